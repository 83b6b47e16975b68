"""The constrained filter against the model it stands for, sampled by brute force, and its reports."""

import warnings

import pytest
import torch

from tests.draws import generator
from tests.filters.linear_poses import LinearBody, assert_within_error
from tests.whole_body.filters.bending_body import BODY, performance, performances, space
from tests.whole_body.filters.walking_body import HEIGHT, WIDTH, rig
from torchpose.body import JointLimits
from torchpose.errors import DegenerateFilterWarning, InputError, SkeletonError
from torchpose.priors import ActionBank, ActionSpace
from torchpose.priors._actions.action_file import ActionInfo
from torchpose.priors._actions.postures import state_postures
from torchpose.whole_body import (
    ConstrainedParticleFilter,
    SIRParticleFilter,
    constant_velocity_std,
    render,
)
from torchpose.whole_body._filters.constrained import log_share
from torchpose.whole_body._filters.posture_gate import PostureGate, Redrawn, Rows

BEND, WAVE = space("bend"), space("wave")
STD = torch.full((36,), 0.03, dtype=torch.float64)


def motion_noise():
    """Of what moves in these actions: the twist of a limb, which no joint shows, does not."""
    std = constant_velocity_std(BODY, performances("bend") + performances("wave"))
    moving = std > 1e-5
    std = torch.where(moving, std.clamp_min(0.012), 0.0)
    std[:3] = 0.003
    return std


RIG = rig(3).select([0, 1])


def near(target):
    """Log-likelihood of joints about those of a target state."""

    def log_likelihood(states, frame):
        apart = BODY.joints(states) - BODY.joints(target)
        return -0.5 * (apart / 0.06).square().sum((-1, -2))

    return log_likelihood


def flat(states, frame):
    return states.new_zeros(states.shape[:2])


FRAME = torch.ones(1, 1, dtype=torch.bool)


# --- the model


def test_the_gate_is_that_of_the_action():
    """Its decisions, with the same uniform numbers, against the action itself in float64."""
    gate = PostureGate(BODY, BEND)
    states = performance("bend", 3).repeat(25, 1)
    states[:, 6:] += 0.04 * torch.randn(len(states), 30, generator=generator(), dtype=torch.float64)
    rows = Rows.all(1, len(states), generator(5), states.device)
    found = gate.accept(states[:, 6:], rows)
    z = BEND.project(state_postures(BODY, states))
    expected = BEND.inside(z.float(), BEND.match(z.float(), generator(5)))
    assert (found == expected).double().mean() > 0.995  # but for roundings at the border
    assert 0.1 < found.double().mean() < 0.9


@pytest.fixture(scope="module")
def brute_force():
    """Sixteen ancestors that differ in how many of their draws belong to the action.

    2,500 draws of each without any bound, with the probability of acceptance summed over all postures
    j instead of a drawn one.
    """
    before = performance("bend", 3)[12]
    g = generator(7)
    spread = torch.zeros(36, dtype=torch.float64).index_fill(0, torch.tensor([6, 9, 12, 21]), 0.03)
    ancestors = before + spread * torch.randn(16, 36, generator=g, dtype=torch.float64)
    drawn = ancestors[:, None] + STD * torch.randn(16, 2500, 36, generator=g, dtype=torch.float64)
    drawn = drawn.flatten(0, 1)
    z = BEND.project(state_postures(BODY, drawn))
    inside = ((z[:, None] - BEND.performance).abs() < 2 * BEND.std).all(-1)
    accepted = (BEND.log_match(z).softmax(-1) * inside).sum(-1).view(16, -1)
    return before, ancestors, drawn, accepted


@pytest.mark.parametrize("weights", ["published", "normalised"])
def test_one_frame_is_the_model_sampled_by_brute_force(brute_force, weights):
    """Redrawing divides by every ancestor's share of accepted draws; normalised weights put it back."""
    before, ancestors, drawn, accepted = brute_force
    target = ancestors[:4].mean(0)
    share = accepted.mean(1, keepdim=True)
    assert share.min() < 0.5 * share.max() and share.min() > 0.01
    weight = accepted * near(target)(drawn, None).view(16, -1).exp()
    weight = weight if weights == "normalised" else weight / share
    weight = weight / weight.sum()
    expected = weight.flatten() @ drawn[:, 6:]

    tracker = ConstrainedParticleFilter(
        BODY, BEND, 16 * 80, process_cov=STD**2, likelihood=near(target), max_redraws=200,
        weights=weights, resample_threshold=0.0, velocity_rate=None,
    )  # fmt: skip
    copies = ancestors.repeat_interleave(80, 0)
    means, gates = [], []
    for seed in range(4):
        state = tracker.init(before, generator=generator(seed))
        state = state._replace(particles=copies[None])
        if state.memory is not None:  # eighty copies of each
            state = state._replace(memory=torch.arange(1280)[None] // 80)
        _, out = tracker.step(state, FRAME, None, generator=generator(seed))
        means.append(out.mean[0, 6:])
        gates.append(out.details["acceptance"][0])
        assert out.details["clamped"] < 0.01
    assert_within_error(torch.stack(means), expected, slack=2e-4, factor=8)
    assert_within_error(torch.stack(gates), share.mean(), slack=0.01)


def test_the_weights_differ_between_the_two_forms():
    """The same draws, so that only Z is between them."""
    start, ahead = performance("bend", 3)[12], performance("bend", 3)[14]
    options = {"process_cov": STD**2, "likelihood": near(ahead)}
    means = []
    for weights in ("published", "normalised"):
        tracker = ConstrainedParticleFilter(BODY, BEND, 200, weights=weights, **options)
        state = tracker.init(start, generator=generator(), initial_cov=STD**2)
        _, out = tracker.step(state, FRAME, None, generator=generator(1))
        means.append(out.mean)
    assert (means[0] - means[1]).abs().max() > 1e-4


def test_a_copy_with_exchanged_legs_has_a_share_of_its_own():
    """Its draws say nothing about how often those of the other copies are accepted."""
    tracker = ConstrainedParticleFilter(BODY, BEND, 4, weights="normalised", process_cov=STD**2)
    copies = torch.tensor([[0, 0, 0, 3]])
    memory = tracker.swap_memory(copies, torch.tensor([[False, False, True, False]]))
    yes, share = torch.ones(4, dtype=torch.bool), torch.tensor([0.5, 0.3, 0.1, 0.2]).double()
    found = Redrawn(torch.zeros(4, 36), yes, yes, yes.long(), share)
    expected = torch.tensor([[0.4, 0.4, 0.1, 0.2]]).double().log()
    torch.testing.assert_close(log_share(found, memory), expected)
    published = ConstrainedParticleFilter(BODY, ActionBank([BEND]), 4, process_cov=STD**2)
    assert torch.equal(published.swap_memory(copies, yes[None]), copies)  # actions


def test_every_particle_belongs_to_the_action():
    start = performance("bend", 3)[10]
    tracker = ConstrainedParticleFilter(
        BODY, BEND, 200, process_cov=(2 * STD) ** 2, likelihood=flat, max_redraws=100
    )
    state, out = tracker.step(tracker.init(start), FRAME, None, generator=generator())
    assert out.details["clamped"] < 0.02 and 0 < out.details["acceptance"] < 0.7
    z = BEND.project(state_postures(BODY, state.particles[0]))
    off = (z[:, None] - BEND.performance).abs() - 2 * BEND.std
    inside = (off.amax(-1) < 0.02).any(-1)  # degrees
    assert inside.double().mean() > 0.97
    free = BODY.perturb(start, 2 * STD * torch.randn(200, 36, generator=generator()).double())
    z = BEND.project(state_postures(BODY, free))
    loose = ((z[:, None] - BEND.performance).abs() < 2 * BEND.std).all(-1).any(-1)
    assert loose.double().mean() < 0.8


def test_without_an_action_and_velocity_it_is_sir():
    states = performance("bend", 3)
    silhouettes = render(BODY, states[1:6], RIG, HEIGHT, WIDTH)
    options = {"process_cov": STD**2, "sharpness": 30.0, "likelihood": "overlap"}
    ours = ConstrainedParticleFilter(BODY, None, 50, velocity_rate=None, **options)
    out = ours(silhouettes, RIG, states[0], generator=generator())
    expected = SIRParticleFilter(BODY, 50, **options)(
        silhouettes, RIG, states[0], generator=generator()
    )
    assert torch.equal(out.mean, expected.mean)
    assert (out.details["acceptance"] == 1).all() and not out.details["clamped"].any()


def test_the_velocity_is_that_of_the_estimates():
    """Without noise every particle moves by V, which the drawn estimates alone decide."""
    body, start = LinearBody(3), torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    tracker = ConstrainedParticleFilter(body, None, 2, process_cov=0.0, likelihood=flat)
    state = tracker.init(start)
    velocity, before = torch.tensor([0.4, 0.0, -0.2]).double(), start - 1.0
    state = state._replace(trend=torch.stack([velocity, before])[None])
    for _ in range(4):
        mean = state.mean[0]
        velocity = 0.5 * velocity + 0.5 * (mean - before)
        state, out = tracker.step(state, torch.ones(1, 1), None)
        assert torch.allclose(out.mean[0], mean + velocity)
        before = mean


# --- tracking


@pytest.fixture(scope="module")
def sequence():
    states = performance("bend", 3, 40)[8:26]
    return states, render(BODY, states[1:], RIG, HEIGHT, WIDTH)


def error(body, mean, states):
    gap = state_postures(body, mean) - state_postures(body, states)
    return float(gap.square().mean())


def test_a_bend_is_tracked_better_than_without_the_action(sequence):
    states, silhouettes = sequence
    options = {"process_cov": (2 * motion_noise()) ** 2, "likelihood": "overlap", "sharpness": 40.0}
    errors = []
    for action in (BEND, None):
        tracker = ConstrainedParticleFilter(BODY, action, 150, max_redraws=20, **options)
        out = tracker(silhouettes.expand(2, -1, -1, -1, -1), RIG, states[0], generator=generator())
        errors.append(error(BODY, out.mean, states[1:].expand(2, -1, -1)))
    still = error(BODY, states[:1].expand(17, -1), states[1:])
    assert errors[0] < errors[1] and errors[0] < 0.4 * still


def test_frame_by_frame_and_alone_it_is_the_same(sequence):
    states, silhouettes = sequence
    bank = ActionBank([BEND, WAVE])
    for action in (BEND, bank):
        tracker = ConstrainedParticleFilter(
            BODY,
            action,
            20,
            process_cov=STD**2,
            likelihood="overlap",
            sharpness=30.0,
            max_redraws=10,
        )
        both = torch.stack([silhouettes[:3], silhouettes[4:7]])
        start = torch.stack([states[0], states[4]])
        track = tracker(both, RIG, start, generator=[generator(1), generator(2)])
        alone = tracker(both[1], RIG, start[1], generator=[generator(2)])
        assert torch.allclose(track.mean[1], alone.mean)
        for name, value in alone.details.items():
            assert torch.allclose(track.details[name][1].double(), value.double())
        state = tracker.init(start[1])
        g = [generator(2)]
        for t in range(3):
            state, out = tracker.step(state, both[1, t][None], RIG, generator=g)
            assert torch.allclose(out.mean[0], alone.mean[t])


def test_coasting_stays_in_the_action(sequence):
    states, silhouettes = sequence
    gone = silhouettes[:8].clone()
    gone[2:] = False
    tracker = ConstrainedParticleFilter(BODY, BEND, 100, process_cov=STD**2, likelihood="overlap")
    out = tracker(gone, RIG, states[0], generator=generator())
    assert out.coasting.tolist() == [False] * 2 + [True] * 6
    z = BEND.project(state_postures(BODY, out.mean))
    assert ((z[:, None] - BEND.performance).abs() < 2 * BEND.std).all(-1).any(-1).all()


def test_joint_limits_hold_too(sequence):
    states, silhouettes = sequence
    limits = JointLimits.fit(torch.cat(performances("bend")), margin=1.0)
    for mode in ("clamp", "discard"):
        tracker = ConstrainedParticleFilter(
            BODY,
            BEND,
            60,
            process_cov=motion_noise() ** 2,
            limits=limits,
            limit_mode=mode,
            max_redraws=10,
        )
        state = tracker.init(states[0])
        state, _ = tracker.step(state, silhouettes[:1], RIG, generator=generator())
        kept = state.particles[0][state.log_weights[0] > -torch.inf]
        assert len(kept) and limits.inside(kept).all()


# --- several actions


def follow(action, states, n_particles, n_seeds):
    """Details [B, T, ...] of tracks by joints that are seen with noise, each with its own seed."""
    seen = []

    def log_likelihood(particles, frame):
        return near(seen[-1])(particles, frame)

    tracker = ConstrainedParticleFilter(
        BODY, action, n_particles, process_cov=motion_noise() ** 2, likelihood=log_likelihood,
        max_redraws=10,
    )  # fmt: skip
    generators = [generator(seed) for seed in range(n_seeds)]
    state, details = tracker.init(states[0].expand(n_seeds, -1), generator=generators), []
    for seen_now in states[1:]:
        seen.append(seen_now)
        state, out = tracker.step(state, FRAME.expand(n_seeds, 1), None, generator=generators)
        details.append(out.details)
    return {name: torch.stack([d[name] for d in details], 1) for name in details[0]}


@pytest.mark.slow
@pytest.mark.parametrize("action", ["bend", "wave"])
def test_a_bank_tells_the_action(action):
    bank = ActionBank([BEND, WAVE])
    posterior = follow(bank, performance(action, 11, 40)[4:19], 150, 6)["actions"]
    assert posterior.shape == (6, 14, 3)
    assert torch.allclose(posterior.sum(-1), torch.ones(6, 14, dtype=torch.float64))
    right, wrong = bank.names.index(action), 1 - bank.names.index(action)
    assert posterior[:, 8:, right].mean() > 0.5 and posterior[:, 8:, wrong].max() < 0.01


def test_what_is_none_of_the_actions_is_released():
    """Somebody bends, and a bank knows waves only; beside it the gate of waves alone."""
    states = performance("bend", 11, 40)[6:18]
    free = follow(ActionBank([WAVE]), states, 40, 4)
    assert (free["released"][:, 6:].double().mean(1) > 0.9).all()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DegenerateFilterWarning)
        held = follow(WAVE, states, 30, 4)
    assert free["clamped"][:, 6:].mean() < 0.1 < held["clamped"][:, 6:].mean(1).min()


def test_transitions_are_rescaled_to_the_frames_and_repr_says_so():
    bank = ActionBank([BEND, WAVE])
    apart = {}
    for fps in (None, 15.0):
        tracker = ConstrainedParticleFilter(BODY, bank, 10, fps=fps)
        actions = torch.zeros(1, 20_000, dtype=torch.long)
        moved = tracker.gate.next_actions(actions, fps, generator())
        left = (moved != 0).double().mean()
        expected = 1 - bank.transition(fps)[0, 0]
        assert abs(left - expected) < 4 * (expected / 20_000) ** 0.5
        apart[fps] = left
    assert apart[15.0] > 1.5 * apart[None]
    assert "transitions at 15 frames per second, rescaled from 30" in repr(tracker)
    assert "rescaled" not in repr(ConstrainedParticleFilter(BODY, bank, 10, fps=30.0))
    assert "transitions" not in repr(ConstrainedParticleFilter(BODY, BEND, 10, fps=15.0))


# --- bad input


def test_a_gate_that_rejects_everything_is_reported():
    start = performance("bend", 3)[0].clone()
    for part in ("left_thigh", "right_upper_arm"):  # sitting, an arm up
        start[3 + 3 * BODY.skeleton.part(part)] = -0.7
    tracker = ConstrainedParticleFilter(
        BODY, BEND, 30, process_cov=(0.1 * STD) ** 2, likelihood=flat, max_redraws=3
    )
    with pytest.warns(DegenerateFilterWarning, match="all particles 1 times .element 0 at frame 0"):
        state, out = tracker.step(tracker.init(start), FRAME, None, generator=generator())
    assert out.details["clamped"] == 1 and out.details["acceptance"] == 0
    assert out.details["redraws"] == 3
    # past the length of a sequence what is reported repeats, and is not warned of again
    frames, lengths = FRAME.expand(2, 3, 1), torch.tensor([1, 2])
    with pytest.warns(DegenerateFilterWarning, match="particles 3 times .*element 1 at frame 1.,"):
        out = tracker(frames, None, start.expand(2, -1), generator=generator(), lengths=lengths)
    assert out.details["clamped"].tolist() == [[1, 1, 1]] * 2
    z = BEND.project(state_postures(BODY, state.particles[0]))
    off = ((z[:, None] - BEND.performance).abs() - 2 * BEND.std).amax(-1).amin(-1)
    assert off.max() < 12  # degrees: shoulders are fixed in the torso, so not quite at the border
    normalised = ConstrainedParticleFilter(
        BODY,
        BEND,
        30,
        process_cov=(0.1 * STD) ** 2,
        likelihood=flat,
        max_redraws=3,
        weights="normalised",
    )
    with pytest.warns(DegenerateFilterWarning):
        _, out = normalised.step(normalised.init(start), FRAME, None, generator=generator())
    assert not out.respread.any()  # all alike


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"weights": "none"}, "weights must be one of published, normalised"),
        ({"velocity_rate": 1.0}, "velocity_rate must be from 0 to below 1"),
        ({"max_redraws": -1}, "max_redraws must be a whole number of 0 or more"),
        ({"fps": 0.0}, "fps must be positive"),
        ({"gate_width": 0.0}, "width must be positive"),
        ({"limb_shape": "cones"}, "limb_shape must be one of cylinders, rectangles"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(InputError, match=message):
        ConstrainedParticleFilter(BODY, BEND, 10, **options)


def test_actions_and_bodies_that_do_not_fit():
    with pytest.raises(InputError, match="action must be an ActionSpace, an ActionBank or None"):
        ConstrainedParticleFilter(BODY, "bend", 10)
    with pytest.raises(InputError, match="a bank compares motions"):
        ConstrainedParticleFilter(BODY, ActionBank([BEND]), 10, weights="normalised")
    with pytest.raises(InputError, match="without a frame rate; give fps"):
        timeless = ActionSpace(**dict(BEND.named_buffers()), info=ActionInfo(name="bend"))
        ConstrainedParticleFilter(BODY, ActionBank([timeless]), 10)
    with pytest.raises(SkeletonError, match="posture_body of skeleton"):
        other = type("Other", (), {"skeleton": type("S", (), {"name": "stick"})()})()
        PostureGate(BODY, BEND, other)
