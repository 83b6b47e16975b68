"""Find what is wrong with one camera: its pose, its focal length or its lens, with the joints eliminated.

A camera with errors e = (w, s, a, k) sees a joint p at

    u = K (g x, g y, 1),   X = exp(w) (R p + t) + s,   x, y = X_12 / X_3,   g = e^a (1 + k (x^2 + y^2)),

with w a rotation, s a shift, a the log of a factor of the focal length, and k a radial distortion. Unknown
are the joints of some frames, and those errors of one camera that are free. Steps of Gauss and Newton
minimise

    nu/2 sum_tcj pi log(1 + |z - u|^2 / (nu R)) + e^T L e / 2

for several explanations side by side, with noise R that is wide at first.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.camera._rig import CameraRig
from torchpose.math._gaussian import symmetrise
from torchpose.math._rotations import rotvec_to_matrix
from torchpose.whole_body._keypoints.joint_elimination import eliminated
from torchpose.whole_body._keypoints.joint_triangulation import triangulate_without
from torchpose.whole_body._keypoints.keypoint_likelihood import LEAST_DEPTH, KeypointFrame, RigMaps

N_CAUSES = 8
TURN, FOCAL, LENS = 3, 6, 7
"""How many errors are a rotation; the places of a and of k."""
POSE = 6
"""How many errors are a pose."""
_STD = (*[0.1] * 3, *[0.03] * 3, 0.1, 0.15)  # radians, metres, log of a factor, per square of a ray
_KNOWN = 1e12  # information about errors that are not free
_FREEDOM = 4.0  # nu, of Student's distribution of the errors
_WIDTHS = (100.0, 30.0, 10.0, 4.0, 2.0, *[1.0] * 5)
_WIDEST = 1.0  # square of a ray's tangent from which on the lens distorts no more
_BEHIND = 1e6  # square of the error of a keypoint whose joint is behind the camera


class Causes(NamedTuple):
    """Holds N explanations of what cameras see.

    Attributes:
        camera: [N], that is wrong. free: [N, 8], which of its errors are estimated.
    """

    camera: Tensor
    free: Tensor

    @classmethod
    def of(cls, causes: Sequence[tuple[int, Sequence[int]]], device: torch.device) -> "Causes":
        """Return the causes of cameras and the places of their errors."""
        free = [[place in places for place in range(N_CAUSES)] for _, places in causes]
        cameras = torch.tensor([camera for camera, _ in causes], device=device)
        return cls(cameras, torch.tensor(free, device=device))


class Explained(NamedTuple):
    """Holds what N explanations give.

    Attributes:
        errors: [N, 8], of the camera that each is about. cost: [N], what is minimised.
        pixels: [N, T, C, J], distances of keypoints from joints.
        promise: [N], by how much the cost would fall by a step in which all errors are free.
    """

    errors: Tensor
    cost: Tensor
    pixels: Tensor
    promise: Tensor


class _Views(NamedTuple):
    """Holds how C cameras see joints, one of which has errors.

    Attributes:
        pixels: [N, T, C, J, 2]. by_point: [N, T, C, J, 2, 3], their derivative by points in camera axes.
        points, rays: [N, T, C, J, 3], [N, T, C, J, 2], in camera axes. gain: [N, T, C, J, 1], g.
        rotation: [N, C, 3, 3]. in_front: [N, T, C, J].
    """

    pixels: Tensor
    by_point: Tensor
    points: Tensor
    rays: Tensor
    gain: Tensor
    rotation: Tensor
    in_front: Tensor


class _Equations(NamedTuple):
    """Holds factors of the information about joints [N, T, J, 3, 3], and the equations of errors.

    Attributes:
        E: [N, T, J, 3, 8]. b: [N, T, J, 3, 1]. S: [N, 8, 8]. g: [N, 8].
    """

    chol: Tensor
    E: Tensor
    b: Tensor
    S: Tensor
    g: Tensor


def explain(rig: CameraRig, frames: KeypointFrame, causes: Causes) -> Explained:
    """Return what explanations of some frames give.

    Args:
        rig: two cameras or more. frames: keypoints [N, T, C, J]. causes: that are tried.
    """
    known = torch.tensor(_STD).to(frames.pixels).square().reciprocal()
    prior = torch.where(causes.free, known, _KNOWN)
    errors = torch.zeros_like(prior)
    joints = _first_joints(rig, frames, causes)
    for width in _WIDTHS:
        views = _views(rig, joints, causes, errors)
        chol, E, b, S, g = _equations(rig, frames, views, causes, errors, width)
        step = _solved(S, g - prior * errors, prior)
        joints = joints + torch.cholesky_solve(b - E @ step[:, None, None], chol).squeeze(-1)
        errors = torch.where(causes.free, errors + step.squeeze(-1), 0.0)
    free = _solved(S, g, known.expand_as(prior)).squeeze(-1)
    promise = 0.5 * (free * g).sum(-1)
    views = _views(rig, joints, causes, errors)
    off, variance = _residuals(frames, views)
    square = off.square().sum(-1)
    ratio = torch.where(views.in_front, square / variance, _BEHIND) / _FREEDOM
    misfit = _FREEDOM / 2 * (frames.inlier * ratio.log1p()).sum((1, 2, 3))
    spent = 0.5 * (known * errors.square()).sum(-1)
    return Explained(errors, misfit + spent, square.sqrt(), promise)


def _solved(S: Tensor, g: Tensor, prior: Tensor) -> Float[Tensor, "N 8 1"]:
    """Return the solutions of normal equations with a prior."""
    L = torch.linalg.cholesky(symmetrise(S) + torch.diag_embed(prior))
    return torch.cholesky_solve(g[..., None], L)


def _first_joints(
    rig: CameraRig, frames: KeypointFrame, causes: Causes
) -> Float[Tensor, "N T J 3"]:
    """Return joints by the other cameras, or by all where too few see them."""
    own = torch.nn.functional.one_hot(causes.camera, len(rig)).bool()
    own = own & causes.free.any(-1, keepdim=True)
    count, n_frames = frames.inlier.shape[:2]
    flat = frames.map(lambda value: value.flatten(0, 1))
    joints = triangulate_without(RigMaps.of(rig), flat, own.repeat_interleave(n_frames, 0))
    return joints.unflatten(0, (count, n_frames))


def _views(
    rig: CameraRig, joints: Float[Tensor, "N T J 3"], causes: Causes, errors: Float[Tensor, "N 8"]
) -> _Views:
    """Return joints as cameras see them, one of which has errors."""
    count = len(causes.camera)
    rows, turn = torch.arange(count, device=errors.device), rotvec_to_matrix(errors[:, :TURN])
    R = rig.rotation.to(joints).repeat(count, 1, 1, 1)
    t = rig.translation.to(joints).repeat(count, 1, 1)
    own = rows, causes.camera
    R[own], t[own] = turn @ R[own], (turn @ t[own][..., None]).squeeze(-1) + errors[:, TURN:POSE]
    X = joints[:, :, None] @ R[:, None].mT + t[:, None, :, None]
    in_front = X[..., 2] > LEAST_DEPTH
    depth = torch.where(in_front, X[..., 2], 1.0)[..., None]
    rays = X[..., :2] / depth
    a, k = (_of_own(rig, causes, errors[:, i : i + 1])[:, None, :, None] for i in (FOCAL, LENS))
    gain = a.exp() * (1 + k * _square(rays))
    K = rig.matrix.to(joints)
    flat = torch.cat([torch.eye(2).to(rays).expand(*rays.shape, 2), -rays[..., None]], -1)
    return _Views(
        (rays * gain) @ K[:, :2, :2].mT + K[:, None, :2, 2],
        K[:, None, :2, :2] @ flat * (gain / depth)[..., None],
        X, rays, gain, R, in_front,
    )  # fmt: skip


def _of_own(rig: CameraRig, causes: Causes, values: Float[Tensor, "N K"]) -> Float[Tensor, "N C K"]:
    """Return values of the camera that is wrong, 0 for the others."""
    own = torch.nn.functional.one_hot(causes.camera, len(rig)).to(values)
    return own[..., None] * values[:, None]


def _square(rays: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 1"]:
    return rays.square().sum(-1, keepdim=True).clamp_max(_WIDEST)


def _residuals(frames: KeypointFrame, views: _Views) -> tuple[Tensor, Tensor]:
    """Return residuals [N, T, C, J, 2] of keypoints, and the variances of their noise."""
    return frames.pixels - views.pixels, frames.noise(views.by_point)


def _equations(
    rig: CameraRig,
    frames: KeypointFrame,
    views: _Views,
    causes: Causes,
    errors: Float[Tensor, "N 8"],
    width: float,
) -> _Equations:
    """Return the normal equations with joints eliminated."""
    off, variance = _residuals(frames, views)
    trust = frames.inlier * views.in_front
    root = (trust / (width * variance + off.square().sum(-1) / _FREEDOM)).sqrt()[..., None]
    A = root[..., None] * (views.by_point @ views.rotation[:, None, :, None])
    r = root * off
    rows = torch.arange(len(errors), device=errors.device), causes.camera
    A_own, r_own, root, own = (
        value.transpose(1, 2)[rows] for value in (A, r, root[..., None], views.by_point)
    )
    X, rays, gain = (v.transpose(1, 2)[rows] for v in (views.points, views.rays, views.gain))
    by_turn = torch.linalg.cross((X - errors[:, None, None, TURN:POSE])[..., None, :], own)
    K = rig.matrix.to(errors)[causes.camera, :2, :2][:, None, None]
    by_focal = K @ (gain * rays)[..., None]
    by_lens = K @ (_square(rays) * rays)[..., None]
    B = root * torch.cat([by_turn, own, by_focal, by_lens], -1)
    E = A_own.mT @ B
    b = (A.mT @ r[..., None]).sum(2)
    chol, Y, y = eliminated(A.transpose(2, 3).flatten(3, 4), E, b)
    S = (B.mT @ B - Y.mT @ Y).sum((1, 2))
    g = (B.mT @ r_own[..., None] - Y.mT @ y).sum((1, 2)).squeeze(-1)
    return _Equations(chol, E, b, S, g)
