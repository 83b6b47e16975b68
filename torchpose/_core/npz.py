"""Arrays of .npz files, read with no more trust than is needed.

The directory of the archive and the header of each array come first: their shapes, types and sizes are
checked against one another and against the size of the file before anything is allocated, and only what is
asked for is read.
"""

import math
import sys
import warnings
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from torchpose._core.reading import reading, require_file
from torchpose.errors import FileFormatError

__all__ = ["npz_keys", "read_npz"]

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
