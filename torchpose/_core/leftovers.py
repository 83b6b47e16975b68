"""Temporary files and folders that are locked while their process lives, and cleared afterwards."""

import contextlib
import os
import tempfile
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

__all__ = ["clear_leftovers", "hold", "make_temporary_file"]

_PREFIX = ".torchpose-tmp-"


def hold(handle: int, wait: bool = False) -> bool | None:
    """Lock an open file or folder until it is closed.

    The system releases the lock when the process ends, however it ends.

    Args:
        handle: its descriptor. wait: until no other process holds it.

    Returns:
        True if it is locked now, False if another process holds it, None where there are no locks.
    """
    if fcntl is None:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return None
    return True


def make_temporary_file(folder: Path, suffix: str) -> tuple[int, Path]:
    """Make a file that `clear_leftovers` leaves alone until its descriptor is closed.

    Returns:
        The descriptor and the path.

    Raises:
        OSError: it cannot be made.
    """
    while True:
        handle, name = tempfile.mkstemp(dir=folder, prefix=_PREFIX, suffix=suffix)
        if hold(handle) is not False and os.path.exists(name):
            return handle, Path(name)
        os.close(handle)  # taken for a leftover before it was locked


def clear_leftovers(folder: str | Path) -> None:
    """Remove the temporary files that killed processes left in a folder.

    Those of processes that are alive stay, and so does everything where there are no locks.
    """
    for path in Path(folder).glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):
            handle = os.open(path, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
            try:
                if hold(handle):
                    path.unlink()
            finally:
                os.close(handle)
