"""Read and write files safely: whole files or none, typed errors, no pickles, nothing left over."""

import contextlib
import os
import secrets
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from torchpose._core.reading import read_npz, require_file
from torchpose.errors import OutputError

__all__ = [
    "as_output_error",
    "atomic_path",
    "check_output_folder",
    "clear_leftovers",
    "hold",
    "hold_folder",
    "read_npz",
    "require_file",
    "write_npz",
]

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


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


def hold_folder(folder: Path) -> tuple[int | None, bool | None]:
    """Return a descriptor that holds a lock on a folder until it is closed, and what `hold` says."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:  # Windows opens no folders
        return None, None
    held = hold(handle)
    if held:
        return handle, True
    os.close(handle)
    return None, held


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


@contextlib.contextmanager
def as_output_error(path: Path) -> Iterator[None]:
    """Raise an `OutputError` that names the path in place of the system's errors."""
    try:
        yield
    except OSError as error:
        if isinstance(error, OutputError):
            raise
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary file in the same folder that becomes `path` when the block succeeds.

    The temporary file keeps the suffix of `path` (`numpy.savez` and picture writers look at it).
    When the block fails it is removed, and what stood at `path` before is untouched. What a killed
    process left is removed by the next `check_output_folder`.

    Args:
        path: where the file is to appear; its folder must exist.

    Yields:
        Path of the temporary file, for the block to write to.

    Raises:
        OutputError: the folder is missing or not writable, the disk is full, or `path` is a folder.

    >>> import tempfile
    >>> target = Path(tempfile.mkdtemp()) / "note.txt"
    >>> with atomic_path(target) as temporary:
    ...     _ = temporary.write_text("whole or not at all")
    >>> target.read_text()
    'whole or not at all'
    """
    path = Path(path)
    if path.is_dir():
        raise OutputError(f"{path}: is a folder; give the name of a file")
    # Named before it is made, and made inside the `try`: a signal between the two leaves nothing.
    temporary = path.with_name(f"{_PREFIX}{secrets.token_hex(8)}{path.suffix}")
    handle = None
    try:
        with as_output_error(path):
            handle = _make(temporary, path)
            if os.name == "nt":  # an open file cannot be renamed there
                os.close(handle)
            yield temporary
            umask = os.umask(0)
            os.umask(umask)
            temporary.chmod(0o666 & ~umask)  # only its owner could read it so far
            temporary.replace(path)
    finally:
        with contextlib.suppress(OSError):  # never made, or renamed
            temporary.unlink()
        if handle is not None and os.name != "nt":
            os.close(handle)


def _make(temporary: Path, path: Path) -> int:
    """Make a file that `clear_leftovers` leaves alone until its descriptor is closed; return that."""
    while True:
        try:
            handle = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        except OSError as error:
            raise OutputError(f"{path}: cannot write here ({error.strerror or error})") from error
        hold(handle, wait=True)
        if temporary.exists():
            return handle
        os.close(handle)  # another process took it for a leftover before it was locked


def check_output_folder(folder: str | Path, option: str = "--out") -> Path:
    """Make the folder if need be, see that files can be written there, clear what killed runs left.

    Args:
        folder: of results. option: that names another one.

    Raises:
        OutputError: it is a file, cannot be made, or is not writable.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        clear_leftovers(folder)
    except OSError as error:
        raise OutputError(
            f"{folder}: results cannot be written to this folder ({error.strerror or error}); "
            f"choose another with {option}"
        ) from error
    return folder


def write_npz(path: str | Path, arrays: dict[str, Any]) -> None:
    """Write arrays as a compressed .npz; the file appears whole or not at all."""
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, **arrays)
