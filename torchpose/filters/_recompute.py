"""Call functions again for their gradients, so that little is kept for these."""

import threading
import weakref
from collections.abc import Callable, Iterator
from typing import TypeVar

import torch
from torch import Tensor
from torch.autograd.graph import saved_tensors_hooks

RECOMPUTED_FRAMES = 16
"""Frames at a time that filters compute anew for gradients."""

_Result = TypeVar("_Result")
# What was computed anew last, in each thread. Outputs that the gradient does not ask for leave some of
# it over, which is dropped when the next function is called again: backward takes one after the other.
_latest = threading.local()


def wants_gradient(*tensors: Tensor) -> bool:
    """Return whether a gradient is to run through any of the tensors."""
    return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)


def recomputed(function: Callable[..., _Result], *arguments: object) -> _Result:
    """Call a function, and call it again for its gradient instead of keeping what that needs.

    As `torch.utils.checkpoint` without its import of the compiler, which takes a second. Under the
    transforms of `torch.func`, which take no hooks on saved tensors, and in what is compiled, which
    decides for itself what to keep, the function is simply called.

    Args:
        function: without random numbers or side effects. arguments: tensors and others.
    """
    if torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active():
        return function(*arguments)
    slots: list[weakref.ref[_Slot]] = []
    values: weakref.WeakKeyDictionary[_Slot, Tensor] = weakref.WeakKeyDictionary()

    def reserve(value: Tensor) -> _Slot:
        slot = _Slot(value.shape)
        slots.append(weakref.ref(slot))
        return slot

    def fetch(slot: _Slot) -> Tensor:
        if slot not in values:
            getattr(_latest, "values", values).clear()
            _latest.values = values
            waiting = iter(slots)
            with torch.enable_grad(), saved_tensors_hooks(lambda x: keep(waiting, x), _refuse):
                function(*arguments)
        return values.pop(slot)

    def keep(waiting: Iterator[weakref.ref[_Slot]], value: Tensor) -> None:
        slot = next(waiting)()
        if slot is None:
            return
        if slot.shape != value.shape:
            raise RuntimeError("a recomputed function did something else the second time")
        values[slot] = value.detach()

    with saved_tensors_hooks(reserve, fetch):
        return function(*arguments)


class _Slot:
    """Holds the place of a tensor that a gradient needs; it lives as long as the graph of that gradient."""

    def __init__(self, shape: torch.Size) -> None:
        self.shape = shape


def _refuse(_: None) -> Tensor:
    raise RuntimeError("a recomputed function has to be free of gradients of its own")
