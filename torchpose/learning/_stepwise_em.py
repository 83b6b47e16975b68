"""Take a first pass of stepwise EM, which moves the mixture many times in one pass over the states.

Exact EM takes one step for each pass over all states. Stepwise EM takes one for every few blocks, and
blends their statistics with those of earlier blocks, whose weight decays. One pass over 50 blocks improves
a mixture about as much as eight passes of exact EM, which then continues from there.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_count
from torchpose.errors import InputError
from torchpose.learning._blocks import ALONE, Share
from torchpose.learning._samplers import Samples, SampleSource
from torchpose.learning._streamed_em import StreamedEM
from torchpose.math._mixture_em import IterationBar
from torchpose.math._mixture_steps import (
    MixtureParameters,
    SufficientStatistics,
    m_step,
    upper_triangle,
)

# Of powers 0.6 to 1 and 1 to 8 blocks, the smaller the further a pass came, on drawn and on recorded
# states; two blocks let two processes work at a time.
BLOCKS_PER_STEP = 2
POWER, OFFSET = 0.6, 2.0


class StepwiseState(NamedTuple):
    """Holds the blended statistics that are carried from step to step.

    Attributes:
        table: blended statistics s of `SufficientStatistics`, for one sample of weight one.
        size: number of samples that the blend is worth, 1 / sum_i a_i^2 / n_i with the share a_i and
            the weight n_i of every step in it.
        step: steps taken.
    """

    table: Float[Tensor, "K F"]
    size: Float[Tensor, ""]
    step: int


def implied_statistics(
    parameters: MixtureParameters, floor: Float[Tensor, "D D"]
) -> Float[Tensor, "K F"]:
    """Return the statistics of one sample from which `m_step` makes this mixture.

    s_k = pi_k [1, mu_k, Sigma_k - floor + mu_k mu_k'], the upper triangle of the last.

    Args:
        parameters: the mixture. floor: as for `m_step`.
    """
    weights, means, covariances = parameters
    rows, columns = upper_triangle(means.shape[1], means.device)
    second = covariances - floor + means.unsqueeze(-1) * means.unsqueeze(-2)
    features = torch.cat([torch.ones_like(means[:, :1]), means, second[:, rows, columns]], 1)
    return features * weights.unsqueeze(-1)


def stepwise_start(em: StreamedEM, size: float) -> StepwiseState:
    """Return the state before the first step, with the mixture counting as `size` samples."""
    table = implied_statistics(em.parameters_tuple(), em.floor)
    return StepwiseState(table, table.new_tensor(size), 0)


@torch.no_grad()
def stepwise_update(
    em: StreamedEM,
    state: StepwiseState,
    statistics: SufficientStatistics,
    power: float,
    offset: float,
) -> StepwiseState:
    """Blend the statistics of a few blocks in, and move the mixture.

    s <- (1 - eta) s + eta s_new,  eta = (t + t0)^-kappa  for the step t = 0, 1, ...

    Args:
        em: the mixture; its parameters are replaced, its history is emptied.
        state: the state of the step before.
        statistics: the statistics of the blocks, summed over processes, made with `em` as it is.
        power: kappa in (1/2, 1]; the smaller, the sooner old blocks are forgotten.
        offset: t0 >= 1; the larger, the less the first blocks move the start.

    Returns:
        The state of this step.

    Raises:
        InputError: a power or offset out of range, blocks without weight.

    Reference:
        Cappé & Moulines, "On-line expectation-maximization algorithm for latent data models",
        JRSS B 71, 2009. Liang & Klein, "Online EM for unsupervised models", NAACL 2009.
    """
    _check_schedule(power, offset)
    em.mean_log_likelihood(statistics)  # raises without weight
    eta = (state.step + offset) ** -power
    weight = statistics.weight
    table = (1 - eta) * state.table + eta * statistics.table / weight
    size = 1 / ((1 - eta) ** 2 / state.size + eta**2 / weight)
    blend = SufficientStatistics(table * size, statistics.log_likelihood, size)
    parameters, moved = m_step(blend, em.floor)
    em.restart(parameters)
    if moved:  # the blend has to be that of the mixture, or what was moved would come back
        table = implied_statistics(parameters, em.floor)
    return StepwiseState(table, size, state.step + 1)


def stepwise_pass(
    em: StreamedEM,
    source: SampleSource,
    seed: int = 0,
    *,
    blocks_per_step: int = BLOCKS_PER_STEP,
    power: float = POWER,
    offset: float = OFFSET,
    share: Share = ALONE,
    progress: bool = False,
) -> Float[Tensor, " T"]:
    """Go once over a source in random order, with a step for every few blocks.

    The steps are the same for any number of processes, which share the blocks of every step. The pass
    leaves `em` with another mixture and an empty history, as if it had just been started.

    Args:
        em: the mixture.
        source: the states.
        seed: the seed of the order of the blocks.
        blocks_per_step: blocks of all processes together for one step.
        power, offset: of the step size, see `stepwise_update`.
        share: of this process.
        progress: show a bar.

    Returns:
        Mean log-likelihood of the blocks of each step before that step, in units of the states.

    Raises:
        InputError: settings out of range, samples that are not finite.
    """
    check_count("blocks_per_step", blocks_per_step)
    _check_schedule(power, offset)
    order = torch.randperm(source.n_blocks, generator=torch.Generator().manual_seed(seed))
    steps = order.split(blocks_per_step)
    state, history = None, []
    with IterationBar(len(steps), progress) as bar:
        for blocks in steps:
            statistics = em.accumulate(_Chosen(source, blocks.tolist()), share, epoch=0)
            if float(statistics.weight) == 0:
                continue
            if state is None:
                state = stepwise_start(em, float(statistics.weight))
            history.append(em.mean_log_likelihood(statistics))
            state = stepwise_update(em, state, statistics, power, offset)
            bar.update(history[-1])
    return torch.tensor(history, dtype=torch.float64)


class _Chosen:
    """Yields some blocks of a source."""

    def __init__(self, source: SampleSource, blocks: list[int]) -> None:
        self.source, self.blocks = source, blocks
        self.dim, self.n_blocks, self.n_samples = source.dim, len(blocks), source.n_samples

    def block(self, index: int, epoch: int = 0) -> Samples:
        return self.source.block(self.blocks[index], epoch)


def _check_schedule(power: float, offset: float) -> None:
    if not 0.5 < power <= 1:
        raise InputError(f"power must lie in (0.5, 1], got {power}")
    if not offset >= 1:
        raise InputError(f"offset must be at least 1, got {offset}")
