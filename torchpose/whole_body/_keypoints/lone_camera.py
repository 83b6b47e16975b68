"""Follow a person whom one of several cameras sees by that camera, as if there were no other.

A body that is larger and farther away by the same factor looks the same. With the deviation s of the log of
persons' sizes and the place c of the camera, the covariance of a joint p gets s^2 (p - c) (p - c)^T.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.whole_body._keypoints.body_kalman import BodyGaussian
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame, RigMaps

NOBODY = -1
"""In place of the camera that alone sees a person, where there is none."""


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


def state_of(state: BodyGaussian, camera: int) -> BodyGaussian:
    """Return Gaussians with what is believed of one camera."""
    log_odds, scale, told = (
        value[:, [camera]] for value in (state.log_odds, state.scale, state.told)
    )
    return state._replace(log_odds=log_odds, scale=scale, told=told)


def into_all(
    every: Float[Tensor, "B C *N"], one: Float[Tensor, "B 1 *N"], camera: int
) -> Float[Tensor, "B C *N"]:
    """Return values of all cameras with those of one in their place."""
    return every.index_copy(1, torch.tensor([camera], device=every.device), one)


def of_any_size(
    cov: Float[Tensor, "*batch J 3 3"],
    joints: Float[Tensor, "*batch J 3"],
    alone: Int[Tensor, "*batch"],
    maps: RigMaps,
    std: float,
) -> Float[Tensor, "*batch J 3 3"]:
    """Return covariances of joints that one camera sees with what it does not tell of their depth.

    Args:
        cov: metres squared. joints: metres. alone: the camera, -1 where there are several.
        maps: the cameras. std: of the log of persons' sizes.
    """
    away = std * (joints - maps.centre[alone.clamp_min(0)].unsqueeze(-2))
    wider = cov + away[..., None] * away[..., None, :]
    return torch.where((alone >= 0)[..., None, None, None], wider, cov)
