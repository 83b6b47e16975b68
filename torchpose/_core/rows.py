"""Choose between values of the same kind, row by row or the last ones known, and join their rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

T = TypeVar("T")


def where_rows(rows: Bool[Tensor, "*rows"], new: T, old: T) -> T:
    """Return the chosen rows of `new`, and the others of `old`.

    Args:
        rows: which leading elements are chosen. new, old: tensors [*rows, ...], or named tuples of such
            tensors, or of further named tuples.
    """

    def pick(ours: Any, others: Any) -> Any:
        if isinstance(ours, Tensor):
            chosen = rows.view(*rows.shape, *[1] * (ours.ndim - rows.ndim))
            return torch.where(chosen, ours, others)
        return type(ours)(*(pick(*pair) for pair in zip(ours, others, strict=True)))

    return cast(T, pick(new, old))


def last_known(known: Bool[Tensor, "B T *rest"]) -> Int[Tensor, "B T *rest"]:
    """Return the last frame up to each one in which something was known, counted from 1; 0 before any."""
    frames = torch.arange(1, known.shape[1] + 1, device=known.device)
    return frames.view(-1, *[1] * (known.ndim - 2)).where(known, 0).cummax(1).values


def in_frames(last: Int[Tensor, "B T *rest"], before: Tensor, values: Tensor) -> Tensor:
    """Return values [B, T, ...] of the frames that `last_known` tells.

    Args:
        last: numbers of frames. before: [B, ...], of frame 0. values: of the frames from 1 on.
    """
    rows = last.view(*last.shape, *[1] * (values.ndim - last.ndim)).expand_as(values)
    return torch.cat([before[:, None], values], 1).gather(1, rows)


def discounted_sums(
    before: Float[Tensor, "B K"],
    values: Float[Tensor, "B T K"],
    keep: float | Float[Tensor, "B T 1"],
) -> Float[Tensor, "B T K"]:
    """Return s_t = a s_(t-1) + x_t of every frame.

    Args:
        before: s before the first frame. values: x. keep: a, of every frame or the same for all.
    """
    n_frames = values.shape[1]
    factors: Sequence[float | Tensor] = (
        keep.unbind(1) if isinstance(keep, Tensor) else n_frames * (keep,)
    )
    sums = []
    for kept, now in zip(factors, values.unbind(1), strict=True):
        before = kept * before + now
        sums.append(before)
    return torch.stack(sums, 1)


def joined(parts: Sequence[T], dim: int = 0) -> T:
    """Return tensors, or tuples of tensors or of further tuples, one after the other."""
    every: list[Any] = list(parts)
    if isinstance(every[0], Tensor):
        return cast(T, torch.cat(every, dim))
    rows = [joined(values, dim) for values in zip(*every, strict=True)]
    return cast(T, type(every[0])(*rows) if hasattr(every[0], "_fields") else tuple(rows))
