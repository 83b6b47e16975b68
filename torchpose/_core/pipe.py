"""Send values that hold tensors to another process, and receive them."""

import io
import mmap
import os
import pickle
import struct
import tempfile
from typing import IO, Any

import numpy as np
import torch
from torch import Tensor

_HEADER = struct.Struct("<QQq")  # bytes of the pickle, of the arrays, and where these are in memory
_IN_PIPE = -1  # the place of arrays that are in no shared memory
_STEP = 64  # arrays begin at multiples of this many bytes
_SHARES = 16  # what is larger than one of so many parts of the memory goes through the pipe
WAITING = _SHARES - 2  # values that may be sent before they are received


def shared_memory(size: int) -> int:
    """Return the descriptor of memory that processes share, which ends with the last of them.

    Raises:
        OSError: there is not so much.
    """
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("torchpose")
        os.ftruncate(descriptor, size)
        return descriptor
    with tempfile.TemporaryFile() as file:
        file.write(bytes(size))
        file.flush()
        return os.dup(file.fileno())


class PipeWriter:
    """Sends values to a `PipeReader`. What a value has in common with the one before is not sent again.

    Tensors keep the order of their elements in memory, on which the last digits of sums depend. They must not
    be written to once they were sent.

    Args:
        file: a pipe, open for writing.
        memory: the descriptor of `shared_memory`, through which arrays go quicker; no more than `WAITING`
            values may be sent before they are received.
    """

    def __init__(self, file: IO[bytes], memory: int) -> None:
        self._file, self._ring = file, _Ring(memory)
        self._before: dict[int, tuple[Tensor | np.ndarray, int]] = {}

    def write(self, value: Any) -> None:
        """Send a value; arrays and tensors may be inside of anything that can be pickled.

        Raises:
            OSError: nobody reads any more. Whatever `pickle` raises for what cannot be pickled.
        """
        message = _Message(self._before)
        head = message.pickled(value)
        self._before = message.sent
        start = self._ring.place(message.size)
        if start != _IN_PIPE:
            self._ring.fill(start, message.parts)
        self._file.write(_HEADER.pack(len(head), message.size, start))
        self._file.write(head)
        if start == _IN_PIPE:
            block = np.empty(message.size, np.uint8)
            _fill(block, message.parts)
            self._file.write(block.data)
        self._file.flush()


class PipeReader:
    """Receives the values of a `PipeWriter`.

    Args:
        file: the pipe, open for reading. memory: see `PipeWriter`.
    """

    def __init__(self, file: IO[bytes], memory: int) -> None:
        self._file, self._ring = file, _Ring(memory)
        self._before: dict[int, Any] = {}

    def read(self) -> Any:
        """Return the next value.

        Raises:
            EOFError: there is none.
        """
        length, size, start = _HEADER.unpack(self._exactly(_HEADER.size).data)
        head = self._exactly(length)
        block = self._exactly(size) if start == _IN_PIPE else self._ring.copy(start, size)
        found: dict[int, Any] = {}

        def array_at(place: tuple[Any, ...]) -> Any:
            number, *where = place
            if number not in found:
                found[number] = self._before[where[0]] if len(where) == 1 else _array(block, *where)
            return found[number]

        unpickler = pickle.Unpickler(io.BytesIO(head.data))
        unpickler.persistent_load = array_at  # type: ignore[method-assign]
        value = unpickler.load()
        self._before = found
        return value

    def _exactly(self, size: int) -> np.ndarray:
        """Return so many bytes of the pipe."""
        block = np.empty(size, np.uint8)
        if self._file.readinto(block.data) < size:  # type: ignore[attr-defined]
            raise EOFError("the pipe has ended")
        return block


class _Ring:
    """Holds shared memory, of which every value takes the next part."""

    def __init__(self, memory: int) -> None:
        self._bytes = np.frombuffer(mmap.mmap(memory, 0), np.uint8)
        self._end = 0

    def place(self, size: int) -> int:
        """Return the place of the next so many bytes, or that they are too many."""
        if size > len(self._bytes) // _SHARES:
            return _IN_PIPE
        start = self._end if self._end + size <= len(self._bytes) else 0
        self._end = start + size
        return start

    def fill(self, start: int, parts: list[tuple[np.ndarray, int]]) -> None:
        """Write bytes to their places after `start`."""
        _fill(self._bytes[start:], parts)

    def copy(self, start: int, size: int) -> np.ndarray:
        """Return bytes that stay."""
        return self._bytes[start : start + size].copy()


def _fill(block: np.ndarray, parts: list[tuple[np.ndarray, int]]) -> None:
    for part, at in parts:
        block[at : at + part.size] = part


class _Message:
    """Collects the arrays of a value while it is pickled.

    Attributes:
        sent: arrays and tensors of the value with their numbers, by identity.
        parts: bytes, and the places where they are to be. size: of all.
    """

    def __init__(self, before: dict[int, tuple[Tensor | np.ndarray, int]]) -> None:
        self._before = before
        self.sent: dict[int, tuple[Tensor | np.ndarray, int]] = {}
        self.parts: list[tuple[np.ndarray, int]] = []
        self.size = 0

    def pickled(self, value: Any) -> memoryview:
        """Return the value without its arrays."""
        file = io.BytesIO()
        pickler = pickle.Pickler(file, 5)
        pickler.persistent_id = self._place  # type: ignore[method-assign]
        pickler.dump(value)
        return file.getbuffer()

    def _place(self, part: Any) -> tuple[Any, ...] | None:
        """Return what stands for an array or tensor in the pickle; None for anything else."""
        if type(part) is not Tensor and type(part) is not np.ndarray:
            return None
        if id(part) in self.sent:
            return (self.sent[id(part)][1],)
        number = len(self.sent)
        self.sent[id(part)] = part, number
        if id(part) in self._before:
            return number, self._before[id(part)][1]
        array = part if isinstance(part, np.ndarray) else part.detach().numpy()
        back: list[int] | None = None
        if not array.flags.c_contiguous:
            order = sorted(range(array.ndim), key=array.strides.__getitem__, reverse=True)
            array = array.transpose(order)
            back = sorted(range(array.ndim), key=order.__getitem__)
        start, end = self.size, self.size + array.nbytes
        self.parts.append((np.ascontiguousarray(array).reshape(-1).view(np.uint8), start))
        self.size = -(-end // _STEP) * _STEP
        return number, isinstance(part, Tensor), array.dtype, array.shape, back, start, end


def _array(
    block: np.ndarray,
    tensor: bool,
    dtype: np.dtype,
    shape: tuple[int, ...],
    back: list[int] | None,
    start: int,
    end: int,
) -> Tensor | np.ndarray:
    """Return the array or tensor between two bytes of the block, whose dimensions go back to their order."""
    array = block[start:end].view(dtype).reshape(shape)
    if back is not None:
        array = array.transpose(back)
    return torch.from_numpy(array) if tensor else array
