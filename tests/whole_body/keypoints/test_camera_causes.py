"""One camera with a wrong focal length, lens or pose is said, and so are two that agree poorly."""

import copy
import math

import pytest
import torch

from tests.whole_body.keypoints.scenes import FPS, NAMES, kalman, moving_body, scene, seen_by
from torchpose.camera import CameraRig
from torchpose.camera._lens import distort_rays
from torchpose.errors import CameraError
from torchpose.math._rotations import rotvec_to_matrix
from torchpose.whole_body._keypoints.camera_cause_notes import (
    CameraCause,
    find_cause,
    notes_on_causes,
)
from torchpose.whole_body._keypoints.camera_causes import FOCAL, LENS, Causes, explain
from torchpose.whole_body._keypoints.camera_notes import CameraDoubts, notes_on_cameras, sure_delays
from torchpose.whole_body._keypoints.keypoint_body_tracker import KeypointBodyTracker
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame

WRONG = 1
BARREL = torch.tensor([-0.3, *[0.0] * 13], dtype=torch.float64)


@pytest.fixture(scope="module", params=[2, 3, 4])
def seen(request):
    return scene(request.param, n_frames=20)


@pytest.fixture(scope="module")
def three():
    return scene(3, n_frames=20)


@pytest.fixture(scope="module")
def wide():
    """Three cameras with the person in a corner of their images, where lenses distort."""
    found = scene(3, n_frames=20)
    rig = copy.deepcopy(found.rig)
    turn = rotvec_to_matrix(torch.tensor([0.12, 0.42, 0.0], dtype=torch.float64))
    rig.rotation.copy_(turn @ rig.rotation)
    rig.translation.copy_((turn @ rig.translation[..., None]).squeeze(-1))
    return seen_by(rig, found.joints)


def frames_of(rig: CameraRig, keypoints) -> KeypointFrame:
    return KeypointBodyTracker(rig, FPS).reader.frames_and_feet(keypoints, None, NAMES, None)[0]


def cause_of(rig: CameraRig, keypoints) -> CameraCause | None:
    return find_cause(rig, frames_of(rig, keypoints))


def with_focal(rig: CameraRig, factor: float) -> CameraRig:
    other = copy.deepcopy(rig)
    other.matrix[WRONG, [0, 1], [0, 1]] *= factor
    return other


def with_pose(rig: CameraRig, change) -> CameraRig:
    other = copy.deepcopy(rig)
    R, t = change(rig.rotation[WRONG], rig.translation[WRONG])
    other.rotation[WRONG], other.translation[WRONG] = R, t
    return other


def distorted(rig: CameraRig, keypoints):
    """Keypoints of which one camera's are those of a lens."""
    K = rig.matrix[WRONG]
    rays = ((keypoints[:, WRONG] - K[:2, 2]) / K.diagonal()[:2]).flatten(0, 1)
    bent = distort_rays(rays, BARREL, False) * K.diagonal()[:2] + K[:2, 2]
    other = keypoints.clone()
    other[:, WRONG] = bent.view_as(keypoints[:, WRONG])
    return other


def test_right_cameras_have_no_cause(seen):
    assert cause_of(seen.rig, seen.keypoints) is None
    few = seen.keypoints.clone()
    few[1:] = torch.nan
    assert cause_of(with_focal(seen.rig, 0.8), few) is None


@pytest.mark.parametrize("factor", [0.8, 0.9, 1.1, 1.2])
@pytest.mark.parametrize("cameras", [3, 4])
def test_a_wrong_focal_length_of_one_camera_is_found(factor, cameras):
    one = scene(cameras, n_frames=20)
    found = cause_of(with_focal(one.rig, factor), one.keypoints)
    assert found is not None and (found.kind, found.camera) == ("focal", WRONG)
    assert found.value == pytest.approx(1 / factor, abs=0.03)
    assert found.explained < 0.75 * found.given


def test_a_wrong_focal_length_is_said_by_the_track(three):
    tracker = kalman(with_focal(three.rig, 0.85))
    note = tracker(keypoints=three.keypoints).notes[0]
    assert note.startswith("camera c1: cameras agree far better if its focal length is 1.1")
    assert "in place of 1105" in note
    assert kalman(three.rig)(keypoints=three.keypoints).notes == ()


def test_a_lens_that_is_missing_is_found(wide):
    assert cause_of(wide.rig, wide.keypoints) is None
    found = cause_of(wide.rig, distorted(wide.rig, wide.keypoints))
    assert found is not None and (found.kind, found.camera) == ("lens", WRONG)
    assert found.value == pytest.approx(float(BARREL[0]), abs=0.1)
    (note,) = notes_on_causes(
        wide.rig, frames_of(wide.rig, distorted(wide.rig, wide.keypoints)), torch.zeros(3)
    )
    assert "radial distortion k1 of about -0." in note and "missing" in note


def test_a_lens_that_keypoints_do_not_have_is_found(wide):
    rig = copy.deepcopy(wide.rig)
    rig.distortions[WRONG] = BARREL
    assert cause_of(rig, distorted(rig, wide.keypoints)) is None
    found = cause_of(rig, wide.keypoints)
    assert found is not None and (found.kind, found.camera) == ("raw", WRONG)
    (note,) = notes_on_causes(rig, frames_of(rig, wide.keypoints), torch.zeros(3))
    assert "camera c1" in note and "set its `distortions` to zeros" in note


def test_errors_are_those_that_were_made(three):
    rig = with_focal(three.rig, 1.15)
    frames = frames_of(rig, rig(three.joints).pixels)
    frames = frames._replace(pixels=three.rig(three.joints).pixels)
    causes = Causes.of([(WRONG, (FOCAL,)), (WRONG, (FOCAL, LENS)), (0, ())], torch.device("cpu"))
    found = explain(rig, frames.map(lambda value: value.expand(3, *value.shape)), causes)
    assert float(found.errors[0, FOCAL]) == pytest.approx(-math.log(1.15), abs=2e-3)
    assert float(found.errors[1, FOCAL]) == pytest.approx(-math.log(1.15), abs=1e-2)
    assert not bool(found.errors[2].any()) and float(found.cost[2]) > 10 * float(found.cost[0])
    assert float(found.promise[2]) < float(found.promise[:2].max()) + float(found.cost[2])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("word", "change"),
    [
        ("poses are those from camera to world", lambda R, t: (R.mT, -R.mT @ t)),
        ("translations are the places", lambda R, t: (R, -R.mT @ t)),
        ("those of OpenGL", lambda R, t: (FLIP[:, None] * R, FLIP * t)),
        ("axes y and z of the world", lambda R, t: (R * FLIP, t)),
        ("its own axes x and z", lambda R, t: (FLIP_UP[:, None] * R, FLIP_UP * t)),
        ("the other sign", lambda R, t: (R, -t)),
    ],
)
@pytest.mark.parametrize("cameras", [2, 3])
def test_a_pose_of_another_convention_of_one_camera_is_said(word, change, cameras):
    one = scene(cameras, n_frames=7)
    rig = with_pose(one.rig, change)
    try:
        notes = kalman(rig)(keypoints=one.keypoints).notes
    except CameraError:
        assert cameras == 2  # both may agree by another convention, too
        return
    named = [note for note in notes if note.startswith("camera c1: ") and word in note]
    assert named or (cameras == 2 and any("agree poorly" in note for note in notes))


FLIP = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
FLIP_UP = torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64)


@pytest.mark.slow
def test_two_cameras_that_agree_poorly_are_said():
    two = scene(2, n_frames=20)
    for rig in (with_focal(two.rig, 0.85), turned(two.rig, 1.5)):
        notes = kalman(rig)(keypoints=two.keypoints).notes
        (note,) = (note for note in notes if "agree poorly" in note)
        assert "cameras c0 and c1" in note and "pixels or more" in note and "late" in note
        assert not any("calibrated pose of this or of another" in other for other in notes)


def test_two_cameras_that_see_different_persons_are_said():
    two = scene(2, n_frames=20)
    keypoints = two.keypoints.clone()
    keypoints[:, 1] = two.rig(moving_body(20) + torch.tensor([0.3, 0.6, 0.9])).pixels[:, 1].flip(0)
    found = cause_of(two.rig, keypoints)
    assert found is not None and found.given > 5


def turned(rig: CameraRig, degrees: float) -> CameraRig:
    turn = rotvec_to_matrix(torch.tensor([math.radians(degrees), 0.0, 0.0]).double())
    return with_pose(rig, lambda R, t: (turn @ R, turn @ t))


def test_turned_cameras_are_not_called_anything_else(three):
    for degrees in (1.0, 4.0):
        assert cause_of(turned(three.rig, degrees), three.keypoints) is None


def test_a_delay_that_is_sure_is_no_fault_of_the_calibration():
    one = scene(2, n_frames=40)
    late = one.keypoints.clone()
    late[8:, 1], late[:8, 1] = one.keypoints[:-8, 1], one.keypoints[0, 1]
    frames = frames_of(one.rig, late)
    assert notes_on_causes(one.rig, frames, torch.tensor([0.0, 8.0])) == ()


def test_delays_are_said_from_four_standard_deviations_on():
    zero = torch.zeros(3)
    doubts = CameraDoubts(
        torch.tensor([0.0, 2.0, 2.0]), torch.tensor([0.0, 0.45, 0.55]), zero, zero
    )
    assert sure_delays(doubts).tolist() == [0.0, 2.0, 0.0]
    (note,) = notes_on_cameras("abc", doubts)
    assert note.startswith("camera b seems to have begun 2.00 ± 0.45 frames earlier than a;")
    turned_one = doubts._replace(turns=zero + 2, turn_sigmas=zero + 20)
    assert len(notes_on_cameras("abc", turned_one)) == 2
    assert len(notes_on_cameras("abc", turned_one, explained=True)) == 1


@pytest.mark.parametrize(
    ("refined", "late", "turned"),
    [
        ("none", 'refine="delays"', 'refine="extrinsics"'), ("delays", *['refine="both"'] * 2),
        ("extrinsics", 'refine="both"', "found nothing"), ("both", *["found nothing"] * 2),
    ],
)  # fmt: skip
def test_notes_do_not_recommend_what_was_refined(refined, late, turned):
    zero = torch.zeros(2)
    doubts = CameraDoubts(torch.tensor([0.0, 3.0]), zero + 0.1, zero + 2, zero + 20)
    notes = notes_on_cameras("ab", doubts, refined=refined)
    assert [word in note for word, note in zip((late, turned), notes, strict=True)] == [True, True]
    assert all((", as refined," in note) == (refined != "none") for note in notes)
