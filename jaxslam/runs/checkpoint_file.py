"""The file of a checkpoint, named arrays and a manifest, and the fingerprint of a run in it.

An uncompressed `.npz`, never pickled. The manifest is its last entry, JSON as bytes: the run's
fingerprint, and shape, type and SHA-256 of every array.
"""

import json
import math
import zipfile
from contextlib import ExitStack, contextmanager
from hashlib import sha256

import numpy as np

from jaxslam.config import FORMER_FIELDS
from jaxslam.files import atomic_write, fsync_all
from jaxslam.logs.log_file import entries_of
from jaxslam.parameters import current_names

FORMAT = 1
MANIFEST = "manifest"
IRRELEVANT = ("devices",)  # settings that do not change the result
PIECE = 1 << 20  # bytes hashed and written at a time, while they are in cache


def write_checkpoint(path, about, columns):
    """Write a checkpoint atomically.

    `about`: a dict for the manifest. `columns`: pairs of a name and a list of arrays, which are
    concatenated; an iterator, so that only one need be on the host at a time. Raises `OSError` if
    the disk is full, `ValueError` if the file can't be written.
    """
    listed = {}
    with atomic_write(path) as file, zipfile.ZipFile(file, "w") as archive:
        for name, parts in columns:
            listed[name] = _write_entry(archive, name, parts)
        text = json.dumps(about | {"format": FORMAT, "arrays": listed})
        _write_entry(archive, MANIFEST, [np.frombuffer(text.encode(), np.uint8)])
    fsync_all(path.parent)


def _write_entry(archive, name, parts):
    """Write an array without copying it, and return its record in the manifest."""
    shape, dtype = parts[0].shape, parts[0].dtype
    if len(parts) > 1:
        shape = (sum(map(len, parts)), *shape[1:])
    digest = sha256()
    entry = zipfile.ZipInfo(name + ".npy", (1980, 1, 1, 0, 0, 0))
    header = {"descr": dtype.str, "fortran_order": False, "shape": shape}
    with archive.open(entry, "w", force_zip64=True) as member:
        np.lib.format.write_array_header_1_0(member, header)
        for part in parts:
            data = np.ascontiguousarray(part).reshape(-1).view(np.uint8).data
            for start in range(0, len(data), PIECE):
                piece = data[start : start + PIECE]
                digest.update(piece)
                member.write(piece)
    return {"shape": list(shape), "dtype": dtype.str, "sha256": digest.hexdigest()}


@contextmanager
def open_checkpoint(path):
    """Open a checkpoint as its manifest and a function that reads and checks an array by name.

    Names are today's, also in a checkpoint of version 0.1. Both raise `ValueError` for whatever is
    broken.
    """
    with ExitStack() as stack:
        with _name_in_errors(path):
            archive = stack.enter_context(zipfile.ZipFile(path))
            about = json.loads(_read_entry(archive, MANIFEST, None).tobytes())
            if about["format"] != FORMAT:
                raise ValueError(f"format {about['format']}; this version reads {FORMAT}")
            about["run"] = current_settings(about["run"])

        def get(name):
            with _name_in_errors(path):
                if name not in about["arrays"]:
                    name = name.replace("summary.landmark_id", "summary.match")
                    name = name.replace("landmark_id", "birth")
                return _read_entry(archive, name, about["arrays"][name])

        yield about, get


def current_settings(settings):
    """Replace the names that version 0.1 gave to settings and parameters."""
    config = {FORMER_FIELDS.get(name, name): value for name, value in settings["config"].items()}
    return settings | {"config": config, "params": current_names(settings["params"])}


@contextmanager
def _name_in_errors(path):
    try:
        yield
    except MemoryError:  # not the file's fault
        raise
    except Exception as err:  # broken bytes: zipfile, JSON and NumPy raise errors of any type
        reason = (str(err).splitlines() or [""])[0] or type(err).__name__
        raise ValueError(f"{path.name}: {reason}") from err


def _read_entry(archive, name, record):
    """Read an array and check it by its `record` in the manifest (None: the manifest itself)."""
    info = archive.getinfo(name + ".npy")
    with archive.open(info) as member:
        np.lib.format.read_magic(member)
        shape, _, dtype = np.lib.format.read_array_header_1_0(member)
        size = math.prod(shape) * dtype.itemsize
        if dtype.kind not in "biuf" or size != info.file_size - member.tell():
            raise ValueError(f"entry {name} has a broken header")
        if record and (list(shape), dtype.str) != (record["shape"], record["dtype"]):
            raise ValueError(f"entry {name} has another shape or type than in the manifest")
        array, digest = np.empty(shape, dtype), sha256()
        data = array.reshape(-1).view(np.uint8).data
        for start in range(0, size, PIECE):
            piece = data[start : start + PIECE]
            if member.readinto(piece) != len(piece):
                raise ValueError(f"entry {name} is truncated")
            digest.update(piece)
        member.read(1)  # at the end, zipfile compares its checksum
    if record and digest.hexdigest() != record["sha256"]:
        raise ValueError(f"entry {name} has a wrong checksum")
    return array


def run_fingerprint(log, config, params, seed):
    """Collect what determines the result of a run, for JSON."""
    return {
        "frames": [len(log.frame_time), *map(int, log.frame_time[[0, -1]])],
        **run_settings(config, params, seed),
        "log": _hash_log(log),
    }


def run_settings(config, params, seed):
    """Collect the part of a run's fingerprint that is not of the log."""
    return {
        "seed": int(seed),
        "config": {k: v for k, v in vars(config).items() if k not in IRRELEVANT},
        "params": {k: float(v) for k, v in params._asdict().items()},
    }


def _hash_log(log):
    """Compute the SHA-256 of a log's entries."""
    digest = sha256()
    for name, array in sorted(entries_of(log).items()):
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
