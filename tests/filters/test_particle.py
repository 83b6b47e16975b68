"""Bootstrap particle filters against exact filters: Kalman for one component, a grid for several."""

import functools
import math
import warnings

import numpy as np
import pytest
import torch

from tests.data import data_dir_or_skip
from tests.draws import generator
from tests.filters.linear_poses import assert_within_error
from tests.filters.oracles import (
    dense_posterior,
    paper_transition,
    random_covariance,
    random_mixture,
    tensor,
)
from torchpose.errors import CovarianceError, DegenerateFilterWarning, InputError, ShapeError
from torchpose.filters import BootstrapParticleFilter, RecursiveFilter
from torchpose.filters._particle import PROPOSALS
from torchpose.filters._transition import make_transition
from torchpose.filters._walk import MixtureWalk, Moves, grouped_affine
from torchpose.math._gaussian import log_prob, mixture_moments, safe_cholesky
from torchpose.priors import GaussianMixture

WIDE = torch.float64
EXACT_PROPOSALS = ("mixture", "random-walk")
DTYPES = (torch.float32, torch.float64)


def mixture(weights, means, covs):
    return GaussianMixture(tensor(weights), tensor(means), tensor(covs))


def small_mixture(seed=0, n_components=3, dim=2, spread=2.0):
    return mixture(*random_mixture(np.random.default_rng(seed), n_components, dim, spread))


def runs_of(tracker, z, mask=None, runs=48, seed=0, **options):
    """The same sequence filtered `runs` times, as a batch."""
    z = z[None].expand(runs, -1, -1)
    mask = None if mask is None else mask[None].expand(runs, -1, -1)
    return tracker(z, mask, generator=generator(seed), **options)


# --- one component: the model is linear and Gaussian, and the exact answer is a dense Gaussian


def linear_problem(seed=1, dim=3, n_frames=6):
    rng = np.random.default_rng(seed)
    mean, cov = rng.standard_normal(dim), random_covariance(rng, dim)
    process = random_covariance(rng, dim, 0.5)
    noise, observed = np.diag([0.4, 0.6]), [2, 0]
    z = mean[observed] + rng.standard_normal((n_frames, 2))
    return mean, cov, process, noise, observed, z


def causal_posteriors(models, mean, cov, observed, noise, z, mask):
    """Filtered mean, covariance and evidence increment of every frame, from dense posteriors."""
    out, before = [], 0.0
    for t in range(1, len(z) + 1):
        m, p, evidence = dense_posterior(models[:t], mean, cov, observed, noise, z[:t], mask[:t])
        out.append((m[-1], p[-1], evidence - before))
        before = evidence
    return [tensor(np.stack(part)) for part in zip(*out, strict=True)]


@pytest.mark.parametrize("threshold", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("proposal", EXACT_PROPOSALS)
def test_one_component_agrees_with_the_exact_filter(proposal, threshold):
    mean, cov, process, noise, observed, z = linear_problem()
    mask = np.ones(z.shape, dtype=bool)
    mask[1, 0] = mask[3] = False
    models = [paper_transition(mean, cov, process)] * len(z)
    exact_mean, exact_cov, exact_evidence = causal_posteriors(
        models, mean, cov, observed, noise, z, mask
    )
    tracker = BootstrapParticleFilter(
        mixture([1.0], mean[None], cov[None]), tensor(process), tensor(noise), observed,
        proposal=proposal, n_particles=4000, resample_threshold=threshold, dtype=WIDE,
    )  # fmt: skip
    out = runs_of(tracker, tensor(z), torch.tensor(mask), return_cov=True)
    assert_within_error(out.mean, exact_mean)
    assert_within_error(out.cov, exact_cov, slack=2e-3)
    assert_within_error(out.log_evidence, exact_evidence, slack=2e-3)
    assert (out.log_evidence[:, 3] == 0).all()
    # the estimate of the evidence itself, not its logarithm, is unbiased up to 1 / N
    ratio = (out.log_evidence.sum(1) - exact_evidence.sum()).exp()
    assert_within_error(ratio, 1.0, slack=2e-3)


@pytest.mark.parametrize("proposal", EXACT_PROPOSALS)
def test_burn_in_and_initial_covariance_change_the_model_as_described(proposal):
    mean, cov, process, noise, observed, z = linear_problem(seed=2)
    mask, initial = np.ones(z.shape, dtype=bool), 0.2 * np.eye(3)
    scales = [8.0 ** max(0.0, 1 - t / 3) for t in range(len(z))]
    models = [paper_transition(mean, cov, s * process) for s in scales]
    exact_mean, _, exact_evidence = causal_posteriors(
        models, mean, initial, observed, noise, z, mask
    )
    tracker = BootstrapParticleFilter(
        mixture([1.0], mean[None], cov[None]), tensor(process), tensor(noise), observed,
        proposal=proposal, n_particles=4000, burn_in=3, burn_in_scale=8.0,
        initial_cov=tensor(initial), dtype=WIDE,
    )  # fmt: skip
    assert [tracker.inflation(t) for t in range(len(z))] == pytest.approx(scales)
    out = runs_of(tracker, tensor(z))
    assert_within_error(out.mean, exact_mean)
    assert_within_error(out.log_evidence, exact_evidence, slack=2e-3)


@pytest.mark.parametrize("proposal", EXACT_PROPOSALS)
def test_a_measured_start_agrees_with_the_exact_filter(proposal):
    mean, cov, process, noise, observed, z = linear_problem(seed=5)
    mask = np.ones(z.shape, dtype=bool)
    mask[0, 1] = False
    still = np.eye(3), np.zeros(3), 1e-10 * np.eye(3)  # x_1 is distributed as the prior
    models = [still] + [paper_transition(mean, cov, process)] * (len(z) - 1)
    exact_mean, exact_cov, exact_evidence = causal_posteriors(
        models, mean, cov, observed, noise, z, mask
    )
    tracker = BootstrapParticleFilter(
        mixture([1.0], mean[None], cov[None]), tensor(process), tensor(noise), observed,
        proposal=proposal, n_particles=4000, start="measured", dtype=WIDE,
    )  # fmt: skip
    out = runs_of(tracker, tensor(z), torch.tensor(mask), return_cov=True)
    assert_within_error(out.mean, exact_mean)
    assert_within_error(out.cov, exact_cov, slack=2e-3)
    assert_within_error(out.log_evidence, exact_evidence, slack=2e-3)


def test_a_measured_start_draws_from_the_posterior_of_each_element():
    prior = small_mixture(seed=7, n_components=3, dim=3, spread=4.0)
    noise = np.array([[0.3, 0.1], [0.1, 0.5]])
    z = np.array([[1.0, -2.0], [3.0, 0.5], [0.0, 0.0]])
    seen = torch.tensor([[True, True], [False, True], [False, False]])
    tracker = BootstrapParticleFilter(
        prior, torch.ones(3), tensor(noise), [2, 0], n_particles=40_000, start="measured"
    )
    state = tracker.init(3, generator=generator())
    state, out = tracker.step(state, tensor(z), seen, generator=generator(), return_cov=True)
    assert torch.allclose(out.log_weights.exp(), torch.full_like(out.log_weights, 1 / 40_000))
    points = np.random.default_rng(0).multivariate_normal(np.zeros(3), np.eye(3), 400_000)
    chosen = np.random.default_rng(1).choice(3, len(points), p=prior.weights.numpy())
    factors = np.linalg.cholesky(prior.covariances.numpy())
    points = prior.means.numpy()[chosen] + np.einsum("nij,nj->ni", factors[chosen], points)
    for b in range(3):
        rows = seen[b].numpy()
        residual = z[b][rows] - points[:, np.array([2, 0])[rows]]
        inner = noise[np.ix_(rows, rows)]
        likelihood = np.exp(-0.5 * (residual @ np.linalg.inv(inner) * residual).sum(1))
        likelihood /= np.sqrt(np.linalg.det(2 * np.pi * inner))
        share = likelihood / likelihood.sum()
        mean = share @ points
        spread = (points - mean).T @ ((points - mean) * share[:, None])
        assert torch.allclose(out.mean[b].double(), tensor(mean), atol=0.05)
        assert torch.allclose(out.cov[b], tensor(spread), atol=0.2)
        assert float(out.log_evidence[b]) == pytest.approx(np.log(likelihood.mean()), abs=0.02)


def test_a_measured_start_keeps_the_particles_that_a_start_from_the_prior_loses():
    prior = mixture([1.0], np.zeros((1, 8)), np.eye(8)[None])
    sizes = {}
    for start in ("prior", "measured"):
        tracker = BootstrapParticleFilter(
            prior, torch.full((8,), 0.01), torch.full((8,), 1e-4), range(8),
            proposal="random-walk", n_particles=2000, start=start,
        )  # fmt: skip
        out = tracker(torch.full((1, 1, 8), 0.5), generator=generator())
        sizes[start] = float(out.effective_sample_size)
    assert sizes["prior"] < 2
    assert sizes["measured"] == pytest.approx(2000, rel=1e-4)


@pytest.mark.parametrize("kind", ["stationary", "ou"])
def test_other_transitions_keep_the_prior_and_track_one_component(kind):
    mean, cov, process, noise, observed, z = linear_problem(seed=3)
    gamma = 0.9 if kind == "ou" else None
    parts = make_transition(
        kind, tensor(mean)[None], tensor(cov)[None], tensor(process),
        None if gamma is None else torch.tensor(gamma, dtype=WIDE),
    )  # fmt: skip
    models = [tuple(p[0].numpy() for p in (parts.matrix, parts.offset, parts.noise))] * len(z)
    exact_mean, _, exact_evidence = causal_posteriors(
        models, mean, cov, observed, noise, z, np.ones(z.shape, dtype=bool)
    )
    options = {"transition": kind, "gamma": gamma, "dtype": WIDE}
    tracker = BootstrapParticleFilter(
        mixture([1.0], mean[None], cov[None]), tensor(process), tensor(noise), observed,
        n_particles=4000, **options,
    )  # fmt: skip
    out = runs_of(tracker, tensor(z))
    assert_within_error(out.mean, exact_mean)
    assert_within_error(out.log_evidence, exact_evidence, slack=2e-3)
    # nothing measured, several components: the particles stay distributed as the prior
    prior = small_mixture(seed=4)
    free = BootstrapParticleFilter(
        prior, torch.full((2,), 0.3), torch.ones(1), [0], n_particles=4000, **options
    )
    nothing = torch.zeros(12, 1, dtype=torch.bool)
    out = runs_of(free, torch.zeros(12, 1), nothing, return_cov=True)
    exact_mean, exact_cov = mixture_moments(prior.weights.log(), prior.means, prior.covariances)
    assert_within_error(out.mean[:, -1], exact_mean)
    assert_within_error(out.cov[:, -1], exact_cov, slack=2e-3)


# --- several components: the truth by numerical integration of (BL 6) over a grid


def grid_filter(prior, process, noise, observed, z, mask, points, scales=None, scaled=True):
    """Filtered means and evidence increments of the model (BL 6), every integral a sum over a grid.

    The transition is the product of random walk and prior, divided by its own sum over the grid, so
    none of (BL 9-14) is used. With `scaled=False` it is not divided.
    """
    phi = prior.log_prob(points).exp()
    belief = phi / phi.sum()
    means, increments = [], []
    for t in range(len(z)):
        factor = safe_cholesky(process if scales is None else process * scales[t])
        walk = log_prob(points[None], points[:, None], factor[None, None]).exp() * phi
        kernel = walk / walk.sum(1, keepdim=True) if scaled else walk
        belief = belief @ kernel
        belief = belief / belief.sum()
        seen = mask[t]
        if seen.any():
            residual = (z[t] - points[:, observed])[:, seen]
            chosen = safe_cholesky(noise[seen][:, seen])
            likelihood = log_prob(residual, torch.zeros_like(residual), chosen[None]).exp()
            increments.append((belief @ likelihood).log())
            belief = belief * likelihood
            belief = belief / belief.sum()
        else:
            increments.append(torch.zeros((), dtype=WIDE))
        means.append(belief @ points)
    return torch.stack(means), torch.stack(increments)


@functools.cache
def exact_posterior(dim):
    return grid_filter(*grid_problem(dim))


def grid_problem(dim):
    rng = np.random.default_rng(5)
    prior = small_mixture(seed=6, dim=dim, spread=1.2)
    n = 500 if dim == 1 else 45
    axis = torch.linspace(-6.5, 6.5, n, dtype=WIDE)
    points = torch.cartesian_prod(*[axis] * dim).reshape(-1, dim)
    process = tensor(random_covariance(rng, dim, 0.6))
    noise = 0.5 * torch.eye(dim, dtype=WIDE)
    z = tensor(rng.standard_normal((6, dim)))
    mask = torch.ones(6, dim, dtype=torch.bool)
    mask[2] = False
    mask[3] = False
    mask[4, 0] = False
    return prior, process, noise, list(range(dim)), z, mask, points


@pytest.mark.slow
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("dim", [1, 2])
def test_mixture_and_scaled_walk_share_the_exact_posterior(dim, dtype):
    prior, process, noise, observed, z, mask, _ = grid_problem(dim)
    exact_mean, exact_evidence = exact_posterior(dim)
    sums = []
    for proposal in EXACT_PROPOSALS:
        tracker = BootstrapParticleFilter(
            prior, process, noise, observed, proposal=proposal, n_particles=4000, dtype=dtype
        )
        out = runs_of(tracker, z, mask)
        assert_within_error(out.mean, exact_mean, slack=1e-3)
        assert_within_error(out.log_evidence, exact_evidence, slack=2e-3)
        sums.append(out.log_evidence.sum(1))
    error = math.hypot(*(float(s.std()) / len(s) ** 0.5 for s in sums))
    assert abs(float(sums[0].mean() - sums[1].mean())) <= 5 * error + 2e-3


def test_unscaled_walk_has_the_posterior_without_the_division():
    *model, points = grid_problem(1)
    prior, process, noise, observed, z, mask = model
    unscaled_mean, _ = grid_filter(*model, points, scaled=False)
    scaled_mean, _ = grid_filter(*model, points)
    tracker = BootstrapParticleFilter(
        prior,
        process,
        noise,
        observed,
        proposal="random-walk-unscaled",
        n_particles=4000,
        dtype=WIDE,
    )
    out = runs_of(tracker, z, mask)
    assert_within_error(out.mean, unscaled_mean, slack=1e-3)
    assert (unscaled_mean - scaled_mean).abs().max() > 0.05, "the test tells the two apart"
    assert out.log_evidence.isnan().all()


@pytest.mark.parametrize("proposal", EXACT_PROPOSALS)
def test_burn_in_with_several_components(proposal):
    *model, points = grid_problem(1)
    prior, process, noise, observed, z, mask = model
    exact_mean, exact_evidence = grid_filter(
        *model, points, scales=[9.0 ** max(0.0, 1 - t / 4) for t in range(len(z))]
    )
    tracker = BootstrapParticleFilter(
        prior, process, noise, observed, proposal=proposal, n_particles=4000,
        burn_in=4, burn_in_scale=9.0, dtype=WIDE,
    )  # fmt: skip
    out = runs_of(tracker, z, mask)
    assert_within_error(out.mean, exact_mean, slack=1e-3)
    assert_within_error(out.log_evidence, exact_evidence, slack=2e-3)


@pytest.mark.parametrize("proposal", EXACT_PROPOSALS)
def test_skipping_the_resampling_changes_nothing_but_the_error(proposal):
    prior, process, noise, observed, z, mask, _ = grid_problem(2)
    outs = [
        runs_of(
            BootstrapParticleFilter(
                prior, process, noise, observed, proposal=proposal, n_particles=2000,
                resample_threshold=threshold, resampling=method, dtype=WIDE,
            ),
            z, mask, seed=seed,
        )
        for seed, (threshold, method) in enumerate(
            [(0.0, "systematic"), (0.3, "stratified"), (1.0, "residual"), (1.0, "multinomial")]
        )
    ]  # fmt: skip
    for quantity in ("mean", "log_evidence"):
        first = getattr(outs[0], quantity)
        for out in outs[1:]:
            other = getattr(out, quantity)
            error = ((first.var(0) + other.var(0)) / len(first)).sqrt()
            assert ((first.mean(0) - other.mean(0)).abs() <= 5 * error + 4e-3).all()


# --- the batch, masks, per-frame noise


def signal(batch, n_frames, n_measured, seed=0):
    return torch.randn(batch, n_frames, n_measured, generator=generator(seed), dtype=WIDE)


@pytest.mark.parametrize("proposal", PROPOSALS)
@pytest.mark.parametrize(
    ("resampling", "start"), [("systematic", "measured"), ("residual", "prior")]
)
def test_an_element_equals_its_own_call(proposal, resampling, start):
    tracker = BootstrapParticleFilter(
        small_mixture(dim=3), torch.full((3,), 0.2), torch.full((2,), 0.3), [0, 2],
        proposal=proposal, n_particles=300, resampling=resampling, burn_in=2, start=start,
        dtype=WIDE,
    )  # fmt: skip
    z = signal(4, 7, 2)
    z[2] *= 30  # degenerates to few particles, so that its neighbours resample at other times
    mask = torch.rand(4, 7, 2, generator=generator(9)) > 0.3
    cov = (0.2 + torch.rand(4, 7, 2, generator=generator(8), dtype=WIDE)).diag_embed()
    lengths = torch.tensor([7, 5, 6, 7])
    out = tracker(
        z, mask, measurement_cov=cov, lengths=lengths, generator=[generator(b) for b in range(4)],
        return_cov=True,
    )  # fmt: skip
    for b in range(4):
        n = int(lengths[b])
        own = tracker(
            z[b : b + 1, :n], mask[b : b + 1, :n], measurement_cov=cov[b : b + 1, :n],
            generator=generator(b), return_cov=True,
        )  # fmt: skip
        for name in ("mean", "log_weights", "log_evidence", "cov"):
            ours, theirs = getattr(out, name)[b, :n], getattr(own, name)[0]
            torch.testing.assert_close(ours, theirs, rtol=1e-10, atol=1e-12, equal_nan=True)


@pytest.mark.parametrize("start", ["prior", "measured"])
@pytest.mark.parametrize("proposal", PROPOSALS)
def test_online_equals_offline(proposal, start):
    tracker = BootstrapParticleFilter(
        small_mixture(dim=2), torch.full((2,), 0.2), torch.ones(1), [1], proposal=proposal,
        n_particles=200, burn_in=3, start=start,
    )  # fmt: skip
    z, mask = signal(3, 6, 1), torch.rand(3, 6, 1, generator=generator(1)) > 0.2
    offline = tracker(z, mask, generator=generator(2), return_cov=True)
    g = generator(2)
    state = tracker.init(3, generator=g)
    for t in range(6):
        state, out = tracker.step(state, z[:, t], mask[:, t], generator=g, return_cov=True)
        assert torch.equal(out.mean, offline.mean[:, t])
        assert torch.equal(out.cov, offline.cov[:, t])
        assert torch.equal(out.log_weights, offline.log_weights[:, t])
    assert state.time == 6
    assert tracker.particles(state).shape == (3, 200, 2)


def test_the_estimate_is_the_weighted_mean_of_the_particles_before_resampling():
    tracker = BootstrapParticleFilter(
        small_mixture(dim=2), torch.full((2,), 0.2), torch.ones(1), [1], n_particles=500, dtype=WIDE
    )
    state, out = tracker.step(tracker.init(2, generator=generator(0)), signal(2, 1, 1)[:, 0])
    particles, weights = tracker.particles(state), state.log_weights.exp()
    torch.testing.assert_close(out.mean, (weights[..., None] * particles).sum(1))
    assert torch.equal(out.log_weights, state.log_weights)
    torch.testing.assert_close(weights.sum(1), torch.ones(2, dtype=WIDE))
    assert isinstance(tracker, RecursiveFilter)


def test_a_masked_value_does_not_matter_and_full_covariances_are_marginalised():
    noise = torch.tensor([[1.0, 0.7], [0.7, 1.0]], dtype=WIDE)
    options = {"n_particles": 400, "dtype": WIDE}
    prior, process = small_mixture(dim=2), torch.full((2,), 0.2)
    both = BootstrapParticleFilter(prior, process, noise, [0, 1], **options)
    first = BootstrapParticleFilter(prior, process, noise[:1, :1], [0], **options)
    z = signal(1, 5, 2)
    mask = torch.ones(1, 5, 2, dtype=torch.bool)
    mask[..., 1] = False
    out = both(z, mask, generator=generator(3))
    wild = both(torch.where(mask, z, torch.nan), mask, generator=generator(3))
    alone = first(z[..., :1], generator=generator(3))
    assert torch.equal(out.mean, wild.mean)
    torch.testing.assert_close(out.mean, alone.mean, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(out.log_evidence, alone.log_evidence, rtol=1e-9, atol=1e-12)


def test_per_frame_covariances_override_the_own_one():
    prior, process = small_mixture(dim=2), torch.full((2,), 0.2)
    z, g = signal(2, 4, 1), generator
    wide = BootstrapParticleFilter(prior, process, 4 * torch.ones(1), [0], n_particles=300)
    narrow = BootstrapParticleFilter(prior, process, torch.ones(1), [0], n_particles=300)
    expected = wide(z, generator=g(1))
    for cov in (torch.full((1, 1), 4.0), torch.full((2, 4, 1, 1), 4.0)):
        out = narrow(z, measurement_cov=cov, generator=g(1))
        torch.testing.assert_close(out.mean, expected.mean)


@pytest.mark.parametrize("proposal", PROPOSALS)
def test_a_degenerate_element_is_reported_and_the_others_finish(proposal):
    tracker = BootstrapParticleFilter(
        small_mixture(dim=2), torch.full((2,), 0.2), torch.ones(1), [0], proposal=proposal,
        n_particles=100,
    )  # fmt: skip
    z = signal(3, 5, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        calm = tracker(z, generator=[generator(b) for b in range(3)])
    z[1, 2] = 1e30  # its square is beyond float32
    with pytest.warns(DegenerateFilterWarning, match="element 1 at frame 2"):
        out = tracker(z, generator=[generator(b) for b in range(3)], return_cov=True)
    assert out.failed_at.tolist() == [-1, 2, -1]
    assert out.mean[1, 2:].isnan().all()
    assert out.mean[1, :2].isfinite().all()
    others = [0, 2]
    torch.testing.assert_close(out.mean[others], calm.mean[others])


def test_many_lost_measurements_keep_the_filter_alive():
    tracker = BootstrapParticleFilter(
        small_mixture(dim=2), torch.full((2,), 0.2), torch.ones(2), [0, 1], n_particles=200
    )
    mask = torch.zeros(1, 40, 2, dtype=torch.bool)
    out = tracker(torch.zeros(1, 40, 2), mask, generator=generator())
    assert out.mean.isfinite().all()
    assert (out.log_evidence == 0).all()
    assert (out.effective_sample_size > 199).all()


# --- densities and moves


def stiff_mixture(seed=0, n_components=6, dim=21):
    """A prior with the scales of an arm: pixels beside metres, smallest eigenvalue about 1e-6."""
    rng = np.random.default_rng(seed)
    scale = np.concatenate([np.tile([120.0, 90.0, 0.4], 5), np.full(3, 0.1), np.full(3, 0.2)])
    low = rng.standard_normal((n_components, dim, 8))
    covs = low @ low.transpose(0, 2, 1) / 8 + 1e-4 * np.eye(dim)
    covs = covs * scale[:, None] * scale * 0.1
    centre = np.concatenate([np.tile([320.0, 240.0, 2.0], 5), np.zeros(3), [0.0, 0.0, 2.0]])
    means = centre + rng.standard_normal((n_components, dim)) * scale
    return mixture(rng.dirichlet(np.full(n_components, 3.0)), means, covs)


ARM_PROCESS = tensor([560, 560, 1] + [56, 56, 1] + [25, 25, 1] * 3 + [0.5] * 3 + [0.01] * 3)


def exact_densities(prior, process_cov, x):
    """log Phi and log sum_i pi_i c_i by torch.distributions, in float64 and in the state's units."""
    out = []
    for extra in (torch.zeros_like(process_cov), process_cov):
        parts = [
            torch.distributions.MultivariateNormal(m, c + extra).log_prob(x)
            for m, c in zip(prior.means, prior.covariances, strict=True)
        ]
        out.append((torch.stack(parts, -1) + prior.weights.log()).logsumexp(-1))
    return out


def check_densities(prior, process_cov, dtype, tolerance):
    """Draws of the prior to `tolerance`; points far off it, as a step leaves them, in proportion."""
    walk = MixtureWalk(prior.parameters_tuple(), process_cov, dtype)
    x = prior.sample((600,), generator=generator())
    step = torch.randn(600, prior.dim, generator=generator(1), dtype=WIDE) @ process_cov.sqrt()
    x = torch.cat([x, x + 0.02 * step])
    white = walk.whiten(x)
    jacobian = walk.scale.diagonal().log().sum()
    for inflation in (1.0, 25.0):
        log_densities = walk.log_prior_and_evidence(white[None], inflation)
        exact = exact_densities(prior, inflation * process_cov, walk.unwhiten(white))
        for ours, theirs in zip(log_densities, exact, strict=True):
            error = (ours[0] - jacobian - theirs).abs()
            assert error[:600].max() < tolerance
            assert (error / (1 + theirs.abs() / 100)).max() < tolerance
    torch.testing.assert_close(
        walk.log_prior(white), log_densities[0][0], rtol=1e-6, atol=tolerance
    )


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 5e-3), (WIDE, 1e-7)])
def test_densities_of_stiff_priors(dtype, tolerance):
    check_densities(stiff_mixture(), torch.diag(ARM_PROCESS), dtype, tolerance)


@pytest.mark.data
@pytest.mark.parametrize("side", ["left", "right"])
def test_densities_of_the_released_prior(side):
    with np.load(data_dir_or_skip("signer") / "released_prior_Training20_02.npz") as file:
        weights, means, covs = (
            tensor(file[f"{side}_{key}"]) for key in ("weights", "means", "covariances")
        )
    prior = GaussianMixture(weights.reshape(-1) / weights.sum(), means, (covs + covs.mT) / 2)
    check_densities(prior, torch.diag(ARM_PROCESS), torch.float32, 5e-3)


def test_components_are_chosen_by_their_probability():
    prior = small_mixture(n_components=4, dim=2)
    process = 0.3 * torch.eye(2, dtype=WIDE)
    walk = MixtureWalk(prior.parameters_tuple(), process, WIDE)
    x = torch.tensor([[0.3, -0.2], [-1.0, 1.0]], dtype=WIDE)
    for inflation in (0.0, 1.0, 4.0):
        parts = [
            torch.distributions.MultivariateNormal(m, c + inflation * process).log_prob(x)
            for m, c in zip(prior.means, prior.covariances, strict=True)
        ]
        expected = (torch.stack(parts, -1) + prior.weights.log()).softmax(-1)
        # equidistant numbers instead of random ones: shares are exact up to 1 / n
        n = 4000
        u = ((torch.arange(n, dtype=WIDE) + 0.5) / n).expand(2, n)
        chosen = walk.choose(walk.whiten(x)[:, None].expand(2, n, 2).contiguous(), u, inflation)
        share = torch.nn.functional.one_hot(chosen, 4).double().mean(1)
        torch.testing.assert_close(share, expected, rtol=0, atol=1.5 / n)


def test_moves_are_the_component_conditionals():
    prior = small_mixture(n_components=2, dim=3)
    process = tensor(random_covariance(np.random.default_rng(3), 3, 0.5))
    walk = MixtureWalk(prior.parameters_tuple(), process, WIDE)
    moves = walk.moves(*make_transition("paper", prior.means, prior.covariances, process))
    x = torch.randn(5, 3, generator=generator(), dtype=WIDE)
    for k in range(2):
        matrix, offset, noise = paper_transition(
            prior.means[k].numpy(), prior.covariances[k].numpy(), process.numpy()
        )
        white = walk.whiten(x) @ moves.matrix[k, :3] + moves.offset[k]
        expected = x @ tensor(matrix).mT + tensor(offset)
        torch.testing.assert_close(walk.unwhiten(white), expected, rtol=1e-9, atol=1e-9)
        factor = moves.matrix[k, 3:] @ walk.scale.mT
        torch.testing.assert_close(factor.mT @ factor, tensor(noise), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("counts", [[1], [0, 70, 0], [33, 1, 0, 500, 31, 32]])
def test_grouped_affine_equals_a_gather(counts):
    group = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))
    group = group[torch.randperm(len(group), generator=generator())]
    x = torch.randn(len(group), 4, generator=generator(1), dtype=WIDE)
    moves = Moves(
        torch.randn(len(counts), 4, 3, generator=generator(2), dtype=WIDE),
        torch.randn(len(counts), 3, generator=generator(3), dtype=WIDE),
    )
    expected = (x[:, None] @ moves.matrix[group])[:, 0] + moves.offset[group]
    torch.testing.assert_close(grouped_affine(x, group, moves), expected)


# --- arguments


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"proposal": "optimal"}, "proposal must be one of mixture"),
        ({"resampling": "wheel"}, "resampling must be one of systematic"),
        ({"start": "guess"}, "start must be one of prior, measured"),
        ({"n_particles": 0}, "n_particles"),
        ({"resample_threshold": 1.5}, "resample_threshold"),
        ({"dtype": torch.float16}, "dtype"),
        ({"burn_in": -1}, "burn_in"),
        ({"burn_in": 3, "burn_in_scale": 0.0}, "burn_in"),
        ({"transition": "brownian"}, "transition must be one of"),
        ({"transition": "ou"}, "gamma"),
        ({"transition": "ou", "gamma": 0.9, "burn_in": 3}, "burn_in"),
        ({"transition": "stationary", "proposal": "random-walk"}, "paper"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        BootstrapParticleFilter(small_mixture(), torch.ones(2), torch.ones(1), [0], **options)


def test_bad_covariances_and_batches_are_refused():
    prior = small_mixture()
    with pytest.raises(CovarianceError, match="process_cov"):
        BootstrapParticleFilter(prior, -torch.ones(2), torch.ones(1), [0])
    with pytest.raises(ShapeError, match="initial_cov"):
        BootstrapParticleFilter(
            prior, torch.ones(2), torch.ones(1), [0], initial_cov=torch.eye(2).expand(5, 2, 2)
        )
    tracker = BootstrapParticleFilter(prior, torch.ones(2), torch.ones(1), [0], n_particles=10)
    for size in (0, 1.5, True):
        with pytest.raises(InputError, match="batch_size must be"):
            tracker.init(size)
    with pytest.raises(InputError, match=r"torch\.Generator\(\)\.manual_seed"):
        tracker.init(1, generator=0)


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("proposal", PROPOSALS)
def test_on_cuda(proposal):
    *model, points = grid_problem(1)
    prior, process, noise, observed, z, mask = model
    tracker = BootstrapParticleFilter(
        prior, process, noise, observed, proposal=proposal, n_particles=4000, burn_in=0
    ).to("cuda")
    g = torch.Generator("cuda").manual_seed(0)
    out = tracker(z.expand(48, -1, -1), mask.expand(48, -1, -1), generator=g, return_cov=True)
    scaled = proposal != "random-walk-unscaled"
    exact_mean, _ = grid_filter(*model, points, scaled=scaled)
    assert out.mean.is_cuda
    assert_within_error(out.mean.cpu(), exact_mean, slack=1e-3)
