"""Lock a run folder for one writing process; the system releases the lock when that ends."""

import errno
import os
import platform
from pathlib import Path

NAME = "lock"


def acquire(folder):
    """Lock a folder for this process; returns the file descriptor, which holds it until closed.

    Raises `BlockingIOError`, with the name of the holder, if another process has locked it.
    """
    path = Path(folder) / NAME
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            _lock(handle, path)
            # Its last holder may have removed the file after it was opened here.
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
    import fcntl  # not on Windows, where only runs with checkpoints need it

    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = path.read_text(encoding="utf-8", errors="replace").strip() or "another process"
        problem = f"is being written by {holder}"
        raise BlockingIOError(errno.EWOULDBLOCK, problem, str(path.parent)) from None
