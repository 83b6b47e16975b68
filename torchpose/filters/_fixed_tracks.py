"""Run the mixture Kalman filter with fixed tracks: one Kalman filter for each component (BL 49)."""

import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from torchpose._core.checks import check_choice
from torchpose._core.value_checks import values_visible
from torchpose.errors import InputError
from torchpose.filters._columns import run_columns, suits_columns
from torchpose.filters._diagonal_model import diagonal_model
from torchpose.filters._gain_graph import find_history, shares_gains
from torchpose.filters._measurements import Measurements
from torchpose.filters._memoryless import frame_log_likelihood, run_memoryless, step_memoryless
from torchpose.filters._mkf import MixtureKalmanFilter, MKFState
from torchpose.filters._outputs import FilterOutput, StepOutput
from torchpose.filters._own_histories import run_own_histories
from torchpose.filters._recompute import wants_gradient
from torchpose.filters._recursive_filter import Generators
from torchpose.filters._shared_gains import run_for_gradients, run_shared
from torchpose.filters._smoothing import smooth_fixed_tracks
from torchpose.filters._track_steps import run_steps, step_estimate
from torchpose.filters._weights import WeightRule
from torchpose.priors._gaussian_mixture import GaussianMixture

_WEIGHTINGS = ("sequence", "frame")
_UNIFORM_WEIGHT = 1e-3


class FixedTrackFilter(MixtureKalmanFilter, tracks="fixed"):
    """Filters by a mixture Kalman filter with one track for each component, which it always keeps (BL 49).

    Each track j is a Kalman filter; with a_j prop. to pi_j w_{t-1,j}, its weight and the evidence are
        w_j prop. to a_j N_j^power,  log p(z_t | z_1:t-1) = logsumexp_j(log a_j + log N_j),
    and then w <- (w + epsilon) / (1 + M epsilon), so that no component is lost.

    Covariances depend on which joints were measured, never on where they were: sequences that measure
    the same share their gains, and constant stretches need no loop over time.

    Args:
        gmm, process_cov, measurement_cov, observed, initial_cov, transition, gamma, subspace, burn_in,
            burn_in_scale, dtype: as `MixtureKalmanFilter`.
        uniform_weight: epsilon, 1e-3 by default; only where weighting is "sequence".
        likelihood_power: exponent of the likelihood in the weights; 1 as published, below 1 where the
            components are surer of themselves than they should be.
        weighting: "sequence" as published, or "frame": the weights of a frame are those that the mixture
            gives to its measurement alone, w_j prop. to pi_j N(z_t; H mu_j, H Sigma_j H^T + R)^power.
            For mixtures whose state holds the past already.
        reset_below: weights go back to pi where logsumexp_j(log pi_j + log w_j + log N_j) is below this,
            as in the authors' released code, whose linear weights are then all zero. None is never.
        medians: first of three dimensions each, points whose estimate is the geometric median of the
            mixture instead of its mean (BL 48); only where frames do not depend on each other.

    Raises:
        InputError, ShapeError, CovarianceError: for what does not fit, before any work.

    Reference:
        M. Burke, J. Lasenby, "Single camera pose estimation using Bayesian filtering and Kinect
        motion priors", eqs 34-42, 48-49.
    """

    medians: Tensor

    def __init__(
        self,
        gmm: GaussianMixture,
        process_cov: Tensor,
        measurement_cov: Tensor,
        observed: Sequence[int] | Tensor,
        *,
        uniform_weight: float | None = None,
        initial_cov: Tensor | None = None,
        transition: str = "paper",
        gamma: Tensor | float | None = None,
        subspace: int | None = None,
        burn_in: int = 0,
        burn_in_scale: float | None = None,
        likelihood_power: float = 1.0,
        weighting: str = "sequence",
        reset_below: float | None = None,
        dtype: torch.dtype = torch.float64,
        medians: Sequence[int] = (),
    ) -> None:
        _check_weighting(weighting, uniform_weight, reset_below)
        uniform_weight = _UNIFORM_WEIGHT if uniform_weight is None else uniform_weight
        _check_ranges(uniform_weight, likelihood_power)
        if len(medians):
            _check_memoryless(weighting, transition, gamma)
        self._register_model(
            gmm, process_cov, measurement_cov, observed,
            n_tracks=None, initial_cov=initial_cov, transition=transition, gamma=gamma,
            subspace=subspace, burn_in=burn_in, burn_in_scale=burn_in_scale, dtype=dtype,
        )  # fmt: skip
        self.uniform_weight = float(uniform_weight)
        self.likelihood_power = float(likelihood_power)
        self.weighting = weighting
        self.reset_below = reset_below
        points = torch.tensor(list(medians), dtype=torch.long, device=gmm.means.device)
        self.register_buffer("medians", points, persistent=False)  # a setting, no state

    @property
    def weight_rule(self) -> WeightRule:
        """Return the settings of the tracks' weights."""
        log_prior, by_frame = self.log_prior.to(self.dtype), self.weighting == "frame"
        return WeightRule(
            log_prior, self.uniform_weight, self.likelihood_power, self.reset_below, by_frame
        )

    @property
    def is_memoryless(self) -> bool:
        """Return whether frames do not depend on each other: neither weights nor states do."""
        still = self.gamma is not None and bool((self.gamma == 0).all())
        return self._weighs_frames_alone and still

    @property
    def _way(self) -> Literal["traced", "alone", "tracked"]:
        """Return how frames are filtered: alone, along tracks, or both while no value may be seen."""
        if not values_visible():
            return "traced"
        return "alone" if self.is_memoryless else "tracked"

    @property
    def _weighs_frames_alone(self) -> bool:
        """Return whether neither weights nor, at a rate of 0, states depend on earlier frames."""
        return self.weighting == "frame" and self.transition_kind == "ou"

    def filter_frame(
        self, state: MKFState, frame: Measurements, generator: Generators, return_cov: bool
    ) -> tuple[MKFState, StepOutput]:
        """Filter one frame, given its checked measurements (BL 34-41, 49)."""
        rule, way = self.weight_rule, self._way
        if way == "traced":
            return self._filter_unseen(rule, state, frame, return_cov)
        if way == "alone":
            return step_memoryless(self, rule, self.medians, state, frame, return_cov)
        return self._filter_tracks(rule, state, frame, return_cov)

    def _filter_tracks(
        self, rule: WeightRule, state: MKFState, frame: Measurements, return_cov: bool
    ) -> tuple[MKFState, StepOutput]:
        marginal = frame_log_likelihood(self, rule, frame.as_sequences())
        own = None if marginal is None else marginal[:, 0]
        transition = self.transition(state.time)
        return step_estimate(self, rule, state, frame, transition, own, return_cov)

    def _filter_unseen(
        self, rule: WeightRule, state: MKFState, frame: Measurements, return_cov: bool
    ) -> tuple[MKFState, StepOutput]:
        """Take one step while the rate may not be looked at; it matters to medians alone."""
        new_state, out = self._filter_tracks(rule, state, frame, return_cov)
        if not self._may_have_medians:
            return new_state, out
        _, alone = step_memoryless(self, rule, self.medians, state, frame, return_cov)
        return new_state, StepOutput(*self._choose_unseen(alone, out))  # type: ignore[arg-type]

    @property
    def _may_have_medians(self) -> bool:
        """Return whether there are medians to estimate if the rate, which may not be looked at, is 0."""
        return self.gamma is not None and len(self.medians) > 0 and self._weighs_frames_alone

    def _choose_unseen(
        self, alone: Sequence[Tensor | None], tracked: Sequence[Tensor | None]
    ) -> list[Tensor | None]:
        """Return the values of frames alone if the rate is 0, else those of the tracks."""
        still = torch.as_tensor(self.gamma == 0).all()
        pairs = zip(alone, tracked, strict=True)
        return [a if a is None or b is None else torch.where(still, a, b) for a, b in pairs]

    def filter_frames(
        self, frames: Measurements, generator: Generators, return_cov: bool, progress: bool
    ) -> FilterOutput:
        """Filter whole sequences, given checked measurements, in the fastest way that gives these numbers.

        The plain recursion is left to gradients of model or noise, and to burn-in where all sequences
        share their gains.
        """
        if self._way != "tracked":
            return super().filter_frames(frames, generator, return_cov, progress)
        rule, given = self.weight_rule, (frames, return_cov, progress)
        z_learns = wants_gradient(frames.z)
        if wants_gradient(frames.cov, *self.sources):
            return run_steps(self, rule, *given)
        history = None
        if frames.cov.ndim == 2 and self.burn_in == 0 and (z_learns or shares_gains(frames)):
            history = find_history(self, frames)
        if history is None:
            diagonal = None if z_learns or _is_one_history(frames) else diagonal_model(self)
            if diagonal is None:
                return run_steps(self, rule, *given)
            return run_own_histories(self, diagonal, rule, *given)
        if z_learns:
            return run_for_gradients(self, rule, frames, history, return_cov, progress)
        shared = all(len(edges) == 1 for edges in history.edges)
        if shared and not return_cov and suits_columns(rule, len(frames.z)):
            edges = [edges[0] for edges in history.edges]
            return run_columns(self, rule, frames, edges, progress)
        return run_shared(self, rule, frames, history, return_cov, progress)

    def continue_frames(
        self,
        state: MKFState,
        frames: Measurements,
        generator: Generators,
        return_cov: bool,
        progress: bool = False,
    ) -> tuple[MKFState, FilterOutput]:
        """Filter some more frames, given checked measurements; all at once if the filter has no memory."""
        if self._way != "alone":
            return super().continue_frames(state, frames, generator, return_cov, progress)
        rule, n_frames = self.weight_rule, frames.z.shape[1]
        out = run_memoryless(self, rule, self.medians, frames, return_cov, progress)
        return state._replace(time=state.time + n_frames), out

    def smooth_frames(
        self, frames: Measurements, lag: int | None, return_cov: bool
    ) -> FilterOutput:
        """Smooth whole sequences, given checked measurements.

        Filters whose frames do not depend on each other have nothing to smooth: their estimates are
        those of `forward`.

        Raises:
            InputError: the filter resets its weights (`reset_below`), which cuts the past off.

        Reference:
            H. Rauch, F. Tung, C. Striebel (1965); see `smooth_fixed_tracks`.
        """
        if self.reset_below is not None:
            raise InputError(
                "smoothing goes back along the weights, which a reset cuts off, got "
                f"reset_below={self.reset_below}; leave it out"
            )
        rule, way = self.weight_rule, self._way
        if way == "alone":
            return run_memoryless(self, rule, self.medians, frames, return_cov)
        smoothed = smooth_fixed_tracks(self, rule, frames, lag, return_cov)
        if way == "tracked" or not self._may_have_medians:
            return smoothed
        alone = run_memoryless(self, rule, self.medians, frames, return_cov)
        return FilterOutput(*self._choose_unseen(alone, smoothed))  # type: ignore[arg-type]


def _is_one_history(frames: Measurements) -> bool:
    """Return whether several sequences share all their gains."""
    if frames.cov.ndim == 4 or len(frames.z) == 1:
        return False
    return bool((frames.mask == frames.mask[:1]).all())


def _check_weighting(
    weighting: str, uniform_weight: float | None, reset_below: float | None
) -> None:
    check_choice("weighting", weighting, _WEIGHTINGS)
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


def _check_ranges(uniform_weight: float, power: float) -> None:
    if not (uniform_weight >= 0 and math.isfinite(uniform_weight)):
        raise InputError(f"uniform_weight must be at least 0, got {uniform_weight}")
    if not 0 < power <= 1:
        raise InputError(f"likelihood_power must lie in (0, 1], got {power}")
