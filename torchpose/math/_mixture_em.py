"""Fit Gaussian mixtures by expectation-maximisation: one engine, for points in memory and in blocks."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Self

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose._core.checks import check_finite, check_shape
from torchpose.errors import InputError
from torchpose.math._gaussian import symmetrise
from torchpose.math._mixture_steps import (
    FitReport,
    MixtureParameters,
    SufficientStatistics,
    e_step,
    m_step,
)

__all__ = [
    "FitReport",
    "IterationBar",
    "MixtureFit",
    "MixtureParameters",
    "SufficientStatistics",
    "e_step",
    "expectation_maximisation",
    "m_step",
    "map_mixture",
    "run_fit",
    "whitening",
]


class MixtureFit(nn.Module):
    """Fits a Gaussian mixture step by step; the whole state of the fit is in its `state_dict`.

    The sums of all points together go to `maximise`, and that is one step of EM. Buffers are float64
    and in units in which the points have about unit covariance, y = L^-1 (x - m), which takes away the
    cancellation of the products and does not change EM.

    Attributes:
        weights [K], means [K, D], covariances [K, D, D]: of the mixture of y.
        shift: m [D]. factor: L [D, D], lower triangular. floor: added to covariances of y [D, D].
        history: mean log-likelihood before every step and, if `record` was last, at the end.
        steps: maximisation steps taken. moved: components moved in the last of them (see `m_step`).
        reseeded: components moved in all of them. converged: the last change was below `tol`.

    Args:
        start: the mixture of y to start from.
        shift, factor, floor: see above.
        dtype: of the products over the points; float32 is faster and good to about 1e-4.
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

    @classmethod
    def in_units(
        cls,
        start: MixtureParameters,
        shift: Float[Tensor, " D"],
        factor: Float[Tensor, "D D"],
        variances: Float[Tensor, " D"],
        dtype: torch.dtype,
    ) -> Self:
        """Return the fit of a mixture that is given in the units of the points.

        Args:
            start: the mixture of x. shift, factor: m and L, see `whitening`.
            variances: added to the diagonal of every covariance of x. dtype: as for the class.
        """
        inverse = _inverse(factor)
        weights, means, covariances = (p.detach().double() for p in start)
        first = map_mixture(MixtureParameters(weights, means - shift, covariances), inverse)
        return cls(first, shift, factor, (inverse * variances) @ inverse.T, dtype)

    @classmethod
    def blank(cls, n_components: int, dim: int) -> Self:
        """Return a mixture of the given size to load a `state_dict` into."""
        eye = torch.eye(dim, dtype=torch.float64)
        means = torch.zeros(n_components, dim, dtype=torch.float64)
        weights = torch.full((n_components,), 1 / n_components, dtype=torch.float64)
        start = MixtureParameters(weights, means, eye.expand(n_components, -1, -1))
        return cls(start, means[0], eye, torch.zeros_like(eye), torch.float64)

    def restart(self, parameters: MixtureParameters) -> None:
        """Go on from another mixture, given in the units of the buffers, with an empty history."""
        self._set(parameters)
        self.history = self.history[:0]
        for name in ("steps", "moved", "reseeded", "converged"):
            setattr(self, name, torch.zeros_like(getattr(self, name)))

    # --- one step

    def parameters_tuple(self) -> MixtureParameters:
        """Return weights, means and covariances in the units of the buffers."""
        return MixtureParameters(self.weights, self.means, self.covariances)

    def whitened(self, points: Float[Tensor, "N D"]) -> Float[Tensor, "D N"]:
        """Return y = L^-1 (x - m) of points, in the dtype of the products."""
        return (_inverse(self.factor) @ (points - self.shift).T).to(self.dtype)

    @torch.no_grad()
    def record(self, statistics: SufficientStatistics, tol: float = 0.0) -> float:
        """Note the mean log-likelihood of the mixture, and whether it has settled.

        Args:
            statistics: the statistics of all samples, made with the mixture as it is.
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
        """Run `record`, and the maximisation step unless the fit has converged.

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
        """Return the mean log-likelihood, in units of the states, from statistics that `expect` made."""
        if float(statistics.weight) == 0:
            raise InputError("EM needs samples of positive weight, got none; look at the weights")
        offset = float(self.factor.diagonal().log().sum())
        return float(statistics.log_likelihood / statistics.weight) - offset

    def parameters_of_points(self) -> MixtureParameters:
        """Return the mixture as it is, in the units of the points."""
        state = map_mixture(self.parameters_tuple(), self.factor)
        return state._replace(means=state.means + self.shift)

    def report(self) -> FitReport:
        """Return a report of the iterations until now."""
        return FitReport(
            iterations=int(self.steps),
            log_likelihood=tuple(self.history.tolist()),
            converged=bool(self.converged),
            reseeded=int(self.reseeded),
        )

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


def run_fit(
    fit: MixtureFit,
    expect: Callable[[], SufficientStatistics],
    *,
    max_iter: int = 200,
    tol: float = 1e-4,
    progress: bool = False,
) -> None:
    """Take EM steps until a fit has converged or taken `max_iter` of them, those before included.

    Args:
        fit: in whatever state. expect: gives the sums of all points, with the mixture as it is.
        max_iter: largest number of steps. tol: as for `MixtureFit.record`. progress: show a bar.
    """
    with IterationBar(max_iter, progress) as bar:
        while not bool(fit.converged):
            statistics = expect()
            if int(fit.steps) >= max_iter:
                fit.record(statistics, tol)
                return
            bar.update(fit.maximise(statistics, tol))


def expectation_maximisation(
    x: Float[Tensor, "N D"],
    start: MixtureParameters,
    sample_weight: Float[Tensor, " N"] | None = None,
    max_iter: int = 200,
    tol: float = 1e-4,
    floor: Float[Tensor, " D"] | None = None,
    dtype: torch.dtype = torch.float64,
    progress: bool = False,
) -> tuple[MixtureParameters, FitReport]:
    """Fit by EM from a given start until the mean log-likelihood changes by less than `tol`.

    Internally the points are whitened with their own covariance, in float64: that takes away the
    cancellation in theta . phi(x), and EM itself does not change under such a map. Parameters and
    log-likelihood are mapped back.

    The log-likelihood never falls, except where a component is moved (see `m_step`), and by what
    the floor costs.

    Args:
        x: points, finite.
        start: mixture to start from.
        sample_weight: w_n >= 0; a point of weight 2 counts as two points.
        max_iter: largest number of maximisation steps.
        tol: change of the mean log-likelihood at which to stop; 0 never stops early.
        floor: variances [D] that are added to the diagonal of every covariance, in squared units
            of x; zeros if None.
        dtype: of the products over the points; float32 is faster and good to about 1e-4.
        progress: show a bar.

    Returns:
        The mixture in float64, and how the fit went.

    Raises:
        ShapeError, InputError: shapes that do not fit together, points that are not finite,
            weights that are negative, fewer points than components.

    Reference:
        Burke & Lasenby, appendix A, equations (BL 51-56).
    """
    _check_points(x, start, sample_weight)
    x = x.detach().double()
    if sample_weight is not None:
        sample_weight = sample_weight.detach().double()
    diagonal = torch.zeros_like(x[0]) if floor is None else floor.to(x)
    shift, centred, factor = whitening(x, sample_weight, diagonal)
    fit = MixtureFit.in_units(start, shift, factor, diagonal, dtype)
    white = (_inverse(factor) @ centred).to(dtype)  # [D, N] in memory, as `e_step` wants it

    def expect() -> SufficientStatistics:
        return e_step(white.T, fit.parameters_tuple(), sample_weight)

    run_fit(fit, expect, max_iter=max_iter, tol=tol, progress=progress)
    return fit.parameters_of_points(), fit.report()


class IterationBar:
    """Progress bar over iterations that shows the log-likelihood; nothing unless asked for."""

    def __init__(self, total: int, show: bool) -> None:
        self.bar = None
        if show:
            from tqdm.auto import tqdm

            self.bar = tqdm(total=total, desc="EM", unit="it")

    def __enter__(self) -> IterationBar:
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.close()

    def update(self, log_likelihood: float) -> None:
        if self.bar is not None:
            self.bar.set_postfix_str(f"log-likelihood {log_likelihood:.5f}", refresh=False)
            self.bar.update()


def map_mixture(state: MixtureParameters, matrix: Float[Tensor, "D D"]) -> MixtureParameters:
    """Return the mixture of A x, where `state` is that of x."""
    covariances = symmetrise(matrix @ state.covariances @ matrix.T)
    return MixtureParameters(state.weights, state.means @ matrix.T, covariances)


def whitening(
    x: Tensor, sample_weight: Tensor | None, diagonal: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mean [D], the centred points [D, N], and a Cholesky factor [D, D] of their covariance."""
    share = None if sample_weight is None else sample_weight / sample_weight.sum()
    mean = x.mean(0) if share is None else share @ x
    centred = torch.sub(x.T, mean.unsqueeze(-1), out=x.new_empty(x.shape[1], len(x)))
    covariance = centred @ centred.T / len(x) if share is None else centred * share @ centred.T
    variance = covariance.diagonal()
    # a direction without any spread must not be blown up; any regular factor serves
    ridge = torch.where(variance > 0, 1e-9 * variance, torch.ones_like(variance))
    factor = torch.linalg.cholesky(covariance + torch.diag(torch.maximum(ridge, diagonal)))
    return mean, centred, factor


def _check_points(x: Tensor, start: MixtureParameters, sample_weight: Tensor | None) -> None:
    check_shape("x", x, ("N", "D"))
    check_finite("x", x, hint="drop frames with missing joints before the fit")
    n_components, dim = len(start.weights), x.shape[1]
    check_shape("start.means", start.means, (n_components, dim))
    check_shape("start.covariances", start.covariances, (n_components, dim, dim))
    if len(x) < n_components:
        raise InputError(
            f"a fit needs at least as many points as components, got {len(x)} points for "
            f"{n_components} components"
        )
    if sample_weight is not None:
        check_shape("sample_weight", sample_weight, (len(x),))
        check_finite("sample_weight", sample_weight)
        if bool((sample_weight < 0).any()) or not bool((sample_weight > 0).any()):
            raise InputError(
                "sample_weight must not be negative nor zero throughout, got values from "
                f"{float(sample_weight.min()):g} to {float(sample_weight.max()):g}"
            )


def _inverse(factor: Tensor) -> Tensor:
    return torch.linalg.solve_triangular(factor, torch.eye(len(factor)).to(factor), upper=False)
