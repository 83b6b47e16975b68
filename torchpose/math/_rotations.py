"""Convert rotations: Euler angles, Rodrigues vectors, vector parts of unit quaternions, rigid alignment.

Angles are radians. A rotation matrix takes body (or world) axes to camera axes.

Every rotation is one such vector in the unit ball, except those by pi, which are two (v and -v). A
vector longer than 1 is scaled back to the unit sphere. Quaternions [..., 4] are (x, y, z, w); the
product of two rotations turns by the right one first. Gradients are finite everywhere."""

import math
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.checks import check_choice, check_floating, check_shape
from torchpose._core.module_state import outside_inference
from torchpose._core.value_checks import values_visible
from torchpose._core.value_pairs import as_pair
from torchpose.errors import InputError
from torchpose.math._gaussian import safe_eigh

RotationOrder = Literal["zxy", "zyx"]
ROTATION_ORDERS: tuple[RotationOrder, ...] = ("zxy", "zyx")

_ANGLES = "rpy"
# The entries of R, row by row, of sines and cosines of roll, pitch and yaw: sums of up to two products.
_EULER = {
    "zxy": (
        ("cr cy", "-sr sp sy"), ("-sr cp",), ("cr sy", "sr sp cy"),
        ("sr cy", "cr sp sy"), ("cr cp",), ("sr sy", "-cr sp cy"),
        ("-cp sy",), ("sp",), ("cp cy",),
    ),
    "zyx": (
        ("cr cy",), ("cr sy sp", "-sr cp"), ("cr sy cp", "sr sp"),
        ("sr cy",), ("sr sy sp", "cr cp"), ("sr sy cp", "-cr sp"),
        ("-sy",), ("cy sp",), ("cy cp",),
    ),
}  # fmt: skip


def _euler_terms(order: RotationOrder) -> tuple[Float[Tensor, "3 S"], Float[Tensor, "2*S 9"]]:
    """Return sums of the angles, and the weights of their cosines and sines in each entry of R.

    Products of sines and cosines are sums of those of sums of their angles, so R takes one product with
    these weights. A product is kept by the exponentials of which it consists,
    cos a = (e^ia + e^-ia) / 2 and sin a = (e^ia - e^-ia) / 2i, of which those of a sum and of its negative
    are conjugates.
    """
    entries = [torch.stack([*map(_exponentials, products)]).sum(0) for products in _EULER[order]]
    coefficients = torch.stack(entries).flatten(1)  # [9, 27], of the sums with factors -1, 0 and 1
    factors = torch.cartesian_prod(*[torch.arange(-1.0, 2.0, dtype=torch.float64)] * 3)
    # of a sum and its negative the second half has one; rows that no entry needs are left out
    used = [row for row in range(14, 27) if bool((coefficients[:, row] != 0).any())]
    known = 2 * coefficients[:, used].mT
    return factors[used].mT.contiguous(), torch.cat([known.real, -known.imag])


def _exponentials(product: str) -> Tensor:
    """Return the coefficients of e^i(k_r r + k_p p + k_y y) in a product, k = -1, 0 and 1, [3, 3, 3]."""
    parts = torch.eye(3, dtype=torch.complex128)[1].repeat(3, 1)
    for factor in product.removeprefix("-").split():
        sine = factor.startswith("s")
        parts[_ANGLES.index(factor[1])] = torch.tensor([0.5j, 0, -0.5j] if sine else [0.5, 0, 0.5])
    sign = -1.0 if product.startswith("-") else 1.0
    return sign * torch.einsum("r,p,y->rpy", *parts)


with outside_inference():
    _EULER_TERMS = {order: _euler_terms(order) for order in ROTATION_ORDERS}


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
        ShapeError: the last dimension is not 3. InputError: another order, or whole numbers.

    Reference: Burke & Lasenby, equation (3).

    >>> euler_to_matrix(torch.tensor([0.0, 0.0, 0.5]))[2]  # yaw turns about y
    tensor([-0.4794,  0.0000,  0.8776])
    """
    check_floating("angles", angles)
    check_shape("angles", angles, ["...", 3])
    _check_order(order)
    factors, weights = _EULER_TERMS[order]
    sums = angles @ factors.to(angles)
    return (torch.cat([sums.cos(), sums.sin()], -1) @ weights.to(angles)).unflatten(-1, (3, 3))


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
    a, b, c, d, e, f, g, h, i = rotation.flatten(-2).unbind(-1)  # row by row
    cos_mid = torch.hypot(g if order == "zxy" else h, i)
    locked = cos_mid < 8 * torch.finfo(rotation.dtype).eps
    if order == "zxy":
        pitch = torch.atan2(h, cos_mid)
        roll = torch.where(locked, 0.0, torch.atan2(-b, e))
        yaw = torch.where(locked, torch.atan2(c, a), torch.atan2(-g, i))
    else:
        yaw = torch.atan2(-g, cos_mid)
        roll = torch.where(locked, 0.0, torch.atan2(d, a))
        pitch = torch.where(locked, torch.atan2(-f, e), torch.atan2(h, i))
    return torch.stack([roll, pitch, yaw], -1)


def rotvec_to_matrix(rotvec: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation matrix of a Rodrigues vector (axis times angle, radians), as in camera files.

    R = I + (sin a / a) [v]x + ((1 - cos a) / a^2) [v]x^2,   a = |v|, by series near zero.
    """
    check_shape("rotvec", rotvec, ["...", 3])
    return exponential(cross_matrix(rotvec))


def exponential(skew: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation matrix exp [v]x of a cross matrix; see `rotvec_to_matrix`."""
    squared = (skew * skew).sum((-2, -1), keepdim=True) / 2.0
    near_zero = squared < 1e-8  # the next terms of the series are below the rounding of float64
    angle = torch.where(near_zero, 1.0, squared).sqrt()
    first = torch.where(near_zero, 1.0 - squared / 6.0, angle.sin() / angle)
    half = (angle / 2.0).sin() / angle
    second = torch.where(near_zero, 0.5 - squared / 24.0, 2.0 * half * half)
    eye = torch.eye(3, dtype=skew.dtype, device=skew.device)
    return eye + first * skew + second * (skew @ skew)


def _check_order(order: str) -> None:
    check_choice("rotation order", order, ROTATION_ORDERS)


def within_half_turn(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Return the angle between -pi and pi that is the same up to whole turns."""
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def within_unit_ball(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Scale vectors longer than 1 back to the unit sphere; others stay as they are."""
    return vector * _squared_length(vector).clamp_min(1).rsqrt()


def vector_to_quaternion(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    """Return the unit quaternion (x, y, z, w), w >= 0, of a quaternion vector.

    w = sqrt(1 - |v|^2), whose slope is infinite at |v| = 1: within the rounding of the dtype w is 0
    there and has no slope.
    """
    vector = within_unit_ball(vector)
    squared = 1.0 - _squared_length(vector)
    on_sphere = squared <= 2 * torch.finfo(vector.dtype).eps
    w = torch.where(on_sphere, torch.ones_like(squared), squared).sqrt()
    return torch.cat([vector, torch.where(on_sphere, torch.zeros_like(w), w)], -1)


def _squared_length(vector: Tensor) -> Tensor:
    """Return |v|^2 [..., 1]; a sum over a dimension of three takes five times as long."""
    x, y, z = vector.split(1, -1)
    return x * x + y * y + z * z


def quaternion_to_vector(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3"]:
    """Return the vector part of q or of -q, whichever has w >= 0; q and -q are the same rotation."""
    vector, w = quaternion[..., :3], quaternion[..., 3:]
    return torch.where(w < 0.0, -vector, vector)


def quaternion_vector_to_matrix(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation matrix R = I + 2 w [v]x + 2 [v]x^2 of a quaternion vector.

    Args:
        vector: [..., 3], v of the unit quaternion (v, w) with w = sqrt(1 - |v|^2).

    Returns:
        R [..., 3, 3].

    Raises:
        ShapeError: the last dimension is not 3.

    >>> quaternion_vector_to_matrix(torch.tensor([0.0, 1.0, 0.0])).diagonal()  # by pi about y
    tensor([-1.,  1., -1.])
    """
    check_shape("vector", vector, ["...", 3])
    x, y, z, w = vector_to_quaternion(vector).unbind(-1)
    xx, yy, zz = 2.0 * x * x, 2.0 * y * y, 2.0 * z * z
    xy, xz, yz = 2.0 * x * y, 2.0 * x * z, 2.0 * y * z
    wx, wy, wz = 2.0 * w * x, 2.0 * w * y, 2.0 * w * z
    rows = [
        1.0 - yy - zz, xy - wz, xz + wy,
        xy + wz, 1.0 - xx - zz, yz - wx,
        xz - wy, yz + wx, 1.0 - xx - yy,
    ]  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def matrix_to_quaternion_vector(
    rotation: Float[Tensor, "*batch 3 3"],
) -> Float[Tensor, "*batch 3"]:
    """Return the quaternion vector of a rotation matrix; the inverse of `quaternion_vector_to_matrix`.

    R determines the matrix 4 q q^T; its row with the largest diagonal entry, at least 1, is q up to
    its length, which is stable at every angle, 0 and pi included.

    Args:
        rotation: [..., 3, 3], orthonormal with determinant 1.
    """
    check_shape("rotation", rotation, ["...", 3, 3])
    a, b, c, d, e, f, g, h, i = rotation.flatten(-2).unbind(-1)
    xy, xz, yz, wx, wy, wz = b + d, c + g, f + h, h - f, c - g, d - b
    rows = [
        1.0 + a - e - i, xy, xz, wx,
        xy, 1.0 - a + e - i, yz, wy,
        xz, yz, 1.0 - a - e + i, wz,
        wx, wy, wz, 1.0 + a + e + i,
    ]  # fmt: skip
    outer = torch.stack(rows, -1).unflatten(-1, (4, 4))
    best = outer.detach().diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = outer.gather(-2, best[..., None, None].expand(*best.shape, 1, 4)).squeeze(-2)
    return quaternion_to_vector(row / row.norm(dim=-1, keepdim=True))


def matrix_to_rotvec(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Return the Rodrigues vector of a rotation matrix, radians; the inverse of `rotvec_to_matrix`."""
    quaternion = matrix_to_quaternion_vector(rotation)
    length = quaternion.norm(dim=-1, keepdim=True).clamp(1e-12, 1.0)
    return 2.0 * quaternion * (length.asin() / length)


def conjugate(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Return the inverse of a rotation, -v.

    Args:
        vector: quaternion vector [..., 3].

    Returns:
        Quaternion vector [..., 3].
    """
    return -vector


def compose(
    first: Float[Tensor, "*#batch 3"], second: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Return the quaternion vector of the product R(first) R(second).

    v = w_1 v_2 + w_2 v_1 + v_1 x v_2, with the sign that makes w_1 w_2 - v_1 . v_2 >= 0.

    Args:
        first, second: quaternion vectors [..., 3]; they broadcast. The product turns by `second` first.

    Returns:
        Quaternion vector [..., 3] in the unit ball.

    Raises:
        ShapeError: the last dimension is not 3, as of quaternions.

    >>> quarter = torch.tensor([0.0, 0.5**0.5, 0.0])
    >>> compose(quarter, -quarter)
    tensor([0., 0., 0.])
    """
    for name, vector in (("first", first), ("second", second)):
        check_shape(name, vector, ["...", 3])
    dtype = torch.promote_types(first.dtype, second.dtype)
    factors = (vector_to_quaternion(vector.to(dtype)) for vector in (first, second))
    return quaternion_to_vector(_product(*factors))


def cross_matrix(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the matrix of the cross product, [v]x a = v x a."""
    x, y, z = vector.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).unflatten(-1, (3, 3))


def _product(a: Tensor, b: Tensor) -> Tensor:
    a, b = torch.broadcast_tensors(a, b)
    (va, wa), (vb, wb) = (q.split([3, 1], -1) for q in (a, b))
    vector = wa * vb + wb * va + torch.linalg.cross(va, vb)
    return torch.cat([vector, wa * wb - (va * vb).sum(-1, keepdim=True)], -1)


def minimal_rotation(
    start: Float[Tensor, "*#batch 3"], end: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Return the rotation by the smallest angle that turns one direction into another: swing, no twist.

    v = a x h,   h = (a + b) / |a + b|, the direction half way.

    Opposite directions have no single such rotation: one by pi about an axis across them is taken.

    Args:
        start, end: directions a and b, of any length but zero.
    """
    a = torch.nn.functional.normalize(start, dim=-1)
    b = torch.nn.functional.normalize(end, dim=-1)
    a, b = torch.broadcast_tensors(a, b)
    middle = a + b
    opposite = (middle * middle).sum(-1, keepdim=True) <= 16 * torch.finfo(a.dtype).eps ** 2
    middle = torch.where(opposite, _across(a), middle)
    return torch.linalg.cross(a, torch.nn.functional.normalize(middle, dim=-1))


def _across(direction: Tensor) -> Tensor:
    """Return a direction at right angles to another: across its smallest coordinate's axis."""
    least = direction.detach().abs().argmin(-1, keepdim=True)
    axis = torch.zeros_like(direction).scatter(-1, least, 1.0)
    return torch.linalg.cross(direction, axis)


def mean_rotation(
    vectors: Float[Tensor, "*batch N 3"], weights: Float[Tensor, "*#batch N"] | None = None
) -> Float[Tensor, "*batch 3"]:
    """Return the mean of rotations: the quaternion q that maximises sum_n w_n (q . q_n)^2.

    It is the leading eigenvector of sum_n w_n q_n q_n^T, so that q and -q count alike.

    Args:
        vectors: quaternion vectors [..., N, 3].
        weights: [..., N], not negative; equal ones by default.

    Returns:
        Quaternion vector [..., 3] in the unit ball; NaN where a rotation or a weight is, and where all
        weights are zero.

    Raises:
        ShapeError: the last dimension is not 3, or another number of weights. InputError: no rotation, or
            a negative weight.

    Reference: Markley, Cheng, Crassidis & Oshman, Averaging quaternions, 2007, equation (12).
    """
    check_shape("vectors", vectors, ["...", None, 3])
    if vectors.shape[-2] == 0:
        raise InputError("a mean needs at least one rotation, got none")
    quaternions = vector_to_quaternion(vectors)
    weighted = quaternions
    if weights is not None:
        _check_weights(weights, vectors.shape[-2])
        weighted = quaternions * weights[..., None]
    matrix = weighted.mT @ quaternions.to(weighted.dtype)
    mean = safe_eigh(matrix.detach())[1][..., -1]
    # eigenvalues that are equal, as of turns about one axis, have no gradients
    if torch.is_grad_enabled():
        size = torch.finfo(matrix.dtype).eps * matrix.detach().diagonal(dim1=-2, dim2=-1).sum(-1)
        apart = size[..., None] * torch.arange(4).to(matrix)
        same = safe_eigh(matrix + torch.diag_embed(apart))[1][..., -1]
        same = same * (same * mean).detach().sum(-1, keepdim=True).sign()
        mean = mean + (same - same.detach())
    if weights is not None:
        mean = mean.masked_fill((weights == 0).all(-1, keepdim=True), math.nan)
    return quaternion_to_vector(mean)


def _check_weights(weights: Tensor, count: int) -> None:
    """Raise unless there is a weight for each of `count` rotations, and none is negative."""
    check_shape("weights", weights, ["...", count])
    if values_visible() and bool((weights < 0).any()):
        raise InputError(
            f"weights must not be negative, got {float(weights.detach().min()):.3g}; take the exponential of "
            "log-weights"
        )


class RigidMotion(NamedTuple):
    """Holds the motion x -> R x + t: rotation [*batch, 3, 3] (det +1), translation [*batch, 3], metres."""

    rotation: Tensor
    translation: Tensor


def procrustes(
    source: Float[Tensor, "*batch N 3"],
    target: Float[Tensor, "*batch N 3"],
    mask: Bool[Tensor, "*batch N"] | None = None,
) -> RigidMotion:
    """Return the rigid motion without scale or reflection that brings each source closest to its target.

    min over R in SO(3), t of sum_n |R s_n + t - x_n|^2; with the centred cross-covariance
    U S V^T = sum_n x_n s_n^T, R = U diag(1, 1, det(U V^T)) V^T and t = mean x - R mean s.

    Args:
        source, target: [*batch, N, 3], metres; a point with a NaN in either is left out.
        mask: [*batch, N], True = use the point.

    Returns:
        `RigidMotion`; NaN for an element with fewer than three points. With points on one line the
        turn about that line is not determined, and one of the best is returned.

    Reference: Schoenemann (1966), DOI 10.1007/BF02289451; Kabsch (1976) for the sign.

    >>> square = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    >>> procrustes(square, square + 1).translation
    tensor([1., 1., 1.])
    """
    source, target = as_pair(source, target, mask, ["...", None, 3], ("source", "target"))
    use = (torch.isfinite(source) & torch.isfinite(target)).all(-1, keepdim=True)
    if mask is not None:
        use = use & mask[..., None]
    weight = use.to(source.dtype)
    count = weight.sum(-2, keepdim=True)
    s, x = torch.where(use, source, 0.0), torch.where(use, target, 0.0)
    s_mean, x_mean = (points.sum(-2, keepdim=True) / count.clamp_min(1) for points in (s, x))
    rotation = _nearest_rotation(((x - x_mean) * weight).mT @ (s - s_mean))
    translation = x_mean - s_mean @ rotation.mT
    few = count < 3
    return RigidMotion(
        rotation.masked_fill(few, math.nan), translation.masked_fill(few, math.nan).squeeze(-2)
    )


def motion_of_all(
    source: Float[Tensor, "*batch N 3"], target: Float[Tensor, "*batch N 3"]
) -> RigidMotion:
    """Return what `procrustes` does of points of one precision that are all finite, three or more."""
    s_mean, x_mean = (points.mean(-2, keepdim=True) for points in (source, target))
    rotation = _nearest_rotation((target - x_mean).mT @ (source - s_mean))
    return RigidMotion(rotation, (x_mean - s_mean @ rotation.mT).squeeze(-2))


def _nearest_rotation(cross: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return U diag(1, 1, det(U V^T)) V^T of a matrix U S V^T."""
    u, _, vh = torch.linalg.svd(cross)
    sign = torch.linalg.det(u @ vh)
    last = torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign], -1)
    return (u * last[..., None, :]) @ vh
