"""Decide whether values may be looked at: not while a function is exported, compiled or vectorised.

Value checks raise errors that name the faulty element. Some computations are skipped where the values
show that they would change nothing. Both read numbers, which do not exist while a function is traced.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import torch
from torch import Tensor

from torchpose.errors import InputError

_HIDDEN: ContextVar[bool] = ContextVar("torchpose_values_hidden", default=False)


@contextmanager
def without_value_checks() -> Iterator[None]:
    """Switch off checks of values, and branches on them, for `torch.func.vmap` and the like.

    A step of a filter inside it depends on the shapes of its arguments alone and returns the same
    numbers, for which it computes more: every element of a batch has covariances of its own. Shapes
    are still checked. What is NaN, infinite or not a covariance raises nothing and comes out as NaN.

    `torch.compile` and `torch.export` see the step so without it.

    Returns:
        Context manager; checks are off inside its ``with`` block, in this thread.

    Example:
        >>> import torch, torchpose
        >>> from torchpose._core.checks import check_finite
        >>> with torchpose.without_value_checks():
        ...     check_finite("z", torch.tensor(float("nan")))
    """
    if torch.compiler.is_compiling():
        yield
        return
    token = _HIDDEN.set(True)
    try:
        yield
    finally:
        _HIDDEN.reset(token)


def values_visible() -> bool:
    """Return whether code may depend on values: not while traced, nor in `without_value_checks`."""
    return not (torch.compiler.is_compiling() or _HIDDEN.get())


def look_at(value: Tensor) -> Any:
    """Return the number or truth value that a tensor of one element holds.

    Raises:
        InputError: it has none to look at, inside `torch.func.vmap` or on the device "meta".
    """
    try:
        return value.item()
    except RuntimeError as error:
        if _has_memory(value):
            raise
        raise InputError(
            "expected values that can be looked at, got tensors inside torch.func.vmap, where filters need "
            "torchpose.without_value_checks() and trackers take the whole batch, or on the device meta, "
            "which holds none"
        ) from error


def _has_memory(tensor: Tensor) -> bool:
    try:
        return tensor.data_ptr() != 0
    except RuntimeError:  # of a transform
        return False


def seen_finite(values: Tensor) -> bool:
    """Return whether values may be looked at and all are finite; False too where their sum overflows.

    Their sum takes a fraction of the time of a look at each of them.
    """
    return values_visible() and math.isfinite(look_at(values.detach().sum()))
