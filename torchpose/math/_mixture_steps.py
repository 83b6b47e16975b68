"""Take the two steps of expectation-maximisation for Gaussian mixtures with full covariances.

With the features phi(x) = [1, x_i, x_i x_j (i <= j)] of a point, the log of every term of a mixture
is a product theta_k . phi(x), and what the maximisation step needs is sum_n r_nk phi(x_n): one
matrix product each way. The table of these sums, [K, 1 + D + D (D + 1) / 2], is all that processes
have to exchange: each runs `e_step` on its share of the points, one merges, all run `m_step`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.errors import CovarianceError
from torchpose.math._gaussian import least_exponent, symmetrise


class CyclicFeatures:
    """Computes phi(x) = [1, x_i, x_i x_(i + s mod D)] of chunk after chunk of points.

    Over all i, with s from 0 to D / 2, every pair of dimensions comes once (for even D and s = D / 2
    half of the i do). The points are stored one and a half times in a row, so that x_(i + s mod D) is
    a view of them and a single product makes nearly all features. The result of a call is
    overwritten by the next.

    Args:
        x: some points [N, D], for dtype, device and D.
        width: most points of a chunk.
    """

    def __init__(self, x: Float[Tensor, "N D"], width: int) -> None:
        self.width, dim = min(width, max(len(x), 1)), x.shape[1]
        half, whole = dim // 2, (dim + 1) // 2
        end = 1 + dim + whole * dim
        self._phi = x.new_ones(1 + dim + dim * (dim + 1) // 2, self.width)
        self._ring = ring = x.new_empty(dim + half, self.width)
        shifted = ring.unfold(0, dim, 1).mT[:whole]  # [s, i] is x_(i + s mod D)
        self._products = [(ring[:dim], shifted, self._phi[1 + dim : end].view(whole, dim, -1))]
        if half == whole:
            self._products.append((ring[:half], ring[half:dim], self._phi[end:]))

    def of(self, points: Float[Tensor, "D n"]) -> Float[Tensor, "F n"]:
        """Return the features of a chunk of points."""
        dim = len(points)
        if points.shape[1] != self.width:
            return CyclicFeatures(points.T, points.shape[1]).of(points)
        self._ring[:dim] = points
        self._ring[dim:] = points[: len(self._ring) - dim]
        self._phi[1 : 1 + dim] = points
        for left, right, out in self._products:
            torch.mul(left, right, out=out)
        return self._phi


def cyclic_order(dim: int, device: torch.device) -> Int[Tensor, " F"]:
    """Return the position of each feature of `CyclicFeatures` in [1, x_i, x_i x_j (i <= j)], i before j."""
    i = torch.arange(dim, device=device)
    left = i.repeat(dim // 2 + 1)[: dim * (dim + 1) // 2]
    right = (left + torch.arange(len(left), device=device) // dim) % dim
    return torch.cat([torch.arange(1 + dim, device=device), product_places(left, right, dim)])


def product_places(i: Int[Tensor, " P"], j: Int[Tensor, " P"], dim: int) -> Int[Tensor, " P"]:
    """Return the positions of products x_i x_j, in either order, in [1, x_i, x_i x_j (i <= j)]."""
    low, high = torch.minimum(i, j), torch.maximum(i, j)
    return 1 + dim + low * dim - low * (low - 1) // 2 + high - low


POINTS = 1008  # at a time and core: 253 features are 2 MB; a power of two is 10 % slower
LOG_2, LOG_2PI = math.log(2.0), math.log(2.0 * math.pi)


class MixtureParameters(NamedTuple):
    """Holds the weights, means and covariances of a Gaussian mixture, as plain tensors."""

    weights: Float[Tensor, " K"]
    means: Float[Tensor, "K D"]
    covariances: Float[Tensor, "K D D"]


class SufficientStatistics(NamedTuple):
    """Holds the sums over points that an expectation step hands to the maximisation step.

    Attributes:
        table: sum_n w_n r_nk phi(x_n); the first column is the number of points per component.
        log_likelihood: sum_n w_n log p(x_n).
        weight: sum_n w_n.
    """

    table: Float[Tensor, "K F"]
    log_likelihood: Float[Tensor, ""]
    weight: Float[Tensor, ""]

    def merge(self, *others: SufficientStatistics) -> SufficientStatistics:
        """Return the statistics of all points together."""
        total = self
        for other in others:
            pairs = zip(total, other, strict=True)
            total = SufficientStatistics(*(a + b for a, b in pairs))
        return total

    @classmethod
    def zeros(cls, n_components: int, dim: int, device: Any = None) -> SufficientStatistics:
        """Return the statistics of no points."""
        n_features = 1 + dim + dim * (dim + 1) // 2
        table = torch.zeros(n_components, n_features, dtype=torch.float64, device=device)
        return cls(table, table.new_zeros(()), table.new_zeros(()))

    def pack(self) -> Float[Tensor, " P"]:
        """Return all sums in one vector, which processes can add up in a single exchange."""
        return torch.cat([self.table.flatten(), self.log_likelihood[None], self.weight[None]])

    @classmethod
    def unpack(cls, packed: Float[Tensor, " P"], n_components: int) -> SufficientStatistics:
        """Return the statistics that `pack` was given."""
        return cls(packed[:-2].reshape(n_components, -1), packed[-2], packed[-1])


@dataclass(frozen=True)
class FitReport:
    """Reports on a fit: iterations, log-likelihoods, convergence.

    Attributes:
        iterations: maximisation steps taken.
        log_likelihood: mean log-likelihood before every maximisation step and at the end.
        converged: the last change was below the tolerance.
        reseeded: how often an empty or collapsed component was moved.
        starts: final mean log-likelihood of every start.
    """

    iterations: int
    log_likelihood: tuple[float, ...]
    converged: bool
    reseeded: int
    starts: tuple[float, ...] = ()


def natural_parameters(parameters: MixtureParameters) -> Float[Tensor, "K F"]:
    """Return theta with theta_k . phi(x) = log pi_k + log N(x; mu_k, Sigma_k).

    With P_k = Sigma_k^-1,
    theta_k = [log pi_k - log|2 pi Sigma_k|/2 - mu_k' P_k mu_k/2, P_k mu_k, -P_k/2].

    Raises:
        CovarianceError: a covariance is not positive definite.
    """
    weights, means, covariances = parameters
    dim = means.shape[-1]
    factor, info = torch.linalg.cholesky_ex(symmetrise(covariances))
    if bool(info.any()):
        raise CovarianceError(
            f"covariances must be positive definite, got {int((info != 0).sum())} that are not; "
            "use a larger covariance floor, or fewer components"
        )
    precision = torch.cholesky_inverse(factor)
    linear = (precision @ means.unsqueeze(-1)).squeeze(-1)
    log_det = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    constant = weights.log() - log_det - 0.5 * dim * LOG_2PI - 0.5 * (means * linear).sum(-1)
    rows, columns = upper_triangle(dim, means.device)
    fold = torch.where(rows == columns, -0.5, -1.0).to(means)
    return torch.cat([constant.unsqueeze(-1), linear, precision[:, rows, columns] * fold], -1)


@torch.no_grad()
def e_step(
    x: Float[Tensor, "N D"],
    parameters: MixtureParameters,
    sample_weight: Float[Tensor, " N"] | None = None,
) -> SufficientStatistics:
    """Run the expectation step: responsibilities, summed up at once (BL 53-56).

    Args:
        x: points; a transposed [D, N] tensor in memory is fastest. Its dtype is that of the
            products, sums over chunks are kept in the dtype of the parameters.
        parameters: the mixture. Best in units in which the data have unit covariance, since
            theta . phi(x) cancels.
        sample_weight: w_n >= 0; a point of weight 2 counts as two points.

    Returns:
        The statistics of `m_step`.
    """
    return feature_sums(x, natural_parameters(parameters), sample_weight)


def feature_sums(
    x: Float[Tensor, "N D"],
    theta: Float[Tensor, "K F"],
    sample_weight: Float[Tensor, " N"] | None,
) -> SufficientStatistics:
    """Run the expectation step of a mixture whose terms are theta_k . phi(x), without a graph.

    Args:
        x, sample_weight: as for `e_step`. theta: `natural_parameters`, or others with zeros for what the
            responsibilities do not depend on.
    """
    order = cyclic_order(x.shape[1], x.device)
    # powers of two, 2^(theta . phi(x) / log 2), take a third of the time that those of e take
    powers = _pad_components((theta[:, order] / LOG_2).to(x.dtype))
    table, total = torch.zeros_like(powers, dtype=theta.dtype), theta.new_zeros(())
    chunk, least = _chunk_size(x.device), least_exponent(x.dtype) / LOG_2
    features, points = CyclicFeatures(x, chunk), x.T
    for start in range(0, len(x), chunk):
        phi = features.of(points[:, start : start + chunk])
        terms = powers @ phi
        top = terms.amax(0)
        norm = terms.sub_(top).clamp_min_(least).exp2_().sum(0)
        log_density, scale = norm.log2().add_(top), norm.reciprocal_()
        if sample_weight is not None:
            weight = sample_weight[start : start + chunk].to(x.dtype)
            scale.mul_(weight)
            log_density.mul_(weight)
        table += terms.mul_(scale) @ phi.T
        total += log_density.sum(dtype=total.dtype)
    count = sample_weight.sum() if sample_weight is not None else total.new_tensor(len(x))
    sums = torch.empty_like(theta)
    sums[:, order] = table[: len(theta)]
    return SufficientStatistics(sums, total * LOG_2, count.to(total.dtype))


def _chunk_size(device: torch.device) -> int:
    """Return the number of points in one product, such that features of 2 MB a core stay in its cache."""
    return POINTS * (torch.get_num_threads() if device.type == "cpu" else 64)


def _pad_components(theta: Tensor) -> Tensor:
    """Add terms that vanish, up to a multiple of four: products are 10 % faster than with 30."""
    extra = theta.new_zeros(-len(theta) % 4, theta.shape[1])
    extra[:, 0] = torch.finfo(theta.dtype).min
    return torch.cat([theta, extra])


def m_step(
    statistics: SufficientStatistics, floor: Float[Tensor, "D D"]
) -> tuple[MixtureParameters, int]:
    """Run the maximisation step, with empty and collapsed components moved (BL 54-56).

    pi_k = n_k / n,  mu_k = s_k / n_k,  Sigma_k = S_k / n_k - mu_k mu_k' + floor

    A component has collapsed if it explains fewer than D + 1 points (or a tenth of its share n / K
    if that is less), if its covariance before the floor is below the floor in every direction, or
    if its covariance is not positive definite. It is given half of the component that explains
    most points, which is split in two along its longest axis so that both together keep its mean
    and covariance. So no weight is ever zero and the number of components stays.

    Args:
        statistics: the statistics of all points.
        floor: added to every covariance; zeros for none.

    Returns:
        The mixture and how many components were moved.
    """
    count, means, spread = moments(statistics.table, floor.shape[-1])
    lost = _collapsed(count, spread, floor)
    moved = int(lost.sum())
    state = MixtureParameters(count / statistics.weight, means, spread + floor)
    for index in lost.nonzero().flatten().tolist():
        state, lost = _split_largest(state, index, lost)
    return state._replace(weights=state.weights / state.weights.sum()), moved


def moments(
    table: Float[Tensor, "K F"], dim: int
) -> tuple[Float[Tensor, " K"], Float[Tensor, "K D"], Float[Tensor, "K D D"]]:
    """Return n_k, mu_k and the covariance S_k / n_k - mu_k mu_k' of each component (BL 54-56)."""
    count = table[:, 0]
    safe = count.clamp_min(torch.finfo(table.dtype).tiny)
    means = table[:, 1 : 1 + dim] / safe.unsqueeze(-1)
    rows, columns = upper_triangle(dim, table.device)
    spread = table.new_zeros(len(table), dim, dim)
    spread[:, rows, columns] = table[:, 1 + dim :] / safe.unsqueeze(-1)
    spread[:, columns, rows] = spread[:, rows, columns]
    return count, means, spread - means.unsqueeze(-1) * means.unsqueeze(-2)


def _collapsed(count: Tensor, spread: Tensor, floor: Tensor) -> Tensor:
    """Return which components [K] are empty, below the floor everywhere, or not positive definite."""
    n_components, dim = spread.shape[:2]
    least = min(dim + 1.0, float(count.sum()) / (10 * n_components))
    usable = torch.isfinite(spread).all(-1).all(-1)
    excess = torch.where(usable[:, None, None], symmetrise(spread - floor), -floor)
    flat = (excess.diagonal(dim1=-2, dim2=-1) <= 0.0).all(-1)
    if bool(flat.any()):  # the diagonal alone decides nearly always
        flat &= torch.linalg.eigvalsh(excess)[:, -1] <= 0
    singular = torch.linalg.cholesky_ex(torch.where(usable[:, None, None], spread, 0) + floor).info
    return (count < least) | flat | (singular != 0) | ~usable


def _split_largest(
    state: MixtureParameters, index: int, lost: Tensor
) -> tuple[MixtureParameters, Tensor]:
    """Give component `index` half of the heaviest component that is not lost."""
    weights, means, covariances = (p.clone() for p in state)
    lost = lost.clone()
    candidates = torch.where(lost, torch.zeros_like(weights), weights)
    if not bool((candidates > 0).any()):  # all collapsed, as on points that coincide
        candidates = torch.where(torch.isfinite(means).all(-1), weights, torch.zeros_like(weights))
    parent = int(candidates.argmax())
    values, vectors = torch.linalg.eigh(covariances[parent])
    # half of the longest axis' variance goes into the distance of the two means
    step = vectors[:, -1] * (values[-1] / 2).sqrt()
    covariances[parent] = symmetrise(covariances[parent] - torch.outer(step, step))
    weights[parent] = weights[parent] / 2
    means[index], means[parent] = means[parent] + step, means[parent] - step
    weights[index], covariances[index] = weights[parent], covariances[parent]
    lost[index] = False
    return MixtureParameters(weights, means, covariances), lost


def upper_triangle(dim: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return rows and columns of the products x_i x_j among the features, i <= j."""
    rows, columns = torch.triu_indices(dim, dim, device=device)
    return rows, columns
