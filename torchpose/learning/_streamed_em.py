"""Fit mixtures by exact EM to states that need not fit into memory, in all or some of their dimensions.

An EM step needs only a table of sums over the states (`SufficientStatistics`). Each process sums over its
share of the blocks, one exchange adds up the tables, and every process takes the same maximisation step.
The result depends neither on the number of processes nor on how blocks are shared, up to rounding.

A mixture may be fitted to some dimensions only: those that are measured or wanted most. The others, such as
the camera's angles, would only split components. They follow by one maximisation step with the
responsibilities of the fitted dimensions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypedDict, Unpack

import torch
from torch import Tensor

from torchpose._core.checks import check_count, check_shape
from torchpose.errors import InputError
from torchpose.learning._blocks import (
    ALONE,
    Share,
    joined_blocks,
    spread_samples,
    usable_block,
    usable_samples,
)
from torchpose.learning._samplers import Samples, SampleSource, cached
from torchpose.math._mixture_em import MixtureFit, map_mixture, run_fit, whitening
from torchpose.math._mixture_start import STARTS, floor_variances, start_mixture
from torchpose.math._mixture_steps import (
    MixtureParameters,
    SufficientStatistics,
    e_step,
    feature_sums,
    moments,
    natural_parameters,
    product_places,
    upper_triangle,
)
from torchpose.priors._gaussian_mixture import GaussianMixture

START_SAMPLES = 100_000


class StreamedEM(MixtureFit):
    """Runs the fit of a mixture to sources of states in blocks.

    `expect` sums up samples, and `accumulate` a whole source, of which every process does its share.
    Attributes and arguments are those of `MixtureFit`.

    >>> import torch
    >>> from torchpose.learning._samplers import TensorSource
    >>> states = torch.randn(1000, 2, generator=torch.Generator().manual_seed(0)).double()
    >>> em = StreamedEM.start(TensorSource(states), n_components=3)
    >>> before = em.maximise(em.accumulate(TensorSource(states)))
    >>> em.maximise(em.accumulate(TensorSource(states))) > before
    True
    >>> em.mixture().n_components
    3
    """

    # --- where a fit begins

    @classmethod
    def start(
        cls,
        source: SampleSource,
        n_components: int,
        seed: int | torch.Generator = 0,
        *,
        start_samples: int = START_SAMPLES,
        covariance_floor: float = 1e-6,
        init: str | MixtureParameters = "k-means++",
        dtype: torch.dtype = torch.float64,
    ) -> StreamedEM:
        """Start a fit from some samples of a source, the same in every process.

        Where the source has no more than `start_samples`, these are those of `GaussianMixture.fit`.

        Args:
            source: the states.
            start_samples: number of samples to start from, spread evenly over the source; every process
                looks at the same ones.
            init: "k-means++", "random" (means at states drawn at random), or the mixture to start
                from, in units of the states.
            n_components, seed, covariance_floor, dtype: as `GaussianMixture.fit`.

        Raises:
            InputError: fewer usable samples or distinct poses than components, samples that are not
                finite, bad settings.
        """
        _check_settings(n_components, start_samples, covariance_floor, init)
        states, weight = spread_samples(source, start_samples)
        _check_enough(source, states, n_components)
        sample_weight = None if bool((weight == 1).all()) else weight
        variances = floor_variances(states, covariance_floor, sample_weight)
        if isinstance(init, str):
            generator = seed
            if not isinstance(generator, torch.Generator):
                generator = torch.Generator().manual_seed(generator)
            init = start_mixture(states, n_components, generator, variances, sample_weight, init)
        check_shape("init.means", init.means, (n_components, source.dim))
        shift, _, factor = whitening(states, sample_weight, variances)
        return cls.in_units(init, shift, factor, variances, dtype)

    # --- one step

    @torch.no_grad()
    def expect(self, samples: Samples) -> SufficientStatistics:
        """Take the expectation step over some samples; sums of parts can be merged or added.

        Args:
            samples: states, in their own units, and weights; those of weight zero are left out.

        Raises:
            InputError: samples that are not finite, or of another size than the mixture.
        """
        return self._expect(usable_samples(samples, "samples"))

    def _expect(self, samples: Samples) -> SufficientStatistics:
        states, weight = (values.to(self.means) for values in samples)
        check_shape("states", states, ("N", self.means.shape[1]))
        sample_weight = None if bool((weight == 1).all()) else weight
        return e_step(self.whitened(states).T, self.parameters_tuple(), sample_weight)

    @torch.no_grad()
    def accumulate(
        self, source: SampleSource, share: Share = ALONE, epoch: int | None = None
    ) -> SufficientStatistics:
        """Take the expectation step over a whole source, shared among processes.

        Args:
            source: the states.
            share: of this process.
            epoch: handed to the source; the number of steps taken if None.

        Returns:
            The statistics of all samples, the same in every process.

        Raises:
            InputError: samples that are not finite; the block is named.
        """
        n_components, dim = self.means.shape
        total = SufficientStatistics.zeros(n_components, dim, self.means.device)
        with share.failing_together(total.pack()):
            epoch = int(self.steps) if epoch is None else epoch
            mine = share.blocks(source.n_blocks)
            blocks = ((None, usable_block(source, index, epoch)) for index in mine)
            for _, samples in joined_blocks(blocks):
                total = total.merge(self._expect(samples))
        return SufficientStatistics.unpack(share.total(total.pack()), len(self.means))

    def mixture(self) -> GaussianMixture:
        """Return the present mixture in units of the states, with a `fit_report`."""
        mixture = GaussianMixture(*self.parameters_of_points())
        mixture.fit_report = self.report()
        return mixture


class StartOptions(TypedDict, total=False):
    """The options of `StreamedEM.start`."""

    start_samples: int
    covariance_floor: float
    init: str | MixtureParameters
    dtype: torch.dtype


def fit_streamed(
    source: SampleSource,
    n_components: int,
    seed: int | torch.Generator = 0,
    *,
    max_iter: int = 200,
    tol: float = 1e-4,
    share: Share = ALONE,
    **options: Unpack[StartOptions],
) -> GaussianMixture:
    """Fit a mixture to a source that may be larger than memory, by one process or by many.

    The same mixture as that of `GaussianMixture.fit`, if all samples are those of the start.

    Args:
        source: the states.
        n_components: number of Gaussians K.
        seed: an integer, or the generator to draw from.
        max_iter: largest number of steps.
        tol: change of the mean log-likelihood at which to stop; 0 never stops early.
        share: of this process; every process calls this function and gets the mixture.
        options: the options of `StreamedEM.start`.

    Returns:
        The mixture, with its `fit_report`.

    Raises:
        InputError: as `StreamedEM.start` and `StreamedEM.accumulate`.
    """
    em = StreamedEM.start(source, n_components, seed, **options)
    run_streamed(em, source, max_iter=max_iter, tol=tol, share=share)
    return em.mixture()


def run_streamed(
    em: StreamedEM,
    source: SampleSource,
    *,
    max_iter: int,
    tol: float,
    share: Share = ALONE,
    progress: bool = False,
) -> None:
    """Take EM steps over a source until `em` has converged or taken `max_iter` of them in all."""
    run_fit(em, lambda: em.accumulate(source, share), max_iter=max_iter, tol=tol, progress=progress)


def _check_settings(
    n_components: int, start_samples: int, covariance_floor: float, init: Any
) -> None:
    check_count("n_components", n_components)
    if start_samples < n_components:
        raise InputError(
            f"start_samples must be at least the number of components, got {start_samples} for "
            f"{n_components} components"
        )
    if not covariance_floor > 0 or math.isinf(covariance_floor):
        raise InputError(f"covariance_floor must be positive, got {covariance_floor}")
    if isinstance(init, str) and init not in STARTS:
        raise InputError(f"init must be a mixture or one of {', '.join(STARTS)}, got {init!r}")


def _check_enough(source: SampleSource, states: Tensor, n_components: int) -> None:
    """Raise `InputError` unless there is a pose for every component."""
    n_poses = getattr(source, "n_poses", len(states))
    if n_poses >= n_components and any(len(x.unique()) >= n_components for x in states.T):
        return
    distinct = min(n_poses, len(states.unique(dim=0)) if len(states) else 0)
    if distinct < n_components:
        raise InputError(
            f"a fit needs at least as many distinct poses as components, got {len(states)} usable "
            f"samples of {distinct} distinct poses for {n_components} components; take fewer "
            "components, or more recordings"
        )


_FLOOR = 1e-6  # of the variance of each dimension, as in expectation-maximisation


class ColumnsSource:
    """Yields some dimensions of the states of another source.

    Args:
        source: of whole states. columns: which dimensions, in order.
    """

    def __init__(self, source: SampleSource, columns: Sequence[int]) -> None:
        self.source, self.columns = source, list(columns)

    @property
    def dim(self) -> int:
        """Return the number of dimensions."""
        return len(self.columns)

    @property
    def n_samples(self) -> int:
        """Return the number of states in all blocks together."""
        return self.source.n_samples

    @property
    def n_blocks(self) -> int:
        """Return the number of blocks."""
        return self.source.n_blocks

    @property
    def fresh(self) -> bool:
        """Return whether every epoch draws states of its own."""
        return bool(getattr(self.source, "fresh", False))

    def block(self, index: int, epoch: int = 0) -> Samples:
        """Return the states of a block."""
        samples = self.source.block(index, epoch)
        return samples._replace(states=samples.states[:, self.columns])


@torch.no_grad()
def complete_mixture(
    mixture: GaussianMixture, source: SampleSource, columns: Sequence[int]
) -> GaussianMixture:
    """Extend a mixture over some dimensions to whole states, by responsibilities.

    mu_k = sum_n r_nk x_n / n_k,  Sigma_k = sum_n r_nk (x_n - mu_k)(x_n - mu_k)^T / n_k + floor,

    where r_nk is the responsibility of component k for state n in the given dimensions (BL 53-56).

    Args:
        mixture: over the dimensions `columns`. source: of whole states.

    Raises:
        InputError: another number of dimensions.
    """
    if mixture.dim != len(columns):
        raise InputError(
            f"the mixture must be over the {len(columns)} dimensions that decide, got {mixture.dim}"
        )
    order = [*columns, *(i for i in range(source.dim) if i not in columns)]
    first = usable_block(source, 0, 0).states.double()
    floor = _FLOOR * first.std(0).clamp_min(1e-9).square()
    # the factor is triangular: of whitened states the first dimensions alone decide, as of states
    shift, _, factor = whitening(first[:, order], None, floor[order])
    theta = _theta_of_first(mixture, shift, factor)
    total = SufficientStatistics.zeros(mixture.n_components, source.dim)
    for index in range(source.n_blocks):
        states, weight = (values.double() for values in usable_block(source, index, 0))
        white = torch.linalg.solve_triangular(factor, (states[:, order] - shift).T, upper=False)
        total = total.merge(feature_sums(white.T, theta, weight))
    _, means, covs = moments(total.table, source.dim)
    whole = map_mixture(MixtureParameters(mixture.weights, means, covs), factor)
    back = torch.tensor(order).argsort()
    covs = whole.covariances[:, back][:, :, back] + torch.diag(floor)
    return GaussianMixture(mixture.weights, (whole.means + shift)[:, back], covs)


def _theta_of_first(mixture: GaussianMixture, shift: Tensor, factor: Tensor) -> Tensor:
    """Return the natural parameters [K, F] of a mixture over the first of whitened dimensions."""
    n, dim = mixture.dim, len(shift)
    weights, means, covs = (
        x.double() for x in (mixture.weights, mixture.means, mixture.covariances)
    )
    inverse = torch.linalg.inv(factor[:n, :n])
    white = map_mixture(MixtureParameters(weights, means - shift[:n], covs), inverse)
    products = product_places(*upper_triangle(n, shift.device), dim)
    theta = shift.new_zeros(len(weights), 1 + dim + dim * (dim + 1) // 2)
    theta[:, [*range(1 + n), *products]] = natural_parameters(white)
    return theta


class MixtureTask(NamedTuple):
    """Describes one mixture to be fitted.

    Attributes:
        source: of its training states. n_components: K. max_iter, tol: of the steps of EM; a
            tolerance of 0 takes all of them. seed: the seed of the start.
    """

    source: SampleSource
    n_components: int
    max_iter: int
    tol: float
    seed: int

    def fit(self) -> GaussianMixture:
        """Fit the mixture in this process and extend it to whole states."""
        source = cached(self.source)
        fitted = fit_streamed(
            source, self.n_components, self.seed, max_iter=self.max_iter, tol=self.tol
        )
        return self.whole(fitted)

    def whole(self, mixture: GaussianMixture) -> GaussianMixture:
        """Return the mixture over all dimensions, extended if it was fitted to some of them."""
        source = self.source
        if not isinstance(source, ColumnsSource) or mixture.dim == source.source.dim:
            return mixture
        return complete_mixture(mixture, source.source, source.columns)
