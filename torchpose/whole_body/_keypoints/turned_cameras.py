"""Find by how much cameras are turned, from the keypoints of one frame, with its joints eliminated.

A camera that is turned about its centre sees z where it should see z' = M exp([w]x) M^-1 z, with M = K R.
So the keypoints of such a camera are corrected, and the cameras stay as they are. Unknown are the joints p
and w of the cameras that may be turned. Steps of Gauss and Newton minimise

    nu/2 sum_cj log(1 + |z'_cj - h_c(p_j)|^2 / (nu R_cj)) + 2 sum_c log(1 + |w_c|^2 / s^2)

by weights, with noise R that is wide at first. The prior about turns is Cauchy's: rather one camera is turned
by much than all by a little.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.math._gaussian import block_diagonal, symmetrise
from torchpose.math._rotations import matrix_to_quaternion_vector, rotvec_to_matrix
from torchpose.whole_body._keypoints.joint_elimination import eliminated
from torchpose.whole_body._keypoints.joint_triangulation import triangulate_all, triangulate_without
from torchpose.whole_body._keypoints.keypoint_likelihood import (
    KeypointFrame,
    RigMaps,
    by_point,
    see,
)

_TURN = 0.02  # radians, the scale s of turns before they are estimated
_FREEDOM = 4.0  # nu, of Student's distribution of the errors
_WIDTHS = (400.0, 400.0, 100.0, 100.0, 25.0, 25.0, 9.0, 4.0, 2.0, *[1.0] * 6)
_WIDTHS_OF_KNOWN = (9.0, 4.0, 1.0, 1.0)
_KNOWN = 1e12  # per square radian, the information about cameras that are not turned
_LEAST_DEPTH = 0.1  # of a turned ray, whose depth is 1 before it is turned


class Turns(NamedTuple):
    """Holds turns [N, C, 3, 3] of cameras in world axes, and what each choice of free turns costs [N].

    `price` is what free turns take from the log-evidence, about Laplace's approximation:
    2 log(1 + |w|^2 / s^2) + log det(S s^2) / 2, with S the information about the turns. `misfit` [N, C] is
    what the errors of each camera's keypoints take from it. `errors` [N, C, J, 2] are those over the standard
    deviations of their noise, and `weights` [N, C, J] how much each counts.
    """

    matrix: Tensor
    price: Tensor
    misfit: Tensor
    errors: Tensor
    weights: Tensor


def turned(
    frame: KeypointFrame, turn: Float[Tensor, "*batch C 3 3"], maps: RigMaps
) -> KeypointFrame:
    """Return keypoints [..., C, J] as cameras would see them that are not turned.

    Args:
        frame: the keypoints. turn: of the cameras, in world axes. maps: the cameras.
    """
    return frame._replace(pixels=_pixels(_rays(frame, maps) @ turn.mT, maps)[0])


def is_turned(turn: Float[Tensor, "*batch 3 3"]) -> Bool[Tensor, "*batch"]:
    """Return which rotations are not the unit matrix."""
    return (turn != torch.eye(3).to(turn)).flatten(-2).any(-1)


def angles_of(turn: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """Return the angles of rotations, radians from 0 to pi."""
    cosine = (turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    return cosine.clamp(-1, 1).arccos()


def unlikely(turn: Float[Tensor, "*batch C 3 3"]) -> Float[Tensor, "*batch"]:
    """Return minus the log density of turns by their prior, sum 2 log(1 + |w|^2 / s^2)."""
    return _unlikely(_rotvec(turn)).sum(-1)


def _unlikely(rotvec: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    return 2 * torch.log1p(rotvec.square().sum(-1) / _TURN**2)


def _rotvec(turn: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Return axes times angles, to within 1 % up to half a radian."""
    return 2 * matrix_to_quaternion_vector(turn)


def find_turns(
    frame: KeypointFrame,
    free: Bool[Tensor, "N C"],
    maps: RigMaps,
    known: Float[Tensor, "N C 3 3"] | None = None,
) -> Turns:
    """Return the turns of cameras that explain the keypoints of a frame, or of several side by side.

    Args:
        frame: the keypoints [N, C, J]; those of several frames are one after the other along J.
        free: which cameras may be turned. maps: the cameras. known: turns that are near, from which few
            steps are taken.
    """
    rays = _rays(frame, maps)
    eye = torch.eye(3).to(rays)
    if known is None:
        turn, widths = eye.expand(*free.shape, 3, 3), _WIDTHS
        joints = triangulate_without(maps, frame, free & ~free.all(-1, keepdim=True))
    else:
        turn, widths = known, _WIDTHS_OF_KNOWN
        joints = triangulate_all(maps, turned(frame, turn, maps), frame.there)
    rotvec = _rotvec(turn)
    for width in widths:
        large = 1.0 + rotvec.square().sum(-1) / _TURN**2
        prior = torch.where(free, 4 / (_TURN**2 * large), _KNOWN)
        prior = prior[..., None].expand_as(rotvec).flatten(1)
        chol, F, b, S, g = _equations(frame, rays @ turn.mT, joints, maps, width)
        L = torch.linalg.cholesky(symmetrise(S) + torch.diag_embed(prior))
        step = torch.cholesky_solve((-g - prior * rotvec.flatten(1))[..., None], L)
        joints = joints + torch.cholesky_solve(b + F @ step[:, None], chol).squeeze(-1)
        rotvec = rotvec + step.view_as(rotvec)
        turn = rotvec_to_matrix(step.view_as(rotvec)) @ turn
    known_before = 1.5 * torch.where(free, -2 * math.log(_TURN), math.log(_KNOWN))
    narrowed = L.diagonal(dim1=-2, dim2=-1).log().sum(-1) - known_before.sum(-1)
    spent = torch.where(free, _unlikely(rotvec), 0.0).sum(-1)
    errors, trust = _errors(frame, _pixels(rays @ turn.mT, maps)[0], joints, maps)
    ratio = errors.square().sum(-1) / _FREEDOM
    misfit = _FREEDOM / 2 * (trust * ratio.log1p()).sum(-1)
    matrix = torch.where(free[..., None, None], turn, eye)
    return Turns(matrix, spent + narrowed, misfit, errors, trust / (1 + ratio))


def _equations(
    frame: KeypointFrame,
    rays: Float[Tensor, "N C J 3"],
    joints: Float[Tensor, "N J 3"],
    maps: RigMaps,
    width: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return a factor of the information about joints, and the normal equations with them eliminated.

    Returns:
        The factor [N, J, 3, 3], F [N, J, 3, 3 C] and b [N, J, 3, 1] of the joints; S [N, 3 C, 3 C] and g
        [N, 3 C] of the turns.
    """
    pixels, by_ray = _pixels(rays, maps)
    seen = see(maps, joints)
    A, off = seen.by_joint, pixels - seen.pixels
    variance, square = width * frame.noise(seen.by_joint), off.square().sum(-1)
    trust = frame.inlier * seen.in_front
    root = (trust / (variance + square / _FREEDOM)).sqrt()[..., None]
    r, A = root * off, root[..., None] * A
    T = root[..., None] * torch.linalg.cross(rays[..., None, :], by_ray)
    F = (A.mT @ T).movedim(1, -2).flatten(-2)
    A, T = A.transpose(1, 2).flatten(2, 3), T.flatten(2, 3)
    b = A.mT @ r.transpose(1, 2).flatten(2)[..., None]
    chol, *solved = eliminated(A, F, b)
    Y, y = (value.flatten(1, 2) for value in solved)
    S = block_diagonal(T.mT @ T) - Y.mT @ Y
    g = (T.mT @ r.flatten(2)[..., None]).flatten(1) - (Y.mT @ y).squeeze(-1)
    return chol, F, b, S, g


def _errors(
    frame: KeypointFrame,
    pixels: Float[Tensor, "N C J 2"],
    joints: Float[Tensor, "N J 3"],
    maps: RigMaps,
) -> tuple[Float[Tensor, "N C J 2"], Float[Tensor, "N C J"]]:
    """Return errors of turned keypoints over the standard deviations of their noise, and their trust."""
    seen = see(maps, joints)
    off = pixels - seen.pixels
    return off / frame.noise(seen.by_joint).sqrt()[..., None], frame.inlier * seen.in_front


def _rays(frame: KeypointFrame, maps: RigMaps) -> Float[Tensor, "*batch C J 3"]:
    """Return the rays of keypoints in world axes, of depth 1."""
    ones = torch.ones_like(frame.pixels[..., :1])
    homogeneous = torch.cat([frame.pixels, ones], -1)
    return torch.linalg.solve(maps.matrix, homogeneous.mT).mT


def _pixels(
    rays: Float[Tensor, "*batch C J 3"], maps: RigMaps
) -> tuple[Float[Tensor, "*batch C J 2"], Float[Tensor, "*batch C J 2 3"]]:
    """Return the pixels of rays, and their derivatives."""
    homogeneous = rays @ maps.matrix.mT
    depth = homogeneous[..., 2:]
    depth = torch.where(depth > _LEAST_DEPTH, depth, _LEAST_DEPTH)
    pixels = homogeneous[..., :2] / depth
    return pixels, by_point(maps.matrix, pixels, depth)
