"""Find what is wrong with one camera: its pose, its focal length or its lens, with the joints eliminated.

A camera with errors e = (w, s, a, k) sees a joint p at

    u = K (g x, g y, 1),   X = exp(w) (R p + t) + s,   x, y = X_12 / X_3,   g = e^a (1 + k (x^2 + y^2)),

with w a rotation, s a shift, a the log of the factor of the focal length, k a radial distortion. Unknown are
the joints of some frames, and those errors of one camera that are free. Steps of Gauss and Newton minimise

    nu/2 sum_tcj pi log(1 + |z - u|^2 / (nu R)) + e^T L e / 2

for all explanations side by side, with noise R that is wide at first.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.camera._rig import CameraRig
from torchpose.math._rotations import rotvec_to_matrix
from torchpose.whole_body._keypoints.joint_triangulation import triangulate_all
from torchpose.whole_body._keypoints.keypoint_likelihood import (
    LEAST_DEPTH,
    KeypointFrame,
    RigMaps,
)

TURN, SHIFT, FOCAL, LENS = slice(0, 3), slice(3, 6), slice(6, 7), slice(7, 8)
_STD = (0.1,) * 3 + (0.03,) * 3 + (0.1, 0.15)  # radians, metres, log of a factor, of a square
_N_ERRORS = len(_STD)
_KNOWN = 1e12  # information about errors that are not free
_FREEDOM = 4.0  # nu, of Student's distribution of the errors
_WIDTHS = (100.0, 30.0, 10.0, 4.0, 2.0, *[1.0] * 5)
_JOINT_STD = 5.0  # metres, of a joint about where it is; tells where no two cameras do


class Explained(NamedTuple):
    """Holds what N explanations give.

    Attributes:
        errors: [N, 8], of the camera that each is about. misfit: [N, T, C, J], what keypoints take from the
            log-evidence. price: [N], what the errors take.
    """

    errors: Tensor
    misfit: Tensor
    price: Tensor


class _Views(NamedTuple):
    """Holds pixels [..., C, J, 2], their derivatives by points in camera axes, and what is needed for more."""

    pixels: Tensor
    by_point: Tensor
    points: Tensor
    rays: Tensor
    in_front: Tensor


def explain(
    rig: CameraRig,
    frames: KeypointFrame,
    camera: Int[Tensor, " N"],
    free: Bool[Tensor, "N 8"],
) -> Explained:
    """Return the errors of one camera in each of N explanations of some frames.

    Args:
        rig: two cameras or more. frames: keypoints [N, T, C, J]. camera: that is wrong.
        free: which of its errors are estimated.
    """
    rows = torch.arange(len(camera), device=camera.device)
    errors = frames.pixels.new_zeros(len(camera), _N_ERRORS)
    prior = torch.tensor(_STD).to(errors).square().reciprocal()
    prior = torch.where(free, prior, _KNOWN)
    joints = _first_joints(rig, frames, camera, free)
    R = rig.rotation.to(joints)
    for width in _WIDTHS:
        views = _seen(rig, joints, rows, camera, errors)
        off, variance = _residuals(frames, views)
        weight = frames.inlier * views.in_front / (width * variance + off.square().sum(-1) / _FREEDOM)
        root = weight.sqrt()[..., None]
        A, r = root[..., None] * (views.by_point @ _turned(R, rows, camera, errors)[:, None, :, None]), root * off
        B = (root[..., None] * _by_errors(rig, views, rows, camera, errors))[rows, :, camera]
        A_own, r_own = A[rows, :, camera], r[rows, :, camera]
        W = (A.mT @ A).sum(2) + torch.eye(3).to(A) / _JOINT_STD**2
        b = (A.mT @ r[..., None]).sum(2)
        E = A_own.mT @ B
        chol = torch.linalg.cholesky(W)
        solved = torch.linalg.solve_triangular(chol, torch.cat([E, b], -1), upper=False)
        X, y = solved[..., :-1], solved[..., -1:]
        S = (B.mT @ B - X.mT @ X).sum((1, 2)) + torch.diag_embed(prior)
        g = (B.mT @ r_own[..., None] - X.mT @ y).sum((1, 2)).squeeze(-1) - prior * errors
        step = torch.cholesky_solve(g[..., None], torch.linalg.cholesky((S + S.mT) / 2))
        joints = joints + torch.cholesky_solve(b - E @ step[:, None, None], chol).squeeze(-1)
        errors = torch.where(free, errors + step.squeeze(-1), 0.0)
    views = _seen(rig, joints, rows, camera, errors)
    off, variance = _residuals(frames, views)
    ratio = off.square().sum(-1) / variance / _FREEDOM
    ratio = torch.where(views.in_front, ratio, 1e6)
    misfit = _FREEDOM / 2 * frames.inlier * ratio.log1p()
    return Explained(errors, misfit, 0.5 * torch.where(free, prior * errors.square(), 0.0).sum(-1))


def _first_joints(
    rig: CameraRig, frames: KeypointFrame, camera: Tensor, free: Tensor
) -> Float[Tensor, "N T J 3"]:
    """Return joints by the other cameras, or by all where too few see them."""
    there = frames.inlier > 0
    own = torch.nn.functional.one_hot(camera, len(rig)).bool() & free.any(-1, keepdim=True)
    right = there & ~own[:, None, :, None]
    right = torch.where(right.sum(2, keepdim=True) >= 2, right, there)
    flat = frames.map(lambda value: value.flatten(0, 1))
    return triangulate_all(RigMaps.of(rig), flat, right.flatten(0, 1)).unflatten(0, there.shape[:2])


def _turned(R: Tensor, rows: Tensor, camera: Tensor, errors: Tensor) -> Float[Tensor, "N C 3 3"]:
    turned = R.expand(len(rows), -1, -1, -1).clone()
    turned[rows, camera] = rotvec_to_matrix(errors[:, TURN]) @ R[camera]
    return turned


def _seen(rig: CameraRig, joints: Tensor, rows: Tensor, camera: Tensor, errors: Tensor) -> _Views:
    """Return joints as cameras see them, one of which has errors."""
    R = _turned(rig.rotation, rows, camera, errors)
    t = rig.translation.expand(len(rows), -1, -1).clone()
    turn = rotvec_to_matrix(errors[:, TURN])
    t[rows, camera] = (turn @ t[rows, camera][..., None]).squeeze(-1) + errors[:, SHIFT]
    X = joints[:, :, None] @ R[:, None].mT + t[:, None, :, None]
    in_front = X[..., 2] > LEAST_DEPTH
    depth = torch.where(in_front, X[..., 2], 1.0)[..., None]
    rays = X[..., :2] / depth
    gain = _gain(rig, rays, rows, camera, errors)
    K = rig.matrix.to(joints)
    pixels = (rays * gain) @ K[:, :2, :2].mT + K[:, None, :2, 2]
    flat = torch.cat([torch.eye(2).to(rays).expand(*rays.shape, 2), -rays[..., None]], -1)
    by_point = K[:, None, :2, :2] @ flat * (gain / depth)[..., None]
    return _Views(pixels, by_point, X, rays, in_front)


def _gain(rig: CameraRig, rays: Tensor, rows: Tensor, camera: Tensor, errors: Tensor) -> Tensor:
    """Return the factors of rays [N, T, C, J, 1]."""
    own = torch.zeros(len(rows), len(rig), 2).to(errors)
    own[rows, camera] = errors[:, 6:]
    a, k = own[:, None, :, None].split(1, -1)
    return a.exp() * (1 + k * rays.square().sum(-1, keepdim=True).clamp_max(1.0))


def _by_errors(
    rig: CameraRig, views: _Views, rows: Tensor, camera: Tensor, errors: Tensor
) -> Float[Tensor, "N T C J 2 8"]:
    """Return the derivative of pixels by errors."""
    shift = torch.zeros(len(rows), len(rig), 3).to(errors)
    shift[rows, camera] = errors[:, SHIFT]
    turned = views.points - shift[:, None, :, None]
    by_turn = torch.linalg.cross(turned[..., None, :], views.by_point)
    K = rig.matrix.to(errors)[:, None, :2, :2]
    square = views.rays.square().sum(-1, keepdim=True).clamp_max(1.0)
    scaled = (K @ views.rays[..., None])
    by_focal = scaled * _gain(rig, views.rays, rows, camera, errors)[..., None]
    by_lens = scaled * square[..., None]
    return torch.cat([by_turn, views.by_point, by_focal, by_lens], -1)


def _residuals(frames: KeypointFrame, views: _Views) -> tuple[Tensor, Tensor]:
    off = frames.pixels - views.pixels
    return off, frames.variance + frames.relative * 0.5 * views.by_point.square().sum((-2, -1))
