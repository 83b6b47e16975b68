"""Run what a compiler of graphs cannot trace as it is, within a model that is compiled."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

import torch

F = TypeVar("F", bound=Callable[..., Any])


def uncompiled(method: F) -> F:
    """Run a method outside of the graphs of `torch.compile`, with all that it calls.

    What depends on the values of its tensors has no graph. Without this every function below it is compiled
    by itself, for minutes, until one of them fails. With `fullgraph=True` PyTorch's error says that there is
    a break; `torch.export` is not concerned, whose refusal is `refuse_export`.
    """

    @functools.wraps(method)
    def run(self: Any, *args: Any, **kwargs: Any) -> Any:
        if torch.compiler.is_dynamo_compiling() and not is_exporting():
            return torch.compiler.disable(method)(self, *args, **kwargs)
        return method(self, *args, **kwargs)

    return cast(F, run)


def is_exporting() -> bool:
    """Return whether `torch.export` traces."""
    exporting = getattr(torch.compiler, "is_exporting", None)  # not in all releases
    return exporting is not None and bool(exporting())
