"""Track a whole body through silhouettes that come frame by frame."""

from collections.abc import Iterable

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from tqdm.auto import tqdm

from torchpose.body.kinematics import Body
from torchpose.camera.rig import Cameras
from torchpose.errors import InputError
from torchpose.filters.base import Generators
from torchpose.whole_body.filters.body_particles import stack_tracks
from torchpose.whole_body.filters.joint_spread import joint_covariance
from torchpose.whole_body.filters.silhouette_filter import SilhouetteParticleFilter
from torchpose.whole_body.poses import BodyPoses

__all__ = ["joint_covariance", "track_body"]


@torch.no_grad()
def track_body(
    model: SilhouetteParticleFilter,
    frames: Iterable[Bool[Tensor, "C H W"]],
    cameras: Cameras,
    initial_state: Float[Tensor, " D"],
    generator: Generators = None,
    *,
    initial_std: Float[Tensor, " D"] | None = None,
    fps: float | None = None,
    n_frames: int | None = None,
    progress: bool = False,
) -> BodyPoses:
    """Track one person; memory holds the poses and a single frame.

    Args:
        model: a filter over silhouettes, whose body is a `torchpose.body.Body`.
        frames: silhouettes of the C cameras, frame after frame. cameras: theirs.
        initial_state: the pose before the first frame [D], recorded or from `find_first_pose`.
        generator: for what is drawn. initial_std: spread of the first particles [D]; none if None.
        fps: of the frames, for the result. n_frames: how many to expect, for the progress bar.
        progress: whether to show it.

    Returns:
        `BodyPoses` of as many frames as came, with the covariances that the filter gives their joints
        (`SilhouetteParticleFilter.joint_covariance`).

    Raises:
        InputError: no frame, or a filter without a body. CameraError, ShapeError: as the filter.
    """
    if not isinstance(model.body, Body):
        raise InputError(f"the filter must track a Body, got {type(model.body).__name__}")
    state, steps, covs = model.init(initial_state[None], generator, initial_std), [], []
    for silhouettes in tqdm(frames, total=n_frames, disable=not progress, unit="frame"):
        state, out = model.step(state, silhouettes[None], cameras, generator)
        steps.append(out)
        covs.append(model.joint_covariance(state, out.mean)[0])
    if not steps:
        raise InputError("there must be at least one frame of silhouettes, got none")
    track = stack_tracks(steps).element(0)
    return BodyPoses(
        model.body, track.mean, track.std, model.body.joints(track.mean), torch.stack(covs),
        track.log_evidence, track.effective_sample_size, track.coasting, track.respread, fps,
        details=track.details,
    )  # fmt: skip
