"""Exchanged legs against joints that trade places, and how often they are exchanged."""

import math

import pytest
import torch

from tests.whole_body.filters.walking_body import walk, walker
from torchpose.body import BODY_15, Body, centres_of
from torchpose.body._kinematics import FRAMES
from torchpose.errors import InputError, SkeletonError
from torchpose.filters._resampling import RESAMPLING
from torchpose.whole_body import SilhouetteParticleFilter, reweight
from torchpose.whole_body._filters.legs import (
    exchange_legs,
    extra_copies,
    leg_angle,
    leg_permutation,
    swap_legs,
)


@pytest.mark.parametrize("frame", FRAMES)
def test_legs_trade_directions_whatever_the_centres(frame):
    plain = walker()
    states = walk(plain, 30)
    body = plain.altered(frame=frame)
    body = body.altered(centres=centres_of(body, plain.convert(states, body)))
    states = plain.convert(states, body)
    swapped = exchange_legs(body, states)
    before, after = body.joints(states), body.joints(swapped)
    for side, other in (("left", "right"), ("right", "left")):
        for above, below in (("hip", "knee"), ("knee", "ankle")):
            bone = [body.skeleton.joint(f"{side}_{joint}") for joint in (above, below)]
            source = [body.skeleton.joint(f"{other}_{joint}") for joint in (above, below)]
            new = after[:, bone[1]] - after[:, bone[0]]
            old = before[:, source[1]] - before[:, source[0]]
            torch.testing.assert_close(new, old, rtol=0, atol=1e-12)
    rest = [i for i, n in enumerate(BODY_15.names) if not n.endswith(("knee", "ankle"))]
    torch.testing.assert_close(after[:, rest], before[:, rest], rtol=0, atol=1e-12)
    torch.testing.assert_close(exchange_legs(body, swapped), states, rtol=0, atol=1e-12)


def test_the_angle_is_that_of_the_swings():
    body = walker()
    state = torch.zeros(2, body.dim, dtype=torch.float64)
    thighs = [3 + 3 * BODY_15.part(f"{side}_thigh") for side in ("left", "right")]
    state[0, thighs[0]], state[0, thighs[1]] = math.sin(0.2), -math.sin(0.15)
    torch.testing.assert_close(leg_angle(body, state), torch.tensor([0.7, 0.0]).double())


def test_the_first_copy_of_every_ancestor_is_no_extra_one():
    g = torch.Generator().manual_seed(0)
    ancestors = torch.randint(0, 12, (5, 20), generator=g)
    for row, found in zip(ancestors.tolist(), extra_copies(ancestors).tolist(), strict=True):
        assert found == [value in row[:n] for n, value in enumerate(row)]
    assert not bool(extra_copies(torch.arange(9).flip(0)[None]).any())


def test_swaps_come_as_often_as_said_among_extra_copies():
    body = walker()
    state = torch.zeros(body.dim, dtype=torch.float64)
    thighs = [3 + 3 * BODY_15.part(f"{side}_thigh") for side in ("left", "right")]
    state[thighs[0]], state[thighs[1]] = math.sin(0.25), -math.sin(0.25)  # an angle of 1
    particles = state.expand(2, 20000, -1)
    generator = torch.Generator().manual_seed(0)
    copies = torch.rand(2, 20000, generator=generator) < 0.7
    moved, swapped = swap_legs(body, particles, copies, 0.6, generator)
    expected = 0.6 / math.pi
    deviation = math.sqrt(expected * (1 - expected) / 28000)
    assert abs(float(swapped[copies].double().mean()) - expected) < 4 * deviation
    assert not bool((swapped & ~copies).any())
    torch.testing.assert_close(moved[swapped], exchange_legs(body, particles)[swapped])
    assert torch.equal(moved[~swapped], particles[~swapped])


def test_legs_that_hang_together_are_never_swapped_and_a_rate_of_zero_draws_nothing():
    body, generator = walker(), torch.Generator().manual_seed(0)
    particles = torch.zeros(1, 50, body.dim, dtype=torch.float64)
    copies = torch.ones(1, 50, dtype=torch.bool)
    assert not bool(swap_legs(body, particles, copies, 1.0, generator)[1].any())
    before = generator.get_state()
    same, swapped = swap_legs(body, particles, copies, 0.0, generator)
    assert same is particles and not bool(swapped.any())
    assert torch.equal(generator.get_state(), before)


def test_an_element_draws_from_its_own_generator():
    body = walker()
    particles = walk(body, 3)[:, None].expand(-1, 40, -1)
    together = [torch.Generator().manual_seed(i) for i in range(3)]
    copies = torch.ones(3, 40, dtype=torch.bool)
    moved, _ = swap_legs(body, particles, copies, 1.0, together)
    alone = swap_legs(body, particles[1:2], copies[1:2], 1.0, [torch.Generator().manual_seed(1)])[0]
    assert torch.equal(moved[1:2], alone)


class Labelled(SilhouetteParticleFilter):
    """Particles that stay where they are; column 0 says who they are, the frame what they weigh."""

    def first_memory(self, particles):
        return torch.zeros_like(particles[..., 0], dtype=torch.long)

    def swap_memory(self, memory, swapped):
        return swapped.long()

    def move(self, state, frame, generator):
        weighted = reweight(state.particles, state.log_weights, frame.score(state.particles))
        return weighted._replace(memory=state.memory)


def resampled(resampling="systematic", threshold=1.0):
    """Strides of 200 labelled particles in two elements; the second has weights to select by."""
    body = walker()

    def weigh(states, frame):
        return frame[:, :1] * states[..., 0].double()

    model = Labelled(
        body, 200, process_cov=0.0, likelihood=weigh, leg_swap=1.0, resampling=resampling,
        resample_threshold=threshold,
    )  # fmt: skip
    state = model.init(walk(body, 40)[20:22])
    state.particles[..., 0] = torch.arange(200).to(state.particles) / 200
    before = state.particles.clone()
    state = state._replace(memory=torch.zeros(2, 200, dtype=torch.long))
    frames = torch.tensor([[0.0], [3.0]], dtype=torch.float64)
    generators = [torch.Generator().manual_seed(i) for i in range(2)]
    state, _ = model.step(state, frames, None, generator=generators)
    assert not bool(state.memory.any()), "nothing has been resampled before the first weights"
    state, _ = model.step(state, frames, None, generator=generators)
    return body, before, state


@pytest.mark.parametrize("resampling", RESAMPLING)
def test_a_swapped_particle_stays_beside_one_that_is_not(resampling):
    body, before, state = resampled(resampling)
    swapped = state.memory[1] > 0
    assert int(swapped.sum()) > 5
    label = (200 * state.particles[1, :, 0]).round().long()
    kept, changed = set(label[~swapped].tolist()), label[swapped].tolist()
    assert set(changed) <= kept
    torch.testing.assert_close(state.particles[1][~swapped], before[1][label[~swapped]])
    torch.testing.assert_close(
        state.particles[1][swapped], exchange_legs(body, before[1][label[swapped]])
    )


@pytest.mark.parametrize("threshold", [1.0, 0.05])
def test_no_legs_are_swapped_where_nothing_was_resampled(threshold):
    _, before, state = resampled(threshold=threshold)
    for element in [0] if threshold == 1.0 else [0, 1]:  # level weights, or too few that are not
        assert not bool(state.memory[element].any())
        torch.testing.assert_close(state.particles[element], before[element])


def test_what_cannot_be_swapped_is_refused():
    body = walker()
    particles = torch.zeros(1, 2, body.dim, dtype=torch.float64)
    copies = torch.ones(1, 2, dtype=torch.bool)
    with pytest.raises(InputError, match="from 0 to 1"):
        swap_legs(body, particles, copies, 1.5)
    with pytest.raises(SkeletonError, match="set leg_swap=0"):
        swap_legs(torch.nn.Identity(), particles, copies, 0.5)
    assert leg_permutation(BODY_15)[BODY_15.part("left_shank")] == BODY_15.part("right_shank")
    assert isinstance(body, Body)
