"""Which part of the work on many blocks is this process', and how the parts are summed up."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["ALONE", "Share"]


def _alone(values: Tensor) -> Tensor:
    return values


def _sum_over_processes(values: Tensor) -> Tensor:
    total = values.clone()
    torch.distributed.all_reduce(total)
    return total


class Share(NamedTuple):
    """Which part of the work this process does.

    Attributes:
        rank, size: number of this process, and how many there are.
        total: the sum of a tensor over all processes, which each of them has to call.
    """

    rank: int = 0
    size: int = 1
    total: Callable[[Tensor], Tensor] = _alone

    @classmethod
    def of_processes(cls) -> Share:
        """This process' share in the group of `torch.distributed`; all of it without a group."""
        if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
            return cls()
        rank, size = torch.distributed.get_rank(), torch.distributed.get_world_size()
        return cls(rank, size, _sum_over_processes)

    def blocks(self, n_blocks: int) -> range:
        """The blocks of this process: every block belongs to exactly one, none is padded."""
        return range(self.rank, n_blocks, self.size)

    @contextlib.contextmanager
    def failing_together(self, like: Tensor) -> Iterator[None]:
        """Work before a `total` of the shape of `like`, which the others get as NaN if it fails."""
        try:
            yield
        except Exception:
            if self.size > 1:  # or the others would wait for this process for ever
                self.total(torch.full_like(like, torch.nan))
            raise


ALONE = Share()
"""All of the work, for a process without others."""
