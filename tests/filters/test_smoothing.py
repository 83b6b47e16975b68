"""Smoothing of fixed tracks against dense joint Gaussians, enumeration and the filter itself."""

import itertools

import numpy as np
import pytest
import torch

from tests.filters.oracles import dense_posterior, enumerate_trajectories, tensor
from tests.filters.small_problem import OBSERVED, Problem
from torchpose.errors import InputError


def chain_of(weights, epsilon):
    """T_ij = ((1 - e) delta_ij + e / M) pi_j, whose rows do not sum to one."""
    n = len(weights)
    e = n * epsilon / (1 + n * epsilon)
    return ((1 - e) * np.eye(n) + e / n) * weights


def track_likelihoods(p):
    """N(z_t | z_1:t-1) of every component's Kalman filter [T, M], from dense Gaussians."""
    totals = np.zeros((p.z.shape[1] + 1, len(p.weights)))
    for t, i in np.ndindex(p.z.shape[1], len(p.weights)):
        models = [p.models()[i]] * (t + 1)
        arguments = (p.means[i], p.covs[i], OBSERVED, p.noise)
        totals[t + 1, i] = dense_posterior(models, *arguments, p.z[0, : t + 1], p.mask[0, : t + 1])[
            2
        ]
    return np.exp(np.diff(totals, axis=0))


def test_smoothing_one_component_is_the_dense_joint_gaussian():
    p = Problem(n_components=1, n_frames=7, batch=2)
    z, mask = tensor(p.z), torch.tensor(p.mask)
    args = (p.means[0], p.covs[0], OBSERVED, p.noise)
    for lag in (None, 0, 2, 50):
        out = p.filter().smooth(z, mask, lag=lag, return_cov=True)
        for b, t in itertools.product(range(2), range(7)):
            n = 7 if lag is None else min(7, t + lag + 1)
            mean, cov, _ = dense_posterior(p.models() * n, *args, p.z[b, :n], p.mask[b, :n])
            np.testing.assert_allclose(out.mean[b, t], mean[t], atol=1e-9)
            np.testing.assert_allclose(out.cov[b, t], cov[t], atol=1e-9)


@pytest.mark.parametrize("epsilon", [0.0, 1e-2, 0.3])
@pytest.mark.parametrize("power", [1.0, 0.4])
@pytest.mark.parametrize("lag", [None, 0, 1, 2])
def test_smoothed_weights_are_the_enumeration_of_the_chain_of_indicators(epsilon, power, lag):
    p = Problem(n_components=2, n_frames=4, missing=0.2)
    likelihood, chain = track_likelihoods(p) ** power, chain_of(p.weights, epsilon)
    model = p.filter(uniform_weight=epsilon, likelihood_power=power)
    found = model.smooth(tensor(p.z), torch.tensor(p.mask), lag=lag).log_weights[0].exp()
    for t in range(4):
        n = 4 if lag is None else min(4, t + lag + 1)
        expected = np.zeros(2)
        for path in itertools.product(range(2), repeat=n):
            weight = p.weights[path[0]] ** 2 * likelihood[0, path[0]]
            for s in range(1, n):
                weight *= chain[path[s - 1], path[s]] * likelihood[s, path[s]]
            expected[path[t]] += weight
        np.testing.assert_allclose(found[t], expected / expected.sum(), atol=1e-12)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"uniform_weight": 0.0},
        {"likelihood_power": 0.3},
        {"weighting": "frame", "transition": "ou", "gamma": 0.5},
        {"weighting": "frame", "transition": "ou", "gamma": 0.0, "medians": [1]},
    ],
)
def test_what_uses_no_later_frame_is_the_filter(options):
    p = Problem(n_frames=25, batch=4, missing=0.2)
    z, mask, lengths = tensor(p.z), torch.tensor(p.mask), torch.tensor([25, 1, 13, 24])
    model = p.filter(**options)
    filtered = model(z, mask, lengths=lengths, return_cov=True)
    at_once = model.smooth(z, mask, lengths=lengths, lag=0, return_cov=True)
    whole = model.smooth(z, mask, lengths=lengths, return_cov=True)
    for name in ("mean", "log_weights", "log_evidence", "cov"):
        expected, ours = getattr(filtered, name), getattr(at_once, name)
        torch.testing.assert_close(ours, expected, rtol=1e-10, atol=1e-10)
        last = getattr(whole, name)[torch.arange(4), lengths - 1]
        at_end = expected[torch.arange(4), lengths - 1]
        torch.testing.assert_close(last, at_end, rtol=1e-10, atol=1e-10)
    if not model.is_memoryless:
        assert (whole.mean - filtered.mean).abs().max() > 0.01


def test_smoothing_of_two_tracks_is_near_the_enumeration_and_beats_filtering():
    """The smoother does not mix track states; this states how much that costs for M = 2, T = 4."""
    epsilon, errors, filtered_errors, weight_errors = 1e-2, [], [], []
    for seed in range(6):
        p = Problem(seed=seed, n_components=2, n_frames=4, missing=0.1)
        exact, _, indicator = enumerate_trajectories(
            p.weights**2,  # weights start at pi, and every step multiplies by pi
            p.means,
            p.covs,
            p.models(),
            OBSERVED,
            p.noise,
            p.z[0],
            p.mask[0],
            chain_of(p.weights, epsilon),
        )
        model = p.filter(uniform_weight=epsilon)
        smooth = model.smooth(tensor(p.z), torch.tensor(p.mask))
        plain = model(tensor(p.z), torch.tensor(p.mask))
        errors.append(np.abs(smooth.mean[0].numpy() - exact).mean())
        filtered_errors.append(np.abs(plain.mean[0].numpy() - exact).mean())
        weight_errors.append(np.abs(smooth.log_weights[0].exp().numpy() - indicator).max())
    # Five of the six problems are close; in one the indicator switches and the smoother is far off.
    assert np.median(errors) < 0.02 < 0.3 < np.median(filtered_errors)
    assert np.mean(errors) < 0.55 * np.mean(filtered_errors)
    assert np.median(weight_errors) < 0.02


def test_smoothing_a_batch_of_different_lengths_equals_single_calls():
    p = Problem(n_frames=40, batch=5, missing=0.1)
    z, mask, lengths = tensor(p.z), torch.tensor(p.mask), torch.tensor([40, 1, 25, 25, 33])
    for lag in (None, 4):
        out = p.filter().smooth(z, mask, lengths=lengths, lag=lag, return_cov=True)
        for b, n in enumerate(lengths.tolist()):
            alone = p.filter().smooth(
                z[b : b + 1, :n], mask[b : b + 1, :n], lag=lag, return_cov=True
            )
            for ours, theirs in zip(out[:4], alone[:4], strict=True):
                torch.testing.assert_close(ours[b, :n], theirs[0], rtol=1e-10, atol=1e-10)


def test_fixed_lag_grows_into_full_smoothing_and_lag_zero_is_the_same_state():
    p = Problem(n_frames=30, missing=0.1)
    z, mask = tensor(p.z), torch.tensor(p.mask)
    model = p.filter()
    full = model.smooth(z, mask)
    torch.testing.assert_close(model.smooth(z, mask, lag=29).mean, full.mean)
    gaps = [(model.smooth(z, mask, lag=n).mean - full.mean).abs().mean() for n in (0, 2, 8)]
    assert gaps[0] > gaps[1] > gaps[2]


def test_smoothing_needs_fixed_tracks_and_a_lag_that_is_not_negative():
    p = Problem()
    with pytest.raises(InputError, match="tracks='fixed'"):
        p.filter(tracks="split").smooth(tensor(p.z))
    with pytest.raises(InputError, match="lag"):
        p.filter().smooth(tensor(p.z), lag=-1)
