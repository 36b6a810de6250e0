"""The file of a log: a compressed `.npz` with a schema version, never pickled, capped in size.

Entries are the fields of `Log` by name, those of the truth and the plan under `truth/` and `plan/`,
and numbers under `noise/` and `skipped/`.
"""

import math
import zipfile
from dataclasses import fields
from importlib import resources
from pathlib import Path

import numpy as np

from jaxslam.files import atomic_write
from jaxslam.logs.log import FloorPlan, Log, Truth

SCHEMA = 1
BUNDLED = ("lost-in-the-woods",)
MAX_BYTES = 1 << 30  # all entries together, unpacked
MAX_ENTRIES = 1000
MAX_DIMENSIONS = 4
MAX_TEXT_BYTES = 1 << 16


def save_log(path: str | Path, log: Log) -> None:
    """Write a log to `path` (.npz) atomically: an interrupted write leaves the old file.

    Raises `ValueError` if it can't be written.
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise ValueError(f"{path}: a log is a .npz file; name it {path.name}.npz")
    with atomic_write(path) as file, zipfile.ZipFile(file, "w") as archive:
        for name, array in entries_of(log).items():
            # A fixed date, so that the same log makes the same bytes.
            entry = zipfile.ZipInfo(name + ".npy", (1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(entry, "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


def entries_of(log):
    """A log's arrays and numbers by the name of their entry."""
    entries: dict = {"schema": np.int64(SCHEMA)}
    for part, prefix in ((log, ""), (log.truth, "truth/"), (log.plan, "plan/")):
        for item in fields(part) if part is not None else ():
            value = getattr(part, item.name)
            if isinstance(value, dict):
                entries |= {f"{item.name}/{key}": np.asarray(v) for key, v in value.items()}
            elif value is not None and item.name not in ("truth", "plan"):
                entries[prefix + item.name] = np.asarray(value)
    return entries


def load_log(path: str | Path) -> Log:
    """Load the log of a `.npz` file, or the bundled one of that name (`lost-in-the-woods`).

    Raises `ValueError` naming the file and what is wrong with it.
    """
    if str(path) in BUNDLED and not Path(path).exists():
        source = resources.files("jaxslam") / "data" / f"{path}.npz"
        with resources.as_file(source) as file:
            return load_log(file)
    path = Path(path)
    if not path.exists():
        raise ValueError(f"{path}: no such file (bundled logs: {', '.join(BUNDLED)})")
    if path.suffix.lower() != ".npz" and not (path.is_file() and zipfile.is_zipfile(path)):
        raise ValueError(f"{path}: is no log; make one of it with: jaxslam convert {path} OUT.npz")
    try:
        return _build(_read_entries(path))
    except Exception as err:  # foreign bytes: zipfile, zlib and NumPy raise whatever they like
        reason = (str(err).splitlines() or [type(err).__name__])[0]
        raise ValueError(f"{path}: not a log, or damaged: {reason}") from err


def _read_entries(path):
    """Read the arrays by name; each is checked against the caps before it is unpacked."""
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        size = sum(member.file_size for member in members)
        if len(members) > MAX_ENTRIES or size > MAX_BYTES:
            found = f"{len(members)} entries of {size} bytes"
            raise ValueError(f"{found}; allowed are {MAX_ENTRIES} of {MAX_BYTES} bytes")
        entries = {}
        for member in members:
            name = member.filename.removesuffix(".npy")
            if name == member.filename or name in entries:
                raise ValueError(f"entry {member.filename!r} is no array, or is there twice")
            with archive.open(member) as file:
                _check_header(name, file, member.file_size)
            with archive.open(member) as file:
                entries[name] = np.lib.format.read_array(file, allow_pickle=False)
                if file.read(1):  # also checks the CRC, at the end
                    raise ValueError(f"entry {name!r} is longer than its array")
    return entries


def _check_header(name, file, size):
    """Raise for objects, and for shapes that do not fit the entry's size."""
    old = np.lib.format.read_magic(file) == (1, 0)
    read = np.lib.format.read_array_header_1_0 if old else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    if dtype.kind not in "iufU":
        raise ValueError(f"entry {name!r} holds {dtype}; only numbers and text are allowed")
    if len(shape) > MAX_DIMENSIONS or min(shape, default=0) < 0:
        raise ValueError(f"entry {name!r} has shape {shape}; at most {MAX_DIMENSIONS} dimensions")
    data = math.prod(shape) * dtype.itemsize
    if data != size - file.tell() or (dtype.kind == "U" and data > MAX_TEXT_BYTES):
        raise ValueError(f"entry {name!r} of shape {shape} can't be {size} bytes long")


def _build(entries):
    """Build the `Log` of a file's entries."""
    schema = entries.pop("schema", None)
    if schema is None or schema.tolist() != SCHEMA:
        raise ValueError(f"it has schema {schema}; this version reads {SCHEMA}")
    parts = {"": {}, "truth": {}, "plan": {}, "noise": {}, "skipped": {}}
    allowed = {"": Log, "truth": Truth, "plan": FloorPlan}
    for name, array in entries.items():
        head, slash, tail = name.partition("/")
        part, key = (head, tail) if slash else ("", name)
        owner = allowed.get(part)
        known = part in parts and (owner is None or key in [f.name for f in fields(owner)])
        if not known or name in parts:
            raise ValueError(f"unknown entry {name!r}")
        parts[part][key] = array.item() if array.ndim == 0 else array
    values = parts[""]
    for name in ("name", "odometry_time", "odometry", "frame_time", "frame", "view"):
        if name not in values:
            raise ValueError(f"it has no entry {name!r}")
    truth = Truth(**parts["truth"]) if parts["truth"] else None
    plan = FloorPlan(**parts["plan"]) if parts["plan"] else None
    return Log(**values, noise=parts["noise"], skipped=parts["skipped"], truth=truth, plan=plan)
