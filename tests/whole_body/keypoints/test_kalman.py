"""The Kalman filter over bodies against dense algebra, simulated bodies and bad keypoints."""

import copy
import math

import numpy as np
import pytest
import torch

import torchpose
from tests.whole_body.keypoints.scenes import (
    FPS,
    NAMES,
    errors,
    kalman,
    moving_body,
    ring,
    scene,
    track,
)
from torchpose.body import BODY_15, Body
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.errors import (
    CameraError,
    InputError,
    NobodySeenError,
    PriorError,
    ShapeError,
    SkeletonError,
)
from torchpose.priors._shipped import load_body_motion
from torchpose.whole_body import BodyTrack, BodyTracker
from torchpose.whole_body._keypoints import keypoint_tracker
from torchpose.whole_body._keypoints.keypoint_notes import (
    TOO_FEW,
    late_note,
    notes_on_still_cameras,
)
from torchpose.whole_body._keypoints.keypoint_start import start
from torchpose.whole_body._keypoints.upright import level_cameras_up

pytestmark = pytest.mark.usefixtures("undoubted_cameras")

J = BODY_15.joint
T = 34


@pytest.fixture(scope="module")
def four():
    return scene(4, T)


@pytest.fixture(scope="module")
def filtered(four):
    return track(four)


# --- accuracy ---------------------------------------------------------------------------------------


def test_several_cameras_find_joints_to_a_centimetre(four, filtered):
    assert float(errors(filtered, four.joints)[10:].mean()) < 0.010
    assert not filtered.coasting.any() and not filtered.failed


def test_smoothing_is_nearer_and_surer(four, filtered):
    smoothed = track(four, "full")
    assert float(errors(smoothed, four.joints).mean()) < float(errors(filtered, four.joints).mean())
    spread = smoothed.covariance3d.diagonal(dim1=-2, dim2=-1).sum(-1)
    assert (
        spread[:-1] <= filtered.covariance3d.diagonal(dim1=-2, dim2=-1).sum(-1)[:-1] * 1.01
    ).all()
    torch.testing.assert_close(smoothed.joints3d[-1], filtered.joints3d[-1])


def share_in_ellipsoids(track, joints):
    """The share of joints in 90 % ellipsoids."""
    away = track.joints3d - joints
    solved = torch.linalg.solve(track.covariance3d, away[..., None]).squeeze(-1)
    return float(((away * solved).sum(-1) < 6.251).double().mean())


def test_ellipsoids_hold_what_they_say(four, filtered):
    assert 0.75 < share_in_ellipsoids(filtered, four.joints) < 0.995


def test_noise_of_keypoints_is_told_within_a_second():
    """It is three times the usual one, and without that ellipsoids hold a third of the joints."""
    given = scene(3, 30, noise=12.0)
    assert share_in_ellipsoids(track(given), given.joints) > 0.65


def test_bones_become_those_of_the_person(spoiled):
    _, found = spoiled["tall"]
    wanted = Body.of_height(BODY_15, 1.95).bone_lengths
    for name in ("left_knee", "right_ankle", "left_elbow"):
        length = found.details["bone_lengths"][-1, J(name)]
        assert float((length / wanted[J(name)] - 1).abs()) < 0.03, name


def test_one_camera_tells_the_pose_up_to_size():
    one = scene(1, 20)
    found = track(one, height=1.7)
    pixels = one.rig(found.joints3d).pixels
    assert float((pixels - one.keypoints).norm(dim=-1)[5:].median()) < 15
    assert not any("size of a person" in note for note in found.notes)
    assert any("size of a person" in note for note in track(one).notes)


def test_covariances_of_one_camera_have_what_frames_do_not_average_out():
    one = scene(1, 10)
    least = torch.linalg.eigvalsh(track(one).covariance3d)[..., 0]
    assert float(least.min()) >= (2 / 3 * 0.03) ** 2


def test_who_is_upright_is_seen_so_where_up_is_known():
    """The camera looks down, and is taken for about level where nothing is said."""
    joints, rig = moving_body(20), ring(1)
    pixels = rig(joints).pixels

    def lean(**options) -> float:
        found = kalman(rig, **options)(keypoints=pixels).joints3d[10:]
        trunk = (found[:, J("neck")] - found[:, J("pelvis")]).mean(0)
        return float(torch.acos(trunk[1] / trunk.norm()))

    known = lean(up="y")
    assert known < 0.12 and known < lean()
    with pytest.raises(InputError, match="up must be one of"):
        kalman(rig, up="x")


def test_a_motion_is_taken_by_its_name_or_as_it_is(four, filtered):
    few = four.keypoints[:5]
    by_name = kalman(four.rig, motion="whole-body")(keypoints=few, confidence=four.confidence[:5])
    itself = kalman(four.rig, motion=load_body_motion("whole-body"))(
        keypoints=few, confidence=four.confidence[:5]
    )
    assert torch.equal(by_name.joints3d, filtered.joints3d[:5])
    assert torch.equal(itself.joints3d, filtered.joints3d[:5])
    with pytest.raises(PriorError):
        kalman(four.rig, motion="no such motion")


# --- faults -----------------------------------------------------------------------------------------


AWAY = (100.0, 1e4, 1e6)  # pixels


def tracked_together(seen, cases):
    """What was there, and the track, of each case of (joints, keypoints), in one batch."""
    keypoints = torch.stack([pixels for _, pixels in cases.values()])
    confidence = seen.confidence.expand(len(cases), -1, -1, -1)
    tracks = kalman(seen.rig)(keypoints=keypoints, confidence=confidence)
    return {
        name: (joints, found)
        for (name, (joints, _)), found in zip(cases.items(), tracks, strict=True)
    }


@pytest.fixture(scope="module")
def spoiled(four):
    """What was there, and the track, of the scene with each fault."""
    cases = {
        "none": (four.joints, four.keypoints),
        "somebody else": (four.joints, scene(4, T, seed=5).keypoints),
        **{f"wild by {away:g}": (four.joints, _with_wild_wrist(four, away)) for away in AWAY},
        "exchanged": (four.joints, _with_exchanged_legs(four)),
        "unseen": (four.joints, _without_wrist(four)),
        "jump": _with_jumping_wrist(four),
        "elsewhere": _who_is_elsewhere(four),
        "tall": scene(4, T, height=1.95)[::2],
        "aside": (four.joints, _with_a_camera_aside(four)),
    }
    return tracked_together(four, cases)


def _with_wild_wrist(four, away):
    keypoints = four.keypoints.clone()
    keypoints[12, 1, J("left_wrist")] += away
    return keypoints


BOTH_LEGS = [
    J(f"{side}_{joint}") for side in ("left", "right") for joint in ("hip", "knee", "ankle")
]


def _with_exchanged_legs(seen, camera=2, frames=slice(15, 20)):
    keypoints = seen.keypoints.clone()
    mirrored = [*BOTH_LEGS[3:], *BOTH_LEGS[:3]]
    keypoints[frames, camera][:, BOTH_LEGS] = seen.keypoints[frames, camera][:, mirrored]
    return keypoints


def _without_wrist(four):
    keypoints = four.keypoints.clone()
    keypoints[20:28, :, J("right_wrist")] = torch.nan
    return keypoints


def _with_jumping_wrist(four):
    joints = moving_body(T)
    joints[20:, J("left_wrist")] = joints[20:, J("left_elbow")] + (
        joints[20:, J("left_elbow")] - joints[20:, J("left_wrist")]
    )
    return joints, four.rig(joints).pixels


def _who_is_elsewhere(four):
    joints = four.joints.clone()
    joints[25:] += torch.tensor([0.9, 0.0, -0.6])
    keypoints = four.rig(joints).pixels
    keypoints[15:25] = torch.nan
    return joints, keypoints


def _with_a_camera_aside(four):
    keypoints = four.keypoints.clone()
    keypoints[:, 3, :, 0] += 400.0
    return keypoints


@pytest.mark.parametrize("away", AWAY)
def test_one_wild_keypoint_moves_nothing(spoiled, filtered, away):
    _, found = spoiled[f"wild by {away:g}"]
    moved = (found.joints3d - filtered.joints3d).norm(dim=-1)
    assert float(moved[12].max()) < 0.04 and float(moved[15].max()) < 0.02
    assert float(found.details["inlier"][12, 1, J("left_wrist")]) < 0.01


def test_exchanged_sides_of_a_camera_are_told_and_undone(spoiled):
    joints, found = spoiled["exchanged"]
    assert (found.details["exchanged"][15:20, 2, 1] > 0.9).all()
    assert (found.details["exchanged"][15:20, 2, 0] < 0.1).all()
    assert (found.details["exchanged"][:15, 2] < 0.1).all()
    assert float(errors(found, joints)[15:20].mean()) < 0.012


def test_a_joint_that_no_camera_sees_goes_on_and_comes_back(spoiled):
    joints, found = spoiled["unseen"]
    wrong = errors(found, joints)[:, J("right_wrist")]
    assert float(wrong[20:28].max()) < 0.25 and float(wrong[31:].max()) < 0.03
    std = found.covariance3d[:, J("right_wrist")].diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
    assert float(std[27]) > 2 * float(std[19])


def test_a_limb_that_jumps_is_found_again(spoiled):
    joints, found = spoiled["jump"]
    assert float(errors(found, joints)[26:, J("left_wrist")].max()) < 0.05


def test_a_person_who_went_away_is_found_elsewhere(spoiled):
    joints, found = spoiled["elsewhere"]
    assert found.coasting[15:25].all() and not found.coasting[25:].any()
    assert float(errors(found, joints)[-1].mean()) < 0.03


@pytest.fixture(scope="module")
def misled():
    """What was there, and the track, of two cameras that mislead."""
    two = scene(2, 20)
    cases = {
        "forearm": _with_a_forearm_along_the_view(two),
        "legs": (two.joints, _with_exchanged_legs(two, 0, slice(0, 3))),
    }
    return tracked_together(two, cases)


def _with_a_forearm_along_the_view(two):
    """A forearm that points away from the first camera instead of towards it, which looks the same there."""
    return _with_a_bone_along_the_view(two, "right_wrist")


def _with_a_bone_along_the_view(two, name):
    """A last bone of a limb that is mirrored in depth before the first camera, which sees no difference."""
    end, start = J(name), BODY_15.parents[J(name)]
    joints = two.joints.clone()
    place = -two.rig.rotation[0].mT @ two.rig.translation[0]
    ray = torch.nn.functional.normalize(joints[12:, end] - place, dim=-1)
    depth = ((joints[12:, end] - joints[12:, start]) * ray).sum(-1, keepdim=True)
    joints[12:, end] -= 2 * depth * ray
    return joints, two.keypoints + two.rig(joints).pixels - two.rig(two.joints).pixels


def test_a_joint_is_found_where_two_cameras_agree_though_one_had_it_elsewhere(misled):
    joints, found = misled["forearm"]
    wrong = errors(found, joints)[:, J("right_wrist")]
    assert float(wrong[12]) > 0.1 and float(wrong[16:].max()) < 0.05
    assert (found.details["inlier"][16:, :, J("right_wrist")] > 0.9).all()


@pytest.mark.parametrize("confidence", [0.7, 0.35])
def test_a_joint_is_found_where_cameras_agree_for_some_frames_of_which_none_tells(confidence):
    two = scene(2, 22)
    joints, keypoints = _with_a_bone_along_the_view(two, "right_ankle")
    doubtful = torch.full_like(two.confidence, confidence)
    found = kalman(two.rig)(keypoints=keypoints, confidence=doubtful)
    wrong = errors(found, joints)[:, J("right_ankle")]
    assert float(wrong[13]) > 0.4 and float(wrong[17:].max()) < 0.05


def test_a_body_begins_right_though_one_of_two_cameras_exchanges_its_legs(misled):
    joints, found = misled["legs"]
    assert float(errors(found, joints)[:, BOTH_LEGS].mean(-1).max()) < 0.03
    assert (found.details["exchanged"][:3, 0, 1] > 0.9).all()
    assert (found.details["exchanged"][4:] < 0.1).all()


def test_legs_that_began_on_the_wrong_sides_are_turned_back(monkeypatch):
    monkeypatch.setattr(keypoint_tracker, "likeliest_start", start)
    two = scene(2, 10)
    found = kalman(two.rig)(keypoints=_with_exchanged_legs(two, 0, slice(0, 3)))
    legs = errors(found, two.joints)[:, BOTH_LEGS].mean(-1)
    assert float(legs[2]) > 0.06 and float(legs[7:].max()) < 0.03
    assert (found.details["exchanged"][7:] < 0.1).all()


@pytest.fixture(scope="module")
def returning():
    """Who is away in frames 15 to 45 and returns turned, in two cameras."""
    given = scene(2, 56)
    c, s = math.cos(2.6), math.sin(2.6)
    turn = torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]], dtype=torch.float64)
    joints = given.joints.clone()
    joints[46:] = joints[46:] @ turn.mT + torch.tensor([0.6, 0.0, -0.4])
    keypoints = given.rig(joints).pixels
    keypoints[15:46] = torch.nan
    return given._replace(joints=joints, keypoints=keypoints)


@pytest.mark.parametrize("persons", [None, "all"])
def test_live_steps_tell_when_tracking_begins_anew(returning, persons):
    keypoints = returning.keypoints[:48]
    if persons is not None:  # one of several who is away for a second is another one
        keypoints = torch.cat([keypoints[:35], returning.keypoints[46:48]])[:, :, None]
    live = kalman(returning.rig)
    whole = live(keypoints=keypoints, persons=persons)
    (whole,) = whole if isinstance(whole, list) else [whole]
    state, anew = live.init(), []
    for frame in keypoints:
        state, now = live.step(state, keypoints=frame, persons=persons)
        anew.append([bool(one.respread) for one in (now if isinstance(now, list) else [now])])
    begins = len(keypoints) - 2
    assert whole.respread.nonzero().flatten().tolist() == [begins]
    assert [t for t, one in enumerate(anew) if one == [True]] == [begins]


@pytest.mark.parametrize("smoothing", ["none", "full"])
def test_who_was_away_for_a_second_and_turned_is_right_at_once(returning, smoothing):
    found = track(returning, smoothing)
    assert found.coasting.nonzero().flatten().tolist() == list(range(15, 46))
    assert found.respread.nonzero().flatten().tolist() == [46]
    assert float(errors(found, returning.joints)[46:].mean(-1).max()) < 0.03


def test_one_camera_sees_who_was_away_for_a_second_as_for_the_first_time(returning):
    one = returning._replace(
        rig=returning.rig.select([0]),
        keypoints=returning.keypoints[10:, :1],
        confidence=returning.confidence[10:, :1],
    )
    found = track(one, "full")
    assert found.respread[36]
    anew = one._replace(keypoints=one.keypoints[36:], confidence=one.confidence[36:])
    torch.testing.assert_close(found.joints3d[36:], track(anew, "full").joints3d)


@pytest.mark.parametrize("smoothing", ["none", "full"])
def test_who_comes_late_has_no_earlier_pose(smoothing):
    """The pose, body and all are those of the same keypoints without the empty frames before."""
    small = scene(3, 6, height=0.9)
    late = torch.cat([torch.full_like(small.keypoints, math.nan), small.keypoints])
    found, alone = (
        kalman(small.rig)(keypoints=k, smoothing=smoothing) for k in (late, small.keypoints)
    )
    assert found.first_frame == 6 and len(found) == 6
    assert found.notes == (*alone.notes, late_note(6, TOO_FEW)[0])
    # where a frame lies in memory may decide the last bit of a product
    torch.testing.assert_close(found.joints3d, alone.joints3d, rtol=0, atol=1e-14)
    torch.testing.assert_close(found.state, alone.state, rtol=0, atol=1e-14)
    assert found.body.height == pytest.approx(0.9, abs=0.1)
    together = kalman(small.rig)(keypoints=torch.stack([late, late.flip(0)]), smoothing=smoothing)
    assert [(one.first_frame, len(one)) for one in together] == [(6, 6), (0, 12)]
    torch.testing.assert_close(together[0].joints3d, alone.joints3d)


def test_a_late_track_is_written_with_its_frames(tmp_path):
    small = scene(3, 4, height=0.9)
    late = torch.cat([torch.full_like(small.keypoints, math.nan), small.keypoints])
    found = kalman(small.rig)(keypoints=late)
    found.save(tmp_path / "body.npz")
    assert BodyTrack.load(tmp_path / "body.npz").first_frame == 4
    found.export(tmp_path / "body.trc")
    rows = (tmp_path / "body.trc").read_text().splitlines()[6:]
    assert [row.split("\t")[0] for row in rows if row] == ["5", "6", "7", "8"]


def test_cameras_of_a_late_track_are_refined_from_its_beginning():
    given = scene(2, 12)
    late = torch.cat([torch.full_like(given.keypoints[:6], math.nan), given.keypoints])
    found = kalman(given.rig)(keypoints=late, refine="extrinsics")
    assert (found.first_frame, len(found)) == (6, 12)
    assert len(found.details["camera_delays"]) == 12


def test_live_there_is_no_pose_before_the_first(four, tmp_path):
    live = kalman(four.rig)
    nothing = torch.full_like(four.keypoints[0], math.nan)
    state, before = live.step(live.init(), keypoints=nothing)
    state, begun = live.step(state, keypoints=four.keypoints[0])
    for name in ("state", "state_std", "joints3d", "covariance3d"):
        assert getattr(before, name).isnan().all() and getattr(begun, name).isfinite().all()
    assert bool(before.coasting) and not bool(begun.coasting)
    assert [len(before), begun.first_frame] == [1, 1]
    for write in (before.save, before.export):
        with pytest.raises(InputError, match="frame 0 holds no pose, since tracking had not begun"):
            write(tmp_path / "before.trc")
    assert not [*tmp_path.iterdir()]


def test_who_is_never_seen_well_enough_is_nobody():
    given = scene(2, 10)
    given.keypoints[:, 0, 5:] = math.nan
    given.keypoints[:, 1] = math.nan
    with pytest.raises(NobodySeenError, match="two cameras"):
        kalman(given.rig)(keypoints=given.keypoints)


# --- one of several cameras -------------------------------------------------------------------------


def test_a_start_waits_for_a_second_camera(four):
    late = four.keypoints[:, :2].clone()
    late[:5, 1] = torch.nan
    found = kalman(four.rig.select([0, 1]))(keypoints=late)
    assert found.first_frame == 5 and not found.coasting.any()
    assert float(errors(found, four.joints[5:])[5:].mean()) < 0.025


def test_one_of_several_cameras_tracks_as_if_it_were_the_only_one():
    given = scene(3, 30, noise=2.0)
    given.keypoints[:, 1:] = torch.nan
    found = kalman(given.rig)(keypoints=given.keypoints)
    assert found.first_frame == 16  # half a second later
    one = kalman(given.rig.select([0]))(keypoints=given.keypoints[16:, :1])
    torch.testing.assert_close(found.joints3d, one.joints3d)
    assert any("one camera alone (c0)" in note for note in found.notes)
    ray = torch.nn.functional.normalize(found.joints3d[-1, 0] - _centre(given.rig, 0), dim=0)
    along, alone = (float(ray @ track.covariance3d[-1, 0] @ ray) for track in (found, one))
    assert (
        along == pytest.approx(alone, rel=0.01) and along > 0.2**2
    )  # it may be larger and farther


def test_a_second_camera_begins_anew_what_one_had_to_guess():
    given = scene(2, 30, noise=2.0, height=1.3)
    given.keypoints[:20, 1] = torch.nan
    found = kalman(given.rig)(keypoints=given.keypoints)
    assert found.first_frame == 16 and found.respread.nonzero().tolist() == [[4]]
    off = errors(found, given.joints[16:]).mean(-1)
    assert float(off[:4].min()) > 0.5 and float(off[4:].max()) < 0.05


def handed(first, second):
    """The keypoints of camera 0 in 20 frames, then those that camera 1 has of somebody."""
    keypoints = torch.full_like(first.keypoints, math.nan)
    keypoints[:20, 0], keypoints[20:, 1] = first.keypoints[:20, 0], second.keypoints[20:, 1]
    return keypoints


def test_one_camera_hands_a_person_to_the_next():
    """As in a corridor where no two cameras see the same place."""
    given = scene(2, 26, noise=2.0)
    found = kalman(given.rig)(keypoints=handed(given, given))
    assert found.first_frame == 16 and not found.coasting.any()
    assert found.respread.nonzero().tolist() == [[4]]
    assert float(errors(found, given.joints[16:]).mean(-1).max()) < 0.4


@pytest.mark.slow
def test_another_camera_that_sees_somebody_else_goes_on_after_half_a_second():
    given = scene(2, 40, noise=2.0)
    aside = given.joints + torch.tensor([1.5, 0.0, 0.0], dtype=torch.float64)
    other = given._replace(keypoints=given.rig(aside).pixels)
    found = kalman(given.rig)(keypoints=handed(given, other))
    assert found.respread.nonzero().tolist() == [[20]]
    assert found.coasting[4:20].all() and not found.coasting[20:].any()
    assert float(errors(found, aside[16:])[20:].mean()) < 0.4


def _centre(rig, camera):
    return -rig.rotation[camera].T @ rig.translation[camera]


# --- behind a desk ----------------------------------------------------------------------------------

HIPS = [J(name) for name in ("pelvis", "left_hip", "right_hip")]


def test_hips_that_no_camera_sees_go_along_with_who_walks():
    """As behind a counter: shoulders and arms alone are seen, and the neck is the middle of the shoulders."""
    given = scene(3, 34)
    way = torch.linspace(-0.7, 0.75, 34, dtype=torch.float64)
    joints = given.joints + torch.stack([way, 0 * way, 0.5 * way], -1)[:, None]
    keypoints = given.rig(joints).pixels
    shoulders = [J("left_shoulder"), J("right_shoulder")]
    keypoints[:, :, J("neck")] = keypoints[:, :, shoulders].mean(2)
    legs = [j for j, name in enumerate(NAMES) if name.endswith(("knee", "ankle"))]
    keypoints[:, :, HIPS + legs] = math.nan
    found = kalman(given.rig)(keypoints=keypoints)
    off = (found.joints3d - joints)[20:, HIPS]
    assert float(off[..., [0, 2]].norm(dim=-1).mean()) < 0.025  # across the room
    assert float(off.norm(dim=-1).mean()) < 0.07  # the trunk has the usual length


LEGS = [j for j, name in enumerate(NAMES) if name.endswith(("knee", "ankle"))]


def at_desk(keypoints):
    """Keypoints of the upper body alone, as of detectors that know no neck, and their names."""
    named = [j for j, name in enumerate(NAMES) if name not in ("pelvis", "neck")]
    hidden = keypoints.clone()
    hidden[:, :, HIPS + LEGS] = math.nan
    return hidden[:, :, named], [NAMES[j] for j in named]


def test_cameras_on_one_side_that_point_down_tell_which_way_is_up():
    rig = ring(2)
    up = level_cameras_up(rig).direction
    assert math.degrees(math.acos(float(up[1]))) < 1.0


def seated(joints):
    """The same upper bodies with thighs ahead and level, and shanks that hang."""
    up = torch.tensor([0.0, 1.0, 0.0], dtype=joints.dtype)
    joints = joints.clone()
    across = joints[:, J("left_hip")] - joints[:, J("right_hip")]
    ahead = torch.nn.functional.normalize(torch.linalg.cross(across, up.expand_as(across)), dim=-1)
    for side in ("left", "right"):
        hip, knee, ankle = (joints[:, J(f"{side}_{name}")] for name in ("hip", "knee", "ankle"))
        thigh, shank = ((a - b).norm(dim=-1, keepdim=True) for a, b in ((knee, hip), (ankle, knee)))
        joints[:, J(f"{side}_knee")] = hip + thigh * ahead
        joints[:, J(f"{side}_ankle")] = hip + thigh * ahead - shank * up
    return joints


def test_ellipsoids_hold_the_legs_of_who_sits_behind_a_desk():
    given = scene(2, 20)
    joints = seated(given.joints)
    keypoints, names = at_desk(given.rig(joints).pixels)
    found = kalman(given.rig)(keypoints=keypoints, names=names)
    off = (found.joints3d - joints)[10:, LEGS]
    squared = (off * torch.linalg.solve(found.covariance3d[10:, LEGS], off)).sum(-1)

    assert float(squared.max()) < 11.3  # 99 % in three dimensions


def test_legs_that_no_camera_ever_sees_hang_less_far_than_straight_ones():
    """So they are nearer to all the poses in which they may be."""
    given = scene(2, 30)
    keypoints, names = at_desk(given.rig(given.joints).pixels)
    found = kalman(given.rig)(keypoints=keypoints, names=names).joints3d[20:]
    hips, knees, ankles = (
        found[:, [J(f"{side}_{name}") for side in ("left", "right")]]
        for name in ("hip", "knee", "ankle")
    )
    length = (hips - knees).norm(dim=-1) + (knees - ankles).norm(dim=-1)
    assert 0.85 < float(((hips - ankles)[..., 1] / length).mean()) < 0.96


def test_legs_that_were_seen_to_sit_go_on_sitting_for_a_second():
    given = scene(2, 34)
    joints = seated(given.joints)
    keypoints = given.rig(joints).pixels
    keypoints[20:, :, HIPS + LEGS] = math.nan
    found = kalman(given.rig)(keypoints=keypoints).joints3d
    assert float((found - joints)[20:, LEGS].norm(dim=-1).mean()) < 0.2


# --- cameras that disagree --------------------------------------------------------------------------


def test_a_camera_that_sees_something_else_is_named(spoiled):
    notes = spoiled["aside"][1].notes
    assert any("camera c3" in note for note in notes)
    assert not any("camera c0" in note for note in notes)


def test_joints_that_no_camera_ever_sees_are_named():
    given = scene(2, 4)
    given.confidence[:, :, [J("left_knee"), J("left_ankle")]] = 0.0
    given.confidence[:, 0, J("right_knee")] = 0.0
    (note,) = track(given).notes
    assert note.startswith("no camera has a keypoint of left_knee, left_ankle in any frame")


def test_an_axis_that_points_down_in_all_images_is_said():
    given = scene(2, 4)
    assert track(given, up="y").notes == ()
    half_turn = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    over = copy.deepcopy(given.rig)
    over.rotation *= half_turn
    (note, *_) = track(given._replace(rig=over), up="y").notes
    assert note.startswith("the axis that was given as up points down in all images")


def test_a_person_of_no_persons_size_is_said():
    given = scene(2, 4, noise=0.0)
    small = copy.deepcopy(given.rig)
    small.translation *= 0.5
    assert any("a person of 0.8" in note for note in track(given._replace(rig=small)).notes)
    assert track(given).notes == ()


@pytest.mark.parametrize("told", [{"height": 2.1}, {"body": Body.of_height(BODY_15, 1.4)}])
def test_cameras_that_measure_another_size_than_was_given_say_so(told):
    given = scene(3, n_frames=20, height=1.7)
    (note,) = kalman(given.rig, **told)(keypoints=given.keypoints).notes
    size = "2.10" if "height" in told else "1.40"
    assert note.startswith(
        f"the person is {size} m tall by the given height or body, and by the cam"
    )
    near = {name: 1.75 if name == "height" else Body.of_height(BODY_15, 1.6) for name in told}
    assert kalman(given.rig, **near)(keypoints=given.keypoints).notes == ()


# --- forms ------------------------------------------------------------------------------------------


def test_a_camera_whose_video_stands_still_is_named():
    pixels = scene(3, n_frames=40).keypoints
    pixels[5:, 2] = pixels[5, 2]
    there = torch.ones(pixels.shape[:3], dtype=torch.bool)
    (note,) = notes_on_still_cameras(("a", "b", "c"), pixels, there, 10)
    assert note.startswith(
        "the keypoints of camera c are exactly the same in frames 15 to 49, which"
    )
    pixels[:, 2] = pixels[0, 2]
    (note,) = kalman(ring(3))(keypoints=pixels).notes
    assert "camera c2 are exactly the same in frames 0 to 39" in note
    everything = pixels[:1].expand_as(pixels)  # a person who does not move at all
    assert notes_on_still_cameras(("a", "b", "c"), everything, there) == ()


def test_frame_by_frame_gives_the_same(four, filtered):
    live = kalman(four.rig)
    state, poses = live.init(), []
    for keypoints, confidence in zip(four.keypoints[:12], four.confidence[:12], strict=True):
        state, pose = live.step(state, keypoints=keypoints, confidence=confidence)
        poses.append(pose.joints3d[0])
    torch.testing.assert_close(torch.stack(poses), filtered.joints3d[:12], rtol=0, atol=1e-12)


def test_a_batch_gives_each_its_own(spoiled, filtered):
    for name in ("joints3d", "covariance3d"):
        own = getattr(spoiled["none"][1], name)
        torch.testing.assert_close(own, getattr(filtered, name), rtol=0, atol=1e-9)
    other = spoiled["somebody else"][1].joints3d
    assert not torch.allclose(other, filtered.joints3d, rtol=0, atol=1e-3)


@pytest.mark.parametrize("smoothing", ["none", "full"])
@pytest.mark.parametrize("n_cameras", [1, 4])
def test_a_batch_of_different_lengths_gives_each_its_own(n_cameras, smoothing):
    given = scene(n_cameras, 7)
    keypoints, confidence = (
        given.keypoints.repeat(3, 1, 1, 1, 1),
        given.confidence.repeat(3, 1, 1, 1),
    )
    keypoints[1] += 1.5
    lengths = torch.tensor([3, 6, 5])
    close = (
        1e-9 if n_cameras > 1 else 1e-6
    )  # of one camera a network of single precision lifts poses
    follow = kalman(given.rig)
    tracks = follow(
        keypoints=keypoints, confidence=confidence, smoothing=smoothing, lengths=lengths
    )
    alone = [
        follow(keypoints=points[:n], confidence=trust[:n], smoothing=smoothing)
        for points, trust, n in zip(keypoints, confidence, lengths.tolist(), strict=True)
    ]
    cut = follow(
        keypoints=keypoints[0], confidence=confidence[0], smoothing=smoothing, lengths=lengths[:1]
    )
    for one, own, near in (*zip(tracks, alone, 3 * [close], strict=True), (cut, alone[0], 1e-9)):
        n = len(own)
        for name in ("joints3d", "covariance3d", "state", "coasting"):
            expected = getattr(own, name)
            torch.testing.assert_close(getattr(one, name)[:n], expected, rtol=0, atol=near)
        assert one.notes == own.notes and len(one) == 7
        assert (one.joints3d[n:] == one.joints3d[n - 1]).all()
        assert not one.log_evidence[n:].any()


def test_lengths_that_no_sequence_has_are_refused(four):
    for wrong in ([0], [T + 1], [3, 4]):
        with pytest.raises((InputError, ShapeError), match="lengths must"):
            kalman(four.rig)(keypoints=four.keypoints, lengths=torch.tensor(wrong))
    detections = four.keypoints[:, :, None]
    with pytest.raises(InputError, match="lengths does nothing with persons"):
        kalman(four.rig)(keypoints=detections, persons="all", lengths=torch.tensor([3]))


def test_a_joint_set_in_another_order_and_without_a_pelvis(four, filtered):
    order = [i for i in range(len(NAMES)) if NAMES[i] != "pelvis"][::-1]
    found = kalman(four.rig)(
        keypoints=four.keypoints[:16, :, order],
        confidence=four.confidence[:16, :, order],
        names=[NAMES[i] for i in order],
    )
    away = (found.joints3d - filtered.joints3d[:16]).norm(dim=-1)[10:]
    assert float(away[:, J("left_wrist")].max()) < 0.01


def test_a_face_tells_where_the_head_is():
    """COCO's joints have no head: without ears and nose the prior alone would say where it is."""
    given, names = scene(3, 20), [n for n in NAMES if n not in ("head", "neck", "pelvis")]
    joints = given.joints.clone()
    body = Body.of_height(BODY_15, 1.7)
    state = torch.zeros(len(joints), body.dim, dtype=torch.float64)
    state[:, 3 + 3 * BODY_15.parts.index("head")] = 0.35  # bent forward
    head = body.joints(state)[:, J("head")] - body.joints(state)[:, J("neck")]
    joints[:, J("head")] = joints[:, J("neck")] + head
    side = torch.nn.functional.normalize(
        joints[:, J("left_hip")] - joints[:, J("right_hip")], dim=-1
    )
    ears = [joints[:, J("head")] + sign * 0.075 * side for sign in (1, -1)]
    points = torch.stack([*(joints[:, J(n)] for n in names), *ears], 1)
    pixels = given.rig(points).pixels
    confidence = torch.ones_like(pixels[..., 0])
    pixels[:, 0, -1], confidence[:, 0, -1] = (
        0.0,
        0.0,
    )  # hidden from a camera: zeros, as detectors write

    def off(wanted: list[str]) -> float:
        columns = [[*names, "left_ear", "right_ear"].index(n) for n in wanted]
        found = kalman(given.rig)(
            keypoints=pixels[:, :, columns], confidence=confidence[:, :, columns], names=wanted
        )
        return float((found.joints3d - joints)[10:, J("head")].norm(dim=-1).mean())

    assert off([*names, "left_ear", "right_ear"]) < 0.04 < 0.06 < off(names)


def test_distorted_keypoints_are_undistorted(four):
    import cv2

    cameras = []
    for i in range(4):
        plain = ring(4)
        camera = PinholeCamera(
            1300, 1300, 959.5, 539.5, 1920, 1080, f"c{i}", distortions=(-0.2, 0.05, 0.0, 0.0),
            rotation=tuple(cv2.Rodrigues(plain.rotation[i].numpy())[0].ravel().tolist()),
            translation=tuple(plain.translation[i].tolist()),
        )  # fmt: skip
        cameras.append(camera)
    rig = CameraRig(cameras)
    seen = []
    for c, camera in enumerate(cameras):
        points = four.joints.reshape(-1, 1, 3).numpy()
        pixels, _ = cv2.projectPoints(
            points, cv2.Rodrigues(rig.rotation[c].numpy())[0], rig.translation[c].numpy(),
            camera.matrix.numpy(), camera.distortions.numpy(),
        )  # fmt: skip
        seen.append(torch.from_numpy(np.asarray(pixels)).reshape(*four.joints.shape[:2], 2))
    distorted = torch.stack(seen, 1)
    straight = rig.undistort_points(distorted)
    torch.testing.assert_close(straight, rig(four.joints).pixels, rtol=0, atol=0.01)
    found = kalman(rig)(keypoints=distorted[:16])
    assert float(errors(found, four.joints[:16])[10:].mean()) < 0.008


def test_tracks_are_saved_and_read_back(tmp_path, filtered):
    filtered.save(tmp_path / "body.npz")
    back = BodyTrack.load(tmp_path / "body.npz")
    assert back.method == "kalman"
    torch.testing.assert_close(back.details["inlier"], filtered.details["inlier"])
    torch.testing.assert_close(back.joints3d, filtered.joints3d)


def test_a_known_body_keeps_its_bones(four, filtered):
    body = Body.of_height(BODY_15, 1.7)
    found = kalman(four.rig, body=body)(keypoints=four.keypoints[:12])
    lengths = found.details["bone_lengths"][:, J("left_knee")]
    assert float((lengths / body.bone_lengths[J("left_knee")] - 1).abs().max()) < 0.02


# --- input that cannot be right -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"keypoints": torch.zeros(3, 2, 15, 2)}, ShapeError, "keypoints"),
        ({"keypoints": torch.full((3, 4, 15, 2), torch.nan)}, NobodySeenError, "no keypoint"),
        ({"keypoints": torch.zeros(0, 3, 4, 15, 2)}, InputError, "at least one sequence"),
        ({"names": ["nose"] * 15}, SkeletonError, "nose"),
        ({"confidence": torch.full((T, 4, 15), -1.0)}, InputError, "in \\[0, 1\\]"),
        ({"confidence": torch.full((T, 4, 15), math.inf)}, InputError, "got inf of camera '"),
        ({"confidence": torch.ones(T, 4, 3)}, ShapeError, "confidence"),
        ({"covariance": torch.zeros(T, 4, 15)}, InputError, "covariance"),
        ({"covariance": torch.full((T, 4, 15), math.inf)}, InputError, "got inf of camera '"),
        ({"covariance": torch.full((T, 4, 15), 1e-12)}, InputError, "between 1e-06 and 1e.12"),
        ({"smoothing": "some"}, InputError, "smoothing"),
        ({"keypoints": None}, InputError, "keypoints"),
    ],
)
def test_bad_input_is_refused(four, change, error, words):
    given = {"keypoints": four.keypoints, "confidence": None, **change}
    with pytest.raises(error, match=words):
        kalman(four.rig)(**given)


def test_keypoints_of_another_image_size_are_refused(four):
    with pytest.raises(CameraError, match="scaled"):
        kalman(four.rig)(keypoints=4 * four.keypoints)
    third = four.keypoints.clone()
    third[:, 2] *= 4
    with pytest.raises(CameraError, match=four.rig.names[2]):
        kalman(four.rig)(keypoints=third)
    few = third[:4].clone()
    few[:, 2, :8] = four.keypoints[:4, 2, :8]
    assert len(kalman(four.rig)(keypoints=few)) == len(few)


@pytest.mark.parametrize("persons", [None, "all"])
def test_a_live_frame_of_outliers_alone_is_no_error(persons):
    """In a stream that runs, one keypoint far outside an image may be all that a camera has."""
    two = scene(2, 12)
    live, keypoints = kalman(two.rig), two.keypoints.clone()
    keypoints[10] = torch.nan
    keypoints[10, 0, 3] = 6000.0
    frames, poses = keypoints if persons is None else keypoints[:, :, None], []
    state = live.init()
    for frame in frames:
        state, pose = live.step(state, keypoints=frame, persons=persons)
        poses.append(pose if persons is None else pose[:1])
    with pytest.raises(CameraError, match="lie outside its image of 1920 x 1080"):
        live.step(live.init(), keypoints=frames[10], persons=persons)
    if persons is None:
        assert bool(poses[10].coasting) and not bool(poses[11].coasting)
    last = poses[11] if persons is None else poses[11][0]
    assert errors(last, two.joints[11:]).mean() < 0.04


@pytest.mark.parametrize("n_cameras", [1, 2])
def test_a_keypoint_that_no_image_can_have_is_missing(n_cameras):
    """A detector may write numbers of memory that it has not filled."""
    seen = scene(n_cameras, 8)
    live, without, wild = kalman(seen.rig), seen.keypoints.clone(), seen.keypoints.clone()
    without[4, 0, 3], wild[4, 0, 3] = torch.nan, 1e300
    found, expected = (live(keypoints=one).joints3d for one in (wild, without))
    assert torch.equal(found, expected)


@pytest.mark.parametrize(("axis", "border"), [(0, 0.0), (0, 1919.0), (0, 1920.0), (1, 1080.0)])
def test_a_keypoint_on_the_border_of_the_image_is_missing(axis, border):
    names, keypoints = NAMES[1:], scene(2, 1).keypoints[:, :, 1:]  # the pelvis is between the hips
    hip = names.index("left_hip")
    reader = kalman(ring(2)).by_keypoints.reader
    keypoints[0, 0, hip, axis] = border  # as of a detector that clips what is beyond it
    there = reader.frames_and_feet(keypoints, None, names, None)[0].there
    assert (~there).nonzero().tolist() == [[0, 0, J("pelvis")], [0, 0, J("left_hip")]]
    keypoints[0, 0, hip, axis] = border - 2 if border else 1.0
    assert bool(reader.frames_and_feet(keypoints, None, names, None)[0].there.all())


@pytest.mark.parametrize("persons", [None, "all"])
def test_keypoints_of_larger_images_are_refused_by_a_single_camera(persons):
    given = scene(1, n_frames=12)
    given.keypoints[..., 0] += 300  # so that a part is to the right of the image of half the size
    alone = kalman(given.rig)
    keypoints = given.keypoints if persons is None else given.keypoints[:, :, None]
    doubled = 2 * keypoints
    with pytest.raises(CameraError, match="right of its image of 1920 x 1080 pixels or below"):
        alone(keypoints=doubled, persons=persons)
    assert alone.step(
        alone.init(), keypoints=doubled[0], persons=persons
    )  # one frame tells nothing
    cut = keypoints + keypoints.new_tensor([0.0, 700.0])  # all but the head is below the image
    assert alone(keypoints=cut, persons=persons)


def test_cameras_in_millimetres_are_refused():
    camera = PinholeCamera(1300, 1300, 959.5, 539.5, 1920, 1080, translation=(0, 0, 4000.0))
    with pytest.raises(CameraError, match="metres"):
        kalman(camera)


@pytest.mark.parametrize(
    "options",
    [
        {"n_layers": 3}, {"manifold": "walk"}, {"n_particles": 50}, {"keypoint_std": -1.0}, {"height": 0.0},
        {"pixel_std": 1e-6}, {"keypoint_std": "0.01"},
    ],
)  # fmt: skip
def test_options_of_other_methods_are_refused(options):
    with pytest.raises(InputError):
        kalman(ring(2), **options)


def test_other_methods_take_no_options_of_this_one(four):
    with pytest.raises(InputError, match="motion, up"):
        BodyTracker(four.rig, "apf", motion="whole-body", up="y")
    with pytest.raises(InputError, match="refine='both' needs method='kalman'"):
        BodyTracker(four.rig, "apf")(keypoints=four.keypoints, refine="both")
    with pytest.raises(InputError, match="persons needs method='kalman'"):
        BodyTracker(four.rig, "apf")(keypoints=four.keypoints, persons=2)


@pytest.mark.parametrize(
    ("method", "options", "said"),
    [
        ("kalman", {"body": 3}, "body must be a Body or the name of its file, got int"),
        ("kalman", {"motion": 3}, "motion must be a BodyMotion or the name"),
        (
            "sir",
            {"n_particles": 20.5},
            "n_particles must be a whole number and at least .* got 20.5",
        ),
    ],
)
def test_arguments_of_other_kinds_are_refused(method, options, said):
    with pytest.raises(InputError, match=said):
        BodyTracker(ring(2), method, **options)


def test_the_tracker_is_at_the_top():
    assert torchpose.BodyTracker is BodyTracker
    assert math.isclose(kalman(ring(2)).fps, FPS)


@pytest.mark.parametrize("nothing", [0.0, -1.0])
@pytest.mark.parametrize("cameras", [1, 3])
def test_what_detectors_write_where_they_found_nothing_is_missing(cameras, nothing):
    given = scene(cameras, 8)
    missing = torch.zeros(given.keypoints.shape[:-1], dtype=torch.bool)
    missing[:2], missing[:, 0, 3] = True, True
    filled, unknown = (
        given.keypoints.masked_fill(missing[..., None], value) for value in (nothing, math.nan)
    )
    found, wanted = (kalman(given.rig)(keypoints=values) for values in (filled, unknown))
    assert found.first_frame == wanted.first_frame == 2
    torch.testing.assert_close(found.joints3d, wanted.joints3d, rtol=0, atol=0)


@pytest.mark.parametrize("nothing", [math.nan, 0.0])
def test_the_covariance_of_a_missing_keypoint_does_not_matter(nothing):
    given = scene(2, 4)
    given.keypoints[:, 0, 7] = math.nan
    covariance = torch.full_like(given.confidence, 9.0)
    usual = kalman(given.rig)(keypoints=given.keypoints, covariance=covariance)
    covariance[:, 0, 7] = nothing
    found = kalman(given.rig)(keypoints=given.keypoints, covariance=covariance)
    torch.testing.assert_close(found.joints3d, usual.joints3d, rtol=0, atol=0)
    covariance[:, 0, 6] = nothing
    with pytest.raises(InputError, match="covariance"):
        kalman(given.rig)(keypoints=given.keypoints, covariance=covariance)


def test_arguments_of_other_methods_are_refused():
    given = scene(2, 2)
    tracker = kalman(given.rig)
    unused = {
        "generator": torch.Generator(), "initial_state": torch.zeros(36),
        "facing": torch.tensor([1.0, 0.0, 0.0]),
    }  # fmt: skip
    for name, value in {**unused, "n_frames": 2}.items():
        with pytest.raises(
            InputError, match=f"{name} does nothing for method kalman; leave it out"
        ):
            tracker(keypoints=given.keypoints, **{name: value})
    for name, value in unused.items():
        with pytest.raises(InputError, match=name):
            tracker.init(**{name: value})


def test_names_of_a_stream_hold_for_all_frames(four):
    order = torch.arange(15).flip(0)
    names = [NAMES[j] for j in order.tolist()]
    tracker = kalman(four.rig)
    given, stated = tracker.init(names=names), tracker.init()
    for t in range(4):
        frame = {"keypoints": four.keypoints[t][:, order], "confidence": four.confidence[t]}
        given, pose = tracker.step(given, **frame)
        stated, same = tracker.step(stated, **frame, names=names)
        torch.testing.assert_close(pose.joints3d, same.joints3d, rtol=0, atol=0)
    assert float((pose.joints3d[0] - four.joints[3]).norm(dim=-1).mean()) < 0.03
    other = BodyTracker(four.rig, "sir", height=1.7, n_particles=50)
    assert other.init(initial_state=torch.zeros(36).double(), names=names).names == tuple(names)


@pytest.mark.parametrize(
    ("changes", "error", "said"),
    [
        ({"keypoints": lambda k: k.numpy()}, InputError, "must be a tensor, got ndarray"),
        (
            {"keypoints": lambda k: k.to("meta")},
            InputError,
            "must hold numbers, got a tensor on the device meta",
        ),
        (
            {"keypoints": lambda k: k.to(torch.complex64)},
            InputError,
            "must be real, got torch.complex64",
        ),
        (
            {"confidence": lambda c: c.to_sparse()},
            InputError,
            "must be a dense tensor, got torch.sparse_coo",
        ),
        ({"confidence": lambda c: 100 * c}, InputError, "divide scores in percent by 100"),
        ({"confidence": lambda c: c.logit()}, InputError, "take the sigmoid of logits"),
        ({"keypoints": lambda k: k.repeat(1, 1, 2, 1)}, ShapeError, "BODY_15, whose names count"),
        ({"keypoints": lambda k: k / 2500}, InputError, "must be in pixels"),
    ],
)
def test_what_keypoints_are_is_said(four, changes, error, said):
    given = {"keypoints": four.keypoints, "confidence": four.confidence}
    given = {name: changes.get(name, lambda v: v)(value) for name, value in given.items()}
    with pytest.raises(error, match=said):
        kalman(four.rig)(**given)


def test_peaks_of_heat_maps_count_as_one(four):
    plain, peaks = (
        kalman(four.rig)(keypoints=four.keypoints[:4], confidence=torch.full((4, 4, 15), value))
        for value in (1.0, 1.02)
    )
    torch.testing.assert_close(peaks.joints3d, plain.joints3d, rtol=0, atol=0)


def test_confidences_of_another_scale_are_named(four):
    frames = four.keypoints[:4]
    said = [
        "confidence below 0.1" in " ".join(kalman(four.rig)(keypoints=frames, confidence=c).notes)
        for c in (0.03 * four.confidence[:4], 0.3 * four.confidence[:4], None)
    ]
    assert said == [True, False, False]


def test_single_precision_leaves_the_filter_double(four):
    plain = kalman(four.rig)(keypoints=four.keypoints[:4], confidence=four.confidence[:4])
    module = torch.nn.Sequential(kalman(four.rig)).float()
    same = module[0](keypoints=four.keypoints[:4], confidence=four.confidence[:4])
    torch.testing.assert_close(same.joints3d, plain.joints3d, rtol=0, atol=0)


def test_a_height_in_centimetres_and_no_state_are_refused(four):
    with pytest.raises(InputError, match=r"height must lie between 0\.5 and 2\.6 m, got 175"):
        kalman(four.rig, height=175)
    with pytest.raises(
        InputError, match="state must be a BodyStream, got NoneType; begin with init"
    ):
        kalman(four.rig).step(None, keypoints=four.keypoints[0])


@pytest.mark.parametrize("method", ["kalman", "sir"])
def test_a_height_beside_a_body_is_refused(four, method):
    body = Body.of_height(BODY_15, 1.9)
    with pytest.raises(InputError, match="height does nothing beside body"):
        BodyTracker(four.rig, method, body=body, height=1.6)


def test_states_of_a_tracker_with_other_options_are_refused(four):
    mine = kalman(four.rig)
    state, _ = mine.step(mine.init(), keypoints=four.keypoints[0])
    moved = copy.deepcopy(four.rig)
    moved.translation[1, 2] += 0.5
    others = {
        f"fps=15.0, got that of a tracker with fps={FPS:g}": BodyTracker(
            four.rig, "kalman", fps=15
        ),
        "with cameras='{} at [^']*{} at [^']* px', got .* cameras='.*'".format(
            *four.rig.names
        ): kalman(four.rig.select([0, 1])),
        "with cameras=.*got that of a tracker with cameras=": kalman(four.rig.select([1, 0, 2, 3])),
        f"{four.rig.names[1]} at .*got that of a tracker with cameras='": kalman(moved),
        "pixel_std=9, got that of a tracker with pixel_std=None": kalman(four.rig, pixel_std=9),
        "keypoint_std=0.1, got": kalman(four.rig, keypoint_std=0.1),
        "body='1.9000 m', got": kalman(four.rig, body=Body.of_height(BODY_15, 1.9)),
        "height=1.9, got that of a tracker with height=None": kalman(four.rig, height=1.9),
        "with method='sir', .*got .* method='kalman'": BodyTracker(four.rig, "sir", fps=FPS),
    }
    for message, other in others.items():
        seen = four.keypoints[1][: len(other.cameras)]
        with pytest.raises(InputError, match=f"{message}.*begin with init of this tracker"):
            other.step(state, keypoints=seen)
    kalman(four.rig).step(state, keypoints=four.keypoints[1])


def test_a_keypoint_that_is_of_no_ray_is_missing():
    camera = PinholeCamera(900, 900, 959.5, 539.5, 1920, 1080, distortions=(-0.35,))
    keypoints = torch.full((1, 1, 15, 2), 600.0).double()
    keypoints[0, 0, 3] = torch.tensor([1900.0, 1000.0])
    frame = kalman(camera).by_keypoints.reader.frames_and_feet(keypoints, None, None, None)[0]
    assert (frame.inlier[0, 0] > 0).tolist() == [j != 3 for j in range(15)]
    assert bool(frame.pixels.isfinite().all())
