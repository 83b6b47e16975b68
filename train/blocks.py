"""Share the blocks of all training sources among processes and their workers.

Every process takes the blocks rank, rank + world, ... of one list, each exactly once, without padding or
repetition. Processes may have different numbers of blocks, or none. Lightning synchronises the processes
in every training step, so that different numbers of steps would be a deadlock. Therefore one step is one
sweep of a process over all of its blocks.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from torch.utils.data import DataLoader, Dataset, Sampler

from torchpose.errors import InputError
from torchpose.learning._blocks import joined_blocks, usable_block
from torchpose.learning._samplers import Samples, SampleSource

__all__ = ["Block", "Key", "Part", "ShareSampler", "Sweep", "SweepLoader", "list_blocks"]


class Key(NamedTuple):
    """A source: the name of its mixture, and whether it is of held-out persons."""

    name: str
    held_out: bool = False


class Block(NamedTuple):
    """A block of a source by its number, and the epoch that it is drawn for."""

    key: Key
    number: int
    epoch: int = 0


class Part(NamedTuple):
    """Some samples of a source."""

    key: Key
    samples: Samples


Sources = Mapping[Key, SampleSource]
Epochs = Callable[[Key], int | None]


def list_blocks(sources: Sources) -> list[Block]:
    """Return every block of every source."""
    return [Block(key, i) for key, source in sources.items() for i in range(source.n_blocks)]


class _Blocks(Dataset[Part]):
    """A data set whose blocks are drawn on demand."""

    def __init__(self, sources: Sources) -> None:
        self.sources = dict(sources)

    def __getitem__(self, block: Block) -> Part:
        try:
            samples = usable_block(self.sources[block.key], block.number, block.epoch)
        except InputError as error:
            raise InputError(f"mixture {block.key.name!r}, {error}") from error
        return Part(block.key, samples)


class ShareSampler(Sampler[Block]):
    """The blocks of one process.

    Args:
        blocks: of all processes together. rank, world: which process of how many.
        epochs: the epoch that a source is wanted for, or None if it is not wanted in this sweep;
            asked anew in every sweep, and the answer has to be the same in every process.
    """

    def __init__(
        self,
        blocks: Sequence[Block],
        rank: int = 0,
        world: int = 1,
        epochs: Epochs = lambda key: 0,
    ) -> None:
        self._blocks, self._rank, self._world, self._epochs = blocks, rank, world, epochs

    def _share(self) -> list[Block]:
        epochs = {key: self._epochs(key) for key in dict.fromkeys(b.key for b in self._blocks)}
        found = ((block, epochs[block.key]) for block in self._blocks)
        wanted = [block._replace(epoch=epoch) for block, epoch in found if epoch is not None]
        return wanted[self._rank :: self._world]

    def __iter__(self) -> Iterator[Block]:
        return iter(self._share())

    def __len__(self) -> int:
        return len(self._share())


class Sweep:
    """One pass of a process over its blocks, joined per source.

    Args:
        blocks: in order, those of a source together. length: how many.
    """

    def __init__(self, blocks: Iterable[Part], length: int) -> None:
        self._blocks, self._length = blocks, length
        self.watchers: list[Callable[[], Any]] = []  # called after each block

    def __len__(self) -> int:
        return self._length

    def __iter__(self) -> Iterator[Part]:
        for key, samples in joined_blocks(self._watched()):
            yield Part(key, samples)

    def _watched(self) -> Iterator[tuple[Key, Samples]]:
        for part in self._blocks:
            yield part
            for watcher in self.watchers:
                watcher()


class SweepLoader:
    """A loader for Lightning with one `Sweep` in every epoch.

    Args:
        sources: of all mixtures. rank, world, epochs: of `ShareSampler`.
        num_workers: processes that draw blocks ahead; 0 draws them where they are used.
    """

    def __init__(
        self,
        sources: Sources,
        rank: int = 0,
        world: int = 1,
        epochs: Epochs = lambda key: 0,
        num_workers: int = 0,
    ) -> None:
        self.sampler = ShareSampler(list_blocks(sources), rank, world, epochs)
        self._blocks: DataLoader[Part] = DataLoader(
            _Blocks(sources),
            batch_size=None,
            sampler=self.sampler,
            num_workers=num_workers,
            persistent_workers=num_workers > 0,
            collate_fn=_unchanged,
        )

    def __len__(self) -> int:
        return 1

    def __iter__(self) -> Iterator[Sweep]:
        yield Sweep(self._blocks, len(self.sampler))


def _unchanged(part: Any) -> Any:
    return part
