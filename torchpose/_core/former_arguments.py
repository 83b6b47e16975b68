"""Take the arguments of methods as they were given one release ago, with a `DeprecationWarning`."""

import functools
import inspect
import sys
import warnings
from collections.abc import Callable
from typing import Any, TypeVar, cast

import torch

from torchpose._core.moved import ARGUMENTS

__all__ = ["takes_former_arguments", "variances"]

_WITHIN = ("torch.", "torchpose.")  # modules between a program and a warning
_Function = TypeVar("_Function", bound=Callable[..., Any])


def takes_former_arguments(function: _Function) -> _Function:
    """Decorate a function of `torchpose._core.moved.ARGUMENTS`, to be called by its former signature too.

    What is given by position beyond its present positional arguments, or by an old name, goes to the
    keyword that stands for it now. Standard deviations become variances where `_std` became `_cov`.

    Raises:
        TypeError: as Python does for arguments that the former signature did not take either.
    """
    positions, renamed = _former(function.__qualname__)
    parameters = inspect.signature(function).parameters.values()
    n_positional = sum(p.kind is p.POSITIONAL_OR_KEYWORD for p in parameters)

    @functools.wraps(function)
    def call(*args: Any, **options: Any) -> Any:
        former = [old for old in renamed if old in options]
        if len(args) <= n_positional and not former:  # in words that torch.compile can trace
            return function(*args, **options)
        args, beyond = args[:n_positional], args[n_positional:]
        names = positions[: len(beyond)]
        if len(beyond) > len(positions) or not options.keys().isdisjoint(names):
            return function(*args, *beyond, **options)  # raises what Python says of it
        if names:
            _warn(f"{function.__qualname__} takes {', '.join(names)} by name now, not by position")
        options |= zip(names, beyond, strict=True)
        for old in renamed.keys() & options.keys():
            new, value = renamed[old], options.pop(old)
            if old not in names:
                _warn(f"{old} of {function.__qualname__} is {new} now")
            squared = old.endswith("_std") and new.endswith("_cov")
            options[new] = variances(value) if squared and value is not None else value
        return function(*args, **options)

    return cast(_Function, call)


def variances(std: Any) -> torch.Tensor:
    """Return the squares of standard deviations, a tensor or a number."""
    return torch.as_tensor(std).square()


def _former(qualified: str) -> tuple[tuple[str, ...], dict[str, str]]:
    """Return former positional arguments in order, and the present names of those that were renamed."""
    positions, renamed = [], {}
    for entry in ARGUMENTS[qualified].split():
        word, _, new = entry.partition("=")
        name = word.removeprefix("+")
        if not word.startswith("+"):
            positions.append(name)
        if new:
            renamed[name] = new
    return tuple(positions), renamed


def _warn(said: str) -> None:
    """Warn where the program calls: a module's `forward` is called by PyTorch."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith(_WITHIN):
        level, frame = level + 1, frame.f_back
    warnings.warn(
        f"{said}; the former way goes with version 0.3.0", DeprecationWarning, stacklevel=level
    )
