"""Run a fit in several processes: exchange values, and choose the strategy that starts the processes."""

from collections.abc import Callable, Mapping, Sequence
from datetime import timedelta
from typing import Any, TypeVar, cast

import torch
from lightning.pytorch.strategies import DDPStrategy, StrategyRegistry
from torch import nn

from torchpose.errors import InputError, TorchposeError
from train.checkpoints import differences

__all__ = [
    "Processes",
    "broadcast_state",
    "check_processes",
    "first_failure",
    "from_all",
    "register_strategy",
    "results_of_all",
]

T = TypeVar("T")


def _several() -> bool:
    distributed = torch.distributed
    return (
        distributed.is_available()
        and distributed.is_initialized()
        and distributed.get_world_size() > 1
    )


def from_all(value: T) -> list[T]:
    """Return the value of every process, in each of them."""
    if not _several():
        return [value]
    found: list[Any] = [None] * torch.distributed.get_world_size()
    torch.distributed.all_gather_object(found, value)
    return found


def first_failure(answers: Sequence[tuple[T, str]]) -> list[T]:
    """Return what every process found, or fail in all of them if one has failed.

    Raises:
        InputError: with what the first process that failed had to say.
    """
    for _, failure in answers:
        if failure:
            raise InputError(failure)
    return [found for found, _ in answers]


def results_of_all(work: Callable[[], T]) -> list[T]:
    """Do each process' share of the work, and return the results of all processes in each of them.

    Raises:
        InputError: with the message of the first process whose work raised a `TorchposeError`.
    """
    found: T | None = None
    failure = ""
    try:
        found = work()
    except TorchposeError as error:
        failure = str(error)
    return cast(list[T], first_failure(from_all((found, failure))))


def broadcast_state(module: nn.Module, source: int) -> None:
    """Give every process the buffers of one of them."""
    if _several():
        for buffer in module.buffers():
            if buffer.numel():
                torch.distributed.broadcast(buffer, source)


def check_processes(identity: Mapping[str, Any], rank: int) -> None:
    """Raise unless every process is to do the same fit.

    Args:
        identity: of the fit in this process. rank: of this process.

    Raises:
        InputError: another process has other settings or recordings; every difference is named.
    """
    for other, theirs in enumerate(from_all(identity)):
        found = differences(theirs, identity)
        if found:
            raise InputError(
                f"process {other} differs from process {rank}: {'; '.join(found)}; give all of them "
                "the same recordings and settings"
            )


class Processes(DDPStrategy):
    """Lightning's DDP, which also takes modules that have nothing to learn by gradients.

    `DistributedDataParallel` refuses a module without trainable parameters, and would send all
    buffers around in every step. Such a module is left unwrapped and does its own exchange with
    `reduce`; any other one is wrapped as usual.
    """

    def configure_ddp(self) -> None:
        """Wrap the module, if there are gradients to average."""
        module = self.lightning_module
        if module is not None and any(p.requires_grad for p in module.parameters()):
            super().configure_ddp()


def register_strategy() -> None:
    """Use `Processes` wherever Lightning would use DDP: by name, or for several devices."""
    StrategyRegistry.register(
        "ddp",
        Processes,
        description="DDP; modules without trainable parameters are not wrapped",
        override=True,
        start_method="popen",
        # others wait while one still holds out its persons; one that is dead is noticed at once
        timeout=timedelta(hours=3),
    )
