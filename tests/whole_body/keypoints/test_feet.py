"""Feet beyond tracked shanks: heels and toes from keypoints, ankles, files."""

import math

import pytest
import torch
from torch.testing import assert_close

from tests.whole_body.keypoints.scenes import FPS, NAMES, kalman, noisy, ring, scene
from torchpose.body import BODY_15
from torchpose.body._articulation import Articulation, BodyPoint, mirror_of
from torchpose.body._feet import ANKLES, FEET, foot_points, foot_shape
from torchpose.errors import FileFormatError
from torchpose.math._rotations import rotvec_to_matrix
from torchpose.metrics import coverage
from torchpose.priors._foot_prior import shipped_foot_prior
from torchpose.whole_body import BodyTrack
from torchpose.whole_body._body_feet import BodyFeet
from torchpose.whole_body._keypoints.foot_filter import FootFilter
from torchpose.whole_body._keypoints.foot_motion import N_FOOT, foot_motion

pytestmark = pytest.mark.usefixtures("undoubted_cameras")

WITH_FEET = (*NAMES, *FEET)
ANKLE_OF = [ankle for ankle in ANKLES for _ in range(3)]


def standing_feet(joints):
    """Feet [T, 6, 3] that tip up and down, and point a little outwards."""
    t = torch.arange(len(joints), dtype=torch.float64) / FPS
    pitch = 0.3 * torch.sin(2 * math.pi * 0.8 * t)
    sides = []
    for ankle, shape, yaw in zip(ANKLES, foot_shape(), (0.2, -0.2), strict=True):
        turn = torch.stack([pitch, torch.full_like(t, yaw), torch.zeros_like(t)], -1)
        shank = (joints[0, ankle] - joints[0, BODY_15.parents[ankle]]).norm()
        away = rotvec_to_matrix(turn)[:, None] @ (shank * shape)[..., None]
        sides.append(joints[:, ankle, None] + away.squeeze(-1))
    return torch.cat(sides, 1)


def with_feet(cameras=4, n_frames=24, noise=4.0, seed=0):
    """A scene, its feet, and keypoints [T, C, 21, 2] of joints and feet with noise."""
    shown = scene(cameras, n_frames, noise, seed)
    feet = standing_feet(shown.joints)
    pixels = noisy(shown.rig(feet).pixels, noise, seed + 1)
    return shown, feet, torch.cat([shown.keypoints, pixels], 2)


@pytest.fixture(scope="module")
def four():
    return with_feet()


@pytest.fixture(scope="module")
def tracked(four):
    shown, _, keypoints = four
    return kalman(shown.rig)(keypoints=keypoints, names=WITH_FEET)


@pytest.fixture(scope="module")
def spoiled(four):
    """Tracks of the scene with faults of its keypoints, all in one batch."""
    shown, _, keypoints = four
    cases = {name: keypoints.clone() for name in ("blind", "hidden", "wild", "turned", "elsewhere")}
    cases["blind"][:, :, 15:] = torch.nan
    cases["hidden"][2:, :, 15:] = torch.nan
    cases["wild"][10:20, 1, 15:] += 150.0
    legs = [i for i, n in enumerate(WITH_FEET) if n.split("_")[-1] in ("hip", "knee", "ankle")]
    moved = legs + list(range(15, 21))
    other = [WITH_FEET.index(_other(WITH_FEET[i])) for i in moved]
    cases["turned"][8:20, 2][:, moved] = keypoints[8:20, 2][:, other]
    cases["elsewhere"][:, 3, :15] = torch.nan
    tracks = kalman(shown.rig)(keypoints=torch.stack([*cases.values()]), names=WITH_FEET)
    return dict(zip(cases, tracks, strict=True))


def errors(track, feet):
    return 1000 * (track.feet.points3d - feet[track.first_frame :]).norm(dim=-1)


def test_heels_and_toes_are_found_to_two_centimetres(four, tracked):
    assert tracked.feet.names == FEET
    assert float(errors(tracked, four[1])[5:].mean()) < 20
    assert float(tracked.feet.inlier.mean()) > 0.9


def test_ellipsoids_hold_heels_and_toes(four, tracked):
    held = coverage(tracked.feet.points3d, tracked.feet.covariance3d, four[1]).overall
    assert 0.35 < float(held[0]) < 0.95
    assert float(held[1]) > 0.8


def test_the_fifteen_joints_are_what_they_are_without_feet(four, tracked):
    shown = four[0]
    alone = kalman(shown.rig)(keypoints=shown.keypoints)
    assert alone.feet is None
    assert not any(name.startswith("f") for name in alone.details)
    for name in ("joints3d", "covariance3d", "state", "log_evidence"):
        assert torch.equal(getattr(alone, name), getattr(tracked, name))
    assert torch.equal(alone.details["inlier"], tracked.details["inlier"])


def test_smoothed_feet_are_nearer_and_surer(four, tracked):
    shown, feet, keypoints = four
    tracker = kalman(shown.rig)
    smoothed = tracker(keypoints=keypoints, names=WITH_FEET, smoothing="full")
    assert float(errors(smoothed, feet).mean()) < float(errors(tracked, feet).mean())
    assert float(smoothed.feet.points_std().mean()) < float(tracked.feet.points_std().mean())


def test_frame_by_frame_gives_the_same_feet(four, tracked):
    shown, _, keypoints = four
    tracker = kalman(shown.rig)
    stream = tracker.init(names=WITH_FEET)
    for t in range(8):
        stream, pose = tracker.step(stream, keypoints=keypoints[t])
        for name in ("points3d", "covariance3d", "inlier", "rotation"):
            own = getattr(pose.feet, name)[0]
            assert_close(own, getattr(tracked.feet, name)[t], atol=1e-9, rtol=1e-7)


def test_live_there_are_no_feet_before_the_first_pose(four):
    shown, _, keypoints = four
    tracker = kalman(shown.rig)
    nothing = torch.full_like(keypoints[0], torch.nan)
    stream, pose = tracker.step(tracker.init(), keypoints=nothing, names=WITH_FEET)
    assert bool(pose.feet.points3d.isnan().all())
    assert bool((pose.feet.inlier == 0).all())
    _, pose = tracker.step(stream, keypoints=keypoints[0], names=WITH_FEET)
    assert bool(pose.feet.points3d.isfinite().all())


def test_feet_that_nobody_sees_are_where_legs_let_expect_them(four, tracked, spoiled):
    _, feet, _ = four
    found = spoiled["blind"]
    assert float(found.feet.points_std().min()) > 2 * float(tracked.feet.points_std().mean())
    assert float(errors(found, feet).mean()) < 120
    assert bool((found.feet.inlier == 0).all())
    held = coverage(found.feet.points3d, found.feet.covariance3d, feet).overall
    assert float(held[1]) > 0.8


def test_a_foot_that_is_hidden_for_long_has_its_prior_again(spoiled):
    known, never = (spoiled[name].feet for name in ("hidden", "blind"))
    wide = never.points_std()[-1]
    assert bool((known.points_std()[-1] > 0.6 * wide).all())
    assert bool((known.points_std()[1] < 0.45 * wide).all())


def test_wild_toes_move_nothing(four, tracked, spoiled):
    _, feet, _ = four
    found = spoiled["wild"]
    assert float(found.feet.inlier[10:20, 1].mean()) < 0.05
    assert float(errors(found, feet)[10:20].mean()) < float(errors(tracked, feet).mean()) + 5


def test_feet_of_a_camera_that_exchanges_legs_are_undone(four, tracked, spoiled):
    _, feet, _ = four
    found = spoiled["turned"]
    assert float(errors(found, feet)[8:20].mean()) < float(errors(tracked, feet).mean()) + 5
    assert float(found.feet.inlier[9:20, 2].mean()) > 0.8


def _other(name):
    side, _, kind = name.partition("_")
    return f"{'right' if side == 'left' else 'left'}_{kind}"


def test_a_camera_without_the_body_tells_nothing_of_feet(spoiled):
    found = spoiled["elsewhere"]
    assert bool((found.feet.inlier[:, 3] == 0).all())
    assert float(found.feet.inlier[:, :3].mean()) > 0.9


def test_a_batch_gives_each_its_own_feet(four, tracked):
    shown, _, keypoints = four
    other = torch.cat([shown.keypoints[:10], with_feet(seed=5, n_frames=10)[2][:, :, 15:]], 2)
    both = torch.stack([keypoints[:10], other])
    found = kalman(shown.rig)(keypoints=both, names=WITH_FEET)
    assert_close(found[0].feet.points3d, tracked.feet.points3d[:10], atol=1e-9, rtol=0)
    assert not torch.allclose(found[1].feet.points3d, found[0].feet.points3d, atol=1e-4)


def test_several_persons_have_their_feet(four, tracked):
    shown, feet, keypoints = four
    frames = 8
    moved = shown.joints[:frames] + torch.tensor([1.2, 0.0, 0.3], dtype=torch.float64)
    second = shown.rig(torch.cat([moved, standing_feet(moved)], 1)).pixels
    people = torch.stack([second, keypoints[:frames]], 2)
    tracker = kalman(shown.rig)
    found = tracker(keypoints=people, names=WITH_FEET, persons="all")
    assert len(found) == 2
    truths = (standing_feet(moved), feet[:frames])
    for truth in truths:
        assert min(float(errors(one, truth).mean()) for one in found) < 25
    stream = tracker.init(names=WITH_FEET)
    for t in range(frames):
        stream, poses = tracker.step(stream, keypoints=people[t], persons="all")
    for live, whole in zip(poses, found, strict=True):
        assert_close(live.feet.points3d[0], whole.feet.points3d[-1], atol=1e-9, rtol=0)
    smoothed = tracker(keypoints=people, names=WITH_FEET, persons="all", smoothing="full")
    assert smoothed[0].feet.points3d.shape == (frames, 6, 3)


@pytest.mark.slow
def test_refined_cameras_give_feet(four):
    shown, feet, keypoints = four
    found = kalman(shown.rig)(keypoints=keypoints, names=WITH_FEET, refine="delays")
    assert float(errors(found, feet)[5:].mean()) < 25


def test_one_camera_finds_feet_where_it_has_the_ankles(four):
    shown, feet, keypoints = with_feet(1)
    found = kalman(shown.rig, height=1.7)(keypoints=keypoints, names=WITH_FEET)
    begun = found.first_frame
    away = found.feet.points3d - found.joints3d[:, ANKLE_OF]
    true = (feet - shown.joints[:, ANKLE_OF])[begun:]
    assert float((away - true).norm(dim=-1).mean()) < 0.08
    assert bool((found.feet.points_std() > 0.015).all())


# --- names ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("names", "places"),
    [
        (("left_ankle", "left_heel", "left_foot_index"), [1, 2, None, None, None, None]),
        (("RAnkle", "RBigToe", "RSmallToe", "RHeel"), [None, None, None, 3, 1, 2]),
        (("AnkleLeft", "FootLeft"), [None, 1, None, None, None, None]),
        (("ltibia", "lfoot", "ltoes"), [None, 2, None, None, None, None]),
    ],
)
def test_sets_of_joints_have_feet_under_their_own_names(names, places):
    points = torch.arange(len(names), dtype=torch.float64)[:, None]
    found = foot_points(points, names)
    expected = torch.tensor([math.nan if p is None else float(p) for p in places]).double()
    assert_close(found[:, 0], expected, equal_nan=True)


def test_a_foot_without_an_ankle_is_the_ankle_of_the_body():
    assert foot_points(torch.zeros(2, 2), ("left_knee", "left_foot")) is None


# --- angles ---------------------------------------------------------------------------------------


def test_feet_in_a_camera_that_is_turned_count_as_its_body_does():
    _, feet, keypoints = with_feet(cameras=3)
    rig = ring(3)
    turn = rotvec_to_matrix(torch.tensor([0.05, 0.0, 0.0], dtype=torch.float64))
    rig.rotation[1] = turn @ rig.rotation[1]
    rig.translation[1] = turn @ rig.translation[1]
    alone = keypoints.clone()
    alone[:, [0, 2], 15:] = torch.nan  # feet are seen by the turned camera alone
    found = kalman(rig)(keypoints=alone, names=WITH_FEET)
    assert any("seems to be turned" in note for note in found.notes)
    assert float(found.feet.inlier[10:, 1].mean()) > 0.8
    assert float(errors(found, feet)[10:].mean()) < 60


def feet_turned(turn):
    """Feet that are both turned by the same rotation vector."""
    rotation = rotvec_to_matrix(torch.tensor(turn, dtype=torch.float64)).expand(1, 2, 3, 3)
    nothing = torch.zeros(1, 6, 3, 3, dtype=torch.float64)
    return BodyFeet(nothing[..., 0], nothing, nothing[:, :1, :, 0], rotation, nothing[:, :2])


@pytest.mark.parametrize(
    ("turn", "left", "right"),
    [
        ((-0.3, 0.0, 0.0), (0.3, 0.0, 0.0), (0.3, 0.0, 0.0)),  # toes up
        ((0.0, 0.0, -0.2), (0.0, 0.2, 0.0), (0.0, -0.2, 0.0)),  # left sole inwards
        ((0.0, -0.4, 0.0), (0.0, 0.0, 0.4), (0.0, 0.0, -0.4)),  # towards the person's right
    ],
)
def test_angles_of_ankles_have_the_signs_of_biomechanics(turn, left, right):
    expected = torch.tensor([[left, right]], dtype=torch.float64)
    assert_close(feet_turned(turn).angles, expected)


# --- files ----------------------------------------------------------------------------------------


def test_feet_are_saved_and_read_back(tmp_path, tracked):
    tracked.save(tmp_path / "body.npz")
    again = BodyTrack.load(tmp_path / "body.npz")
    for name in ("points3d", "covariance3d", "inlier", "rotation", "rotation_covariance"):
        assert torch.equal(getattr(again.feet, name), getattr(tracked.feet, name))


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("feet", r"\[T, 6, 3\] of detail_feet, got \[24, 5, 3\]"),
        ("feet_inlier", r"\[T, C, 6\] of detail_feet_inlier, got \[24, 5, 6\]"),
    ],
)
def test_feet_of_another_size_are_refused(tmp_path, tracked, name, said):
    path = tmp_path / "body.npz"
    five = tracked.details[name][:, [0, 1, 0, 1, 0]]
    BodyTrack(**{**vars(tracked), "details": {**tracked.details, name: five}}).save(path)
    with pytest.raises(FileFormatError, match=said):
        BodyTrack.load(path)


def test_markers_of_feet_have_the_names_of_pose2sim(tmp_path, tracked):
    tracked.export(tmp_path / "body.trc", up="y")
    lines = (tmp_path / "body.trc").read_text().splitlines()
    markers = lines[3].split()
    assert markers[-6:] == ["LHeel", "LBigToe", "LSmallToe", "RHeel", "RBigToe", "RSmallToe"]
    row = [float(v) for v in lines[6].split()]
    assert_close(torch.tensor(row[-3:]), tracked.feet.points3d[0, -1].float(), atol=1e-4, rtol=0)
    tracked.export(tmp_path / "body.c3d", up="y")
    assert b"RSmallToe" in (tmp_path / "body.c3d").read_bytes()


def test_feet_of_an_animation_end_at_their_toes(tmp_path, tracked):
    tracked.export(tmp_path / "body.bvh")
    text = (tmp_path / "body.bvh").read_text()
    _, _, foot = text.partition("JOINT left_foot")
    end = foot.partition("End Site")[2].partition("OFFSET")[2].split()[:3]
    length = math.hypot(*map(float, end))
    away = tracked.feet.points3d[:, FEET.index("left_big_toe")] - tracked.joints3d[:, ANKLES[0]]
    assert length == pytest.approx(100 * float(away.norm(dim=-1).median()), rel=0.1)
    assert text.count("JOINT right_foot") == 1
    alone = BodyTrack(**{**vars(tracked), "details": {}})
    alone.export(tmp_path / "alone.bvh")
    assert "foot" not in (tmp_path / "alone.bvh").read_text()


# --- the model ------------------------------------------------------------------------------------


def test_derivatives_of_feet_are_those_of_differences(tracked):
    tracker = kalman(ring(2)).by_keypoints
    filter: FootFilter = tracker.feet
    generator = torch.Generator().manual_seed(0)
    body = tracker.tracker.filter
    shown = scene(2, 1)
    frame = tracker.reader.frames_and_feet(shown.keypoints, None, NAMES, None)[0]
    _, pose, _ = tracker.tracker.advance(None, frame)
    legs = filter.legs(pose)
    mean = 0.1 * torch.randn(1, 2, N_FOOT, generator=generator, dtype=torch.float64)
    found = filter.linearise(mean, legs)
    step = 1e-6
    for column in [*range(3), *range(6, N_FOOT)]:
        moved = mean.clone()
        moved[..., column] += step
        slope = (filter.linearise(moved, legs).points - found.points) / step
        own = found.jacobian[..., column].unflatten(-1, (3, 3))
        assert_close(slope, own, atol=2e-3, rtol=0)
    of_ankle = legs.ankle_root @ legs.ankle_root.mT / filter.doubt**2
    assert_close(of_ankle + legs.more, pose.covariance[:, ANKLES], atol=1e-9, rtol=0)
    assert body.articulation is filter.articulation


def test_the_rotation_of_a_shank_is_as_unsure_as_its_joints_say():
    tracker = kalman(ring(2)).by_keypoints
    frame = tracker.reader.frames_and_feet(scene(2, 1).keypoints, None, NAMES, None)[0]
    _, pose, _ = tracker.tracker.advance(None, frame)
    filter, body = tracker.feet, tracker.tracker.filter.articulation
    legs = filter.legs(pose)
    step = 1e-6
    shanks = [BODY_15.part_of[ankle] for ankle in ANKLES]
    slopes = []
    for column in range(body.dim):
        d = torch.zeros(1, body.dim, dtype=torch.float64)
        d[:, column] = step
        turned = body.world_rotations(body.moved(pose.point, d))[:, shanks]
        skew = (turned @ legs.shank.mT - torch.eye(3, dtype=torch.float64)) / step
        slopes.append(torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1))
    H = torch.stack(slopes, -1)
    expected = H @ pose.state_cov[:, None] @ H.mT
    found = legs.turn_root @ legs.turn_root.mT / filter.doubt**2
    assert_close(found, expected, atol=1e-7, rtol=1e-4)


def test_a_foot_that_is_not_measured_stays_with_its_prior():
    model = foot_motion(shipped_foot_prior(), 1 / 60)
    ahead = model.matrix @ model.cov @ model.matrix.mT + model.noise
    assert_close(ahead, model.cov)
    assert bool((torch.linalg.eigvalsh(model.noise) > -1e-12).all())


def test_the_right_foot_is_the_mirror_image_of_the_left():
    prior, body = shipped_foot_prior(), Articulation()
    generator = torch.Generator().manual_seed(0)
    angles, rates = 0.5 * torch.randn(2, body.n_rotations, generator=generator, dtype=torch.float64)
    mirror = mirror_of(body)

    def centre(angles, rates):
        vectors = torch.zeros(len(BODY_15.parts), 3, dtype=torch.float64)
        vectors[body.axis_part, body.axis] = angles
        velocity = torch.cat([torch.zeros(3, dtype=torch.float64), rates])
        none = torch.zeros(0, dtype=torch.float64)
        return prior.centre(BodyPoint(none, rotvec_to_matrix(vectors), velocity, none, none))

    whole = centre(angles, rates)
    flipped = centre(*(v[mirror.columns] * mirror.sign for v in (angles, rates)))
    assert_close(flipped, whole.flip(0) * torch.tensor([1.0, -1.0, -1.0]).double())
    assert float((whole[0] - whole[1]).abs().max()) > 0.01
