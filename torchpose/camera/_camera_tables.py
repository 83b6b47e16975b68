"""Find the tables of cameras in the contents of a TOML file, and write such tables."""

import re
from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any

from torchpose.errors import CameraError, FileFormatError

_KEYS = ("name", "size", "matrix", "distortions", "rotation", "translation", "fisheye", "up")
_OF_CAMERAS = ("size", "distortions", "rotation", "translation")  # what no other table has
_ALIKE = 0.75  # similarity of two keys from which on one is the other misspelt
_ELSEWHERE = {
    "k": "matrix", "camera_matrix": "matrix", "d": "distortions", "dist": "distortions",
    "dist_coeffs": "distortions", "distortion_coefficients": "distortions", "r": "rotation",
    "rvec": "rotation", "t": "translation", "tvec": "translation", "image_size": "size",
    "resolution": "size",
}  # fmt: skip
"""What other programs call these keys."""
_ALL = "cameras"  # the table in which some programs put those of cameras, by their numbers
_QUIET = ("metadata",)  # tables that are passed over without a word


def camera_tables(
    path: object, content: Mapping[str, Any]
) -> tuple[dict[str, Mapping[str, Any]], tuple[str, ...]]:
    """Return the tables of cameras by their names, and the names of tables that are something else.

    Tables are at the top, or in one that is called `cameras`; there a camera that is but a number, 0, is
    called cam_0. A table without `matrix` is no camera if it has nothing of one, or if it says
    `ignore = true`, as long as another has a matrix.

    Args:
        path: the file, for messages. content: of it.

    Raises:
        FileFormatError: there is no table. CameraError: a camera without its matrix.
    """
    tables = {name: table for name, table in content.items() if isinstance(table, Mapping)}
    nested = tables.get(_ALL, {})
    if "matrix" not in nested and any(_is_camera(table) for table in nested.values()):
        del tables[_ALL]
        named = {f"cam_{key}" if key.isdecimal() else key: table for key, table in nested.items()}
        tables = {**{name: t for name, t in named.items() if isinstance(t, Mapping)}, **tables}
    some = any(_is_camera(table) for table in tables.values())
    left_out = [name for name, table in tables.items() if _is_left_out(name, table, some)]
    found = {name: table for name, table in tables.items() if name not in left_out}
    if not found:
        raise FileFormatError(f"{path}: expected a table per camera with `matrix`, found none")
    for name, table in found.items():
        if "matrix" not in table:
            raise CameraError(
                f"{path} [{name}]: a camera needs `matrix` (3 x 3, pixels), got {sorted(table)}"
            )
    return found, tuple(name for name in left_out if name not in _QUIET)


def check_keys(where: str, table: Mapping[str, Any]) -> None:
    """Raise `CameraError` for a key that is misspelt, or named as elsewhere: what it says would not count."""
    for key in table:
        if key in _KEYS:
            continue
        other = _ELSEWHERE.get(key.lower())
        if other is None or other in table:
            other = next(iter(get_close_matches(key.lower(), _KEYS, 1, _ALIKE)), None)
        if other is not None:
            raise CameraError(f"{where}: expected `{other}`, got `{key}`")


def table_text(name: str, table: Mapping[str, Any]) -> str:
    """Return a table of numbers, lists of numbers and truth values as TOML.

    Args:
        name: of the camera. table: what stands below its name.
    """
    header = name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _string(name)
    lines = [f"[{header}]", f"name = {_string(name)}"]
    for key, value in table.items():
        # repr of a Python float is the shortest text that reads back to the same number
        lines.append(f"{key} = {str(value).lower() if isinstance(value, bool) else value}")
    return "\n".join(lines) + "\n"


def _is_camera(table: Any) -> bool:
    return isinstance(table, Mapping) and "matrix" in table


def _is_left_out(name: str, table: Mapping[str, Any], some: bool) -> bool:
    """Return whether a table is no camera; some says whether another is one."""
    if "matrix" in table:
        return False
    unused = table.get("ignore") is True or not any(key in table for key in _OF_CAMERAS)
    return name in _QUIET or (some and unused)


def _string(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in escaped) + '"'
