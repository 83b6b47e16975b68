"""Apply functions to all tensors of tuples, and of tuples in them."""

from collections.abc import Callable
from typing import Any

from torch import Tensor


def mapped(fn: Callable[..., Any], first: Any, *others: Any) -> Any:
    """Return a tuple of what a function makes of each entry, and of the same entry of the others.

    Args:
        fn: of as many entries as there are tuples. first: a tuple, or an entry by itself.
        others: tuples of the same kind.
    """
    if not isinstance(first, tuple):
        return fn(first, *others)
    values = (mapped(fn, *parts) for parts in zip(first, *others, strict=True))
    return type(first)(*values) if hasattr(first, "_fields") else tuple(values)


def taken(value: Any, index: Tensor) -> Any:
    """Return some elements of the batch, of a tensor or of named tuples of tensors."""
    return mapped(lambda tensor: tensor[index], value)
