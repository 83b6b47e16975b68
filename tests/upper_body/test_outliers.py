"""Keypoints that belong to no body are left out, and exchanged hands exchanged back."""

import functools
import math

import numpy as np
import pytest
import torch

from torchpose.camera import PinholeCamera
from torchpose.demo import demo_camera, performer
from torchpose.errors import FileFormatError
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body import PoseTrack, UpperBodyTracker
from torchpose.upper_body._measured_joints import MeasuredJoints
from torchpose.upper_body._screening import _screened

NAMES = ["head", "neck", "hand_left", "hand_right"]
ROWS = [UPPER_BODY.index(name) for name in NAMES]
FRAME = 20


def seen(joints, names):
    """Joints in the image, with 3 pixels of noise."""
    uv = demo_camera()(joints.double())[:, [UPPER_BODY.index(name) for name in names], :2]
    generator = torch.Generator().manual_seed(0)
    return uv + 3 * torch.randn(uv.shape, generator=generator, dtype=torch.float64)


@pytest.fixture(scope="module")
def tracker(prior):
    """Keypoints are screened before any method sees them, so a quick one will do."""
    return UpperBodyTracker(prior, demo_camera(), "window-mixture", max_gap=None)


@pytest.fixture(scope="module")
def usual_tracker(prior):
    return UpperBodyTracker(prior, demo_camera(), max_gap=None)


@pytest.fixture(scope="module")
def keypoints():
    """Three performers, who never are in one place."""
    return torch.stack([seen(performer(40, seed=s).joints, NAMES) for s in range(3)])


@pytest.fixture(scope="module")
def clean(tracker, keypoints):
    return tracker(keypoints, names=NAMES)


@pytest.fixture(scope="module")
def hidden(tracker, keypoints):
    """The same with a joint missing in one frame: hidden(joint)."""

    @functools.cache
    def track(joint):
        missing = keypoints.clone()
        missing[:, FRAME, NAMES.index(joint)] = torch.nan
        return tracker(missing, names=NAMES)

    return track


def test_clean_keypoints_are_tracked_bit_by_bit_as_without_a_search(prior, keypoints, clean):
    assert bool((clean.inlier_probability[..., ROWS] > 0.5).all())
    unmeasured = [i for i in range(8) if i not in ROWS]
    assert bool(clean.inlier_probability[..., unmeasured].isnan().all())
    assert not any("outlier" in note or "exchanged" in note for note in clean.notes)
    without = UpperBodyTracker(prior, demo_camera(), "window-mixture", max_gap=None, outliers=False)
    track = without(keypoints, names=NAMES)
    for name in ("joints2d", "joints3d", "covariance3d", "log_evidence", "observed"):
        assert torch.equal(getattr(track, name), getattr(clean, name))
    assert bool(track.inlier_probability.isnan().all())


SIZES = (300.0, 1e3, 1e4, 1e6)  # pixels
WILD = [(joint, size) for joint in NAMES for size in SIZES]


@pytest.fixture(scope="module")
def with_one_outlier(tracker, keypoints):
    """The three performers with one keypoint elsewhere in one frame: all cases in one batch."""
    wild = keypoints.repeat(len(WILD), 1, 1, 1).unflatten(0, (len(WILD), -1))
    directions = torch.tensor([[1.0, 0.0], [0.0, -1.0], [-0.6, 0.8]], dtype=torch.float64)
    for case, (joint, size) in zip(wild, WILD, strict=True):
        case[:, FRAME, NAMES.index(joint)] += size * directions
    return tracker(wild.flatten(0, 1), names=NAMES)


@pytest.mark.parametrize("which", range(len(WILD)), ids=[f"{j}-{size:g}" for j, size in WILD])
def test_one_outlier_moves_nobody(with_one_outlier, clean, hidden, which):
    (joint, _), rows = WILD[which], slice(3 * which, 3 * which + 3)
    track, row = with_one_outlier, UPPER_BODY.index(joint)
    assert bool((track.inlier_probability[rows, FRAME, row] < 0.5).all())
    expected = clean.observed.clone()
    expected[:, FRAME, row] = False
    assert torch.equal(track.observed[rows], expected)
    assert float((track.joints3d[rows] - hidden(joint).joints3d).norm(dim=-1).max()) < 1e-9


@pytest.mark.parametrize("filled", [0.0, -1.0])
def test_what_detectors_write_where_they_found_nothing_is_missing(
    tracker, keypoints, hidden, filled
):
    given = keypoints.clone()
    given[:, FRAME, NAMES.index("hand_left")] = filled
    track, expected = tracker(given, names=NAMES), hidden("hand_left")
    assert torch.equal(track.joints3d, expected.joints3d) and track.notes == expected.notes
    assert bool(track.inlier_probability[:, FRAME, UPPER_BODY.index("hand_left")].isnan().all())


def test_outliers_are_counted_in_a_note(with_one_outlier):
    (note,) = [note for note in with_one_outlier.notes if "outlier" in note]
    assert note.startswith("48 keypoints") and all(f"{joint} 12" in note for joint in NAMES)


@pytest.mark.parametrize("joint", ["head", "neck"])
def test_head_and_neck_are_held_to_less(tracker, keypoints, joint):
    wild = keypoints.clone()
    wild[:, FRAME, NAMES.index(joint), 0] += 100
    track = tracker(wild, names=NAMES)
    assert not bool(track.observed[:, FRAME, UPPER_BODY.index(joint)].any())
    assert int((~track.observed[..., ROWS]).sum()) == 3  # and it drags no other joint with it


@pytest.mark.parametrize("joint", NAMES)
def test_an_outlier_in_the_first_frame_is_told_by_the_other_joints(tracker, keypoints, joint):
    wild = keypoints.clone()
    wild[:, 0, NAMES.index(joint), 0] += 500
    track = tracker(wild, names=NAMES)
    assert not bool(track.observed[:, 0, UPPER_BODY.index(joint)].any())
    assert int((~track.observed[..., ROWS]).sum()) == 3


def test_hands_are_exchanged_back_for_some_frames_and_not_for_good(tracker, keypoints, clean):
    swapped = keypoints.clone()
    apart = (keypoints[:, :, 2] - keypoints[:, :, 3]).norm(dim=-1)
    assert bool((apart[:, FRAME : FRAME + 4] > 80).all())
    swapped[:, FRAME : FRAME + 4, 2:] = keypoints[:, FRAME : FRAME + 4, [3, 2]]
    track = tracker(swapped, names=NAMES)
    assert torch.equal(track.joints3d, clean.joints3d)
    assert any("exchanged back in 12 frames" in note for note in track.notes)
    swapped[:, FRAME:, 2:] = keypoints[:, FRAME:, [3, 2]]
    track = tracker(swapped, names=NAMES)
    apart = (track.joints2d[:, -1, ROWS[2:]] - swapped[:, -1, 2:]).norm(dim=-1)
    assert bool((apart < 30).all())
    assert torch.equal(track.observed, clean.observed)


def test_elbows_are_exchanged_with_the_hands(prior):
    names = [*NAMES, "elbow_left", "elbow_right"]
    points = seen(performer(60, seed=0).joints, names)[None]
    tracker = UpperBodyTracker(prior, demo_camera())
    expected = tracker(points, names=names)
    swapped = points.clone()
    swapped[:, FRAME : FRAME + 3] = points[:, FRAME : FRAME + 3, [0, 1, 3, 2, 5, 4]]
    assert torch.equal(tracker(swapped, names=names).joints3d, expected.joints3d)


def test_somebody_who_is_elsewhere_is_followed_after_a_quarter_of_a_second(tracker, keypoints):
    jumped = keypoints.clone()
    jumped[:, FRAME:, :, 0] += 250
    track = tracker(jumped, names=NAMES)
    there = track.observed[..., ROWS]
    assert not bool(there[:, FRAME : FRAME + 5, :2].any())
    assert bool(there[:, FRAME + 9 :].all())


def test_a_hand_that_stays_where_no_arm_reaches_is_never_believed(tracker, keypoints):
    stuck = keypoints.clone()
    stuck[:, 5:, 2] = 5.0  # a corner of the image
    track = tracker(stuck, names=NAMES)
    assert not bool(track.observed[:, 5:, ROWS[2]].any())
    assert bool(track.observed[:, :, [ROWS[i] for i in (0, 1, 3)]].all())


def test_a_frame_in_which_all_is_wrong_leaves_nothing_behind(tracker, keypoints):
    wild = keypoints.clone()
    wild[:, FRAME] = torch.tensor([[900.0, 50.0], [-200.0, 400.0], [600.0, -90.0], [20.0, 700.0]])
    track = tracker(wild, names=NAMES)
    assert not bool(track.observed[:, FRAME].any())
    assert bool(track.observed[:, FRAME + 1 :, ROWS].all())


def test_after_a_gap_any_place_is_plausible(tracker, keypoints):
    gap = torch.cat([keypoints[:, :15], torch.full_like(keypoints[:, :30], torch.nan),
                     keypoints[:, 15:30]], 1)  # fmt: skip
    gap[:, 45:, :, 0] += 150
    track = tracker(gap, names=NAMES)
    assert bool(track.observed[:, 45:, ROWS].all())


@pytest.mark.slow
def test_frames_one_by_one_and_streams_alone_are_the_same(usual_tracker, keypoints):
    tracker = usual_tracker
    generator = torch.Generator().manual_seed(1)
    wild = keypoints.clone()
    out = torch.rand(wild.shape[:3], generator=generator) < 0.1
    wild[out] = torch.rand(int(out.sum()), 2, generator=generator).double() * 640
    wild[:, 20:23, 2:] = wild[:, 20:23, [3, 2]]
    wild[torch.rand(wild.shape[:3], generator=generator) < 0.05] = torch.nan
    wild = wild[:, :30]
    whole = tracker(wild, names=NAMES)
    assert bool((~whole.observed[..., ROWS]).any())
    state, poses = tracker.init(3, names=NAMES), []
    for t in range(wild.shape[1]):
        state, pose = tracker.step(state, wild[:, t])
        poses.append(pose)
    live = torch.stack([pose.inlier_probability for pose in poses], 1)
    torch.testing.assert_close(live, whole.inlier_probability, rtol=0, atol=1e-12, equal_nan=True)
    assert torch.equal(torch.stack([pose.observed for pose in poses], 1), whole.observed)
    joints = torch.stack([pose.joints3d for pose in poses], 1)
    torch.testing.assert_close(joints, whole.joints3d, rtol=1e-9, atol=1e-9)
    alone = tracker(wild[1:2, :24], names=NAMES)
    one = tracker(wild, names=NAMES, lengths=torch.tensor([30, 24, 27])).sequence(1)
    assert torch.equal(one.observed, alone.observed)
    torch.testing.assert_close(one.joints3d, alone.joints3d, rtol=1e-9, atol=1e-9)


def test_frames_past_the_end_are_not_counted(tracker, keypoints):
    wild = keypoints.clone()
    wild[:, FRAME + 5, 2] = 5000.0
    assert tracker(wild, names=NAMES, lengths=torch.tensor([20, 21, 22])).notes == tracker.notes


def test_gradients_flow_through_what_is_kept(usual_tracker, keypoints):
    wild = keypoints[:1, :30].clone()
    wild[:, 20, 2] = 3000.0
    wild[:, 25:27, 2:] = wild[:, 25:27, [3, 2]]
    wild.requires_grad_()
    usual_tracker(wild, names=NAMES).joints3d.sum().backward()
    gradient = wild.grad.norm(dim=-1)[0]
    assert bool(wild.grad.isfinite().all()) and float(gradient[20, 2]) == 0
    assert bool((gradient[25:27] > 0).all()) and bool((gradient[20, [0, 1, 3]] > 0).all())


def test_outliers_lie_in_the_image_of_another_camera(prior, keypoints, clean):
    """The image is told by the camera, and guessed from its centre where it is not."""
    own = demo_camera().matrix
    twice = [2 * float(x) for x in (own[0, 0], own[1, 1], own[0, 2], own[1, 2])]
    for size in ((), (1280, 960)):
        tracker = UpperBodyTracker(prior, PinholeCamera(*twice, *size), measurement_std=6.0)
        assert bool(tracker(2 * keypoints, names=NAMES).observed[..., ROWS].all())


def test_single_precision_finds_the_same(prior, keypoints):
    wild = keypoints.float()
    wild[:, FRAME, 1] = 900.0
    tracker = UpperBodyTracker(prior, demo_camera(), max_gap=None, dtype=torch.float32)
    track = tracker(wild, names=NAMES)
    assert track.inlier_probability.dtype == torch.float32
    assert not bool(track.observed[:, FRAME, ROWS[1]].any())


def test_files_hold_the_probabilities_and_older_ones_are_read_without(tracker, keypoints, tmp_path):
    wild = keypoints[:1].clone()
    wild[:, FRAME, 0] = 9000.0
    track = tracker(wild, names=NAMES)
    track.save(tmp_path / "poses.npz")
    loaded = PoseTrack.load(tmp_path / "poses.npz")
    torch.testing.assert_close(
        loaded.inlier_probability, track.inlier_probability, rtol=0, atol=0, equal_nan=True
    )
    assert loaded.notes == track.notes
    with np.load(tmp_path / "poses.npz") as arrays:
        older = {key: arrays[key] for key in arrays if key != "inlier_probability"}
    np.savez(tmp_path / "older.npz", **older)
    assert PoseTrack.load(tmp_path / "older.npz").inlier_probability.isnan().all()
    older["inlier_probability"] = np.full_like(track.inlier_probability[0].numpy(), math.pi)
    np.savez(tmp_path / "wrong.npz", **older)
    with pytest.raises(FileFormatError, match="inlier_probability"):
        PoseTrack.load(tmp_path / "wrong.npz")


@pytest.mark.parametrize(("sure", "kept"), [(1.0, True), (0.5, True), (0.1, False)])
def test_an_unsure_keypoint_is_believed_only_where_it_is_expected(tracker, keypoints, sure, kept):
    keypoints = keypoints[:, : FRAME + 1]
    confidence = torch.ones(keypoints.shape[:3])
    confidence[:, FRAME, 2] = sure
    there = tracker(keypoints, confidence, NAMES).inlier_probability[:, FRAME, ROWS[2]]
    moved_away = keypoints.clone()
    moved_away[:, FRAME, 2] += 60.0
    aside = tracker(moved_away, confidence, NAMES).inlier_probability[:, FRAME, ROWS[2]]
    assert bool((there > 0.5).all())
    assert bool((aside > 0.5).all()) is kept


@pytest.mark.parametrize("method", ["articulated", "multiple-model"])
def test_an_unsure_outlier_leaves_no_doubt_about_the_others(prior, keypoints, method):
    tracker = UpperBodyTracker(prior, demo_camera(), method)
    wild, hand = keypoints[:1, : FRAME + 2].clone(), NAMES.index("hand_left")
    wild[:, FRAME, hand] = 20.0
    sure = torch.ones(wild.shape[:3])
    expected = tracker(wild, sure, NAMES)
    sure[:, FRAME, hand] = 0.4
    found = tracker(wild, sure, NAMES)
    assert not bool(found.observed[:, FRAME, ROWS[hand]].any())
    assert torch.equal(found.observed, expected.observed)
    torch.testing.assert_close(found.covariance3d, expected.covariance3d)


def test_the_confidence_of_a_joint_goes_where_the_joint_goes():
    """Hands are exchanged back in the second of two frames, and the head is an outlier in both."""
    left, head, right = (UPPER_BODY.index(n) for n in ("hand_left", "head", "hand_right"))
    sure = torch.linspace(0.2, 0.9, 8).repeat(1, 2, 1)
    cov = torch.eye(2).double().expand(1, 2, 8, 2, 2)
    measured = MeasuredJoints(
        torch.ones(1, 2, 8, 2).double(), torch.ones(1, 2, 8, dtype=torch.bool), cov, confidence=sure
    )
    joints = torch.arange(8).repeat(1, 2, 1)
    joints[0, 1, [left, right]] = torch.tensor([right, left])
    probability = torch.ones(1, 2, 8).double()
    probability[..., head] = 0.1
    found = _screened(measured, probability, joints).confidence
    expected = sure.clone()
    expected[0, 1, [left, right]] = sure[0, 1, [right, left]]
    expected[..., head] = 1.0
    assert torch.equal(found, expected)
