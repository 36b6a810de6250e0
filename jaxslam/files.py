"""Files and folders that appear whole or not at all."""

import errno
import os
import shutil
from contextlib import contextmanager
from pathlib import Path
from secrets import token_hex

NO_SPACE = (errno.ENOSPC, errno.EDQUOT)


@contextmanager
def atomic_write(path):
    """A binary file that becomes `path` once it is written and on the disk.

    Whatever goes wrong, the old file stays and nothing is left beside it. Raises `ValueError` where
    the place can't be written, `OSError` where there is no space.
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
        raise ValueError(f"{path}: cannot write ({err.strerror}); choose another place") from err
    finally:
        temporary.unlink(missing_ok=True)


def move_folder(partial, target, overwrite):
    """Rename the folder `partial` to `target`, with `overwrite` in place of one that is there."""
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
    """A name nobody uses, in the same folder, so that renaming it to `target` is one step."""
    return target.with_name(f".{target.name}.{token_hex(4)}")


def fsync_all(*paths):
    """See files or folders onto the disk."""
    for path in paths:
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
