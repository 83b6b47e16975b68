"""The mixture Kalman filter: fixed, sampled and split tracks (paper section 3.4)."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.module_state import (
    derived,
    one_run,
    outside_inference,
    register_given,
    wide_or_parameter,
)
from torchpose._core.value_checks import values_visible
from torchpose.errors import InputError
from torchpose.filters import fixed_tracks, sampled_tracks, split_tracks
from torchpose.filters.base import (
    Generators,
    Measurements,
    RecursiveFilter,
    as_covariance,
    given_covariance,
    given_initial_cov,
    require_state,
)
from torchpose.filters.frame_weights import FrameGains
from torchpose.filters.gains import GainGraph
from torchpose.filters.outputs import FilterOutput, StepOutput
from torchpose.filters.smoothing import smooth_fixed_tracks
from torchpose.filters.tracks import MKFState
from torchpose.filters.transition import (
    BURN_IN_SCALE,
    Transition,
    check_transition_options,
    make_transition,
)
from torchpose.filters.weights import normalise
from torchpose.priors.gaussian_mixture import GaussianMixture

__all__ = ["MKFState", "MixtureKalmanFilter"]

TRACKS = ("fixed", "sampled", "split")
WEIGHTINGS = ("sequence", "frame")
_UNIFORM_WEIGHT = 1e-3
TRACK_OPTIONS = {
    "n_tracks": ("sampled", "split"),
    "resample_threshold": ("sampled",),
    "uniform_weight": ("fixed",),
    "likelihood_power": ("fixed",),
    "weighting": ("fixed",),
    "reset_below": ("fixed",),
    "medians": ("fixed",),
}
"""Options that only some kinds of tracks use, and which."""


class MixtureKalmanFilter(RecursiveFilter):
    """Mixture Kalman filter of a mixture of Ornstein-Uhlenbeck motion models.

    Given its indicator i, the state follows (BL 32)
        x_t = F_i x_{t-1} + (I - F_i) mu_i + N(0, N_i),  F_i = Sigma_i (Q + Sigma_i)^-1,
    and is measured through z_t = H x_t + N(0, R) (BL 33). Each track is one history of indicators
    with a Kalman filter of its own (BL 34-42); the estimate is the weighted mean (BL 48).

    - ``fixed``: track j keeps indicator j for ever (BL 49); w_j prop. to pi_j N_j w_{t-1,j}, then
      w <- (w + epsilon) / (1 + M epsilon), so that no component is lost.
    - ``sampled``: indicators are drawn from pi (BL 47) and tracks are resampled when the effective
      sample size falls below `resample_threshold` M.
    - ``split``: every track is continued by every component, and the M likeliest are kept
      (Smith & Winter).

    Args:
        gmm: the mixture prior (BL 7), K components over D dimensions.
        process_cov: Q, [D, D] or its diagonal [D], per frame.
        measurement_cov: R, [Z, Z] or its diagonal [Z].
        observed: the Z state indices that are measured.
        tracks: "fixed", "sampled" or "split".
        n_tracks: M; K by default, and always K for fixed tracks.
        uniform_weight: epsilon, 1e-3 by default; only for fixed tracks whose weighting is "sequence".
        initial_cov: covariance of every track before the first prediction, [D, D], [D] or [K, D, D];
            by default that of its component.
        transition: "paper", "stationary" or "ou", see `make_transition`. gamma, subspace: of "ou".
        resample_threshold: share of M, 0 (never) to 1 (always), 0.5 by default; only for sampled tracks.
        burn_in: number of frames over which Q starts inflated by `burn_in_scale` (100 by default) and
            decays to itself geometrically (paper section 3.3, after BL 26). 0 is no burn-in, as it has
            to be for "ou", which has no Q.
        likelihood_power: exponent of the likelihood in the weights of fixed tracks; 1 as published,
            below 1 where the components are surer of themselves than they should be.
        weighting: "sequence" as published, or "frame" (fixed tracks only): the weights of a frame are
            those that the mixture gives to its measurement alone, w_j prop. to
            pi_j N(z_t; H mu_j, H Sigma_j H^T + R), see `frame_weights`. For mixtures whose state
            holds the past already.
        reset_below: fixed tracks only; see `step_weights`.
        dtype: of means and measurements; covariances are always float64.
        medians: first of three dimensions each, points whose estimate is the geometric median of the
            mixture instead of its mean (BL 48); only where frames do not depend on each other.

    Raises:
        InputError, ShapeError, CovarianceError: for what does not fit, before any work; InputError also
            for an option that the kind of tracks, weighting or transition does not use.

    Reference:
        M. Burke, J. Lasenby, "Single camera pose estimation using Bayesian filtering and Kinect
        motion priors", eqs 27-49. H. Smith, P. Winter, "On-line outlier detection and correction
        with a split-track filter" (1978), as cited there.

    Example:
        >>> import torch
        >>> from torchpose.filters import MixtureKalmanFilter
        >>> from torchpose.priors import GaussianMixture
        >>> prior = GaussianMixture(
        ...     torch.tensor([0.5, 0.5]), torch.tensor([[0.0, 0.0], [4.0, 4.0]]),
        ...     torch.eye(2).expand(2, 2, 2))
        >>> f = MixtureKalmanFilter(prior, torch.ones(2), torch.ones(1), observed=[0])
        >>> out = f(torch.full((1, 20, 1), 4.0))
        >>> bool((out.mean[0, -1] > 3).all())
        True
    """

    def __init__(
        self,
        gmm: GaussianMixture,
        process_cov: Tensor,
        measurement_cov: Tensor,
        observed: Sequence[int] | Tensor,
        tracks: str = "fixed",
        n_tracks: int | None = None,
        uniform_weight: float | None = None,
        initial_cov: Tensor | None = None,
        transition: str = "paper",
        gamma: Tensor | float | None = None,
        subspace: int | None = None,
        resample_threshold: float | None = None,
        burn_in: int = 0,
        burn_in_scale: float | None = None,
        likelihood_power: float = 1.0,
        weighting: str = "sequence",
        reset_below: float | None = None,
        dtype: torch.dtype = torch.float64,
        medians: Sequence[int] = (),
    ) -> None:
        super().__init__(measurement_cov, observed, gmm.means.shape[-1], dtype)
        n_components = gmm.means.shape[0]
        _check_tracks(tracks, n_tracks, n_components)
        unlike_default = {
            "resample_threshold": resample_threshold is not None,
            "uniform_weight": uniform_weight is not None,
            "likelihood_power": likelihood_power != 1,
            "weighting": weighting != "sequence",
            "reset_below": reset_below is not None,
            "medians": len(medians) > 0,
        }
        _refuse_unused(tracks, [name for name, given in unlike_default.items() if given])
        _check_weighting(weighting, uniform_weight, reset_below)
        check_transition_options(transition, gamma, subspace, burn_in, burn_in_scale)
        uniform_weight = _UNIFORM_WEIGHT if uniform_weight is None else uniform_weight
        resample_threshold = 0.5 if resample_threshold is None else resample_threshold
        _check_ranges(uniform_weight, resample_threshold, likelihood_power)
        if len(medians):
            _check_memoryless(weighting, transition, gamma)
        self.tracks = tracks
        self.n_tracks = n_tracks or n_components
        self.uniform_weight = float(uniform_weight) if tracks == "fixed" else 0.0
        self.transition_kind = transition
        self.subspace = subspace
        self.resample_threshold = resample_threshold
        self.burn_in = burn_in
        self.burn_in_scale = BURN_IN_SCALE if burn_in_scale is None else float(burn_in_scale)
        self.likelihood_power = float(likelihood_power)
        self.weighting = weighting
        self.reset_below = reset_below
        points = torch.tensor(list(medians), dtype=torch.long)
        self.register_buffer("medians", points, persistent=False)  # a setting, as `tracks` is
        self._register_mixture(gmm)
        register_given(self, "process_cov", given_covariance("process_cov", process_cov, self.dim))
        register_given(self, "gamma", wide_or_parameter(gamma))
        register_given(self, "initial_cov", given_initial_cov(initial_cov, self.covariances))
        self.to(gmm.means.device)
        self.transition(self.burn_in)  # raises what does not fit before any work

    medians: Tensor
    log_prior: Tensor
    means: Tensor
    covariances: Tensor
    process_cov: Tensor
    initial_cov: Tensor | None
    gamma: Tensor | None

    def _register_mixture(self, prior: GaussianMixture) -> None:
        weights = prior.weights.to(torch.float64)
        register_given(self, "log_prior", (weights / weights.sum()).log())
        register_given(self, "means", wide_or_parameter(prior.means))
        register_given(self, "covariances", wide_or_parameter(prior.covariances))

    @property
    def sources(self) -> tuple[Tensor, ...]:
        """The tensors that every gain depends on, beside R."""
        tensors = (self.log_prior, self.means, self.covariances, self.process_cov)
        return (*tensors, *(t for t in (self.gamma, self.initial_cov) if t is not None))

    @property
    def start_cov(self) -> Float[Tensor, "K D D"]:
        """Covariance of every component's track before the first prediction."""
        if self.initial_cov is None:
            return self.covariances.to(torch.float64)
        cov = as_covariance("initial_cov", self.initial_cov, self.dim, self.initial_cov.ndim)
        return cov.expand(self.means.shape[0], -1, -1)

    def transition(self, time: int) -> Transition:
        """The transition into frame `time` (0-based), with the inflated Q of the burn-in."""
        if time < self.burn_in:
            return self._make_transition(self.burn_in_scale ** (1 - time / self.burn_in))
        sources = (self.means, self.covariances, self.process_cov, self.gamma)
        return derived(self, "transition", sources, lambda: self._make_transition(1.0))

    def _make_transition(self, inflation: float) -> Transition:
        wide = torch.float64
        return make_transition(
            self.transition_kind,
            self.means.to(wide),
            self.covariances.to(wide),
            inflation * as_covariance("process_cov", self.process_cov, self.dim),
            None if self.gamma is None else self.gamma.to(wide),
            self.subspace,
        )

    def init(self, batch_size: int, generator: Generators = None) -> MKFState:
        """Tracks at the component means, weighted by pi; sampled tracks draw their component."""
        if batch_size < 1:
            raise InputError(f"batch_size must be at least 1, got {batch_size}")
        if self.tracks == "sampled":
            return sampled_tracks.init(self, batch_size, generator)
        device = self.means.device
        return MKFState(
            normalise(self.log_prior).to(self.dtype).expand(batch_size, -1),
            self.means.to(self.dtype).expand(batch_size, -1, -1),
            self.start_cov[None],
            torch.zeros(batch_size, dtype=torch.long, device=device),
            0,
        )

    def check_state(self, state: Any, batch: int) -> None:
        """Raise unless a state is one of this filter's, of so many elements."""
        tracks = (
            None if self.tracks == "split" else self.n_tracks
        )  # which are first one per component
        require_state(state, MKFState, "mean", (batch, tracks, self.dim))

    def advance(
        self, state: MKFState, frame: Measurements, generator: Generators, return_cov: bool
    ) -> tuple[MKFState, StepOutput]:
        """One step; see `RecursiveFilter.step`."""
        if self.tracks == "sampled":
            return sampled_tracks.advance(self, state, frame, generator, return_cov)
        if self.tracks == "split":
            return split_tracks.advance(self, state, frame, return_cov)
        return fixed_tracks.advance(self, state, frame, return_cov)

    def run(
        self, frames: Measurements, generator: Generators, return_cov: bool, progress: bool
    ) -> FilterOutput:
        """All frames: fixed tracks share their gains and need no loop where those are constant."""
        if self.tracks == "fixed" and values_visible():
            return fixed_tracks.run(self, frames, return_cov, progress)
        return super().run(frames, generator, return_cov, progress)

    def smooth(
        self,
        z: Float[Tensor, "B T Z"],
        mask: Bool[Tensor, "B T Z"] | None = None,
        measurement_cov: Tensor | None = None,
        lengths: Int[Tensor, " B"] | None = None,
        lag: int | None = None,
        return_cov: bool = False,
    ) -> FilterOutput:
        """Estimates that use later measurements too; fixed tracks only.

        Args:
            z, mask, measurement_cov, lengths, return_cov: as `forward`.
            lag: number of later frames that each estimate may use; None is the whole sequence.

        Returns:
            `FilterOutput` with smoothed mean, weights and covariance, and the filter's log-evidence.

        Raises:
            InputError: tracks are not fixed, their weights may be reset (`reset_below`), or lag is
            negative; else as `forward`.

        Reference:
            H. Rauch, F. Tung, C. Striebel (1965); see `smooth_fixed_tracks`.
        """
        if self.tracks != "fixed":
            raise InputError(
                f"smoothing needs tracks='fixed', whose tracks have a past each, got {self.tracks!r}"
            )
        if self.reset_below is not None:
            raise InputError(
                "smoothing goes back along the weights, which a reset cuts off, got "
                f"reset_below={self.reset_below}; leave it out"
            )
        with one_run(self.observed.device):
            frames = self.check(z, mask, measurement_cov, lengths, None)
            return smooth_fixed_tracks(self, frames, lag, return_cov)

    @property
    def is_memoryless(self) -> bool:
        """Whether frames do not depend on each other: neither the weights nor the states do."""
        still = self.gamma is not None and bool((self.gamma == 0).all())
        return self.weighs_frames_alone and still

    @property
    def weighs_frames_alone(self) -> bool:
        """Whether neither weights nor, at a rate of 0, states depend on the frames before."""
        return self.weighting == "frame" and self.transition_kind == "ou"

    def gain_graph(self, measurement_cov: Tensor) -> GainGraph:
        """The graph of gains for constant R, kept while model and R stay as they are."""
        kept: dict[str, GainGraph] = derived(self, f"gains {self.dtype}", self.sources, dict)
        graph = kept.get("graph")
        if graph is None or graph.full() or not torch.equal(graph.measurement_cov, measurement_cov):
            steady = self.transition(self.burn_in)
            with outside_inference():
                graph = GainGraph(steady, self.observed, measurement_cov.clone(), self.start_cov)
            kept["graph"] = graph
        return graph

    @property
    def frame_gains(self) -> FrameGains:
        """Gains of components by pattern of measured dimensions, kept while the mixture stays."""
        sources = (self.means, self.covariances)
        return derived(self, f"frame gains {self.dtype}", sources, FrameGains)

    def extra_repr(self) -> str:
        """Main settings, for printing."""
        return (
            f"tracks={self.tracks}, n_tracks={self.n_tracks}, dim={self.dim}, "
            f"observed={self.observed.tolist()}, transition={self.transition_kind}"
        )


def _check_tracks(tracks: str, n_tracks: int | None, n_components: int) -> None:
    if tracks not in TRACKS:
        raise InputError(f"tracks must be one of {', '.join(TRACKS)}, got {tracks!r}")
    if n_tracks is not None and n_tracks < 1:
        raise InputError(f"n_tracks must be at least 1, got {n_tracks}")
    if tracks == "fixed" and n_tracks not in (None, n_components):
        raise InputError(
            f"fixed tracks are one for each of the {n_components} components, got "
            f"n_tracks={n_tracks}; leave it out, or use tracks='sampled'"
        )


def _refuse_unused(tracks: str, given: Sequence[str]) -> None:
    for name in given:
        if tracks not in TRACK_OPTIONS[name]:
            raise InputError(
                f"{name} does not apply to tracks={tracks!r}; it is of tracks="
                f"{' or '.join(map(repr, TRACK_OPTIONS[name]))}"
            )


def _check_weighting(
    weighting: str, uniform_weight: float | None, reset_below: float | None
) -> None:
    if weighting not in WEIGHTINGS:
        raise InputError(f"weighting must be one of {', '.join(WEIGHTINGS)}, got {weighting!r}")
    if weighting == "frame" and not (reset_below is None and uniform_weight is None):
        raise InputError(
            "weighting 'frame' takes every frame's weights from that frame alone: uniform_weight and "
            f"reset_below are of 'sequence', got {uniform_weight} and {reset_below}"
        )


def _check_memoryless(weighting: str, transition: str, gamma: Tensor | float | None) -> None:
    still = gamma is not None and bool((torch.as_tensor(gamma) == 0).all())
    if not (still and transition == "ou" and weighting == "frame"):
        raise InputError(
            "medians are of frames that do not depend on each other: they need weighting='frame', "
            f"transition='ou' and gamma=0, got {weighting!r}, {transition!r} and gamma={gamma}"
        )


def _check_ranges(uniform_weight: float, resample_threshold: float, power: float) -> None:
    if not (uniform_weight >= 0 and math.isfinite(uniform_weight)):
        raise InputError(f"uniform_weight must be at least 0, got {uniform_weight}")
    if not 0 <= resample_threshold <= 1:
        raise InputError(
            f"resample_threshold must be a share from 0 to 1, got {resample_threshold}"
        )
    if not 0 < power <= 1:
        raise InputError(f"likelihood_power must lie in (0, 1], got {power}")
