"""Condition the mixture on each frame alone, for models in which frames are independent.

With weights by frame, the indicator of every frame is drawn from pi independently, as for sampled
tracks (BL 47); the track of each component still carries its state from frame to frame. Where the
states carry nothing over either (transition "ou" with gamma = 0), frames are independent, and
`run_memoryless` conditions the mixture on all of them at once.
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
    condition_own,
    log_normaliser,
    measured_parts,
    own_moments,
)
from torchpose.filters._measurements import Measurements
from torchpose.filters._mkf import MixtureKalmanFilter, MKFState
from torchpose.filters._outputs import FilterOutput, Mending, StepOutput, finish_output, mending
from torchpose.filters._recompute import recomputed, wants_gradient
from torchpose.filters._weights import WeightRule, frame_weights, normalise, within_and_between
from torchpose.math._gaussian import Gain, kalman_gain
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
    """

    columns: tuple[int, ...] | None = None
    n_context: int = 0


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
    for same in _alike(mask, noise):
        own_noise = frames.cov if noise is None else noise[same[0]]
        for rows in same.split(_RECOMPUTED_FRAMES):
            group = _Group(rows, z[rows], mask[same[0]], own_noise)
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
    model: MixtureKalmanFilter,
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
        model, rule, frames, return_cov, progress: as `run_memoryless`.
        medians: the three dimensions of each point that is estimated by its median, among the wanted ones.
        wanted: the dimensions and the context.
    """
    batch, n_frames, _ = frames.z.shape
    learning = wants_gradient(frames.z, frames.cov, model.log_prior, model.means, model.covariances)
    parts: list[list[tuple[Tensor, Tensor]]] = [[] for _ in range(7)]
    shared = measured_parts(model, wanted.columns)
    at_a_time = _RECOMPUTED_FRAMES if learning else _SHARED_FRAMES
    # a bar that shows nothing would still keep torch.compile out
    bar = tqdm(total=batch * n_frames, unit="frame") if progress else None
    for group in _groups(model, frames, at_a_time, wanted):
        # Gains and parts that groups share are not among what a gradient computes anew for one of them.
        gain = _gain(model, group, wanted) if group.shares_gain else None
        arguments = model, rule, medians, group, gain, shared, return_cov, wanted.n_context
        values = recomputed(_estimate, *arguments) if learning else _estimate(*arguments)
        for part, value in zip(parts, values, strict=True):
            if value is not None:
                part.append((group.rows, value))
        if bar is not None:
            bar.update(len(group.rows))
    if bar is not None:
        bar.close()
    mean, log_weights, evidence = (
        _in_order(part).unflatten(0, (batch, n_frames)) for part in parts[:3]
    )
    covs = _in_order(parts[3]).unflatten(0, (batch, n_frames)) if return_cov else None
    work = Mending(*(_in_order(part).unflatten(0, (batch, n_frames)) for part in parts[4:6]))
    context = _in_order(parts[6]).unflatten(0, (batch, n_frames)) if wanted.n_context else None
    return finish_output(mean, log_weights, evidence, covs, frames.lengths, work), context


def _estimate(
    model: MixtureKalmanFilter,
    rule: WeightRule,
    medians: Tensor,
    group: "_Group",
    gain: "_SharedGain | None",
    shared: MeasuredParts,
    return_cov: bool,
    n_context: int = 0,
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor, Tensor, Tensor | None]:
    """Return the estimates of a group of frames.

    They are means, log-weights, log-evidence, covariances, both parts of the mending, and the log-evidence
    of the context.
    """
    given: OwnFrames | _Conditioned
    if gain is None:
        given = own = condition_own(model, shared, group.z, group.mask, group.noise, n_context)
    else:
        given = tracks = _condition(model, shared, group, gain, n_context)
    log_weights, evidence = _weighed(rule, group, given.log_likelihood)
    if gain is None:
        mean, total = own_moments(model, shared, own, log_weights, medians, return_cov)
    else:
        mean, total = _moments(log_weights, tracks.means, gain.covs, medians, return_cov)
    context = None
    if given.log_context is not None:
        there = group.mask[..., :n_context].any(-1)
        both = torch.logsumexp(normalise(rule.log_prior) + given.log_context, -1)
        context = torch.where(there, both, 0.0)
    return mean, log_weights, evidence, total, *mending(mean, given.jitter), context


def _moments(
    log_weights: Float[Tensor, "N M"],
    means: Float[Tensor, "N M D"],
    covs: Float[Tensor, "M D D"],
    medians: Int[Tensor, "P 3"],
    return_cov: bool,
) -> tuple[Float[Tensor, "N D"], Float[Tensor, "N D D"] | None]:
    """Return the estimates of mixtures (BL 48) and, on request, their second moments about these."""
    weights = log_weights.exp()
    mean = (weights[:, None] @ means)[:, 0]
    if len(medians):
        variances = covs.diagonal(dim1=-2, dim2=-1)[..., medians]
        mean = with_medians(mean, weights, means[..., medians], variances, medians)
    return mean, within_and_between(weights, means, mean, covs) if return_cov else None


def _weighed(
    rule: WeightRule, group: "_Group", log_likelihood: Float[Tensor, "N M"]
) -> tuple[Float[Tensor, "N M"], Float[Tensor, " N"]]:
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
    out = run_memoryless(model, rule, medians, frames, return_cov)
    values = out.mean, out.log_weights, out.log_evidence, out.cov, out.mended, out.jitter
    first = (None if value is None else value[:, 0] for value in values)
    return later, StepOutput(*first)  # type: ignore[arg-type]


class _Group(NamedTuple):
    """Holds the frames whose gains are computed together.

    Attributes:
        rows: which of the B T frames [N]. z: [N, Z].
        mask, noise: [Z] and [Z, Z] for all of them, or [N, Z] and [N, Z, Z].
    """

    rows: Tensor
    z: Tensor
    mask: Tensor
    noise: Tensor

    @property
    def shares_gain(self) -> bool:
        """Return whether all frames have one gain."""
        return self.mask.ndim == 1


def _groups(
    model: MixtureKalmanFilter, frames: Measurements, at_a_time: int, wanted: Wanted = _ALL
) -> Iterator[_Group]:
    """Yield frames that measure the same dimensions with the same noise, which share their gains."""
    z, mask = frames.z.flatten(0, 1), frames.mask.flatten(0, 1)
    noise = None if frames.cov.ndim == 2 else frames.cov.flatten(0, 1)
    if not values_visible():
        each = frames.cov.expand(len(z), -1, -1) if noise is None else noise
        yield _Group(torch.arange(len(z), device=z.device), z, mask, each)
        return
    alike = _alike(mask, noise)
    if noise is not None and not _pays(model, noise, mask, len(alike), wanted):
        yield from _groups_of_own(z, mask, noise)
        return
    for same in alike:
        first = 0 if len(alike) == 1 else int(same[0])
        own_noise = frames.cov if noise is None else noise[first]
        for rows in same.split(at_a_time):
            yield _Group(rows, z[rows], mask[first], own_noise)


def _alike(mask: Bool[Tensor, "N Z"], noise: Float[Tensor, "N Z Z"] | None) -> Sequence[Tensor]:
    """Return the rows of frames that measure the same dimensions with the same noise, set by set."""
    settings = mask if noise is None else torch.cat([mask.to(noise), noise.flatten(1)], 1)
    if len(mask) == 1 or bool((settings == settings[:1]).all()):
        return [torch.arange(len(mask), device=mask.device)]
    _, group = torch.unique(settings, dim=0, return_inverse=True)
    return group.argsort(stable=True).split(torch.bincount(group).tolist())


def _pays(
    model: MixtureKalmanFilter,
    noise: Float[Tensor, "N Z Z"],
    mask: Bool[Tensor, "N Z"],
    n_different: int,
    wanted: Wanted,
) -> bool:
    """Return whether frames with noise of their own gain by making the gains that some of them share."""
    if noise.requires_grad:
        return False
    if len(noise) == 1:
        return _kept_gains(model, wanted).is_asked_again(noise[0], mask[0])
    return n_different <= len(noise) / _LEAST_SHARE


def _groups_of_own(z: Tensor, mask: Tensor, noise: Tensor) -> Iterator[_Group]:
    """Yield frames that have gains of their own, some at a time."""
    for rows in torch.arange(len(z), device=z.device).split(_OWN_FRAMES):
        yield _Group(rows, z[rows], mask[rows], noise[rows])


def _log_likelihood(model: MixtureKalmanFilter, group: _Group) -> Float[Tensor, "N M"]:
    shared = measured_parts(model)
    if group.shares_gain:
        gain = _gain(model, group, _ALL).gain
        return _log_density(gain.log_norm, _whitened(shared, group, gain).square())
    return condition_own(model, shared, group.z, group.mask, group.noise).log_likelihood


class _Conditioned(NamedTuple):
    """Holds the components given N frames that share their gains.

    Attributes:
        means: [N, M, D]. log_likelihood: [N, M]. jitter: [N, M], or None.
        log_context: the log-likelihood of the first measurements alone, [N, M], or None.
    """

    means: Tensor
    log_likelihood: Tensor
    jitter: Tensor | None
    log_context: Tensor | None


def _condition(
    model: MixtureKalmanFilter,
    shared: MeasuredParts,
    group: _Group,
    made: "_SharedGain",
    n_context: int = 0,
) -> _Conditioned:
    """Return every component given each frame."""
    gain = made.gain
    white = _whitened(shared, group, gain)
    squares = white.square()
    means = torch.baddbmm(shared.means.to(model.dtype)[:, None], white.mT, gain.white)
    jitter = None if gain.jitter is None else gain.jitter.expand(len(group.rows), -1)
    context = _log_density(made.context_norm, squares[:, :n_context]) if n_context else None
    likelihood = _log_density(gain.log_norm, squares)
    return _Conditioned(means.transpose(0, 1), likelihood, jitter, context)


def _whitened(shared: MeasuredParts, group: _Group, gain: Gain) -> Float[Tensor, "M Z N"]:
    """Return the innovations over their standard deviations."""
    residual = (group.z[:, None] - shared.centre.to(group.z)) * group.mask
    return torch.linalg.solve_triangular(gain.factor, residual.permute(1, 2, 0), upper=False)


def _log_density(
    log_norm: Float[Tensor, " M"], squares: Float[Tensor, "M Z N"]
) -> Float[Tensor, "N M"]:
    """Return the log-density of innovations, of which the squares of whitened ones are given."""
    return log_norm[:, None].sub(squares.sum(1), alpha=0.5).mT


class _SharedGain(NamedTuple):
    """Holds what frames with the same noise and the same gaps share.

    Attributes:
        gain: of every component. covs: the covariances after the update, [M, D, D].
        context_norm: the log of the normaliser of the first measurements' density, [M].
    """

    gain: Gain
    covs: Tensor
    context_norm: Tensor


def _gain(model: MixtureKalmanFilter, group: _Group, wanted: Wanted) -> _SharedGain:
    """Return gain and covariance of every component for frames that share them, kept for later."""
    kept = _kept_gains(model, wanted)
    found = kept.get(group.noise, group.mask)
    if found is None:
        with outside_inference():
            found = _make_gain(model, group, wanted)
        kept.put(group.noise, group.mask, found)
    return found


def _kept_gains(model: MixtureKalmanFilter, wanted: Wanted) -> "_FrameGains":
    sources = (model.means, model.covariances)
    return derived(model, ("frame gains", model.dtype, wanted), sources, _FrameGains)


def _make_gain(model: MixtureKalmanFilter, group: _Group, wanted: Wanted) -> _SharedGain:
    gain, covs = kalman_gain(
        model.covariances, group.noise, model.observed, group.mask, wanted.columns
    )
    norm = log_normaliser(gain.factor, group.mask, wanted.n_context).to(model.dtype)
    return _SharedGain(gain.to(model.dtype), covs, norm)


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
    return (*mask.tolist(), *noise.detach().flatten().tolist())


def _in_order(parts: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Return the values of all frames in the order of the frames."""
    if len(parts) == 1:  # of all frames, in their order
        return parts[0][1]
    rows = torch.cat([rows for rows, _ in parts])
    values = torch.cat([values for _, values in parts])
    return values.index_select(0, rows.argsort())
