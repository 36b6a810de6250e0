"""One writer at a time: a lock file in a run's folder; the lock dies with its process."""

import errno
import os
import platform
from pathlib import Path

NAME = "lock"


def acquire(folder):
    """Lock a folder for this process; gives the open file, which keeps the lock until it is closed.

    Raises `BlockingIOError` naming the holder where another has it.
    """
    path = Path(folder) / NAME
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            _lock(handle, path)
            # Its last holder may have removed the file between our opening and locking it.
            if path.exists() and os.path.samestat(os.stat(path), os.fstat(handle)):
                os.truncate(handle, 0)
                os.write(handle, f"process {os.getpid()} on {platform.node()}\n".encode())
                return handle
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


def check_unlocked(folder):
    """Raise `BlockingIOError` if another process has this folder locked."""
    path = Path(folder) / NAME
    try:
        handle = os.open(path, os.O_RDONLY)
    except (FileNotFoundError, NotADirectoryError):
        return
    try:
        _lock(handle, path)
    finally:
        os.close(handle)


def _lock(handle, path):
    import fcntl  # here: there is none on Windows, where plain runs need none

    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = path.read_text(encoding="utf-8", errors="replace").strip() or "another process"
        told = f"is being written by {holder}"
        raise BlockingIOError(errno.EWOULDBLOCK, told, str(path.parent)) from None
