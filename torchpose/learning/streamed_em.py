"""Exact EM over states that no memory has to hold, by one process or by many.

An EM step needs of the states only a table of sums (`SufficientStatistics`). So the states come block
by block, each process takes its share of the blocks, one exchange adds up the tables, and every
process makes the same maximisation step. The result depends neither on the number of processes nor
on how the blocks are shared out, up to the rounding of sums.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose.errors import InputError, check_shape
from torchpose.learning.samplers import PRODUCT, Samples, SampleSource, join_samples
from torchpose.learning.share import ALONE, Share
from torchpose.learning.usable_samples import spread_samples, usable_block, usable_samples
from torchpose.math.mixture_em import (
    FitReport,
    IterationBar,
    MixtureParameters,
    SufficientStatistics,
    e_step,
    m_step,
    map_mixture,
    whitening,
)
from torchpose.math.mixture_start import STARTS, floor_variances, start_mixture
from torchpose.priors.gaussian_mixture import GaussianMixture

__all__ = [
    "ALONE",
    "START_SAMPLES",
    "Share",
    "StreamedEM",
    "fit_streamed",
    "run_streamed",
]

START_SAMPLES = 100_000


class StreamedEM(nn.Module):
    """A Gaussian mixture in the middle of its fit; all there is to know is in its `state_dict`.

    `expect` sums up samples, the sums of all samples together go to `maximise`, and that is one step
    of EM. Buffers are float64 and in units in which the states have about unit covariance,
    y = L^-1 (x - m), which takes away the cancellation of the products and does not change EM.

    Attributes:
        weights [K], means [K, D], covariances [K, D, D]: of the mixture of y.
        shift: m [D]. factor: L [D, D], lower triangular. floor: added to covariances of y [D, D].
        history: mean log-likelihood before every step and, if `record` was last, at the end.
        steps: maximisation steps taken. moved: components moved in the last of them (see `m_step`).
        reseeded: components moved in all of them. converged: the last change was below `tol`.

    Args:
        start: the mixture of y to start from.
        shift, factor, floor: see above.
        dtype: of the products over the states; float32 is faster and good to about 1e-4.

    >>> import torch
    >>> from torchpose.learning.samplers import TensorSource
    >>> states = torch.randn(1000, 2, generator=torch.Generator().manual_seed(0)).double()
    >>> em = StreamedEM.start(TensorSource(states), n_components=3)
    >>> before = em.maximise(em.accumulate(TensorSource(states)))
    >>> em.maximise(em.accumulate(TensorSource(states))) > before
    True
    >>> em.mixture().n_components
    3
    """

    weights: Tensor
    means: Tensor
    covariances: Tensor
    shift: Tensor
    factor: Tensor
    floor: Tensor
    history: Tensor
    steps: Tensor
    moved: Tensor
    reseeded: Tensor
    converged: Tensor

    def __init__(
        self,
        start: MixtureParameters,
        shift: Float[Tensor, " D"],
        factor: Float[Tensor, "D D"],
        floor: Float[Tensor, "D D"],
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        parts = {**start._asdict(), "shift": shift, "factor": factor, "floor": floor}
        for name, value in parts.items():
            # in the order in memory that a checkpoint has: the last bit of products depends on it
            wide = value.detach().double().clone(memory_format=torch.contiguous_format)
            self.register_buffer(name, wide)
        self.register_buffer("history", torch.zeros(0, dtype=torch.float64))
        for name in ("steps", "moved", "reseeded"):
            self.register_buffer(name, torch.tensor(0))
        self.register_buffer("converged", torch.tensor(False))
        self.dtype = dtype

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
        """Units, floor and start from some samples of a source, without any exchange.

        Where the source has no more than `start_samples`, these are those of `GaussianMixture.fit`.

        Args:
            source: the states.
            n_components: number of Gaussians K.
            seed: an integer, or the generator to draw from.
            start_samples: how many samples to look at, spread evenly over the source; every process
                looks at the same ones.
            covariance_floor: added to every variance, relative to the variance of the states in that
                dimension (relative to one unit, where they do not vary at all).
            init: "k-means++", "random" (means at states drawn at random), or the mixture to start
                from, in units of the states.
            dtype: of the products over the states; the mixture is float64.

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
        floor = (_inverse(factor) * variances) @ _inverse(factor).T
        return cls(_to_units(init, shift, factor), shift, factor, floor, dtype)

    @classmethod
    def blank(cls, n_components: int, dim: int, dtype: torch.dtype = torch.float64) -> StreamedEM:
        """A mixture of the given size to load a `state_dict` into."""
        eye = torch.eye(dim, dtype=torch.float64)
        means = torch.zeros(n_components, dim, dtype=torch.float64)
        weights = torch.full((n_components,), 1 / n_components, dtype=torch.float64)
        start = MixtureParameters(weights, means, eye.expand(n_components, -1, -1))
        return cls(start, means[0], eye, torch.zeros_like(eye), dtype)

    def restart(self, parameters: MixtureParameters) -> None:
        """Go on from another mixture, given in the units of the buffers, with an empty history."""
        self._set(parameters)
        self.history = self.history[:0]
        for name in ("steps", "moved", "reseeded", "converged"):
            setattr(self, name, torch.zeros_like(getattr(self, name)))

    # --- one step

    def parameters_tuple(self) -> MixtureParameters:
        """Weights, means and covariances in the units of the buffers."""
        return MixtureParameters(self.weights, self.means, self.covariances)

    @torch.no_grad()
    def expect(self, samples: Samples) -> SufficientStatistics:
        """Expectation step over some samples; the sums of parts are merged or added.

        Args:
            samples: states, in their own units, and weights; those of weight zero are left out.

        Raises:
            InputError: samples that are not finite, or of another size than the mixture.
        """
        return self._expect(usable_samples(samples, "samples"))

    def _expect(self, samples: Samples) -> SufficientStatistics:
        states, weight = (values.to(self.means) for values in samples)
        check_shape("states", states, ("N", self.means.shape[1]))
        white = (_inverse(self.factor) @ (states - self.shift).T).to(self.dtype)
        sample_weight = None if bool((weight == 1).all()) else weight
        return e_step(white.T, self.parameters_tuple(), sample_weight)

    @torch.no_grad()
    def accumulate(
        self, source: SampleSource, share: Share = ALONE, epoch: int | None = None
    ) -> SufficientStatistics:
        """Expectation step over a whole source, of which every process does its share.

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
            for samples in _products(source, share, int(self.steps) if epoch is None else epoch):
                total = total.merge(self._expect(samples))
        return SufficientStatistics.unpack(share.total(total.pack()), len(self.means))

    @torch.no_grad()
    def record(self, statistics: SufficientStatistics, tol: float = 0.0) -> float:
        """Note the mean log-likelihood of the mixture, and whether it has settled.

        Args:
            statistics: of all samples, made with the mixture as it is.
            tol: change of the mean log-likelihood below which the fit has converged, unless a
                component was moved in the last step; 0 never converges.

        Returns:
            Mean log-likelihood in units of the states.

        Raises:
            InputError: no samples, or a log-likelihood that is not finite.
        """
        value = self.mean_log_likelihood(statistics)
        steps = int(self.steps)
        if not math.isfinite(value):
            raise InputError(
                f"EM broke down: the mean log-likelihood became {value} after {steps} steps; use "
                "float64, a larger covariance floor, or another start (or another process failed: "
                "see its message)"
            )
        settled = steps > 0 and abs(value - float(self.history[steps - 1])) < tol
        self.converged = torch.full_like(self.converged, settled and int(self.moved) == 0)
        self.history = torch.cat([self.history[:steps], self.history.new_tensor([value])])
        return value

    @torch.no_grad()
    def maximise(self, statistics: SufficientStatistics, tol: float = 0.0) -> float:
        """`record`, and the maximisation step unless the fit has converged.

        Returns:
            Mean log-likelihood, in units of the states, of the mixture before the step.
        """
        value = self.record(statistics, tol)
        if not bool(self.converged):
            parameters, moved = m_step(statistics, self.floor)
            self._set(parameters)
            self.moved = torch.full_like(self.moved, moved)
            self.reseeded = self.reseeded + moved
            self.steps = self.steps + 1
        return value

    def mean_log_likelihood(self, statistics: SufficientStatistics) -> float:
        """Mean log-likelihood, in units of the states, from statistics that `expect` made."""
        if float(statistics.weight) == 0:
            raise InputError("EM needs samples of positive weight, got none; look at the weights")
        offset = float(self.factor.diagonal().log().sum())
        return float(statistics.log_likelihood / statistics.weight) - offset

    def mixture(self) -> GaussianMixture:
        """The mixture as it is, in units of the states; its `fit_report` says how the fit went."""
        state = map_mixture(self.parameters_tuple(), self.factor)
        mixture = GaussianMixture(state.weights, state.means + self.shift, state.covariances)
        mixture.fit_report = FitReport(
            iterations=int(self.steps),
            log_likelihood=tuple(self.history.tolist()),
            converged=bool(self.converged),
            reseeded=int(self.reseeded),
        )
        return mixture

    def extra_repr(self) -> str:
        n_components, dim = self.means.shape
        return f"n_components={n_components}, dim={dim}, steps={int(self.steps)}"

    def _set(self, parameters: MixtureParameters) -> None:
        for name, value in parameters._asdict().items():
            setattr(self, name, value.to(self.means).contiguous())

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        means, history = (state_dict.get(prefix + name) for name in ("means", "history"))
        if means is not None and means.shape != self.means.shape:
            raise InputError(
                "the checkpoint holds a mixture of {} components over {} dimensions, this fit has "
                "{} over {}; resume it with the settings that it was made with".format(
                    *means.shape, *self.means.shape
                )
            )
        if history is not None:
            self.history = self.history.new_zeros(history.shape)
        super()._load_from_state_dict(state_dict, prefix, *rest)


def fit_streamed(
    source: SampleSource,
    n_components: int,
    seed: int | torch.Generator = 0,
    *,
    max_iter: int = 200,
    tol: float = 1e-4,
    share: Share = ALONE,
    progress: bool = False,
    **options: Any,
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
        progress: show a bar.
        options: to `StreamedEM.start`.

    Returns:
        The mixture, with its `fit_report`.

    Raises:
        InputError: as `StreamedEM.start` and `StreamedEM.accumulate`.
    """
    em = StreamedEM.start(source, n_components, seed, **options)
    run_streamed(em, source, max_iter=max_iter, tol=tol, share=share, progress=progress)
    return em.mixture()


def run_streamed(
    em: StreamedEM,
    source: SampleSource,
    *,
    max_iter: int = 200,
    tol: float = 1e-4,
    share: Share = ALONE,
    progress: bool = False,
) -> None:
    """Take EM steps until `em` has converged or taken `max_iter` of them, those before included."""
    with IterationBar(max_iter, progress) as bar:
        while not bool(em.converged):
            statistics = em.accumulate(source, share)
            if int(em.steps) >= max_iter:
                em.record(statistics, tol)
                return
            bar.update(em.maximise(statistics, tol))


def _products(source: SampleSource, share: Share, epoch: int) -> Iterator[Samples]:
    """The samples of this process, as many at a time as one product takes."""
    parts, count = [], 0
    for index in share.blocks(source.n_blocks):
        parts.append(usable_block(source, index, epoch))
        count += len(parts[-1].states)
        if count >= PRODUCT:
            yield join_samples(parts)
            parts, count = [], 0
    if parts:
        yield join_samples(parts)


def _inverse(factor: Tensor) -> Tensor:
    return torch.linalg.solve_triangular(factor, torch.eye(len(factor)).to(factor), upper=False)


def _to_units(mixture: MixtureParameters, shift: Tensor, factor: Tensor) -> MixtureParameters:
    """Mixture of L^-1 (x - m)."""
    weights, means, covariances = (p.detach().double() for p in mixture)
    return map_mixture(MixtureParameters(weights, means - shift, covariances), _inverse(factor))


def _check_settings(
    n_components: int, start_samples: int, covariance_floor: float, init: Any
) -> None:
    if n_components < 1:
        raise InputError(f"n_components must be at least 1, got {n_components}")
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
    """Raise unless there is a pose for every component."""
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
