"""Define the Gaussian mixture with full covariances, the prior over the state of an arm (BL 7)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchpose._core.checks import (
    check_choice,
    check_count,
    check_covariance,
    check_finite,
    check_generator,
    check_shape,
    check_tensors,
    check_weights,
)
from torchpose._core.module_state import NoHalfModule, register_given
from torchpose._core.value_checks import values_visible
from torchpose.errors import InputError, ShapeError
from torchpose.math._gaussian import definite_cholesky, mixture_moments, symmetrise
from torchpose.math._mixture_em import FitReport, MixtureParameters, expectation_maximisation
from torchpose.math._mixture_start import STARTS, floor_variances, start_mixture

LOG_2PI = math.log(2.0 * math.pi)
CHUNK = 512  # rows per product, so that the [K D, rows] residuals stay in the cache
SAMPLE_CHUNK = 4096  # draws per product, which gathers a factor [D, D] for each


class ConditionedMixture(NamedTuple):
    """Holds a Gaussian mixture over the hidden dimensions, given values of the others.

    The covariances do not depend on the values, so they carry no batch dimensions.

    Attributes:
        log_weights: [..., K], normalised.
        means: [..., K, H], in the units of the hidden dimensions.
        covariances: [K, H, H].
    """

    log_weights: Float[Tensor, "*batch K"]
    means: Float[Tensor, "*batch K H"]
    covariances: Float[Tensor, "K H H"]


def component_log_density(
    x: Float[Tensor, "*batch D"],
    means: Float[Tensor, "K D"],
    cholesky: Float[Tensor, "K D D"],
) -> Float[Tensor, "*batch K"]:
    """Return the log density of every point under every Gaussian, log N(x; mu_k, L_k L_k^T).

    The residuals L_k^-1 (x - mu_k) of all components are one matrix product with the rows of all
    L_k^-1, taken chunk by chunk and in float64, since states mix units whose variances span ten
    orders of magnitude.

    Args:
        x: points.
        means: mu_k.
        cholesky: L_k, lower triangular.

    Returns:
        Log densities without mixture weights, in the wider of the two dtypes.
    """
    (k, dim), dtype = means.shape, torch.promote_types(x.dtype, means.dtype)
    factor, centre = cholesky.double(), means.detach().double().mean(0)
    eye = torch.eye(dim, dtype=torch.float64, device=x.device).expand(k, dim, dim)
    inverse = torch.linalg.solve_triangular(factor, eye, upper=False)
    shift = (inverse @ (means.double() - centre).unsqueeze(-1)).squeeze(-1).T.reshape(-1, 1)
    rows = inverse.transpose(0, 1).reshape(dim * k, dim)
    constant = 0.5 * dim * LOG_2PI + factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    points = (x.reshape(math.prod(x.shape[:-1]), dim).double() - centre).T
    squared = [
        torch.addmm(shift, rows, chunk, beta=-1).square().view(dim, k, chunk.shape[1]).sum(0)
        for chunk in points.split(CHUNK, dim=1)
    ]
    log_density = -0.5 * torch.cat(squared, dim=1).T - constant
    return log_density.reshape(*x.shape[:-1], k).to(dtype)


class GaussianMixture(NoHalfModule):
    """Holds a mixture of K Gaussians with full covariances over D dimensions.

    p(x) = sum_k pi_k N(x; mu_k, Sigma_k)

    The three tensors are copied; a parameter stays that parameter, and one with a graph keeps it, so
    that gradients of `log_prob` flow back to it. Weights are divided by their sum.

    Args:
        weights: pi [K], positive, summing to one up to rounding.
        means: mu [K, D].
        covariances: Sigma [K, D, D], symmetric positive definite.

    Raises:
        ShapeError: sizes do not fit together.
        InputError: weights that are a parameter, are not positive or do not sum to one, values not finite.
        CovarianceError: a covariance that is not symmetric or not positive definite.

    Reference:
        Burke & Lasenby, equation (BL 7).

    >>> import torch
    >>> gmm = GaussianMixture(torch.tensor([0.5, 0.5]), torch.tensor([[-1.0], [1.0]]),
    ...                       torch.ones(2, 1, 1))
    >>> round(gmm.log_prob(torch.zeros(1)).item(), 4)
    -1.4189
    """

    weights: Tensor
    means: Tensor
    covariances: Tensor

    def __init__(
        self,
        weights: Float[Tensor, " K"],
        means: Float[Tensor, "K D"],
        covariances: Float[Tensor, "K D D"],
    ) -> None:
        super().__init__()
        if isinstance(weights, nn.Parameter):
            raise InputError(
                "weights must not be a parameter, which a step of an optimiser would not keep positive and "
                "summing to one; pass logits.softmax(-1) of a parameter of your own"
            )
        _check_mixture(weights, means, covariances)
        register_given(self, "weights", weights / weights.sum())
        register_given(self, "means", means)
        register_given(self, "covariances", covariances)
        self.fit_report: FitReport | None = None

    @property
    def n_components(self) -> int:
        """Return the number of Gaussians K."""
        return int(self.means.shape[0])

    @property
    def dim(self) -> int:
        """Return the number of dimensions D."""
        return int(self.means.shape[1])

    def extra_repr(self) -> str:
        return f"n_components={self.n_components}, dim={self.dim}, dtype={self.means.dtype}"

    def rounded(self) -> GaussianMixture:
        """Return the mixture in single-precision numbers, its covariances still positive definite.

        Rounding may push the least eigenvalue of a covariance below zero. There, a share of each
        variance is added before: the least of 0, 1e-6, ... 1e-3 with which a tenth of a millionth
        could be taken away again.
        """
        scale = self.covariances.diagonal(dim1=-2, dim2=-1).sqrt()
        eye = torch.eye(self.dim, dtype=self.covariances.dtype, device=self.covariances.device)
        units = scale[:, :, None] * scale[:, None]
        best = self.covariances.float().to(self.covariances)
        for share in (0.0, 1e-6, 1e-5, 1e-4, 1e-3):
            tried = (self.covariances + share * units * eye).float().to(self.covariances)
            unsafe = torch.linalg.cholesky_ex(best / units - 1e-7 * eye).info != 0
            best = torch.where(unsafe[:, None, None], tried, best)
        weights, means = (x.float().to(x) for x in (self.weights, self.means))
        return GaussianMixture(weights, means, best)

    def parameters_tuple(self) -> MixtureParameters:
        """Return weights, means and covariances as one value."""
        return MixtureParameters(self.weights, self.means, self.covariances)

    @classmethod
    def from_parameters(cls, parameters: MixtureParameters) -> GaussianMixture:
        """Return the mixture of the given weights, means and covariances.

        Args:
            parameters: weights [K], means [K, D] and covariances [K, D, D].

        Returns:
            `GaussianMixture`.

        Raises:
            ShapeError, InputError, CovarianceError: as the class.
        """
        return cls(*parameters)

    @classmethod
    def fit(
        cls,
        x: Float[Tensor, "N D"],
        n_components: int = 30,
        seed: int | torch.Generator = 0,
        sample_weight: Float[Tensor, " N"] | None = None,
        n_init: int = 1,
        max_iter: int = 200,
        tol: float = 1e-4,
        covariance_floor: float = 1e-6,
        init: str = "k-means++",
        progress: bool = False,
        dtype: torch.dtype = torch.float64,
    ) -> GaussianMixture:
        """Fit a mixture by expectation-maximisation; the result has a `fit_report`.

        Args:
            x: points [N, D], finite.
            n_components: number of Gaussians K.
            seed: an integer, or the generator to draw from.
            sample_weight: w_n >= 0; a point of weight 2 counts as two points.
            n_init: number of starts, of which the one with the highest log-likelihood is kept.
            max_iter: largest number of iterations of each start.
            tol: change of the mean log-likelihood at which to stop.
            covariance_floor: added to every variance, relative to the variance of the data in that
                dimension (relative to one unit, where the data do not vary at all).
            init: "k-means++" or "random" (means at points drawn at random).
            progress: show a bar for every start.
            dtype: the floating-point type of the products over the points; the mixture is float64.

        Returns:
            `GaussianMixture` in float64, with a `fit_report`.

        Raises:
            ShapeError, InputError: bad points, weights or settings, fewer points than components.
        """
        _check_fit(x, n_components, n_init, covariance_floor, init)
        generator = seed
        if not isinstance(generator, torch.Generator):
            generator = torch.Generator(device=x.device).manual_seed(generator)
        x = x.detach().double()
        if sample_weight is not None:
            sample_weight = sample_weight.detach().double()
        floor = floor_variances(x, covariance_floor, sample_weight)
        settings = (sample_weight, max_iter, tol, floor, dtype, progress)
        runs = []
        for _ in range(n_init):
            start = start_mixture(x, n_components, generator, floor, sample_weight, init)
            runs.append(expectation_maximisation(x, start, *settings))
        scores = tuple(report.log_likelihood[-1] for _, report in runs)
        best, report = runs[scores.index(max(scores))]
        mixture = cls.from_parameters(best)
        mixture.fit_report = replace(report, starts=scores)
        return mixture

    def cholesky(self) -> Float[Tensor, "K D D"]:
        """Return lower factors L_k of the covariances, Sigma_k = L_k L_k^T (factorised in float64).

        Raises:
            CovarianceError: a covariance that was learnt is not positive definite any more.
        """
        return _factors(self.covariances)

    def component_log_prob(self, x: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch K"]:
        """Return the log of each term of the mixture, log pi_k + log N(x; mu_k, Sigma_k).

        Args:
            x: points, any leading dimensions.

        Returns:
            [..., K], natural logarithm.

        Raises:
            ShapeError: the last dimension is not D. InputError: no tensor, or complex points.
            CovarianceError: as `cholesky`.
        """
        check_tensors(x=x)
        check_shape("x", x, ("...", self.dim))
        return self.weights.log() + component_log_density(x, self.means, self.cholesky())

    def log_prob(self, x: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch"]:
        """Return the log density of the mixture, log sum_k pi_k N(x; mu_k, Sigma_k).

        Args:
            x: points, any leading dimensions.

        Returns:
            [...], natural logarithm.

        Raises:
            ShapeError: the last dimension is not D. InputError: no tensor, or complex points.
            CovarianceError: as `cholesky`.
        """
        return self.component_log_prob(x).logsumexp(-1)

    def forward(self, x: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch"]:
        """Return the log density of the mixture, as `log_prob` does.

        Args:
            x: [..., D].

        Returns:
            [...], natural logarithm.
        """
        return self.log_prob(x)

    if TYPE_CHECKING:  # nn.Module has Any
        __call__ = forward

    def moments(self) -> tuple[Float[Tensor, " D"], Float[Tensor, "D D"]]:
        """Return the mean and covariance of the whole mixture."""
        return mixture_moments(self.weights.log(), self.means, self.covariances)

    def sample(
        self, shape: Sequence[int] = (), generator: torch.Generator | None = None
    ) -> Float[Tensor, "*shape D"]:
        """Return independent draws.

        Args:
            shape: leading dimensions of the result.
            generator: source of randomness; the global one if None.

        Returns:
            Draws [*shape, D], in the dtype of the mixture.

        Raises:
            InputError: a shape that is no sequence of sizes, such as 5 in place of (5,), or no generator.
        """
        check_generator(generator)
        shape = _sizes(shape)
        n = math.prod(shape)
        weights = self.weights
        factor, rows = self.cholesky(), []
        for start in range(0, n, SAMPLE_CHUNK):
            count = min(SAMPLE_CHUNK, n - start)
            uniform = torch.rand(
                count, generator=generator, dtype=torch.float64, device=weights.device
            )
            k = _components(weights, uniform)
            noise = torch.randn(
                count, self.dim, generator=generator, dtype=weights.dtype, device=weights.device
            )
            rows.append(self.means[k] + (factor[k] @ noise.unsqueeze(-1)).squeeze(-1))
        draws = torch.cat(rows) if rows else self.means.new_zeros(0, self.dim)
        return draws.reshape(*shape, self.dim)

    def marginal(self, indices: Sequence[int] | Int[Tensor, " S"]) -> GaussianMixture:
        """Return the mixture over a subset of the dimensions, in the order of `indices`.

        Args:
            indices: [S], distinct dimensions.

        Returns:
            `GaussianMixture` of K components over S dimensions.

        Raises:
            InputError: an index is out of range or given twice.
        """
        keep = self._indices(indices)
        return GaussianMixture(
            self.weights, self.means[:, keep], self.covariances[:, keep][:, :, keep]
        )

    def condition(
        self,
        indices: Sequence[int] | Int[Tensor, " S"],
        values: Float[Tensor, "*batch S"],
    ) -> ConditionedMixture:
        """Return the mixture over the other dimensions, given x[indices] = values.

        With the factor of the covariance in the order (observed, hidden),
        L = [[L_o, 0], [L_ho, L_h]], each component has the mean
        mu_h + L_ho L_o^-1 (values - mu_o), the covariance L_h L_h^T and the weight
        pi_k N(values; mu_o, Sigma_o), normalised.

        Args:
            indices: the S observed dimensions.
            values: their values, any leading dimensions.

        Returns:
            Log weights, means and covariances over the D - S hidden dimensions, these in
            increasing order.

        Raises:
            ShapeError: `values` does not end in S. InputError: bad or repeated indices,
            complex values.
        """
        seen = self._indices(indices)
        check_tensors(values=values)
        check_shape("values", values, ("...", len(seen)))
        hidden = torch.ones(self.dim, dtype=torch.bool, device=seen.device)
        hidden[seen] = False
        order = torch.cat([seen, hidden.nonzero().squeeze(-1)])
        factor = _factors(self.covariances[:, order][:, :, order])
        n = len(seen)
        seen_factor, cross, hidden_factor = factor[:, :n, :n], factor[:, n:, :n], factor[:, n:, n:]
        mean = self.means[:, order]
        gain = torch.linalg.solve_triangular(seen_factor, cross, upper=False, left=False)
        residual = values.unsqueeze(-2) - mean[:, :n]
        means = mean[:, n:] + torch.einsum("kho,...ko->...kh", gain, residual)
        log_joint = self.weights.log() + component_log_density(values, mean[:, :n], seen_factor)
        return ConditionedMixture(
            log_joint.log_softmax(-1), means, hidden_factor @ hidden_factor.mT
        )

    def _indices(self, indices: Sequence[int] | Tensor) -> Tensor:
        given = torch.as_tensor(indices, device=self.means.device).reshape(-1)
        if len(given) and (given.is_floating_point() or given.dtype == torch.bool):
            raise InputError(f"indices must be whole numbers, got {given.tolist()}")
        index = given.long()
        index = torch.where(index < 0, index + self.dim, index)
        if bool(((index < 0) | (index >= self.dim)).any()) or len(index.unique()) != len(index):
            raise InputError(
                f"indices must be distinct and lie in 0..{self.dim - 1}, got {index.tolist()}"
            )
        return index


def _factors(covariances: Float[Tensor, "K D D"]) -> Float[Tensor, "K D D"]:
    """Return the factors of covariances, computed in float64."""
    wide = symmetrise(covariances.double())
    # traced, it would be factorised with every jitter
    seen = values_visible()
    factor = definite_cholesky("covariances", wide) if seen else torch.linalg.cholesky(wide)
    return factor.to(covariances.dtype)


def _sizes(shape: Sequence[int]) -> torch.Size:
    """Return a shape, or raise `InputError` for what is none."""
    try:
        sizes = torch.Size(shape)
    except TypeError:
        sizes = None
    if sizes is None or min(sizes, default=0) < 0:
        raise InputError(f"shape must be a sequence of sizes, such as (5,), got {shape!r:.60}")
    return sizes


def _components(weights: Tensor, uniform: Tensor) -> Tensor:
    """Return the component of each uniform number, by inversion of the cumulative weights."""
    edges = weights.detach().double().cumsum(0)
    return torch.searchsorted(edges, uniform * edges[-1], right=True).clamp_max(len(weights) - 1)


def _check_fit(
    x: Tensor, n_components: int, n_init: int, covariance_floor: float, init: str
) -> None:
    check_tensors(x=x)
    check_shape("x", x, ("N", "D"))
    check_finite("x", x, hint="drop frames with missing joints before the fit")
    check_count("n_components", n_components)
    check_count("n_init", n_init)
    if len(x) < n_components:
        raise InputError(
            f"a fit needs at least as many points as components, got {len(x)} points for "
            f"{n_components} components"
        )
    if not covariance_floor > 0 or math.isinf(covariance_floor):
        raise InputError(f"covariance_floor must be positive, got {covariance_floor}")
    check_choice("init", init, STARTS)


@torch.no_grad()
def _check_mixture(weights: Tensor, means: Tensor, covariances: Tensor) -> None:
    for name, tensor in (("weights", weights), ("means", means), ("covariances", covariances)):
        if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
            kind = tensor.dtype if isinstance(tensor, Tensor) else type(tensor).__name__
            raise InputError(f"{name} must be a floating-point tensor, got {kind}")
    check_shape("weights", weights, ("K",))
    check_shape("means", means, (len(weights), "D"))
    dim = means.shape[1]
    if dim == 0:
        raise ShapeError(f"means must have shape [K, D] with D >= 1, got {list(means.shape)}")
    check_shape("covariances", covariances, (len(weights), dim, dim))
    if len({weights.dtype, means.dtype, covariances.dtype}) > 1:
        raise InputError(
            "weights, means and covariances must share one dtype, got "
            f"{weights.dtype}, {means.dtype} and {covariances.dtype}; convert them first"
        )
    check_weights("weights", weights)
    total = float(weights.double().sum())
    tolerance = max(1e-6, 100 * len(weights) * torch.finfo(weights.dtype).eps)
    if abs(total - 1.0) > tolerance:
        raise InputError(
            f"weights must sum to 1, got {total:.6g}; divide them by their sum if that is meant"
        )
    check_finite("means", means)
    check_covariance("covariances", covariances)
