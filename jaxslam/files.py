"""Write files and folders atomically: they appear complete or not at all."""

import errno
import os
import shutil
from contextlib import contextmanager
from pathlib import Path
from secrets import token_hex

NO_SPACE = (errno.ENOSPC, errno.EDQUOT)


@contextmanager
def atomic_write(path):
    """Open a binary file that becomes `path` once it is complete and on the disk.

    If anything fails, the old file stays and no temporary file is left. Raises `ValueError` if the
    path can't be written, `OSError` if there is no space.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as err:
        if err.errno in NO_SPACE:
            raise OSError(err.errno, err.strerror, str(path)) from err
        raise ValueError(f"{path}: cannot write ({err.strerror}); choose another path") from err
    finally:
        temporary.unlink(missing_ok=True)


def move_folder(partial, target, overwrite):
    """Rename the folder `partial` to `target`; `overwrite`: replace a folder that exists."""
    old = temporary_sibling(target) if overwrite and target.exists() else None
    if old:
        os.rename(target, old)
    try:
        os.rename(partial, target)
    except BaseException:
        if old:
            os.rename(old, target)
        raise
    fsync_all(target.parent)
    if old:
        shutil.rmtree(old, ignore_errors=True)


def temporary_sibling(target):
    """Return an unused name in the same folder, from which renaming to `target` is atomic."""
    return target.with_name(f".{target.name}.{token_hex(4)}")


def fsync_all(*paths):
    """Flush files or folders to the disk."""
    for path in paths:
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
