"""The network that lifts one camera is causal and sized by the person, and a measurement of the filter."""

import cv2
import pytest
import torch

import torchpose
from benchmarks.keypoint_bodies.clips import MHAD, WALKS, begun, read_clips
from benchmarks.keypoint_bodies.sitting import sitting_clips
from tests.data import data_with
from tests.whole_body.keypoints.scenes import FPS, NAMES, kalman, moving_body, ring, scene
from torchpose.body import BODY_15, Body
from torchpose.body._skeleton import other_side
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.errors import FileFormatError
from torchpose.math._rotations import rotvec_to_matrix
from torchpose.priors._lifting_network import (
    Lifted,
    LiftingNetwork,
    LiftingNetworkInfo,
    lifting_features,
    shipped_lifting_network,
)
from torchpose.priors._shipped import load_body_motion
from torchpose.whole_body._keypoints.adapted_noise import AdaptedNoise
from torchpose.whole_body._keypoints.body_kalman import BodyGaussian
from torchpose.whole_body._keypoints.body_roll import BodyRoll, next_roll
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame
from torchpose.whole_body._keypoints.keypoint_start import _points
from torchpose.whole_body._keypoints.keypoint_tracker import KeypointTracker
from torchpose.whole_body._keypoints.known_person import with_body
from torchpose.whole_body._keypoints.lifted_pose import (
    _FACTOR,
    PoseLifter,
    corrected_by,
    place_on_rays,
)

PELVIS = BODY_15.joint("pelvis")
LEGS = [i for i, name in enumerate(BODY_15.names) if name.endswith(("knee", "ankle"))]
KNEES = [BODY_15.joint("left_knee"), BODY_15.joint("right_knee")]
SHOULDERS = [BODY_15.joint(name) for name in ("left_shoulder", "right_shoulder", "neck")]
ANKLES = [BODY_15.joint("left_ankle"), BODY_15.joint("right_ankle")]
LIMBS = [
    i for i, name in enumerate(BODY_15.names) if name.endswith(("elbow", "wrist", "knee", "ankle"))
]


def tracker(**options):
    return kalman(ring(1), **options)


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
    """A filter, and its state of a body that stands at the joints of a moving one, with a wide covariance."""
    body, joints = motion.articulation, moving_body(1)
    filter = KeypointTracker(ring(1), FPS, motion).filter
    point = _points(body, motion, filter.maps, joints, 1)
    point = body.swung(point, joints, torch.ones(1, 15, dtype=torch.bool))
    cov = 0.05**2 * torch.eye(body.dim, dtype=torch.float64)
    scales = body.columns["scales"]
    cov[scales, scales] *= 1e-6
    new = point.position.new_zeros
    state = BodyGaussian(
        point, cov[None], new(1, 1, 2), new(1, 1), new(1, 15), new(1, 1), new(1, 15, 3),
        AdaptedNoise.usual(new(1, 45)),
    )  # fmt: skip
    return filter, state


def lifted_from(joints, std, off=(0.0, 0.0, 0.0)):
    wanted = relative(joints) + torch.tensor(off, dtype=torch.float64)
    wanted[:, PELVIS] = 0
    return Lifted(wanted, torch.full((1, 15), std, dtype=torch.float64))


def test_what_was_lifted_moves_the_mean_as_far_as_it_is_sure():
    filter, state = state_of(load_body_motion("whole-body"))
    body = filter.articulation
    before = body.joints(state.mean)
    gaps = []
    for std in (1e-4, 0.05, 10.0):
        lifted = lifted_from(before, std, (0.0, 0.0, 0.04))
        after = corrected_by(lifted, filter, state).mean
        gaps.append(
            float((relative(body.joints(after)) - lifted.joints).norm(dim=-1)[0, 1:].mean())
        )
        lengths = [body.bones(point).norm(dim=-1)[0, LIMBS] for point in (after, state.mean)]
        torch.testing.assert_close(*lengths, atol=2e-3, rtol=0)
    assert gaps[0] < gaps[1] < gaps[2] < 0.0401
    nothing = corrected_by(lifted_from(before, torch.inf), filter, state)
    torch.testing.assert_close(body.joints(nothing.mean), before)
    torch.testing.assert_close(nothing.cov, state.cov)


def test_the_correction_is_the_dense_kalman_update():
    """Of a measurement so near that the joints are linear in the state."""
    filter, state = state_of(load_body_motion("whole-body"))
    body = filter.articulation
    joints, jacobian = body.linearise(state.mean)
    others = [j for j in range(15) if j != PELVIS]
    lifted = lifted_from(joints, 0.07, (0.0, 2e-5, 1e-5))
    H = (jacobian - jacobian[:, [PELVIS]])[0, others].reshape(-1, body.dim)
    noise = (_FACTOR * 0.07) ** 2 * torch.eye(len(H), dtype=torch.float64)
    gain = torch.linalg.solve(H @ state.cov[0] @ H.mT + noise, H @ state.cov[0]).mT
    after = corrected_by(lifted, filter, state)
    torch.testing.assert_close(
        after.cov[0], state.cov[0] - gain @ H @ state.cov[0], atol=1e-7, rtol=0
    )
    step = gain @ (lifted.joints - relative(joints))[0, others].flatten()
    expected = body.joints(body.moved(state.mean, step[None]))
    torch.testing.assert_close(body.joints(after.mean), expected, atol=1e-8, rtol=0)


def test_a_body_is_placed_on_its_rays_beside_a_wild_one():
    generator = torch.Generator().manual_seed(0)
    joints = 0.4 * torch.randn(1, 15, 3, generator=generator, dtype=torch.float64)
    place = torch.tensor([0.3, -0.2, 4.0], dtype=torch.float64)
    seen = joints + place
    rays = seen[..., :2] / seen[..., 2:]
    weights = torch.ones(1, 15, dtype=torch.float64)
    torch.testing.assert_close(place_on_rays(joints, rays, weights)[0], place, atol=1e-4, rtol=0)
    rays[0, 3] += 0.5
    found = place_on_rays(joints, rays, weights)[0]
    torch.testing.assert_close(found, place, atol=0.1, rtol=0)
    weights[0, 3] = 0
    torch.testing.assert_close(place_on_rays(joints, rays, weights)[0], place, atol=1e-4, rtol=0)


def test_a_larger_person_is_lifted_larger_and_few_keypoints_are_not_lifted():
    motion = load_body_motion("whole-body")
    rig, pixels = ring(1), ring(1)(moving_body(1)).pixels
    usual = PoseLifter(rig, FPS, motion, "y")(frame_of(pixels), None)[0]
    large = with_body(motion, Body.of_height(BODY_15, 2.1))
    other = PoseLifter(rig, FPS, large, "y")(frame_of(pixels), None)[0]
    ratio = other.std / usual.std
    torch.testing.assert_close(ratio, ratio[:1, :1].expand_as(ratio))
    torch.testing.assert_close(other.joints, ratio[0, 0] * usual.joints)
    assert 1.1 < float(ratio[0, 0]) < 1.4
    few = frame_of(pixels)
    few.inlier[..., 5:] = 0
    assert bool(PoseLifter(rig, FPS, motion, "y")(few, None)[0].std.isinf().all())


def test_a_camera_on_its_side_lifts_the_same_where_up_is_known():
    motion, rig = load_body_motion("whole-body"), ring(1)
    frame = frame_of(rig(moving_body(1)).pixels)
    rolled = quarter_turned(rig)
    turned = frame._replace(pixels=rolled(moving_body(1)).pixels)
    usual, on_side = (
        PoseLifter(one, FPS, motion, "y")(given, None)[0]
        for one, given in ((rig, frame), (rolled, turned))
    )
    torch.testing.assert_close(on_side.joints, usual.joints, atol=1e-4, rtol=0)
    torch.testing.assert_close(on_side.std, usual.std, atol=1e-4, rtol=0)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_body_that_lies_is_lifted_as_one_that_stands(quarters):
    """Turned about the optical axis, a body looks as in a camera that is turned the other way."""
    motion, rig, joints = load_body_motion("whole-body"), ring(1), moving_body(1)
    axis = quarters * torch.pi / 2 * rig.rotation[0, 2]
    turn = rotvec_to_matrix(axis)
    centre = -rig.rotation[0].mT @ rig.translation[0]
    lifter = PoseLifter(rig, FPS, motion)
    usual, lying = (
        lifter(frame_of(rig(body).pixels), None)[0]
        for body in (joints, (joints - centre) @ turn.mT + centre)
    )
    expected = usual.joints[:, LIMBS] @ turn.mT
    off = (lying.joints[:, LIMBS] - expected).norm(dim=-1)
    assert float(off.max()) < 0.1  # the turn is that of trunk and legs, not of the floor
    assert float(off.mean()) < 0.05


def test_who_bends_or_sits_with_stretched_legs_is_not_taken_to_lie():
    upright = torch.tensor([[0.0, -1.0]], dtype=torch.float64)
    hips, long = torch.zeros(2, dtype=torch.float64), 0.2
    for trunk, legs, expected in (
        ((0.9, 0.3), (0.0, -1.0), (0.0, -1.0)),  # bends
        ((0.0, -1.0), (1.0, 0.0), (0.0, -1.0)),  # sits with stretched legs
        ((1.0, 0.0), (-1.0, -0.2), (0.0, -1.0)),  # bends in a seat, seen from above
        ((1.0, -0.1), (1.0, 0.1), (1.0, 0.0)),  # lies
        ((0.1, 1.0), (-0.1, 1.0), (0.0, 1.0)),  # stands on the hands
    ):
        rays = torch.zeros(1, 15, 2, dtype=torch.float64)
        rays[0, SHOULDERS] = hips + long * torch.tensor(trunk, dtype=torch.float64)
        rays[0, ANKLES] = hips - long * torch.tensor(legs, dtype=torch.float64)
        there = torch.ones(1, 15, dtype=torch.bool)
        roll, turned = next_roll(BodyRoll.upright(rays[:, 0, 0]), rays, there, FPS)
        torch.testing.assert_close(roll.up[0].tolist(), list(expected), atol=1e-9, rtol=0)
        assert bool(turned) == (expected != (0.0, -1.0))
        one_hip = there.clone()
        one_hip[:, [PELVIS, BODY_15.joint("left_hip")]] = False
        untold, _ = next_roll(BodyRoll.upright(rays[:, 0, 0]), rays, one_hip, FPS)
        assert torch.equal(untold.up, upright)


def test_a_body_that_lies_is_turned_until_it_stands_up():
    up = torch.tensor([[[0.0, -1.0]], [[1.0, 0.0]]], dtype=torch.float64)
    there = torch.ones(1, 15, dtype=torch.bool)
    rays = torch.zeros(2, 1, 15, 2, dtype=torch.float64)
    rays[..., SHOULDERS, :] = up[:, :, None]
    rays[..., ANKLES, :] = -up[:, :, None]
    roll = BodyRoll.upright(rays[0, :, 0, 0])
    changes = []
    for seen in (*[rays[0]] * 30, rays[1], *[rays[0]] * 30, *[rays[1]] * 30, *[rays[0]] * 30):
        roll, turned = next_roll(roll, seen, there, FPS)
        changes.append(bool(turned))
    first, second = (t for t, turned in enumerate(changes) if turned)
    assert 61 < first < 91 < second  # not for the single frame
    assert torch.equal(roll.up, up[0])
    torch.testing.assert_close(roll.turn[0], torch.eye(3, dtype=torch.float64), atol=0, rtol=0)


def quarter_turned(rig):
    """The same camera, on its side."""
    roll = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    rotation = cv2.Rodrigues((roll @ rig.rotation[0]).numpy())[0].ravel().tolist()
    camera = PinholeCamera(
        1300, 1300, 539.5, 959.5, 1080, 1920, "side",
        rotation=rotation, translation=(roll @ rig.translation[0]).tolist(),
    )  # fmt: skip
    return CameraRig([camera])


def test_exchanged_sides_at_the_start_are_soon_forgotten():
    joints, rig = moving_body(30), ring(1)
    pixels = rig(joints).pixels
    mirror = [NAMES.index(other_side(name)) for name in NAMES]
    wrong = pixels.clone()
    wrong[:3] = pixels[:3][..., mirror, :]
    error = []
    for seen in (pixels, wrong):
        found = tracker()(keypoints=seen).joints3d
        error.append(float((relative(found) - relative(joints)).norm(dim=-1)[20:].mean()))
    assert error[1] < error[0] + 0.02


def test_strangers_are_nearer_than_the_best_still_pose():
    data = data_with(MHAD)
    names = {MHAD: ("s09_a09_sit_stand_r1", "s10_a05_wave_two_hands_r1")}
    for clip in read_clips(data, names)[MHAD]:
        one = begun(clip, 60).of_cameras(1)
        track = torchpose.BodyTracker(one.rig, "kalman", fps=one.fps)(
            keypoints=one.seen.keypoints, confidence=one.seen.confidence
        )
        true = relative(one.joints)
        error, still = (
            float((x - true).norm(dim=-1).nanmean())
            for x in (relative(track.joints3d), true.mean(0))
        )
        assert error < 0.08
        assert error < still


def test_a_height_that_is_told_stays():
    """The network makes limbs short of whose depth it is unsure."""
    data = data_with(MHAD)
    (clip,) = read_clips(data, {MHAD: ("s10_a05_wave_two_hands_r1",)})[MHAD]
    one = begun(clip, 60).of_cameras(1)
    track = torchpose.BodyTracker(one.rig, "kalman", fps=one.fps, height=1.7)(
        keypoints=one.seen.keypoints, confidence=one.seen.confidence, smoothing="full"
    )
    assert track.body.height == pytest.approx(1.7, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("every", [2, 4])
def test_strangers_who_walk_may_be_filmed_at_half_and_a_quarter_of_the_rate(every):
    data = data_with(WALKS)
    (clip,) = read_clips(data, {WALKS: ("s16_16_15_walk",)})[WALKS]
    one = begun(clip, 120).of_cameras(1)
    track = torchpose.BodyTracker(one.rig, "kalman", fps=one.fps / every)(
        keypoints=one.seen.keypoints[::every], confidence=one.seen.confidence[::every]
    )
    off = relative(track.joints3d) - relative(one.joints[::every])[track.first_frame :]
    assert float(off.norm(dim=-1).nanmean()) < 0.06  # 0.07 and 0.09 if rates are not drawn


def test_strangers_behind_a_desk_may_sit():
    """Nobody sees their legs: knees are guessed between those of people who stand and who sit."""
    clips = sitting_clips(data_with(MHAD))["side"]
    off = []
    for clip in (begun(one) for one in clips if "1.3 m" in one.name):
        keypoints = clip.seen.keypoints.clone()
        keypoints[..., LEGS, :] = torch.nan
        track = torchpose.BodyTracker(clip.rig, "kalman", fps=clip.fps)(
            keypoints=keypoints, confidence=clip.seen.confidence
        )
        found, truth = (relative(x)[..., KNEES, :] for x in (track.joints3d, clip.joints))
        off.append((found - truth[track.first_frame :]).norm(dim=-1).mean())
    assert len(off) == 4
    assert float(torch.stack(off).mean()) < 0.3  # 0.37 by a network that saw few who sit


def test_steps_are_lifted_as_whole_sequences_are():
    one = scene(1, 6)
    whole = tracker()(keypoints=one.keypoints, confidence=one.confidence)
    live, state = tracker(), None
    state = live.init()
    for t in range(6):
        state, pose = live.step(state, keypoints=one.keypoints[t], confidence=one.confidence[t])
        torch.testing.assert_close(pose.joints3d[0], whole.joints3d[t])


def test_a_module_in_double_precision_lifts_the_same():
    one = scene(1, 3)
    given = {"keypoints": one.keypoints, "confidence": one.confidence, "names": NAMES}
    single, double = tracker()(**given), tracker().double()(**given)
    torch.testing.assert_close(single.joints3d, double.joints3d, atol=1e-4, rtol=0)


def test_several_cameras_lift_nothing():
    assert kalman(ring(2)).by_keypoints.tracker.lifter is None
    assert tracker().by_keypoints.tracker.lifter is not None


def test_nobody_at_first_is_no_error_and_begins_later():
    one = scene(1, 8)
    keypoints = one.keypoints.clone()
    keypoints[:3] = torch.nan
    track = tracker()(keypoints=keypoints, confidence=one.confidence)
    assert bool(track.joints3d.isfinite().all())
    pixels = one.rig(track.joints3d).pixels
    assert track.first_frame == 3
    assert float((pixels - one.keypoints[3:]).norm(dim=-1)[2:].median()) < 20
