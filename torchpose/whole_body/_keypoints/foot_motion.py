"""Describe the state of feet beyond tracked shanks, its prior, and how it goes on.

The state of each foot is a Gaussian vector of 21 numbers about zero. In this order:

    turn       3     rotation vector x of the foot from the one that the pose of the legs lets expect, radians
    rate       3     of these, per second
    shape      9     heel and toes from where an average foot has them, lengths of the shank, foot axes
    errors     6     of the shank's rotation and the ankle's place as the body was tracked, whitened

All of it is stationary: a foot that nothing is seen of comes out with its prior. Turns are critically damped
(`FootPrior`). The errors of the body are units of its own covariance, which last for some frames, so that
the keypoints of a foot are not taken for news about the foot alone.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.body._feet import foot_shape
from torchpose.priors._foot_prior import FootPrior

TURN, RATE, SHAPE, ERRORS = slice(0, 3), slice(3, 6), slice(6, 15), slice(15, 21)
N_FOOT = 21
_SIZE_STD = 0.06  # of the log of a foot's size relative to the shank
_SHAPE_STD = (0.03, 0.05, 0.04)  # lengths of the shank, outwards, upwards, forwards
_SHAPE_TIME = 5.0  # seconds, since toes bend
_ERROR_TIME = 0.1  # seconds


class FootMotion(NamedTuple):
    """Holds the model of one frame.

    Attributes:
        matrix: [N, N]. noise: [2, N, N], of left and right feet. cov: [2, N, N], of the prior.
        shape: [2, 3, 3], points of average feet, lengths of the shank, foot axes.
    """

    matrix: Tensor
    noise: Tensor
    cov: Tensor
    shape: Tensor


def foot_motion(prior: FootPrior, dt: float) -> FootMotion:
    """Return the model of a frame of dt seconds.

    Turns: with r the rate and a = exp(-r dt), [x; v]' = a [1 + r dt, dt; -r^2 dt, 1 - r dt] [x; v]. The noise
    of all is what keeps the covariance P of the prior, P - F P F^T.
    """
    std, rate = prior.turn_std, prior.turn_rate
    shape = foot_shape().to(std)
    matrix = torch.zeros(N_FOOT, N_FOOT, dtype=std.dtype, device=std.device)
    keep = torch.exp(-rate * dt)
    turn, velocity = torch.arange(3), torch.arange(3, 6)
    matrix[turn, turn] = keep * (1 + rate * dt)
    matrix[turn, velocity] = keep * dt
    matrix[velocity, turn] = -keep * rate.square() * dt
    matrix[velocity, velocity] = keep * (1 - rate * dt)
    for columns, time in ((SHAPE, _SHAPE_TIME), (ERRORS, _ERROR_TIME)):
        own = torch.arange(columns.start, columns.stop)
        matrix[own, own] = math.exp(-dt / time)
    cov = torch.zeros(2, N_FOOT, N_FOOT, dtype=std.dtype, device=std.device)
    cov[:, TURN, TURN] = std.square().diag()
    cov[:, RATE, RATE] = (std * rate).square().diag()
    size = shape.flatten(1)
    spread = std.new_tensor(_SHAPE_STD).repeat(3).square().diag()
    cov[:, SHAPE, SHAPE] = spread + _SIZE_STD**2 * size[:, :, None] * size[:, None]
    cov[:, ERRORS, ERRORS] = torch.eye(6).to(std)
    return FootMotion(matrix, cov - matrix @ cov @ matrix.mT, cov, shape)


class Legs(NamedTuple):
    """Holds what a tracked body tells of both feet.

    Attributes:
        ankle: [..., 2, 3], metres. shank: [..., 2, 3, 3], world axes.
        centre: [..., 2, 3], expected rotation vectors of feet relative to shanks, radians.
        turn_root, ankle_root: [..., 2, 3, 3], Cholesky factors of the covariances of the shank's rotation
            and of the ankle, world axes. length: [..., 2], of the shanks, metres.
        more: [..., 2, 3, 3], covariance of the ankle that frames do not average out.
    """

    ankle: Tensor
    shank: Tensor
    centre: Tensor
    turn_root: Tensor
    ankle_root: Tensor
    length: Tensor
    more: Tensor
