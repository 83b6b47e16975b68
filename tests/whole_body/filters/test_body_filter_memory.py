"""What the base filter carries for its subclasses: memory of particles, trends of elements, details."""

import math

import pytest
import torch

from tests.filters.linear_poses import LinearBody
from tests.whole_body.filters.walking_body import walker
from torchpose.body import BODY_15, JointLimits
from torchpose.errors import DegenerateFilterWarning, InputError, SkeletonError
from torchpose.whole_body import (
    AnnealedParticleFilter,
    SilhouetteParticleFilter,
    SIRParticleFilter,
    reweight,
)
from torchpose.whole_body._filters.legs import exchange_legs

WIDE = torch.float64


class Genealogist(SilhouetteParticleFilter):
    """Remembers the first value of every particle, and the last two estimates of an element."""

    def first_memory(self, particles):
        return particles.clone()

    def first_trend(self, mean):
        return torch.stack([mean, mean], 1)

    def swap_memory(self, memory, swapped):
        return torch.where(swapped[..., None], -memory, memory)

    def move(self, state, frame, generator):
        particles = state.particles + self.step_std
        moved = reweight(particles, state.log_weights, frame.score(particles))
        trend = torch.stack([state.trend[:, 1], state.mean], 1)
        age = (particles - state.memory).mean((1, 2))
        return moved._replace(memory=state.memory, trend=trend, details={"age": age})


def near(states, frame):
    return -0.5 * (states - frame[:, None]).square().sum(-1)


def tracker(n=30, **options):
    options = {"process_cov": 0.25**2, "likelihood": near, **options}
    return Genealogist(LinearBody(2), n, **options)


def generators(count):
    return [torch.Generator().manual_seed(i) for i in range(count)]


def test_memory_follows_its_particles_through_resampling():
    model = tracker()
    z = torch.randn(2, 5, 2, dtype=WIDE, generator=torch.Generator().manual_seed(1))
    state = model.init(
        torch.zeros(2, 2, dtype=WIDE),
        generator=generators(2),
        initial_cov=torch.ones(2, dtype=WIDE),
    )
    streams = generators(2)
    for t in range(5):
        state, out = model.step(state, z[:, t], None, generator=streams)
        # a particle has moved by 0.25 a frame from what it was at first, whoever its neighbours were
        moved = state.particles - state.memory
        torch.testing.assert_close(moved, torch.full_like(moved, 0.25 * (t + 1)))
        torch.testing.assert_close(out.details["age"], moved.mean((1, 2)))
    survivors = torch.unique(state.memory[0, :, 0])
    assert 1 <= len(survivors) < 30, "somebody was resampled"


def test_a_trend_holds_what_was_before_and_details_are_reported_for_every_frame():
    model = tracker()
    z = torch.randn(3, 4, 2, dtype=WIDE, generator=torch.Generator().manual_seed(2))
    start = torch.zeros(3, 2, dtype=WIDE)
    out = model(z, None, start, generator=generators(3))
    assert out.details["age"].shape == (3, 4)
    state, streams = model.init(start), generators(3)
    means = [start]
    for t in range(4):
        state, one = model.step(state, z[:, t], None, generator=streams)
        torch.testing.assert_close(out.details["age"][:, t], one.details["age"])
        torch.testing.assert_close(state.trend, torch.stack(means[-2:] if t else [start] * 2, 1))
        means.append(one.mean)
    alone = model(z[1], None, start[1], generator=generators(2)[1])
    torch.testing.assert_close(alone.details["age"], out.details["age"][1])


@pytest.mark.parametrize("count", [1, 3])
def test_a_list_of_generators_holds_one_for_each_element_online_too(count):
    model, start = tracker(), torch.zeros(2, 2, dtype=WIDE)
    with pytest.raises(InputError, match=f"one for each sequence, got {count}"):
        model.init(start, generator=generators(count), initial_cov=1.0)
    state = model.init(start, generator=generators(2), initial_cov=1.0)
    with pytest.raises(InputError, match=f"one for each sequence, got {count}"):
        model.step(state, start, None, generator=generators(count))
    with pytest.raises(InputError, match=f"one for each sequence, got {count}"):
        model.advance(state, start[:, None], None, generator=generators(count))


def test_particles_that_died_start_with_a_memory_of_their_own():
    def deadly(states, frame):
        return near(states, frame).masked_fill(frame[:, :1] > 5, -math.inf)

    model = tracker(likelihood=deadly)
    z = torch.zeros(2, 3, 2, dtype=WIDE)
    z[1, 1] = 9.0
    state, streams = model.init(torch.zeros(2, 2, dtype=WIDE)), generators(2)
    state, _ = model.step(state, z[:, 0], None, generator=streams)
    with pytest.warns(DegenerateFilterWarning, match="element 1"):
        state, out = model.step(state, z[:, 1], None, generator=streams)
    assert out.respread.tolist() == [False, True]
    torch.testing.assert_close(state.memory[1], state.particles[1])
    torch.testing.assert_close(state.memory[0], state.particles[0] - 0.5)


# --- legs


def strides(body, n=1):
    """One leg forward, the other back."""
    state = torch.zeros(n, body.dim, dtype=WIDE)
    left, right = (3 + 3 * BODY_15.part(f"{side}_thigh") for side in ("left", "right"))
    state[:, left], state[:, right] = 0.3, -0.25
    return state


@pytest.mark.parametrize("kind", [SIRParticleFilter, AnnealedParticleFilter])
def test_every_filter_finds_legs_that_had_been_taken_for_each_other(kind):
    body = walker()
    true = strides(body)
    joints = body.joints(true)[0]

    def likelihood(states, frame):
        return -0.5 * ((body.joints(states) - joints) / 0.05).square().sum((-1, -2))

    start, frames = exchange_legs(body, true)[0], torch.zeros(4, 1, dtype=WIDE)
    error = []
    for rate in (0.0, 0.5):
        model = kind(body, 100, process_cov=0.005**2, likelihood=likelihood, leg_swap=rate)
        out = model(frames, None, start, generator=torch.Generator().manual_seed(0))
        error.append(float((body.joints(out.mean[-1]) - joints).norm(dim=-1).mean()))
    assert error[0] > 0.05, "without a swap the legs stay where they were"
    assert error[1] < 0.02


def test_memory_hears_of_swapped_legs():
    options = {
        "process_cov": 0.0,
        "likelihood": lambda states, frame: 200 * states[..., 0].double(),
    }
    model = Genealogist(walker(), 200, leg_swap=1.0, **options)
    start = strides(model.body)
    spread = torch.zeros(model.body.dim, dtype=WIDE)
    spread[0] = 0.01
    generator = torch.Generator().manual_seed(0)
    state = model.init(start, generator=generator, initial_cov=spread**2)
    for _ in range(2):  # the second frame begins with the resampling by the weights of the first
        state, _ = model.step(state, torch.zeros(1, 1, dtype=WIDE), None, generator=generator)
    legs = state.particles[0, :, 3:]
    turned = (state.memory[0, :, 3:] == -start[0, 3:]).all(-1)
    swapped = ~torch.isclose(legs, start[0, 3:]).all(-1)
    assert (turned == swapped).all() and 5 < int(swapped.sum()) < 100


def test_rates_and_bodies_without_legs_are_refused():
    with pytest.raises(InputError, match="leg_swap"):
        SIRParticleFilter(walker(), 10, leg_swap=1.5)
    with pytest.raises(SkeletonError, match="leg_swap"):
        SIRParticleFilter(LinearBody(3), 10, leg_swap=0.1)


def test_limits_that_discard_hold_for_the_estimate_of_the_largest_weight():
    body = walker()
    seed = torch.Generator().manual_seed(0)
    limits = JointLimits.fit(0.05 * torch.randn(500, body.dim, dtype=WIDE, generator=seed))
    outside = torch.zeros(body.dim, dtype=WIDE)
    outside[6:] = 0.5

    def drawn_outside(states, frame):
        return -50 * (states - outside).square().sum(-1)

    start, frames = torch.zeros(body.dim, dtype=WIDE), torch.zeros(3, 1, dtype=WIDE)
    for mode in ("discard", "clamp"):
        model = SIRParticleFilter(
            body,
            200,
            process_cov=0.05**2,
            likelihood=drawn_outside,
            limits=limits,
            limit_mode=mode,
            estimate="map",
        )
        out = model(frames, None, start, generator=torch.Generator().manual_seed(0))
        assert not out.respread.any() and limits.inside(out.mean).all()
