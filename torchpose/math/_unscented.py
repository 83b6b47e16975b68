"""Transform Gaussians through nonlinear functions, by a few points of equal weight.

All 2 D points, or 2 D + 1 with the mean, weigh the same: they have the Gaussian's own mean and
covariance, and weights of any other kind (a likelihood at each point) turn them into a measured
Gaussian.
"""

import math
from collections.abc import Callable
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from torchpose._core.checks import check_choice, check_shape, check_tensors
from torchpose.errors import InputError
from torchpose.math._gaussian import condition, safe_cholesky, safe_eigh, symmetrise

Directions = Literal["eigen", "cholesky"]
DIRECTIONS: tuple[Directions, ...] = ("eigen", "cholesky")


def sigma_points(
    mean: Float[Tensor, "*#batch D"],
    covariance: Float[Tensor, "*#batch D D"],
    *,
    centre: bool = False,
    directions: Directions = "eigen",
) -> Float[Tensor, "*batch S D"]:
    """Return the points of equal weight that have the mean and the covariance of a Gaussian.

    sigma_d = mu + sqrt(k v_d) e_d,   sigma_{D+d} = mu - sqrt(k v_d) e_d   (DX 2)

    with eigenvalues v_d and eigenvectors e_d, and k = D; or k = D + 1/2 where the mean is a point as
    well. Along a direction of no variance (an eigenvalue of zero, or below it by rounding) both
    points are the mean: nothing is divided by an eigenvalue, and none needs a floor.

    Args:
        mean: mu [..., D]. covariance: [..., D, D], symmetric; only the lower triangle is read.
        centre: with the mean as the first point.
        directions: ``"eigen"`` as published, or ``"cholesky"``: columns of the Cholesky factor in
            place of sqrt(v_d) e_d. They have the same moments and cost a fifth in D = 3, but depend
            on the order of the dimensions.

    Returns:
        [..., S, D], S = 2 D, or 2 D + 1 with the mean first; NaN for a matrix that is not finite.

    Raises:
        ShapeError: sizes that do not go together. InputError: unknown directions.

    Reference: Daubney & Xie, equation (2) and section 5.

    >>> sigma_points(torch.zeros(2), torch.diag(torch.tensor([4.0, 0.0])), centre=True)[:, 0]
    tensor([ 0.0000,  0.0000,  3.1623,  0.0000, -3.1623])
    """
    dim = mean.shape[-1]
    check_shape("covariance", covariance, ["...", dim, dim])
    check_choice("directions", directions, DIRECTIONS)
    if directions == "cholesky":
        axes = safe_cholesky(covariance)
    else:
        values, vectors = safe_eigh(covariance)
        axes = vectors * values.clamp_min(0).sqrt()[..., None, :]
    steps = math.sqrt(dim + 0.5 * centre) * axes.mT  # row d: the step along direction d
    middle = mean[..., None, :]
    points = [middle + steps, middle - steps]
    if centre:
        points = [middle.expand(*points[0].shape[:-2], 1, dim), *points]
    return torch.cat(points, -2)


def moments(
    points: Float[Tensor, "*batch S D"], log_weights: Float[Tensor, "*#batch S"] | None = None
) -> tuple[Float[Tensor, "*batch D"], Float[Tensor, "*batch D D"]]:
    """Return the mean and covariance of weighted points; the covariance is symmetric by construction.

    mu = sum_s w_s p_s,   Sigma = sum_s w_s (p_s - mu)(p_s - mu)^T,   sum_s w_s = 1

    Args:
        points: [..., S, D]. log_weights: [..., S], of any common factor, -inf for a weight of zero;
            equal ones by default. Where all are -inf, NaN comes back.

    Returns:
        Mean [..., D] and covariance [..., D, D], of rank S - 1 at most.

    Raises:
        ShapeError: another number of weights than of points.
    """
    if log_weights is None:
        mean = points.mean(-2, keepdim=True)
        spread = (points - mean) * (1 / math.sqrt(points.shape[-2]))
        return mean.squeeze(-2), spread.mT @ spread
    check_shape("log_weights", log_weights, ["...", points.shape[-2]])
    weights = log_weights.softmax(-1)[..., None].to(points.dtype)
    mean = (weights * points).sum(-2)
    spread = (points - mean[..., None, :]) * weights.sqrt()
    return mean, spread.mT @ spread


def unscented_transform(
    function: Callable[[Tensor], Tensor],
    mean: Float[Tensor, "*#batch D"],
    covariance: Float[Tensor, "*#batch D D"],
    *,
    centre: bool = False,
    directions: Directions = "eigen",
) -> tuple[Tensor, Tensor]:
    """Return the mean and covariance of a function of a Gaussian variable, from its sigma points.

    Both are exact where the function is linear, the mean where it is quadratic; in general they are
    right up to the second order of the function's Taylor series.

    Args:
        function: maps points [..., S, D] to [..., S, E].
        mean: [..., D]. covariance: [..., D, D]. centre, directions: see `sigma_points`. Gradients with
            respect to a covariance with equal eigenvalues need "cholesky".

    Returns:
        Mean [..., E] and covariance [..., E, E].

    Reference: Daubney & Xie, section 3.3; Julier, Uhlmann & Durrant-Whyte, A new approach for
        filtering nonlinear systems, 1995.

    >>> mean, covariance = unscented_transform(torch.square, torch.tensor([3.0]), torch.eye(1))
    >>> mean  # of the square of N(3, 1): 3^2 + 1
    tensor([10.])
    """
    points = sigma_points(mean, covariance, centre=centre, directions=directions)
    return moments(function(points))


def unscented_update(
    function: Callable[[Tensor], Tensor],
    mean: Float[Tensor, "*#batch D"],
    covariance: Float[Tensor, "*#batch D D"],
    measured: Float[Tensor, "*#batch Z"],
    noise: Float[Tensor, "*#batch Z Z"],
    *,
    centre: bool = False,
    directions: Directions = "eigen",
) -> tuple[Float[Tensor, "*batch D"], Float[Tensor, "*batch D D"], Float[Tensor, "*batch"]]:
    """Compute the measurement update of an unscented Kalman filter: z = h(x) + N(0, R).

    K = C S^-1,   mu' = mu + K (z - mu_h),   Sigma' = Sigma - K S K^T,   S = Sigma_h + R

    with mean mu_h, covariance Sigma_h and covariance with the state C of h at the sigma points.

    Args:
        function: h, maps points [..., S, D] to [..., S, Z].
        mean: mu [..., D]. covariance: Sigma [..., D, D]. measured: z [..., Z]. noise: R [..., Z, Z].
        centre, directions: see `unscented_transform`.

    Returns:
        mu' [..., D], Sigma' [..., D, D] and the log-likelihood log N(z; mu_h, S) [...].

    Raises:
        ShapeError: sizes that do not go together. InputError: no tensors, or unknown directions.
    """
    check_tensors(mean=mean, covariance=covariance, measured=measured, noise=noise)
    points = sigma_points(mean, covariance, centre=centre, directions=directions)
    check_shape("measured", measured, ["...", "Z"])
    dim, count = points.shape[-1], measured.shape[-1]
    check_shape("noise", noise, ["...", count, count])
    seen = function(points)
    check_tensors(**{"what function returns": seen})
    check_shape("what function returns", seen, ["...", points.shape[-2], count])
    joint_mean, joint = moments(torch.cat([points, seen], -1))
    joint = joint + pad(noise, (dim, 0, dim, 0))
    given = torch.arange(dim, joint_mean.shape[-1], device=mean.device)
    return condition(joint_mean, joint, given, measured)


def floor_eigenvalues(
    covariance: Float[Tensor, "*batch D D"], least: float
) -> Float[Tensor, "*batch D D"]:
    """Return the covariances whose eigenvalues below `least` are raised to it; their eigenvectors stay.

    What few points measured has no variance across them (two points and five of no weight: rank 1),
    and would outweigh everything else there.

    Args:
        covariance: [..., D, D], symmetric. least: variance, positive or zero.

    Raises:
        InputError: a negative `least`.
    """
    if not 0 <= least < math.inf:
        raise InputError(f"least must be a variance, zero or more and finite, got {least}")
    values, vectors = safe_eigh(covariance)
    return symmetrise((vectors * values.clamp_min(least)[..., None, :]) @ vectors.mT)
