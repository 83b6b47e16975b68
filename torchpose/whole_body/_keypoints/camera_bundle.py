"""Adjust cameras and delays to the keypoints of a moving body, with its joints eliminated.

The keypoint of joint j in frame t of camera c is u = h(exp(w_c) (R_c p + t_c) + s_c) with p the joint at
t - d_c, p_j(t) - d_c v_j(t). Unknown are the joints p_j(t), and of every camera its errors
e_c = (w_c, s_c, d_c): a small rotation, a shift in the camera's axes and a delay. One step of Gauss and
Newton solves the normal equations of the errors alone,

    S = sum B^T R^-1 B + L - sum_tj E^T W^-1 E,   W = sum_c A^T R^-1 A,   E = A^T R^-1 B,

with A and B the derivatives of pixels by joints and by errors, noise R over the probability that a keypoint
is its joint's, and L the information of a prior that cameras are about right. It decides what pixels do not
tell: where all cameras are in the room together, and how large it is.
"""

from collections.abc import Sequence
from typing import NamedTuple, Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.camera._rig import CameraRig
from torchpose.math._gaussian import safe_cholesky
from torchpose.math._rotations import rotvec_to_matrix
from torchpose.whole_body._keypoints.joint_elimination import JOINT_STD, eliminated
from torchpose.whole_body._keypoints.keypoint_likelihood import (
    LEAST_DEPTH,
    NOISE_SCALES,
    Beliefs,
    Exchange,
    KeypointFrame,
    RigMaps,
    Seen,
    Weighed,
    by_point,
    readings_of,
    squared_errors,
    weigh,
)

N_ERRORS = 7  # of a camera: rotation, shift, delay
ROTATION_STD, SHIFT_STD = 0.0175, 0.03  # radians, metres
_EXCHANGED = -3.5  # prior log-odds of exchanged sides


class CameraErrors(NamedTuple):
    """Holds the errors of C cameras.

    Attributes:
        values: [C, 7], rotation (radians) and shift (metres) in camera axes, and delay (frames).
        cov: [7 C, 7 C], their covariance; 0 for those that were not estimated.
    """

    values: Tensor
    cov: Tensor

    @classmethod
    def none(cls, rig: CameraRig) -> Self:
        """Return no errors."""
        n = N_ERRORS * len(rig)
        return cls(rig.matrix.new_zeros(len(rig), N_ERRORS), rig.matrix.new_zeros(n, n))

    @property
    def std(self) -> Float[Tensor, "C 7"]:
        """Return standard deviations."""
        return self.cov.diagonal().clamp_min(0).sqrt().view_as(self.values)


class BundleInputs(NamedTuple):
    """Holds what cameras are adjusted to.

    Attributes:
        frames: keypoints [T, C, J]. joints, velocity: [T, J, 3], metres, and metres a frame.
        shifts: [C], frames by which keypoints were shifted already, which the delays include.
        free: [C, 7], which errors are estimated. delay_std: frames, of delays before they are estimated.
        block: frames within which errors of a joint's keypoints go together. exchange: of sides.
    """

    frames: KeypointFrame
    joints: Tensor
    velocity: Tensor
    shifts: Tensor
    free: Tensor
    delay_std: float
    block: int
    exchange: Exchange


class Adjusted(NamedTuple):
    """Holds what an adjustment gives.

    Attributes:
        errors: of the cameras. price: what free errors cost in log-evidence, by Laplace's approximation:
            e^T L e / 2 + log det(S L^-1) / 2.
    """

    errors: CameraErrors
    price: float


class _Equations(NamedTuple):
    """Holds the normal equations of joints and of the errors of the F cameras that have free ones.

    Attributes:
        chol: factors of W [T, J, 3, 3]. E: [T, J, 3, 7 F]. b: [T, J, 3, 1]. S: [7 F, 7 F].
        g: [T, J, 7 F].
    """

    chol: Tensor
    E: Tensor
    b: Tensor
    S: Tensor
    g: Tensor


def corrected_pose(
    rig: CameraRig, values: Float[Tensor, "C 7"]
) -> tuple[Float[Tensor, "C 3 3"], Float[Tensor, "C 3"]]:
    """Return rotations and translations of cameras without their errors."""
    turn = rotvec_to_matrix(values[:, :3])
    return turn @ rig.rotation, (turn @ rig.translation[..., None]).squeeze(-1) + values[:, 3:6]


def adjust(
    rig: CameraRig, given: BundleInputs, start: CameraErrors, widths: Sequence[float]
) -> Adjusted:
    """Return the errors of cameras after a step of Gauss and Newton for every width of the noise.

    Args:
        rig: the cameras as they were given. given: keypoints and joints. start: errors to begin with.
        widths: factors of the noise's variance, falling to 1.
    """
    values, joints = start.values, given.joints
    scale = values.new_ones(len(rig))
    readings, maps = readings_of(given.frames, given.exchange), RigMaps.of(rig)
    moving = given.free.any(-1)
    cameras = moving.nonzero().squeeze(-1).to(values.device)
    prior, free = _information(given, len(cameras)), given.free[moving].flatten()
    joint_cov: Tensor | None = None
    for width in widths:
        seen, by_errors = _seen(rig, values, joints, given.velocity, given.shifts, cameras)
        weighed, scale = _weighed(given, readings, maps, seen, joint_cov, scale, width)
        chol, E, b, S, g = _equations(given, seen, by_errors, weighed, joints, prior, cameras)
        L = safe_cholesky(S[free][:, free])
        pull = g.sum((0, 1)) - prior * values[cameras].flatten()
        step = torch.zeros_like(pull)
        step[free] = torch.cholesky_solve(pull[free, None], L).squeeze(-1)
        moved = torch.cholesky_solve(b - E @ step[:, None], chol).squeeze(-1)
        values = values.index_add(0, cameras, step.view(-1, N_ERRORS))
        joints = joints + moved
        joint_cov = torch.cholesky_inverse(chol)
    cov = torch.zeros_like(start.cov)
    rows = given.free.flatten().nonzero().squeeze(-1)
    cov[rows[:, None], rows] = _covariance(given, g[..., free], prior[free], L)
    spent = (prior * values[cameras].flatten().square())[free].sum() / 2
    narrowed = L.diagonal().log().sum() - prior[free].log().sum() / 2
    return Adjusted(CameraErrors(values, cov), float(spent + narrowed))


def _information(given: BundleInputs, n_cameras: int) -> Float[Tensor, " F7"]:
    """Return the information of the prior about errors."""
    std = [ROTATION_STD] * 3 + [SHIFT_STD] * 3 + [given.delay_std]
    return torch.tensor(std).to(given.joints).square().reciprocal().repeat(n_cameras)


def _weighed(
    given: BundleInputs,
    readings: KeypointFrame,
    maps: RigMaps,
    seen: Seen,
    joint_cov: Tensor | None,
    scale: Float[Tensor, " C"],
    width: float,
) -> tuple[Weighed, Float[Tensor, " C"]]:
    """Return the weights of keypoints, and the next factors of the cameras' noise."""
    count, n_cameras = given.frames.inlier.shape[:2]
    beliefs = Beliefs(scale.new_full((count, n_cameras, 2), _EXCHANGED), scale.expand(count, -1))
    weighed = weigh(
        readings, seen, maps, beliefs, given.exchange, joint_cov, decide=width < 2, width=width
    )
    if joint_cov is None:
        return weighed, scale
    sums, number = squared_errors(readings, seen, weighed, joint_cov)
    ratio = sums.sum(0) / number.sum(0).clamp_min(1e-6) * width
    return weighed, (scale * ratio).clamp(*NOISE_SCALES)


def _equations(
    given: BundleInputs,
    seen: Seen,
    by_errors: Float[Tensor, "T F J 2 7"],
    weighed: Weighed,
    joints: Float[Tensor, "T J 3"],
    prior: Float[Tensor, " F7"],
    cameras: Int[Tensor, " F"],
) -> _Equations:
    """Return the normal equations with joints eliminated."""
    root = (weighed.own / weighed.variance).sqrt()[..., None]
    A, r = root[..., None] * seen.by_joint, root * (given.frames.pixels - seen.pixels)
    B = root[:, cameras, ..., None] * by_errors
    E = (A[:, cameras].mT @ B).permute(0, 2, 3, 1, 4).flatten(-2)
    g = (r[:, cameras, ..., None, :] @ B).squeeze(-2).transpose(1, 2).flatten(-2)
    A, r = A.transpose(1, 2).flatten(2, 3), r.transpose(1, 2).flatten(2)[..., None]
    b = A.mT @ r + (given.joints - joints)[..., None] / JOINT_STD**2
    chol, Y, y = eliminated(A, E, b)
    B, rows = B.transpose(0, 1).flatten(1, 3), Y.flatten(0, 2)
    S = torch.block_diag(*(B.mT @ B)) + torch.diag(prior) - rows.T @ rows
    return _Equations(chol, E, b, S, g - (Y.mT @ y).squeeze(-1))


def by_pose(rig: CameraRig, joints: Float[Tensor, "T J 3"]) -> Float[Tensor, "T C J 2 6"]:
    """Return the derivative of pixels by rotation and shift of the cameras that see them."""
    none = CameraErrors.none(rig).values
    every = torch.arange(len(rig), device=none.device)
    _, by_errors = _seen(rig, none, joints, torch.zeros_like(joints), none[:, 0], every)
    return by_errors[..., : N_ERRORS - 1]


def _seen(
    rig: CameraRig,
    values: Float[Tensor, "C 7"],
    joints: Float[Tensor, "T J 3"],
    velocity: Float[Tensor, "T J 3"],
    shifts: Float[Tensor, " C"],
    cameras: Int[Tensor, " F"],
) -> tuple[Seen, Float[Tensor, "T F J 2 7"]]:
    """Return joints as cameras see them, and for some cameras the derivative by their errors."""
    R, t = corrected_pose(rig, values)
    late = (values[:, 6] - shifts)[:, None, None]
    moved = joints[:, None] - late * velocity[:, None]
    X = moved @ R.mT + t[:, None]
    depth = X[..., 2]
    in_front = depth > LEAST_DEPTH
    depth = torch.where(in_front, depth, 1.0)[..., None]
    pixels = (X @ rig.matrix.mT)[..., :2] / depth
    by_joint = by_point(rig.matrix @ R, pixels, depth)
    by_shift = by_point(rig.matrix[cameras], pixels[:, cameras], depth[:, cameras])
    turned = X[:, cameras] - values[cameras, None, 3:6]
    by_turn = torch.linalg.cross(turned[..., None, :], by_shift)
    by_delay = -(by_joint[:, cameras] * velocity[:, None, :, None]).sum(-1, keepdim=True)
    return Seen(pixels, by_joint, in_front), torch.cat([by_turn, by_shift, by_delay], -1)


def _covariance(
    given: BundleInputs,
    g: Float[Tensor, "T J N"],
    prior: Float[Tensor, " N"],
    L: Float[Tensor, "N N"],
) -> Float[Tensor, "N N"]:
    """Return the covariance of errors, S^-1 (sum_b g_b g_b^T + L) S^-1, b joints over a second.

    Keypoints of a joint err alike from frame to frame, which S^-1 would not know.
    """
    groups = torch.stack([part.sum(0) for part in g.split(given.block)]).flatten(0, 1)
    meat = groups.mT @ groups + torch.diag(prior)
    return torch.cholesky_solve(torch.cholesky_solve(meat, L).mT, L)
