"""Choose between two values of the same kind, row by row."""

from __future__ import annotations

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
