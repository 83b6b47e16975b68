"""Transition models: a mixture of discrete Ornstein-Uhlenbeck processes, one per prior component."""

import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.value_checks import values_visible
from torchpose.errors import InputError
from torchpose.math.gaussian import safe_cholesky, symmetrise

__all__ = [
    "BURN_IN_SCALE",
    "TRANSITIONS",
    "Transition",
    "check_transition_options",
    "inflation",
    "make_transition",
]

TRANSITIONS = ("paper", "stationary", "ou")
BURN_IN_SCALE = 100.0
"""Factor of Q in the first frame of a burn-in, where none is given."""


class Transition(NamedTuple):
    """x_t = F x_{t-1} + b + N(0, N), one linear-Gaussian model per component.

    Attributes:
        matrix: F [K, D, D]. offset: b = (I - F) mu [K, D]. noise: N [K, D, D].
    """

    matrix: Tensor
    offset: Tensor
    noise: Tensor


def check_transition_options(
    kind: str,
    gamma: Any,
    subspace: int | None,
    burn_in: int,
    burn_in_scale: float | None,
) -> None:
    """Refuse a transition that does not exist, and options that the chosen one does not use.

    Args:
        kind: one of `TRANSITIONS`. gamma, subspace: of "ou", None where they were not given.
        burn_in: number of frames with an inflated Q, which "ou" has not. burn_in_scale: factor of Q
            in the first of them, None where it was not given.

    Raises:
        InputError: an unknown kind, an option without use, or a burn-in out of range.
    """
    if kind not in TRANSITIONS:
        raise InputError(f"transition must be one of {', '.join(TRANSITIONS)}, got {kind!r}")
    for name, value in (("gamma", gamma), ("subspace", subspace)):
        if kind != "ou" and value is not None:
            raise InputError(f"{name} does not apply to transition {kind!r}; it is of 'ou'")
    whole = isinstance(burn_in, int) and not isinstance(burn_in, bool)
    scale = BURN_IN_SCALE if burn_in_scale is None else burn_in_scale
    if not whole or burn_in < 0 or not (math.isfinite(scale) and scale > 0):
        raise InputError(
            "burn_in must be a number of frames >= 0 and burn_in_scale a positive factor of Q, "
            f"got {burn_in} and {scale}"
        )
    if burn_in and kind == "ou":
        raise InputError("burn_in inflates Q, which transition 'ou' does not use; leave it at 0")
    if burn_in == 0 and burn_in_scale is not None:
        raise InputError(f"burn_in_scale is of a burn-in: got {scale} and burn_in = 0")


def inflation(time: int, burn_in: int, scale: float) -> float:
    """Return the factor of Q in frame `time` (0-based): from `scale` geometrically to 1.

    Q_t = scale^(1 - t / burn_in) Q, and Q after the burn-in.
    """
    return 1.0 if time >= burn_in else scale ** (1 - time / burn_in)


def make_transition(
    kind: str,
    means: Float[Tensor, "K D"],
    covariances: Float[Tensor, "K D D"],
    process_cov: Float[Tensor, "D D"],
    gamma: Float[Tensor, "*K"] | None = None,
    subspace: int | None = None,
) -> Transition:
    """Return the transition of every component.

    - ``paper``: F = Sigma (Q + Sigma)^-1, N = Sigma (Q + Sigma)^-1 Q   (BL 31-32, 35-37). It settles
      at Sigma (2 Sigma + Q)^-1 (Sigma + Q), less than Sigma: hidden joints come out too certain.
    - ``stationary``: the paper's F with N = Sigma - F Sigma F^T, which settles at Sigma itself.
    - ``ou``: F = gamma I, N = (1 - gamma^2) Sigma, one gamma per component, which settles at Sigma.
      With `subspace` d, gamma acts on the d leading principal directions U of each Sigma,
      F = gamma U U^T, and the others are drawn anew in each step; N = Sigma - F Sigma F^T.

    Sigma is never inverted: with S = Q + Sigma, F = Sigma S^-1 and I - F = Q S^-1 come from one
    Cholesky factor, and N = F Q F^T + (I - F) Sigma (I - F)^T is symmetric term by term.

    Args:
        kind: "paper", "stationary" or "ou".
        means, covariances: of the prior's components, [K, D] and [K, D, D].
        process_cov: Q [D, D]; not used by "ou".
        gamma: [K] or [], in [0, 1); only for "ou".
        subspace: number of principal directions, only for "ou".

    Raises:
        InputError: unknown kind, or gamma missing or outside [0, 1).
    """
    if kind == "ou":
        return _scalar_rate(means, covariances, gamma, subspace)
    if kind not in TRANSITIONS:
        raise InputError(f"transition must be one of {', '.join(TRANSITIONS)}, got {kind!r}")
    factor = safe_cholesky(covariances + process_cov)
    matrix = torch.cholesky_solve(covariances, factor).mT
    rest = torch.cholesky_solve(process_cov.expand_as(covariances), factor).mT
    offset = (rest @ means[..., None])[..., 0]
    noise = matrix @ process_cov @ matrix.mT + rest @ covariances @ rest.mT
    if kind == "stationary":
        # Sigma - F Sigma F^T = N + (I - F) Sigma F^T, and (I - F) Sigma is the paper's N itself.
        noise = noise + noise @ matrix.mT
    return Transition(matrix, offset, symmetrise(noise))


def _scalar_rate(
    means: Tensor, covariances: Tensor, gamma: Tensor | None, subspace: int | None
) -> Transition:
    if gamma is None:
        raise InputError(
            "transition 'ou' needs gamma, [K] or a number in [0, 1), got None; "
            "fit it with torchpose.filters.fit_gamma or pass for instance 0.95"
        )
    with torch.no_grad():
        outside = (gamma < 0) | (gamma >= 1) | ~torch.isfinite(gamma)
        if values_visible() and bool(outside.any()):
            raise InputError(f"gamma must lie in [0, 1), got {gamma.tolist()}")
    rate = gamma.expand(means.shape[0])[:, None, None]
    dim = means.shape[-1]
    eye = torch.eye(dim, dtype=means.dtype, device=means.device)
    if subspace is None:
        matrix = rate * eye
        noise = (1 - rate.square()) * covariances
    else:
        if not 1 <= subspace <= dim:
            raise InputError(f"subspace must lie between 1 and {dim}, got {subspace}")
        directions = torch.linalg.eigh(covariances)[1][..., dim - subspace :]
        matrix = rate * (directions @ directions.mT)
        noise = covariances - matrix @ covariances @ matrix.mT
    offset = ((eye - matrix) @ means[..., None])[..., 0]
    return Transition(matrix, offset, symmetrise(noise))
