"""Run the mixture Kalman filter with sampled tracks, whose indicators are drawn (BL 43-48)."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from tqdm.auto import tqdm

from torchpose._core.checks import check_count
from torchpose._core.former_arguments import takes_former_arguments
from torchpose._core.value_checks import values_visible
from torchpose.errors import InputError
from torchpose.filters._joint_tracks import (
    JointTracks,
    joined,
    joint_chunks,
    joint_estimate,
    joint_models,
    joint_problems,
    stacked,
)
from torchpose.filters._measurements import Measurements
from torchpose.filters._mkf import MixtureKalmanFilter, MKFState
from torchpose.filters._outputs import FilterOutput, StepOutput, mending
from torchpose.filters._recompute import wants_gradient
from torchpose.filters._recursive_filter import Generators, uniform
from torchpose.filters._resampling import ancestors, systematic, systematic_positions
from torchpose.filters._weights import estimate_of, normalise
from torchpose.math._gaussian import mended_update, predict_moments
from torchpose.priors._gaussian_mixture import GaussianMixture


class SampledTrackFilter(MixtureKalmanFilter, tracks="sampled"):
    """Filters by a mixture Kalman filter whose M tracks draw a component from pi in every frame.

    A track is a Kalman filter under the components it drew; its weight is w_j prop. to w_{t-1,j} N_j
    (BL 47). Tracks are resampled, systematically, when the effective sample size (BL 25) falls below
    `resample_threshold` M.

    Args:
        gmm, process_cov, measurement_cov, observed, initial_cov, transition, gamma, subspace, burn_in,
            burn_in_scale, dtype: as `MixtureKalmanFilter`.
        n_tracks: M; K by default.
        resample_threshold: share of M, 0 (never) to 1 (always).

    Raises:
        InputError, ShapeError, CovarianceError: for what does not fit, before any work.

    Reference:
        M. Burke, J. Lasenby, "Single camera pose estimation using Bayesian filtering and Kinect
        motion priors", eqs 34-48. R. Chen, J. S. Liu, "Mixture Kalman filters" (2000).
    """

    def __init__(
        self,
        gmm: GaussianMixture,
        process_cov: Tensor,
        measurement_cov: Tensor,
        observed: Sequence[int] | Tensor,
        *,
        n_tracks: int | None = None,
        initial_cov: Tensor | None = None,
        transition: str = "paper",
        gamma: Tensor | float | None = None,
        subspace: int | None = None,
        resample_threshold: float | None = None,
        burn_in: int = 0,
        burn_in_scale: float | None = None,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        threshold = 0.5 if resample_threshold is None else resample_threshold
        if not 0 <= threshold <= 1:
            raise InputError(f"resample_threshold must be a share from 0 to 1, got {threshold}")
        self._register_model(
            gmm, process_cov, measurement_cov, observed,
            n_tracks=n_tracks, initial_cov=initial_cov, transition=transition, gamma=gamma,
            subspace=subspace, burn_in=burn_in, burn_in_scale=burn_in_scale, dtype=dtype,
        )  # fmt: skip
        self.resample_threshold = threshold

    @takes_former_arguments
    def init(self, batch_size: int, *, generator: Generators = None) -> MKFState:
        """Return the state before the first frame: M tracks at the means of components drawn from pi.

        Args:
            batch_size: B. generator: one generator, or a list of one for each element.
        """
        check_count("batch_size", batch_size)
        drawn = self._draw_components(batch_size, generator)
        log_weights = torch.zeros(drawn.shape, dtype=self.dtype, device=drawn.device)
        group = torch.arange(batch_size, device=drawn.device)
        mean, cov = self.means.to(self.dtype)[drawn], self.start_cov[drawn]
        return MKFState(normalise(log_weights), mean, cov, group, 0)

    def filter_frame(
        self, state: MKFState, frame: Measurements, generator: Generators, return_cov: bool
    ) -> tuple[MKFState, StepOutput]:
        """Filter one frame: draw indicators, filter, weigh (BL 47), and resample if needed (BL 25)."""
        drawn = self._draw_components(frame.z.shape[0], generator)
        matrix, offset, noise = (part[drawn] for part in self.transition(state.time))
        wide = torch.float64
        mean, cov = predict_moments(state.mean.to(wide), state.cov, matrix, offset, noise)
        noise_cov = frame.cov if frame.cov.ndim == 2 else frame.cov[:, None]
        mask = frame.mask[:, None].expand(*mean.shape[:2], -1)
        mean, cov, log_likelihood, jitter = mended_update(
            mean, cov, frame.z[:, None].to(wide), noise_cov, self.observed, mask
        )
        mean = mean.to(self.dtype)
        joint = state.log_weights + log_likelihood.to(self.dtype)
        log_evidence = torch.logsumexp(joint, -1)
        log_weights = joint - log_evidence[:, None]
        log_evidence = torch.where(frame.mask.any(-1), log_evidence, torch.zeros_like(log_evidence))
        estimate, total = estimate_of(log_weights, mean, cov if return_cov else None)
        carried = self._resample(log_weights, mean, cov, generator)
        group = torch.arange(frame.z.shape[0], device=mean.device)
        return (
            MKFState(*carried, group, state.time + 1),
            StepOutput(estimate, log_weights, log_evidence, total, *mending(estimate, jitter)),
        )

    def filter_frames(
        self, frames: Measurements, generator: Generators, return_cov: bool, progress: bool
    ) -> FilterOutput:
        """Filter whole sequences, given checked measurements, some sequences at a time."""
        if not values_visible() or wants_gradient(frames.z, frames.cov, *self.sources):
            return super().filter_frames(frames, generator, return_cov, progress)
        batch, n_frames = frames.z.shape[:2]
        first = self._draw_components(batch, generator)
        # In the order in which single frames draw, so that numbers are theirs.
        draws = [self._draw_frame(batch, generator) for _ in range(n_frames)]
        parts = []
        with tqdm(total=batch * n_frames, disable=not progress, unit="frame") as bar:
            for chunk in joint_chunks(self, batch):
                own = [(drawn[chunk], u[chunk]) for drawn, u in draws]
                parts.append(self._filter_chunk(frames.some(chunk), first[chunk], own, return_cov))
                bar.update(len(parts[-1].mean) * n_frames)
        return joined(parts, frames.lengths)

    def _draw_frame(self, batch: int, generator: Generators) -> tuple[Tensor, Tensor]:
        """Draw what one frame needs: components [B, M], and where resampling starts [B, 1]."""
        drawn = self._draw_components(batch, generator)
        like = torch.empty(0, dtype=torch.float64, device=drawn.device)
        return drawn, uniform(batch, (1,), generator, like)

    def _filter_chunk(
        self,
        frames: Measurements,
        first: Tensor,
        draws: list[tuple[Tensor, Tensor]],
        return_cov: bool,
    ) -> FilterOutput:
        """Filter some sequences whose random numbers are drawn, as `filter_frame` does."""
        equal = normalise(torch.zeros(first.shape, dtype=self.dtype, device=first.device))
        own = torch.arange(self.n_tracks, device=first.device)
        tracks, log_weights = JointTracks(self, self.means[first], self.start_cov[first]), equal
        positions = systematic_positions(torch.stack([u for _, u in draws]), self.n_tracks)
        moves = joint_models(self, len(draws))
        steps = []
        for problem, (drawn, _), places, move in zip(
            joint_problems(frames), draws, positions, moves, strict=True
        ):
            tracks.predict(move, drawn)
            log_likelihood, jitter = tracks.weigh(problem)
            joint = log_weights + log_likelihood.to(self.dtype)
            log_weights = joint.log_softmax(-1)
            steps.append(joint_estimate(tracks, log_weights, joint, [jitter], return_cov))
            weights = log_weights.exp()
            needed = self._is_degenerate(weights)
            if bool(needed.any()):
                parent = ancestors(weights.double(), places)
                tracks.take(torch.where(needed[:, None], parent, own))
                log_weights = torch.where(needed[:, None], equal, log_weights)
        return stacked(tracks, steps, frames)

    def _is_degenerate(self, weights: Tensor) -> Tensor:
        """Return whether the effective sample size of normalised weights is below its share of M, [B]."""
        least = self.resample_threshold * self.n_tracks
        return torch.linalg.vecdot(weights, weights) > (1 / least if least else math.inf)

    def _draw_components(self, batch: int, generator: Generators) -> Tensor:
        cumulative = self.log_prior.exp().cumsum(0)
        draws = uniform(batch, (self.n_tracks,), generator, cumulative)
        return torch.searchsorted(cumulative, draws).clamp_max(cumulative.numel() - 1)

    def _resample(
        self, log_weights: Tensor, mean: Tensor, cov: Tensor, generator: Generators
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return tracks with equal weights for the elements that need it; all of them draw."""
        resampled = systematic(log_weights, generator)
        needed = self._is_degenerate(log_weights.exp())
        if values_visible() and not bool(needed.any()):
            return log_weights.clone(), mean, cov  # those of the output are the caller's
        own = torch.arange(self.n_tracks, device=mean.device)
        index = torch.where(needed[:, None], resampled, own)
        rows = torch.arange(index.shape[0], device=mean.device)[:, None]
        equal = normalise(torch.zeros_like(log_weights))
        log_weights = torch.where(needed[:, None], equal, log_weights)
        return log_weights, mean[rows, index], cov[rows, index]
