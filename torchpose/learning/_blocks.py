"""Share blocks of samples among processes, check their values, and join them for large products."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from torchpose._core.rows import joined
from torchpose.errors import InputError
from torchpose.learning._samplers import BLOCK, PRODUCT, Samples, SampleSource

K = TypeVar("K")
_START_BLOCKS = 4  # times the blocks that the samples would fill, for variety


def _alone(values: Tensor) -> Tensor:
    return values


def _sum_over_processes(values: Tensor) -> Tensor:
    total = values.clone()
    torch.distributed.all_reduce(total)
    return total


class Share(NamedTuple):
    """Describes the share of the blocks that one process takes.

    Attributes:
        rank, size: number of this process, and of all processes.
        total: the sum of a tensor over all processes, which each of them has to call.
    """

    rank: int = 0
    size: int = 1
    total: Callable[[Tensor], Tensor] = _alone

    @classmethod
    def of_processes(cls) -> Share:
        """Return this process' share in the group of `torch.distributed`; all of it without a group."""
        if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
            return cls()
        rank, size = torch.distributed.get_rank(), torch.distributed.get_world_size()
        return cls(rank, size, _sum_over_processes)

    def blocks(self, n_blocks: int) -> range:
        """Return the blocks of this process; every block belongs to exactly one process."""
        return range(self.rank, n_blocks, self.size)

    @contextlib.contextmanager
    def failing_together(self, like: Tensor) -> Iterator[None]:
        """Let the other processes get NaN from their `total`, shaped as `like`, if the block raises."""
        try:
            yield
        except Exception:
            if self.size > 1:  # or the others would wait for this process
                self.total(torch.full_like(like, torch.nan))
            raise


ALONE = Share()
"""All of the work, for a process without others."""


def usable_samples(samples: Samples, name: str) -> Samples:
    """Return the samples of positive weight.

    Args:
        samples: states and weights.
        name: the name of the samples, for a message, such as their block.

    Raises:
        InputError: weights that are negative or not finite, states of positive weight that are not.
    """
    states, weight = samples
    if len(weight) and _all_usable(states, weight):
        return samples
    if not bool((weight >= 0).all()) or bool(torch.isinf(weight).any()):
        bad = ~((weight >= 0) & torch.isfinite(weight))
        row = int(bad.nonzero()[0])
        raise InputError(
            f"{name}: weights must be finite and not negative, got {float(weight[row]):g} in row "
            f"{row} ({int(bad.sum())} such weights)"
        )
    positive = weight > 0
    if not bool(positive.all()):
        states, weight = states[positive], weight[positive]
    if not bool(torch.isfinite(states).all()):
        bad = ~torch.isfinite(states).all(1)
        row = int((positive.nonzero()[:, 0])[bad][0])
        raise InputError(
            f"{name}: states must be finite, got {int(bad.sum())} of {len(samples.states)} that are "
            f"not, the first in row {row}; drop frames with missing joints, or give them weight 0"
        )
    return Samples(states, weight)


def _all_usable(states: Tensor, weight: Tensor) -> bool:
    """Return whether all samples are usable: NaN and infinity show in a sum and in the extremes."""
    low, high = weight.aminmax()
    return bool((low > 0) & (high < torch.inf) & torch.isfinite(states.sum()))


def spread_samples(source: SampleSource, count: int) -> Samples:
    """Return about `count` usable samples, spread evenly over a source and the same in every process.

    Args:
        source: the states; all of them are taken if there are no more than `count`.
        count: number of samples.

    Raises:
        InputError: samples that are not finite; the block is named.
    """
    n_blocks = source.n_blocks
    if source.n_samples > count:
        n_blocks = min(n_blocks, _START_BLOCKS * -(-count // BLOCK))
    each = -(-count // max(n_blocks, 1))
    parts = []
    for place in range(n_blocks):
        index = (place * source.n_blocks + source.n_blocks // 2) // n_blocks
        samples = usable_block(source, index)
        n = len(samples.states)
        if source.n_samples > count and each < n:
            rows = torch.arange(each) * n // each
            samples = Samples(*(values[rows] for values in samples))
        parts.append(samples)
    if not parts:
        return Samples(torch.zeros(0, source.dim).double(), torch.zeros(0).double())
    return joined(parts)


def usable_block(source: SampleSource, index: int, epoch: int = 0) -> Samples:
    """Return the samples of positive weight of a block, which errors name."""
    name = f"block {index} of {source.n_blocks}"
    return usable_samples(source.block(index, epoch), name)


def joined_blocks(blocks: Iterable[tuple[K, Samples]]) -> Iterator[tuple[K, Samples]]:
    """Join consecutive blocks of one key to as many samples as one product takes.

    Args:
        blocks: keys, such as the name of their source, and samples; those of one key together.
    """
    kept: list[Samples] = []
    last: list[K] = []
    for key, samples in blocks:
        if kept and last != [key]:
            yield last[0], joined(kept)
            kept = []
        last = [key]
        kept.append(samples)
        if sum(len(s.states) for s in kept) >= PRODUCT:
            yield key, joined(kept)
            kept = []
    if kept:
        yield last[0], joined(kept)
