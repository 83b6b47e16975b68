"""Standard deviations of a motion about its manifold, from validation poses (MR 27, 29, 30)."""

import copy
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.errors import InputError
from torchpose.priors.manifold.pose_sequences import steps_within

__all__ = ["MotionNoise", "at_rate", "check_unseen", "motion_noise", "no_noise"]

_LEAST_SHARE = 0.05  # of the root mean square over all columns: a deviation that is not nothing


class MotionNoise(NamedTuple):
    """Standard deviations per frame.

    Attributes:
        std_latent: sigma x->z [d] (MR 27). std_pose: sigma z->x [Q] (MR 30). std_step: sigma x->x [Q]
            (MR 29).
    """

    std_latent: Tensor
    std_pose: Tensor
    std_step: Tensor


def no_noise(latent_dim: int, columns: int, like: Tensor) -> MotionNoise:
    """NaN for all of it, before there are validation poses."""
    return MotionNoise(*(like.new_full((n,), math.nan) for n in (latent_dim, columns, columns)))


def motion_noise(
    poses: Float[Tensor, "T Q"],
    latents: Float[Tensor, "T d"],
    returned: Float[Tensor, "T Q"],
    lengths: Sequence[int],
) -> MotionNoise:
    """Root mean squares of g(x_t) - g(x_t-1), of x_t - f(g(x_t)) and of x_t - x_t-1.

    A column that stands still, such as the twist of an arm, gets a twentieth of the root mean square
    over all columns.

    Args:
        poses: x. latents: g(x). returned: f(g(x)). lengths: frames of each sequence; no step is taken
            from one to the next.

    Raises:
        InputError: no sequence has two frames.
    """
    found = (steps_within(latents, lengths), poses - returned, steps_within(poses, lengths))
    squared = [values.square().mean(0) for values in found]
    return MotionNoise(*(s.sqrt().maximum(_LEAST_SHARE * s.mean().sqrt()) for s in squared))


def at_rate(manifold: Any, fps: float) -> Any:
    """The same manifold with its standard deviations for another frame rate.

    sigma(fps) = sigma (fps_0 / fps)^g of sigma x->z and x->x, g learnt by `fit_noise`; sigma z->x does
    not depend on the rate.

    Raises:
        PriorError: no standard deviations, or a file that does not say how they grow.
    """
    known = bool(torch.isfinite(manifold.std_pose).all())
    latent, step = manifold.info.noise_factors(fps, known)
    other = copy.deepcopy(manifold)
    other.std_latent *= latent
    other.std_step *= step
    other.info = replace(manifold.info, fps=float(fps))
    return other


def check_unseen(
    poses: Float[Tensor, "T Q"], lengths: Sequence[int], fitted: Float[Tensor, "N Q"]
) -> None:
    """Raise `InputError` if a sequence starts with a pose that was fitted to."""
    first = torch.stack([part[0] for part in poses.split(list(lengths)) if len(part)])
    if bool((first[:, None] == fitted).all(-1).any()):
        raise InputError(
            "the standard deviations need poses that were not fitted to, got some that were; "
            "take another trial of the same person"
        )
