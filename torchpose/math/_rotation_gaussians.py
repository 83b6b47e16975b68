"""Compute with Gaussians over rotations, in a space where a rotation is a vector of three numbers.

A vector x in the unit ball stands for the rotation C R(x): R(x) turns by x as a quaternion vector
(`torchpose.math._rotations`: axis times the sine of half the angle), and the centre C is a
rotation in the middle of the data, given by its own quaternion vector, none being no rotation. Near
the centre the space is flat and half as long as the angle in radians; at |x| = 1, half a turn from
the centre, x and -x are one rotation and the space has an edge. A Gaussian that stays well inside is
a Gaussian over rotations; `angle_to_edge` says how far recorded rotations stay inside. One that
reaches the edge is cut there: sigma points beyond it are put onto it, and where a mean is turned to
near |x'| = 1 the points that go across fold back inside, so that the covariance comes out too small
and the mean too near to the centre. Choose another centre in that case.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_finite, check_shape, check_tensors
from torchpose.errors import InputError
from torchpose.math._rotations import compose, conjugate, vector_to_quaternion
from torchpose.math._unscented import Directions, moments, sigma_points

_CHUNK = 1 << 22  # products of two quaternions at a time, 32 MB

# a b = _LEFT(a) b = _RIGHT(b) a for quaternions (x, y, z, w): row i, column j holds the entry of the
# factor that is taken there, 1 to 4, and its sign.
_LEFT = ((4, -3, 2, 1), (3, 4, -1, 2), (-2, 1, 4, 3), (-1, -2, -3, 4))
_RIGHT = ((4, 3, -2, 1), (-3, 4, 1, 2), (2, -1, 4, 3), (-1, -2, -3, 4))


def safe_centre(vectors: Float[Tensor, "*batch N 3"]) -> Float[Tensor, "*batch 3"]:
    """Return the training rotation that all others are nearest to: centre of a safe space for them.

    arg max_{q_i} 1/m sum_j (q_i^-1 q_j) . [1, 0, 0, 0]   (DX 1)

    The scalar part is taken without its sign, as q and -q are one rotation. It takes time N^2: for
    more than some ten thousand rotations pass every n-th.

    Args:
        vectors: q_j as quaternion vectors [..., N, 3].

    Returns:
        One of them, [..., 3].

    Raises:
        InputError: no rotation, or not finite.

    Reference: Daubney & Xie, equation (1).

    >>> safe_centre(torch.tensor([[0.1, 0.0, 0.0], [0.3, 0.0, 0.0], [0.9, 0.0, 0.0]]))
    tensor([0.3000, 0.0000, 0.0000])
    """
    check_shape("vectors", vectors, ["...", None, 3])
    count = vectors.shape[-2]
    if count == 0:
        raise InputError("a centre needs at least one rotation, got none")
    check_finite("vectors", vectors)
    quaternions = vector_to_quaternion(vectors)
    rows = max(1, _CHUNK // max(1, quaternions[..., 0].numel()))
    near = [(part @ quaternions.mT).abs().mean(-1) for part in quaternions.split(rows, dim=-2)]
    best = torch.cat(near, -1).argmax(-1)
    return vectors.gather(-2, best[..., None, None].expand(*best.shape, 1, 3)).squeeze(-2)


def angle_to_edge(
    vectors: Float[Tensor, "*batch N 3"], centre: Float[Tensor, "*#batch 3"] | None = None
) -> Float[Tensor, "*batch"]:
    """Return the least angle between the rotations and the edge of the space around a centre.

    pi - 2 arcsin(max_n |x_n|): 0 at the edge |x| = 1, pi where all rotations are the centre.

    Args:
        vectors: rotations as quaternion vectors without a centre, [..., N, 3].
        centre: its quaternion vector [..., 3]; no rotation by default.

    Returns:
        Radians [...]. Below half a radian a Gaussian over them is cut by the edge.

    Raises:
        ShapeError: the last dimension is not 3, as of quaternions. InputError: no rotation.
    """
    local = _around(vectors, centre)
    quaternions = vector_to_quaternion(local)
    half = torch.atan2(quaternions[..., 3], quaternions[..., :3].norm(dim=-1))
    return 2 * half.amin(-1)


def fit_gaussian(
    vectors: Float[Tensor, "*batch N 3"],
    centre: Float[Tensor, "*#batch 3"] | None = None,
    log_weights: Float[Tensor, "*#batch N"] | None = None,
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3 3"]]:
    """Return the mean and covariance of rotations in the space around a centre.

    Args:
        vectors: rotations as quaternion vectors without a centre, [..., N, 3].
        centre: its quaternion vector [..., 3]; no rotation by default.
        log_weights: [..., N], of any common factor; equal ones by default.

    Returns:
        Mean [..., 3] and covariance [..., 3, 3] of the quaternion vectors relative to the centre.

    Raises:
        ShapeError: the last dimension is not 3, as of quaternions, or another number of weights.
        InputError: no rotation.
    """
    return moments(_around(vectors, centre), log_weights)


def _around(vectors: Tensor, centre: Tensor | None) -> Float[Tensor, "*batch N 3"]:
    """Return checked rotations relative to a centre."""
    check_shape("vectors", vectors, ["...", None, 3])
    if vectors.shape[-2] == 0:
        raise InputError("expected at least one rotation, got none")
    return vectors if centre is None else compose(conjugate(centre)[..., None, :], vectors)


def rotate_gaussian(
    rotation: Float[Tensor, "*#batch 3"],
    mean: Float[Tensor, "*#batch 3"],
    covariance: Float[Tensor, "*#batch 3 3"],
    *,
    centre: Float[Tensor, "*#batch 3"] | None = None,
    new_centre: Float[Tensor, "*#batch 3"] | None = None,
    directions: Directions = "eigen",
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3 3"]]:
    """Return F(q, N(x)), the Gaussian of q C R(x): a known rotation applied after one that is uncertain.

    N(x'; mu', Sigma') = F(q, N(x; mu, Sigma)),   C' R(x') = q C R(x),   by sigma points (DX 2)

    An uncertain limb q_ij = C R(x) on an upper limb q_i = q makes a lower limb q_j (DX 3).

    Args:
        rotation: q, a quaternion vector without a centre, [..., 3].
        mean, covariance: mu [..., 3] and Sigma [..., 3, 3], in the space around C.
        centre: C. new_centre: C', of the space of the result. Quaternion vectors [..., 3]; no
            rotation by default.
        directions: the directions of the sigma points.

    Returns:
        mu' [..., 3] and Sigma' [..., 3, 3], symmetric. See the module for what happens at its edge.

    Raises:
        ShapeError: sizes that do not go together, as of a quaternion. InputError: no tensors, or unknown
            directions.

    Reference: Daubney & Xie, section 3.3 and equation (3).
    """
    _check_turn(rotation, mean, covariance)
    left = rotation if centre is None else compose(rotation, centre)
    left = left if new_centre is None else compose(conjugate(new_centre), left)
    return turn_gaussian(mean, covariance, left=left, directions=directions)


def gaussian_rotate(
    mean: Float[Tensor, "*#batch 3"],
    covariance: Float[Tensor, "*#batch 3 3"],
    rotation: Float[Tensor, "*#batch 3"],
    *,
    centre: Float[Tensor, "*#batch 3"] | None = None,
    new_centre: Float[Tensor, "*#batch 3"] | None = None,
    directions: Directions = "eigen",
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3 3"]]:
    """Return F(N(x), q), the Gaussian of C R(x) q: an uncertain rotation applied after one that is known.

    N(x'; mu', Sigma') = F(N(x; mu, Sigma), q),   C' R(x') = C R(x) q,   by sigma points (DX 2)

    An upper limb q_i = C R(x) carries its uncertainty on to the lower limb q_j = q_i q_ij (DX 10).

    Args:
        mean, covariance: mu [..., 3] and Sigma [..., 3, 3], in the space around C.
        rotation: q, a quaternion vector without a centre, [..., 3].
        centre: C. new_centre: C', of the space of the result. Quaternion vectors [..., 3]; no
            rotation by default.
        directions: the directions of the sigma points, see `rotate_gaussian`.

    Returns:
        mu' [..., 3] and Sigma' [..., 3, 3], symmetric.

    Raises:
        ShapeError, InputError: as `rotate_gaussian`.

    Reference: Daubney & Xie, section 3.3 and equation (10).
    """
    _check_turn(rotation, mean, covariance)
    left = centre
    if new_centre is not None:
        left = conjugate(new_centre) if centre is None else compose(conjugate(new_centre), centre)
    return turn_gaussian(mean, covariance, left=left, right=rotation, directions=directions)


def _check_turn(rotation: Tensor, mean: Tensor, covariance: Tensor) -> None:
    """Raise unless a rotation and a mean are vectors of three numbers."""
    check_tensors(rotation=rotation, mean=mean, covariance=covariance)
    for name, vector in (("rotation", rotation), ("mean", mean)):
        check_shape(name, vector, ["...", 3])


def turn_gaussian(
    mean: Float[Tensor, "*#batch 3"],
    covariance: Float[Tensor, "*#batch 3 3"],
    *,
    left: Float[Tensor, "*#batch 3"] | None = None,
    right: Float[Tensor, "*#batch 3"] | None = None,
    directions: Directions = "eigen",
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3 3"]]:
    """Return the Gaussian of an uncertain rotation between two known ones, R(x') = a R(x) b.

    Products of quaternions are linear, so that a and b make one matrix of four rows for all sigma
    points. Each of them comes out as the quaternion of the two, q or -q, that is nearer to the
    image of the mean, whose own scalar part is not negative; the moments are those of the vectors.

    Args:
        mean: [..., 3]. covariance: [..., 3, 3].
        left: a. right: b. Quaternion vectors [..., 3], none for no rotation.
        directions: the directions of the sigma points.
    """
    quaternions = sigma_quaternions(mean, covariance, directions)
    if left is not None:
        turn = left_matrix(vector_to_quaternion(left.to(quaternions)))
        if right is not None:
            turn = turn @ right_matrix(vector_to_quaternion(right.to(quaternions)))
        quaternions = quaternions @ turn.mT
    elif right is not None:
        quaternions = quaternions @ right_matrix(vector_to_quaternion(right.to(quaternions))).mT
    return quaternion_moments(quaternions)


def sigma_quaternions(
    mean: Float[Tensor, "*#batch 3"],
    covariance: Float[Tensor, "*#batch 3 3"],
    directions: Directions = "eigen",
) -> Float[Tensor, "*batch 7 4"]:
    """Return the quaternions (x, y, z, w) of the mean and of the six sigma points, in this order."""
    points = sigma_points(mean, covariance, directions=directions)
    middle = mean[..., None, :].expand(*points.shape[:-2], 1, 3)
    return vector_to_quaternion(torch.cat([middle, points], -2))


def quaternion_moments(
    quaternions: Float[Tensor, "*batch 7 4"],
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3 3"]]:
    """Return mean and covariance of the vectors of six sigma points, from their turned quaternions.

    Args:
        quaternions: [..., 7, 4], the image of the mean first, for its hemisphere alone.
    """
    image = quaternions[..., :1, :]
    alike = (quaternions[..., 1:, :] @ image.mT) * _sign(image[..., 3:])
    return moments(quaternions[..., 1:, :3] * _sign(alike))


def left_matrix(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Return the matrix that multiplies quaternions by another from the left: L(a) b = a b."""
    return _product_matrix(quaternion, _LEFT)


def right_matrix(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Return the matrix that multiplies quaternions by another from the right: R(a) b = b a."""
    return _product_matrix(quaternion, _RIGHT)


def _sign(values: Tensor) -> Tensor:
    """Return -1 below zero and 1 elsewhere."""
    return torch.where(values < 0.0, -1.0, 1.0).to(values.dtype)


def _product_matrix(quaternion: Tensor, layout: tuple[tuple[int, ...], ...]) -> Tensor:
    places = torch.tensor(layout, device=quaternion.device)
    signs = places.sign().to(quaternion.dtype)
    return quaternion[..., places.abs() - 1] * signs
