"""Take arguments and methods as they were one release ago, with a `DeprecationWarning`."""

import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar, cast

import torch

from torchpose._core.moved import ARGUMENTS, warn_of_former

_Function = TypeVar("_Function", bound=Callable[..., Any])


def takes_former_arguments(function: _Function) -> _Function:
    """Decorate a function of `torchpose._core.moved.ARGUMENTS`, to be called by its former signature too.

    What is given by position beyond its present positional arguments, or by an old name, goes to the
    keyword that stands for it now. Standard deviations become variances where `_std` became `_cov`.

    Raises:
        TypeError: as Python does for arguments that the former signature did not take either, or an
            argument by its present and its former name.
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
            warn_of_former(
                f"{function.__qualname__} takes {', '.join(names)} by name now; positions go"
            )
        options |= zip(names, beyond, strict=True)
        for old in renamed.keys() & options.keys():
            new, value = renamed[old], options.pop(old)
            if new in options:
                raise TypeError(f"{function.__qualname__} got {new} and, by its former name, {old}")
            if old not in names:
                warn_of_former(f"{old} of {function.__qualname__} is {new} now; the old name goes")
            squared = old.endswith("_std") and new.endswith("_cov")
            options[new] = variances(value) if squared and value is not None else value
        return function(*args, **options)

    return cast(_Function, call)


def rename_former_hook(cls: type, old: str, new: str) -> None:
    """Rename what a subclass implements by a former name, which has another meaning now, and warn.

    Args:
        cls: of a program. old, new: names of the method.
    """
    if old in vars(cls) and new not in vars(cls):
        warn_of_former(f"{cls.__name__}.{old} is to be called {new}; the old name goes")
        setattr(cls, new, vars(cls)[old])
        delattr(cls, old)


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
