"""Run the mixture Kalman filter with split tracks (Smith & Winter, as cited in paper section 3.4)."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchpose.filters._measurements import Measurements
from torchpose.filters._mkf import MixtureKalmanFilter, MKFState
from torchpose.filters._outputs import StepOutput, mending
from torchpose.filters._recursive_filter import Generators, require_state
from torchpose.filters._weights import estimate_of, normalise
from torchpose.math._gaussian import kalman_correct, kalman_gain, symmetrise
from torchpose.priors._gaussian_mixture import GaussianMixture

__all__ = ["SplitTrackFilter"]


class SplitTrackFilter(MixtureKalmanFilter, tracks="split"):
    """Filters by a mixture Kalman filter that splits every track by every component; the M likeliest stay.

    A candidate is track i continued by component j, of weight w_i pi_j N(z_t | i, j). In the first
    frame there is one track for each component. Without pruning (M = K^(T+1)) this is the exact
    posterior.

    Args:
        gmm, process_cov, measurement_cov, observed, initial_cov, transition, gamma, subspace, burn_in,
            burn_in_scale, dtype: as `MixtureKalmanFilter`.
        n_tracks: M; K by default.

    Raises:
        InputError, ShapeError, CovarianceError: for what does not fit, before any work.

    Reference:
        H. Smith, P. Winter, "On-line outlier detection and correction with a split-track filter"
        (1978), as cited by Burke & Lasenby.
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
        burn_in: int = 0,
        burn_in_scale: float | None = None,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        self._register_model(
            gmm, process_cov, measurement_cov, observed,
            n_tracks=n_tracks, initial_cov=initial_cov, transition=transition, gamma=gamma,
            subspace=subspace, burn_in=burn_in, burn_in_scale=burn_in_scale, dtype=dtype,
        )  # fmt: skip

    def check_state(self, state: Any, batch: int) -> None:
        """Check that a state is one of this filter's, for a batch of this size.

        Args:
            state: as a step would take it.
            batch: B, number of sequences.

        Raises:
            InputError: a state of another kind of filter. ShapeError: another batch size, or a filter
                of other sizes.
        """
        # Any number of tracks: before the first frame there is one for each component.
        require_state(state, MKFState, "mean", (batch, None, self.dim))

    def filter_frame(
        self, state: MKFState, frame: Measurements, generator: Generators, return_cov: bool
    ) -> tuple[MKFState, StepOutput]:
        """Filter one frame: continue each of the M tracks by each of the K components, keep the M likeliest.

        Only the measured block of the M K predicted covariances is formed before the selection.

        Args:
            state: the state of the B sequences, from `init` or the frame before.
            frame: checked measurements of one frame: z [B, Z], mask [B, Z], cov [Z, Z] or [B, Z, Z].
            generator: for filters that draw; one generator, or a list of one for each sequence.
            return_cov: whether to return the covariance as well.

        Returns:
            The next state, and a `StepOutput` with the mean [B, D].
        """
        wide = torch.float64
        track_cov = state.cov[state.group]
        mean = state.mean.to(wide)
        log_joint, choice_jitter = self._candidate_weights(state, mean, track_cov, frame)
        flat = log_joint.flatten(1)
        log_evidence = torch.logsumexp(flat, -1)
        # The first frames may have fewer candidates than tracks: the rest stays empty, at weight zero.
        spare = max(0, self.n_tracks - flat.shape[1])
        padded = torch.nn.functional.pad(flat, (0, spare), value=-torch.inf)
        kept, chosen = padded.topk(self.n_tracks, dim=1)
        chosen = torch.where(chosen < flat.shape[1], chosen, torch.zeros_like(chosen))
        log_weights = normalise(kept).to(self.dtype)
        log_evidence = torch.where(frame.mask.any(-1), log_evidence, torch.zeros_like(log_evidence))
        n_components = self.means.shape[0]
        parent, component = chosen // n_components, chosen % n_components
        mean, cov, jitter = self._continue(state.time, mean, track_cov, parent, component, frame)
        mean = mean.to(self.dtype)
        estimate, total = estimate_of(log_weights, mean, cov if return_cov else None)
        group = torch.arange(mean.shape[0], device=mean.device)
        new_state = MKFState(log_weights, mean, cov, group, state.time + 1)
        work = mending(estimate, choice_jitter, jitter)
        log_evidence = log_evidence.to(self.dtype)
        return new_state, StepOutput(estimate, log_weights, log_evidence, total, *work)

    def _candidate_weights(
        self, state: MKFState, mean: Tensor, cov: Tensor, frame: Measurements
    ) -> tuple[Tensor, Tensor | None]:
        """Return log w_i pi_j N(z | track i continued by j) [B, M, K], and the jitter of its S."""
        matrix, offset, noise = self.transition(state.time)
        rows = matrix[:, self.observed]
        expected = torch.einsum("kzd,bmd->bmkz", rows, mean) + offset[:, self.observed]
        block = torch.einsum("kzd,bmde->bmkze", rows, cov) @ rows.mT
        block = symmetrise(block + noise[:, self.observed][..., self.observed])
        noise_cov = frame.cov if frame.cov.ndim == 2 else frame.cov[:, None, None]
        everything = torch.arange(self.observed.numel(), device=mean.device)
        mask = frame.mask[:, None, None].expand(expected.shape)
        gain, _ = kalman_gain(block, noise_cov, everything, mask)
        z = frame.z[:, None, None].to(expected.dtype)
        _, log_likelihood = kalman_correct(expected, z, gain, everything, mask)
        log_weights = state.log_weights.to(expected.dtype)
        return log_weights[..., None] + self.log_prior + log_likelihood, gain.jitter

    def _continue(
        self,
        time: int,
        mean: Tensor,
        cov: Tensor,
        parent: Tensor,
        component: Tensor,
        frame: Measurements,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return the kept tracks after a full Kalman step, and the jitter of its covariances."""
        rows = torch.arange(mean.shape[0], device=mean.device)[:, None]
        matrix, offset, noise = (part[component] for part in self.transition(time))
        mean = (matrix @ mean[rows, parent][..., None])[..., 0] + offset
        cov = symmetrise(matrix @ cov[rows, parent] @ matrix.mT + noise)
        noise_cov = frame.cov if frame.cov.ndim == 2 else frame.cov[:, None]
        mask = frame.mask[:, None].expand(*mean.shape[:2], -1)
        gain, cov = kalman_gain(cov, noise_cov, self.observed, mask)
        z = frame.z[:, None].to(mean.dtype)
        mean, _ = kalman_correct(mean, z, gain, self.observed, mask)
        return mean, cov, gain.jitter
