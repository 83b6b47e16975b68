"""Run the mixture Kalman filter with split tracks (Smith & Winter, as cited in paper section 3.4)."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from tqdm.auto import tqdm

from torchpose._core.value_checks import values_visible
from torchpose.filters._joint_tracks import (
    JointModel,
    JointProblem,
    JointTracks,
    joined,
    joint_chunks,
    joint_estimate,
    joint_model,
    joint_problems,
    stacked,
)
from torchpose.filters._measurements import Measurements
from torchpose.filters._mkf import MixtureKalmanFilter, MKFState
from torchpose.filters._outputs import FilterOutput, StepOutput, first_step, mending
from torchpose.filters._recompute import wants_gradient
from torchpose.filters._recursive_filter import Generators, require_state
from torchpose.filters._split_candidates import (
    CandidateProblem,
    CandidateRoom,
    SharedCandidates,
    block_numbers,
    candidate_problems,
    candidates,
)
from torchpose.filters._weights import estimate_of
from torchpose.math._gaussian import kalman_correct, kalman_gain, symmetrise
from torchpose.priors._gaussian_mixture import GaussianMixture

_MOST_SHARED = 1 << 22  # numbers, 32 MB, of the product that all frames share
_RANKS = 1e9  # per nat: log-weights of one rank are equal


class _SplitFrame(NamedTuple):
    """Holds what one frame measures of some sequences, and how tracks and candidates move into it."""

    time: int
    measured: Measurements
    problem: JointProblem
    own: CandidateProblem
    move: JointModel
    shared: SharedCandidates


class SplitTrackFilter(MixtureKalmanFilter, tracks="split"):
    """Filters by a mixture Kalman filter that splits every track by every component; the M likeliest stay.

    A candidate is track i continued by component j, of weight w_i pi_j N(z_t | i, j). In the first
    frame there is one track for each component. Without pruning (M = K^(T+1)) this is the exact
    posterior. Where nothing is measured, candidates that differ in the order of their components alone have
    equal weights, of which the first ones stay.

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
        """Check that a state is one of this filter's, for a batch of this size."""
        # Any number of tracks: before the first frame there is one for each component.
        require_state(state, MKFState, "mean", (batch, None, self.dim))

    def filter_frame(
        self, state: MKFState, frame: Measurements, generator: Generators, return_cov: bool
    ) -> tuple[MKFState, StepOutput]:
        """Filter one frame: continue each of the M tracks by each of the K components, keep the M likeliest.

        Only the measured block of the M K predicted covariances is formed before the selection.
        """
        if self._in_place(frame):
            return self._filter_in_place(state, frame, return_cov)
        wide = torch.float64
        track_cov = state.cov[state.group]
        mean = state.mean.to(wide)
        log_joint, choice_jitter = self._candidate_weights(state, mean, track_cov, frame)
        log_weights, log_evidence, parent, component = self._select(log_joint)
        log_evidence = torch.where(frame.mask.any(-1), log_evidence, torch.zeros_like(log_evidence))
        mean, cov, jitter = self._continue(state.time, mean, track_cov, parent, component, frame)
        mean = mean.to(self.dtype)
        estimate, total = estimate_of(log_weights, mean, cov if return_cov else None)
        group = torch.arange(mean.shape[0], device=mean.device)
        new_state = MKFState(log_weights, mean, cov, group, state.time + 1)
        work = mending(estimate, choice_jitter, jitter)
        log_evidence = log_evidence.to(self.dtype)
        return new_state, StepOutput(estimate, log_weights, log_evidence, total, *work)

    def filter_frames(
        self, frames: Measurements, generator: Generators, return_cov: bool, progress: bool
    ) -> FilterOutput:
        """Filter whole sequences, given checked measurements, some sequences at a time."""
        if not self._in_place(frames):
            return super().filter_frames(frames, generator, return_cov, progress)
        batch, n_frames = frames.z.shape[:2]
        parts = []
        with tqdm(total=batch * n_frames, disable=not progress, unit="frame") as bar:
            for chunk in joint_chunks(self, batch, block_numbers(self)[0]):
                parts.append(self._filter_chunk(frames.some(chunk), return_cov))
                bar.update(len(parts[-1].mean) * n_frames)
        return joined(parts, frames.lengths)

    def _in_place(self, frames: Measurements) -> bool:
        """Return whether tracks may be stepped in place: no gradient, and a product that fits into memory."""
        learning = wants_gradient(frames.z, frames.cov, *self.sources)
        return values_visible() and not learning and block_numbers(self)[1] <= _MOST_SHARED

    def _filter_chunk(self, frames: Measurements, return_cov: bool) -> FilterOutput:
        """Filter some sequences as `filter_frame` does."""
        state, steps = self.init(len(frames.z)), []
        tracks, log_weights = (
            JointTracks(self, state.mean, state.cov[state.group]),
            state.log_weights,
        )
        room = CandidateRoom()
        for frame in self._frames(frames, 0):
            log_weights, step = self._step(tracks, room, log_weights, frame, return_cov)
            steps.append(step)
        return stacked(tracks, steps, frames)

    def _filter_in_place(
        self, state: MKFState, frame: Measurements, return_cov: bool
    ) -> tuple[MKFState, StepOutput]:
        """Filter one frame by the same operations as whole sequences, so that equal weights fall alike."""
        tracks = JointTracks(self, state.mean, state.cov[state.group])
        frames = frame.as_sequences()
        (own,) = self._frames(frames, state.time)
        log_weights, step = self._step(tracks, CandidateRoom(), state.log_weights, own, return_cov)
        group = torch.arange(len(log_weights), device=log_weights.device)
        mean, cov = tracks.mean.to(self.dtype), symmetrise(tracks.cov)
        new_state = MKFState(log_weights, mean, cov, group, state.time + 1)
        return new_state, first_step(stacked(tracks, [step], frames))

    def _frames(self, frames: Measurements, first: int) -> list[_SplitFrame]:
        """Return the frames of some sequences, of which the first one has number `first`."""
        problems = joint_problems(frames)
        times = range(first, first + len(problems))
        steady = max(self.burn_in, first)
        kept = joint_model(self, steady), candidates(self, steady)
        models = [
            kept if time >= steady else (joint_model(self, time), candidates(self, time))
            for time in times
        ]
        measured = [frames.frame(t) for t in range(len(times))]
        rows = zip(times, measured, problems, candidate_problems(problems), models, strict=True)
        return [_SplitFrame(time, z, problem, own, *model) for time, z, problem, own, model in rows]

    def _step(
        self,
        tracks: JointTracks,
        room: CandidateRoom,
        log_weights: Tensor,
        frame: _SplitFrame,
        return_cov: bool,
    ) -> tuple[Tensor, StepOutput]:
        """Step the tracks in place, and return their log-weights and the estimate."""
        log_likelihood = room.log_likelihood(frame.shared, tracks, frame.own)
        jitter = None
        if log_likelihood is not None:
            log_joint = (log_weights[..., None] + self.log_prior) + log_likelihood.permute(1, 2, 0)
        else:  # a block is to be mended, or lost
            group = torch.arange(len(log_weights), device=log_weights.device)
            state = MKFState(log_weights, tracks.mean, tracks.cov, group, frame.time)
            log_joint, jitter = self._candidate_weights(
                state, state.mean, state.cov, frame.measured
            )
        log_weights, log_evidence, parent, component = self._select(log_joint)
        tracks.take(parent)
        tracks.predict(frame.move, component)
        jitters = [jitter, tracks.correct(frame.problem)]
        log_evidence = log_evidence.to(self.dtype)
        return log_weights, joint_estimate(tracks, log_weights, log_evidence, jitters, return_cov)

    def _select(self, log_joint: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return log-weights of the M likeliest candidates, log-evidence, and their tracks and components.

        Without measurements, i continued by j is as likely as j continued by i. Of such the first ones
        are taken, not those that rounding prefers.
        """
        flat = log_joint.flatten(1)
        shares = flat.log_softmax(1)
        # The first frames may have fewer candidates than tracks: the rest stays empty, at weight zero.
        spare = max(0, self.n_tracks - flat.shape[1])
        padded = torch.nn.functional.pad(shares, (0, spare), value=-torch.inf) if spare else shares
        largest, chosen = _first_of_largest(padded, self.n_tracks)
        log_evidence = (flat.gather(1, chosen[:, :1]) - largest[:, :1])[:, 0]
        log_weights = largest.log_softmax(-1).to(self.dtype)
        if spare:
            chosen = torch.where(chosen < flat.shape[1], chosen, torch.zeros_like(chosen))
        n_components = self.means.shape[0]
        parent = chosen.div(n_components, rounding_mode="floor")
        return log_weights, log_evidence, parent, chosen.sub(parent, alpha=n_components)

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


def _first_of_largest(
    log_weights: Float[Tensor, "B N"], count: int
) -> tuple[Float[Tensor, "B n"], Int[Tensor, "B n"]]:
    """Return the largest log-weights in falling order and their places, of equal ones the first places."""
    if values_visible():
        largest, places = log_weights.topk(min(count + 1, log_weights.shape[1]), 1)
        gaps = largest[:, :-1] - largest[:, 1:]
        if gaps.numel() == 0 or gaps.amin().item() > 2 / _RANKS:  # ranks differ, none is NaN
            return largest[:, :count], places[:, :count]
    ranks = (log_weights * _RANKS).round()
    places = ranks.sort(dim=1, descending=True, stable=True).indices[:, :count]
    return log_weights.gather(1, places), places
