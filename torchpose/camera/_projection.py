"""Project points to pixels and lift them back, and turn the state of an arm into joints in metres (BL 5).

Camera axes: x right, y down, z forward. Metres and pixels. (BL n) is an equation of Burke &
Lasenby, "Single camera pose estimation using Bayesian filtering and Kinect motion priors". Every
function is differentiable, takes any dtype and broadcasts over leading dimensions."""

from collections.abc import Callable
from functools import cache, reduce
from typing import NamedTuple, Self

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_shape
from torchpose._core.module_state import outside_inference
from torchpose.errors import CameraError
from torchpose.math._gaussian import point_blocks
from torchpose.math._rotations import RotationOrder, euler_to_matrix
from torchpose.math._unscented import unscented_transform

_SHORTEST, _LARGEST = 1e-6, 1e9  # pixels: focal lengths and entries beyond are of no camera


def project(
    points: Float[Tensor, "... J 3"],
    K: Float[Tensor, "... 3 3"],
    R: Float[Tensor, "... 3 3"],
    t: Float[Tensor, "... 3"],
) -> Float[Tensor, "... J 3"]:
    """Return the pixels and projective depth of body points.

    [u, v, lambda] = K [R | t] [X, Y, Z, 1]   (BL 3), returned as (u/lambda, v/lambda, lambda).

    Args:
        points: [..., J, 3] in body axes, metres.
        K: camera matrix [3, 3] or [..., 3, 3], pixels, as (BL 4).
        R: rotation [..., 3, 3], body axes to camera axes.
        t: translation [..., 3], metres, in camera axes.

    Leading dimensions broadcast. A point with lambda <= 0 lies behind the camera and its pixels
    mean nothing; a point with lambda = 0 gives infinite pixels.

    Returns:
        (u, v, lambda) [..., J, 3]: pixels, pixels, metres.

    Reference: Burke & Lasenby, equations (3) and (4).

    >>> K, eye = torch.eye(3), torch.eye(3)
    >>> project(torch.tensor([[1.0, 2.0, 2.0]]), K, eye, torch.tensor([0.0, 0.0, 2.0]))
    tensor([[0.2500, 0.5000, 4.0000]])
    """
    check_shape("points", points, ["...", None, 3])
    _check_pose(K, R, t)
    points, K, R, t = _of_one_precision(points, K, R, t)
    homogeneous = (points @ R.mT + t.unsqueeze(-2)) @ K.mT
    depth = homogeneous[..., 2:]
    return torch.cat([homogeneous[..., :2] / depth, depth], -1)


def _of_one_precision(*values: Tensor) -> list[Tensor]:
    """Return tensors in the precision of the most precise one."""
    dtype = reduce(torch.promote_types, (value.dtype for value in values))
    return [value.to(dtype) for value in values]


def backproject(
    uvl: Float[Tensor, "... J 3"], K: Float[Tensor, "... 3 3"]
) -> Float[Tensor, "... J 3"]:
    """Return the points in camera axes of pixels and projective depth: K^-1 (u lambda, v lambda, lambda).

    Args:
        uvl: (u, v, lambda) [..., J, 3]: pixels, pixels, metres.
        K: camera matrix [3, 3] or [..., 3, 3]: upper triangular, last row (0, 0, 1).

    Returns:
        [..., J, 3], camera axes, metres.
    """
    check_shape("uvl", uvl, ["...", None, 3])
    check_shape("K", K, ["...", 3, 3])
    dtype = torch.promote_types(uvl.dtype, K.dtype)
    wide = torch.promote_types(dtype, torch.float32)  # there is no solver for half precision
    pixels, depth = uvl.to(wide).split([2, 1], -1)
    eye = torch.eye(3, dtype=wide, device=K.device)
    inverse = torch.linalg.solve_triangular(K.to(wide), eye, upper=True)
    return ((homogeneous_pixels(pixels) @ inverse.mT) * depth).to(dtype)


def turn_homography(
    rotation: Float[Tensor, "*batch 3 3"], matrix: Float[Tensor, "3 3"]
) -> Float[Tensor, "*batch 3 3"]:
    """Return K R K^-1, the map of homogeneous pixels when a camera turns."""
    return torch.linalg.solve_triangular(matrix, matrix @ rotation, upper=True, left=False)


def homogeneous_pixels(uv: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
    """Return pixels (u, v, 1)."""
    return torch.nn.functional.pad(uv, (0, 1), value=1.0)


def pixel_rays(
    uv: Float[Tensor, "*batch 2"], matrix: Float[Tensor, "3 3"]
) -> Float[Tensor, "*batch 3"]:
    """Return K^-1 [u, v, 1]; K is triangular, so that its inverse is not needed."""
    pixels = homogeneous_pixels(uv)
    return torch.linalg.solve_triangular(matrix.mT, pixels, upper=False, left=False)


def scale_matrix(
    matrix: Float[Tensor, "*batch 3 3"], sx: Tensor | float, sy: Tensor | float
) -> Float[Tensor, "*batch 3 3"]:
    """Return K of images that are scaled by sx and sy, pixel centres at whole numbers.

    Args:
        matrix: K. sx, sy: new by old width and height, numbers or of the batch's shape.
    """
    scaled = matrix.clone()
    sx, sy = (torch.as_tensor(s).to(matrix) for s in (sx, sy))
    scaled[..., 0, :] *= sx[..., None]
    scaled[..., 1, :] *= sy[..., None]
    scaled[..., 0, 2] += (sx - 1) / 2
    scaled[..., 1, 2] += (sy - 1) / 2
    return scaled


def lift(
    uvl: Float[Tensor, "... J 3"],
    K: Float[Tensor, "... 3 3"],
    R: Float[Tensor, "... 3 3"],
    t: Float[Tensor, "... 3"],
) -> Float[Tensor, "... J 3"]:
    """Return body points of pixels and projective depth; the inverse of `project`.

    [X, Y, Z] = [p1 p2 p3]^-1 ([u, v, lambda] - p4)   (BL 5), here R^T (K^-1 [u, v, lambda] - t).

    Args:
        uvl: (u, v, lambda) [..., J, 3], u and v divided by lambda as in the state.
        K: camera matrix [3, 3] or [..., 3, 3]: upper triangular, last row (0, 0, 1).
        R: rotation [..., 3, 3], orthonormal. t: translation [..., 3], metres.

    Returns:
        [..., J, 3] in body axes, metres.

    Reference: Burke & Lasenby, equation (5).
    """
    _check_pose(K, R, t)
    uvl, K, R, t = _of_one_precision(uvl, K, R, t)
    return (backproject(uvl, K) - t.unsqueeze(-2)) @ R


def map_pixels(
    uv: Float[Tensor, "... 2"], K_from: Float[Tensor, "... 3 3"], K_to: Float[Tensor, "... 3 3"]
) -> Float[Tensor, "... 2"]:
    """Return the pixels of one camera as another camera in the same place would see them: K_to K_from^-1.

    Args:
        uv: [..., 2], pixels of the first camera; NaN stays NaN.
        K_from, K_to: camera matrices [3, 3] (or with leading dimensions that broadcast).

    Returns:
        [..., 2], pixels of the second camera.
    """
    check_shape("uv", uv, ["...", 2])
    return PixelMap.between(K_from, K_to).points(uv)


def map_pixel_covariance(
    covariance: Float[Tensor, "... 2 2"],
    K_from: Float[Tensor, "... 3 3"],
    K_to: Float[Tensor, "... 3 3"],
) -> Float[Tensor, "... 2 2"]:
    """Return the covariance of pixels after `map_pixels`: A C A^T with its Jacobian A (the map is affine).

    Args:
        covariance: [..., 2, 2], squared pixels of the first camera.
        K_from, K_to: camera matrices [3, 3].

    Returns:
        [..., 2, 2], squared pixels of the second camera.
    """
    check_shape("covariance", covariance, ["...", 2, 2])
    return PixelMap.between(K_from, K_to).covariances(covariance)


class PixelMap(NamedTuple):
    """Affine map from the pixels of one camera to those of another one in the same place.

    Attributes:
        slope: its linear part, [..., 2, 2]. start, end: the principal points of both cameras, [..., 2].
    """

    slope: Tensor
    start: Tensor
    end: Tensor

    @classmethod
    def between(cls, K_from: Float[Tensor, "... 3 3"], K_to: Float[Tensor, "... 3 3"]) -> Self:
        """Return the map K_to K_from^-1 between two cameras; raise `CameraError` unless they are some."""
        check_intrinsics("K_from", K_from)
        check_intrinsics("K_to", K_to)
        inverse = _inverse_slope(K_from)
        slope = K_to[..., :2, :2].to(inverse) @ inverse
        return cls(slope, K_from[..., :2, 2], K_to[..., :2, 2])

    def points(self, uv: Float[Tensor, "... 2"]) -> Float[Tensor, "... 2"]:
        """Return pixels of the first camera in the second one; NaN stays NaN."""
        slope, start, end = (part.to(uv) for part in self)
        return (slope @ (uv - start).unsqueeze(-1)).squeeze(-1) + end

    def covariances(self, covariance: Float[Tensor, "... 2 2"]) -> Float[Tensor, "... 2 2"]:
        """Return covariances of pixels of the first camera in the second one."""
        slope = self.slope.to(covariance)
        return slope @ covariance @ slope.mT


def check_intrinsics(name: str, K: Tensor) -> None:
    """Raise `CameraError` unless K is a camera matrix (BL 4).

    Args:
        name: the name of the matrix, for the message.
        K: [..., 3, 3]: finite, positive focal lengths, zeros below the diagonal, last row
            (0, 0, 1).
    """
    if K.ndim < 2 or tuple(K.shape[-2:]) != (3, 3):
        raise CameraError(f"{name} must have shape [3, 3], got {list(K.shape)}")
    least, most = _bounds(K.dtype, K.device)
    if not bool(((least <= K) & (most >= K)).all()):
        _refuse_intrinsics(name, K)


@cache
def _bounds(
    dtype: torch.dtype, device: torch.device
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3 3"]]:
    """Return the least and the largest value of each entry of a camera matrix."""
    low, high = -_LARGEST, _LARGEST
    least = [[_SHORTEST, low, low], [0.0, _SHORTEST, low], [0.0, 0.0, 1.0]]
    most = [[high, high, high], [0.0, high, high], [0.0, 0.0, 1.0]]
    with outside_inference():
        both = torch.tensor([least, most], dtype=dtype, device=device)
        return both[0], both[1]


def _refuse_intrinsics(name: str, K: Tensor) -> None:
    """Raise a `CameraError` that says why K is no camera matrix."""
    if not bool((K.abs() <= _LARGEST).all()):
        raise CameraError(
            f"{name} must be finite and at most {_LARGEST:g}, got {K.tolist()!s:.200}"
        )
    fx, fy, *_ = intrinsics(K)
    if bool((fx < _SHORTEST).any()) or bool((fy < _SHORTEST).any()):
        raise CameraError(
            f"{name} needs positive focal lengths in pixels, got fx={fx.tolist()}, fy={fy.tolist()}"
        )
    raise CameraError(
        f"{name} must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]], got {K.tolist()}; "
        "divide by the last entry, and give the rotation apart"
    )


def intrinsics(K: Float[Tensor, "... 3 3"]) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return fx, fy, skew, cx, cy of a camera matrix (BL 4), each [...], pixels."""
    return K[..., 0, 0], K[..., 1, 1], K[..., 0, 1], K[..., 0, 2], K[..., 1, 2]


def _check_pose(K: Tensor, R: Tensor, t: Tensor) -> None:
    check_shape("K", K, ["...", 3, 3])
    check_shape("R", R, ["...", 3, 3])
    check_shape("t", t, ["...", 3])


def _inverse_slope(K: Float[Tensor, "... 3 3"]) -> Float[Tensor, "... 2 2"]:
    """Return the inverse of the upper left part of a camera matrix: the linear part of K^-1."""
    fx, fy, skew, *_ = intrinsics(K)
    zero = torch.zeros_like(fx)
    return torch.stack([1 / fx, -skew / (fx * fy), zero, 1 / fy], -1).unflatten(-1, (2, 2))


_CHUNK = 4096  # states at a time: 43 sigma points of 21 numbers each make 30 MB


def arm_in_camera_frame(
    mean: Float[Tensor, "... 21"],
    cov: Float[Tensor, "... 21 21"],
    matrix: Float[Tensor, "3 3"],
) -> tuple[Float[Tensor, "... 5 3"], Float[Tensor, "... 5 3 3"]]:
    """Return the joints of an arm in camera axes, X = lambda K^-1 [u, v, 1], by unscented transform.

    Each joint depends on its own (u, v, lambda) alone, so seven sigma points do. The covariance is
    of where the joint is in space: it includes how far away the whole body is.

    Args:
        mean, cov: of the arm's state. matrix: K of the state's pixels.

    Returns:
        Mean [..., 5, 3] in metres and covariance [..., 5, 3, 3] of hand, elbow, shoulder, head, neck.
    """
    joints, own = mean[..., :15].unflatten(-1, (5, 3)), point_blocks(cov[..., :15, :15])
    return _unscented(lambda points: backproject(points, matrix), joints, own)


def arm_in_body_frame(
    mean: Float[Tensor, "... 21"],
    cov: Float[Tensor, "... 21 21"],
    matrix: Float[Tensor, "3 3"],
    rotation_order: RotationOrder,
) -> tuple[Float[Tensor, "... 5 3"], Float[Tensor, "... 5 3 3"]]:
    """Return the joints of an arm in the frame of the body, (BL 5), by unscented transform over the state.

    X = [p1 p2 p3]^-1 (lambda [u, v, 1] - p4), P = K [R | t]: the camera's rotation and translation
    are part of the state, so their uncertainty is in the covariance, and what joints and camera have
    in common (the distance of the whole body, say) cancels.

    Args:
        mean, cov: of the arm's state. matrix: K. rotation_order: of roll, pitch and yaw.

    Returns:
        As `arm_in_camera_frame`, in the frame in which the prior's poses were recorded and centred.
    """

    def to_body(points: Tensor) -> Tensor:
        joints = points[..., :15].unflatten(-1, (5, 3))
        rotation = euler_to_matrix(points[..., 15:18], rotation_order)
        return lift(joints, matrix, rotation, points[..., 18:21]).flatten(-2)

    flat_mean, flat_cov = mean.reshape(-1, 21), cov.reshape(-1, 21, 21)
    parts = [
        _unscented(to_body, m, c)
        for m, c in zip(flat_mean.split(_CHUNK), flat_cov.split(_CHUNK), strict=True)
    ]
    joints = torch.cat([joints for joints, _ in parts])
    covs = torch.cat([point_blocks(cov) for _, cov in parts])
    return joints.view(*mean.shape[:-1], 5, 3), covs.view(*mean.shape[:-1], 5, 3, 3)


def _unscented(
    function: Callable[[Tensor], Tensor], mean: Tensor, cov: Tensor
) -> tuple[Tensor, Tensor]:
    return unscented_transform(function, mean, cov, centre=True, directions="cholesky")


def join_arms(left: Float[Tensor, "B T 5 *rest"], right: Float[Tensor, "B T 5 *rest"]) -> Tensor:
    """Return the eight joints from hand, elbow, shoulder, head and neck of either arm.

    Head and neck are averaged. For covariances the average bounds that of the averaged estimate
    whatever the two errors have in common: Cov((a + b) / 2) <= (Cov a + Cov b) / 2.
    """
    shared = (left[:, :, 3:] + right[:, :, 3:]) / 2
    return torch.cat([left[:, :, :3], shared, right[:, :, :3].flip(2)], 2)


def pixel_covariances(cov: Float[Tensor, "*batch 21 21"]) -> Float[Tensor, "*batch 5 2 2"]:
    """Return the covariances of (u, v) of the five joints of an arm, pixels squared."""
    return point_blocks(cov[..., :15, :15])[..., :2, :2]
