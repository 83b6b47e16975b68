"""Survival rate of weighted particles, and the exponent of the weights that brings one about."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.errors import InputError

__all__ = [
    "LEAST_SURVIVORS",
    "check_survival_rate",
    "survival_exponent",
    "survival_rate",
    "survival_rate_per_frame",
]

LEAST_SURVIVORS = 2.0
"""Particles that a survival rate must leave: one alone is no distribution."""

_REACH = 30.0  # of the search, in log beta, on either side of where it starts
_MOST_STEPS = 60
_TOLERANCE = 1e-9  # in log alpha


def survival_rate(log_weights: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch"]:
    """Return the share of the particles that resampling is expected to keep.

    alpha = (sum_n w_n)^2 / (N sum_n w_n^2)

    Args:
        log_weights: [..., N], normalised or not; -inf is a weight of zero.

    Returns:
        alpha [...], from 1 / N to 1; NaN where every weight is zero.

    Reference:
        Deutscher & Reid (2005), doi:10.1023/B:VISI.0000043757.18370.9c, section 4.

    >>> survival_rate(torch.tensor([0.5, 0.5, 0.0, 0.0]).log())
    tensor(0.5000)
    """
    n = log_weights.shape[-1]
    total = torch.logsumexp(log_weights, -1)
    return torch.exp(2 * total - torch.logsumexp(2 * log_weights, -1) - math.log(n))


def survival_exponent(
    log_weights: Float[Tensor, "*batch N"], rate: float
) -> Float[Tensor, "*batch"]:
    """Return the exponent beta for which a given share of the particles survives.

    alpha = (sum_n w_n^beta)^2 / (N sum_n w_n^(2 beta))

    alpha falls from 1 to the share of the best particle as beta rises, so the root is unique; it is
    found by Newton's method in log beta, kept inside a bracket.

    Args:
        log_weights: [..., N], normalised or not; -inf is a weight of zero and stays one.
        rate: alpha, between 0 and 1.

    Returns:
        beta [...], float64. 1 where all weights are equal (or all zero). Where no exponent reaches
        the rate, the nearest end: about 0 if fewer particles than that are alive, very large if more
        than that share the largest weight.

    Raises:
        InputError: a rate that is not between 0 and 1.

    Reference:
        Deutscher & Reid (2005), doi:10.1023/B:VISI.0000043757.18370.9c, section 4.2; Daubney & Xie,
        section 7.

    >>> log_weights = torch.linspace(-1, 0, 100, dtype=torch.float64)
    >>> beta = survival_exponent(log_weights, 0.5)
    >>> survival_rate(beta * log_weights)
    tensor(0.5000, dtype=torch.float64)
    """
    if not 0 < rate < 1:
        raise InputError(f"a survival rate must lie between 0 and 1, got {rate}")
    relative = log_weights.double()
    relative = relative - relative.amax(-1, keepdim=True)
    alive = torch.isfinite(relative)
    relative = torch.where(alive, relative, 0.0)
    n_alive = alive.sum(-1).clamp_min(1)
    mean = relative.sum(-1) / n_alive
    spread = torch.where(alive, relative - mean[..., None], 0.0).square().sum(-1) / n_alive
    level = spread <= 1e-30
    # exact for log-weights that are normally distributed: alpha = exp(-beta^2 var)
    start = 0.5 * (math.log(-math.log(rate)) - torch.where(level, 1.0, spread).log())
    beta = _solve(relative, alive, start, math.log(rate * relative.shape[-1])).exp()
    return torch.where(level, torch.ones_like(beta), beta)


def _solve(relative: Tensor, alive: Tensor, start: Tensor, target: float) -> Tensor:
    """Return log beta at which 2 log sum w^beta - log sum w^(2 beta) is the target."""
    low, high, u = start - _REACH, start + _REACH, start
    for _ in range(_MOST_STEPS):
        beta = u.exp()
        scaled = torch.where(alive, beta[..., None] * relative, -torch.inf)
        once, twice = torch.logsumexp(scaled, -1), torch.logsumexp(2 * scaled, -1)
        value = 2 * once - twice - target
        if bool((value.abs() < _TOLERANCE).all()):
            break
        low, high = torch.where(value > 0, u, low), torch.where(value > 0, high, u)
        gap = (scaled - once[..., None]).exp() - (2 * scaled - twice[..., None]).exp()
        slope = 2 * beta * (gap * relative).sum(-1)
        newton = u - value / slope
        inside = (newton > low) & (newton < high)
        u = torch.where(inside, newton, (low + high) / 2)
    return u


def check_survival_rate(rate: float, n_particles: int) -> None:
    """Raise unless a share of this many particles can survive.

    2 / N <= alpha < 1. No exponent leaves fewer than one particle, alpha = 1 / N; a rate near it
    hands the whole frame to the best particle.

    Args:
        rate: alpha, per frame. n_particles: N.

    Raises:
        InputError: a rate that is not below 1, or that leaves fewer than `LEAST_SURVIVORS`.
    """
    if not 0 < rate < 1:
        raise InputError(f"survival_rate must lie between 0 and 1, got {rate}")
    if rate * n_particles < LEAST_SURVIVORS * (1 - 1e-9):
        least = LEAST_SURVIVORS / n_particles
        way = f"ask for {least:.3g} or more" if least < 1 else "take more particles"
        raise InputError(
            f"survival_rate of {rate:.3g} leaves {rate * n_particles:.2g} of {n_particles} particles, "
            f"fewer than {LEAST_SURVIVORS:g}; {way}. A rate per second "
            "leaves the fewer in a frame, the fewer frames a second has"
        )


def survival_rate_per_frame(per_second: float, fps: float) -> float:
    """Return the rate per frame that keeps the same share of the particles over a second.

    alpha = exp(ln(alpha_c) / N_t)

    Args:
        per_second: alpha_c, between 0 and 1. fps: N_t, frames per second.

    Raises:
        InputError: a rate that is not between 0 and 1, or a frame rate that is not positive.

    Reference:
        Daubney & Xie, section 7: 0.01 at 60 Hz is 0.93 per frame.

    >>> round(survival_rate_per_frame(0.01, 60.0), 2)
    0.93
    """
    if not 0 < per_second < 1:
        raise InputError(f"a survival rate must lie between 0 and 1, got {per_second}")
    if not 0 < fps < math.inf:
        raise InputError(f"fps must be positive and finite, got {fps}")
    return per_second ** (1 / fps)
