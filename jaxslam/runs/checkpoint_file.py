"""One file of a run put aside: arrays by name, and a manifest by which each of them is checked.

An uncompressed `.npz`, never pickled. The manifest is its last entry, JSON as bytes: what the run
was told, and of every array its shape, type and SHA-256.
"""

import json
import math
import zipfile
from contextlib import ExitStack, contextmanager
from hashlib import sha256

import numpy as np

from jaxslam.files import atomic_write, fsync_all
from jaxslam.logs.log_file import entries_of

FORMAT = 1
MANIFEST = "manifest"
PIECE = 1 << 20  # bytes at once: checksum and write while they are in cache


def write_checkpoint(path, about, columns):
    """Write a checkpoint, all or nothing.

    `about`: a dict for the manifest. `columns`: pairs of a name and a list of arrays, which are
    joined along the first axis; looked at one by one, so that only one need be on the host. Raises
    `OSError` where there is no space, `ValueError` where the place can't be written.
    """
    listed = {}
    with atomic_write(path) as file, zipfile.ZipFile(file, "w") as archive:
        for name, parts in columns:
            listed[name] = _put(archive, name, parts)
        text = json.dumps(about | {"format": FORMAT, "arrays": listed})
        _put(archive, MANIFEST, [np.frombuffer(text.encode(), np.uint8)])
    fsync_all(path.parent)


def _put(archive, name, parts):
    """Write one entry, without a copy of it; gives its line of the manifest."""
    shape, dtype = parts[0].shape, parts[0].dtype
    if len(parts) > 1:
        shape = (sum(map(len, parts)), *shape[1:])
    digest = sha256()
    entry = zipfile.ZipInfo(name + ".npy", (1980, 1, 1, 0, 0, 0))
    head = {"descr": dtype.str, "fortran_order": False, "shape": shape}
    with archive.open(entry, "w", force_zip64=True) as member:
        np.lib.format.write_array_header_1_0(member, head)
        for part in parts:
            data = np.ascontiguousarray(part).reshape(-1).view(np.uint8).data
            for start in range(0, len(data), PIECE):
                piece = data[start : start + PIECE]
                digest.update(piece)
                member.write(piece)
    return {"shape": list(shape), "dtype": dtype.str, "sha256": digest.hexdigest()}


@contextmanager
def open_checkpoint(path):
    """A checkpoint's manifest, and a function of a name that reads and checks that array.

    Both raise `ValueError` for whatever is not as it was written.
    """
    with ExitStack() as stack:
        with _blaming(path):
            archive = stack.enter_context(zipfile.ZipFile(path))
            about = json.loads(_get(archive, MANIFEST, None).tobytes())
            if about["format"] != FORMAT:
                raise ValueError(f"format {about['format']}; this version reads {FORMAT}")

        def get(name):
            with _blaming(path):
                return _get(archive, name, about["arrays"][name])

        yield about, get


@contextmanager
def _blaming(path):
    try:
        yield
    except MemoryError:  # no fault of the file
        raise
    except Exception as err:  # broken bytes: zipfile, JSON and NumPy raise whatever they like
        reason = (str(err).splitlines() or [""])[0] or type(err).__name__
        raise ValueError(f"{path.name}: {reason}") from err


def _get(archive, name, line):
    """The array of one entry; `line`: that of the manifest (None: for the manifest itself)."""
    info = archive.getinfo(name + ".npy")
    with archive.open(info) as member:
        np.lib.format.read_magic(member)
        shape, _, dtype = np.lib.format.read_array_header_1_0(member)
        size = math.prod(shape) * dtype.itemsize
        if dtype.kind not in "biuf" or size != info.file_size - member.tell():
            raise ValueError(f"entry {name} is not as it was written")
        if line and (list(shape), dtype.str) != (line["shape"], line["dtype"]):
            raise ValueError(f"entry {name} is not what its manifest says")
        array, digest = np.empty(shape, dtype), sha256()
        data = array.reshape(-1).view(np.uint8).data
        for start in range(0, size, PIECE):
            piece = data[start : start + PIECE]
            if member.readinto(piece) != len(piece):
                raise ValueError(f"entry {name} ends too soon")
            digest.update(piece)
        member.read(1)  # the end, where zipfile compares its own checksum
    if line and digest.hexdigest() != line["sha256"]:
        raise ValueError(f"entry {name} has another checksum")
    return array


def digest_of_log(log):
    """SHA-256 of everything in a log."""
    digest = sha256()
    for name, array in sorted(entries_of(log).items()):
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
