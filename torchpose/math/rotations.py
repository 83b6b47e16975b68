"""Rotation matrices of roll, pitch and yaw (two orders) and of Rodrigues vectors.

Angles are radians. A rotation matrix takes body (or world) axes to camera axes.
"""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.errors import InputError, check_shape

__all__ = [
    "ROTATION_ORDERS",
    "RotationOrder",
    "euler_to_matrix",
    "matrix_to_euler",
    "rotvec_to_matrix",
]

RotationOrder = Literal["zxy", "zyx"]
ROTATION_ORDERS: tuple[RotationOrder, ...] = ("zxy", "zyx")


def euler_to_matrix(
    angles: Float[Tensor, "*batch 3"], order: RotationOrder = "zxy"
) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation matrix of roll, pitch and yaw.

    ``zxy``: R = Rz(roll) Rx(pitch) Ry(yaw), the paper's (BL 3).
    ``zyx``: R = Rz(roll) Ry(yaw) Rx(pitch), the authors' released code and priors.

    Args:
        angles: [..., 3], (roll, pitch, yaw) in radians, in this order for both.
        order: ``"zxy"`` or ``"zyx"``.

    Returns:
        R [..., 3, 3], body axes to camera axes.

    Raises:
        ShapeError: the last dimension is not 3. InputError: another order.

    Reference: Burke & Lasenby, equation (3).

    >>> euler_to_matrix(torch.tensor([0.0, 0.0, 0.5]))[2]  # yaw turns about y
    tensor([-0.4794,  0.0000,  0.8776])
    """
    check_shape("angles", angles, ["...", 3])
    _check_order(order)
    (sr, sp, sy), (cr, cp, cy) = angles.sin().unbind(-1), angles.cos().unbind(-1)
    if order == "zxy":
        rows = [
            [cr * cy - sr * sp * sy, -sr * cp, cr * sy + sr * sp * cy],
            [sr * cy + cr * sp * sy, cr * cp, sr * sy - cr * sp * cy],
            [-cp * sy, sp, cp * cy],
        ]
    else:
        rows = [
            [cr * cy, cr * sy * sp - sr * cp, cr * sy * cp + sr * sp],
            [sr * cy, sr * sy * sp + cr * cp, sr * sy * cp - cr * sp],
            [-sy, cy * sp, cy * cp],
        ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def matrix_to_euler(
    rotation: Float[Tensor, "*batch 3 3"], order: RotationOrder = "zxy"
) -> Float[Tensor, "*batch 3"]:
    """Return the roll, pitch and yaw of a rotation matrix; the inverse of `euler_to_matrix`.

    The middle angle (pitch for ``zxy``, yaw for ``zyx``) comes back in [-pi/2, pi/2]. Where it is
    a right angle the other two are not unique: roll is then 0 and gradients are undefined.

    Args:
        rotation: R [..., 3, 3], orthonormal with determinant 1.
        order: ``"zxy"`` (the paper) or ``"zyx"`` (released code).

    Returns:
        (roll, pitch, yaw) [..., 3] in radians.
    """
    check_shape("rotation", rotation, ["...", 3, 3])
    _check_order(order)
    R = rotation
    if order == "zxy":
        cos_mid = torch.hypot(R[..., 2, 0], R[..., 2, 2])
        locked = cos_mid < 8 * torch.finfo(R.dtype).eps
        pitch = torch.atan2(R[..., 2, 1], cos_mid)
        roll = torch.where(locked, 0.0, torch.atan2(-R[..., 0, 1], R[..., 1, 1]))
        free = torch.atan2(-R[..., 2, 0], R[..., 2, 2])
        yaw = torch.where(locked, torch.atan2(R[..., 0, 2], R[..., 0, 0]), free)
    else:
        cos_mid = torch.hypot(R[..., 2, 1], R[..., 2, 2])
        locked = cos_mid < 8 * torch.finfo(R.dtype).eps
        yaw = torch.atan2(-R[..., 2, 0], cos_mid)
        roll = torch.where(locked, 0.0, torch.atan2(R[..., 1, 0], R[..., 0, 0]))
        free = torch.atan2(R[..., 2, 1], R[..., 2, 2])
        pitch = torch.where(locked, torch.atan2(-R[..., 1, 2], R[..., 1, 1]), free)
    return torch.stack([roll, pitch, yaw], -1)


def rotvec_to_matrix(rotvec: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation matrix of a Rodrigues vector (axis times angle, radians), as in camera files.

    R = I + (sin a / a) [v]x + ((1 - cos a) / a^2) [v]x^2,   a = |v|, by series near zero.
    """
    check_shape("rotvec", rotvec, ["...", 3])
    x, y, z = rotvec.unbind(-1)
    o = torch.zeros_like(x)
    skew = torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).unflatten(-1, (3, 3))
    squared = rotvec.square().sum(-1)[..., None, None]
    near_zero = squared < 1e-8  # the next terms of the series are below the rounding of float64
    angle = torch.where(near_zero, torch.ones_like(squared), squared).sqrt()
    first = torch.where(near_zero, 1 - squared / 6, angle.sin() / angle)
    half = (angle / 2).sin() / angle
    second = torch.where(near_zero, 0.5 - squared / 24, 2 * half.square())
    eye = torch.eye(3, dtype=rotvec.dtype, device=rotvec.device)
    return eye + first * skew + second * (skew @ skew)


def _check_order(order: str) -> None:
    if order not in ROTATION_ORDERS:
        raise InputError(
            f"rotation order must be one of {', '.join(ROTATION_ORDERS)}, got {order!r}"
        )
