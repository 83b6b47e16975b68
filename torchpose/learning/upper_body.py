"""Fit of an upper-body prior: a mixture per arm over poses seen from random viewpoints (BL 3.1)."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

from torchpose.camera.pinhole import PinholeCamera
from torchpose.camera.viewpoints import ViewRange
from torchpose.errors import PriorError
from torchpose.learning.samplers import ArmSource, all_samples
from torchpose.learning.training import TRAINING_VIEWS, RecordingLike, arm_sources, collect_poses
from torchpose.priors.arm_state import check_rotation_order, mirror_mixture
from torchpose.priors.gaussian_mixture import GaussianMixture
from torchpose.priors.prior_file import PriorInfo
from torchpose.priors.upper_body import UpperBodyPrior

__all__ = ["fit_upper_body_prior", "prior_of_arms"]

_KINECT_CAMERA = (525.0, 525.0, 319.5, 239.5)


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
    **fit_options: Any,
) -> UpperBodyPrior:
    """Fit a prior to recorded 3D poses seen from random viewpoints (BL section 3.1).

    Args:
        recordings: in camera axes (`torchpose.io.read_recordings`).
        n_components: Gaussians per arm.
        seed: of viewpoints and start.
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
        fit_options: to `GaussianMixture.fit`: n_init, max_iter, tol, covariance_floor, init.

    Raises:
        InputError: no recordings or no complete frames. PriorError: kinds of joints that cannot be
            mixed, unknown rotation order.
    """
    check_rotation_order(rotation_order)
    camera = camera or PinholeCamera(*_KINECT_CAMERA, width=640, height=480)
    (fx, skew, cx), (_, fy, cy), _ = camera.matrix.tolist()
    if skew:
        raise PriorError(f"the camera of a prior must have no skew, got {skew:g} pixels")
    poses = collect_poses(recordings, neck, centre, nose_as_head)
    sources = arm_sources(
        poses, camera.matrix, seed, views, rotation_order, mirror, n_samples, views_per_pose
    )
    options: dict[str, Any] = {"n_components": n_components, "seed": seed}
    options |= {"progress": progress} | fit_options
    left = _fit_arm(sources.left, options)
    right = None if sources.right is None else _fit_arm(sources.right, options)
    info = PriorInfo(
        name=name, rotation_order=rotation_order, fx=fx, fy=fy, cx=cx, cy=cy, licence=licence,
        command=command, views=asdict(views), **sources.facts,
    )  # fmt: skip
    return prior_of_arms(left, right, info, seed)


def _fit_arm(source: ArmSource, options: dict[str, Any]) -> GaussianMixture:
    states, weight = all_samples(source)
    return GaussianMixture.fit(states, sample_weight=weight, **options)


def prior_of_arms(
    left: GaussianMixture, right: GaussianMixture | None, info: PriorInfo, seed: int
) -> UpperBodyPrior:
    """Prior of fitted mixtures over poses; a right arm of None is the left one's mirror image.

    Args:
        left, right: mixtures with their `fit_report`, if they were fitted. info: what they were
            fitted on. seed: of the fit.
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
