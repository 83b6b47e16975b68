"""Cameras that stand still, are turned, or see somebody else are noticed, and do not draw the body away."""

import copy
import math

import pytest
import torch

from tests.whole_body.keypoints.scenes import (
    FPS,
    NAMES,
    camera_at,
    errors,
    kalman,
    moving_body,
    ring,
    scene,
)
from torchpose.body import BODY_15
from torchpose.camera import CameraRig
from torchpose.errors import CameraError
from torchpose.math._rotations import rotvec_to_matrix
from torchpose.whole_body._keypoints import track_builder
from torchpose.whole_body._keypoints.all_sides import notes_on_all_sides
from torchpose.whole_body._keypoints.camera_order import agree_as_given, notes_on_order
from torchpose.whole_body._keypoints.camera_readings import notes_on_one_camera
from torchpose.whole_body._keypoints.camera_refinement import (
    _corrected,
    _one_after_another,
    _turns_of,
)
from torchpose.whole_body._keypoints.faulty_cameras import (
    CameraFaults,
    find_faults,
    looked_at_again,
    without_still,
)
from torchpose.whole_body._keypoints.keypoint_body_tracker import KeypointBodyTracker
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame, RigMaps, exchange_of
from torchpose.whole_body._keypoints.keypoint_notes import (
    notes_on_a_rolled_camera,
    notes_on_cameras_now,
)
from torchpose.whole_body._keypoints.turn_looks import _mean_turn
from torchpose.whole_body._keypoints.turned_cameras import (
    angles_of,
    find_turns,
    is_turned,
    turned,
    unlikely,
)


@pytest.fixture(scope="module")
def three():
    return scene(3, n_frames=18)


def track(keypoints, rig):
    return kalman(rig)(keypoints=keypoints)


def with_turn(rig: CameraRig, camera: int, degrees: float) -> CameraRig:
    """A rig of which one camera is said to be turned about its x axis by so much more."""
    other = copy.deepcopy(rig)
    turn = rotvec_to_matrix(torch.tensor([math.radians(degrees), 0.0, 0.0]).double())
    other.rotation[camera] = turn @ rig.rotation[camera]
    other.translation[camera] = turn @ rig.translation[camera]
    return other


def frame_of(keypoints) -> KeypointFrame:
    """A frame [1, C, J] of keypoints [C, J, 2]."""
    ones = torch.ones_like(keypoints[None, ..., 0])
    return KeypointFrame(keypoints[None], ones, 1e-4 * ones, 0.9 * ones)


def test_turns_are_found_and_keypoints_turned_back(three):
    rig = with_turn(three.rig, 1, 5.0)
    maps, frame = RigMaps.of(rig), frame_of(rig(three.joints).pixels[0])
    wrong = frame._replace(pixels=three.rig(three.joints).pixels[:1])
    found = find_turns(wrong, torch.tensor([[False, True, False]]), maps)
    angles = torch.rad2deg(angles_of(found.matrix))[0].tolist()
    assert angles == pytest.approx([0.0, 5.0, 0.0], abs=0.05)
    back = turned(wrong, found.matrix, maps)
    assert float((back.pixels - frame.pixels).abs().max()) < 1.5


@pytest.mark.usefixtures("undoubted_here")
@pytest.mark.parametrize("degrees", [1.5, 20.0])
def test_a_turned_camera_of_three_hardly_moves_the_body(three, degrees):
    found = track(three.keypoints[:14], with_turn(three.rig, 1, degrees))
    assert float(errors(found, three.joints[:14])[10:].mean()) < 0.03
    assert any(f"camera c1 (by {degrees:.0f}"[:-1] in note for note in found.notes)


@pytest.mark.usefixtures("undoubted_here")
def test_cameras_that_are_all_turned_agree_again(three):
    rig = three.rig
    for camera, degrees in enumerate((3.0, -3.0, 3.0)):
        rig = with_turn(rig, camera, degrees)
    found = track(three.keypoints[:14], rig)
    assert float(found.details["inlier"][10:].mean()) > 0.8
    assert any("against the calibration" in note for note in found.notes)


def turned_scene(three, degrees):
    """A rig whose cameras are turned by so much each, its filter, and frames of the scene's keypoints."""
    rig = three.rig
    for camera, angle in enumerate(degrees):
        rig = with_turn(rig, camera, angle)
    filter = kalman(rig).by_keypoints.tracker.filter
    return rig, filter, [frame_of(keypoints) for keypoints in three.keypoints]


def test_turns_become_better_known_with_more_frames(three):
    rig, filter, frames = turned_scene(three, (0.0, 0.0, 3.0))
    faults, _, better = find_faults(filter, frames[0], CameraFaults.none(frames[0]))
    assert bool(better.all())
    true = three.rig.rotation.mT @ rig.rotation
    errors = [angles_of(faults.turn[0] @ true.mT).mean()]
    for frame in frames[1:]:
        faults = looked_at_again(filter, faults, frame)
        errors.append(angles_of(faults.turn[0] @ true.mT).mean())
    assert float(faults.looks.n_frames[0]) == 5.0
    assert float(errors[-1]) < 0.6 * float(errors[0])


def test_turns_of_several_persons_are_told_by_different_numbers_of_frames(three):
    _, filter, frames = turned_scene(three, (0.0, 0.0, 3.0))
    faults, _, _ = find_faults(filter, both := frames[0].take(torch.tensor([0, 0])),
                               CameraFaults.none(both))  # fmt: skip
    alone, _, _ = find_faults(filter, frames[0], CameraFaults.none(frames[0]))
    for t, frame in enumerate(frames[1:6], 1):
        both = frame.take(torch.tensor([0, 0]))
        both.inlier[1] = both.inlier[1] * (t > 4)
        faults = looked_at_again(filter, faults, both)
        alone = looked_at_again(filter, alone, frame)
    assert faults.looks.n_frames.tolist() == [3.0, 2.0]
    torch.testing.assert_close(faults.turn[:1], alone.turn)
    assert bool(faults.turn.isfinite().all())


def looked_at(three, errors):
    """What is believed of turned cameras after frames of a body that stands still, with errors in pixels."""
    _, filter, frames = turned_scene(three, (0.0, 5.0, 0.0))
    exact = three.rig(three.joints[:1]).pixels
    frames = [frames[0]._replace(pixels=exact + error) for error in errors]
    faults, _, _ = find_faults(filter, frames[0], CameraFaults.none(frames[0]))
    for frame in frames[1:]:
        faults = looked_at_again(filter, faults, frame)
    return faults


def test_errors_that_last_do_not_count_in_every_frame(three):
    shape, generator = (20, 3, len(NAMES), 2), torch.Generator().manual_seed(0)
    errors = 3 * torch.randn(shape, generator=generator, dtype=torch.float64)
    often, once = looked_at(three, errors), looked_at(three, errors[:1].expand(20, -1, -1, -1))
    assert float(often.looks.n_frames) == float(once.looks.n_frames) == 5.0
    assert float(often.looks.lasting) < 0.1 and float(once.looks.lasting) > 0.9
    assert bool(is_turned(once.turn)[0, 1])


def test_turns_are_a_mean_over_explanations_as_far_as_errors_last():
    turn = torch.eye(3).double().repeat(1, 4, 2, 1, 1)
    for explanation, camera in ((0, 0), (1, 1)):
        turn[0, explanation, camera] = rotvec_to_matrix(torch.tensor([0.04, 0.0, 0.0]).double())
    cost = torch.tensor([[0.0, 0.1, 50.0, 60.0]]).double()
    found = [angles_of(_mean_turn(turn, cost, cost.new_tensor([part])))[0] for part in (0.0, 1.0)]
    assert found[0].tolist() == pytest.approx([0.04, 0.0], abs=1e-9)
    assert found[1].tolist() == pytest.approx([0.021, 0.019], abs=1e-4)
    assert bool((_mean_turn(turn, -cost, cost.new_ones(1)) == torch.eye(3)).all())


def test_what_is_known_of_turns_outlasts_another_search(three):
    _, filter, frames = turned_scene(three, (0.0, 5.0, 0.0))
    faults, _, _ = find_faults(filter, frames[0], CameraFaults.none(frames[0]))
    again, _, better = find_faults(filter, frames[1], faults)
    assert not bool(better.any())
    assert torch.equal(again.turn, faults.turn) and bool(again.doubted < 0)


def test_large_turns_are_unlikely():
    turn = torch.eye(3).double().repeat(3, 1, 1)
    assert float(unlikely(turn)) == 0.0
    turn[1] = rotvec_to_matrix(torch.tensor([0.02, 0.0, 0.0]).double())
    assert float(unlikely(turn)) == pytest.approx(2 * math.log(2), abs=1e-3)


def test_cameras_that_turn_out_to_be_right_are_no_longer_turned_back(three):
    _, filter, frames = turned_scene(three, (0.0, 0.0, 0.0))
    wrong = frames[0].pixels.clone()
    wrong[:, 1] += 60.0
    faults, _, _ = find_faults(
        filter, frames[0]._replace(pixels=wrong), CameraFaults.none(frames[0])
    )
    assert bool(faults.wrong.all())
    for frame in frames[1:]:
        faults = looked_at_again(filter, faults, frame)
    assert not bool(faults.wrong.any()) and not bool(angles_of(faults.turn).any())


def test_live_steps_say_which_cameras_are_wrong(three):
    tracker = kalman(with_turn(three.rig, 1, 5.0))
    _, found = tracker.step(tracker.init(names=NAMES), keypoints=three.keypoints[0])
    (note,) = found.notes
    assert "camera c1 (by" in note and "are turned back" in note
    tracker = kalman(three.rig)
    stream = tracker.init(names=NAMES)
    still = three.keypoints[:1].expand_as(three.keypoints).clone()
    still[:, :2] = three.keypoints[:, :2]
    for keypoints in still[[0, 1, 2, 3]]:
        stream, found = tracker.step(stream, keypoints=keypoints)
        assert found.notes == ()
    assert stream.filter.body.faults.still.tolist() == [[0.0, 0.0, 3.0]]


def test_notes_of_a_live_frame():
    count, off = torch.tensor([0.0, 29.0, 28.0]), torch.tensor([True, False, False])
    left, out = notes_on_cameras_now("abc", count, off, torch.zeros(3))
    assert "camera b" in left and "for 30 frames" in left and "camera a is left out" in out
    assert notes_on_cameras_now("abc", 0 * count, off & False, torch.zeros(3)) == ()


def test_right_cameras_stay_as_they_are(three):
    found = track(three.keypoints[:10], three.rig)
    assert found.notes == () and not found.respread.any()


@pytest.mark.usefixtures("undoubted_here")
def test_a_camera_that_stands_still_is_not_used(three):
    keypoints, joints = three.keypoints[:14].clone(), three.joints[:14]
    keypoints[8:, 2] = keypoints[8, 2]
    found = track(keypoints, three.rig)
    two = track(three.keypoints[:14, :2], three.rig.select([0, 1]))
    assert float(errors(found, joints)[10:].mean()) < 1.2 * float(errors(two, joints)[10:].mean())
    assert float(found.details["inlier"][9:, 2].max()) == 0.0
    tracker = kalman(three.rig)
    stream = tracker.init(names=NAMES)
    for t in range(12):
        stream, live = tracker.step(stream, keypoints=keypoints[t])
    torch.testing.assert_close(live.joints3d[0], found.joints3d[11])


@pytest.mark.slow
@pytest.mark.usefixtures("undoubted_here")
def test_what_is_refined_leaves_wrong_cameras_out():
    seen = scene(4, n_frames=14)
    keypoints = seen.keypoints.clone()
    keypoints[4:, 2] = keypoints[4, 2]
    keypoints[:, 3] = 400.0 + 0.5 * seen.keypoints[:, 1].flip(1)
    tracker = kalman(seen.rig)
    found = tracker(keypoints=keypoints, refine="extrinsics")
    assert float(found.details["inlier"][5:, 2].max()) == 0.0
    assert float(found.details["inlier"][:, 3].max()) == 0.0
    assert float(errors(found, seen.joints).mean()) < 0.02
    assert any("camera c3 was left out" in note for note in found.notes)
    assert not any("no keypoint of this person" in note for note in found.notes)


@pytest.mark.usefixtures("undoubted_here")
def test_what_is_refined_begins_with_the_turns_that_tracking_finds(three):
    said = with_turn(three.rig, 1, 6.0)
    tracker = kalman(said)
    found = tracker(keypoints=three.keypoints[:14], refine="extrinsics")
    assert float(errors(found, three.joints[:14]).mean()) < 0.02
    rotation = rotvec_to_matrix(found.details["camera_rotation"][0])
    off = torch.rad2deg(angles_of(rotation @ three.rig.rotation.mT))
    assert float(off.max()) < 0.8
    notes = [note for note in found.notes if "refined: camera c1 was turned by" in note]
    assert len(notes) == 1 and abs(float(notes[0].split("by ")[1].split()[0]) - 6.0) < 0.8


def test_turns_that_are_known_and_further_errors_make_one(three):
    known = torch.zeros(3, 7, dtype=torch.float64)
    known[1, :3] = torch.tensor([0.1, -0.2, 0.05])
    further = 0.02 * torch.randn(3, 7, generator=torch.Generator().manual_seed(3)).double()
    first = _corrected(three.rig, known)
    both = _corrected(three.rig, _one_after_another(known, further))
    then = _corrected(first, further)
    torch.testing.assert_close(both.rotation, then.rotation)
    torch.testing.assert_close(both.translation, then.translation)
    change = first.rotation[1] @ three.rig.rotation[1].mT
    turn = torch.eye(3).double().repeat(3, 1, 1)
    turn[1] = (three.rig.rotation[1].mT @ change @ three.rig.rotation[1]).mT
    torch.testing.assert_close(_turns_of(three.rig, turn), known[:, :3])


def test_everything_that_stands_still_is_used(three):
    frame = frame_of(three.keypoints[0])
    assert bool((without_still(frame, frame.pixels, frame.inlier).inlier > 0).all())


@pytest.mark.usefixtures("undoubted_here")
def test_a_camera_that_sees_somebody_else_is_left_out_and_comes_back():
    seen = scene(4, n_frames=38)
    keypoints, other = seen.keypoints.clone(), scene(4, n_frames=38, height=1.1)
    keypoints[6:22, 1] = 400.0 + 0.5 * other.keypoints[6:22, 3].flip(1)
    found = track(keypoints, seen.rig)
    assert float(errors(found, seen.joints).mean()) < 0.03
    assert float(found.details["inlier"][10:20, 1].mean()) < 0.5
    assert float(found.details["inlier"][33:, 1].mean()) > 0.7


@pytest.mark.parametrize("order", [(1, 0), (0, 2, 1), (3, 1, 2, 0)])
def test_another_order_of_the_inputs_is_said(order):
    places = [(0.6, 4.0), (2.0, 3.1), (3.9, 4.6), (5.5, 3.6)][: len(order)]
    rig = CameraRig([camera_at(*place, f"c{i}") for i, place in enumerate(places)])
    pixels = rig(moving_body() + torch.tensor([0.6, 0.1, 0.3])).pixels
    frame = frame_of(pixels[0])
    frames = frame.map(lambda value: value.repeat(len(pixels), *[1] * (value.ndim - 1)))
    right = frames._replace(pixels=pixels)
    frames = frames._replace(pixels=pixels[:, list(order)])
    names, maps = [f"c{i}" for i in range(len(order))], RigMaps.of(rig)
    (note,) = notes_on_order(names, maps, frames)
    for camera, given in enumerate(order):
        assert f"input {camera + 1} is of c{given}" in note
    assert notes_on_order(names, maps, right) == ()


def test_other_readings_are_tried_only_where_they_can_be_better(three, monkeypatch):
    given = KeypointBodyTracker(three.rig, FPS).reader.frames_and_feet(
        three.keypoints, None, NAMES, None
    )[0]
    maps, tried = RigMaps.of(three.rig), []
    assert agree_as_given(maps, given)
    assert not agree_as_given(maps, given._replace(pixels=given.pixels[:, [1, 0, 2]]))
    for name in ("notes_on_order", "notes_on_one_camera"):
        monkeypatch.setattr(track_builder, name, lambda *_, name=name: tried.append(name) or ())
    mirrored = three.keypoints[:3].clone()
    track(mirrored, three.rig)
    assert tried == []
    mirrored[:, 1, :, 0] = 1919 - mirrored[:, 1, :, 0]
    track(mirrored, three.rig)
    assert tried == ["notes_on_order", "notes_on_one_camera"]


@pytest.mark.parametrize(("cameras", "exchanged"), [(3, True), (4, False)])
def test_one_mirrored_camera_is_said(cameras, exchanged):
    seen = scene(cameras, n_frames=10)
    keypoints = seen.keypoints + torch.tensor([90.0, 0.0])  # not in the middle
    rig = copy.deepcopy(seen.rig)
    rig.matrix[:, 0, 2] += 90
    mirrored = keypoints.clone()
    mirrored[:, 1, :, 0] = 1919 - keypoints[:, 1, :, 0]
    if exchanged:
        mirror = exchange_of(BODY_15, torch.device("cpu")).mirror
        mirrored[:, 1] = mirrored[:, 1, mirror]
    notes = track(mirrored, rig).notes
    assert (
        notes[0].startswith("camera c1: ")
        and "of this camera alone, the images are mirrored" in notes[0]
    )
    assert not any("seems to have begun" in note for note in notes)


@pytest.mark.parametrize("cameras", [2, 3])
def test_sides_that_are_exchanged_in_all_cameras_are_said(cameras):
    seen = scene(cameras, n_frames=8)
    single = KeypointBodyTracker(seen.rig, FPS)
    frames = single.reader.frames_and_feet(seen.keypoints, seen.confidence, NAMES, None)[0]
    filter = single.tracker.filter
    assert notes_on_all_sides(filter, frames) == ()
    nobody = frames._replace(inlier=0 * frames.inlier)
    assert notes_on_all_sides(filter, nobody) == ()
    mirror = filter.exchange.mirror
    notes = track(seen.keypoints[:, :, mirror], seen.rig).notes
    assert "left and right seem to be exchanged in all cameras" in notes[0]


def test_one_camera_with_images_of_another_size_is_said(three):
    keypoints = three.keypoints[:8].clone()
    keypoints[:, 2] = (keypoints[:, 2] + 0.5) / 2 - 0.5
    notes = track(keypoints, three.rig).notes
    assert notes[0].startswith("camera c2: ") and "keypoints are of images of 1/2" in notes[0]


def test_right_and_turned_cameras_are_not_called_mirrored(three):
    filter = kalman(three.rig).by_keypoints.tracker.filter
    sides = filter.exchange.mirror
    behind = three.keypoints.clone()
    behind[::4, 1] = behind[::4, 1, sides]  # sides that a detector exchanges
    turned_rig = with_turn(three.rig, 1, 20.0)
    for rig, keypoints in ((three.rig, three.keypoints), (three.rig, behind), (turned_rig, behind)):
        single = KeypointBodyTracker(rig, FPS)
        frames = single.reader.frames_and_feet(keypoints, None, NAMES, None)[0]
        maps = single.tracker.filter.maps
        assert notes_on_one_camera(rig, maps, frames, filter.exchange) == ()


def test_a_rolled_camera_by_itself_is_said():
    seen = scene(1)
    pixels, there = seen.keypoints[:, 0], torch.ones((*seen.keypoints.shape[:1], 15)) > 0
    assert notes_on_a_rolled_camera("a", pixels, there) == ()
    quarter = torch.stack([1080 - pixels[..., 1], pixels[..., 0]], -1)
    (note,) = notes_on_a_rolled_camera("a", quarter, there)
    assert "leans by" in note and "--up" in note


def test_several_persons_in_cameras_in_other_units_are_refused(three):
    far = ring(3)
    far.translation.mul_(15)
    tracker = kalman(far)
    with pytest.raises(CameraError, match="metres"):
        tracker(keypoints=three.keypoints[:, :, None], persons="all")
