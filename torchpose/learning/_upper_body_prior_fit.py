"""Fit an upper-body prior (BL 3): a mixture per arm, and the noise of its motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any, TypedDict, Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.camera._pinhole import PinholeCamera
from torchpose.camera._viewpoints import Viewpoints, ViewRange, sample_viewpoints
from torchpose.errors import PriorError
from torchpose.learning._samplers import ArmSource, all_samples, derived_seed
from torchpose.learning._training import (
    DEFAULT_RATE,
    MIRROR,
    TRAINING_VIEWS,
    PoseSet,
    RecordingLike,
    arm_poses,
    arm_sources,
    collect_poses,
)
from torchpose.math._rotations import euler_to_matrix
from torchpose.priors._arm_state import (
    ANGLES,
    STATE_DIM,
    check_rotation_order,
    mirror_covariance,
    mirror_mixture,
    turned_arm_state,
)
from torchpose.priors._gaussian_mixture import GaussianMixture
from torchpose.priors._prior_file import PriorInfo
from torchpose.priors._upper_body_prior import UpperBodyPrior
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.skeleton._upper_body import LEFT_ARM, RIGHT_ARM

KINECT_CAMERA = (525.0, 525.0, 319.5, 239.5)
"""fx, fy, cx, cy of a Kinect's camera at 640 x 480, pixels."""


class MixtureFitOptions(TypedDict, total=False):
    """The options of `GaussianMixture.fit` that `fit_upper_body_prior` does not set itself."""

    n_init: int
    max_iter: int
    tol: float
    covariance_floor: float
    init: str
    dtype: torch.dtype


def fit_upper_body_prior(
    recordings: Sequence[RecordingLike],
    n_components: int = 30,
    seed: int = 0,
    views: ViewRange = TRAINING_VIEWS,
    *,
    camera: PinholeCamera | None = None,
    rotation_order: str = "zxy",
    centre: str = "neck",
    neck: str | None = None,
    mirror: bool = True,
    n_samples: int | None = None,
    views_per_pose: int | None = None,
    nose_as_head: bool = False,
    name: str = "",
    licence: str = "",
    command: str = "",
    progress: bool = False,
    **fit_options: Unpack[MixtureFitOptions],
) -> UpperBodyPrior:
    """Fit a prior to recorded 3D poses seen from random viewpoints (BL section 3.1).

    Args:
        recordings: the recordings, in camera axes (`torchpose.io.read_recordings`).
        n_components: Gaussians per arm.
        seed: the seed of viewpoints and start.
        views: limits of the random viewpoints.
        camera: whose pixels the states are in; Kinect's (f = 525, 640 x 480) if None.
        rotation_order: "zxy" (paper) or "zyx" (released priors).
        centre: "neck", "head" or "sequence" (`PriorInfo`).
        neck: kind of neck; the highest among the recordings if None. Others are converted.
        mirror: fit one mixture to left arms and mirrored right arms, and mirror it.
        n_samples, views_per_pose: how many training states (`arm_sources`).
        nose_as_head: take the nose where a joint set has no head.
        name, licence, command: for `info`.
        progress: show bars.
        **fit_options: to `GaussianMixture.fit`: n_init, max_iter, tol, covariance_floor, init.

    Returns:
        `UpperBodyPrior` in float64, without noise and windows.

    Raises:
        InputError: no recordings or no complete frames. PriorError: kinds of joints that cannot be
            mixed, unknown rotation order.
    """
    order = check_rotation_order(rotation_order)
    camera = camera or PinholeCamera(*KINECT_CAMERA, width=640, height=480)
    (fx, skew, cx), (_, fy, cy), _ = camera.matrix.tolist()
    if skew:
        raise PriorError(f"the camera of a prior must have no skew, got {skew:g} pixels")
    poses = collect_poses(recordings, neck, centre, nose_as_head)
    sources = arm_sources(
        poses, camera.matrix, seed, views, order, mirror, n_samples, views_per_pose
    )
    options: dict[str, Any] = {"n_components": n_components, "seed": seed, "progress": progress}
    options |= fit_options
    left = _fit_arm(sources.left, options)
    right = None if sources.right is None else _fit_arm(sources.right, options)
    info = PriorInfo(
        name=name, rotation_order=order, fx=fx, fy=fy, cx=cx, cy=cy, licence=licence,
        command=command, views=asdict(views), **sources.facts,
    )  # fmt: skip
    return prior_of_arms(left, right, info, seed)


def _fit_arm(source: ArmSource, options: dict[str, Any]) -> GaussianMixture:
    states, weight = all_samples(source)
    return GaussianMixture.fit(states, sample_weight=weight, **options)


def prior_of_arms(
    left: GaussianMixture, right: GaussianMixture | None, info: PriorInfo, seed: int
) -> UpperBodyPrior:
    """Build a prior of fitted mixtures over poses; the right one mirrors the left one if None.

    Args:
        left, right: mixtures with their `fit_report`, if they were fitted. info: what they were
            fitted on. seed: the seed of the fit.
    """
    info = replace(info, extra=info.extra | _fit_facts(left, seed))
    return UpperBodyPrior(left, mirror_mixture(left, info.cx) if right is None else right, info)


def _fit_facts(mixture: GaussianMixture, seed: int) -> dict[str, Any]:
    report = mixture.fit_report
    if report is None:
        return {"seed": seed}
    return {
        "seed": seed,
        "fit": {
            "iterations": report.iterations,
            "log_likelihood": report.log_likelihood[-1],
            "converged": report.converged,
            "reseeded": report.reseeded,
        },
    }


_NECK = UPPER_BODY.index("neck")
_STEPS = 50_000  # least number of viewpoints, where there are recorded steps
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
        matrix: K, pixels. views, rotation_order: of the viewpoints. seed: the seed of these.
        mirror: pool left arms and mirrored right ones.

    Returns:
        S in pixels, metres and radians for the sides that have steps at all; with `mirror` for both, if
        one has.
    """
    order = check_rotation_order(rotation_order)
    rate = poses.facts["fps"] or DEFAULT_RATE
    found = {}
    for side, arm in (("left", LEFT_ARM), ("right", RIGHT_ARM)):
        used = _usable(poses, arm)
        if len(used):
            generator = torch.Generator().manual_seed(derived_seed(seed, f"increments {side}"))
            used = used.repeat(-(-_STEPS // len(used)))
            sampled = sample_viewpoints(len(used), views, generator)
            joints = poses.joints * MIRROR if mirror and side == "right" else poses.joints
            rotation = euler_to_matrix(sampled.angles, order)
            steps = _states(joints[used], arm, sampled, rotation, matrix)
            steps = steps - _states(joints[used - 1], arm, sampled, rotation, matrix)
            trust = _trust(poses, arm, used)
            weight = trust * _rates(poses)[used] / rate
            found[side] = (steps * weight[:, None]).mT @ steps / trust.sum()
    if mirror and found:
        pooled = torch.stack(list(found.values())).mean(0)
        found = {"left": pooled, "right": mirror_covariance(pooled)}
    turning = torch.zeros(STATE_DIM, dtype=torch.float64)
    turning[ANGLES] = _ANGLE_STEP**2 * 30.0 / rate
    return {side: cov + torch.diag(turning) for side, cov in found.items()}


def _usable(poses: PoseSet, arm: tuple[int, ...]) -> Tensor:
    """Return frames that follow another one of their recording, with the whole arm in both."""
    whole = arm_poses(poses, arm).known
    lengths = torch.tensor(poses.lengths)
    begins = torch.zeros_like(whole)
    begins[(lengths.cumsum(0) - lengths)[lengths > 0]] = True
    return (whole & whole.roll(1) & ~begins).nonzero()[:, 0]


def _trust(poses: PoseSet, arm: tuple[int, ...], frames: Tensor) -> Tensor:
    weight = arm_poses(poses, arm).weight
    return torch.minimum(weight[frames], weight[frames - 1])


def _rates(poses: PoseSet) -> Float[Tensor, " N"]:
    return torch.tensor(poses.rates, dtype=torch.float64).repeat_interleave(
        torch.tensor(poses.lengths)
    )


def _states(
    joints: Float[Tensor, "n 8 3"],
    arm: tuple[int, ...],
    views: Viewpoints,
    rotation: Float[Tensor, "n 3 3"],
    matrix: Tensor,
) -> Float[Tensor, "n 21"]:
    """Return states of poses centred on their neck, whose position goes into the camera's translation."""
    neck = joints[:, _NECK]
    place = views.translation + (rotation @ neck[..., None])[..., 0]
    points = joints[:, list(arm)] - neck[:, None]
    return turned_arm_state(points, Viewpoints(views.angles, place), rotation, matrix)
