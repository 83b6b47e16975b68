"""Choose between values of the same kind, row by row, and join their rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar, cast

import torch
from jaxtyping import Bool
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


def joined(parts: Sequence[T], dim: int = 0) -> T:
    """Return tensors, or tuples of tensors or of further tuples, one after the other."""
    every: list[Any] = list(parts)
    if isinstance(every[0], Tensor):
        return cast(T, torch.cat(every, dim))
    rows = [joined(values, dim) for values in zip(*every, strict=True)]
    return cast(T, type(every[0])(*rows) if hasattr(every[0], "_fields") else tuple(rows))
