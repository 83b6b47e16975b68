"""The network that lifts one camera is causal and sized by the person; it corrects means, not covariances."""

import pytest
import torch

import torchpose
from benchmarks.keypoint_bodies.clips import MHAD, begun, read_clips
from tests.data import data_dir_or_skip
from tests.whole_body.keypoints.scenes import FPS, NAMES, moving_body, ring, scene
from torchpose.body import BODY_15, Body
from torchpose.body._articulation import Articulation
from torchpose.errors import FileFormatError, InputError
from torchpose.priors._shipped import load_body_motion
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame
from torchpose.whole_body._keypoints.keypoint_start import _points
from torchpose.whole_body._keypoints.known_person import with_body
from torchpose.whole_body._keypoints.lifted_pose import PoseLifter, corrected_by, nothing_lifted
from torchpose.whole_body._keypoints.lifting_network import (
    Lifted,
    LiftingNetwork,
    LiftingNetworkInfo,
    lifting_features,
    shipped_lifting_network,
)

PELVIS = BODY_15.joint("pelvis")


def tracker(**options):
    return torchpose.BodyTracker(ring(1), "kalman", fps=FPS, **options)


def relative(joints):
    return joints - joints[..., [PELVIS], :]


def frame_of(pixels, inlier=0.9):
    one = torch.ones_like(pixels[..., 0])
    return KeypointFrame(pixels, one, 1e-4 * one, inlier * one)


def test_features_know_neither_what_is_missing_nor_the_zoom():
    rays = torch.randn(3, 15, 2)
    sure = torch.full((3, 15), 0.9)
    sure[:, 4] = 0.0
    other = rays.clone()
    other[:, 4] = 7.0
    assert torch.equal(lifting_features(rays, sure, 30.0), lifting_features(other, sure, 30.0))
    near, far = (lifting_features(scale * rays, sure, 30.0) for scale in (2.0, 1.0))
    torch.testing.assert_close(near[:, :30], far[:, :30])  # relative to the extent
    assert not torch.allclose(near, far)  # which is told
    nothing = lifting_features(rays, torch.zeros(3, 15), 30.0)
    assert bool(nothing.isfinite().all())


def test_the_network_is_causal_and_goes_on_where_it_stopped():
    network = shipped_lifting_network()
    seen = torch.randn(2, 7, network.cells.input_size)
    whole, memory = network(seen)
    first, kept = network(seen[:, :3])
    second, after = network(seen[:, 3:], kept)
    torch.testing.assert_close(torch.cat([first.joints, second.joints], 1), whole.joints)
    torch.testing.assert_close(torch.cat([first.std, second.std], 1), whole.std)
    torch.testing.assert_close(after, memory)
    assert bool((whole.std > 0).all())


def test_a_saved_network_is_the_same_but_for_half_precision(tmp_path):
    torch.manual_seed(0)
    network = LiftingNetwork(LiftingNetworkInfo("mine", ("a", "b"), "MIT", "make", 0.7)).eval()
    network.save(tmp_path / "mine.safetensors")
    again = LiftingNetwork.load(tmp_path / "mine.safetensors")
    assert again.info == network.info
    seen = torch.randn(1, 4, network.cells.input_size)
    torch.testing.assert_close(again(seen)[0].joints, network(seen)[0].joints, atol=1e-3, rtol=0.02)
    load_body_motion("whole-body").save(tmp_path / "other.safetensors")
    with pytest.raises(FileFormatError):
        LiftingNetwork.load(tmp_path / "other.safetensors")


def state_of(motion):
    """A body that stands at the joints of a moving one, and a wide covariance."""
    body = motion.articulation
    joints = moving_body(1)
    maps = torchpose.BodyTracker(ring(2), "kalman", fps=FPS).by_keypoints.tracker.filter.maps
    point = _points(body, motion, maps, joints, 1)
    point = body.swung(point, joints, torch.ones(1, 15, dtype=torch.bool))
    cov = 0.05**2 * torch.eye(body.dim, dtype=torch.float64)
    scales = body.columns["scales"]
    cov[scales, scales] *= 1e-6
    return point, cov[None]


def test_what_was_lifted_moves_the_mean_as_far_as_it_is_sure():
    motion = load_body_motion("whole-body")
    body: Articulation = motion.articulation
    point, cov = state_of(motion)
    before = body.joints(point)
    wanted = relative(before) + torch.tensor([0.0, 0.0, 0.04], dtype=torch.float64)
    wanted[:, PELVIS] = 0
    moved = {}
    for std in (1e-4, 0.05, 10.0):
        lifted = Lifted(wanted, torch.full((1, 15), std, dtype=torch.float64))
        moved[std] = body.joints(corrected_by(lifted, body, point, cov))
    gaps = [float((relative(x) - wanted)[0, 1:].norm(dim=-1).mean()) for x in moved.values()]
    assert gaps[0] < gaps[1] < gaps[2] < 0.0401
    lengths = [
        body.bones(corrected_by(lifted, body, point, cov)).norm(dim=-1)[0, 3:],
        body.bones(point).norm(dim=-1)[0, 3:],
    ]
    torch.testing.assert_close(*lengths, atol=2e-3, rtol=0)
    same = corrected_by(nothing_lifted(before), body, point, cov)
    torch.testing.assert_close(body.joints(same), before)


def test_a_larger_person_is_lifted_larger_and_few_keypoints_are_not_lifted():
    motion = load_body_motion("whole-body")
    rig, pixels = ring(1), ring(1)(moving_body(1)).pixels
    usual = PoseLifter(rig, FPS, motion)(frame_of(pixels), None)[0]
    large = with_body(motion, Body.of_height(BODY_15, 2.1))
    other = PoseLifter(rig, FPS, large)(frame_of(pixels), None)[0]
    ratio = other.std / usual.std
    torch.testing.assert_close(ratio, ratio[:1, :1].expand_as(ratio))
    torch.testing.assert_close(other.joints, ratio[0, 0] * usual.joints)
    assert 1.1 < float(ratio[0, 0]) < 1.4
    few = frame_of(pixels)
    few.inlier[..., 5:] = 0
    assert bool(PoseLifter(rig, FPS, motion)(few, None)[0].std.isinf().all())


def test_persons_of_no_fit_are_nearer_with_it():
    data = data_dir_or_skip(MHAD).parent
    names = {MHAD: ("s09_a09_sit_stand_r1", "s10_a05_wave_two_hands_r1")}
    errors = dict.fromkeys((True, False), 0.0)
    for clip in read_clips(data, names)[MHAD]:
        one = begun(clip, 60).of_cameras(1)
        for lifting in errors:
            track = torchpose.BodyTracker(one.rig, "kalman", fps=one.fps, lifting=lifting)(
                keypoints=one.seen.keypoints, confidence=one.seen.confidence
            )
            off = relative(track.joints3d) - relative(one.joints)
            errors[lifting] += float(off.norm(dim=-1).nanmean())
    assert errors[True] < 0.9 * errors[False]


def test_evidence_and_covariances_are_those_of_the_filter():
    one = scene(1, 10)
    given = {"keypoints": one.keypoints, "confidence": one.confidence, "names": NAMES}
    lifted, alone = (tracker(lifting=lifting)(**given) for lifting in (True, False))
    assert not torch.allclose(lifted.joints3d, alone.joints3d, atol=1e-3)
    assert torch.equal(lifted.log_evidence, alone.log_evidence)
    stds = [
        x.covariance3d.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt().mean() for x in (lifted, alone)
    ]
    assert float(stds[0] / stds[1]) == pytest.approx(1.0, abs=0.1)


def test_steps_are_corrected_as_whole_sequences_are():
    one = scene(1, 6)
    whole = tracker()(keypoints=one.keypoints, confidence=one.confidence, names=NAMES)
    live, state = tracker(), None
    state = live.init()
    for t in range(6):
        state, pose = live.step(
            state, keypoints=one.keypoints[t], confidence=one.confidence[t], names=NAMES
        )
        torch.testing.assert_close(pose.joints3d[0], whole.joints3d[t])


def test_a_module_in_double_precision_lifts_the_same():
    one = scene(1, 3)
    given = {"keypoints": one.keypoints, "confidence": one.confidence, "names": NAMES}
    single, double = tracker()(**given), tracker().double()(**given)
    torch.testing.assert_close(single.joints3d, double.joints3d, atol=1e-4, rtol=0)


def test_several_cameras_and_particle_filters_lift_nothing():
    assert torchpose.BodyTracker(ring(2), "kalman", fps=FPS).by_keypoints.tracker.lifter is None
    assert tracker(lifting=False).by_keypoints.tracker.lifter is None
    with pytest.raises(InputError, match="lifting"):
        torchpose.BodyTracker(ring(2), "sir", lifting=False)
