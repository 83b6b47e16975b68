"""Run fixed tracks over many sequences that share one history of masks, sequences innermost.

A step of all tracks is one product of the gains with the measurements and one with the states, both
over columns that are sequences; a few frames at a time stay in the cache until their weights are in.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from torchpose.filters._gain_graph import Edge, mending_of_edges
from torchpose.filters._measurements import Measurements
from torchpose.filters._mkf import MixtureKalmanFilter
from torchpose.filters._outputs import FilterOutput, finish_output
from torchpose.filters._weights import WeightRule, indicator_mixing, steps_between_rescaling
from torchpose.math._gaussian import least_exponent

_LEAST_BATCH = 16  # below, the calls cost more than the arithmetic, and blocks of frames are faster
_MOST_COLUMNS = 96  # more sequences at a time fall out of the cache
_FRAMES = 4  # at a time


class _Step(NamedTuple):
    """Holds one step, for columns (v, d): whitened innovation over deviation, N = Z + D rows per track.

    Attributes:
        state: previous deviations to (v, d) [M, N, D]. inputs: (z, 1) to the same [M N, Z + 1].
        log_norm: constant of the likelihood [M, 1].
    """

    state: Tensor
    inputs: Tensor
    log_norm: Tensor


def suits_columns(rule: WeightRule, batch: int) -> bool:
    """Return whether `run_columns` may run: many sequences, and weights as published."""
    published = rule.power == 1 and rule.reset_below is None and not rule.by_frame
    mixed = rule.uniform_weight > 0
    safe = mixed and steps_between_rescaling(rule.log_prior, rule.uniform_weight) > 0
    return published and safe and batch >= _LEAST_BATCH


def run_columns(
    model: MixtureKalmanFilter,
    rule: WeightRule,
    frames: Measurements,
    edges: list[Edge],
    progress: bool,
) -> FilterOutput:
    """Filter all frames of a batch.

    Args:
        model: with fixed tracks. rule: of their weights. frames: all that is measured, in sequences of
            one history. edges: the gains of each frame. progress: whether to show a progress bar.
    """
    batch, n_frames, _ = frames.z.shape
    steps = _steps(model, edges)
    options = {"dtype": model.dtype, "device": frames.z.device}
    means = torch.empty(n_frames, batch, model.dim, **options)
    log_weights = torch.empty(n_frames, batch, model.n_tracks, **options)
    evidence = torch.empty(n_frames, batch, **options)
    n_parts = -(-batch // _MOST_COLUMNS)
    bar = tqdm(total=n_parts * n_frames, disable=not progress, unit="frame")
    for rows in torch.arange(batch).tensor_split(n_parts):
        part = slice(int(rows[0]), int(rows[-1]) + 1)
        out = means[:, part], log_weights[:, part], evidence[:, part]
        _run_part(model, rule, frames.z[part], steps, out, bar)
    bar.close()
    evidence = torch.where(frames.mask.any(-1), evidence.mT, torch.zeros_like(evidence.mT))
    shared = torch.zeros(batch, dtype=torch.long, device=frames.z.device)
    work = mending_of_edges([[edge] for edge in edges], shared)
    return finish_output(
        means.transpose(0, 1), log_weights.transpose(0, 1), evidence, None, frames.lengths, work
    )


def _steps(model: MixtureKalmanFilter, edges: list[Edge]) -> list[_Step]:
    made: dict[int, _Step] = {}
    for edge in edges:
        if id(edge) not in made:
            made[id(edge)] = _step(model, edge)
    return [made[id(edge)] for edge in edges]


def _step(model: MixtureKalmanFilter, edge: Edge) -> _Step:
    matrix, observed = model.transition(model.burn_in).matrix, model.observed
    whiten = edge.inverse_factor
    gain = edge.white.mT @ whiten
    offset = model.means[:, observed, None]
    expected = matrix[:, observed]
    state = torch.cat([-whiten @ expected, matrix - gain @ expected], 1)
    inputs = torch.cat(
        [torch.cat([whiten, -whiten @ offset], 2), torch.cat([gain, -gain @ offset], 2)], 1
    )
    dtype = model.dtype
    log_norm = edge.log_norm.to(dtype)[:, None]
    return _Step(state.to(dtype).contiguous(), inputs.flatten(0, 1).to(dtype), log_norm)


def _run_part(
    model: MixtureKalmanFilter,
    rule: WeightRule,
    z: Float[Tensor, "B T Z"],
    steps: list[_Step],
    out: tuple[Tensor, Tensor, Tensor],
    bar: "tqdm[None]",
) -> None:
    batch, n_frames, n_obs = z.shape
    n_tracks, dim = model.means.shape
    columns = z.new_ones(n_frames, n_obs + 1, batch)
    columns[:, :n_obs] = z.permute(1, 2, 0)
    slabs = z.new_empty(_FRAMES, n_tracks, n_obs + dim, batch)
    squares = z.new_empty(_FRAMES, n_tracks, n_obs, batch)
    log_likelihood = z.new_empty(_FRAMES, n_tracks, batch)
    weights = _LinearWeights(rule, batch)
    centres = model.means.to(z.dtype).T.contiguous()
    state = z.new_zeros(n_tracks, dim, batch)
    for start in range(0, n_frames, _FRAMES):
        count = min(_FRAMES, n_frames - start)
        for i, step in enumerate(steps[start : start + count]):
            slab = slabs[i]
            torch.mm(step.inputs, columns[start + i], out=slab.view(-1, batch))
            state = slab.baddbmm_(step.state, state)[:, n_obs:]
        whitened, deviation = slabs[:count, :, :n_obs], slabs[:count, :, n_obs:]
        torch.mul(whitened, whitened, out=squares[:count])
        torch.sum(squares[:count], 2, out=log_likelihood[:count]).mul_(-0.5)
        for i, step in enumerate(steps[start : start + count]):
            log_likelihood[i] += step.log_norm
        span = slice(start, start + count)
        shares, logs, out[2][span] = weights.update(log_likelihood[:count])
        out[1][span] = logs.transpose(1, 2)
        # The weighting below overwrites the deviations, and the next stretch starts from the last.
        state = state.clone()
        mean = deviation.mul_(shares[:, :, None]).sum(1)
        out[0][span] = mean.add_(centres @ shares).transpose(1, 2)
        bar.update(count)


class _LinearWeights:
    """Runs the recursion of `sequence_weights` with epsilon, on scaled linear numbers [S, M, B]."""

    def __init__(self, rule: WeightRule, batch: int) -> None:
        log_prior = rule.log_prior
        prior = log_prior.exp()[:, None]
        self._transition = indicator_mixing(log_prior, rule.uniform_weight).mT.contiguous()
        self._rescale = steps_between_rescaling(log_prior, rule.uniform_weight)
        self._predicted = (prior / prior.sum() * prior).expand(-1, batch)
        self._count = 0

    def update(self, log_likelihood: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return weights, log-weights [S, M, B] and log-evidence [S, B] of the next S frames."""
        top = log_likelihood.amax(1, keepdim=True)
        likelihood = (log_likelihood - top).clamp_min_(least_exponent(log_likelihood.dtype)).exp_()
        predicted = torch.empty_like(likelihood)
        for now, frame in zip(predicted.unbind(), likelihood.unbind(), strict=True):
            now.copy_(self._predicted)
            alpha = now * frame
            self._count += 1
            if self._count % self._rescale == 0:
                alpha /= alpha.sum(0, keepdim=True)
            self._predicted = self._transition @ alpha
        joint = likelihood.mul_(predicted)
        mass, total = joint.sum(1, keepdim=True), predicted.sum(1, keepdim=True)
        evidence = (mass / total).log_().add_(top)[:, 0]
        log_mass = mass.log().add_(top)
        logs = predicted.log_().add_(log_likelihood).sub_(log_mass)
        return joint.div_(mass), logs, evidence
