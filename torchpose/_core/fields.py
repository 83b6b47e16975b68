"""What arrays that belong together have to be: their types, and sizes that agree with one another."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from torchpose.errors import FileFormatError

__all__ = ["check_arrays", "one_number", "one_text", "sizes_fit", "texts"]

_WORDS = {
    "f": "floating-point numbers", "i": "whole numbers", "b": "true or false", "U": "text",
    "n": "one number",
}  # fmt: skip
_KINDS = {"f": "f", "i": "iu", "b": "b", "U": "U", "n": "fiu"}


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
        if array.dtype.kind not in _KINDS[kind] or (
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
