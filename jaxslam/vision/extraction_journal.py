"""What a long extraction has done so far, kept beside its output so that it can go on.

One line of JSON per image, appended and forced to the disk now and then; the first line says what
settings it was made with. A line cut off by a crash is dropped.
"""

import base64
import json
import os
import time
from pathlib import Path

import numpy as np

from jaxslam.vision.lines import Lines

EVERY_S = 1.0  # s between forced writes: that much work is lost at most


class ExtractionJournal:
    """Images done, in order: `rows`, each (name, `Lines` or the reason why there are none).

    `settings`: what the result depends on, as JSON can write it. Use it in a `with`; `path` None
    keeps everything in memory only. Raises `ValueError` when the file there was made with others.
    """

    def __init__(self, path, settings):
        self.path = None if path is None else Path(path)
        self.settings = json.loads(json.dumps(settings))
        self.rows, self.file, self.forced = [], None, time.monotonic()

    def __enter__(self):
        if self.path is None:
            return self
        try:
            kept = self._read() if self.path.exists() else 0
            self.file = open(self.path, "ab")
            self.file.truncate(kept)
        except OSError as err:
            raise ValueError(f"{self.path}: cannot write ({err.strerror})") from err
        if not kept:
            self._append(self.settings)
            self._force()
        return self

    def __exit__(self, *_):
        if self.file is not None:
            self._force()
            self.file.close()

    def _read(self):
        """Fill `rows`; the number of good bytes."""
        data = self.path.read_bytes()
        lines = data[: data.rfind(b"\n") + 1].splitlines(keepends=True)
        if not lines:
            return 0
        try:
            settings = json.loads(lines[0])
            rows = [_decode(json.loads(line)) for line in lines[1:]]
        except (ValueError, KeyError, TypeError) as err:
            raise ValueError(f"{self.path}: is damaged ({err}); delete it to begin anew") from None
        if settings != self.settings:
            both = set(settings) | set(self.settings)
            changed = sorted(k for k in both if settings.get(k) != self.settings.get(k))
            raise ValueError(
                f"{self.path}: was begun with other settings ({', '.join(changed)}); use those "
                "again, or delete it to begin anew"
            )
        self.rows = rows
        return sum(map(len, lines))

    def add(self, name, found):
        """Append an image's `Lines`, or the reason why there are none."""
        self.rows.append((name, found))
        if self.file is not None:
            self._append(_encode(name, found))
            if time.monotonic() - self.forced > EVERY_S:
                self._force()

    def remove(self):
        """Delete the file: the result is in a safe place."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)

    def _append(self, value):
        self.file.write(json.dumps(value).encode() + b"\n")

    def _force(self):
        self.file.flush()
        os.fsync(self.file.fileno())
        self.forced = time.monotonic()


def _encode(name, found):
    if isinstance(found, str):
        return {"image": name, "skipped": found}
    parts = {}
    for field, array in zip(Lines._fields, found, strict=True):
        array = np.ascontiguousarray(array)
        data = base64.b64encode(array.tobytes()).decode()
        parts[field] = [array.dtype.str, list(array.shape), data]
    return {"image": name, "lines": parts}


def _decode(row):
    if "skipped" in row:
        return row["image"], row["skipped"]
    arrays = {}
    for field, (dtype, shape, data) in row["lines"].items():
        array = np.frombuffer(base64.b64decode(data, validate=True), np.dtype(dtype))
        arrays[field] = array.reshape(shape)
    return row["image"], Lines(**arrays)
