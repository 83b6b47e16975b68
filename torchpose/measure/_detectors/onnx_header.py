"""Read the inputs of an ONNX model out of its file, for runtimes that do not tell them.

An ONNX file is one message of Protocol Buffers: fields of a number, a kind (0: a variable-length number,
1: eight bytes, 2: bytes with their length, 5: four bytes) and a value.
"""

from collections.abc import Iterator
from typing import NamedTuple

from torchpose.errors import FileFormatError

_GRAPH, _INITIALIZER, _INPUT = 7, 5, 11  # of ModelProto and GraphProto
_NAME, _TYPE, _TENSOR_NAME = 1, 2, 8  # of ValueInfoProto and TensorProto
_ELEMENTS = {1: "float32", 2: "uint8", 3: "int8", 6: "int32", 7: "int64", 10: "float16"}


class TensorInfo(NamedTuple):
    """Holds name, shape (None where it is not fixed) and type of the elements of a model's input."""

    name: str
    shape: tuple[int | None, ...]
    dtype: str


def read_inputs(data: bytes, model: str) -> list[TensorInfo]:
    """Return the inputs of a model, without its weights.

    Args:
        data: of the file. model: its name in messages.

    Raises:
        FileFormatError: no ONNX model.
    """
    try:
        graph = next(value for field, value in _fields(data) if field == _GRAPH)
        inputs, weights = [], set()
        for field, value in _fields(_bytes(graph)):
            if field == _INPUT:
                inputs.append(_input(_bytes(value)))
            elif field == _INITIALIZER:
                names = (v for f, v in _fields(_bytes(value)) if f == _TENSOR_NAME)
                weights.add(_text(next(names, b"")))
    except (StopIteration, LookupError, TypeError, ValueError) as error:
        raise FileFormatError(f"{model}: expected an ONNX model, got another file") from error
    return [one for one in inputs if one.name not in weights]


def _input(data: memoryview) -> TensorInfo:
    parts = dict(_fields(data))
    tensor = dict(_fields(_bytes(dict(_fields(_bytes(parts[_TYPE])))[1]))) if _TYPE in parts else {}
    shape: list[int | None] = []
    for field, value in _fields(_bytes(tensor.get(2, b""))):
        if field == 1:
            size = dict(_fields(_bytes(value))).get(1)
            shape.append(size if isinstance(size, int) and size > 0 else None)
    kind = _ELEMENTS.get(int(tensor.get(1, 0)), "unknown")
    return TensorInfo(_text(parts.get(_NAME, b"")), tuple(shape), kind)


def _fields(data: bytes | memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Yield number and value of the fields of a message."""
    view, at = memoryview(data), 0
    while at < len(view):
        key, at = _number(view, at)
        kind = key & 7
        if kind == 0:
            value, at = _number(view, at)
            yield key >> 3, value
            continue
        length = {1: 8, 5: 4}.get(kind, -1)
        if kind == 2:
            length, at = _number(view, at)
        if length < 0 or at + length > len(view):
            raise ValueError("not a message")
        yield key >> 3, view[at : at + length]
        at += length


def _number(view: memoryview, at: int) -> tuple[int, int]:
    """Return a variable-length number and the place behind it."""
    value = shift = 0
    while True:
        byte = view[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at
        if shift > 63:
            raise ValueError("not a number")


def _bytes(value: int | bytes | memoryview) -> memoryview:
    if isinstance(value, int):
        raise ValueError("expected a message, got a number")
    return memoryview(value)


def _text(value: int | bytes | memoryview) -> str:
    return bytes(_bytes(value)).decode("utf-8", "replace")
