"""The state of a mixture Kalman filter, and the estimate that its tracks make together."""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

__all__ = ["MKFState", "estimate_of", "within_and_between"]


class MKFState(NamedTuple):
    """Weighted Kalman tracks.

    Attributes:
        log_weights: log w that the next step starts from (epsilon mixed in), [B, M].
        mean: track means [B, M, D]. cov: track covariances [G, M, D, D], float64.
        group: which row of `cov` each element has, [B]; elements whose histories of masks and
            noise are the same share one row.
        time: number of frames seen.
    """

    log_weights: Tensor
    mean: Tensor
    cov: Tensor
    group: Tensor
    time: int


def estimate_of(
    log_weights: Float[Tensor, "B M"], mean: Float[Tensor, "B M D"], cov: Tensor | None
) -> tuple[Float[Tensor, "B D"], Tensor | None]:
    """Weighted mean (BL 48), and the covariance within and between tracks if `cov` is given."""
    weights = log_weights.exp()
    estimate = (weights[:, None, :] @ mean)[:, 0]
    if cov is None:
        return estimate, None
    return estimate, within_and_between(weights, mean, estimate, cov)


def within_and_between(weights: Tensor, mean: Tensor, estimate: Tensor, cov: Tensor) -> Tensor:
    """sum_j w_j (P_j + (m_j - m)(m_j - m)^T), P [M, D, D] or [B, M, D, D]; all else [B, ...]."""
    spread = (mean - estimate[:, None]) * weights[..., None].sqrt()
    flat = cov.flatten(-2).to(weights.dtype)
    within = weights @ flat if cov.ndim == 3 else (weights[:, None] @ flat)[:, 0]
    return within.unflatten(-1, cov.shape[-2:]) + spread.mT @ spread
