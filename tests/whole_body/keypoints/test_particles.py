"""Particle filters over bodies that keypoints weigh."""

import math
import pickle

import pytest
import torch

from tests.whole_body.keypoints.scenes import errors, ring, scene
from torchpose import BodyTracker
from torchpose.body import BODY_15, Body
from torchpose.body._skeleton import other_side
from torchpose.errors import CameraError, InputError, NobodySeenError, ShapeError
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame, RigMaps
from torchpose.whole_body._keypoints.particle_likelihood import (
    KeypointMeasurement,
    keypoint_log_likelihood,
    limbs_given_keypoints,
)

METHODS = {
    "sir": {}, "apf": {}, "mrpf": {"manifold": "walk"}, "root": {"conditionals": "walk"},
    "constrained": {"action": "exercises"},
}  # fmt: skip
_ARMS = ("left_shoulder", "left_elbow", "left_wrist")
_LEGS = ("left_hip", "left_knee", "left_ankle")
_ODDS = 1 / (1 + math.exp(3.0))  # prior probability of exchanged sides


def _measured(seen, t=0, power=1.0):
    pixels = seen.keypoints[t : t + 1].clone()
    one = torch.ones_like(pixels[..., 0])
    return KeypointMeasurement(
        KeypointFrame(pixels, one, 0.012**2 * one, 0.9 * one), RigMaps.of(seen.rig), power
    )


def _particles(seen, count=3):
    generator = torch.Generator().manual_seed(1)
    shift = 0.02 * torch.randn(1, count, 15, 3, generator=generator, dtype=torch.float64)
    return seen.joints[:1, None] + shift


def _mirror(joint):
    return BODY_15.joint(other_side(BODY_15.names[joint]))


def _by_loops(measured, joints):
    """The likelihood of one particle [15, 3], camera by camera and keypoint by keypoint."""
    total, maps, frame = 0.0, measured.maps, measured.frame
    sided = {BODY_15.joint(n): g for g, names in enumerate((_ARMS, _LEGS)) for n in names}
    sided |= {_mirror(j): g for j, g in sided.items()}

    def density(c, joint, keypoint):
        pi = float(frame.inlier[0, c, keypoint])
        if pi == 0:
            return 0.0
        x, y, depth = (maps.matrix[c] @ joints[joint] + maps.shift[c]).tolist()
        pixel = torch.tensor([x / depth, y / depth], dtype=torch.float64)
        rows = maps.matrix[c, :2] - pixel[:, None] * maps.matrix[c, 2:]
        variance = float(frame.variance[0, c, keypoint])
        relative = float(frame.relative[0, c, keypoint])
        variance += relative * 0.5 * float((rows / depth).square().sum())
        square = float((frame.pixels[0, c, keypoint] - pixel).square().sum())
        inlier = pi / (2 * math.pi * variance) * math.exp(-0.5 * square / variance)
        return math.log(inlier + (1 - pi) * math.exp(-float(maps.log_area[c])))

    for c in range(len(maps.shift)):
        for group in (0, 1):
            members = [j for j, g in sided.items() if g == group]
            own = sum(density(c, j, j) for j in members)
            other = sum(density(c, j, _mirror(j)) for j in members)
            peak = max(own, other)
            mixed = (1 - _ODDS) * math.exp(own - peak) + _ODDS * math.exp(other - peak)
            total += peak + math.log(mixed)
        total += sum(density(c, j, j) for j in range(15) if j not in sided)
    return total


@pytest.mark.parametrize("kind", ["plain", "missing", "exchanged", "outlier"])
def test_the_likelihood_equals_loops_over_particles_cameras_and_joints(kind):
    seen = scene(cameras=2, n_frames=1)
    measured = _measured(seen)
    if kind == "missing":
        measured.frame.inlier[0, 0, [3, 7]] = 0.0
    if kind == "exchanged":
        other = [_mirror(j) for j in range(15)]
        measured.frame.pixels[0, 1] = measured.frame.pixels[0, 1, other]
    if kind == "outlier":
        measured.frame.pixels[0, 0, 5] += 500.0
    joints = _particles(seen)
    expected = torch.tensor([_by_loops(measured, p) for p in joints[0]], dtype=torch.float64)
    torch.testing.assert_close(keypoint_log_likelihood(measured, joints)[0], expected)
    halved = keypoint_log_likelihood(measured._replace(power=0.5), joints)[0]
    torch.testing.assert_close(halved, 0.5 * expected)


def test_one_keypoint_lowers_the_likelihood_by_no_more_than_an_outlier_does():
    seen = scene(cameras=2, n_frames=1)
    near, far, farther = _measured(seen), _measured(seen), _measured(seen)
    head = BODY_15.joint("head")
    far.frame.pixels[0, 0, head] += 1e3
    farther.frame.pixels[0, 0, head] += 1e6
    joints = _particles(seen)
    values = [keypoint_log_likelihood(m, joints) for m in (near, far, farther)]
    torch.testing.assert_close(values[1], values[2])
    assert bool((values[0] - values[1] < 25).all())


def test_joints_behind_a_camera_are_no_better_than_outliers():
    seen = scene(cameras=1, n_frames=1)
    measured, joints = _measured(seen), _particles(seen, 1)
    behind = joints + 100 * (seen.rig.rotation[0].T @ torch.tensor([0.0, 0.0, -1.0]).double())
    assert float(keypoint_log_likelihood(measured, behind)) < float(
        keypoint_log_likelihood(measured, joints)
    )


def test_exchanged_sides_cost_their_prior_and_not_the_pose():
    seen = scene(cameras=3, n_frames=1, noise=0.0)
    joints = seen.joints[:1, None]
    straight, exchanged = _measured(seen), _measured(seen)
    exchanged.frame.pixels[0, 0] = exchanged.frame.pixels[0, 0, [_mirror(j) for j in range(15)]]
    lost = keypoint_log_likelihood(straight, joints) - keypoint_log_likelihood(exchanged, joints)
    assert float(lost) == pytest.approx(2 * math.log((1 - _ODDS) / _ODDS), abs=0.1)


def test_keypoints_turn_limbs_towards_where_they_are():
    body = Body.of_height(BODY_15, 1.7).altered(frame="body")
    state = torch.zeros(1, 1, body.dim, dtype=torch.float64)
    turned = state.clone()
    forearm = BODY_15.parts.index("left_forearm")
    turned[..., 3 + 3 * forearm + 2] = 0.1
    rig = scene(cameras=3, n_frames=1).rig
    pixels = rig(body.joints(turned)[0]).pixels
    one = torch.ones_like(pixels[..., 0])
    frame = KeypointFrame(pixels, one, 1e-6 * one, 0.99 * one)
    mean = state[..., 6:].unflatten(-1, (-1, 3))
    cov = (0.1**2 * torch.eye(3, dtype=torch.float64)).expand(*mean.shape, 3).clone()
    new, new_cov = limbs_given_keypoints(
        KeypointMeasurement(frame, RigMaps.of(rig)), body, state, mean, cov
    )
    found = body.joints(body.with_relative(state, new.flatten(-2)))
    wrist = BODY_15.joint("left_wrist")
    before = (body.joints(state) - body.joints(turned))[0, 0, wrist].norm()
    after = (found - body.joints(turned))[0, 0, wrist].norm()
    assert float(after) < 0.2 * float(before)
    spread = torch.linalg.eigvalsh(new_cov[0, 0, forearm - 1]).sqrt()
    assert float(spread[0]) < 0.02  # across the forearm
    assert float(spread[-1]) == pytest.approx(0.1, rel=0.1)  # about it no keypoint tells


@pytest.mark.parametrize("method", METHODS)
def test_every_method_tracks_keypoints_alone(method):
    seen = scene(cameras=3, n_frames=8)
    tracker = BodyTracker(seen.rig, method, height=1.7, fps=30, n_particles=300, **METHODS[method])
    poses = tracker(
        keypoints=seen.keypoints, confidence=seen.confidence,
        generator=torch.Generator().manual_seed(0),
    )  # fmt: skip
    assert len(poses) == 8
    assert float(errors(poses, seen.joints).mean()) < 0.15
    assert poses.method == method


def test_init_step_and_advance_give_the_numbers_of_forward():
    seen = scene(cameras=2, n_frames=5)
    tracker = BodyTracker(seen.rig, "sir", height=1.7, fps=10, n_particles=50)
    given = {"keypoints": seen.keypoints, "confidence": seen.confidence}
    whole = tracker(**given, generator=torch.Generator().manual_seed(3))
    state = tracker.init(**given, generator=torch.Generator().manual_seed(3))
    state, one = tracker.step(state, keypoints=seen.keypoints[0], confidence=seen.confidence[0])
    _, rest = tracker.advance(state, keypoints=seen.keypoints[1:], confidence=seen.confidence[1:])
    assert torch.equal(torch.cat([one.state, rest.state]), whole.state)


def test_a_loaded_state_reaches_what_keypoints_are_measured_by():
    seen = scene(cameras=2, n_frames=3)
    given = {"keypoints": seen.keypoints, "confidence": seen.confidence}
    options = {"height": 1.7, "fps": 10, "n_particles": 30}
    tracker = BodyTracker(seen.rig, "sir", **options)
    size = len(pickle.dumps(tracker))
    expected = tracker(**given, generator=torch.Generator().manual_seed(0)).state
    assert len(pickle.dumps(tracker)) == size
    other = BodyTracker(ring(2, 5.0), "sir", **options)
    other(**given, generator=torch.Generator().manual_seed(0))
    other.load_state_dict(tracker.state_dict())
    again = other(**given, generator=torch.Generator().manual_seed(0)).state
    assert torch.equal(again, expected)


@pytest.mark.parametrize("method", ["kalman", "sir"])
def test_autocast_changes_nothing(method):
    seen = scene(cameras=1, n_frames=3)
    options = {} if method == "kalman" else {"n_particles": 30}
    tracker = BodyTracker(seen.rig, method, height=1.7, fps=30, **options)
    seeds = (
        {} if method == "kalman" else {"generator": torch.Generator().manual_seed(0)}
        for _ in range(2)
    )
    expected = tracker(keypoints=seen.keypoints, **next(seeds))
    with torch.autocast("cpu", torch.bfloat16):
        found = tracker(keypoints=seen.keypoints, **next(seeds))
    assert torch.equal(found.joints3d, expected.joints3d)


def test_silhouettes_and_keypoints_add():
    seen = scene(cameras=2, n_frames=3)
    rig = seen.rig.scaled(54, 96)
    empty = torch.zeros(3, 2, 54, 96, dtype=torch.bool)
    tracker = BodyTracker(rig, "sir", height=1.7, fps=30, n_particles=30)
    given = {"keypoints": seen.keypoints / 20, "confidence": seen.confidence}
    alone = tracker(**given, generator=torch.Generator().manual_seed(0))
    unseen = tracker(empty, **given, generator=torch.Generator().manual_seed(0))
    assert torch.equal(alone.joints3d, unseen.joints3d)  # empty silhouettes tell nothing
    masks = empty.clone()
    masks[..., 10:44, 40:56] = True
    both = tracker(masks, **given, generator=torch.Generator().manual_seed(0))
    assert not torch.equal(alone.joints3d, both.joints3d)
    with pytest.raises(InputError, match="same number of frames"):
        tracker(masks[:2], **given)


def test_frames_without_keypoints_coast():
    seen = scene(cameras=2, n_frames=4)
    keypoints = seen.keypoints.clone()
    keypoints[2] = torch.nan
    tracker = BodyTracker(seen.rig, "apf", height=1.7, fps=30, n_particles=100)
    poses = tracker(keypoints=keypoints, generator=torch.Generator().manual_seed(0))
    assert poses.coasting.tolist() == [False, False, True, False]


def test_the_first_pose_is_that_of_the_frame_in_which_two_cameras_see_the_person():
    seen = scene(cameras=3, n_frames=12, noise=2.0)
    seen.keypoints[:3, 1:] = math.nan
    tracker = BodyTracker(seen.rig, "sir", height=1.7, n_particles=100, fps=30.0)
    found = tracker(keypoints=seen.keypoints, generator=torch.Generator().manual_seed(0))
    assert found.first_frame == 3 and any("first 3 frames" in note for note in found.notes)
    assert float(errors(found, seen.joints[3:])[0].mean()) < 0.07


def test_a_live_stream_begins_with_the_pose_that_one_camera_tells():
    seen = scene(cameras=3, n_frames=6, noise=2.0)
    seen.keypoints[:, 1:] = math.nan
    tracker = BodyTracker(seen.rig, "sir", height=1.7, n_particles=100, fps=30.0)
    state = tracker.init(keypoints=seen.keypoints, generator=torch.Generator().manual_seed(0))
    joints = tracker.body.joints(state.filter.particles[0].mean(0))
    assert float((joints - seen.joints[0]).norm(dim=-1).mean()) < 0.4
    seen.keypoints[:, :, 5:] = math.nan
    with pytest.raises(NobodySeenError, match="in any camera"):
        tracker.init(keypoints=seen.keypoints)


def test_a_live_frame_of_outliers_alone_is_no_error():
    seen = scene(cameras=1, n_frames=2)
    tracker = BodyTracker(seen.rig, "sir", height=1.7, n_particles=20)
    state = tracker.init(keypoints=seen.keypoints, generator=torch.Generator().manual_seed(0))
    wild = {"keypoints": torch.full_like(seen.keypoints[1], 6000.0)}
    with pytest.raises(CameraError, match="lie outside its image"):
        tracker.step(state, **wild)
    state, _ = tracker.step(state, keypoints=seen.keypoints[0])
    assert bool(tracker.step(state, **wild)[1].joints3d.isfinite().all())


def test_bad_keypoints_are_refused():
    seen = scene(cameras=2, n_frames=2)
    tracker = BodyTracker(seen.rig, "sir", height=1.7, n_particles=20)
    with pytest.raises(InputError, match="silhouettes, keypoints or both"):
        tracker()
    with pytest.raises(InputError, match="smoothing"):
        tracker(keypoints=seen.keypoints, smoothing="full")
    with pytest.raises(ShapeError, match="keypoints"):
        tracker(keypoints=seen.keypoints[None])
    with pytest.raises(NobodySeenError, match="no keypoint"):
        tracker(keypoints=torch.full_like(seen.keypoints, torch.nan))
    masks, kalman = torch.ones(2, 2, 54, 96, dtype=torch.bool), BodyTracker(seen.rig, "kalman")
    with pytest.raises(InputError, match="takes keypoints and no silhouettes"):
        kalman(masks, keypoints=seen.keypoints)
    with pytest.raises(InputError, match="takes keypoints and no silhouettes"):
        kalman.step(kalman.init(), masks[0], keypoints=seen.keypoints[0])
