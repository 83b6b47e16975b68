"""Apply functions to all tensors of tuples, and of tuples in them; collect those of frames.

None, where something is missing, stays None.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchpose._core.rows import joined

PART = 256
"""Frames of a long recording that are worked on at once; what that needs for all would fill the memory."""


def mapped(fn: Callable[..., Any], first: Any, *others: Any) -> Any:
    """Return a tuple of what a function makes of each entry, and of the same entry of the others.

    Args:
        fn: of as many entries as there are tuples. first: a tuple, or an entry by itself.
        others: tuples of the same kind.
    """
    if first is None:
        return None
    if not isinstance(first, tuple):
        return fn(first, *others)
    values = (mapped(fn, *parts) for parts in zip(first, *others, strict=True))
    return type(first)(*values) if hasattr(first, "_fields") else tuple(values)


def taken(value: Any, index: Tensor | int) -> Any:
    """Return some elements of the batch, or one of them, of a tensor or of named tuples of tensors."""
    if isinstance(index, int):
        return mapped(lambda tensor: tensor[index], value)
    return mapped(lambda tensor: tensor.index_select(0, index), value)


def one_of(value: Any, row: int) -> Any:
    """Return one element of the batch as a batch of one, of a tensor or of named tuples of tensors."""
    return mapped(lambda tensor: tensor.narrow(0, row, 1), value)


def frame_at(value: Any, time: int) -> Any:
    """Return one frame [B, ...] of a tensor [B, T, ...], or of named tuples of tensors."""
    return mapped(lambda tensor: tensor[:, time], value)


def replaced(value: Any, index: Tensor, other: Any) -> Any:
    """Return the batch with some elements replaced, of a tensor or of named tuples of tensors.

    Args:
        value: the batch. index: of the elements [N]. other: what takes their places, [N, ...].
    """
    return mapped(lambda own, new: own.index_copy(0, index, new), value, other)


def stacked(frames: Sequence[Any]) -> Any:
    """Return named tuples of tensors [B, ...] as one of tensors [B, T, ...]."""
    return mapped(lambda *values: torch.stack(values, 1), *frames)


def part_of(value: Any, rows: slice, dim: int = 1) -> Any:
    """Return the frames from the start of a slice to its stop, of tensors or of named tuples of tensors."""
    return mapped(lambda tensor: tensor.narrow(dim, rows.start, rows.stop - rows.start), value)


def write_part(value: Any, rows: slice, part: Any) -> None:
    """Write over some frames of tensors [B, T, ...], or of tuples of them."""
    mapped(lambda every, some: every[:, rows].copy_(some), value, part)


def by_parts(fn: Callable[..., Any], *sequences: Any, dim: int = 1) -> Any:
    """Return what a function makes of sequences, computed for some frames at a time.

    Args:
        fn: of as many tensors, or tuples of them, as there are sequences; it returns one of the same frames.
        sequences: tensors, or tuples of them. dim: of the frames, in all tensors.
    """
    end = _n_frames(sequences, dim)
    parts = [slice(begin, min(begin + PART, end)) for begin in range(0, end, PART)]
    found = [fn(*part_of(sequences, rows, dim)) for rows in parts]
    return found[0] if len(found) == 1 else joined(found, dim)


def _n_frames(value: Any, dim: int) -> int:
    return _n_frames(value[0], dim) if isinstance(value, tuple) else value.shape[dim]


class FrameCollector:
    """Collects the named tuples of T frames, tensors [B, ...], as one of tensors [B, T, ...] held once.

    Args:
        n_frames: T.

    Attributes:
        sequence: what was collected; it has all frames after the last one was added.
    """

    def __init__(self, n_frames: int) -> None:
        self.sequence: Any = None
        self._n_frames, self._count = n_frames, 0
        self._some: list[Any] = []

    def add(self, frame: Any) -> None:
        """Add the next frame."""
        self._some.append(frame)
        done = self._count + len(self._some)
        if len(self._some) < PART and done < self._n_frames:
            return
        part, rows = stacked(self._some), slice(self._count, done)
        if self.sequence is None:
            self.sequence = mapped(self._for_all, part)
        write_part(self.sequence, rows, part)
        self._some, self._count = [], done

    def _for_all(self, part: Tensor) -> Tensor:
        return part.new_empty(len(part), self._n_frames, *part.shape[2:])
