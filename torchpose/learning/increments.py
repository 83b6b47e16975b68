"""How much a frame changes the state of an arm: second moments of recorded steps."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.camera.viewpoints import Viewpoints, ViewRange, sample_viewpoints
from torchpose.learning.samplers import derived_seed
from torchpose.learning.training import DEFAULT_RATE, PoseSet
from torchpose.math.rotations import RotationOrder, euler_to_matrix
from torchpose.priors.arm_state import (
    ANGLES,
    STATE_DIM,
    arm_state,
    check_rotation_order,
    mirror_covariance,
)
from torchpose.skeleton.joint_sets import UPPER_BODY
from torchpose.skeleton.upper_body import LEFT_ARM, RIGHT_ARM

__all__ = ["increment_covs"]

_NECK = UPPER_BODY.index("neck")
_STEPS = 50_000  # at least so many viewpoints, where there are recorded steps at all
# rad in 1/30 s. The camera of a recording stands still; what it is believed to be has to move.
_ANGLE_STEP = 0.03


def increment_covs(
    poses: PoseSet,
    matrix: Float[Tensor, "3 3"],
    views: ViewRange,
    rotation_order: str,
    mirror: bool,
    seed: int,
) -> dict[str, Float[Tensor, "21 21"]]:
    """Return the second moment of the steps of each arm's state, per frame, by side.

    S = E[(x_t - x_{t-1}) (x_t - x_{t-1})^T] + diag(0, .., a^2, a^2, a^2, 0, 0, 0), where x_t and x_{t-1}
    are the states (BL 3) of consecutive frames of a recording, seen by a camera that stands still at
    a random viewpoint; the neck's path through the room moves t. a = 0.03 rad in 1/30 s explores the
    camera's angles, which no recorded step shows.

    Args:
        poses: centred on each recording's mean neck ("sequence"); steps of recordings at another rate
            than that of most frames count in proportion to the interval.
        matrix: K, pixels. views, rotation_order: of the viewpoints. seed: of these.
        mirror: pool left arms and mirrored right ones.

    Returns:
        S in pixels, metres and radians for the sides that have steps at all.
    """
    order = check_rotation_order(rotation_order)
    rate = poses.facts["fps"] or DEFAULT_RATE
    found = {}
    flip = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    for side, arm in (("left", LEFT_ARM), ("right", RIGHT_ARM)):
        used = _usable(poses, arm)
        if len(used):
            generator = torch.Generator().manual_seed(derived_seed(seed, f"increments {side}"))
            used = used.repeat(-(-_STEPS // len(used)))
            sampled = sample_viewpoints(len(used), views, generator)
            joints = poses.joints * flip if mirror and side == "right" else poses.joints
            steps = _states(joints[used], arm, sampled, matrix, order)
            steps = steps - _states(joints[used - 1], arm, sampled, matrix, order)
            trust = _trust(poses, arm, used)
            weight = trust * _rates(poses)[used] / rate
            found[side] = (steps * weight[:, None]).mT @ steps / trust.sum()
    if mirror and len(found) == 2:
        pooled = (found["left"] + found["right"]) / 2
        found = {"left": pooled, "right": mirror_covariance(pooled)}
    turning = torch.zeros(STATE_DIM, dtype=torch.float64)
    turning[ANGLES] = _ANGLE_STEP**2 * 30.0 / rate
    return {side: cov + torch.diag(turning) for side, cov in found.items()}


def _usable(poses: PoseSet, arm: tuple[int, ...]) -> Tensor:
    """Frames that have a frame before them in their recording, with the whole arm in both."""
    whole = torch.isfinite(poses.joints[:, list(arm)]).flatten(1).all(1)
    whole = whole & (poses.weight[:, list(arm)].amin(1) > 0)
    lengths = torch.tensor(poses.lengths)
    begins = torch.zeros_like(whole)
    begins[(lengths.cumsum(0) - lengths)[lengths > 0]] = True
    return (whole & whole.roll(1) & ~begins).nonzero()[:, 0]


def _trust(poses: PoseSet, arm: tuple[int, ...], frames: Tensor) -> Tensor:
    weight = poses.weight[:, list(arm)].amin(1)
    return torch.minimum(weight[frames], weight[frames - 1])


def _rates(poses: PoseSet) -> Float[Tensor, " N"]:
    return torch.tensor(poses.rates, dtype=torch.float64).repeat_interleave(
        torch.tensor(poses.lengths)
    )


def _states(
    joints: Float[Tensor, "n 8 3"],
    arm: tuple[int, ...],
    views: Viewpoints,
    matrix: Tensor,
    order: RotationOrder,
) -> Float[Tensor, "n 21"]:
    """States of poses that are centred on their neck, whose place is the camera's translation."""
    neck = joints[:, _NECK]
    rotation = euler_to_matrix(views.angles, order)
    place = views.translation + (rotation @ neck[..., None])[..., 0]
    points = joints[:, list(arm)] - neck[:, None]
    return arm_state(points, Viewpoints(views.angles, place), matrix, order)
