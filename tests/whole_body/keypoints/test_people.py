"""Several persons from detections in any order: who is who, who enters and leaves, live as in one go."""

import math

import pytest
import torch

from tests.whole_body.keypoints.scenes import FPS, kalman, moving_body, noisy, ring
from torchpose.errors import InputError, NobodySeenError, ShapeError
from torchpose.math._rotations import rotvec_to_matrix
from torchpose.whole_body import BodyTracker
from torchpose.whole_body._keypoints.people_association import assign, detection_gains
from torchpose.whole_body._keypoints.people_tracker import PeopleTracker
from torchpose.whole_body._keypoints.people_turns import turns_of_all
from torchpose.whole_body._keypoints.turned_cameras import angles_of

pytestmark = pytest.mark.usefixtures("undoubted_cameras")

T = 32


def passing(cameras, seed=0):
    """Two persons half a metre apart as they pass: rig, joints [T, 2, 15, 3], keypoints [T, C, D, 15, 2]."""
    along = torch.linspace(-0.8, 0.8, T, dtype=torch.float64)
    joints = torch.stack([moving_body(T), moving_body(T, 1.8, phase=0.4)], 1)
    joints[:, 0, :, 0] += along[:, None]
    joints[:, 1, :, 0] -= along[:, None]
    joints[:, 1, :, 2] += 0.45
    rig = ring(cameras)
    pixels = torch.stack([rig(joints[:, p]).pixels for p in range(2)], 2)
    return rig, joints, noisy(pixels, 3.0, seed)


def shuffled(pixels, seed=1):
    order = torch.rand(pixels.shape[:3], generator=torch.Generator().manual_seed(seed)).argsort(-1)
    return pixels.gather(2, order[..., None, None].expand_as(pixels)), order


@pytest.mark.parametrize("cameras", [3, 2])
def test_persons_who_pass_each_other_stay_who_they_are(cameras):
    rig, joints, pixels = passing(cameras)
    mixed, order = shuffled(pixels)
    found = kalman(rig)(keypoints=mixed, persons="all")
    assert [len(one) for one in found] == [T, T]
    alone = kalman(rig)(keypoints=pixels.movedim(2, 0))
    for one in found:
        p = int((one.joints3d - joints.movedim(1, 0)).norm(dim=-1).mean((1, 2)).argmin())
        error = (one.joints3d - joints[:, p]).norm(dim=-1).mean()
        assert float(error) < 1.1 * float((alone[p].joints3d - joints[:, p]).norm(dim=-1).mean())
        used = one.details["detection"]
        whose = order.gather(-1, used.clamp_min(0)[..., None]).squeeze(-1)
        assert float((whose == p)[used >= 0].double().mean()) == 1.0


@pytest.mark.parametrize("cameras", [3, 2])
def test_persons_are_found_at_five_frames_a_second(cameras):
    rig, joints, pixels = passing(cameras)
    slow = BodyTracker(rig, method="kalman", fps=FPS / 6)
    found = slow(keypoints=shuffled(pixels[::6])[0], persons="all")
    assert [(one.first_frame, len(one)) for one in found] == [(0, 6), (0, 6)]
    for one in found:
        off = (one.joints3d - joints[::6].movedim(1, 0)).norm(dim=-1).mean((1, 2))
        assert float(off.min()) < 0.05


def test_a_camera_that_is_turned_is_used_all_the_same():
    rig, _, pixels = passing(3)
    angle = math.radians(1.3)
    c, s = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
    rig.rotation[0], rig.translation[0] = turn @ rig.rotation[0], turn @ rig.translation[0]
    found = kalman(rig)(keypoints=shuffled(pixels[:20])[0], persons="all")
    assert [len(one) for one in found] == [20, 20]
    # by 1.3 degrees joints are 9 cm off at 4 m, seven times the noise of keypoints
    for one in found:
        assert (one.details["detection"] >= 0).double().mean(0).min() > 0.95


def test_a_camera_that_is_turned_is_turned_back_for_everybody():
    rig, _, pixels = passing(4)
    turn = rotvec_to_matrix(torch.tensor([math.radians(1.5), 0.0, 0.0]).double())
    rig.rotation[1], rig.translation[1] = turn @ rig.rotation[1], turn @ rig.translation[1]
    found = kalman(rig)(keypoints=shuffled(pixels[:20])[0], persons="all")
    assert len(found) == 2
    for track in found:
        angles = torch.rad2deg(angles_of(track.details["camera_turn"][-1]))
        assert angles.tolist() == pytest.approx([0.0, 1.5, 0.0, 0.0], abs=0.1)
        assert any("c1 (by 1.5" in n and "on a recording of one person" in n for n in track.notes)


def with_turns(rig, degrees):
    """The rig, of which each camera is said to be turned by so much about an axis of its own."""
    generator = torch.Generator().manual_seed(3)
    axis = torch.randn(len(rig), 3, generator=generator, dtype=torch.float64)
    axis = torch.nn.functional.normalize(axis, dim=-1)
    turn = rotvec_to_matrix(torch.deg2rad(torch.tensor(degrees))[:, None] * axis)
    rig.rotation[:] = turn @ rig.rotation
    rig.translation[:] = (turn @ rig.translation[..., None]).squeeze(-1)
    return rig


@pytest.mark.parametrize("degrees", [(0.0, 4.0, 0.0, 0.0), (1.5, 1.5, 1.5, 1.5)])
def test_detections_of_turned_cameras_are_those_of_persons_and_begin_nobody(degrees):
    rig, joints, pixels = passing(4)
    pixels = shuffled(pixels)[0][:10]
    found = kalman(with_turns(rig, degrees))(keypoints=pixels, persons="all")
    assert [(one.first_frame, len(one)) for one in found] == [(0, 10), (0, 10)]
    for one in found:
        assert bool((one.details["detection"] >= 0).all())
        assert float(one.details["inlier"].mean()) > 0.8
        off = (one.joints3d - joints[:10].movedim(1, 0)).norm(dim=-1).mean((1, 2))
        assert float(off.min()) < 0.04
        assert any("against the calibration" in note for note in one.notes)


def test_two_detections_of_two_cameras_tell_no_turn():
    rig, _, pixels = passing(3)
    people = kalman(rig).by_keypoints
    none = torch.eye(3).double().expand(3, 3, 3)

    def told(keypoints):
        trust = torch.full_like(keypoints[..., 0], 0.9)
        frame, _ = people.reader.frames_and_feet(
            keypoints.transpose(0, 1), trust.transpose(0, 1), None, None
        )
        return turns_of_all(people.tracker.filter, frame, none)

    assert abs(told(pixels[0]).gain) < 1.0  # both persons in all cameras, which are right
    apart = pixels[0].clone()
    apart[0, 1] = apart[1, 0] = apart[2] = math.nan
    assert told(apart) is None


@pytest.mark.slow
def test_a_note_names_the_camera_whose_detections_are_nobodys():
    rig, _, pixels = passing(3)
    notes = [
        one.notes
        for degrees in (0.0, 40.0)
        for one in kalman(with_turns(rig, (0.0, degrees, 0.0)))(keypoints=pixels, persons="all")
    ]
    assert len(notes) == 4
    said = [
        [note for note in own if "detection that fits no tracked person" in note] for own in notes
    ]
    assert said[:2] == [[], []]
    for (note,) in said[2:]:
        assert note.startswith("in 100 % of its frames camera c1")


def test_live_has_the_same_numbers():
    rig, _, pixels = passing(3)
    pixels = shuffled(pixels)[0][:8]
    whole = kalman(rig)(keypoints=pixels, persons=2)
    live = kalman(rig)
    state = live.init()
    for frame in pixels:
        state, now = live.step(state, keypoints=frame, persons=2)
    assert len(now) == len(whole) == 2
    for one, last in zip(whole, now, strict=True):
        torch.testing.assert_close(last.joints3d[0], one.joints3d[-1])
        assert int(last.details["person"]) == int(one.details["person"][-1])


def test_a_frame_in_which_no_camera_detects_anybody_is_one_of_missing_keypoints():
    rig, _, pixels = passing(2)
    found = []
    for nobody in (pixels[0, :, :0], torch.full_like(pixels[0], torch.nan)):
        one, state = kalman(rig), kalman(rig).init()
        for frame in (nobody, *pixels[:6], nobody, nobody, *pixels[9:11]):
            state, poses = one.step(state, keypoints=frame, persons="all")
        found.append(torch.cat([pose.joints3d for pose in poses]))
    assert len(found[0]) == 2 and torch.equal(*found)


def test_who_enters_late_and_leaves_is_tracked_while_there():
    rig, _, pixels = passing(3)
    pixels[:10, :, 1] = math.nan
    pixels[30:, :, 1] = math.nan
    pixels[:, 2, 1] = math.nan  # a camera that sees only the first
    found = kalman(rig)(keypoints=shuffled(pixels)[0], persons="all", smoothing="full")
    assert [(one.first_frame, len(one)) for one in found] == [(0, T), (10, 20)]
    assert (found[1].details["detection"][:, 2] == -1).all()


SLOW = 15  # frames a second


def walkers(starts, cameras=2, seconds=1.7, speed=1.2, seed=0):
    """Persons who walk along x from starts [x, z] beside each other: rig, keypoints [T, C, P, 15, 2]."""
    bodies = [moving_body(round(seconds * FPS), 1.8 - 0.1 * i)[::2] for i in range(len(starts))]
    time = torch.arange(len(bodies[0]), dtype=torch.float64) / SLOW
    joints = torch.stack(bodies, 1)
    for i, (x, z) in enumerate(starts):
        joints[:, i, :, 0] += x + speed * time[:, None]
        joints[:, i, :, 2] += z
    rig = ring(cameras)
    pixels = torch.stack([rig(joints[:, p]).pixels for p in range(len(starts))], 2)
    return rig, noisy(pixels, 3.0, seed)


def followed(rig, pixels):
    found = BodyTracker(rig, method="kalman", fps=SLOW)(keypoints=pixels, persons="all")
    return sorted((one.first_frame, len(one)) for one in found)


@pytest.mark.slow
@pytest.mark.parametrize(("cameras", "seconds"), [(2, 0.5), (2, 0.9), (1, 0.5)])
def test_who_walks_on_unseen_is_the_same_person(cameras, seconds):
    rig, pixels = walkers([(-1.0, 0.0), (-1.0, 1.0)], cameras)
    pixels[8 : 8 + round(seconds * SLOW), :, 0] = math.nan
    assert followed(rig, pixels) == [(0, len(pixels))] * 2


def test_who_enters_elsewhere_is_not_who_left_before():
    rig, pixels = walkers([(-1.0, 0.0), (-1.0, 1.0), (-1.0, -1.3)])
    pixels[8:, :, 0] = pixels[:16, :, 2] = math.nan  # half a second with neither
    assert followed(rig, pixels) == [(0, 8), (0, len(pixels)), (16, len(pixels) - 16)]


def test_two_who_come_back_together_are_who_they_were():
    rig, pixels = walkers([(-1.0, 0.0), (-1.0, 0.6)])
    pixels[8:18] = math.nan
    tracker = BodyTracker(rig, method="kalman", fps=SLOW)
    found = tracker(keypoints=shuffled(pixels)[0], persons="all")
    assert len(found) == 2
    seen = torch.stack([rig(one.joints3d).pixels[-1] for one in found])
    off = (seen[:, None] - pixels[-1].transpose(0, 1)).norm(dim=-1).mean((-1, -2))
    first = torch.stack([rig(one.joints3d).pixels[0] for one in found])
    before = (first[:, None] - pixels[0].transpose(0, 1)).norm(dim=-1).mean((-1, -2))
    assert off.argmin(1).tolist() == before.argmin(1).tolist()


def back_to_back(turn):
    """Two persons 0.6 m apart, seen from a turned side by three cameras: joints and keypoints."""
    joints = [moving_body(T) @ about_up(turn), moving_body(T, 1.8, phase=0.4) @ about_up(turn + 3)]
    joints[1][..., 2] += 0.6
    rig = ring(3)
    pixels = torch.stack([rig(one).pixels for one in joints], 2)
    return rig, torch.stack(joints, 1), noisy(pixels, 2.0)


def about_up(angle):
    sin, cos = math.sin(angle), math.cos(angle)
    return torch.tensor([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]]).double()


@pytest.mark.parametrize("turn", [0.0, 2.0])
def test_two_persons_whom_one_camera_each_sees_stay_two(turn):
    rig, joints, pixels = back_to_back(turn)
    pixels[12:, 1:, 0] = math.nan
    pixels[12:, 0, 1] = pixels[12:, 2, 1] = math.nan
    found = kalman(rig)(keypoints=pixels, persons="all")
    assert [len(one) for one in found] == [T, T]
    off = [(one.joints3d - joints.movedim(1, 0)).norm(dim=-1).mean((1, 2)) for one in found]
    assert {int(each.argmin()) for each in off} == {0, 1}
    assert max(float(each.min()) for each in off) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("turn", [0.0, 4.0])
def test_somebody_whom_another_camera_sees_does_not_move_a_person(turn):
    rig, joints, pixels = back_to_back(turn)
    pixels[10:, 1:, 0] = math.nan
    pixels[:20, :, 1] = pixels[:, 0, 1] = pixels[:, 2, 1] = math.nan
    (found,) = kalman(rig)(keypoints=pixels, persons="all")
    assert len(found) == T and not found.respread.any()
    assert float((found.joints3d - joints[:, 0]).norm(dim=-1).mean()) < 0.1


def test_persons_who_are_there_begin_anew_where_there_is_no_room_for_others():
    people = kalman(ring(2)).by_keypoints.tracker
    new = torch.tensor([True, False, True, True])
    assert PeopleTracker(people, 2)._has_room(new, 1).tolist() == [True, True, False, False]
    assert PeopleTracker(people, None)._has_room(new, 1).all()


def test_a_gap_of_who_enters_late_has_the_numbers_of_the_recording():
    rig, _, pixels = passing(2)
    still = pixels[5:6, :, :1].expand(50, -1, -1, -1, -1).clone()
    still[:10] = still[14:44] = math.nan
    (found,) = kalman(rig)(keypoints=still, persons="all")
    assert (found.first_frame, len(found)) == (10, 40)
    assert any("in frames 14 to 43;" in note for note in found.notes)


def test_a_detection_of_nobody_and_a_double_make_no_person():
    rig, _, pixels = passing(3)
    false = torch.full_like(pixels[:, :, :1], math.nan)
    false[5, 0] = pixels[5, 0, :1] + 400
    double = pixels[:, :, :1] + 2
    seen = torch.cat([pixels, false, double], 2)[:20]
    found = kalman(rig)(keypoints=seen, persons="all")
    assert len(found) == 2


def test_one_camera_tracks_two_persons_beside_each_other():
    rig, _, pixels = passing(1)
    apart = pixels[:10]  # before they cover each other
    found = kalman(rig)(keypoints=shuffled(apart)[0], persons="all")
    assert [len(one) for one in found] == [10, 10]
    seen = torch.stack([rig(one.joints3d).pixels[-1, 0] for one in found])
    off = (seen[:, None] - apart[-1, 0]).norm(dim=-1).mean(-1)  # of tracks from persons
    assert float(off.amin(1).max()) < 25.0 and set(off.argmin(1).tolist()) == {0, 1}


def test_assignment_is_the_best_of_all():
    gains = torch.tensor([[5.0, 4.0, -1.0], [5.5, 1.0, -2.0], [-1.0, -3.0, -2.0]])[:, None]
    assert assign(gains)[:, 0].tolist() == [1, 0, -1]


@pytest.mark.parametrize("confidence", [0.1, 1.0])
def test_who_is_behind_a_camera_wants_none_of_its_detections(confidence):
    rig, _, pixels = passing(3)
    single = kalman(rig).by_keypoints
    trust = torch.full_like(pixels[0, ..., 0], confidence).transpose(0, 1)
    frame = single.reader.frames_and_feet(pixels[0].transpose(0, 1), trust, None, None)[0]
    state = single.tracker.advance(None, frame)[0].state
    behind = state.mean.position - 1.4 * rig.rotation[0].T @ rig.translation[0]
    moved = state._replace(mean=state.mean._replace(position=behind))
    assert (detection_gains(single.tracker.filter, state, frame)[:, 0].amax(-1) > 0).all()
    assert (detection_gains(single.tracker.filter, moved, frame)[:, 0] < 0).all()


def test_bad_input_is_refused():
    rig, _, pixels = passing(2)
    for persons in ("some", 0, True):
        with pytest.raises(InputError, match="persons"):
            kalman(rig)(keypoints=pixels, persons=persons)
    with pytest.raises(ShapeError):
        kalman(rig)(keypoints=pixels[:, :, 0], persons="all")
    with pytest.raises(InputError, match="refine"):
        kalman(rig)(keypoints=pixels, persons="all", refine="both")
    with pytest.raises(NobodySeenError):
        kalman(rig)(keypoints=torch.full_like(pixels, math.nan), persons="all")
