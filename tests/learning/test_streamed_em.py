"""EM over blocks against EM in memory, two processes against one, and a killed fit against a whole one."""

import functools
import io

import numpy as np
import pytest
import torch
import torch.multiprocessing as mp

from tests.priors.mixtures import random_mixture
from torchpose.errors import CovarianceError, InputError, ShapeError
from torchpose.learning._blocks import Share, spread_samples, usable_samples
from torchpose.learning._samplers import BLOCK, Samples, SampleSource, TensorSource
from torchpose.learning._streamed_em import StreamedEM, fit_streamed, run_streamed
from torchpose.math import expectation_maximisation
from torchpose.math._mixture_start import floor_variances
from torchpose.math._mixture_steps import MixtureParameters, SufficientStatistics, e_step
from torchpose.priors import GaussianMixture

N = 2 * BLOCK + 1500  # three blocks, the last one short: two for one process, one for the other


@functools.cache
def states(n=N, dim=4, seed=0):
    """States in units that differ by six orders of magnitude."""
    x = random_mixture(5, dim, seed).sample((n,), torch.Generator().manual_seed(seed))
    return x * torch.logspace(3, -3, dim, dtype=torch.float64) + 50


def weights(n=N, seed=1):
    g = torch.Generator().manual_seed(seed)
    return torch.rand(n, generator=g, dtype=torch.float64).mul(1.3).sub(0.3).clamp_min(0)


def some_start(x, k=5):
    chosen = torch.randperm(len(x), generator=torch.Generator().manual_seed(3))[:k]
    weight = torch.full((k,), 1 / k, dtype=torch.float64)
    return MixtureParameters(weight, x[chosen], torch.cov(x.T).expand(k, -1, -1).clone())


def assert_same_mixture(a, b, tolerance=1e-8):
    """Equal in units of the standard deviation of the states."""
    scale = b.moments()[1].diagonal().sqrt()
    torch.testing.assert_close(a.weights, b.weights, rtol=0, atol=tolerance)
    torch.testing.assert_close(a.means / scale, b.means / scale, rtol=0, atol=tolerance)
    outer = torch.outer(scale, scale)
    torch.testing.assert_close(a.covariances / outer, b.covariances / outer, rtol=0, atol=tolerance)


def same_state(a, b) -> bool:
    mine, theirs = a.state_dict(), b.state_dict()
    return mine.keys() == theirs.keys() and all(torch.equal(mine[k], theirs[k]) for k in mine)


class KilledError(Exception):
    """Stands for a signal."""


class KilledAt(TensorSource):
    """Ends when a block is drawn in an epoch for the first time."""

    def __init__(self, states, block, epoch):
        super().__init__(states)
        self.at = (block, epoch)

    def block(self, index, epoch=0):
        if (index, epoch) == self.at:
            self.at = None
            raise KilledError
        return super().block(index, epoch)


# --- one process


@pytest.mark.parametrize("weighted", [False, True])
def test_streamed_fit_is_the_fit_in_memory(weighted):
    x, weight = states(), weights() if weighted else None
    mine = fit_streamed(TensorSource(x, weight), 5, seed=2, max_iter=25, tol=0)
    theirs = GaussianMixture.fit(x, 5, seed=2, sample_weight=weight, max_iter=25, tol=0)
    if weighted:  # weights of zero are no samples here
        keep = weight > 0
        theirs = GaussianMixture.fit(
            x[keep], 5, seed=2, sample_weight=weight[keep], max_iter=25, tol=0
        )
    assert_same_mixture(mine, theirs)
    report, expected = mine.fit_report, theirs.fit_report
    assert report.iterations == 25 and len(report.log_likelihood) == 26
    np.testing.assert_allclose(report.log_likelihood, expected.log_likelihood, atol=1e-9)


def test_streamed_fit_stops_where_the_fit_in_memory_does():
    x = states()
    mine, theirs = fit_streamed(TensorSource(x), 5, tol=1e-3), GaussianMixture.fit(x, 5, tol=1e-3)
    assert mine.fit_report.converged
    assert mine.fit_report.iterations == theirs.fit_report.iterations
    assert_same_mixture(mine, theirs)


def test_units_of_a_subset_do_not_matter():
    x = states()
    start, floor = some_start(x), floor_variances(x, 1e-6)
    theirs, _ = expectation_maximisation(x, start, max_iter=20, tol=0, floor=floor)
    em = StreamedEM.start(TensorSource(x), 5, init=start, start_samples=700)
    # the floor alone comes from the subset: take that of all states instead
    inverse = torch.linalg.inv(em.factor)
    em.floor = inverse @ torch.diag(floor) @ inverse.T
    run_streamed(em, TensorSource(x), max_iter=20, tol=0)
    assert_same_mixture(em.mixture(), GaussianMixture(*theirs))


def test_floor_is_that_of_the_states():
    x = states()
    em = StreamedEM.start(TensorSource(x), 5, covariance_floor=0.1)
    floor = em.factor @ em.floor @ em.factor.T
    expected = torch.diag(0.1 * x.var(0, correction=0))
    scale = x.std(0)
    torch.testing.assert_close(
        floor / torch.outer(scale, scale), expected / torch.outer(scale, scale)
    )


def test_memory_mapped_states_are_those_in_memory(tmp_path):
    np.save(tmp_path / "states.npy", states().numpy())
    source = TensorSource(np.load(tmp_path / "states.npy", mmap_mode="r"))
    assert isinstance(source, SampleSource)
    mine, theirs = (fit_streamed(s, 4, max_iter=5) for s in (source, TensorSource(states())))
    assert torch.equal(mine.means, theirs.means)


def test_float32_products_are_close():
    double, single = (
        fit_streamed(TensorSource(states()), 5, max_iter=20, tol=0, dtype=dtype)
        for dtype in (torch.float64, torch.float32)
    )
    assert single.means.dtype == torch.float64
    close = pytest.approx(double.fit_report.log_likelihood[-1], abs=1e-3)
    assert single.fit_report.log_likelihood[-1] == close


def test_log_likelihood_is_that_of_the_mixture():
    x, weight = states(), weights()
    em = StreamedEM.start(TensorSource(x, weight), 5)
    for _ in range(3):
        expected = (weight * em.mixture().log_prob(x)).sum() / weight.sum()
        value = em.maximise(em.accumulate(TensorSource(x, weight)))
        assert value == pytest.approx(float(expected), abs=1e-9)
    assert em.history.tolist()[-1] == value and int(em.steps) == 3


def test_statistics_pack_and_unpack():
    x = random_mixture(5, 4).sample((50,), torch.Generator().manual_seed(0))
    statistics = e_step(x, random_mixture(5, 4).parameters_tuple())
    again = SufficientStatistics.unpack(statistics.pack(), 5)
    assert all(torch.equal(a, b) for a, b in zip(statistics, again, strict=True))
    nothing = SufficientStatistics.zeros(5, 4)
    merged = nothing.merge(statistics)
    assert all(torch.equal(a, b) for a, b in zip(statistics, merged, strict=True))


def test_samples_of_the_start_come_from_everywhere():
    x = torch.arange(250 * BLOCK, dtype=torch.float64)[:, None]
    found = spread_samples(TensorSource(x), 5000).states[:, 0]
    assert 5000 <= len(found) < 5100 and len(found.unique()) == len(found)
    share = torch.histc(found, 8, 0, len(x)) / len(found)
    assert float((share - 1 / 8).abs().max()) <= 0.01
    assert torch.equal(spread_samples(TensorSource(x[:7000]), 7000).states, x[:7000])


def test_blocks_are_shared_out_once():
    shares = [Share(rank, 3) for rank in range(3)]
    found = [block for share in shares for block in share.blocks(8)]
    assert sorted(found) == list(range(8))
    assert list(Share().blocks(3)) == [0, 1, 2] and Share.of_processes() == Share()


# --- resumed fits


@pytest.mark.parametrize("killed", [(0, 0), (1, 4), (2, 7)])
def test_killed_fit_goes_on_to_the_same_mixture(killed):
    x = states()
    whole = StreamedEM.start(TensorSource(x), 5)
    run_streamed(whole, TensorSource(x), max_iter=9, tol=0)
    source, saved = KilledAt(x, *killed), io.BytesIO()
    first = StreamedEM.start(TensorSource(x), 5)
    with pytest.raises(KilledError):
        run_streamed(first, source, max_iter=9, tol=0)
    torch.save(first.state_dict(), saved)
    second = StreamedEM.blank(5, 4)
    second.load_state_dict(torch.load(io.BytesIO(saved.getvalue()), weights_only=True))
    assert int(second.steps) == killed[1]
    run_streamed(second, source, max_iter=9, tol=0)
    assert same_state(whole, second)
    assert same_state(whole.mixture(), second.mixture())
    assert whole.mixture().fit_report == second.mixture().fit_report


def test_finished_fit_stays_as_it_is():
    source = TensorSource(states())
    em = StreamedEM.start(source, 5)
    run_streamed(em, source, max_iter=5, tol=0)
    before = em.mixture()
    run_streamed(em, source, max_iter=5, tol=0)
    assert torch.equal(before.means, em.mixture().means)
    assert before.fit_report == em.mixture().fit_report
    run_streamed(em, source, max_iter=8, tol=0)
    whole = StreamedEM.start(source, 5)
    run_streamed(whole, source, max_iter=8, tol=0)
    assert same_state(whole, em)


def test_moved_components_and_convergence_are_remembered():
    x = states()
    start = some_start(x)
    start.means[0] += 1e4 * x.std(0)
    start.covariances[0] *= 1e-4
    source = TensorSource(x)
    em = StreamedEM.start(source, 5, init=start)
    em.maximise(em.accumulate(source))
    assert int(em.moved) == 1 == int(em.reseeded)
    run_streamed(em, source, max_iter=100, tol=1e-3)
    assert bool(em.converged) and int(em.moved) == 0
    again = StreamedEM.blank(5, 4)
    again.load_state_dict(em.state_dict())
    assert again.mixture().fit_report.reseeded >= 1 and again.mixture().fit_report.converged
    again.restart(em.parameters_tuple())
    assert not len(again.history) and not bool(again.converged) and int(again.steps) == 0


def test_checkpoint_of_another_mixture_is_refused():
    source = TensorSource(states())
    em = StreamedEM.start(source, 5)
    with pytest.raises(InputError, match="5 components over 4 dimensions, this fit has 6 over 4"):
        StreamedEM.blank(6, 4).load_state_dict(em.state_dict())


# --- two processes


def _process(rank, size, folder, n):
    """A fit by one of several processes."""
    torch.set_num_threads(1)
    store = f"file://{folder}/store"
    torch.distributed.init_process_group("gloo", init_method=store, rank=rank, world_size=size)
    source = TensorSource(states(n), weights(n))
    share = Share.of_processes()
    mixture = fit_streamed(source, 5, max_iter=15, tol=0, share=share)
    # a fit that goes on from a step in the middle
    first, second = StreamedEM.start(source, 5), StreamedEM.blank(5, 4)
    run_streamed(first, source, max_iter=6, tol=0, share=share)
    second.load_state_dict(first.state_dict())
    run_streamed(second, source, max_iter=15, tol=0, share=share)
    resumed = second.mixture()
    # bad states in a block of one process end all of them
    broken = states(n).clone()
    broken[BLOCK + 7] = torch.nan
    em = StreamedEM.start(source, 5)
    try:
        em.maximise(em.accumulate(TensorSource(broken, torch.ones(n)), share))
        message = ""
    except InputError as error:
        message = str(error)
    result = {
        "state": mixture.state_dict(),
        "resumed": resumed.state_dict(),
        "report": mixture.fit_report.log_likelihood,
        "message": message,
    }
    torch.save(result, f"{folder}/{rank}.pt")
    torch.distributed.destroy_process_group()


@pytest.mark.slow
def test_two_processes_fit_the_mixture_of_one(tmp_path):
    mp.spawn(_process, (2, str(tmp_path), N), nprocs=2)
    found = [torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in range(2)]
    for key, value in found[0]["state"].items():
        assert torch.equal(value, found[1]["state"][key])
        assert torch.equal(value, found[0]["resumed"][key])
    alone = fit_streamed(TensorSource(states(), weights()), 5, max_iter=15, tol=0)
    assert_same_mixture(GaussianMixture(**found[0]["state"]), alone)
    np.testing.assert_allclose(found[0]["report"], alone.fit_report.log_likelihood, atol=1e-9)
    assert "block 1 of 3" in found[1]["message"] and "row 7" in found[1]["message"]
    assert "another process failed" in found[0]["message"]


@pytest.mark.parametrize("size", [2, 3, 5])
def test_any_number_of_shares_adds_up(size):
    source = TensorSource(states(), weights())
    em = StreamedEM.start(source, 5)
    whole = em.accumulate(source)
    parts = [em.accumulate(source, Share(rank, size)) for rank in range(size)]
    for merged, value in zip(parts[0].merge(*parts[1:]), whole, strict=True):
        torch.testing.assert_close(merged, value, rtol=1e-12, atol=1e-9)


# --- bad input


def test_fewer_poses_than_components_are_refused():
    x = states(6).repeat(50, 1)
    with pytest.raises(
        InputError, match=r"300 usable samples of 6 distinct poses for 7 components"
    ):
        StreamedEM.start(TensorSource(x), 7)
    assert fit_streamed(TensorSource(x), 6, max_iter=3).n_components == 6
    weight = torch.zeros(300)
    weight[:3] = 1
    with pytest.raises(InputError, match="3 usable samples of 3 distinct poses for 5 components"):
        StreamedEM.start(TensorSource(x, weight), 5)

    class FewPoses(TensorSource):
        n_poses = 4

    with pytest.raises(InputError, match="of 4 distinct poses for 5"):
        StreamedEM.start(FewPoses(states()), 5)
    with pytest.raises(InputError, match="0 usable samples"):
        StreamedEM.start(TensorSource(states()[:0]), 5)


def test_bad_states_and_weights_are_named():
    x = states().clone()
    x[BLOCK + 3, 1] = torch.inf
    x[BLOCK + 9] = torch.nan
    message = "block 1 of 3: states must be finite, got 2 of 4096 .* row 3"
    with pytest.raises(InputError, match=message):
        StreamedEM.start(TensorSource(x), 5)
    em = StreamedEM.start(TensorSource(states()), 5)
    with pytest.raises(InputError, match=message):
        em.accumulate(TensorSource(x))
    with pytest.raises(InputError, match="samples: states"):
        em.expect(TensorSource(x).block(1))
    for value in (-0.5, torch.nan, torch.inf):
        weight = torch.ones(4).double()
        weight[2] = value
        with pytest.raises(InputError, match="in row 2"):
            usable_samples(Samples(states()[:4], weight), "these")
    weight = torch.ones(N)
    weight[[BLOCK + 3, BLOCK + 9]] = 0  # states of no weight may be anything
    assert np.isfinite(em.maximise(em.accumulate(TensorSource(x, weight))))


def test_bad_settings_are_refused():
    source = TensorSource(states())
    for options, named in (
        ({"n_components": 0}, "n_components"),
        ({"start_samples": 3}, "start_samples"),
        ({"covariance_floor": 0.0}, "covariance_floor"),
        ({"init": "best"}, "k-means"),
    ):
        with pytest.raises(InputError, match=named):
            StreamedEM.start(source, **{"n_components": 5} | options)
    with pytest.raises(ShapeError):
        StreamedEM.start(source, 5, init=some_start(states(), 4))
    em = StreamedEM.start(source, 5)
    with pytest.raises(ShapeError):
        em.expect(TensorSource(states(dim=3)).block(0))
    with pytest.raises(InputError, match="positive weight"):
        em.maximise(SufficientStatistics.zeros(5, 4))
    start = some_start(states())
    start.covariances[1] = 0
    with pytest.raises(CovarianceError, match="positive definite"):
        StreamedEM.start(source, 5, init=start).accumulate(source)
