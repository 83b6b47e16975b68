"""The tracker with root uncertainty: a walk, its parts one by one, and what it refuses."""

import math
from functools import cache

import pytest
import torch

from tests.whole_body.filters.walking_body import HEIGHT, WIDTH, rig, walk, walker
from torchpose.body import JointLimits
from torchpose.errors import DegenerateFilterWarning, InputError, PriorError
from torchpose.learning import fit_limb_conditionals
from torchpose.math._unscented import sigma_points
from torchpose.priors._limb_conditionals import in_body_frame
from torchpose.whole_body import RootUncertaintyTracker, render
from torchpose.whole_body._filters.legs import exchange_legs
from torchpose.whole_body._filters.limb_observations import (
    count_positions,
    least_part_log_likelihood,
    part_groups,
    part_log_likelihood,
    parts_log_weight,
)
from torchpose.whole_body._silhouettes.limb_counts import PartCounts
from torchpose.whole_body._silhouettes.rendering import prepare_silhouettes

FRAMES = 8


@cache
def scene():
    """Body, conditionals of other walks, true states and silhouettes of a slow walk."""
    upright = walker()
    seen = [walk(upright, 120, seed=s, phase=s, speed=0.01) for s in (1, 2)]
    body, states = in_body_frame([(upright, seen)])
    conditionals = fit_limb_conditionals(body, states, 60.0)
    truth = upright.convert(walk(upright, FRAMES, speed=0.01), body)
    return body, conditionals, truth, render(body, truth, rig(), HEIGHT, WIDTH)


def tracker(n=25, **options):
    body, conditionals, _, _ = scene()
    options = {"fps": 60.0, "process_cov": 0.01**2, "survival_rate": 0.46, **options}
    return RootUncertaintyTracker(body, conditionals, n, **options)


def seeded(*seeds):
    return [torch.Generator().manual_seed(seed) for seed in seeds]


def error(body, states, truth):
    return float((body.joints(states) - body.joints(truth)).norm(dim=-1).mean())


@pytest.mark.parametrize("weighting", ["parts", "body"])
def test_it_follows_a_walk(weighting):
    body, _, truth, silhouettes = scene()
    track = tracker(60, weighting=weighting)(silhouettes, rig(), truth[0], generator=seeded(0)[0])
    still = truth[:1].expand_as(truth)
    assert error(body, track.mean[4:], truth[4:]) < 0.7 * error(body, still[4:], truth[4:])
    assert bool(track.log_evidence.isnan().all()) and not bool(track.coasting.any())
    assert bool((track.std[:, 6:] > 0.005).all()) and bool((track.std[:, 6:] < 0.3).all())


def test_steps_and_batches_give_the_numbers_of_sequences_alone():
    _, _, truth, silhouettes = scene()
    filter_ = tracker(10, leg_swap=0.5)
    both = torch.stack([silhouettes[:4], silhouettes[4:]])
    starts = torch.stack([truth[0], truth[3]])
    track = filter_(both, rig(), starts, generator=seeded(3, 4))
    state = filter_.init(starts[1:])
    generator = seeded(4)
    for t in range(4):
        state, out = filter_.step(state, both[1:, t], rig(), generator=generator)
        torch.testing.assert_close(out.mean[0], track.mean[1, t], rtol=0, atol=1e-9)
        torch.testing.assert_close(out.std[0], track.std[1, t], rtol=0, atol=1e-9)
    assert state.memory.shape == (1, 10, 10, 3, 3)


def test_roots_alone_are_drawn_and_parts_grow_by_the_learnt_diffusion():
    _, conditionals, truth, silhouettes = scene()
    filter_ = tracker(10)
    state = filter_.init(truth[:1])
    empty = torch.zeros_like(silhouettes[:1])
    after, out = filter_.step(state, empty, rig(), generator=seeded(0))
    assert bool(out.coasting) and float(out.log_evidence) == 0
    assert torch.equal(after.particles[..., 6:], state.particles[..., 6:])
    moved = after.particles[..., :6] - state.particles[..., :6]
    assert bool((moved.abs() > 0).all()) and float(moved.abs().max()) < 0.06
    mean = truth[0, 6:].view(-1, 3)
    grown = conditionals.diffuse(mean, state.memory[0, 0])[1]
    torch.testing.assert_close(after.memory[0], grown.expand_as(after.memory[0]))
    again, later = filter_.step(after, empty, rig(), generator=seeded(1))
    assert bool((later.std > out.std).all())
    assert torch.equal(again.log_weights, state.log_weights)


def test_an_element_that_nobody_sees_coasts_beside_one_that_is_seen():
    _, _, truth, silhouettes = scene()
    filter_ = tracker(10)
    state = filter_.init(truth[:2])
    frame = silhouettes[:2].clone()
    frame[1] = False
    after, out = filter_.step(state, frame, rig(), generator=seeded(0, 1))
    assert out.coasting.tolist() == [False, True]
    assert torch.equal(after.particles[1, :, 6:], state.particles[1, :, 6:])
    assert torch.equal(after.log_weights[1], state.log_weights[1])
    assert not torch.equal(after.particles[0, :, 6:], state.particles[0, :, 6:])


def test_limits_hold_for_an_element_that_coasts_whoever_its_neighbours_are():
    _, _, truth, silhouettes = scene()
    ends = 0.05 + truth[0, 6:].abs()
    filter_ = tracker(10, limits=JointLimits(-ends, ends, torch.full((30,), 0.01).double()))
    starts = truth[:2].clone()
    starts[1, 8] = ends[2] + 0.2  # outside
    frame = silhouettes[:2].clone()
    frame[1] = False
    with pytest.warns(DegenerateFilterWarning, match="element 1"):
        after, out = filter_.step(filter_.init(starts), frame, rig(), generator=seeded(0, 1))
    with pytest.warns(DegenerateFilterWarning, match="element 0"):
        alone, _ = filter_.step(filter_.init(starts[1:]), frame[1:], rig(), generator=seeded(1))
    assert out.respread.tolist() == [False, True]
    assert torch.equal(after.particles[1], alone.particles[0])
    assert torch.equal(after.memory[1], alone.memory[0])


def test_hypotheses_weigh_as_the_product_over_parts_of_sums_over_places():
    body, _, truth, silhouettes = scene()
    filter_ = tracker(12, normalisation="published", camera_rule="sum")
    after, _ = filter_.step(filter_.init(truth[:1]), silhouettes[:1], rig(), generator=seeded(5))
    mean = truth[0, 6:].view(-1, 3).expand(12, -1, -1)
    covariance = filter_.conditionals.diffuse(mean, filter_.first_memory(after.particles)[0])[1]
    points = sigma_points(mean, covariance, centre=True)
    roots = torch.cat([after.particles[0, :, :6], mean.flatten(1)], -1)
    seen, groups = prepare_silhouettes(silhouettes[0]), part_groups(body.skeleton)
    counts = count_positions(body, roots, points, rig(), seen, groups)
    pixels = part_log_likelihood(counts, cameras="sum").exp()
    product = torch.ones(12, dtype=torch.float64)
    for part in range(pixels.shape[1]):
        product = product * pixels[:, part].sum(-1)  # (DX 12)
    log_product, log_weights = product.log(), after.log_weights[0]
    slope = (log_weights[1:] - log_weights[0]) / (log_product[1:] - log_product[0])
    torch.testing.assert_close(slope, slope[:1].expand_as(slope), rtol=1e-6, atol=0)
    weights = log_weights.exp()
    survival = float(weights.sum() ** 2 / (12 * weights.square().sum()))
    assert survival == pytest.approx(0.46, rel=1e-6)


def test_the_spread_is_that_of_draws_from_the_mixture():
    filter_ = tracker(3, survival_rate=0.9)
    _, _, truth, _ = scene()
    generator = torch.Generator().manual_seed(0)
    particles = truth[None, :3].clone()
    root = 0.1 * torch.randn(1, 3, 10, 3, 3, generator=generator, dtype=torch.float64)
    memory = root @ root.mT
    log_weights = torch.tensor([[0.5, 0.3, 0.2]], dtype=torch.float64).log()
    mean = particles[:, 0]
    found = filter_.spread(particles, log_weights, mean, memory)
    noise = torch.randn(200_000, 10, 3, generator=generator, dtype=torch.float64)
    chosen = torch.multinomial(log_weights[0].exp(), 200_000, True, generator=generator)
    drawn = particles[0, chosen, 6:] + torch.einsum(
        "nvij,nvj->nvi", root[0, chosen], noise
    ).flatten(1)
    expected = (drawn - mean[:, 6:]).square().mean(0).sqrt()
    torch.testing.assert_close(found[0, 6:], expected, rtol=0.02, atol=0)


def test_swapped_legs_take_their_covariances_along():
    body, _, truth, _ = scene()
    filter_ = tracker(5)
    generator = torch.Generator().manual_seed(0)
    root = 0.02 * torch.randn(1, 2, 10, 3, 3, generator=generator, dtype=torch.float64)
    memory = root @ root.mT
    swapped = torch.tensor([[True, False]])
    found = filter_.swap_memory(memory, swapped)
    assert torch.equal(found[:, 1], memory[:, 1])
    noise = torch.randn(100_000, 10, 3, generator=generator, dtype=torch.float64)
    middle = torch.zeros_like(truth[0])  # where the map of the covariances is taken
    drawn = middle.expand(100_000, -1).clone()
    drawn[:, 6:] = torch.einsum("vij,nvj->nvi", root[0, 0], noise).flatten(1)
    drawn = exchange_legs(body, drawn)[:, 6:].unflatten(-1, (-1, 3)).transpose(0, 1)
    expected = torch.stack([part.T.cov() for part in drawn])
    torch.testing.assert_close(found[0, 0], expected, rtol=0.05, atol=2e-5)
    twice = filter_.swap_memory(found, swapped)
    torch.testing.assert_close(twice, memory, rtol=1e-3, atol=1e-6)


def test_hypotheses_that_all_die_are_spread_anew():
    _, _, truth, silhouettes = scene()
    elsewhere = torch.zeros_like(silhouettes[:1])
    elsewhere[..., :8, :8] = True  # a corner, far from every part
    filter_ = tracker(10, weighting="parts")
    with pytest.warns(DegenerateFilterWarning, match="all particles died"):
        after, out = filter_.step(filter_.init(truth[:1]), elsewhere, rig(), generator=seeded(0))
    assert bool(out.respread) and torch.equal(out.mean, truth[:1])
    torch.testing.assert_close(after.memory, filter_.first_memory(after.particles))


def test_hidden_parts_rule_no_hypothesis_out():
    body, _, truth, silhouettes = scene()
    shanks = [body.skeleton.names.index(f"{side}_ankle") for side in ("left", "right")]
    others = [joint for joint in range(len(body.skeleton.names)) if joint not in shanks]
    knees = [body.skeleton.names.index(f"{side}_knee") for side in ("left", "right")]
    pixels = rig()(body.joints(truth)).pixels  # [T, C, J, 2]
    hidden = silhouettes.clone()
    for t, c in ((t, c) for t in range(FRAMES) for c in range(len(rig()))):
        hidden[t, c, int(pixels[t, c, knees, 1].min()) - 4 :] = False  # behind a table
    filter_ = tracker(40)
    track = filter_(hidden, rig(), truth[0], generator=seeded(0)[0])
    assert not bool(track.respread.any())
    found, true = body.joints(track.mean)[:, others], body.joints(truth)[:, others]
    assert float((found - true).norm(dim=-1).mean()) < 0.1


def test_a_part_that_is_not_seen_weighs_as_a_hundredth_of_its_pixels():
    area = torch.full((1, 2, 7, 3), 50)
    weight = torch.full((1, 2, 7, 3), 25.0, dtype=torch.float64)
    weight[:, 1] = 0
    for rule, normalisation, least in (
        ("product", "share", 0.01**3), ("product", "published", 0.5**3), ("sum", "share", 0.03),
    ):  # fmt: skip
        rules = {"cameras": rule, "normalisation": normalisation}
        counts = PartCounts(weight, area)
        value = part_log_likelihood(counts, **rules)
        found = parts_log_weight(value, least_part_log_likelihood(counts, **rules))
        expected = value[:, 0].logsumexp(-1) + math.log(7 * least)
        torch.testing.assert_close(found, expected)
        nothing = PartCounts(0 * weight, area)
        value = part_log_likelihood(nothing, **rules)
        assert bool(parts_log_weight(value, least_part_log_likelihood(nothing, **rules)).isneginf())


def test_hypotheses_outside_the_limits_are_discarded():
    _, _, truth, silhouettes = scene()
    tight = JointLimits(truth[0, 6:] - 1e-4, truth[0, 6:] + 1e-4, torch.full((30,), 0.01).double())
    filter_ = tracker(5, limits=tight)
    with pytest.warns(DegenerateFilterWarning):
        filter_.step(filter_.init(truth[:1]), silhouettes[:1], rig(), generator=seeded(0))
    free = tracker(5, limits=JointLimits.fit(truth, margin=10.0))
    _, out = free.step(free.init(truth[:1]), silhouettes[:1], rig(), generator=seeded(0))
    assert not bool(out.respread)


def test_another_frame_rate_is_rescaled_and_said():
    _, conditionals, _, _ = scene()
    slow = tracker(fps=15.0)
    assert slow.conditionals.info.fps == 15 and conditionals.info.fps == 60
    ratio = slow.conditionals.diffusion / conditionals.diffusion
    expected = 4 ** conditionals.growth[:, None, None].expand_as(ratio)
    known = conditionals.diffusion.abs() > 0
    torch.testing.assert_close(ratio[known], expected[known])
    assert "rescaled from 60" in repr(slow) and "15 frames per second" in repr(slow)


@pytest.mark.parametrize("fps", [60.0, 30.0, 20.0, 15.0])
def test_by_default_several_hypotheses_survive_at_every_frame_rate(fps):
    _, _, truth, silhouettes = scene()
    for n in (3, 20, 114):
        filter_ = tracker(n, fps=fps, survival_rate=None)
        assert filter_.survival_rate * n >= 2 - 1e-9
    after, out = filter_.step(filter_.init(truth[:1]), silhouettes[:1], rig(), generator=seeded(0))
    weights = after.log_weights[0].exp()
    left = float(weights.sum() ** 2 / weights.square().sum())
    assert left == pytest.approx(114 * filter_.survival_rate, rel=1e-6) and left > 10
    assert float(out.effective_sample_size) == pytest.approx(left)


def test_survival_that_leaves_one_hypothesis_is_refused():
    with pytest.raises(InputError, match=r"leaves 0\.072 of 114 particles, fewer than 2"):
        tracker(114, fps=15.0, survival_rate=None, survival_per_second=1e-48)
    fine = tracker(114, fps=60.0, survival_rate=None, survival_per_second=1e-48)
    assert fine.survival_rate == pytest.approx(1e-48 ** (1 / 60))
    with pytest.raises(InputError, match="got both"):
        tracker(survival_per_second=0.01)
    with pytest.raises(InputError, match="take more particles"):
        tracker(2, survival_rate=None)


def test_the_published_form_is_there_by_name():
    published = {"normalisation": "published", "observation_sharpness": 1.0}
    filter_ = tracker(**published, survival_per_second=0.01, survival_rate=None)
    assert filter_.survival_rate == pytest.approx(0.926, abs=1e-3)  # section 8: 0.93 at 60 Hz
    assert filter_.normalisation == "published" and filter_.observation_sharpness == 1


def test_single_precision_tracks_as_well():
    body, conditionals, truth, silhouettes = scene()
    single = RootUncertaintyTracker(
        body.altered().float(), conditionals, 10, fps=60.0, process_cov=0.01**2
    )
    track = single(silhouettes[:3], rig(), truth[0].float(), generator=seeded(0)[0])
    assert track.mean.dtype == torch.float32 and bool(track.mean.isfinite().all())
    assert error(body, track.mean.double(), truth[:3]) < 0.1


def test_what_does_not_fit_is_refused_with_a_way_out():
    body, conditionals, _, _ = scene()
    with pytest.raises(PriorError, match="in_body_frame"):
        RootUncertaintyTracker(walker(), conditionals, fps=60.0)
    with pytest.raises(InputError, match="conditionals must be LimbConditionals, got str"):
        RootUncertaintyTracker(body, "walk", fps=60.0)
    elsewhere = body.altered(centres=torch.zeros_like(body.centres))
    with pytest.raises(PriorError, match=r"Body\.altered"):
        RootUncertaintyTracker(elsewhere, conditionals, fps=60.0)
    with pytest.raises(InputError, match=r"torchpose\.body\.Body"):
        RootUncertaintyTracker(torch.nn.Identity(), conditionals, fps=60.0)
    for options, message in (
        ({"weighting": "legs"}, "weighting must be"),
        ({"likelihood": lambda states, frame: states[..., 0]}, "takes no other likelihood"),
        ({"camera_rule": "mean"}, "cameras must be"),
        ({"least_std": -1.0}, "least_std must be"),
        ({"first_std": math.inf}, "first_std must be"),
        ({"survival_rate": 0.0}, "survival_rate must lie"),
        ({"fps": 0.0}, "fps must be"),
    ):
        with pytest.raises(InputError, match=message):
            tracker(**options)
