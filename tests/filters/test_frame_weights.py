"""Weights of a frame by itself, against densities of scipy and the evidence of Kalman filters."""

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from tests.filters.oracles import random_covariance, random_mixture, tensor
from torchpose.errors import DegenerateFilterWarning, InputError
from torchpose.filters import MixtureKalmanFilter, _memoryless
from torchpose.filters._measurements import Measurements
from torchpose.filters._memoryless import Wanted, run_with_context
from torchpose.filters._side_by_side import SideBySide
from torchpose.math._gaussian import kalman_gain, point_blocks
from torchpose.math._geometric_median import median_columns
from torchpose.priors import GaussianMixture

DIM, OBSERVED, POWER = 4, [0, 2, 3], 0.4


def problem(batch=3, n_frames=7, missing=0.3, seed=0):
    rng = np.random.default_rng(seed)
    weights, means, covs = random_mixture(rng, 3, DIM, 2.0)
    noise = random_covariance(rng, 3, 0.5)
    z = rng.standard_normal((batch, n_frames, 3))
    mask = rng.random((batch, n_frames, 3)) > missing
    return (weights, means, covs, noise), z, mask


def make_filter(model, **options):
    weights, means, covs, noise = model
    mixture = GaussianMixture(tensor(weights), tensor(means), tensor(covs))
    options = {"transition": "ou", "gamma": 0.8, "likelihood_power": POWER} | options
    return MixtureKalmanFilter(
        mixture, torch.ones(DIM), tensor(noise), OBSERVED, weighting="frame", **options
    )


def posterior_of_frame(model, z, mask, noise=None):
    """p(component | z_t) with a tempered likelihood, from scipy's densities."""
    weights, means, covs, own = model
    noise, seen = own if noise is None else noise, np.flatnonzero(mask)
    at = np.array(OBSERVED)[seen]
    log = np.log(weights)
    if len(seen):
        log = log + POWER * np.array(
            [
                multivariate_normal.logpdf(
                    z[seen], m[at], c[np.ix_(at, at)] + noise[np.ix_(seen, seen)]
                )
                for m, c in zip(means, covs, strict=True)
            ]
        )
    return np.exp(log - np.logaddexp.reduce(log))


@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_weights_are_the_tempered_posterior_of_the_frame(missing):
    model, z, mask = problem(missing=missing)
    out = make_filter(model)(tensor(z), torch.as_tensor(mask))
    for b, t in np.ndindex(z.shape[:2]):
        expected = posterior_of_frame(model, z[b, t], mask[b, t])
        np.testing.assert_allclose(out.log_weights[b, t].exp(), expected, atol=1e-12)


def test_noise_of_every_frame_enters_the_weights():
    model, z, mask = problem()
    rng = np.random.default_rng(4)
    noise = np.stack([[random_covariance(rng, 3, 2.0) for _ in range(7)] for _ in range(3)])
    out = make_filter(model)(tensor(z), torch.as_tensor(mask), tensor(noise))
    for b, t in np.ndindex(z.shape[:2]):
        expected = posterior_of_frame(model, z[b, t], mask[b, t], noise[b, t])
        np.testing.assert_allclose(out.log_weights[b, t].exp(), expected, atol=1e-12)


@pytest.mark.parametrize("gamma", [0.0, 0.8])
@pytest.mark.parametrize("own_noise", [False, True])
def test_online_offline_and_smoothed_weights_are_the_same(gamma, own_noise):
    model, z, mask = problem(missing=0.2)
    f, z, mask = make_filter(model, gamma=gamma), tensor(z), torch.as_tensor(mask)
    noise = None
    if own_noise:
        scale = 1 + torch.arange(7, dtype=torch.float64)[:, None, None]
        noise = (scale * tensor(model[3])).expand(3, 7, 3, 3)
    out, state = f(z, mask, noise, return_cov=True), f.init(3)
    for t in range(z.shape[1]):
        now = None if noise is None else noise[:, t]
        state, step = f.step(state, z[:, t], mask[:, t], now, return_cov=True)
        values = out.mean, out.log_weights, out.log_evidence, out.cov, out.mended, out.jitter
        for found, whole in zip(step, values, strict=True):
            torch.testing.assert_close(found, whole[:, t])
    torch.testing.assert_close(f.smooth(z, mask, noise).log_weights, out.log_weights)


def test_tracks_remember_but_weights_do_not():
    model, z, _ = problem(missing=0.0)
    other = z.copy()
    other[:, :3] += 5.0
    f = make_filter(model)
    one, two = f(tensor(z)), f(tensor(other))
    torch.testing.assert_close(one.log_weights[:, 3:], two.log_weights[:, 3:])
    assert (one.mean[:, 3] - two.mean[:, 3]).abs().max() > 0.05


def test_evidence_is_that_of_the_tracks_under_pi():
    """With one component there is nothing to weight: the evidence is the Kalman filter's."""
    rng = np.random.default_rng(1)
    weights, means, covs = random_mixture(rng, 1, DIM)
    model = weights, means, covs, random_covariance(rng, 3, 0.5)
    z = tensor(rng.standard_normal((2, 6, 3)))
    published = MixtureKalmanFilter(
        GaussianMixture(tensor(weights), tensor(means), tensor(covs)), torch.ones(DIM),
        tensor(model[3]), OBSERVED, transition="ou", gamma=0.8,
    )  # fmt: skip
    torch.testing.assert_close(make_filter(model)(z).log_evidence, published(z).log_evidence)


def test_gradients_reach_the_prior_through_the_weights():
    model, z, mask = problem(batch=1, n_frames=3)
    weights, means, covs, noise = (tensor(value) for value in model)
    z, mask = tensor(z), torch.as_tensor(mask)

    def first_weight(means):
        mixture = GaussianMixture(weights, means, covs)
        f = MixtureKalmanFilter(
            mixture, torch.ones(DIM), noise, OBSERVED, transition="ou", gamma=0.8,
            likelihood_power=POWER, weighting="frame",
        )  # fmt: skip
        return f(z, mask).log_weights[..., 0].sum()

    torch.autograd.gradcheck(first_weight, means.requires_grad_(True))


def test_settings_that_contradict_it_are_refused():
    model, *_ = problem()
    with pytest.raises(InputError, match="weighting does not apply to tracks='sampled'"):
        make_filter(model, tracks="sampled", likelihood_power=1.0)
    with pytest.raises(InputError, match="uniform_weight"):
        make_filter(model, uniform_weight=1e-3)
    with pytest.raises(InputError, match=r"medians .* gamma=0"):
        make_filter(model, medians=[0])
    with pytest.raises(InputError, match="reset_below"):
        make_filter(model, reset_below=-50.0)
    with pytest.raises(InputError, match="weighting must be one of"):
        MixtureKalmanFilter(
            GaussianMixture(*(tensor(v) for v in model[:3])), torch.ones(DIM), torch.ones(1), [0],
            weighting="never",
        )  # fmt: skip


def test_lengths_hold_the_last_estimate_without_memory_too():
    model, z, mask = problem()
    f, lengths = make_filter(model, gamma=0.0), torch.tensor([7, 3, 5])
    out = f(tensor(z), torch.as_tensor(mask), lengths=lengths, return_cov=True)
    alone = f(tensor(z[1:2, :3]), torch.as_tensor(mask[1:2, :3]), return_cov=True)
    torch.testing.assert_close(out.mean[1, :3], alone.mean[0])
    torch.testing.assert_close(out.cov[1, 3:], alone.cov[0, -1:].expand(4, -1, -1))
    assert not out.log_evidence[1, 3:].any()


@pytest.mark.parametrize("kind", ["the filter's", "given", "of every frame"])
def test_gradients_of_many_frames_without_memory_reach_prior_and_noise(kind):
    """More frames than are computed anew at a time, of two patterns that share their gains."""
    model, z, _ = problem(batch=2, n_frames=70, missing=0.0)
    weights, means, covs, noise = (tensor(value) for value in model)
    mask = torch.ones(z.shape, dtype=torch.bool)
    mask[:, ::3, 0] = False
    log_pi, z = weights.log(), tensor(z)
    pull = torch.randn(2, 70, DIM, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def total(log_pi, means, factor, scale, z):
        mixture = GaussianMixture(log_pi.softmax(0), means, factor @ factor.mT)
        r = scale * noise
        if kind == "of every frame":
            r = r * (1 + 0.1 * torch.arange(70, dtype=z.dtype))[:, None, None].expand(2, 70, 1, 1)
        f = MixtureKalmanFilter(
            mixture, torch.ones(DIM), noise, OBSERVED, transition="ou", gamma=0.0,
            likelihood_power=POWER, weighting="frame", medians=[1],
        )  # fmt: skip
        out = f(z, mask, None if kind == "the filter's" else r, return_cov=True)
        return (out.mean * pull).sum() + out.log_evidence.sum() + out.cov.sum()

    inputs = [log_pi, means, torch.linalg.cholesky(covs), tensor(1.3), z]
    leaves = [value.clone().requires_grad_() for value in inputs]
    leaves[3].requires_grad_(kind != "the filter's")
    assert torch.autograd.gradcheck(total, leaves, atol=1e-4, rtol=1e-4, fast_mode=True)


@pytest.mark.parametrize("own_noise", [False, True])
def test_wanted_dimensions_and_the_context_are_those_of_whole_filters(own_noise):
    model, z, mask = problem()
    z, mask = tensor(z), torch.as_tensor(mask)
    own = tensor([[0.5 + 0.1 * t for t in range(7)]] * 3)[..., None, None] * torch.eye(3)
    noise = own.double() if own_noise else None
    filter_ = make_filter(model, gamma=0.0)
    frames = filter_.check(z, mask, noise, None, None)
    medians = median_columns(filter_.medians)
    columns, given = [2, 0], (filter_.weight_rule, medians, frames, True)
    out, context = run_with_context(filter_, *given, Wanted(tuple(columns), 2))
    whole = filter_(z, mask, noise, return_cov=True)
    torch.testing.assert_close(out.mean, whole.mean[..., columns], rtol=1e-12, atol=1e-12)
    covs = whole.cov[..., columns, :][..., columns]
    torch.testing.assert_close(out.cov, covs, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(out.log_evidence, whole.log_evidence, rtol=1e-12, atol=1e-12)
    first = mask & torch.tensor([True, True, False])
    expected = filter_(z, first, noise).log_evidence
    torch.testing.assert_close(context, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("own_noise", [False, True])
@pytest.mark.parametrize("missing", [0.0, 0.2])
@pytest.mark.parametrize("medians", [(), (1,)])
def test_filters_side_by_side_give_the_numbers_of_each_by_itself(own_noise, missing, medians):
    columns, parts = (2, 0, 1, 3, 1, 2), []
    wanted = Wanted(columns, 2, of_points=True)
    points = torch.tensor([[3, 4, 5]])[: len(medians)]
    for seed in (0, 1):
        model, z, mask = problem(missing=missing, seed=seed)
        noise = torch.eye(3, dtype=torch.float64) * (0.5 + torch.rand(3, 7, 1, 1) * own_noise)
        filter_ = make_filter(model, gamma=0.0, medians=medians)
        frames = filter_.check(tensor(z), torch.as_tensor(mask), noise, None, None)
        if not own_noise:
            frames = frames._replace(cov=filter_.own_noise())
        parts.append((filter_, frames))
    filters = [filter_ for filter_, _ in parts]
    both = SideBySide(filters, [filter_.weight_rule for filter_ in filters])
    frames = Measurements(*map(torch.stack, zip(*(own for _, own in parts), strict=True)))
    out, context = run_with_context(both, both.weight_rule, points, frames, True, wanted)
    whole = wanted._replace(of_points=False)
    for i, (filter_, own) in enumerate(parts):
        rows = slice(3 * i, 3 * i + 3)
        alone, told = run_with_context(filter_, filter_.weight_rule, points, own, True, whole)
        for name in ("mean", "log_weights", "log_evidence"):
            found = getattr(out, name)[rows]
            torch.testing.assert_close(found, getattr(alone, name), rtol=1e-11, atol=1e-12)
        torch.testing.assert_close(out.cov[rows], point_blocks(alone.cov), rtol=1e-11, atol=1e-12)
        torch.testing.assert_close(context[rows], told, rtol=1e-11, atol=1e-12)


def test_what_fails_beside_another_filter_is_named_by_its_sequence():
    model, z, mask = problem(missing=0.0)
    filter_ = make_filter(model, gamma=0.0)
    frames = filter_.check(tensor(z), torch.as_tensor(mask), None, None, None)
    both = SideBySide([filter_] * 2, [filter_.weight_rule] * 2)
    pair = Measurements(*(torch.stack([part, part]) for part in frames))
    pair.z[1, 2, 4] = torch.nan
    given = both.weight_rule, torch.empty(0, 3, dtype=torch.long), pair, False, Wanted()
    with pytest.warns(DegenerateFilterWarning, match=r"1 of 3 .*element 2 at frame 4"):
        out, _ = run_with_context(both, *given)
    assert out.failed_at.tolist() == [-1, -1, -1, -1, -1, 4]


def test_gains_are_made_for_a_noise_that_comes_again(monkeypatch):
    model, z, mask = problem(batch=1)
    made = []
    monkeypatch.setattr(
        _memoryless, "kalman_gain", lambda *args: made.append(args) or kalman_gain(*args)
    )
    filter_, seen = make_filter(model, gamma=0.0), torch.ones_like(torch.as_tensor(mask[:, 0]))
    state, outputs = filter_.init(1), []
    for noise, count in ((0.5, 0), (0.6, 0), (0.5, 1), (0.5, 1)):
        own = noise * torch.eye(3, dtype=torch.float64)[None]
        _, out = filter_.step(state, tensor(z[:, 0]), seen, own, return_cov=True)
        outputs.append(out)
        assert len(made) == count
    for once, again in zip(outputs[0][:4], outputs[2][:4], strict=True):
        torch.testing.assert_close(once, again, rtol=1e-11, atol=1e-12)
