"""Damage to files: of bytes, of text, of the structure of archives, of JSON, and of paths."""

import copy
import functools
import io
import json
import os
import re
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

__all__ = ["bomb", "damage_content", "place"]

_BOMB = 700 << 20  # bytes of zeros that an entry of an archive unpacks to, above the memory allowed
_RAW = "@raw@"

ODD_NUMBERS = (
    "nan", "inf", "-inf", "1e400", "-1e400", "1e308", "1e160", "-1", "0", "-0.0", "1e-320", "1.5",
    "2000000", "99999999999", "80000000000", "1" * 5000, "9" * 400, "true", "null", "", "x", "0x10",
    "1_0", "²", "1e5", "-1e9", "18446744073709551616",
)  # fmt: skip
"""What a number of a text is replaced by."""

_ODD_VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1.5, 1e160, -1e308, 10**400, 2**70, "", "nan", "x\x1b[31mred\x07",
    "a\nb", "\u202e", "y" * 200_000, [], {}, [[]], [None], [1], {"a": 1}, [[1.0, 2.0]] * 3,
    _RAW + "NaN", _RAW + "Infinity", _RAW + "1e999", _RAW + "1" * 5000,
    _RAW + "[" * 100_000 + "]" * 100_000, _RAW + "[" * 3000 + "]" * 3000,
    _RAW + '{"a":' * 3000 + "1" + "}" * 3000,
)  # fmt: skip
"""What a value of JSON is replaced by; text after `_RAW` goes into the file as it is."""


# --- bytes ----------------------------------------------------------------------------------------


def _bytes(content: bytes, rng: Random) -> bytes:
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 5, 20))):
        at, to = rng.randrange(len(data) + 1), rng.randrange(len(data) + 1)
        match rng.randrange(8):
            case 0 if data:
                data[at % len(data)] ^= 1 << rng.randrange(8)
            case 1 if data:
                data[at % len(data)] = rng.choice((0, 255, 127, 128, rng.randrange(256)))
            case 2:
                data = data[:at]
            case 3:
                del data[at : at + rng.choice((1, 4, 100))]
            case 4:
                data[at:at] = rng.randbytes(rng.choice((1, 2, 8, 300)))
            case 5:
                data[at:at] = data[to : to + rng.choice((8, 200))]
            case 6:
                width = rng.choice((2, 4, 8))
                limit = rng.choice((0, 1, (1 << 8 * width) - 1, 1 << (8 * width - 1)))
                data[at : at + width] = limit.to_bytes(width, rng.choice(("little", "big")))
            case _:
                data[at:at] = rng.choice((b"\x1b[2J", b"\0", b"\xff\xfe", b"\r", b"\n\n"))
    return bytes(data)


def _other(_: bytes, rng: Random) -> bytes:
    return rng.choice(
        (b"", b"\0" * 4096, b"hello\n", b"PK\x03\x04", b"\x93NUMPY\x01\0", b"{}", b"[]", b"null",
         b"\x80\x04\x95 pickle", b"[" * 60_000, b'{"a":' * 60_000, b"%YAML:1.0\n---\n", b"\xef\xbb\xbf",
         b"a" * 4_000_000, b"\x1b]0;title\x07", b"\xff" * 64, b"1," * 200_000)
    )  # fmt: skip


# --- text -----------------------------------------------------------------------------------------

_NUMBER = re.compile(rb"(?<![A-Za-z_])[-+]?\d+(?:\.\d*)?(?:e[-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_]{2,}")


def _text(content: bytes, rng: Random) -> bytes:
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        content = rng.choice(_TEXT)(content, rng)
    return content


def _numbers(content: bytes, rng: Random) -> bytes:
    found = list(_NUMBER.finditer(content))
    if not found:
        return content
    first = rng.random() < 0.3  # what stands first are often sizes and rates
    match = found[rng.randrange(min(8, len(found)))] if first else rng.choice(found)
    odd = rng.choice(ODD_NUMBERS).encode()
    return content[: match.start()] + odd + content[match.end() :]


def _words(content: bytes, rng: Random) -> bytes:
    found = list(_WORD.finditer(content))
    if not found:
        return content
    match = rng.choice(found)
    odd = (b"", b"x", b"nose", b"\x1b[31mred\x1b[0m", b"\xe4\xf6", b"w" * 100_000, b"true", b"nan",
           rng.choice(found)[0])  # fmt: skip
    return content[: match.start()] + rng.choice(odd) + content[match.end() :]


def _lines(content: bytes, rng: Random) -> bytes:
    lines = content.split(b"\n")
    a, b = rng.randrange(len(lines)), rng.randrange(len(lines))
    match rng.randrange(6):
        case 0:
            del lines[a]
        case 1:
            lines.insert(b, lines[a])
        case 2:
            lines[a], lines[b] = lines[b], lines[a]
        case 3:
            lines[a] = lines[a][: rng.randrange(len(lines[a]) + 1)]
        case 4:
            lines[a] = lines[a] * rng.choice((2, 3, 1000))
        case _:
            lines.insert(a, rng.choice((b"# fps = nan", b"# fps = 1e9", b"# image_size = 1e400,2",
                                        b"# fps =", b"#", b"\0", b"fps = [", b"x = [1, 2")))  # fmt: skip
    return b"\n".join(lines)


def _nested(content: bytes, rng: Random) -> bytes:
    at, depth = rng.randrange(len(content) + 1), rng.choice((200, 3000, 50_000))
    opened = rng.choice((b"[", b"{", b"(", b"[{", b'{"a":', b"- "))
    return content[:at] + opened * depth + content[at:]


def _far(content: bytes, rng: Random) -> bytes:
    """First numbers of lines moved apart: a few rows that claim to span hours."""
    gap = rng.choice((10_000, 100_000, 2_000_000))
    lines = content.split(b"\n")
    for i, line in enumerate(lines):
        match = re.match(rb"\d+(?=[ ,;])", line)
        if match and len(match[0]) < 9:
            lines[i] = str(int(match[0]) * gap).encode() + line[match.end() :]
    return b"\n".join(lines)


_TEXT = (_numbers, _numbers, _numbers, _words, _lines, _nested, _far)


# --- JSON -----------------------------------------------------------------------------------------


def _json(content: bytes, rng: Random) -> bytes:
    return _damaged_tree(json.loads(content), rng).encode("utf-8", "surrogatepass")


def _damaged_tree(tree: Any, rng: Random) -> str:
    """The text of a tree in which a value or more were replaced, taken out, or put in twice."""
    for _ in range(rng.choice((1, 1, 2))):
        places = list(_places(tree))
        if not places:
            break
        shallow = [p for p in places if p[2] <= 2]
        where, key, _ = rng.choice(shallow if shallow and rng.random() < 0.5 else places)
        action = rng.random()
        if action < 0.15:
            del where[key]
        elif action < 0.25 and isinstance(where, list):
            where.append(copy.deepcopy(where[key]))
        elif action < 0.3 and isinstance(where, dict):
            where[rng.choice(("odd", "\x1b[31m", ""))] = _odd_value(rng)
        else:
            where[key] = _odd_value(rng)
    return re.sub(
        f'"{_RAW}((?:[^"\\\\]|\\\\.)*)"', lambda m: json.loads(f'"{m[1]}"'), json.dumps(tree)
    )


def _odd_value(rng: Random) -> Any:
    """A value of its own: damage to it later must reach neither other places nor other cases."""
    return copy.deepcopy(rng.choice(_ODD_VALUES))


def _places(tree: Any, depth: int = 0) -> Any:
    pairs = (
        tree.items()
        if isinstance(tree, dict)
        else enumerate(tree)
        if isinstance(tree, list)
        else ()
    )
    for key, value in list(pairs):
        yield tree, key, depth
        yield from _places(value, depth + 1)


# --- npz ------------------------------------------------------------------------------------------


def _npz(content: bytes, rng: Random) -> bytes:
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        arrays = dict(file)
    entries = {key: _npy(value) for key, value in arrays.items()}
    method = zipfile.ZIP_DEFLATED
    for _ in range(rng.choice((1, 1, 2, 3))):
        key = rng.choice(list(entries))
        match rng.randrange(12):
            case 0:
                del entries[key]
            case 1:
                entries[rng.choice(("odd", "x" * 300, "\x1b[31m", "../x"))] = entries[key]
            case 2:
                entries[key] = entries[rng.choice(list(entries))]
            case 3:
                entries[key] = _claiming(entries[key], rng)
            case 4:
                entries[key] = _bytes(entries[key], rng)
            case 5:
                method = rng.choice((zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2, zipfile.ZIP_STORED))
            case _:
                entries[key] = _npy(_odd_array(arrays.get(key, np.zeros(3)), rng), pickled=True)
        if not entries:
            break
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for key, data in entries.items():
            archive.writestr(f"{key}.npy", data)
    made = stream.getvalue()
    if rng.random() < 0.02:
        needed = rng.random() < 0.5
        made = _with_bomb(made, rng.choice(list(entries or {"x": 0})) if needed else "unneeded")
    if rng.random() < 0.1:  # the directory at the end
        start = made.rfind(b"PK\x01\x02")
        made = made[:start] + _bytes(made[start:], rng)
    return made


def _npy(array: np.ndarray, pickled: bool = False) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=pickled)
    return stream.getvalue()


_ODD_SHAPES = (
    "(80000000000,)", "(1000000, 100000)", "(0,)", "()", "(-1,)", "(3,)", "(1e3,)", "[3]",
    "(10000000000000000000000,)", "(2,)" * 3000, "(" * 200 + ")" * 200,
)  # fmt: skip
_ODD_TYPES = ("<f8", "<f4", "|O", "<U1000000000", "|V8", "<c16", "|b1", "<i8", "<M8[s]", "<U0")


def _claiming(data: bytes, rng: Random) -> bytes:
    """The same numbers under a header that claims another shape or type."""
    if len(data) < 10:  # cut off already
        return data
    shape = rng.choice(_ODD_SHAPES)
    kind = rng.choice(_ODD_TYPES)
    kind = kind if rng.random() < 0.5 else "<f8"
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    old = struct.unpack("<H", data[8:10])[0]
    return data[:8] + struct.pack("<H", len(text) + 1) + text + b"\n" + data[10 + old :]


def _odd_array(array: np.ndarray, rng: Random) -> np.ndarray:
    values = np.array(array)
    match rng.randrange(14):
        case 0 if values.dtype.kind == "f":
            return np.full_like(
                values, rng.choice((np.nan, np.inf, -np.inf, 0.0, -1.0, 1e160, 1e308))
            )
        case 1 | 2 | 3 if values.dtype.kind == "f" and values.size:
            at = rng.randrange(values.size)
            values.reshape(-1)[at] = rng.choice((np.nan, np.inf, -np.inf, -1e9, 1e300, 1e-300))
            return values
        case 1 | 2 if values.dtype.kind in "iu" and values.size:
            values.reshape(-1)[rng.randrange(values.size)] = rng.choice((-1, -7, 10**6, 2**62, 0))
            return values
        case 4:
            return values[:-1] if values.ndim else np.array([values, values])
        case 5:
            return values[None]
        case 6:
            return values.T
        case 7 if values.ndim:
            return values[..., :-1]
        case 8:
            return values.reshape(-1)[: rng.choice((0, 1, 2))]
        case 9:
            kind = rng.choice(("f2", "f4", "i8", "c16", "b1", "U9", "O", "M8[s]", "S3", "u1"))
            try:
                return values.astype(kind)
            except (TypeError, ValueError):
                return np.array("x")
        case 10:
            return np.array(rng.choice(("", "x\x1b[31m", "y" * 100_000, "a\nb", "camera", "\x00")))
        case 11:
            return np.array(rng.choice((np.nan, np.inf, -1.0, 0.0, 1e9, 1e400)))
        case 12 if values.dtype.kind == "U" and values.size:
            values.reshape(-1)[rng.randrange(values.size)] = rng.choice(
                ("", "x", "nose", "\x1b[2J")
            )
            return values
    return (
        np.zeros((0, *values.shape[1:]), values.dtype)
        if values.ndim
        else values + values.dtype.type(1)
    )


@functools.cache
def bomb() -> bytes:
    """A .npz with one entry: zeros that unpack to `_BOMB` bytes."""
    stream = io.BytesIO()
    with (
        zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("bomb.npy", "w", force_zip64=True) as entry,
    ):
        header = io.BytesIO()
        shape = {"descr": "<f8", "fortran_order": False, "shape": (_BOMB // 8,)}
        np.lib.format.write_array_header_1_0(header, shape)
        entry.write(header.getvalue())
        zeros = bytes(1 << 24)
        for _ in range(_BOMB >> 24):
            entry.write(zeros)
    return stream.getvalue()


def _with_bomb(archive: bytes, key: str) -> bytes:
    """The archive with the bomb under a key, in its place if it is there."""
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archive)) as whole, zipfile.ZipFile(stream, "w") as made:
        for name in whole.namelist():
            if name != f"{key}.npy":
                made.writestr(name, whole.read(name))
    with zipfile.ZipFile(io.BytesIO(bomb())) as source:
        info = source.getinfo("bomb.npy")
    return _append_raw(stream.getvalue(), info, key)


def _append_raw(archive: bytes, info: zipfile.ZipInfo, key: str) -> bytes:
    """Append an entry that is compressed already: its bytes as they are, the directory anew."""
    whole = bomb()
    start = (
        info.header_offset + 30 + sum(struct.unpack("<HH", whole[info.header_offset + 26 :][:4]))
    )
    packed = whole[start : start + info.compress_size]
    name = f"{key}.npy".encode()
    directory = archive.rfind(b"PK\x05\x06")
    size, offset = struct.unpack("<II", archive[directory + 12 : directory + 20])
    count = struct.unpack("<H", archive[directory + 10 : directory + 12])[0] + 1
    sizes = struct.pack("<III", info.CRC, info.compress_size, info.file_size)
    local = b"PK\x03\x04" + struct.pack("<HHHHH", 20, 0, 8, 0, 0) + sizes
    local += struct.pack("<HH", len(name), 0) + name + packed
    central = archive[offset : offset + size]
    central += b"PK\x01\x02" + struct.pack("<HHHHHH", 20, 20, 0, 8, 0, 0) + sizes
    central += struct.pack("<HHHHHII", len(name), 0, 0, 0, 0, 0, offset) + name
    end = struct.pack("<HHHHIIH", 0, 0, count, count, len(central), offset + len(local), 0)
    return archive[:offset] + local + central + b"PK\x05\x06" + end


# --- safetensors ----------------------------------------------------------------------------------


def _safetensors(content: bytes, rng: Random) -> bytes:
    length = struct.unpack("<Q", content[:8])[0]
    header, data = json.loads(content[8 : 8 + length]), bytearray(content[8 + length :])
    if rng.random() < 0.5:
        facts = json.loads(header["__metadata__"]["torchpose"])
        if rng.random() < 0.8:
            text = _damaged_tree(json.loads(facts["info"]), rng)
            facts["info"] = text
            made = json.dumps(facts)
        else:
            made = _damaged_tree(facts, rng)
        header["__metadata__"]["torchpose"] = made
    else:
        for _ in range(rng.choice((1, 1, 2))):
            _odd_tensor(header, data, rng)
    text = (
        json.dumps(header).encode() if rng.random() < 0.95 else _damaged_tree(header, rng).encode()
    )
    return struct.pack("<Q", len(text)) + text + bytes(data)


def _odd_tensor(header: dict[str, Any], data: bytearray, rng: Random) -> None:
    name = rng.choice([key for key in header if key != "__metadata__"])
    facts = header[name]
    start, end = facts["data_offsets"]
    width = {"F64": 8, "F32": 4, "I64": 8}.get(facts["dtype"], 1)
    kind = {"F64": "<d", "F32": "<f", "I64": "<q"}.get(facts["dtype"], "<B")
    match rng.randrange(6):
        case 0 | 1 | 2 if end > start:
            at = start + width * rng.randrange((end - start) // width)
            odd = (float("nan"), float("inf"), -1e30, 0.0, -1.0, 1e37)
            whole = (-1, 0, 2**62, -(2**62), 1000, 7)
            many = (end - start) // width if rng.random() < 0.3 else 1
            at = start if many > 1 else at
            value = struct.pack(kind, rng.choice(odd if width > 1 and kind != "<q" else whole[1:2]))
            if kind == "<q":
                value = struct.pack(kind, rng.choice(whole))
            data[at : at + width * many] = value * many
        case 3:
            facts["shape"] = facts["shape"][::-1]
        case 4:
            facts["shape"] = [*facts["shape"], 1]
        case 5:
            header[rng.choice(("odd", "noise.x", "noise.\x1b[31m", "left.means"))] = header.pop(
                name
            )
        case _:
            same = {"F64": "I64", "I64": "F64", "F32": "I32"}
            facts["dtype"] = same.get(facts["dtype"], "U8")


# --- one or the other -----------------------------------------------------------------------------

_STRUCTURED: dict[str, tuple[Callable[[bytes, Random], bytes], ...]] = {
    ".npz": (_npz, _npz, _npz, _bytes),
    ".json": (_json, _json, _text, _bytes),
    ".safetensors": (_safetensors, _safetensors, _safetensors, _bytes),
    ".c3d": (_bytes,),
    ".mp4": (_bytes,),
}


@np.errstate(all="ignore")
def damage_content(name: str, content: bytes, rng: Random) -> bytes:
    """Damaged bytes of a file of this name."""
    if rng.random() < 0.02:
        return _other(content, rng)
    kinds = _STRUCTURED.get(Path(name).suffix, (_text, _text, _text, _bytes))
    return rng.choice(kinds)(content, rng)


def place(folder: Path, name: str, content: bytes | dict[str, bytes], rng: Random) -> Path:
    """Write a damaged file or folder of files, or put something else into its place."""
    path = folder / name
    if rng.random() < 0.02:
        return _odd_path(path, rng)
    if isinstance(content, bytes):
        path.write_bytes(damage_content(name, content, rng))
        return path
    path.mkdir()
    files = dict(content)
    for _ in range(rng.choice((1, 1, 2))):
        own = rng.choice(list(files))
        match rng.randrange(8):
            case 0:
                _odd_path(path / own, rng, inside=True)
                files.pop(own, None)
            case 1:
                number = rng.choice(("2000000", "9" * 200, "99999999", "x", "0", "-5", "100000"))
                files[f"clip_{number}_keypoints.json"] = files.pop(own)
            case _:
                files[own] = damage_content("a.json", content.get(own, b"{}"), rng)
        if not files:
            break
    for own, data in files.items():
        if not os.path.lexists(path / own):
            (path / own).write_bytes(data)
    return path


def _odd_path(path: Path, rng: Random, inside: bool = False) -> Path:
    """Something else than a file under its name, or a name that no file can have."""
    kind = rng.choice(
        ("folder", "dangling", "loop", "pipe", *(("nul", "long", "none") * (not inside)))
    )
    if kind == "folder":
        path.mkdir()
    elif kind == "dangling":
        path.symlink_to(path.parent / "nothing")
    elif kind == "loop":
        path.symlink_to(path)
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "nul":
        return path.with_name(f"a\0b{path.suffix}")
    elif kind == "long":
        return path.with_name("n" * rng.choice((300, 5000)) + path.suffix)
    return path
