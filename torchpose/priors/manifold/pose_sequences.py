"""Sequences of poses as one matrix, with the ends of each remembered."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.errors import InputError, ShapeError

__all__ = [
    "column_scale",
    "join_sequences",
    "principal_axes",
    "steps_growth",
    "steps_within",
    "thin",
]

LEAST_FRAMES = 10
_STRIDES = (2, 3, 4)  # frames, over which the growth of steps is looked at


def join_sequences(
    poses: Tensor | Sequence[Tensor], columns: Sequence[str] = (), dim: int | None = None
) -> tuple[Float[Tensor, "T Q"], list[int]]:
    """Poses of all sequences, one below the other in double precision, and how long each is.

    Args:
        poses: one sequence [T, Q] or several. columns: their names, for messages. dim: the number of
            columns that there have to be; any if None.

    Raises:
        ShapeError: not [T, Q], or another number of columns. InputError: no sequence, fewer than 10
            frames in all, or a value that is not finite.
    """
    parts = [poses] if isinstance(poses, Tensor) else list(poses)
    wanted = dim if dim is not None else next((p.shape[-1] for p in parts if p.ndim == 2), None)
    for number, part in enumerate(parts):
        where = "poses" if isinstance(poses, Tensor) else f"sequence {number} of the poses"
        if part.ndim != 2 or part.shape[1] != wanted:
            raise ShapeError(
                f"{where} must have shape [T, {'Q' if wanted is None else wanted}], got "
                f"{list(part.shape)}; a pose is the columns that `Body.relative` returns"
            )
        bad = (~torch.isfinite(part)).nonzero()
        if len(bad):
            frame, column = (int(i) for i in bad[0])
            name = f" ({columns[column]})" if len(columns) == part.shape[1] else ""
            raise InputError(
                f"{where} must be finite, got {float(part[frame, column])} in frame {frame}, column "
                f"{column}{name}; {len(bad)} such values; leave out the frames with gaps, and end "
                "the sequence there"
            )
    count = sum(len(part) for part in parts)
    if count < LEAST_FRAMES:
        raise InputError(f"a manifold needs at least {LEAST_FRAMES} frames of poses, got {count}")
    return torch.cat([part.detach().double() for part in parts]), [len(part) for part in parts]


def steps_within(values: Float[Tensor, "T D"], lengths: Sequence[int]) -> Float[Tensor, "steps D"]:
    """Differences of consecutive rows, but not from one sequence to the next.

    Raises:
        InputError: no sequence has two frames.
    """
    steps = torch.cat([part.diff(dim=0) for part in values.split(list(lengths))])
    if not len(steps):
        raise InputError("a step takes two frames of one sequence, got sequences of one frame each")
    return steps


def steps_growth(values: Float[Tensor, "T D"], lengths: Sequence[int]) -> float:
    """Exponent g with which steps grow with the frames k between them, RMS(x_t+k - x_t) ~ k^g.

    1/2 for a random walk, 1 for a motion that goes on; by least squares over 2, 3 and 4 frames, from 0
    to 1, and 1/2 where no sequence is long enough.

    Args:
        values: of all sequences. lengths: frames of each; no step is taken from one to the next.

    >>> steps_growth(torch.arange(20.0)[:, None], [20])
    1.0
    """
    parts, sizes = values.split(list(lengths)), {}
    for k in (1, *_STRIDES):
        steps = [part[k:] - part[:-k] for part in parts if len(part) > k]
        sizes[k] = float(torch.cat(steps).square().mean().sqrt()) if steps else 0.0
    if not sizes[1] > 0:
        return 0.5
    found = [(math.log(k), math.log(sizes[k] / sizes[1])) for k in _STRIDES if sizes[k] > 0]
    slope = sum(x * y for x, y in found) / sum(x * x for x, _ in found) if found else 0.5
    return min(1.0, max(0.0, slope))


def column_scale(poses: Float[Tensor, "T Q"]) -> Float[Tensor, " Q"]:
    """Standard deviation of each column; at least a hundredth of the largest one."""
    spread = poses.std(0)
    largest = spread.max()
    return spread.maximum(0.01 * largest) if bool(largest > 0) else torch.ones_like(spread)


def principal_axes(latents: Float[Tensor, "T d"]) -> Float[Tensor, "d d"]:
    """Rotation or reflection to the axes of largest variance, the first point at positive values."""
    _, _, axes = torch.linalg.svd(latents - latents.mean(0), full_matrices=False)
    signs = torch.where(latents[0] @ axes.mT < 0, -1.0, 1.0).to(latents)
    return axes.mT * signs


def thin(sequences: Sequence[Float[Tensor, "_ Q"]], frames: int) -> list[Tensor]:
    """So many poses in all at most, evenly spread over all sequences.

    Poses spread over many trials make a better manifold than as many in a row.

    Args:
        sequences: [T_s, Q] each. frames: at most, but at least one of each sequence.

    >>> [len(part) for part in thin([torch.zeros(10, 3), torch.zeros(7, 3)], 8)]
    [4, 3]
    """
    total = sum(len(part) for part in sequences)
    kept = []
    for part in sequences:
        count = max(1, len(part) * min(frames, total) // max(total, 1))
        index = (torch.arange(count) * len(part) / count).long()
        kept.append(part[index.to(part.device)])
    return kept
