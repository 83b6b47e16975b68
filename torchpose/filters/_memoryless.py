"""Condition the mixture on each frame alone, for models in which frames are independent.

With weights by frame, the indicator of every frame is drawn from pi independently, as for sampled
tracks (BL 47); the track of each component still carries its state from frame to frame. Where the
states carry nothing over either (transition "ou" with gamma = 0), frames are independent, and
`run_memoryless` conditions the mixture on all of them at once. Several such filters that measure the
same dimensions run side by side (`SideBySide`), with a leading axis of A filters in all that they hold.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from tqdm.auto import tqdm

from torchpose._core.module_state import derived, outside_inference
from torchpose._core.value_checks import values_visible
from torchpose.filters._frame_noise import (
    MeasuredParts,
    OwnFrames,
    Tracks,
    condition_own,
    log_normaliser,
    measured_parts,
    own_moments,
    variances_of,
)
from torchpose.filters._measurements import Measurements
from torchpose.filters._mkf import MixtureKalmanFilter, MKFState
from torchpose.filters._outputs import (
    FilterOutput,
    Mending,
    StepOutput,
    finish_output,
    first_step,
    mending,
)
from torchpose.filters._recompute import recomputed, wants_gradient
from torchpose.filters._side_by_side import SideBySide, stacked
from torchpose.filters._weights import WeightRule, between, frame_weights, mixed, normalise
from torchpose.math._gaussian import Gain, kalman_gain, point_blocks
from torchpose.math._geometric_median import median_columns, with_medians

_SHARED_FRAMES = 1024  # at a time, where they share their gains
_PATTERNS = 24  # of measured dimensions and noise whose gains are kept; about 4 MB each
_OWN_FRAMES = 8  # at a time, where each has gains of its own
_RECOMPUTED_FRAMES = 64  # at a time, where gradients compute them again
_LEAST_SHARE = 2  # frames to a noise, on average, below which sharing does not pay


def frame_log_likelihood(
    model: MixtureKalmanFilter, rule: WeightRule, frames: Measurements
) -> Float[Tensor, "B T M"] | None:
    """Return log N(z_t; H mu_j, H Sigma_j H^T + R) of the measured dimensions of every frame.

    None for weights that are not by frame.
    """
    if not rule.by_frame:
        return None
    groups = _groups(model, frames, _SHARED_FRAMES)
    found = [(group.rows, _log_likelihood(model, group)) for group in groups]
    return _in_order(found).unflatten(0, frames.z.shape[:2])


class Wanted(NamedTuple):
    """Results that are wanted of frames.

    Attributes:
        columns: the state dimensions that are estimated, in this order; None is all.
        n_context: the number of the first measurements whose evidence is wanted by itself.
        of_points: whether of the covariances those of each three consecutive dimensions are wanted alone,
            [..., D / 3, 3, 3].
    """

    columns: tuple[int, ...] | None = None
    n_context: int = 0
    of_points: bool = False


_ALL = Wanted()


def conditioned_groups(
    model: MixtureKalmanFilter, rule: WeightRule, frames: Measurements
) -> Iterator[tuple["_Group", Tensor, Tensor, Tensor]]:
    """Yield groups of frames with the posterior of every component given each frame.

    Yields:
        A group, whose `rows` are the places of its N frames among all; means [N, M, D], the covariances that
        the frames share [M, D, D], and log-weights [N, M].
    """
    z, mask = frames.z.flatten(0, 1), frames.mask.flatten(0, 1)
    noise = None if frames.cov.ndim == 2 else frames.cov.flatten(0, 1)
    for same in _rows_by_setting(mask, noise):
        own_noise = frames.cov if noise is None else noise[same[0]]
        for rows in same.split(_RECOMPUTED_FRAMES):
            group = _Group(rows, z[rows], mask[same[:1]], own_noise)
            shared = _gain(model, group, _ALL)
            given = _condition(model, measured_parts(model), group, shared)
            yield group, given.means, shared.covs, _weighed(rule, group, given.log_likelihood)[0]


def run_memoryless(
    model: MixtureKalmanFilter,
    rule: WeightRule,
    medians: Tensor,
    frames: Measurements,
    return_cov: bool,
    progress: bool = False,
) -> FilterOutput:
    """Filter sequences where the predictions are the components themselves (BL 39-41, 48).

    Args:
        model: whose components these are. rule: of the weights, by frame. medians: first dimensions of
            the points that are estimated by their geometric medians. frames: all that is measured.
        return_cov: whether to return covariances. progress: whether to show a progress bar.
    """
    columns = median_columns(medians)
    return run_with_context(model, rule, columns, frames, return_cov, _ALL, progress)[0]


def run_with_context(
    model: Tracks,
    rule: WeightRule,
    medians: Int[Tensor, "P 3"],
    frames: Measurements,
    return_cov: bool,
    wanted: Wanted,
    progress: bool = False,
) -> tuple[FilterOutput, Float[Tensor, "B T"] | None]:
    """Return what `run_memoryless` does, of the wanted dimensions, and the evidence of a context.

    The context are the first measurements. With S = L L^T their likelihood is that of the first innovations
    over their standard deviations, so that it takes no filter of its own.

    Args:
        model, rule, frames, return_cov, progress: as `run_memoryless`. Of filters side by side frames are
            [A, B, T, Z], R is [A, Z, Z] or [A, B, T, Z, Z], and results are those of A B sequences.
        medians: the three dimensions of each point that is estimated by its median, among the wanted ones.
        wanted: the dimensions and the context.
    """
    n_frames = frames.z.shape[-2]
    learning = wants_gradient(frames.z, frames.cov, model.log_prior, model.means, model.covariances)
    parts: list[list[tuple[Tensor, Tensor]]] = [[] for _ in range(7)]
    shared = measured_parts(model, wanted.columns, wanted.of_points)
    at_a_time = _RECOMPUTED_FRAMES if learning else _SHARED_FRAMES
    # a bar that shows nothing would still keep torch.compile out
    bar = tqdm(total=frames.z.shape[-3] * n_frames, unit="frame") if progress else None
    for group in _groups(model, frames, at_a_time, wanted):
        # Gains and parts that groups share are not among what a gradient computes anew for one of them.
        gain = _gain(model, group, wanted) if group.shares_gain else None
        arguments = model, rule, medians, group, gain, shared, return_cov, wanted
        values = recomputed(_estimate, *arguments) if learning else _estimate(*arguments)
        for part, value in zip(parts, values, strict=True):
            if value is not None:
                part.append((group.rows, value))
        if bar is not None:
            bar.update(len(group.rows))
    if bar is not None:
        bar.close()
    mean, log_weights, evidence, mended, jitter = (
        _in_order(parts[i]).unflatten(0, (-1, n_frames)) for i in (0, 1, 2, 4, 5)
    )
    covs = _in_order(parts[3]).unflatten(0, (-1, n_frames)) if return_cov else None
    context = _in_order(parts[6]).unflatten(0, (-1, n_frames)) if wanted.n_context else None
    lengths, n_filters = frames.lengths.flatten(), frames.z.shape[:-3].numel()
    given = lengths, Mending(mended, jitter), n_filters
    return finish_output(mean, log_weights, evidence, covs, *given), context


def _estimate(
    model: Tracks,
    rule: WeightRule,
    medians: Tensor,
    group: "_Group",
    gain: "_SharedGain | None",
    shared: MeasuredParts,
    return_cov: bool,
    wanted: Wanted = _ALL,
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor, Tensor, Tensor | None]:
    """Return the estimates of a group of frames, those of filters side by side one after the other.

    They are means, log-weights, log-evidence, covariances, both parts of the mending, and the log-evidence
    of the context.
    """
    given: OwnFrames | _Conditioned
    n_context, of_points = wanted.n_context, wanted.of_points
    if gain is None:
        given = own = condition_own(model, shared, group.z, group.mask, group.noise, n_context)
    else:
        given = tracks = _condition(model, shared, group, gain, n_context)
    log_weights, evidence = _weighed(rule, group, given.log_likelihood)
    if gain is None:
        mean, total = own_moments(model, shared, own, log_weights, medians, return_cov, of_points)
    else:
        each = log_weights, tracks.means, gain.covs
        mean, total = _moments(*each, medians, return_cov, of_points)
    context = None
    if given.log_context is not None:
        there = group.mask[..., :n_context].any(-1)
        both = torch.logsumexp(normalise(rule.log_prior) + given.log_context, -1)
        context = torch.where(there, both, 0.0).flatten()
    mean, log_weights = mean.flatten(0, -2), log_weights.flatten(0, -2)
    total = None if total is None else total.flatten(0, evidence.ndim - 1)
    work = mending(mean, given.jitter)
    return mean, log_weights, evidence.flatten(), total, *work, context


def _moments(
    log_weights: Float[Tensor, "*A N M"],
    means: Float[Tensor, "*A N M D"],
    covs: Tensor,
    medians: Int[Tensor, "P 3"],
    return_cov: bool,
    of_points: bool,
) -> tuple[Float[Tensor, "*A N D"], Tensor | None]:
    """Return the estimates of mixtures (BL 48) and, on request, their second moments about these."""
    weights = log_weights.exp()
    mean = (weights[..., None, :] @ means)[..., 0, :]
    if len(medians):
        variances = variances_of(covs, of_points)[..., None, :, medians]
        mean = with_medians(mean, weights, means[..., medians], variances, medians)
    if not return_cov:
        return mean, None
    apart = between(weights, means, mean)
    return mean, mixed(weights, covs) + (point_blocks(apart) if of_points else apart)


def _weighed(
    rule: WeightRule, group: "_Group", log_likelihood: Float[Tensor, "*A N M"]
) -> tuple[Float[Tensor, "*A N M"], Float[Tensor, "*A N"]]:
    """Return log-weights and log-evidence of a group of frames; 0 where nothing is measured."""
    log_weights, evidence = frame_weights(rule, log_likelihood, log_likelihood)
    return log_weights, torch.where(group.mask.any(-1), evidence, 0.0)


def step_memoryless(
    model: MixtureKalmanFilter,
    rule: WeightRule,
    medians: Tensor,
    state: MKFState,
    frame: Measurements,
    return_cov: bool,
) -> tuple[MKFState, StepOutput]:
    """Filter one frame as `run_memoryless` does; the state only counts it."""
    later = state._replace(time=state.time + 1)
    frames = frame.as_sequences()
    if not values_visible():
        (group,) = _groups(model, frames, len(frame.z))
        shared = measured_parts(model)
        columns = median_columns(medians)
        found = _estimate(model, rule, columns, group, None, shared, return_cov)
        return later, StepOutput(*found[:-1])
    return later, first_step(run_memoryless(model, rule, medians, frames, return_cov))


class _Group(NamedTuple):
    """Holds the frames whose gains are computed together.

    Attributes:
        rows: which of the B T frames [N]. z: [*A, N, Z].
        mask, noise: [*A, 1, Z] and [*A, Z, Z] for all of them, or [*A, N, Z] and [*A, N, Z, Z].
    """

    rows: Tensor
    z: Tensor
    mask: Tensor
    noise: Tensor

    @property
    def shares_gain(self) -> bool:
        """Return whether all frames have one gain."""
        return self.noise.ndim == self.z.ndim


def _groups(
    model: Tracks, frames: Measurements, at_a_time: int, wanted: Wanted = _ALL
) -> Iterator[_Group]:
    """Yield frames that measure the same dimensions with the same noise, which share their gains."""
    z, mask = frames.z.flatten(-3, -2), frames.mask.flatten(-3, -2)
    noise = None if frames.cov.ndim < frames.z.ndim else frames.cov.flatten(-4, -3)
    if not values_visible():
        each = frames.cov.expand(len(z), -1, -1) if noise is None else noise
        yield _Group(torch.arange(len(z), device=z.device), z, mask, each)
        return
    alike = _rows_by_setting(mask, noise)
    if noise is not None and not _sharing_pays(model, noise, mask, len(alike), wanted):
        yield from _groups_of_own(z, mask, noise)
        return
    for same in alike:
        first = 0 if len(alike) == 1 else int(same[0])
        own_noise = frames.cov if noise is None else noise[..., first, :, :]
        own_mask = mask[..., first : first + 1, :]
        for rows in same.split(at_a_time):
            own = z if len(rows) == z.shape[-2] and len(alike) == 1 else z.index_select(-2, rows)
            yield _Group(rows, own, own_mask, own_noise)


def _rows_by_setting(
    mask: Bool[Tensor, "*A N Z"], noise: Float[Tensor, "*A N Z Z"] | None
) -> Sequence[Tensor]:
    """Return the rows of frames that measure the same dimensions with the same noise, set by set."""
    n_rows = mask.shape[-2]
    if n_rows == 1:
        return [torch.arange(1, device=mask.device)]
    settings = mask.movedim(-2, 0).flatten(1)
    if noise is not None:
        settings = torch.cat([settings.to(noise), noise.movedim(-3, 0).flatten(1)], 1)
    if bool((settings == settings[:1]).all()):
        return [torch.arange(n_rows, device=mask.device)]
    _, group = torch.unique(settings, dim=0, return_inverse=True)
    return group.argsort(stable=True).split(torch.bincount(group).tolist())


def _sharing_pays(
    model: Tracks,
    noise: Float[Tensor, "*A N Z Z"],
    mask: Bool[Tensor, "*A N Z"],
    n_different: int,
    wanted: Wanted,
) -> bool:
    """Return whether frames with noise of their own gain by making the gains that some of them share."""
    if noise.requires_grad:
        return False
    if mask.shape[-2] == 1:
        return _kept_gains(model, wanted).is_asked_again(noise, mask)
    return n_different <= mask.shape[-2] / _LEAST_SHARE


def _groups_of_own(z: Tensor, mask: Tensor, noise: Tensor) -> Iterator[_Group]:
    """Yield frames that have gains of their own, some at a time."""
    for rows in torch.arange(z.shape[-2], device=z.device).split(_OWN_FRAMES):
        own = z[..., rows, :], mask[..., rows, :], noise[..., rows, :, :]
        yield _Group(rows, *own)


def _log_likelihood(model: MixtureKalmanFilter, group: _Group) -> Float[Tensor, "N M"]:
    shared = measured_parts(model)
    if group.shares_gain:
        gain = _gain(model, group, _ALL).gain
        return _log_density(gain.log_norm, _whitened(shared, group, gain).square())
    return condition_own(model, shared, group.z, group.mask, group.noise).log_likelihood


class _Conditioned(NamedTuple):
    """Holds the components given N frames that share their gains.

    Attributes:
        means: [*A, N, M, D]. log_likelihood: [*A, N, M]. jitter: [*A, N, M], or None.
        log_context: the log-likelihood of the first measurements alone, [*A, N, M], or None.
    """

    means: Tensor
    log_likelihood: Tensor
    jitter: Tensor | None
    log_context: Tensor | None


def _condition(
    model: Tracks,
    shared: MeasuredParts,
    group: _Group,
    made: "_SharedGain",
    n_context: int = 0,
) -> _Conditioned:
    """Return every component given each frame."""
    gain = made.gain
    white = _whitened(shared, group, gain)
    squares = white.square()
    centres = shared.means.to(model.dtype)
    moves = (part.flatten(0, -3) for part in (white.mT, gain.white))
    means = torch.baddbmm(centres.flatten(0, -2)[:, None], *moves)
    # frame by frame in memory, for the sums over components that follow
    means = means.view(*white.shape[:-2], *means.shape[1:]).transpose(-3, -2).contiguous()
    jitter = None
    if gain.jitter is not None:
        jitter = gain.jitter[..., None, :].expand(means.shape[:-1])
    context = _log_density(made.context_norm, squares[..., :n_context, :]) if n_context else None
    return _Conditioned(means, _log_density(gain.log_norm, squares), jitter, context)


def _whitened(shared: MeasuredParts, group: _Group, gain: Gain) -> Float[Tensor, "*A M Z N"]:
    """Return the innovations over their standard deviations."""
    centre = shared.centre.to(group.z)
    residual = (group.z[..., None, :] - centre[..., None, :, :]) * group.mask[..., None, :]
    return torch.linalg.solve_triangular(gain.factor, residual.movedim(-3, -1), upper=False)


def _log_density(
    log_norm: Float[Tensor, "*A M"], squares: Float[Tensor, "*A M Z N"]
) -> Float[Tensor, "*A N M"]:
    """Return the log-density of innovations, of which the squares of whitened ones are given."""
    return log_norm[..., None].sub(squares.sum(-2), alpha=0.5).mT


class _SharedGain(NamedTuple):
    """Holds what frames with the same noise and the same gaps share.

    Attributes:
        gain: of every component. covs: the covariances after the update, [*A, M, D, D], or
            [*A, M, P, 3, 3] of points.
        context_norm: the log of the normaliser of the first measurements' density, [*A, M].
    """

    gain: Gain
    covs: Tensor
    context_norm: Tensor


def _gain(model: Tracks, group: _Group, wanted: Wanted) -> _SharedGain:
    """Return gain and covariance of every component for frames that share them, kept for later."""
    kept = _kept_gains(model, wanted)
    found = kept.get(group.noise, group.mask)
    if found is None:
        with outside_inference():
            found = _make_gain(model, group, wanted)
        kept.put(group.noise, group.mask, found)
    return found


def _kept_gains(model: Tracks, wanted: Wanted) -> "_FrameGains":
    sources = (model.means, model.covariances)
    return derived(model, ("frame gains", model.dtype, wanted), sources, _FrameGains)


def _make_gain(model: Tracks, group: _Group, wanted: Wanted) -> _SharedGain:
    if isinstance(model, SideBySide):  # one of them may have had its part before
        groups = (_Group(group.rows, *parts) for parts in zip(*group[1:], strict=True))
        pairs = zip(model.filters, groups, strict=True)
        return _gains_of_all([_gain(own, part, wanted) for own, part in pairs])
    gain, covs = kalman_gain(
        model.covariances, group.noise, model.observed, group.mask, wanted.columns
    )
    covs = point_blocks(covs).contiguous() if wanted.of_points else covs
    norm = log_normaliser(gain.factor, group.mask, wanted.n_context).to(model.dtype)
    return _SharedGain(gain.to(model.dtype), covs, norm)


def _gains_of_all(made: Sequence[_SharedGain]) -> _SharedGain:
    """Return the gains of filters side by side."""
    gains, covs, norms = zip(*made, strict=True)
    jitters = [gain.jitter for gain in gains]
    jitter = None
    if any(found is not None for found in jitters):
        none = torch.zeros_like(gains[0].log_norm)
        jitter = stacked([none if found is None else found for found in jitters])
    factor, white, log_norm = map(stacked, zip(*(gain[:3] for gain in gains), strict=True))
    return _SharedGain(Gain(factor, white, log_norm, jitter), stacked(covs), stacked(norms))


class _FrameGains:
    """Holds the gains of the latest patterns of measured dimensions and noise, for one mixture."""

    def __init__(self) -> None:
        self._found: dict[tuple[Any, ...], _SharedGain] = {}
        self._asked: dict[tuple[Any, ...], None] = {}

    def is_asked_again(self, noise: Tensor, mask: Tensor) -> bool:
        """Return whether this pattern and noise came before: gains that are used once do not pay."""
        key = _key(noise, mask)
        if key in self._found or key in self._asked:
            return True
        if len(self._asked) >= _PATTERNS:
            self._asked.pop(next(iter(self._asked)))
        self._asked[key] = None
        return False

    def get(self, noise: Tensor, mask: Tensor) -> _SharedGain | None:
        """Return the stored gains for this pattern and noise, or None."""
        if torch.is_grad_enabled() and noise.requires_grad:
            return None
        key = _key(noise, mask)
        found = self._found.pop(key, None)
        if found is not None:
            self._found[key] = found  # the latest one used is the last to go
        return found

    def put(self, noise: Tensor, mask: Tensor, value: _SharedGain) -> None:
        """Keep a gain, unless the noise wants gradients; the pattern unused longest makes room."""
        if torch.is_grad_enabled() and noise.requires_grad:
            return
        if len(self._found) >= _PATTERNS:
            self._found.pop(next(iter(self._found)))
        self._found[_key(noise, mask)] = value


def _key(noise: Tensor, mask: Tensor) -> tuple[Any, ...]:
    return (*mask.flatten().tolist(), *noise.detach().flatten().tolist())


def _in_order(parts: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Return the values of all frames in the order of the frames, filter by filter."""
    if len(parts) == 1:  # of all frames, in their order
        return parts[0][1]
    rows = torch.cat([rows for rows, _ in parts])
    values = torch.cat([values.unflatten(0, (-1, len(rows))) for rows, values in parts], 1)
    return values.index_select(1, rows.argsort()).flatten(0, 1)
