"""Read foreign files, and raise one typed error for anything wrong with one.

The directory of the archive and the header of each array come first: their shapes, types and sizes are
checked against one another and against the size of the file before anything is allocated, and only what is
asked for is read."""

import contextlib
import errno
import json
import lzma
import math
import os
import struct
import sys
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchpose.errors import FileFormatError, InputError, TorchposeError, printable

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
    """Turn an error while a file is read into one typed error that names the file.

    Args:
        path: the file. expected: the expected kind of file, as "a TOML camera file".

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
    """Return the content of a JSON file.

    Raises:
        InputError: no such file. FileFormatError: no JSON, or too deeply nested.
    """
    text = read_text(path, expected)
    with reading(path, expected):
        return json.loads(text)


def check_span(where: str | Path, frames: int, rows: int) -> None:
    """Check that the rows of a file are enough for the number of frames that they span.

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


_EXPECTED = "an .npz file of plain arrays"
_SINGLE = b"\x93NUMPY"
_KINDS = "biufcUSmM"  # of dtypes; others are structured, or objects that would have to be unpickled
_FREE, _DENSER = 256 << 20, 100  # bytes; how many times as large as its file what is read may be


def npz_keys(path: str | Path) -> tuple[str, ...]:
    """Return the names of the arrays in an .npz file, none of which is read.

    Raises:
        InputError: no such file. FileFormatError: not an .npz file.
    """
    path = require_file(path)
    with reading(path, _EXPECTED), path.open("rb") as stream:
        if stream.read(len(_SINGLE)) == _SINGLE:
            raise FileFormatError(f"{path}: expected an .npz archive, got a single array")
        with zipfile.ZipFile(stream) as archive:
            return tuple(_members(archive))


def read_npz(
    path: str | Path, required: Sequence[str] = (), optional: Sequence[str] | None = None
) -> dict[str, np.ndarray]:
    """Read arrays of an .npz file, without ever unpickling.

    Args:
        path: the file.
        required: keys that must be there.
        optional: the other keys to read; None reads all. Nothing of the rest is looked at.

    Returns:
        Arrays by key.

    Raises:
        InputError: no such file. FileFormatError: truncated, another kind of file, a pickled
            array, one that claims more numbers than the file can hold, or a required key is missing.
    """
    path = require_file(path)
    there = npz_keys(path)
    keys = [k for k in there if optional is None or k in required or k in optional]
    missing = [key for key in required if key not in there]
    if missing:
        found = ", ".join(sorted(there)) or "nothing"
        words = "key" if len(missing) == 1 else "keys"
        raise FileFormatError(f"{path}: expected the {words} {', '.join(missing)}, found {found}")
    with reading(path, _EXPECTED), zipfile.ZipFile(path) as archive:
        members = _members(archive)
        size = sum(_checked_size(path, archive, key, members[key]) for key in keys)
        most = _FREE + _DENSER * path.stat().st_size
        if size > most:
            raise FileFormatError(
                f"{path}: expected at most {most} bytes of arrays in a file of {path.stat().st_size} "
                f"bytes, it claims {size}; write it again with numpy.savez"
            )
        return {key: _array(archive, members[key]) for key in keys}


def _members(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    return {info.filename.removesuffix(".npy"): info for info in archive.infolist()}


def _checked_size(path: Path, archive: zipfile.ZipFile, key: str, info: zipfile.ZipInfo) -> int:
    """Return the size in bytes of an array, by its header, which has to agree with the directory."""
    where = f"{path}: {key}"
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise FileFormatError(
            f"{where} is packed in a way that NumPy does not write; save it again"
        )
    with archive.open(info) as entry, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about headers as Python 2 wrote them
        version = np.lib.format.read_magic(entry)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, _, dtype = read_header(entry)
        there = info.file_size - entry.tell()
    if dtype.kind not in _KINDS or dtype.hasobject:
        raise FileFormatError(
            f"{where} must be an array of numbers or text, got {dtype!s:.60}; pickled objects and "
            "structures are not read"
        )
    count = math.prod(shape)
    if min(shape, default=0) < 0 or count * dtype.itemsize != there or count > max(there, 1):
        raise FileFormatError(
            f"{where} claims the shape {list(shape)!s:.60} of {dtype!s:.20}, which does not fit its "
            f"{there} bytes; the file is truncated or damaged"
        )
    return there


def _array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(info) as entry:
        array: np.ndarray = np.lib.format.read_array(entry, allow_pickle=False)
        entry.read(1)  # the end, where the checksum is compared
    if array.dtype.kind == "U" and array.size:
        codes = np.ascontiguousarray(array).reshape(-1).view(f"{array.dtype.byteorder}u4")
        if codes.max() > sys.maxunicode:
            raise ValueError("text of other characters than Unicode has")
    return array


_WORDS = {
    "f": "floating-point numbers", "i": "whole numbers", "b": "true or false", "U": "text",
    "n": "one number",
}  # fmt: skip
_KINDS_OF_FIELDS = {"f": "f", "i": "iu", "b": "b", "U": "U", "n": "fiu"}


def check_arrays(
    path: str | Path, arrays: Mapping[str, np.ndarray], fields: Mapping[str, str]
) -> dict[str, int]:
    """Check arrays of a file against their fields.

    Args:
        path: the file. arrays: by key.
        fields: by key a kind (f, i, b, U as of NumPy's dtypes, n for any number) and the sizes, as
            "f T 8 3"; a letter stands for the same size in all of them.

    Returns:
        The sizes by letter.

    Raises:
        FileFormatError: another type or another shape; the key is named.
    """
    letters: dict[str, int] = {}
    for key, text in fields.items():
        kind, _, sizes = text.partition(" ")
        array = arrays[key]
        if array.dtype.kind not in _KINDS_OF_FIELDS[kind] or (
            kind == "f" and array.dtype.itemsize not in (4, 8)
        ):
            raise FileFormatError(
                f"{path}: expected {_WORDS[kind]} in {key}, got {array.dtype!s:.40}"
            )
        if not sizes_fit(sizes, array.shape, letters):
            known = ", ".join(f"{letter} = {size}" for letter, size in letters.items())
            raise FileFormatError(
                f"{path}: expected the shape [{', '.join(sizes.split())}] of {key}, got "
                f"{list(array.shape)!s:.60}{f' where {known}' if known else ''}"
            )
    return letters


def sizes_fit(sizes: str, shape: tuple[int, ...], letters: dict[str, int]) -> bool:
    """Return whether a shape has these sizes; letters that are met for the first time are kept.

    >>> letters = {}
    >>> sizes_fit("T 3", (5, 3), letters), sizes_fit("T 2", (6, 2), letters), letters
    (True, False, {'T': 5})
    """
    expected = sizes.split()
    return len(expected) == len(shape) and all(
        (int(size) if size.isdigit() else letters.setdefault(size, found)) == found
        for size, found in zip(expected, shape, strict=True)
    )


def one_number(path: str | Path, key: str, array: np.ndarray) -> float:
    """Return the one number of an array, in any shape.

    Raises:
        FileFormatError: it holds text, several numbers, or none.
    """
    if array.dtype.kind not in "fiu" or array.size != 1:
        raise FileFormatError(
            f"{path}: {key} must be one number, got {array.dtype!s:.40} of shape {list(array.shape)!s:.60}"
        )
    return float(array.item())


def one_text(path: str | Path, key: str, array: np.ndarray) -> str:
    """Return the one text of an array.

    Raises:
        FileFormatError: it holds numbers, several texts, or none.
    """
    if array.dtype.kind != "U" or array.size != 1:
        raise FileFormatError(
            f"{path}: {key} must be one text, got {array.dtype!s:.40} of shape {list(array.shape)!s:.60}"
        )
    return str(array.item())


def texts(path: str | Path, key: str, array: np.ndarray) -> tuple[str, ...]:
    """Return the texts of an array [N]; an empty one of any type has none.

    Raises:
        FileFormatError: it holds numbers, or has another number of dimensions.
    """
    if array.size == 0:
        return ()
    if array.dtype.kind != "U" or array.ndim > 1:
        raise FileFormatError(
            f"{path}: {key} must be a list of text, got {array.dtype!s:.40} of shape "
            f"{list(array.shape)!s:.60}"
        )
    return tuple(str(text) for text in array.ravel())
