"""Reading and writing files safely: whole files or none, typed errors, no pickles."""

import contextlib
import os
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchpose.errors import FileFormatError, InputError, OutputError

__all__ = ["atomic_path", "check_output_folder", "read_npz", "require_file", "write_npz"]


def require_file(path: str | Path) -> Path:
    """Return `path` as a Path, or raise `InputError` if there is no such file."""
    path = Path(path)
    if not path.is_file():
        raise InputError(
            f"{path}: {'is a folder, not a file' if path.is_dir() else 'no such file'}"
        )
    return path


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary file in the same folder that becomes `path` when the block succeeds.

    The temporary file keeps the suffix of `path` (`numpy.savez` and picture writers look at it).
    When the block fails it is removed, and what stood at `path` before is untouched.

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
    try:
        handle, name = tempfile.mkstemp(
            dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix
        )
        os.close(handle)
    except OSError as error:
        raise OutputError(f"{path}: cannot write here ({error.strerror or error})") from error
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)  # mkstemp makes files that only their owner can read
        temporary.replace(path)
    except OSError as error:
        if isinstance(error, OutputError):
            raise
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        temporary.unlink(missing_ok=True)


def check_output_folder(folder: str | Path) -> Path:
    """Make the folder if need be and see that files can be written there, before any work.

    Raises:
        OutputError: it is a file, cannot be made, or is not writable.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OutputError(
            f"{folder}: results cannot be written to this folder ({error.strerror or error}); "
            "choose another with --out"
        ) from error
    return folder


def read_npz(
    path: str | Path, required: Sequence[str] = (), optional: Sequence[str] | None = None
) -> dict[str, np.ndarray]:
    """Read arrays of an .npz file, without ever unpickling.

    Args:
        path: the file.
        required: keys that must be there.
        optional: the other keys to read; None reads all.

    Returns:
        Arrays by key.

    Raises:
        InputError: no such file. FileFormatError: truncated, another kind of file, a pickled
            array, or a required key is missing.
    """
    path = require_file(path)
    try:
        # opened here, because numpy leaves a file open that turns out to be damaged
        with path.open("rb") as stream:
            archive = np.load(stream, allow_pickle=False)
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise FileFormatError(f"{path}: expected an .npz archive, got a single array")
            keys = archive.files
            if optional is not None:
                keys = [key for key in keys if key in required or key in optional]
            found = ", ".join(sorted(archive.files)) or "nothing"
            arrays = {key: archive[key] for key in keys}
    except FileFormatError:
        raise
    except (ValueError, EOFError, OSError, KeyError, zipfile.BadZipFile, zlib.error,
            NotImplementedError, RuntimeError, SyntaxError, TypeError) as error:  # fmt: skip
        reason = str(error).split(". ")[0]
        raise FileFormatError(
            f"{path}: expected an .npz file of plain arrays; it is truncated, of another kind, or "
            f"holds pickled objects ({reason})"
        ) from error
    missing = [key for key in required if key not in arrays]
    if missing:
        raise FileFormatError(f"{path}: expected the keys {', '.join(missing)}, found {found}")
    return arrays


def write_npz(path: str | Path, arrays: dict[str, Any]) -> None:
    """Write arrays as a compressed .npz; the file appears whole or not at all."""
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, **arrays)
