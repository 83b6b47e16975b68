"""Recordings that are there twice, whole or in part, under whatever name."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.errors import OverlapError
from torchpose.io.recordings import Recording
from torchpose.learning.curation.upper import label, measured

__all__ = [
    "Duplicate",
    "describe_duplicate",
    "find_duplicates",
    "refuse_shared_between_persons",
    "refuse_shared_recordings",
]

_GRID = 0.02  # metres: coarse, so that copies in whole millimetres mostly agree on it
_SHARED = 0.5  # of the shorter recording's frames
_MOST_COPIES = 64  # of one frame that are compared
_NECK = 4
_MISSING = -(2**40)


class Duplicate(NamedTuple):
    """Two recordings with the same frames: their indices, and the share of the shorter one's frames."""

    first: int
    second: int
    shared: float


def find_duplicates(recordings: Sequence[Recording], shared: float = _SHARED) -> list[Duplicate]:
    """Pairs of recordings that have at least this share of the shorter one's frames in common.

    A frame is its eight joints relative to the neck, rounded to 2 cm, as a hash of 64 bits; so copies
    are found that were moved, cut, renamed, or written in whole millimetres. A copy that was turned,
    scaled or mirrored is not. Equal frames within one recording count once.
    """
    keys = [torch.unique(_frame_keys(r.upper_body().joints)) for r in recordings]
    sizes = torch.tensor([len(k) for k in keys], dtype=torch.long)
    which = torch.arange(len(keys)).repeat_interleave(sizes)
    flat, order = torch.sort(torch.cat(keys) if keys else sizes, stable=True)
    which = which[order]
    pairs = []
    for apart in range(1, _MOST_COPIES):
        same = flat[apart:] == flat[:-apart]
        if not bool(same.any()):
            break
        pairs.append(torch.stack([which[:-apart][same], which[apart:][same]], 1))
    if not pairs:
        return []
    found, counts = torch.unique(torch.cat(pairs), dim=0, return_counts=True)
    share = counts / torch.minimum(sizes[found[:, 0]], sizes[found[:, 1]])
    return [
        Duplicate(first, second, part)
        for (first, second), part in zip(found.tolist(), share.tolist(), strict=True)
        if part >= shared
    ]


def refuse_shared_recordings(
    train: Sequence[Recording], test: Sequence[Recording], shared: float = _SHARED
) -> None:
    """Raise if a recording, or part of it, is on both sides.

    Raises:
        OverlapError: both files and persons are named.
    """
    both = [*train, *test]
    for found in find_duplicates(both, shared):
        if found.first < len(train) <= found.second:
            raise OverlapError(
                f"{describe_duplicate(found, both)}; the first would be in the test and the second "
                "in training: remove one"
            )


def refuse_shared_between_persons(
    recordings: Sequence[Recording], shared: float = _SHARED
) -> list[Duplicate]:
    """Raise if a recording, or part of it, is there under two persons.

    Returns:
        The duplicates of one person.

    Raises:
        OverlapError: both files and persons are named.
    """
    duplicates = find_duplicates(recordings, shared)
    for found in duplicates:
        if recordings[found.first].person_id != recordings[found.second].person_id:
            raise OverlapError(
                f"{describe_duplicate(found, recordings)}; a recording under two persons would leak "
                "from training into a test: remove one, or put both into the folder of one person"
            )
    return duplicates


def describe_duplicate(found: Duplicate, recordings: Sequence[Recording]) -> str:
    """Which recording is in which other one, for people."""
    first, second = recordings[found.first], recordings[found.second]
    return (
        f"{100 * found.shared:.0f} % of the frames of {label(second)} (person {second.person_id}) "
        f"are also in {label(first)} (person {first.person_id})"
    )


def _frame_keys(joints: Float[Tensor, "T 8 3"]) -> Int[Tensor, " N"]:
    """A hash of each frame that has a joint."""
    joints = joints[measured(joints).any(1)].double()
    neck = joints[:, _NECK : _NECK + 1]
    joints = joints - torch.where(torch.isfinite(neck), neck, 0.0)
    grid = torch.where(torch.isfinite(joints), (joints / _GRID).round(), _MISSING).long()
    generator = torch.Generator().manual_seed(0)
    factors = torch.randint(-(2**62), 2**62, (grid[0].numel() if len(grid) else 24,),
                            generator=generator) | 1  # fmt: skip
    return (grid.flatten(1) * factors).sum(1)  # in the ring of 64-bit numbers
