"""Journal of a long extraction, kept beside its output so that an interrupted run can resume.

One line of JSON per image, appended, and synchronized to disk about once a second; the first line
holds the settings. A line cut off by a crash is dropped.
"""

import base64
import json
import os
import time
from pathlib import Path

import numpy as np

from jaxslam.vision.lines import Lines

EVERY_S = 1.0  # s between calls of fsync: at most that much work is lost


class ExtractionJournal:
    """The finished images in order: `images`, each (name, `Lines` or the reason for having none).

    `settings`: what the result depends on, as JSON values. A context manager; with `path` None
    everything stays in memory. Raises `ValueError` if an existing file has other settings.
    """

    def __init__(self, path, settings):
        self.path = None if path is None else Path(path)
        self.settings = json.loads(json.dumps(settings))
        self.images, self.file, self.synced = [], None, time.monotonic()

    def __enter__(self):
        if self.path is None:
            return self
        try:
            size = self._read() if self.path.exists() else 0
            self.file = open(self.path, "ab")
            self.file.truncate(size)
        except OSError as err:
            raise ValueError(f"{self.path}: cannot write ({err.strerror})") from err
        if not size:
            self._append(self.settings)
            self._sync()
        return self

    def __exit__(self, *_):
        if self.file is not None:
            self._sync()
            self.file.close()

    def _read(self):
        """Read `images` from the file; returns the number of intact bytes."""
        data = self.path.read_bytes()
        lines = data[: data.rfind(b"\n") + 1].splitlines(keepends=True)
        if not lines:
            return 0
        try:
            settings = json.loads(lines[0])
            images = [_decode(json.loads(line)) for line in lines[1:]]
        except (ValueError, KeyError, TypeError) as err:
            raise ValueError(f"{self.path}: is damaged ({err}); delete it to restart") from None
        if settings != self.settings:
            both = set(settings) | set(self.settings)
            changed = sorted(k for k in both if settings.get(k) != self.settings.get(k))
            fault = f"was started with other settings ({', '.join(changed)})"
            raise ValueError(f"{self.path}: {fault}; use those again, or delete it to restart")
        self.images = images
        return sum(map(len, lines))

    def add(self, name, lines):
        """Append an image's `Lines`, or the reason why there are none."""
        self.images.append((name, lines))
        if self.file is not None:
            self._append(_encode(name, lines))
            if time.monotonic() - self.synced > EVERY_S:
                self._sync()

    def remove(self):
        """Delete the file, once the result is stored elsewhere."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)

    def _append(self, value):
        self.file.write(json.dumps(value).encode() + b"\n")

    def _sync(self):
        self.file.flush()
        os.fsync(self.file.fileno())
        self.synced = time.monotonic()


def _encode(name, lines):
    if isinstance(lines, str):
        return {"image": name, "skipped": lines}
    parts = {}
    for field, array in zip(Lines._fields, lines, strict=True):
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
