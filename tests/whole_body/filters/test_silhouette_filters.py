"""Filters over poses against exact answers: linear bodies, Gaussian likelihoods, linear manifolds."""

import math

import pytest
import torch

from tests.draws import generator
from tests.filters.linear_poses import (
    BoxLimits,
    LinearBody,
    LinearManifold,
    assert_within_error,
    condition_on,
    dense_gaussian,
    gaussian_likelihood,
)
from torchpose.errors import DegenerateFilterWarning, InputError, PriorError, ShapeError
from torchpose.whole_body import (
    AnnealedParticleFilter,
    BodyFilterOutput,
    ManifoldParticleFilter,
    SIRParticleFilter,
    default_step_std,
    fit_sharpness,
    motion_std,
    reweight,
    track_body,
)
from torchpose.whole_body._filters.annealed import anneal
from torchpose.whole_body._filters.body_particles import resample_state
from torchpose.whole_body._filters.manifold_regularised import MANIFOLD_PROPOSALS, MANIFOLD_WEIGHTS
from torchpose.whole_body._sharpness import ValidationSequence, log_grid, mean_joint_error

WIDE = torch.float64
RUNS = 48


def tensor(values):
    return torch.tensor(values, dtype=WIDE)


def generators(count, first=0):
    return [generator(first + i) for i in range(count)]


# --- a linear problem and its exact answer

H = tensor([[1.0, 0.0, 0.5], [0.0, 1.0, -1.0]])
R = tensor([[0.3, 0.1], [0.1, 0.4]])
STEP = tensor([0.3, 0.5, 0.4])
START, START_STD = tensor([0.2, -0.1, 0.4]), tensor([0.5, 0.4, 0.6])


def observations(n_frames=6, seed=1, missing=(3,)):
    z = torch.randn(n_frames, 2, generator=generator(seed), dtype=WIDE)
    z[list(missing)] = math.nan
    return z


def kalman(z, noise=R):
    """Filtered means, standard deviations and evidence of a random walk."""
    mean, cov, out = START, torch.diag(START_STD**2), []
    for one in z:
        mean, cov, evidence = condition_on(mean, cov + torch.diag(STEP**2), H, noise, one)
        out.append((mean, cov.diagonal().sqrt(), evidence))
    return [torch.stack(part) for part in zip(*out, strict=True)]


def run(tracker, z, runs=RUNS, seed=0, initial_cov=START_STD**2):
    """The same sequence filtered `runs` times, as a batch."""
    frames = z.expand(runs, *z.shape)
    return tracker(
        frames, None, START.expand(runs, -1), generator=generator(seed), initial_cov=initial_cov
    )


def sir(n=3000, **options):
    options = {"process_cov": STEP**2, "likelihood": gaussian_likelihood(H, R), **options}
    return SIRParticleFilter(LinearBody(3), n, **options)


@pytest.mark.parametrize("threshold", [1.0, 0.5, 0.0])
def test_sir_agrees_with_the_exact_filter(threshold):
    z = observations()
    mean, std, evidence = kalman(z)
    out = run(sir(resample_threshold=threshold), z)
    assert_within_error(out.mean, mean)
    assert_within_error(out.std, std, slack=3e-3)
    assert_within_error(out.log_evidence, evidence, slack=2e-3)
    assert_within_error(out.log_evidence.sum(1).sub(evidence.sum()).exp(), 1.0, slack=2e-3)
    coasting = torch.tensor([False, False, False, True, False, False])
    assert (out.coasting == coasting).all()
    assert (out.log_evidence[:, 3] == 0).all()
    assert not out.respread.any()
    assert (out.std[:, 3] > out.std[:, 2]).all()


def test_sharpness_is_an_exponent_of_the_likelihood():
    z = observations()
    # N(z | Hx, R)^4 is N(z | Hx, R / 4) up to a constant
    mean, std, _ = kalman(z, R / 4)
    out = run(sir(sharpness=4.0), z)
    assert_within_error(out.mean, mean)
    assert_within_error(out.std, std, slack=3e-3)


def test_first_weights_are_normalised():
    log_weights = sir(20).init(START[None]).log_weights
    assert float(log_weights.logsumexp(-1)) == pytest.approx(0.0, abs=1e-15)


def test_particles_of_equal_weights_are_left_as_they_are():
    for n in range(2, 40):
        state = sir(n).init(START[None], initial_cov=1.0, generator=generator(0))
        for start in (state, state._replace(log_weights=state.log_weights.exp().log())):
            after, _ = resample_state(start, "multinomial", 1.0, generator(1))
            assert torch.equal(after.particles, state.particles), n


def test_the_map_estimate_is_the_particle_of_the_largest_weight():
    z, tracker = observations(1, missing=()), sir(50, estimate="map")
    state = tracker.init(START[None])
    state, out = tracker.step(state, z[:1], None, generator=generator(3))
    assert (out.mean[0] == state.particles[0, state.log_weights[0].argmax()]).all()


def test_sir_with_a_survival_rate_keeps_that_share():
    z = observations(4, missing=(2,))
    out = run(sir(survival_rate=0.93, resample_threshold=1.0), z, runs=3)
    share = out.effective_sample_size / 3000
    torch.testing.assert_close(share[:, [0, 1, 3]], torch.full((3, 3), 0.93, dtype=WIDE))
    assert out.log_evidence[:, [0, 1, 3]].isnan().all()
    assert (out.log_evidence[:, 2] == 0).all()
    sharp = run(sir(survival_rate=0.93, sharpness=20.0), z, runs=3)
    torch.testing.assert_close(sharp.mean, out.mean)


# --- batches, streams, types


def filters():
    manifold = linear_manifold()
    options = {"process_cov": STEP**2, "likelihood": gaussian_likelihood(H, R)}
    body = LinearBody(3, n_root=1)
    return {
        "sir": SIRParticleFilter(body, 40, **options),
        "annealed": AnnealedParticleFilter(body, 20, n_layers=3, **options),
        "published": ManifoldParticleFilter(
            body, manifold, 40, weights="published", proposal="diffusion", **options
        ),
        "product": ManifoldParticleFilter(
            body, manifold, 40, weights="normalised", proposal="product", **options
        ),
    }


def linear_manifold(columns=2, std_pose=(0.6, 0.7), std_latent=(0.5,)):
    return LinearManifold(
        A=tensor([[0.7, -0.4]]), a=tensor([0.1]), W=tensor([[0.8], [0.5]]), b=tensor([-0.2, 0.3]),
        std_latent=tensor(std_latent), std_pose=tensor(std_pose), std_step=STEP[-columns:],
    )  # fmt: skip


@pytest.mark.parametrize("name", ["sir", "annealed", "published", "product"])
def test_steps_are_the_run_and_elements_are_independent(name):
    tracker = filters()[name]
    z = torch.stack([observations(seed=s, missing=m) for s, m in ((1, ()), (2, (0, 4)), (3, (1,)))])
    start = START + torch.arange(3, dtype=WIDE)[:, None] / 10
    out = tracker(z, None, start, generator=generators(3))
    assert out.mean.shape == (3, 6, 3) and out.coasting.shape == (3, 6)
    state, streams = tracker.init(start), generators(3)
    for t in range(6):
        state, one = tracker.step(state, z[:, t], None, generator=streams)
        assert not out.details and not one.details
        for whole, part in zip(out[:-1], one[:-1], strict=True):
            torch.testing.assert_close(whole[:, t], part, rtol=0, atol=0, equal_nan=True)
    state, streams = tracker.init(start), generators(3)
    for frames in (slice(0, 2), slice(2, 6)):
        state, some = tracker.advance(state, z[:, frames], None, generator=streams)
        for whole, part in zip(out[:-1], some[:-1], strict=True):
            torch.testing.assert_close(whole[:, frames], part, rtol=0, atol=0, equal_nan=True)
    with pytest.raises(ShapeError, match="one frame or more for each of the 3"):
        tracker.advance(state, z[:, :0], None, generator=streams)
    with pytest.raises(InputError, match="must hold 3, one for each sequence"):
        tracker.advance(state, z, None, generator=streams[:2])
    alone = tracker(z[1], None, start[1], generator=generator(1))
    assert alone.mean.shape == (6, 3)
    for whole, part in zip(out[:-1], alone[:-1], strict=True):
        torch.testing.assert_close(whole[1], part, equal_nan=True)


@pytest.mark.parametrize("name", ["sir", "annealed", "published", "product"])
def test_single_precision(name):
    tracker = filters()[name].float()
    likelihood = tracker.likelihood
    tracker.likelihood = lambda states, frame: likelihood(states.double(), frame)
    out = tracker(observations(), None, START, generator=generator())
    assert out.mean.dtype == torch.float32 and out.log_evidence.dtype == WIDE
    assert out.mean.isfinite().all()


# --- failure


def killing(frames, value=-math.inf):
    """A likelihood that lets no particle live where the observation is above 100."""
    normal = gaussian_likelihood(H, R)

    def log_likelihood(states, frame):
        alive = normal(states, frame.clamp_max(5.0))
        return torch.where(frame[:, :1] > 100, value, alive)

    z = observations(missing=())
    z[list(frames)] = 1000.0
    return log_likelihood, z


@pytest.mark.parametrize("value", [-math.inf, math.nan])
@pytest.mark.parametrize("kind", ["sir", "annealed", "manifold"])
def test_particles_that_all_die_are_spread_about_the_last_mean(kind, value):
    likelihood, z = killing([2, 3], value)
    options = {"process_cov": STEP**2, "likelihood": likelihood, "respread_scale": 4.0}
    body = LinearBody(3, n_root=1)
    tracker = {
        "sir": lambda: SIRParticleFilter(body, 4000, **options),
        "annealed": lambda: AnnealedParticleFilter(body, 4000, n_layers=2, **options),
        "manifold": lambda: ManifoldParticleFilter(body, linear_manifold(), 4000, **options),
    }[kind]()
    healthy = observations(missing=())
    both, starts = torch.stack([healthy, z]), START.expand(2, -1)
    with pytest.warns(DegenerateFilterWarning, match=r"2 times \(element 1 at frame 2, element 1"):
        out = tracker(both, None, starts, generator=generators(2))
    expected = torch.zeros(2, 6, dtype=torch.bool)
    expected[1, 2:4] = True
    assert (out.respread == expected).all()
    assert (out.mean[1, 2] == out.mean[1, 1]).all() and (out.mean[1, 3] == out.mean[1, 1]).all()
    # about the mean of frame 1, with 4 and then 8 times the noise; then it finds the person again
    torch.testing.assert_close(out.std[1, 2], 4 * STEP, rtol=0.05, atol=0)
    torch.testing.assert_close(out.std[1, 3], 8 * STEP, rtol=0.05, atol=0)
    assert (out.std[1, 4] < 8 * STEP).all()
    assert out.mean.isfinite().all()
    if kind == "annealed":
        assert out.log_evidence.isnan().all()
    else:
        assert (out.log_evidence[1, 2:4] == -math.inf).all()
        assert out.log_evidence[0].isfinite().all()
    # the other element saw nothing of it
    torch.testing.assert_close(
        out.mean[0], tracker(healthy, None, START, generator=generator(0)).mean
    )
    assert out.effective_sample_size[1, 2:4] == pytest.approx(4000)


def test_a_step_warns_as_well():
    likelihood, z = killing([0])
    tracker = sir(10, likelihood=likelihood)
    with pytest.warns(DegenerateFilterWarning, match="1 times"):
        tracker.step(tracker.init(START[None]), z[:1], None, generator=generator())


# --- limits


def test_limits_clamp_or_discard():
    z = observations(missing=())
    clamped = sir(500, limits=BoxLimits(0.4))
    state, out = clamped.step(clamped.init(START[None]), z[:1], None, generator=generator())
    assert (state.particles.abs() <= 0.4).all() and state.particles.abs().max() == 0.4
    discarding = sir(4000, limits=BoxLimits(0.4), limit_mode="discard")
    state, out = discarding.step(discarding.init(START[None]), z[:1], None, generator=generator())
    inside = (state.particles.abs() <= 0.4).all(-1)
    assert inside.any() and not inside.all()
    assert (state.log_weights[~inside] == -math.inf).all()
    # the evidence is that of the truncated prediction, by plain Monte Carlo
    x = START + STEP * torch.randn(400_000, 3, generator=generator(5), dtype=WIDE)
    x = x[(x.abs() <= 0.4).all(-1)]
    exact = gaussian_likelihood(H, R)(x[None], z[:1]).exp().mean().log()
    assert float(out.log_evidence) == pytest.approx(float(exact), abs=0.05)
    with pytest.warns(DegenerateFilterWarning):
        nothing = sir(10, limits=BoxLimits(-1.0), limit_mode="discard")
        nothing(z, None, START, generator=generator())


# --- the annealed filter


def test_every_layer_has_its_survival_rate():
    score = lambda x: -3.0 * (x - 0.7).square().sum(-1)  # noqa: E731
    particles = torch.randn(3, 400, 2, generator=generator(), dtype=WIDE)
    scales = []

    def diffuse(states, layer):
        scales.append(layer)
        noise = torch.randn(states.shape, generator=generator(layer), dtype=WIDE)
        return states + noise * 0.3 * 0.5 ** (layer / 2)

    out = anneal(particles, score, diffuse, 5, 0.4, generator=generator())
    assert scales == [0, 1, 2, 3, 4]
    torch.testing.assert_close(out.survival, torch.full((3, 5), 0.4, dtype=WIDE))
    assert (out.exponents.diff(dim=1) > 0).all()  # from broad to narrow
    share = 1 / (400 * (2 * out.log_weights).exp().sum(-1))
    torch.testing.assert_close(share, out.survival[:, -1])
    mean = LinearBody(2).mean(out.particles, out.log_weights)
    assert (mean - 0.7).abs().max() < 0.1


def test_the_noise_of_a_layer_shrinks_with_the_survival_rate():
    flat = lambda states, frame: torch.zeros(states.shape[:2], dtype=WIDE)  # noqa: E731
    tracker = AnnealedParticleFilter(
        LinearBody(3), 20_000, n_layers=4, survival_rate=0.5, process_cov=STEP**2, likelihood=flat
    )
    z = observations(2, missing=(1,))
    out = tracker(z, None, START, generator=generator())
    total = (1 + 0.5 + 0.25 + 0.125) ** 0.5
    torch.testing.assert_close(out.std[0], total * STEP, rtol=0.03, atol=0)
    # what nobody sees moves once
    torch.testing.assert_close(out.std[1], (total**2 + 1) ** 0.5 * STEP, rtol=0.03, atol=0)
    assert out.log_evidence[0].isnan() and out.log_evidence[1] == 0
    assert out.coasting.tolist() == [False, True]


def test_the_estimate_is_that_of_the_last_layer():
    z = observations(1, missing=())
    tracker = AnnealedParticleFilter(
        LinearBody(3), 200, process_cov=STEP**2, likelihood=gaussian_likelihood(H, R)
    )
    state, out = tracker.step(tracker.init(START[None]), z, None, generator=generator(4))
    expected = torch.einsum("bn,bnd->bd", state.log_weights.exp(), state.particles)
    torch.testing.assert_close(out.mean, expected)
    assert float(out.effective_sample_size) == pytest.approx(100)


def test_one_layer_of_exponent_one_is_sir():
    z = observations()
    options = {"process_cov": STEP**2, "likelihood": gaussian_likelihood(H, R)}
    one = AnnealedParticleFilter(LinearBody(3), 300, n_layers=1, schedule=[1.0], **options)
    expected = run(sir(300), z, runs=2)
    found = run(one, z, runs=2)
    torch.testing.assert_close(found.mean, expected.mean)
    torch.testing.assert_close(found.std, expected.std)


def test_annealing_finds_a_narrow_peak_that_sir_misses():
    """A peak two orders of magnitude narrower than the diffusion, in four dimensions."""
    peak = tensor([0.9, -0.8, 1.1, 0.7])
    likelihood = lambda x, frame: -0.5 * ((x - peak) / 0.02).square().sum(-1)  # noqa: E731
    frames, start = torch.ones(12, 1, 1, dtype=WIDE), torch.zeros(12, 4, dtype=WIDE)
    options = {"process_cov": 1.0, "likelihood": likelihood}
    annealed = AnnealedParticleFilter(LinearBody(4), 100, n_layers=10, **options)
    plain = SIRParticleFilter(LinearBody(4), 1000, **options)
    near = (annealed(frames, None, start, generator=generator()).mean - peak).norm(dim=-1)
    far = (plain(frames, None, start, generator=generator()).mean - peak).norm(dim=-1)
    assert near.mean() < 0.5 * far.mean()


# --- the manifold filter


def manifold_filter(z, manifold, weights):
    """Exact means, standard deviations and evidence, from the dense joint of x_t-1, z and x_t."""
    n_root = 1
    eye, none = torch.eye(3, dtype=WIDE), torch.zeros(3, 3, dtype=WIDE)
    pick = eye[n_root:]  # the columns that the manifold covers
    mean, cov, out = START, torch.diag(START_STD**2), []
    pose, step = manifold.std_pose**2, STEP[n_root:] ** 2
    zero = torch.zeros(3, 1, dtype=WIDE)
    for one in z:
        before, latent, after = 0, 3, 4

        def rows(block, size, place):
            J = torch.zeros(size, 7, dtype=WIDE)
            J[:, place : place + block.shape[1]] += block
            return J

        factors = [
            (rows(eye, 3, before), mean, torch.linalg.inv(cov), 1),
            (
                rows(torch.eye(1, dtype=WIDE), 1, latent) - rows(manifold.A @ pick, 1, before),
                manifold.a, torch.diag(manifold.std_latent**-2), 1,
            ),
            (torch.cat([-eye, zero, eye], 1), none[0], torch.diag(STEP**-2), 1),
            (
                rows(pick, 2, after) - rows(manifold.W, 2, latent),
                manifold.b, torch.diag(1 / pose), 1,
            ),
        ]  # fmt: skip
        if weights == "normalised" or bool(torch.isnan(one).any()):  # coasting is normalised
            J = rows(pick, 2, before) - rows(manifold.W, 2, latent)
            factors.append((J, manifold.b, torch.diag(1 / (pose + step)), -1))
        joint_mean, joint_cov = dense_gaussian(factors, 7)
        mean, cov, evidence = condition_on(joint_mean[4:], joint_cov[4:, 4:], H, R, one)
        out.append((mean, cov.diagonal().sqrt(), evidence))
    return [torch.stack(part) for part in zip(*out, strict=True)]


@pytest.mark.slow
@pytest.mark.parametrize("proposal", MANIFOLD_PROPOSALS)
@pytest.mark.parametrize("weights", MANIFOLD_WEIGHTS)
def test_the_manifold_filter_agrees_with_the_exact_posterior(weights, proposal):
    manifold, z = linear_manifold(), observations()
    mean, std, evidence = manifold_filter(z, manifold, weights)
    tracker = ManifoldParticleFilter(
        LinearBody(3, n_root=1), manifold, 6000, weights=weights, proposal=proposal,
        process_cov=STEP**2, likelihood=gaussian_likelihood(H, R),
    )  # fmt: skip
    out = run(tracker, z)
    assert_within_error(out.mean, mean, slack=1e-3)
    assert_within_error(out.std, std, slack=5e-3)
    assert_within_error(out.log_evidence, evidence, slack=3e-3)
    assert out.coasting[:, 3].all() and (out.log_evidence[:, 3] == 0).all()


def test_the_two_weights_differ_and_the_product_wastes_fewer_particles():
    manifold, z = linear_manifold(std_pose=(0.15, 0.15)), observations(missing=())
    exact = {w: manifold_filter(z, manifold, w)[0] for w in MANIFOLD_WEIGHTS}
    assert (exact["published"] - exact["normalised"]).abs().max() > 0.01
    sizes = {}
    for proposal in MANIFOLD_PROPOSALS:
        tracker = ManifoldParticleFilter(
            LinearBody(3, n_root=1), manifold, 500, weights="normalised", proposal=proposal,
            process_cov=STEP**2, likelihood=gaussian_likelihood(H, R),
        )  # fmt: skip
        sizes[proposal] = float(run(tracker, z, runs=8).effective_sample_size.mean())
    assert sizes["product"] > 1.3 * sizes["diffusion"]


@pytest.mark.parametrize("weights", MANIFOLD_WEIGHTS)
def test_how_far_particles_stray_without_evidence(weights):
    """One column, a manifold of one pose: the published weights confine to about sqrt(s_xx s_zx)."""
    q, s = 0.1**2, 0.6**2
    point = LinearManifold(
        torch.zeros(1, 1, dtype=WIDE), tensor([0.0]), torch.zeros(1, 1, dtype=WIDE), tensor([0.0]),
        tensor([0.0]), tensor([0.6]), tensor([0.1]),
    )  # fmt: skip
    flat = lambda states, frame: torch.zeros(states.shape[:2], dtype=WIDE)  # noqa: E731
    tracker = ManifoldParticleFilter(
        LinearBody(1), point, 4000, weights=weights, process_cov=0.1**2, likelihood=flat
    )
    out = tracker(torch.ones(150, 1), None, tensor([0.0]), generator=generator())
    if weights == "published":  # P = (1 / (P + q) + 1 / s)^-1
        exact = (-q + (q * q + 4 * q * s) ** 0.5) / 2
    else:  # x <- (1 - k) x + N(0, k s), k = q / (q + s)
        k = q / (q + s)
        exact = k * s / (1 - (1 - k) ** 2)
    assert float(out.std[100:].square().mean()) == pytest.approx(exact, rel=0.1)


def test_the_default_diffusion_is_the_manifolds():
    tracker = ManifoldParticleFilter(LinearBody(9, n_root=6), six_root_manifold())
    assert tracker.n_particles == 500
    assert (tracker.step_std[6:] == six_root_manifold().std_step).all()
    assert (tracker.step_std[:6] == default_step_std(LinearBody(9))[:6]).all()


def six_root_manifold(**changes):
    manifold = LinearManifold(
        torch.zeros(1, 3, dtype=WIDE), tensor([0.0]), torch.zeros(3, 1, dtype=WIDE),
        tensor([0.0] * 3), tensor([0.1]), tensor([0.2] * 3), tensor([0.07] * 3),
    )  # fmt: skip
    for name, value in changes.items():
        setattr(manifold, name, value)
    return manifold


def test_columns_that_never_move_do_no_harm():
    """The twist of a limb does not vary in recorded states: all its standard deviations are zero."""
    still = six_root_manifold(std_pose=tensor([0.2, 0.0, 0.2]), std_step=tensor([0.07, 0.0, 0.07]))
    flat = lambda states, frame: torch.zeros(states.shape[:2], dtype=WIDE)  # noqa: E731
    for weights in MANIFOLD_WEIGHTS:
        for proposal in MANIFOLD_PROPOSALS:
            tracker = ManifoldParticleFilter(
                LinearBody(9, n_root=6), still, 50, weights=weights, proposal=proposal,
                likelihood=flat,
            )  # fmt: skip
            out = tracker(torch.ones(3, 1), None, torch.zeros(9, dtype=WIDE), generator=generator())
            assert out.mean.isfinite().all()
            assert (out.std[:, 7] == 0).all() and (out.std[:, 6] > 0).all()


def test_what_the_manifold_filter_refuses():
    body = LinearBody(9, n_root=6)
    with pytest.raises(InputError, match="weights must be one of published, normalised"):
        ManifoldParticleFilter(body, six_root_manifold(), weights="exact")
    with pytest.raises(InputError, match="proposal must be one of"):
        ManifoldParticleFilter(body, six_root_manifold(), proposal="exact")
    with pytest.raises(InputError, match=r"manifold must be a Back.* got str"):
        ManifoldParticleFilter(body, "walk")
    with pytest.raises(PriorError, match="fit_gplvm_noise"):
        ManifoldParticleFilter(body, six_root_manifold(std_pose=tensor([math.nan] * 3)))
    with pytest.raises(ShapeError, match="std_pose"):
        ManifoldParticleFilter(body, six_root_manifold(std_pose=tensor([0.1])))

    def refuse(body, fps):
        raise PriorError("of another skeleton")

    with pytest.raises(PriorError, match="another skeleton"):
        ManifoldParticleFilter(body, six_root_manifold(check_for=refuse))


# --- sharpness and noise


def walk_sequence(seed):
    """A random walk observed through H, once per frame."""
    g = generator(seed)
    states = START + (STEP * torch.randn(40, 3, generator=g, dtype=WIDE)).cumsum(0)
    noise = torch.randn(40, 2, generator=g, dtype=WIDE) @ torch.linalg.cholesky(R).mT
    return ValidationSequence(states @ H.T + noise, None, states, initial_state=START)


def test_the_sharpness_that_makes_the_likelihood_right_is_chosen():
    blunt = gaussian_likelihood(H, 30 * R)
    found = fit_sharpness(
        lambda sharpness: sir(300, likelihood=blunt, sharpness=sharpness),
        [walk_sequence(1), walk_sequence(2)],
        values=[0.5, 30.0, 3000.0],
    )
    assert found.sharpness == 30
    assert found.tried == (0.5, 30.0, 3000.0) and len(found.errors) == 3
    assert min(found.errors) == found.errors[1]


def test_the_budget_is_a_grid_and_every_value_sees_the_same_numbers():
    made = []

    def make(sharpness):
        made.append(sharpness)
        return sir(20, sharpness=1.0)

    found = fit_sharpness(make, [walk_sequence(1)], n_values=4, seeds=1)
    assert made == pytest.approx([1, 10, 100, 1000])
    assert len(set(found.errors)) == 1
    assert log_grid(2, 8, 1) == (4,)
    joints_only = walk_sequence(1)._replace(states=None)
    with pytest.raises(InputError, match="true states"):
        fit_sharpness(make, [joints_only], n_values=1)
    with pytest.raises(InputError, match="at least one sequence"):
        fit_sharpness(make, [])
    unknown = walk_sequence(1)._replace(joints=torch.full((40, 1, 3), math.nan))
    with pytest.raises(ShapeError, match=r"of a validation sequence must have shape .40, any"):
        fit_sharpness(make, [unknown._replace(joints=torch.zeros(1, 1, 3))], n_values=1)
    with pytest.raises(InputError, match="no value has a finite error"):
        fit_sharpness(make, [unknown], n_values=2, seeds=1)
    with pytest.raises(InputError, match="0 < low"):
        log_grid(0, 1, 3)


def test_the_error_is_the_mean_distance_of_the_joints():
    estimate, truth = torch.zeros(2, 4, 3, dtype=WIDE), torch.zeros(4, 3, 3, dtype=WIDE)
    truth[:, 0] = tensor([3.0, 4.0, 0.0])
    assert mean_joint_error(LinearBody(3), estimate, truth).tolist() == pytest.approx([5 / 3] * 2)
    truth[:, 1] = math.nan
    assert mean_joint_error(LinearBody(3), estimate, truth).tolist() == pytest.approx([2.5] * 2)


def test_motion_std_is_the_change_from_frame_to_frame():
    states = tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0]])
    torch.testing.assert_close(
        motion_std(LinearBody(2), states), tensor([0.5, 2.0]) ** 0.5 * tensor([1.0, 1.0])
    )
    gap = torch.cat([states, torch.full((1, 2), math.nan), 50 + states])
    torch.testing.assert_close(
        motion_std(LinearBody(2), [gap, states[:1]]), motion_std(LinearBody(2), states)
    )
    assert motion_std(LinearBody(2), torch.zeros(3, 2), floor=0.1).tolist() == pytest.approx(
        [0.1] * 2
    )
    for none in (states[:1], []):
        with pytest.raises(InputError, match="follow each other"):
            motion_std(LinearBody(2), none)
    with pytest.raises(InputError, match="states must be a tensor, got ndarray"):
        motion_std(LinearBody(2), states.numpy())


# --- bad input


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_particles": 0}, "n_particles"),
        ({"likelihood": "chamfer"}, "likelihood must be one of bidirectional, overlap"),
        ({"sharpness": 0.0}, "sharpness"),
        ({"sharpness": math.inf}, "sharpness"),
        ({"resampling": "none"}, "resampling must be one of"),
        ({"resample_threshold": 1.5}, "resample_threshold"),
        ({"resample_threshold": "1"}, "resample_threshold"),
        ({"limits": 0.4}, "limits must be a torchpose.body.JointLimits.* clamp, got float"),
        ({"limits": 0.4, "limit_mode": "discard"}, "its method inside, got float"),
        ({"estimate": "mode"}, "estimate must be one of"),
        ({"limit_mode": "reflect"}, "limit_mode must be one of"),
        ({"process_cov": tensor([1.0, -1.0, 1.0])}, "must not be negative"),
        ({"process_cov": tensor([1.0, 1.0])}, "process_cov must have shape"),
        ({"process_cov": math.nan}, "finite"),
        ({"respread_scale": -1.0}, "respread_scale"),
        ({"survival_rate": 1.0}, "survival_rate"),
    ],
)
def test_options_that_are_refused(options, message):
    with pytest.raises((InputError, ShapeError), match=message):
        SIRParticleFilter(LinearBody(3), **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_layers": 0}, "n_layers"),
        ({"survival_rate": 0.0}, "survival_rate"),
        ({"schedule": [0.1, 1.0]}, "schedule must hold 5"),
        ({"schedule": [0.1, 0.2, 0.3, 0.4, 0.0]}, "positive exponents"),
        ({"noise_decay": 2.0}, "noise_decay"),
        ({"resample_threshold": 0.5}, "leave resample_threshold out"),
    ],
)
def test_options_that_the_annealed_filter_refuses(options, message):
    with pytest.raises(InputError, match=message):
        AnnealedParticleFilter(LinearBody(3), **options)


def test_inputs_that_are_refused():
    body, masks = LinearBody(3), torch.ones(4, 2, 5, 6, dtype=torch.bool)
    tracker = SIRParticleFilter(body, 5)
    with pytest.raises(
        InputError, match=r"model must be a filter that tracks a Body, got SIR.* of Lin"
    ):
        track_body(tracker, masks, None, torch.zeros(3))
    with pytest.raises(InputError, match=r"tracks a Body, got str of NoneType"):
        track_body("sir", masks, None, torch.zeros(3))
    with pytest.raises(InputError, match="precision of SIRParticleFilter"):
        tracker.half()
    with pytest.raises(InputError, match=r"body must be a torchpose.body.Body, .* got str"):
        SIRParticleFilter("walker")
    for given, start, said in (
        (masks.numpy(), torch.zeros(3), "silhouettes must be a tensor, got ndarray"),
        (masks, [0.0] * 3, "initial_state must be a tensor, got list"),
        (None, torch.zeros(3), "must be given, got None"),
    ):
        with pytest.raises(InputError, match=said):
            tracker(given, None, start)
    with pytest.raises(InputError, match="silhouettes must be a tensor, got list"):
        tracker.step(tracker.init(torch.zeros(1, 3)), [masks[0]], None)
    for value, said in (
        (torch.zeros(1, 1), r"what likelihood returns must have shape \[1, 5\], got \[1, 1\]"),
        ([0.0] * 5, "what likelihood returns must be a tensor, got list"),
    ):
        own = SIRParticleFilter(body, 5, likelihood=lambda states, frame, value=value: value)
        with pytest.raises((InputError, ShapeError), match=said):
            own(torch.zeros(2, 1), None, torch.zeros(3))
    with pytest.raises(InputError, match="initial_state must be a tensor, got list"):
        tracker.init([0.0] * 3)
    state = tracker.init(torch.zeros(1, 3))
    for other, said in (
        (state.particles, "state must be a BodyFilterState .* got Tensor"),
        (
            SIRParticleFilter(body, 4).init(torch.zeros(1, 3)),
            r"particles must have shape \[B, 5, 3\]",
        ),
        (state._replace(trend=torch.zeros(1, 2, 3)), "state is of another kind of filter"),
    ):
        for run, frames in ((tracker.step, masks[:1]), (tracker.advance, masks[None])):
            with pytest.raises((InputError, ShapeError), match=said):
                run(other, frames, None)
    with pytest.raises(ShapeError, match="initial_state"):
        tracker(masks, None, torch.zeros(4))
    with pytest.raises(ShapeError, match="initial_state must be"):
        tracker(masks, None, torch.zeros(1, 1, 3))
    with pytest.raises(InputError, match="initial_state must be finite"):
        tracker(masks, None, tensor([0.0, math.nan, 0.0]))
    with pytest.raises(ShapeError, match="silhouettes must have shape"):
        tracker(masks[0], None, torch.zeros(3))
    with pytest.raises(InputError, match="must be bool"):
        tracker(masks.float(), None, torch.zeros(3))
    with pytest.raises(ShapeError, match="same number of sequences"):
        tracker(masks.expand(2, *masks.shape), None, torch.zeros(3, 3))
    with pytest.raises(ShapeError, match="at least one"):
        tracker(masks[:0], None, torch.zeros(3))
    with pytest.raises(InputError, match="list of generators"):
        tracker(masks, None, torch.zeros(3), generator=generators(2))
    with pytest.raises(ShapeError, match="one frame for each"):
        tracker.step(tracker.init(torch.zeros(2, 3)), masks, None)
    assert BodyFilterOutput._fields[:2] == ("mean", "log_evidence")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_evidence_of_particles_that_all_died_is_minus_infinity(dtype):
    alive = torch.zeros(3, 4, dtype=dtype)
    likelihood = torch.tensor([0.0, -math.inf, math.nan]).to(dtype)[:, None].expand(3, 4)
    evidence = reweight(torch.zeros(3, 4, 2, dtype=dtype), alive, likelihood).log_evidence
    assert evidence.tolist() == [0.0, -math.inf, -math.inf]


def test_whole_numbers_may_be_observed_in_sequences_of_different_lengths():
    seen = torch.tensor([[[1, 0], [2, 1], [0, 0]], [[0, 1], [1, 1], [2, 2]]])

    def likelihood(states, observed):
        return -(states - observed[:, None]).square().sum(-1)

    tracker = SIRParticleFilter(LinearBody(2), 30, process_cov=0.5, likelihood=likelihood)
    start, lengths = torch.zeros(2, 2, dtype=torch.float64), torch.tensor([2, 3])
    both = tracker(seen, None, start, generator=generators(2), lengths=lengths)
    alone = tracker(seen[:1, :2], None, start[:1], generator=generators(1))
    torch.testing.assert_close(both.mean[:1, :2], alone.mean, rtol=0, atol=0)
    torch.testing.assert_close(both.mean[0, 2], both.mean[0, 1], rtol=0, atol=0)
