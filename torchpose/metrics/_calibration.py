"""Measure the calibration of covariances: coverage, reliability curve, predictive log-likelihood.

Pure functions on tensors; chi-square needs no scipy. What is missing (NaN or masked) is left out of
every share, and the counts say how much was not.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.checks import check_shape
from torchpose._core.value_pairs import as_pair, as_values
from torchpose.errors import InputError
from torchpose.math._gaussian import log_prob, safe_cholesky

RELIABILITY_LEVELS = tuple(round(0.05 * i, 2) for i in range(1, 20))


class Coverage(NamedTuple):
    """Holds the share of true joints inside the ellipsoids of nominal probability `levels`.

    Attributes:
        levels: nominal probability [L].
        overall: all joints pooled [L].
        per_joint: [L, J].
        counts: joints that were counted [J].
    """

    levels: Tensor
    overall: Tensor
    per_joint: Tensor
    counts: Tensor


def chi2_cdf(x: Float[Tensor, "*batch"], dof: int = 3) -> Float[Tensor, "*batch"]:
    """Return the distribution function of chi-square, P(dof/2, x/2) with the lower incomplete gamma function.

    >>> chi2_cdf(torch.tensor([7.8147]))
    tensor([0.9500])
    """
    x = as_values("x", x, ["..."])
    half = torch.full_like(x, dof / 2)
    return torch.special.gammainc(half, x.clamp_min(0) / 2)


def chi2_quantile(p: Float[Tensor, "*batch"], dof: int = 3) -> Float[Tensor, "*batch"]:
    """Return the inverse of `chi2_cdf`, by bisection in float64; 0 at p = 0, infinite at p = 1.

    The squared radius of the ellipsoid that holds probability p of a Gaussian in `dof` dimensions.

    Raises:
        InputError: a p outside [0, 1].

    >>> chi2_quantile(torch.tensor([0.5, 0.9], dtype=torch.float64))
    tensor([2.3660, 6.2514], dtype=torch.float64)
    """
    p = as_values("p", p, ["..."])
    if not bool(((p >= 0) & (p <= 1)).all()):
        raise InputError(f"p must be probabilities in [0, 1], got {p.tolist()!s:.120}")
    wide = p.double()
    # Over the radius, which resolves the small quantiles better than its square.
    low, high = torch.zeros_like(wide), torch.full_like(wide, (100.0 + 10.0 * dof) ** 0.5)
    for _ in range(64):
        middle = (low + high) / 2
        below = chi2_cdf(middle.square(), dof) < wide
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    quantile = torch.where(wide == 0, torch.zeros_like(wide), ((low + high) / 2).square())
    return torch.where(wide == 1, torch.full_like(wide, math.inf), quantile).to(p.dtype)


def mahalanobis_squared(
    estimate: Float[Tensor, "*batch J D"],
    covariance: Float[Tensor, "*batch J D D"],
    truth: Float[Tensor, "*batch J D"],
    mask: Bool[Tensor, "*batch J"] | None = None,
) -> Float[Tensor, "*batch J"]:
    """Return the squared distance (x - m)^T C^-1 (x - m) of each true joint from its estimate.

    Returns:
        [*batch, J]; NaN where masked, where anything is NaN, and where C is not positive definite.
    """
    estimate, truth = as_pair(estimate, truth, mask, ["...", None, None])
    dim = estimate.shape[-1]
    check_shape("covariance", covariance, [*estimate.shape, dim])
    covariance = as_values("covariance", covariance, ["...", None, None]).to(estimate)
    known = torch.isfinite(covariance).all(-1).all(-1)
    eye = torch.eye(dim, dtype=covariance.dtype, device=covariance.device)
    factor = safe_cholesky(torch.where(known[..., None, None], covariance, eye))
    residual = (truth - estimate)[..., None]
    white = torch.linalg.solve_triangular(factor, residual, upper=False)
    squared = white.square().sum((-2, -1))
    known = known & torch.isfinite(squared)
    return squared.masked_fill(~known if mask is None else ~(known & mask), math.nan)


def coverage(
    estimate: Float[Tensor, "*batch J D"],
    covariance: Float[Tensor, "*batch J D D"],
    truth: Float[Tensor, "*batch J D"],
    levels: Sequence[float] | Float[Tensor, " L"] = (0.5, 0.9),
    mask: Bool[Tensor, "*batch J"] | None = None,
) -> Coverage:
    """Return the share of true joints that lie inside the ellipsoids of the given probabilities.

    Inside at level p: (x - m)^T C^-1 (x - m) <= q_p, q_p the chi-square quantile with D degrees of
    freedom. A calibrated tracker has a share of p. Align first (`align` turns C as well).

    Args:
        estimate, truth: [*batch, J, D], D = 3 (metres) or 2 (pixels).
        covariance: [*batch, J, D, D], of the estimate.
        levels: [L], nominal probabilities.
        mask: [*batch, J], True = count this joint.

    Returns:
        `Coverage`; joints whose distance is NaN (see `mahalanobis_squared`) are left out.
    """
    estimate = as_values("estimate", estimate, ["...", None, None])
    nominal = torch.as_tensor(levels, dtype=torch.float64, device=estimate.device)
    check_shape("levels", nominal, ["L"])
    squared = mahalanobis_squared(estimate, covariance, truth, mask)
    flat = squared.reshape(-1, squared.shape[-1])
    count = (~flat.isnan()).sum(0)
    radius = chi2_quantile(nominal, estimate.shape[-1])
    inside = (flat <= radius[:, None, None]).sum(1).double()
    return Coverage(nominal, inside.sum(-1) / count.sum(), inside / count, count)


def reliability(
    estimate: Float[Tensor, "*batch J D"],
    covariance: Float[Tensor, "*batch J D D"],
    truth: Float[Tensor, "*batch J D"],
    levels: Sequence[float] = RELIABILITY_LEVELS,
    mask: Bool[Tensor, "*batch J"] | None = None,
) -> Coverage:
    """Return `coverage` over a grid of levels, 5 to 95 %: the curve of a reliability diagram.

    Args:
        estimate, truth: [*batch, J, D], D = 3 (metres) or 2 (pixels).
        covariance: [*batch, J, D, D], of the estimate, in squares of that unit.
        levels: [L], nominal probabilities.
        mask: [*batch, J], True = count this joint.

    Returns:
        `Coverage` at the L levels.

    Raises:
        ShapeError, InputError: as `coverage`.
    """
    return coverage(estimate, covariance, truth, levels, mask)


def calibration_error(curve: Coverage) -> Float[Tensor, " J"]:
    """Return the largest gap |share - nominal| over the levels, per joint (0.05 = 5 points).

    Args:
        curve: the curve from `reliability` or `coverage`, L levels and J joints.

    Returns:
        [J], 0 to 1 (0.05 = 5 points); NaN for a joint without counts.
    """
    return (curve.per_joint - curve.levels[:, None]).abs().amax(0)


def predictive_log_likelihood(
    log_weights: Float[Tensor, "*batch M"],
    means: Float[Tensor, "*batch M D"],
    covariance: Float[Tensor, "*batch M D D"],
    value: Float[Tensor, "*batch D"],
) -> Float[Tensor, "*batch"]:
    """Return the log density of observed values under a mixture that predicted them.

    log sum_m w_m N(value; mean_m, C_m), the weights normalised here.

    Args:
        log_weights: [*batch, M]. means: [*batch, M, D]. value: [*batch, D], pixels or metres.
        covariance: [*batch, M, D, D], with the measurement noise if `value` is a measurement.

    Returns:
        [*batch], nats; NaN where `value` is NaN.
    """
    means = as_values("means", means, ["...", None, None])
    *batch, count, dim = means.shape
    covariance = as_values("covariance", covariance, [*batch, count, dim, dim]).to(means)
    value = as_values("value", value, [*batch, dim]).to(means)
    log_weights = as_values("log_weights", log_weights, [*batch, count]).to(means)
    log_weights = torch.log_softmax(log_weights, -1)
    each = log_prob(value[..., None, :], means, safe_cholesky(covariance))
    return torch.logsumexp(log_weights + each, -1)
