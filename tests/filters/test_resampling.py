"""Resampling against its definition: unbiased counts, bounds of each method, batches, dead rows."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchpose.errors import InputError, ShapeError
from torchpose.filters import resample
from torchpose.filters._resampling import RESAMPLING

METHODS = sorted(RESAMPLING)


def counts_of(ancestors, n_particles):
    return torch.nn.functional.one_hot(ancestors, n_particles).sum(1).double()


def generators(*seeds):
    return [torch.Generator().manual_seed(seed) for seed in seeds]


weight_lists = st.lists(
    st.one_of(st.just(0.0), st.floats(1e-6, 1.0)), min_size=1, max_size=8
).filter(lambda w: sum(w) > 0)


@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=25, deadline=None)
@given(weights=weight_lists, seed=st.integers(0, 2**31), n_samples=st.integers(1, 12))
def test_every_particle_is_taken_n_w_times_on_average(method, weights, seed, n_samples):
    runs = 4000
    w = torch.tensor(weights, dtype=torch.float64)
    rows = w.log().expand(runs, -1)
    (g,) = generators(seed)
    counts = counts_of(resample(rows, method, g, n_samples), len(w))
    expected = n_samples * w / w.sum()
    error = counts.std(0) / runs**0.5
    assert ((counts.mean(0) - expected).abs() <= 6 * error + 3e-3).all()
    assert (counts[:, w == 0] == 0).all()


@settings(max_examples=50, deadline=None)
@given(weights=weight_lists, seed=st.integers(0, 2**31))
def test_systematic_takes_floor_or_ceil_and_residual_at_least_floor(weights, seed):
    w = torch.tensor(weights, dtype=torch.float64)
    expected = len(w) * w / w.sum()
    rows = w.log().expand(50, -1)
    systematic = counts_of(resample(rows, "systematic", *generators(seed)), len(w))
    assert (systematic >= (expected - 1e-9).floor()).all()
    assert (systematic <= (expected + 1e-9).ceil()).all()
    stratified = counts_of(resample(rows, "stratified", *generators(seed)), len(w))
    assert ((stratified - expected).abs() < 2 + 1e-9).all()
    residual = counts_of(resample(rows, "residual", *generators(seed)), len(w))
    assert (residual >= (expected - 1e-9).floor()).all()


@pytest.mark.parametrize("method", METHODS)
def test_weights_need_not_be_normalised_and_may_be_tiny(method):
    log_weights = torch.randn(4, 50, generator=torch.Generator().manual_seed(0)).double()
    plain = resample(log_weights, method, *generators(1))
    shifted = resample(log_weights - 1e5, method, *generators(1))
    assert (plain == shifted).float().mean() > 0.99


@pytest.mark.parametrize("method", METHODS)
def test_equal_weights_are_kept_by_all_but_multinomial(method):
    ancestors = resample(torch.zeros(3, 1000), method, *generators(2))
    if method == "multinomial":
        assert ancestors.unique().numel() < 1000
    else:
        assert (ancestors.sort(-1).values == torch.arange(1000)).all()


@pytest.mark.parametrize("method", METHODS)
def test_a_row_does_not_depend_on_its_batch(method):
    log_weights = 3 * torch.randn(5, 200, generator=torch.Generator().manual_seed(3)).double()
    log_weights[1] = -torch.inf
    log_weights[2, 7] = torch.nan
    together = resample(log_weights, method, generators(*range(5)))
    for b in range(5):
        alone = resample(log_weights[b : b + 1], method, generators(b))
        assert torch.equal(together[b], alone[0])


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("n_samples", [3, 9])
def test_dead_rows_get_the_particles_in_turn(method, n_samples):
    log_weights = torch.full((3, 5), -torch.inf)
    log_weights[1] = torch.nan
    log_weights[2] = torch.inf
    ancestors = resample(log_weights, method, *generators(0), n_samples=n_samples)
    assert (ancestors == torch.arange(n_samples).clamp_max(4)).all()


@pytest.mark.parametrize("method", METHODS)
def test_a_single_survivor_is_taken_by_all(method):
    log_weights = torch.full((2, 10_000), -torch.inf)
    log_weights[0, 9_999] = 0.0
    log_weights[1, 0] = -700.0
    ancestors = resample(log_weights, method, *generators(0))
    assert (ancestors[0] == 9_999).all()
    assert (ancestors[1] == 0).all()


def test_bad_input_is_refused():
    with pytest.raises(InputError, match="systematic"):
        resample(torch.zeros(1, 3), "wheel")
    with pytest.raises(ShapeError, match="log_weights"):
        resample(torch.zeros(1, 2, 3))
    with pytest.raises(InputError, match="particles"):
        resample(torch.zeros(1, 0))
    with pytest.raises(InputError, match="n_samples"):
        resample(torch.zeros(1, 3), n_samples=0)


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("method", METHODS)
def test_on_cuda(method):
    log_weights = torch.randn(3, 1000, device="cuda")
    ancestors = resample(log_weights, method)
    assert ancestors.is_cuda
    assert int(ancestors.max()) < 1000
