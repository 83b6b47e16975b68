"""What processes tell each other; with a single process, nothing."""

from collections.abc import Sequence
from typing import Any, TypeVar

import torch
from torch import nn

from torchpose.errors import InputError

__all__ = ["broadcast_state", "first_failure", "from_all"]

T = TypeVar("T")


def _several() -> bool:
    distributed = torch.distributed
    return (
        distributed.is_available()
        and distributed.is_initialized()
        and distributed.get_world_size() > 1
    )


def from_all(value: T) -> list[T]:
    """The value of every process, in each of them."""
    if not _several():
        return [value]
    found: list[Any] = [None] * torch.distributed.get_world_size()
    torch.distributed.all_gather_object(found, value)
    return found


def first_failure(answers: Sequence[tuple[T, str]]) -> list[T]:
    """What every process found, unless one of them failed: then all of them fail.

    Raises:
        InputError: with what the first process that failed had to say.
    """
    for _, failure in answers:
        if failure:
            raise InputError(failure)
    return [found for found, _ in answers]


def broadcast_state(module: nn.Module, source: int) -> None:
    """Give every process the buffers of one of them."""
    if _several():
        for buffer in module.buffers():
            if buffer.numel():
                torch.distributed.broadcast(buffer, source)
