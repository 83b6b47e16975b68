"""Track one person with any filter over bodies, frame after frame."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from tqdm.auto import tqdm

from torchpose._core.former_arguments import takes_former_arguments
from torchpose.body._kinematics import Body
from torchpose.camera._rig import Cameras
from torchpose.errors import InputError
from torchpose.filters._recursive_filter import Generators
from torchpose.whole_body._body_track import BodyTrack
from torchpose.whole_body._filters.body_frames import check_observation
from torchpose.whole_body._filters.body_particles import BodyFilterState, stack_outputs
from torchpose.whole_body._filters.silhouette_filter import SilhouetteParticleFilter
from torchpose.whole_body._keypoints.particle_likelihood import KeypointMeasurement

_SEEN = 0.002  # of the image: fewer pixels are nobody


class Observed(NamedTuple):
    """Holds one frame of one person: silhouettes [C, H, W] or None, keypoints of one element or None."""

    silhouettes: Tensor | None
    keypoints: KeypointMeasurement | None = None


def which_see(silhouettes: Bool[Tensor, "C H W"]) -> Bool[Tensor, " C"]:
    """Return of which cameras the silhouette has more than 0.2 % of the frame's pixels."""
    return silhouettes.double().mean((-2, -1)) > _SEEN


@takes_former_arguments
@torch.no_grad()
def track_body(
    model: SilhouetteParticleFilter,
    frames: Iterable[Bool[Tensor, "C H W"]],
    cameras: Cameras,
    initial_state: Float[Tensor, " D"],
    *,
    generator: Generators = None,
    initial_cov: Tensor | float | None = None,
    fps: float | None = None,
    n_frames: int | None = None,
    progress: bool = False,
) -> BodyTrack:
    """Track one person with any filter; memory holds the poses and a single frame.

    Args:
        model: a filter over silhouettes, whose body is a `torchpose.body.Body`.
        frames: silhouettes of the C cameras, frame after frame. cameras: theirs.
        initial_state: the pose before the first frame [D], recorded or from `find_first_pose`.
        generator: of random numbers. initial_cov: variances of the first particles, as the filter's
            `process_cov`; none if None.
        fps: of the frames, for the result. n_frames: expected number of frames, for the progress bar.
        progress: whether to show it.

    Returns:
        `BodyTrack` of as many frames as came, with the covariances that the filter gives their joints
        (`SilhouetteParticleFilter.joint_covariance`).

    Raises:
        InputError: no frame, or a filter without a body. CameraError, ShapeError: as the filter.
    """
    body = getattr(model, "body", None)
    if not isinstance(model, SilhouetteParticleFilter) or not isinstance(body, Body):
        raise InputError(
            f"model must be a filter that tracks a Body, got {type(model).__name__} of "
            f"{type(body).__name__}"
        )
    state = model.init(initial_state[None], generator=generator, initial_cov=initial_cov)
    bar = tqdm(frames, total=n_frames, disable=not progress, unit="frame")
    poses = follow(model, state, map(Observed, bar), cameras, generator)[1]
    poses.fps = fps
    return poses


def follow(
    model: SilhouetteParticleFilter,
    state: BodyFilterState,
    frames: Iterable[Observed],
    cameras: Cameras,
    generator: Generators,
    first_frame: int = 0,
) -> tuple[BodyFilterState, BodyTrack]:
    """Return the state after some frames, and their poses."""
    steps, covs = [], []
    body: Any = model.body
    for silhouettes, keypoints in frames:
        outlined = None if silhouettes is None else silhouettes[None]
        if outlined is not None:
            check_observation(outlined, 1, generator, plain=not callable(model.likelihood))
        more = () if keypoints is None else (keypoints,)
        state, out = model.filter_frame(state, outlined, cameras, generator, *more)
        steps.append(out)
        covs.append(model.joint_covariance(state, out.mean)[0])
    if not steps:
        raise InputError("there must be at least one frame of silhouettes or keypoints, got none")
    batch = stack_outputs(steps)
    model.warn(batch)
    track = batch.element(0)
    poses = BodyTrack(
        body, track.mean, track.std, body.joints(track.mean), torch.stack(covs), track.log_evidence,
        track.effective_sample_size, track.coasting, track.respread,
        notes=model.notes(track, first_frame), first_frame=first_frame, details=track.details,
        action_names=model.action_names,
    )  # fmt: skip
    return state, poses
