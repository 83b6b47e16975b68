"""Weigh particles over body poses by keypoints: of every particle's joints, in all cameras at once.

With z_cj the keypoint of joint j in camera c, h_c the projection and q the prior probability that left and
right of a group g (arms, legs) are exchanged in a camera,

    log p(z | x) = k sum_c sum_g log( (1 - q) prod_{j in g} p(z_cj | x) + q prod_{j in g} p(z_cj' | x) ),
    p(z_cj | x) = pi N(z_cj; h_c(p_j(x)), (r + m f^2 / depth^2) I) + (1 - pi) / a,

with j' the joint on the other side. Joints in the middle are a group without exchange, and missing keypoints
are left out. The exponent k makes up for errors of a detector that cameras, joints and frames share, and
keeps particles alive: a few hundred cannot cover a likelihood that is as sharp as that of all keypoints.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.body._kinematics import Body
from torchpose.body._skeleton import BODY_15
from torchpose.math._rotations import quaternion_vector_to_matrix, within_unit_ball
from torchpose.math._unscented import floor_eigenvalues, sigma_points
from torchpose.whole_body._keypoints.keypoint_likelihood import (
    Beliefs,
    KeypointFrame,
    RigMaps,
    Seen,
    Weighed,
    exchange_of,
    information,
    readings_of,
    see,
    weigh,
)

_POWER = 0.1  # k
_LOG_ODDS = -3.0  # of exchanged sides in a camera and frame
_ROOT = 6  # columns of a state: position and orientation of the root


class KeypointMeasurement(NamedTuple):
    """Holds the keypoints of one frame of B persons, and the cameras that see them.

    Attributes:
        frame: keypoints [B, C, J, ...] of `BODY_15`'s joints. maps: of the C cameras. power: the exponent k.
    """

    frame: KeypointFrame
    maps: RigMaps
    power: float = _POWER

    @property
    def seen(self) -> Bool[Tensor, " B"]:
        """Return whether there is any keypoint."""
        return self.frame.there.flatten(1).any(1)


def keypoint_log_likelihood(
    measured: KeypointMeasurement, joints: Float[Tensor, "B N J 3"]
) -> Float[Tensor, "B N"]:
    """Return k times the log-likelihood of keypoints, given the joints of particles.

    Args:
        measured: the keypoints of a frame. joints: metres, world axes.

    Returns:
        [B, N], float64; 0 in elements without a keypoint. No keypoint, however far off, lowers it by more
        than the density of outliers does.
    """
    weighed = _weighed(measured, joints)[2]
    return measured.power * weighed.log_evidence.view(joints.shape[:2])


def limbs_given_keypoints(
    measured: KeypointMeasurement,
    body: Body,
    states: Float[Tensor, "B N D"],
    mean: Float[Tensor, "B N V 3"],
    covariance: Float[Tensor, "B N V 3 3"],
    least_std: float = 0.0,
) -> tuple[Float[Tensor, "B N V 3"], Float[Tensor, "B N V 3 3"]]:
    """Return the Gaussians of the parts' rotations, given the keypoints of the joints that each part carries.

    A joint is linear in the part that carries it: with S = L L^T, the sigma points of the part give L and
    H = dp/dx L. From W and b of the keypoints (`information`) follow

        A = I + sum_j H_j^T W_j H_j,   mu_obs = mu + L A^-1 sum_j H_j^T b_j,   S_obs = L A^-1 L^T.

    Where a joint is carried by several parts, those nearer to the root stay at their means.

    Args:
        measured: the keypoints of a frame. body: with ``frame="body"``. states: with the means of the parts.
        mean, covariance: of the V = P - 1 parts that are not the root, quaternion vectors.
        least_std: least standard deviation in any direction.
    """
    joints = body.joints(states)
    carried, part = _carried(body)
    points = sigma_points(mean, covariance)
    apart = 2 * math.sqrt(points.shape[-1])
    factor = (points[..., :3, :] - points[..., 3:, :]).mT / apart  # L, by columns
    root = quaternion_vector_to_matrix(states[..., None, 3:_ROOT])
    turns = (root @ body.centre_rotations[1:])[..., None, :, :]
    turns = turns @ quaternion_vector_to_matrix(within_unit_ball(points))
    moved = (turns[..., :3, :, :] - turns[..., 3:, :, :])[:, :, part] / apart
    offsets = body.joint_weights[_ROOT // 2 :].unflatten(0, (-1, 3))[part, :, carried]
    by_point = (moved @ offsets[:, None, :, None]).squeeze(-1).mT  # H [B, N, J', 3, 3]
    by_point = by_point.to(measured.maps.shift)
    # predicted where the part may be, a keypoint that is off by that much is no outlier
    spread = by_point.new_zeros(*joints.shape, 3)
    spread[:, :, carried] = by_point @ by_point.mT
    matrix, pull = information(*_weighed(measured, joints, spread))
    matrix, pull = matrix.view(spread.shape), pull.view(joints.shape)
    gained = by_point.mT @ matrix[:, :, carried] @ by_point
    pulled = (by_point.mT @ pull[:, :, carried, :, None]).squeeze(-1)
    eye = torch.eye(3).to(matrix).expand(*covariance.shape).clone()
    root_a = torch.linalg.cholesky(eye.index_add(2, part, gained))
    summed = torch.zeros_like(mean, dtype=matrix.dtype).index_add(2, part, pulled)
    factor = factor.to(matrix)
    new_mean = mean + (factor @ torch.cholesky_solve(summed[..., None], root_a)).squeeze(-1)
    half = torch.linalg.solve_triangular(root_a, factor.mT, upper=False)
    new_cov = floor_eigenvalues(half.mT @ half, least_std**2)
    return within_unit_ball(new_mean.to(mean)), new_cov.to(covariance)


def _weighed(
    measured: KeypointMeasurement,
    joints: Float[Tensor, "B N J 3"],
    joint_cov: Float[Tensor, "B N J 3 3"] | None = None,
) -> tuple[KeypointFrame, Seen, Weighed]:
    """Return both readings of keypoints for every particle, its joints in the cameras, and the weights."""
    batch, n = joints.shape[:2]
    maps, exchange = measured.maps, exchange_of(BODY_15, measured.maps.shift.device)
    readings = readings_of(measured.frame, exchange).map(
        lambda v: v[:, :, None].expand(-1, -1, n, *v.shape[2:]).flatten(1, 2)
    )
    seen = see(maps, joints.flatten(0, 1).to(maps.shift))
    new = maps.shift.new_full
    n_cameras = len(maps.shift)
    beliefs = Beliefs(new((batch * n, n_cameras, 2), _LOG_ODDS), new((batch * n, n_cameras), 1.0))
    spread = None if joint_cov is None else joint_cov.flatten(0, 1)
    weighed = weigh(readings, seen, maps, beliefs, exchange, spread, marginal=spread is not None)
    return readings, seen, weighed


def _carried(body: Body) -> tuple[Tensor, Tensor]:
    """Return the joints that parts but the root carry, and the places of those parts without the root."""
    part = torch.tensor(body.skeleton.part_of, device=body.offsets.device)
    joints = (part > 0).nonzero().squeeze(-1)
    return joints, part[joints] - 1
