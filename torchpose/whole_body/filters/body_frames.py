"""What a filter over body poses is given: sequences and frames of silhouettes, checked."""

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool
from torch import Tensor

from torchpose.errors import DegenerateFilterWarning, InputError, ShapeError, check_shape
from torchpose.filters.base import Generators
from torchpose.whole_body.filters.body_particles import Score

__all__ = ["Frame", "check_frame", "check_sequences", "is_seen", "warn_if_respread"]

_LISTED = 8


class Frame(NamedTuple):
    """What one frame shows.

    Attributes:
        score: states [B, N, D] -> sharpened log-likelihood [B, N], float64; 0 in elements that nobody
            sees.
        seen: [B], False where the frame is empty.
        silhouettes: `PreparedSilhouettes` of [B, C, H, W]; with a callable as the likelihood, what it
            is given. cameras: as handed to the filter.
    """

    score: Score
    seen: Bool[Tensor, " B"]
    silhouettes: Any
    cameras: Any


def check_sequences(
    observed: Tensor, initial_state: Tensor, generator: Generators, dim: int, *, plain: bool
) -> tuple[Tensor, Tensor, bool]:
    """Observations [B, T, ...], initial states [B, D], and whether a batch was given.

    Args:
        observed, initial_state, generator: as `SilhouetteParticleFilter.forward`. dim: D.
        plain: whether the observations are silhouettes; otherwise any tensor that a callable takes.

    Raises:
        ShapeError, InputError: as `SilhouetteParticleFilter.forward`.
    """
    check_shape("initial_state", initial_state, ["...", dim])
    if initial_state.ndim > 2:
        raise ShapeError(f"initial_state must be [D] or [B, D], got {list(initial_state.shape)}")
    batched = initial_state.ndim == 2
    if plain:
        if observed.ndim not in (4, 5):
            raise ShapeError(
                "silhouettes must have shape [T, C, H, W] or [B, T, C, H, W], "
                f"got {list(observed.shape)}"
            )
        several = observed.ndim == 5
        _check_silhouettes(observed)
    else:
        several = batched
    frames = observed if several else observed[None]
    start = initial_state if batched else initial_state[None]
    sizes = {len(frames), len(start)} - {1}
    if len(sizes) > 1 or 0 in sizes or 0 in frames.shape[:2]:
        raise ShapeError(
            "silhouettes and initial_state must hold the same number of sequences, at least one "
            f"of one frame; got {list(observed.shape)} and {list(initial_state.shape)}"
        )
    batch = max(len(frames), len(start))
    if isinstance(generator, Sequence) and len(generator) != batch:
        raise InputError(
            f"a list of generators must hold one for each of the {batch} sequences, "
            f"got {len(generator)}"
        )
    frames, start = frames.expand(batch, *frames.shape[1:]), start.expand(batch, -1)
    return frames, start, batched or several


def check_frame(observed: Tensor, batch: int, *, plain: bool) -> None:
    """Raise unless this is one frame [B, ...] of B sequences.

    Raises:
        ShapeError, InputError: as `SilhouetteParticleFilter.step`.
    """
    if len(observed) != batch:
        raise ShapeError(
            f"silhouettes must hold one frame for each of the {batch} elements of the state, "
            f"[B, C, H, W]; got {list(observed.shape)}"
        )
    if plain:
        check_shape("silhouettes", observed, ["B", "C", "H", "W"])
        _check_silhouettes(observed)


def _check_silhouettes(silhouettes: Tensor) -> None:
    if silhouettes.dtype != torch.bool:
        raise InputError(
            f"silhouettes must be bool (True = person), got {silhouettes.dtype}; pass mask > 0"
        )


def is_seen(observed: Tensor) -> Bool[Tensor, " B"]:
    """Whether anything is observed: a True pixel, or a number that is not NaN."""
    known = observed if observed.dtype == torch.bool else ~torch.isnan(observed)
    return known.flatten(1).any(1)


def warn_if_respread(respread: Bool[Tensor, "B T"]) -> None:
    """Warn of the frames in which all particles died."""
    if not bool(respread.any()):
        return
    rows, frames = torch.nonzero(respread, as_tuple=True)
    listed = [
        f"element {b} at frame {t}" for b, t in zip(rows.tolist(), frames.tolist(), strict=True)
    ]
    warnings.warn(
        f"all particles died {len(listed)} times ({', '.join(listed[:_LISTED])}) and were spread "
        "about the last mean; use more particles, a larger step_std, a smaller sharpness or wider "
        "joint limits",
        DegenerateFilterWarning,
        stacklevel=3,
    )
