"""Follow a person whom one of several cameras sees by that camera, as if there were no other."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.body._skeleton import BODY_15
from torchpose.whole_body._keypoints.body_kalman import BodyGaussian
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame
from torchpose.whole_body._keypoints.keypoint_poses import (
    KeypointPoses,
    KeypointStep,
    KeypointStream,
)
from torchpose.whole_body._keypoints.nested import mapped

NOBODY = -1
"""In place of the camera that alone sees a person, where there is none."""
_TOGETHER = 16.3  # squared standard deviations within which 99.9 % of places in the room are
_PELVIS = BODY_15.joint("pelvis")


class LoneNoise(NamedTuple):
    """Holds the noise of keypoints that no other camera corrects.

    Attributes:
        widening: factor of the variance that goes with the body, against that of several cameras.
        lasting_std: metres, of what frames do not average out.
    """

    widening: float
    lasting_std: float


SAME_NOISE = LoneNoise(1.0, 0.0)


def frame_of(frame: KeypointFrame, camera: int, widening: float) -> KeypointFrame:
    """Return the keypoints [B, 1, J] of one camera, the noise that goes with the body widened."""
    one = frame.map(lambda value: value[:, [camera]])
    return one._replace(relative=widening * one.relative)


def stream_of(stream: KeypointStream, camera: int) -> KeypointStream:
    """Return a stream as one camera has it for which there is no other."""
    both = _by_cameras(stream.state), stream.memory
    (log_odds, scale, told), memory = mapped(lambda every: every[:, [camera]], both)
    state = stream.state._replace(log_odds=log_odds, scale=scale, told=told)
    return stream._replace(state=state, alone=torch.full_like(stream.alone, NOBODY), memory=memory)


def step_by_one(step: KeypointStep, by_one: KeypointStep, camera: int) -> KeypointStep:
    """Return a frame by all cameras with what one camera by itself gave in its place.

    Args:
        step: by all cameras. by_one: by that one. camera: its number.
    """

    def into_all(every: Float[Tensor, "B C *N"], one: Float[Tensor, "B 1 *N"]) -> Tensor:
        return every.index_copy(1, torch.tensor([camera], device=every.device), one)

    stream, pose, found = step
    after, one, found_by_one = by_one
    log_odds, scale, told = mapped(
        into_all, _by_cameras(found.state), _by_cameras(found_by_one.state)
    )
    state = found_by_one.state._replace(log_odds=log_odds, scale=scale, told=told)
    alone = torch.full_like(stream.alone, camera)
    stream = stream._replace(
        state=state,
        begun=after.begun,
        lost=after.lost,
        alone=alone,
        memory=mapped(into_all, stream.memory, after.memory),
        still=after.still,
    )
    pose = one._replace(
        inlier=into_all(torch.zeros_like(pose.inlier), one.inlier),
        exchanged=into_all(pose.exchanged, one.exchanged),
        alone=alone,
        turn=pose.turn,
        off=pose.off,
        scale=scale,
    )
    return stream, pose, found_by_one._replace(state=state, weighed=found.weighed)


def are_together(poses: KeypointPoses, others: KeypointPoses) -> Bool[Tensor, " B"]:
    """Return which bodies are at the same places as others, by the covariances of both."""
    apart = (poses.joints - others.joints)[:, _PELVIS]
    cov = (poses.covariance + others.covariance)[:, _PELVIS]
    return (apart * torch.linalg.solve(cov, apart)).sum(-1) < _TOGETHER


def _by_cameras(state: BodyGaussian) -> tuple[Tensor, Tensor, Tensor]:
    """Return what is believed of each camera."""
    return state.log_odds, state.scale, state.told
