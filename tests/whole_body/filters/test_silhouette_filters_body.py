"""The filters on a body and its silhouettes: tracking, coasting, bad input, a learnt manifold."""

import math

import pytest
import torch

from tests.draws import generator
from tests.whole_body.filters.walking_body import HEIGHT, WIDTH, rig, walk, walker
from torchpose.body import JointLimits
from torchpose.camera import PinholeCamera
from torchpose.errors import CameraError, PriorError
from torchpose.learning import fit_gplvm, fit_gplvm_noise
from torchpose.whole_body import (
    AnnealedParticleFilter,
    ManifoldParticleFilter,
    SIRParticleFilter,
    fit_sharpness,
    motion_std,
    render,
)
from torchpose.whole_body._filters.body_frames import without_specks
from torchpose.whole_body._sharpness import ValidationSequence, mean_joint_error

BODY, RIG = walker(), rig()


@pytest.fixture(scope="module")
def sequence():
    """States and silhouettes of 20 frames, and the state before them."""
    states = walk(BODY, 21)
    return states[0], states[1:], render(BODY, states[1:], RIG, HEIGHT, WIDTH)


@pytest.fixture(scope="module")
def process_cov():
    return motion_std(BODY, walk(BODY, 120, seed=3), floor=1e-3).square()


@pytest.fixture(scope="module")
def manifold():
    train, validation = walk(BODY, 90, seed=1), walk(BODY, 70, seed=2, phase=0.2)
    found = fit_gplvm(BODY.relative(train), steps=4)
    return fit_gplvm_noise(found, BODY.relative(validation), fps=60.0)


def make(kind, process_cov, manifold, **options):
    options = {"process_cov": process_cov, "sharpness": 60.0, **options}
    if kind == "sir":
        return SIRParticleFilter(BODY, 300, **options)
    if kind == "annealed":
        return AnnealedParticleFilter(BODY, 100, n_layers=3, **options)
    return ManifoldParticleFilter(BODY, manifold, 300, **options)


@pytest.mark.parametrize("kind", ["sir", "annealed", "manifold"])
def test_a_walk_is_tracked(kind, sequence, process_cov, manifold):
    start, states, silhouettes = sequence
    tracker = make(kind, process_cov, manifold)
    out = tracker(silhouettes, RIG, start, generator=generator())
    error = mean_joint_error(BODY, out.mean, BODY.joints(states))
    still = mean_joint_error(BODY, start.expand_as(states), BODY.joints(states))
    assert float(error) < 0.1 < 0.5 * float(still)
    assert out.mean.shape == out.std.shape == (20, 36)
    assert not out.coasting.any() and not out.respread.any()
    if kind != "annealed":
        assert (out.log_evidence < 0).all()


@pytest.mark.parametrize("kind", ["sir", "annealed", "manifold"])
def test_empty_silhouettes_let_the_filter_coast(kind, sequence, process_cov, manifold):
    start, _, silhouettes = sequence
    gone = silhouettes[:12].clone()
    gone[4:10] = False
    one_blind = silhouettes[:12].clone()
    one_blind[:, 0] = False
    both = torch.stack([gone, one_blind])
    out = make(kind, process_cov, manifold)(both, RIG, start, generator=generator())
    expected = torch.zeros(2, 12, dtype=torch.bool)
    expected[0, 4:10] = True
    assert (out.coasting == expected).all()
    assert (out.log_evidence[0, 4:10] == 0).all()
    spread = out.std[0, :, :3].norm(dim=-1)
    assert spread[9] > spread[6] > 1.2 * spread[3] and spread[11] < spread[9]
    assert out.mean.isfinite().all()


def test_specks_are_nobody(sequence, process_cov):
    """The topmost rows of the person who has left; more of them are the person."""
    start, _, silhouettes = sequence
    tops = silhouettes[:8].any(-1).cumsum(-1)[..., None]
    shown = [silhouettes[:8] & (tops <= rows) for rows in (0, 1, 12)]
    given = torch.stack([torch.cat([silhouettes[:4], part[4:]]) for part in shown])
    tracker = SIRParticleFilter(BODY, 100, process_cov=process_cov, sharpness=60.0)
    out = tracker(given, RIG, start, generator=[generator() for _ in range(3)])
    assert given[1, 4:].flatten(2).any(-1).all()
    assert out.coasting[:2, 4:].all() and not out.coasting[2].any()
    assert torch.equal(out.mean[0], out.mean[1]) and not torch.equal(out.mean[0], out.mean[2])


def test_specks_where_the_body_is_expected_beside_the_image_are_a_share_of_that():
    beside = walk(BODY, 1).clone()
    beside[:, :3] += 100.0
    some = torch.zeros(1, len(RIG), HEIGHT, WIDTH, dtype=torch.bool)
    few = some.clone()
    few[..., : round(0.001 * HEIGHT * WIDTH)][..., 0, :] = True
    some[..., 0, :] = True
    for silhouettes, seen in ((few, False), (some, True)):
        found = without_specks(BODY, beside, silhouettes, RIG)
        assert bool(found.area.all()) == bool(found.area.any()) == seen


def test_overlap_limits_and_single_precision(sequence, process_cov):
    start, states, silhouettes = sequence
    limits = JointLimits.fit(walk(BODY, 120, seed=5))
    tracker = SIRParticleFilter(
        walker().float(), 100, process_cov=process_cov, likelihood="overlap", sharpness=30.0,
        limits=limits.float(),
    )  # fmt: skip
    out = tracker(silhouettes[:6], RIG, start, generator=generator())
    assert out.mean.dtype == torch.float32
    # the mean of what lies in a box lies in it
    low, high = limits.lower - 1e-5, limits.upper + 1e-5
    assert ((out.mean[:, 6:] >= low) & (out.mean[:, 6:] <= high)).all()
    error = mean_joint_error(BODY, out.mean.double(), BODY.joints(states[:6]))
    assert float(error) < 0.1


def test_a_body_that_no_camera_has_in_view_is_no_error(sequence, process_cov):
    start, _, silhouettes = sequence
    behind = start.clone()
    behind[0] += 50.0
    out = SIRParticleFilter(BODY, 20, process_cov=process_cov)(
        silhouettes[:2], RIG, behind, generator=generator()
    )
    # model and silhouette share nothing: both terms are 1 in every camera (MR 12)
    assert out.log_evidence.tolist() == pytest.approx([-2.0, -2.0])
    assert not out.coasting.any()


def test_cameras_that_do_not_match(sequence, process_cov):
    start, _, silhouettes = sequence
    tracker = SIRParticleFilter(BODY, 5, process_cov=process_cov)
    with pytest.raises(CameraError, match="2 cameras"):
        tracker(silhouettes, RIG.select([0, 1]), start)
    with pytest.raises(CameraError, match="60 x 80"):
        tracker(silhouettes[..., ::2], RIG, start)
    with pytest.raises(CameraError):
        tracker.step(tracker.init(start[None]), silhouettes[:1, :2], RIG)
    with pytest.raises(CameraError, match="60 x 80"):  # whatever they show
        tracker(torch.zeros(3, 3, 60, 40, dtype=torch.bool), RIG, start)


def test_cameras_may_come_one_after_the_other(sequence, process_cov):
    start, _, silhouettes = sequence
    tracker = SIRParticleFilter(BODY, 5, process_cov=process_cov)
    cameras = [
        PinholeCamera(
            90, 90, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT, name, translation=(0, 0, 3)
        )
        for name in RIG.names
    ]  # fmt: skip
    one, two = (
        tracker(silhouettes[:3], given, start, generator=generator()).mean
        for given in (cameras, iter(cameras))
    )
    assert torch.equal(one, two)


def test_a_manifold_of_another_body_is_refused(manifold):
    other = fit_gplvm(walk(BODY, 40)[:, 6:12], steps=1)
    fit_gplvm_noise(other, walk(BODY, 40, seed=4)[:, 6:12], fps=60.0)
    with pytest.raises(PriorError, match="6 columns"):
        ManifoldParticleFilter(BODY, other)
    with pytest.raises(PriorError, match="30"):
        ManifoldParticleFilter(BODY, manifold, fps=30.0)
    unfinished = fit_gplvm(BODY.relative(walk(BODY, 40)), steps=1)
    with pytest.raises(PriorError, match="fit_gplvm_noise"):
        ManifoldParticleFilter(BODY, unfinished)


@pytest.mark.parametrize("weights", ["published", "normalised"])
def test_the_manifold_keeps_what_no_camera_shows_near_it(weights, sequence, process_cov, manifold):
    """Without evidence particles wander off, but for the manifold."""
    start, frames = sequence[0], torch.ones(50, 1)
    options = {
        "process_cov": process_cov.clamp_min(0.012**2),
        "likelihood": lambda states, frame: torch.zeros(states.shape[:2]),
    }
    distance = {}
    for name, tracker in {
        "free": SIRParticleFilter(BODY, 100, **options),
        "held": ManifoldParticleFilter(
            BODY, manifold, 100, weights=weights, proposal="product", **options
        ),
    }.items():
        state, seeds = tracker.init(start[None]), [generator(1)]
        for frame in frames:
            state, _ = tracker.step(state, frame[None], None, generator=seeds)
        relative = BODY.relative(state.particles)
        gap = (relative - manifold.reconstruct(relative)) / manifold.std_pose.clamp_min(1e-3)
        distance[name] = float(gap.square().mean().sqrt())
    assert distance["held"] < 0.6 * distance["free"]


def test_sharpness_is_fitted_on_silhouettes(sequence, process_cov):
    start, states, silhouettes = sequence
    one = ValidationSequence(silhouettes[:8], RIG, states[:8], start)
    found = fit_sharpness(
        lambda s: SIRParticleFilter(BODY, 80, process_cov=process_cov, sharpness=s),
        [one], values=[1.0, 60.0], seeds=3,
    )  # fmt: skip
    assert found.sharpness == 60.0
    assert all(math.isfinite(e) for e in found.errors)
