"""The filter over single poses of an arm, and the noise that it takes."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.camera.projection import map_pixel_covariance
from torchpose.errors import InputError, check_finite, check_shape
from torchpose.filters.base import RecursiveFilter
from torchpose.priors.upper_body import UpperBodyPrior
from torchpose.skeleton.joint_sets import UPPER_BODY
from torchpose.skeleton.upper_body import ARM_JOINTS
from torchpose.upper_body.arms import ARMS
from torchpose.upper_body.measurements import pixel_indices
from torchpose.upper_body.methods import SINGLE_POSES, check_options, pose_model
from torchpose.upper_body.process_noise import default_process_cov, process_cov

__all__ = ["default_process_cov", "joint_covariances", "noise_options", "pose_filter"]

_DEFAULT_STD = 3.0


def pose_filter(
    prior: UpperBodyPrior,
    side: str,
    joints: tuple[str, ...],
    measurement_cov: Float[Tensor, "8 2 2"],
    method: str,
    fps: float | None,
    options: dict[str, Any],
) -> RecursiveFilter:
    """The filter of an arm that measures these joints.

    Args:
        prior: whose mixture and noise it takes. side: "left" or "right". joints: of `ARM_JOINTS`.
        measurement_cov: R of the eight joints, the prior's pixels. method: one of
            `torchpose.upper_body.METHODS`. fps: frame rate. options: to the filter; what the prior
            brings is used for the others.

    Raises:
        InputError: an option that the method does not use.
    """
    check_options(method, options)
    arm = ARMS[side]
    blocks = [measurement_cov[arm[ARM_JOINTS.index(joint)]] for joint in joints]
    arguments = noise_options(prior, side, method, fps, options)
    model, kind = pose_model(method)
    return model(
        getattr(prior, side),
        measurement_cov=torch.block_diag(*blocks),
        observed=pixel_indices(joints),
        **kind,
        **arguments,
    )


def noise_options(
    prior: UpperBodyPrior,
    side: str,
    method: str,
    fps: float | None,
    options: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the caller's options, and for the others the noise and transition of the prior.

    Args:
        prior: what it brings is scaled to the frame rate, and left out where a choice of the caller
            has no use for it. side: "left" or "right". method: a filter over single poses. fps: frame
            rate. options: of the caller.

    Raises:
        InputError: process_cov for the transition "ou", which has no Q.
    """
    own = dict(options or {})
    brought = _brought_by(prior, side, method, fps)
    kind = own.get("transition", brought.get("transition"))
    if kind == "ou" and "process_cov" in own:
        raise InputError("process_cov does not apply to transition 'ou', whose noise is gamma's")
    if kind != "ou":
        brought.pop("gamma", None)
    if own.get("weighting") == "frame":
        brought.pop("uniform_weight", None)
    return brought | own


def _brought_by(prior: UpperBodyPrior, side: str, method: str, fps: float | None) -> dict[str, Any]:
    noise, info = prior.noise, prior.info
    ratio = 1.0 if not fps or not info.fps else info.fps / fps
    options: dict[str, Any] = {"process_cov": ratio * process_cov(prior, side, method)}
    if method.startswith("pf-"):
        return options | {"start": "measured"}
    options["transition"] = info.transition
    gamma = noise.get(f"gamma_{side}", noise.get("gamma"))
    if gamma is not None:
        options["gamma"] = gamma**ratio
    epsilon = noise.get("uniform_weight")
    if epsilon is not None and method == SINGLE_POSES:
        options["uniform_weight"] = float(epsilon)
    return options


def joint_covariances(
    prior: UpperBodyPrior,
    std: float | Sequence[float] | Tensor | None,
    matrix: Float[Tensor, "3 3"],
) -> Float[Tensor, "8 2 2"]:
    """R of each of the eight joints in the prior's pixels.

    Args:
        prior: whose pixels are meant, and whose noise is taken where none is stated.
        std: of a keypoint, pixels of the camera: None, one number, or one for each of `ARM_JOINTS`.
        matrix: K of that camera.

    Raises:
        ShapeError, InputError: another number of deviations, or some that are not positive.
    """
    learnt = prior.noise.get("measurement_std") if std is None else None
    if learnt is None:
        given = torch.as_tensor(_DEFAULT_STD if std is None else std, dtype=torch.float64)
    else:
        given = learnt.double()
    by_joint = given.expand(5) if given.ndim == 0 else given
    check_shape("measurement_std", by_joint, [5])
    check_finite("measurement_std", by_joint)
    if bool((by_joint <= 0).any()):
        raise InputError(f"measurement_std must be positive, got {by_joint.tolist()}")
    cov = torch.diag_embed(by_joint.square()[:, None].expand(5, 2))
    if learnt is None:
        cov = map_pixel_covariance(cov, matrix, prior.info.matrix)
    return cov[[ARM_JOINTS.index(joint.split("_")[0]) for joint in UPPER_BODY]]
