"""The boundary that foreign files come in through: whatever is wrong with one is one typed error."""

import contextlib
import errno
import json
import lzma
import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from torchpose.errors import FileFormatError, InputError, TorchposeError, printable

__all__ = ["check_span", "read_json", "read_text", "reading", "require_file"]

# What parsers raise at damaged files: those of Python, NumPy, PyTorch and safetensors. A lack of memory
# is none of them: sizes are looked at before anything is allocated.
_DAMAGE = (
    ArithmeticError, AssertionError, AttributeError, EOFError, LookupError, NotImplementedError,
    RuntimeError, SyntaxError, TypeError, ValueError,
    lzma.LZMAError, struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
_LONGEST_REASON = 200  # characters of what a parser says
_FREE_FRAMES, _FRAMES_PER_ROW = 100_000, 100


def require_file(path: str | Path) -> Path:
    """Return `path` as a Path, or raise `InputError` if there is no such file."""
    path = Path(path)
    if os.path.isfile(path):
        return path
    if os.path.isdir(path):
        raise InputError(f"{path}: is a folder, not a file")
    raise InputError(f"{path}: {_why_no_file(path)}")


def _why_no_file(path: Path) -> str:
    try:
        path.stat()
    except ValueError:
        return "no such file: a name cannot hold a NUL character"
    except OSError as error:
        if error.errno in (errno.ENOENT, errno.ENOTDIR):
            return "no such file"
        return f"no such file ({error.strerror or error})"
    return "is no file but a pipe or a device"


@contextlib.contextmanager
def reading(path: str | Path, expected: str) -> Iterator[None]:
    """Turn what goes wrong while a file is read into one typed error that names it.

    Args:
        path: the file. expected: what it should be, as "a TOML camera file".

    Raises:
        InputError: it cannot be opened or read. FileFormatError: whatever a parser raises at it. Errors
            of torchpose stay what they are, with the file's name in front where they lack it.
    """
    try:
        yield
    except TorchposeError as error:
        if printable(str(path)) in str(error) or not isinstance(error, ValueError):
            raise
        raise type(error)(f"{path}: {error}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except RecursionError as error:
        raise FileFormatError(f"{path}: expected {expected}; it is nested too deeply") from error
    except _DAMAGE as error:
        raise FileFormatError(
            f"{path}: expected {expected}; it is truncated or of another kind, or damaged "
            f"({_reason(error)})"
        ) from error


def read_text(path: str | Path, expected: str, encoding: str = "utf-8-sig") -> str:
    """Return the text of a file.

    Raises:
        InputError: no such file. FileFormatError: not in this encoding.
    """
    path = require_file(path)
    with reading(path, expected):
        return path.read_text(encoding=encoding)


def read_json(path: str | Path, expected: str) -> Any:
    """Return what a file of JSON holds.

    Raises:
        InputError: no such file. FileFormatError: no JSON, or too deeply nested.
    """
    text = read_text(path, expected)
    with reading(path, expected):
        return json.loads(text)


def check_span(where: str | Path, frames: int, rows: int) -> None:
    """Raise `FileFormatError` if so few rows claim to span so many frames.

    A table has a place for each frame between the first and the last one, so two damaged frame numbers
    could fill the memory.

    Args:
        where: the file. frames: from the first to the last one. rows: those that are there.
    """
    most = _FREE_FRAMES + _FRAMES_PER_ROW * rows
    if frames > most:
        raise FileFormatError(
            f"{where}: frame numbers span {frames} frames, of which {rows} are there; at most {most} are "
            "taken for one recording: cut it where nobody was there, or correct the numbers"
        )


def _reason(error: BaseException) -> str:
    lines = [line.strip() for line in str(error)[:2000].splitlines() if line.strip()]
    return (lines[0] if lines else type(error).__name__)[:_LONGEST_REASON]
