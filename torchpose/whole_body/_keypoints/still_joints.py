"""Expect joints that stood still when they were last seen to stay where they are while they are hidden.

The noise of velocities is that of all motion on average, so by itself a foot on the floor would go on by the
noise of its last places. With the velocity v of a joint and its covariance V,

    log p / (1 - p) = log pi / (1 - pi) + log N(v; 0, V + s^2 I) - log N(v; 0, V + m^2 I)

are the odds that it stands still. While no camera has a keypoint of it, p decays within the time for which it
had stood: who stood for long will stand for longer, and a hand that turns about is still for no time.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.math._gaussian import log_prob
from torchpose.whole_body._keypoints.body_kalman import BodyGaussian, BodyKalmanFilter, Speeds
from torchpose.whole_body._keypoints.information_step import unit
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame
from torchpose.whole_body._keypoints.nested import replaced, taken

_STILL, _MOVING = 0.06, 0.7  # metres per second along every axis, standard deviations s and m
_PRIOR = 0.1  # pi
_HELD = 0.05  # seconds within which it would be known alone that a joint does not move
_LEAST = 0.01  # probability below which joints are left alone
_SHORT = 1e-6  # seconds, in place of none


class StillJoints(NamedTuple):
    """Holds how probable it is that joints stand still, and for how long they have, seconds, [B, J]."""

    probability: Tensor
    seconds: Tensor

    @staticmethod
    def none(like: Float[Tensor, "B J"]) -> "StillJoints":
        """Return joints of which nothing is known."""
        return StillJoints(torch.zeros_like(like), torch.zeros_like(like))

    def forgotten(self, rows: Bool[Tensor, " B"]) -> "StillJoints":
        """Return these, with nothing known of some persons."""
        return StillJoints(*(values.masked_fill(rows[:, None], 0.0) for values in self))

    def later(self, speeds: Speeds, seen: Bool[Tensor, "B J"], dt: float) -> "StillJoints":
        """Return what is known of joints one frame later.

        Args:
            speeds: of the joints. seen: which are. dt: seconds of a frame.
        """
        probability = _probability(speeds)
        stood = torch.where(probability > 0.5, self.seconds + dt, 0.0)
        left = self.probability * torch.exp(-dt / self.seconds.clamp_min(_SHORT))
        return StillJoints(
            torch.where(seen, probability, left), torch.where(seen, stood, self.seconds)
        )


def with_still_joints(
    filter: BodyKalmanFilter, state: BodyGaussian, still: StillJoints, frame: KeypointFrame
) -> BodyGaussian:
    """Return predictions in which joints that stood still and are hidden now hardly move.

    Velocities v of joints are measured as 0 with the variance s^2 + (1 - p) / p m^2 along every axis. Persons
    of whom nothing is seen are left alone: they may have gone.

    Args:
        filter: that predicted. state: the predictions. still: of the frame before. frame: the keypoints.
    """
    seen = frame.there.any(1)
    p = still.probability.masked_fill(seen | ~seen.any(-1, keepdim=True), 0.0)
    rows = (p > _LEAST).any(-1).nonzero().squeeze(-1)
    if not len(rows):
        return state
    p = p[rows]
    variance = _STILL**2 + (1 - p) / p.clamp_min(_SHORT) * _MOVING**2
    held = filter.held_still(taken(state, rows), variance, _HELD)
    return replaced(state, rows, held)


def _probability(speeds: Speeds) -> Float[Tensor, "B J"]:
    """Return how probable it is that joints stand still."""
    stds = speeds.cov.new_tensor([_STILL, _MOVING])[:, None, None, None, None]
    L = torch.linalg.cholesky(speeds.cov + stds.square() * unit(3, speeds.cov))
    nothing = torch.zeros_like(speeds.velocity)
    still, moving = log_prob(nothing, speeds.velocity, L)
    return (math.log(_PRIOR / (1 - _PRIOR)) + still - moving).sigmoid()
