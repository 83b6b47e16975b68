"""Fit action spaces to performances of an action (AS 1)."""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_count, check_rate, check_shape
from torchpose.errors import InputError
from torchpose.learning._performances import checked_performances, synchronise
from torchpose.priors._actions.action_file import ActionInfo, Synchronised
from torchpose.priors._actions.polar_limbs import POSTURE_DIM
from torchpose.priors._actions.space import ActionSpace

_STD_FLOOR = 0.1  # of a dimension's deviation over the whole performance
_LEAST_STD = 0.1  # degrees
_STILL = 1e-3  # degrees, of somebody who does not move: rounding, and that of frames between frames
_SMALLEST_VARIANCE = 1e-10  # of the largest; below it a direction is rounding


def fit_action_space(
    performances: Sequence[Float[Tensor, "_ 36"]],
    n_dimensions: int = 13,
    *,
    name: str = "",
    fps: float | None = None,
    n_postures: int | None = None,
    prominence: float = 0.15,
    info: ActionInfo | None = None,
) -> ActionSpace:
    """Fit an action space to performances of one action (AS 1).

    Performances are synchronised in all principal axes, whatever D is, so that
    `with_dimensions(d)` of a larger space is the fit with d.

    Args:
        performances: [T_p, 36] each, degrees, of any lengths, one repetition of the action from
            its start to its end (`split_repetitions` cuts them out of recordings).
        n_dimensions: D; reduced, with a warning, if the postures span fewer.
        name: the name of the action. fps: the frame rate of the performances, for the record.
        n_postures: K; by default the median length. prominence: see `synchronise`.
        info: more facts; name, fps and what the fit finds are filled in.

    Returns:
        `ActionSpace` with D dimensions and K postures, degrees, and its performances in step.

    Raises:
        InputError: one performance only, one with too few frames, NaN, D or fps not positive,
            nothing moves. ShapeError: postures of other than 36 angles.
    """
    return fit_synchronised(
        performances, n_dimensions, name=name, fps=fps, n_postures=n_postures,
        prominence=prominence, info=info,
    )[0]  # fmt: skip


def fit_synchronised(
    performances: Sequence[Float[Tensor, "_ 36"]],
    n_dimensions: int,
    *,
    name: str = "",
    fps: float | None = None,
    n_postures: int | None = None,
    prominence: float = 0.15,
    info: ActionInfo | None = None,
) -> tuple[ActionSpace, Synchronised]:
    """Fit as `fit_action_space` does, and return the synchronised performances as well."""
    known = info or ActionInfo()
    name, fps = name or known.name, known.fps if fps is None else fps
    if fps is not None:
        check_rate("fps", fps)
    parts = _checked(performances, n_dimensions)
    postures = torch.cat(parts)
    mean = postures.mean(0)
    variances, axes = _principal_axes(postures - mean)
    rank = int((variances > _SMALLEST_VARIANCE * variances[0]).sum())
    if n_dimensions > rank:
        warnings.warn(
            f"the postures of {name or 'the action'} span {rank} dimensions, fewer than the "
            f"{n_dimensions} that were asked for: the action space has {rank}",
            stacklevel=3,  # who called the public function
        )
    d = min(n_dimensions, rank)
    axes = axes[:, :rank]
    found = synchronise([(part - mean) @ axes for part in parts], n_postures, prominence)
    found = found._replace(before=found.before[..., :d], after=found.after[..., :d])
    performance, std = found.after.mean(0), found.after.std(0)
    match_std = (found.after - performance).square().mean((0, 1)).sqrt().clamp_min(_LEAST_STD)
    tensors = {
        "mean": mean, "basis": axes[:, :d].contiguous(), "performance": performance,
        "std": torch.maximum(std, _STD_FLOOR * match_std), "match_std": match_std,
        "variances": variances[:d].clone(), "lost_variance": variances[d:].sum(),
    }  # fmt: skip
    facts = replace(
        known, name=name, fps=fps, performances=len(parts), key_frames=found.key_frames,
        explained=float(variances[:d].sum() / variances.sum()),
    )  # fmt: skip
    space = ActionSpace(**tensors, info=facts)
    space.synchronised = found
    return space, found


def _principal_axes(moves: Float[Tensor, "N 36"]) -> tuple[Tensor, Tensor]:
    """Return falling variances [36] and axes [36, 36] whose largest entry is positive."""
    variances, axes = torch.linalg.eigh(moves.mT @ moves / len(moves))
    variances, axes = variances.flip(0).clamp_min(0), axes.flip(1)
    largest = axes.gather(0, axes.abs().argmax(0, keepdim=True))
    return variances, axes * largest.sign()


def _checked(performances: Sequence[Tensor], n_dimensions: int) -> list[Tensor]:
    """Return the performances in double precision, or raise `InputError`."""
    check_count("n_dimensions", n_dimensions)
    if len(performances) < 2:
        raise InputError(
            f"an action space needs the deviation between performances: expected two or more, got "
            f"{len(performances)}; add recordings, or cut one with `split_repetitions`"
        )
    parts = checked_performances(performances)
    check_shape("performance 0", parts[0], ["T", POSTURE_DIM])
    if all(torch.equal(parts[0], part) for part in parts[1:]):
        raise InputError("all performances are one and the same: there is no deviation to learn")
    if all(float((part - part[0]).abs().max()) < _STILL for part in parts):
        raise InputError(
            "all postures of each performance are one and the same: there is no motion to learn"
        )
    return parts


class Performed(NamedTuple):
    """Holds a recording or a single performance.

    Attributes:
        person, action: who and what. postures: [T, 36], degrees.
    """

    person: str
    action: str
    postures: Tensor
