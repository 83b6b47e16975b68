"""Gradients of filters against finite differences, and estimates that they leave as they are."""

import numpy as np
import pytest
import torch

from tests.filters.oracles import random_covariance, tensor
from tests.filters.small_problem import DIM, OBSERVED, Problem
from tests.gradients import assert_differentiable, assert_without_gradient
from torchpose.filters import BootstrapParticleFilter, MixtureKalmanFilter
from torchpose.filters._constant_velocity import ConstantVelocityFilter
from torchpose.priors import GaussianMixture

FRAMES = 18  # more than are computed anew at a time
LENGTHS = torch.tensor([18, 11, 1])


def problem():
    """Three sequences; whole stretches are measured in full, others have gaps of their own."""
    p = Problem(n_frames=FRAMES, batch=3, missing=0.0)
    p.mask[0, 5:9, 1] = False
    p.mask[1, 6:8] = False
    p.mask[2, 0, 0] = False
    return p


def outputs(model, p, smooth=False, noise=None, **options):
    """Everything that a filter gives, as a function of the measurements."""
    mask = torch.tensor(p.mask)

    def run(z):
        if smooth:
            return model.smooth(z, mask, noise, lengths=LENGTHS, return_cov=True, **options)[:4]
        generator = torch.Generator().manual_seed(0)
        return model(z, mask, noise, lengths=LENGTHS, generator=generator, return_cov=True)[:4]

    return run


FIXED = [
    {},
    {"uniform_weight": 0.0},
    {"transition": "stationary", "likelihood_power": 0.4},
    {"transition": "ou", "gamma": 0.9},
    {"transition": "ou", "gamma": 0.9, "subspace": 2},
    {"reset_below": -6.0},
    {"burn_in": 4},
    {"initial_cov": torch.ones(DIM)},
    {"weighting": "frame", "transition": "ou", "gamma": 0.8},
    {"weighting": "frame", "transition": "ou", "gamma": 0.0, "medians": [1]},
]


@pytest.mark.parametrize("options", FIXED, ids=str)
def test_fixed_tracks(options):
    p = problem()
    model = p.filter(**options)
    assert_differentiable(outputs(model, p), tensor(p.z))
    if "reset_below" not in options:
        lag = 3 if options else None
        assert_differentiable(outputs(model, p, smooth=True, lag=lag), tensor(p.z))


def test_noise_of_every_frame_and_many_mask_histories():
    p = problem()
    rng = np.random.default_rng(0)
    noise = tensor(np.stack([[random_covariance(rng, 2) for _ in range(FRAMES)]] * 3))
    assert_differentiable(outputs(p.filter(), p, noise=noise), tensor(p.z))
    p = Problem(n_frames=FRAMES, batch=3, missing=0.4)
    assert_differentiable(outputs(p.filter(), p), tensor(p.z))


@pytest.mark.parametrize("batch", [1, 24])
def test_the_quickest_paths_without_gradients_give_the_same(batch):
    """Blocks of frames, and columns of sequences; both only without covariances."""
    p = Problem(n_frames=60, batch=batch, missing=0.0)
    model = p.filter()
    assert_differentiable(lambda z: model(z)[:3], tensor(p.z))


def test_frames_one_by_one():
    p = problem()
    for model in (p.filter(), p.filter(weighting="frame", transition="ou", gamma=0.0, medians=[1])):

        def steps(z, model=model):
            state, found = model.init(len(z)), []
            for t in range(5):
                state, out = model.step(state, z[:, t], return_cov=True)
                found += [out.mean, out.log_weights, out.log_evidence, out.cov]
            return found

        assert_differentiable(steps, tensor(p.z)[:, :5])


@pytest.mark.parametrize("tracks", ["sampled", "split"])
@pytest.mark.parametrize("transition", ["paper", "stationary", "ou"])
def test_tracks_that_change_their_component(tracks, transition):
    """Which tracks are drawn or kept does not change where the differences are taken."""
    p = problem()
    model = p.filter(
        tracks=tracks, n_tracks=7, transition=transition, gamma=0.9 if transition == "ou" else None
    )
    assert_differentiable(outputs(model, p), tensor(p.z), step=1e-7, tolerance=1e-4)


@pytest.mark.parametrize("proposal", ["mixture", "random-walk", "random-walk-unscaled"])
def test_particles_have_none(proposal):
    p = problem()
    model = BootstrapParticleFilter(
        p.mixture(), tensor(p.process), tensor(p.noise), OBSERVED, proposal=proposal, n_particles=50
    )
    assert_without_gradient(outputs(model, p), tensor(p.z))


@pytest.mark.parametrize("lag", ["filter", 0, 3, None])
def test_constant_velocity(lag):
    model = ConstantVelocityFilter(ratio=1e3, fps=30.0)
    z = tensor(np.random.default_rng(0).standard_normal((2, 12, 3)).cumsum(1))
    lengths = torch.tensor([12, 7])
    if lag == "filter":
        assert_differentiable(lambda z: [model(z)], z)
    else:
        assert_differentiable(lambda z: [model.smooth(z, lengths=lengths, lag=lag)], z)


MODELS = [
    {"uniform_weight": 1e-2},
    {"burn_in": 3},
    {"transition": "stationary"},
    {"weighting": "frame", "transition": "ou", "gamma": 0.7},
    {"weighting": "frame", "transition": "ou", "gamma": 0.0, "medians": [1]},
]


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("options", MODELS, ids=str)
def test_prior_and_noise_of_fixed_tracks(options, smooth):
    p = problem()
    pull = torch.randn(3, FRAMES, DIM, generator=torch.Generator().manual_seed(0)).double()

    def total(log_q, log_pi, means, chol, log_r):
        prior = GaussianMixture(log_pi.softmax(0), means, chol @ chol.mT)
        model = MixtureKalmanFilter(prior, log_q.exp(), log_r.exp(), OBSERVED, **options)
        out = outputs(model, p, smooth)(tensor(p.z))
        return (out[0] * pull).sum() + out[2].sum() + out[3].sum()

    inputs = [
        tensor(p.process.diagonal()).log(),
        tensor(p.weights).log(),
        tensor(p.means),
        torch.linalg.cholesky(tensor(p.covs)),
        tensor(p.noise.diagonal()).log(),
    ]
    leaves = [value.clone().requires_grad_() for value in inputs]
    if options.get("transition") == "ou":
        leaves[0].requires_grad_(False)
    assert torch.autograd.gradcheck(total, leaves, atol=1e-4, rtol=1e-4, fast_mode=True)
