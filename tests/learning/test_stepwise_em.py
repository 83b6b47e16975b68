"""Stepwise EM against a plain loop in NumPy, and against exact EM on states of a known mixture."""

import functools

import numpy as np
import pytest
import torch

from tests.priors.mixtures import random_mixture
from torchpose.errors import InputError
from torchpose.learning._blocks import Share
from torchpose.learning._samplers import BLOCK, TensorSource
from torchpose.learning._stepwise_em import implied_statistics, stepwise_pass
from torchpose.learning._streamed_em import StreamedEM, run_streamed
from torchpose.math._mixture_em import MixtureParameters, SufficientStatistics, m_step

N = 12 * BLOCK + 700


@functools.cache
def truth():
    return random_mixture(6, 5, seed=4)


@functools.cache
def states():
    return truth().sample((N,), torch.Generator().manual_seed(0))


def fresh(n_components=6, **options):
    return StreamedEM.start(TensorSource(states()), n_components, init="random", **options)


def log_likelihood(em):
    return em.mean_log_likelihood(em.accumulate(TensorSource(states())))


def numpy_pass(x, start, floor, order, blocks_per_step, power, offset):
    """One component at a time, in the units of the states."""
    weights, means, covariances = (p.numpy().copy() for p in start)
    second = covariances - floor + means[:, :, None] * means[:, None, :]
    sums = [weights, weights[:, None] * means, weights[:, None, None] * second]
    for step, first in enumerate(range(0, len(order), blocks_per_step)):
        chosen = order[first : first + blocks_per_step]
        part = np.concatenate([x[b * BLOCK : (b + 1) * BLOCK] for b in chosen])
        terms = []
        for weight, mean, covariance in zip(weights, means, covariances, strict=True):
            residual = part - mean
            squared = (residual * np.linalg.solve(covariance, residual.T).T).sum(1)
            terms.append(weight * np.exp(-0.5 * squared) / np.sqrt(np.linalg.det(covariance)))
        r = np.stack(terms, 1) / np.sum(terms, 0)[:, None]
        new = [
            r.mean(0),
            r.T @ part / len(part),
            np.einsum("nk,ni,nj->kij", r, part, part) / len(part),
        ]
        eta = (step + offset) ** -power
        sums = [(1 - eta) * old + eta * value for old, value in zip(sums, new, strict=True)]
        weights = sums[0]
        means = sums[1] / weights[:, None]
        covariances = sums[2] / weights[:, None, None] + floor
        covariances = covariances - means[:, :, None] * means[:, None, :]
    return weights / weights.sum(), means, covariances


@pytest.mark.parametrize(("power", "offset"), [(0.6, 2.0), (1.0, 1.0)])
def test_a_pass_is_the_loop_in_numpy(power, offset):
    em = fresh()
    start, floor = em.mixture().parameters_tuple(), em.factor @ em.floor @ em.factor.T
    order = torch.randperm(13, generator=torch.Generator().manual_seed(5)).tolist()
    history = stepwise_pass(
        em, TensorSource(states()), 5, blocks_per_step=3, power=power, offset=offset
    )
    expected = numpy_pass(states().numpy(), start, floor.numpy(), order, 3, power, offset)
    for mine, theirs in zip(em.mixture().parameters_tuple(), expected, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-8, atol=1e-9)
    assert len(history) == 5 and not len(em.history) and int(em.steps) == 0


def test_a_pass_gets_further_than_a_step_of_exact_em():
    em = fresh()
    history = stepwise_pass(em, TensorSource(states()), blocks_per_step=1)
    exact = fresh()
    run_streamed(exact, TensorSource(states()), max_iter=3, tol=0)
    known = float(truth().log_prob(states()).mean())
    start, reached = exact.history[0], log_likelihood(em)
    assert len(history) == 13 and float(history[-1]) > float(history[0])
    assert reached > float(exact.history[3])
    # a pass closes more of the gap to the mixture that the states were drawn from
    assert (reached - start) / (known - start) > 0.8
    before = log_likelihood(em)
    run_streamed(em, TensorSource(states()), max_iter=2, tol=0)
    assert before == float(em.history[0]) < float(em.history[1])


def test_a_pass_follows_its_seed():
    first, same, other = (fresh() for _ in range(3))
    for em, seed in ((first, 0), (same, 0), (other, 1)):
        stepwise_pass(em, TensorSource(states()), seed)
    assert torch.equal(first.means, same.means)
    assert not torch.equal(first.means, other.means)


def test_blocks_of_a_step_are_shared(monkeypatch):
    alone, both = fresh(), fresh()
    stepwise_pass(alone, TensorSource(states()), blocks_per_step=3)
    accumulate = StreamedEM.accumulate

    def by_two(em, source, share, epoch):
        parts = [accumulate(em, source, Share(rank, 2), epoch) for rank in range(2)]
        return parts[0].merge(parts[1])

    monkeypatch.setattr(StreamedEM, "accumulate", by_two)
    stepwise_pass(both, TensorSource(states()), blocks_per_step=3)
    torch.testing.assert_close(alone.means, both.means, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(alone.covariances, both.covariances, rtol=1e-9, atol=1e-9)


def test_implied_statistics_make_the_mixture():
    parameters = random_mixture(4, 3).parameters_tuple()
    floor = 1e-3 * torch.eye(3, dtype=torch.float64)
    table = implied_statistics(parameters, floor)
    n = torch.tensor(1000.0, dtype=torch.float64)
    again, moved = m_step(SufficientStatistics(table * n, n * 0, n), floor)
    assert moved == 0
    for mine, theirs in zip(again, parameters, strict=True):
        torch.testing.assert_close(mine, theirs)


def test_empty_components_are_moved_once_and_stay():
    em = fresh()
    means = em.means.clone()
    means[0] += 1e3
    em.restart(MixtureParameters(em.weights, means, 0.2 * em.covariances))
    # with t0 = 1 the first blocks replace the start
    stepwise_pass(em, TensorSource(states()), blocks_per_step=1, offset=1.0)
    assert float(em.means.abs().max()) < 10
    assert float(em.weights.min()) > 1e-3
    assert log_likelihood(em) > float(truth().log_prob(states()).mean()) - 0.5


def test_bad_settings_are_refused():
    source = TensorSource(states())
    for options, named in (
        ({"power": 0.5}, "power"),
        ({"offset": 0.5}, "offset"),
        ({"blocks_per_step": 0}, "blocks_per_step"),
    ):
        with pytest.raises(InputError, match=named):
            stepwise_pass(fresh(), source, **options)
    broken = states().clone()
    broken[5] = torch.nan
    with pytest.raises(InputError, match="row 5"):
        stepwise_pass(fresh(), TensorSource(broken))
    weightless = TensorSource(states(), torch.zeros(N))
    assert not len(stepwise_pass(fresh(), weightless))
