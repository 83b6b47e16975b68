"""Apply functions to all tensors of named tuples, and of named tuples in them."""

from collections.abc import Callable
from typing import Any

from torch import Tensor

__all__ = ["mapped", "taken"]


def mapped(fn: Callable[..., Any], first: Any, *others: Any) -> Any:
    """Return a named tuple of what a function makes of each entry, and of the same entry of the others.

    Args:
        fn: of as many entries as there are tuples. first: a named tuple, or an entry by itself.
        others: named tuples of the same kind.
    """
    if not isinstance(first, tuple):
        return fn(first, *others)
    return type(first)(*(mapped(fn, *parts) for parts in zip(first, *others, strict=True)))


def taken(value: Any, index: Tensor) -> Any:
    """Return some elements of the batch, of a tensor or of named tuples of tensors."""
    return mapped(lambda tensor: tensor[index], value)
