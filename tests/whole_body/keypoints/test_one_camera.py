"""One camera does not tell how large and how far a person is, which covariances say, and its height does."""

import math
import re

import pytest
import torch

import torchpose
from tests.whole_body.keypoints.scenes import FPS, Scene, kalman, moving_body, ring, scene, track
from torchpose.body import BODY_15, Body
from torchpose.errors import InputError
from torchpose.priors._shipped import load_body_motion
from torchpose.whole_body._keypoints.body_kalman import BodyKalmanFilter
from torchpose.whole_body._keypoints.body_size import (
    _ANKLE,
    _LASTING,
    Floor,
    SizeBelief,
    resized,
    tangent_of_size,
    told_by_floor,
    units_of_size,
)
from torchpose.whole_body._keypoints.keypoint_start import _begun
from torchpose.whole_body._keypoints.only_camera import until_seen

FLOOR = Floor(torch.tensor([0.0, 1.0, 0.0]).double(), torch.tensor([0.0, 1.5, 0.0]).double(), 1.5)
STD = 0.07
ANKLES = [BODY_15.joint("left_ankle"), BODY_15.joint("right_ankle")]
PELVIS = BODY_15.joint("pelvis")
LEGS = [BODY_15.joint(f"{side}_{name}") for side in ("left", "right") for name in ("knee", "ankle")]
HIPS = [PELVIS, BODY_15.joint("left_hip"), BODY_15.joint("right_hip")]


def ankles_at(heights, size=1.0):
    """Ankles [B, 2, 3] of the filter's size, of larger persons, with ankles at heights above the floor."""
    real = torch.zeros(*heights.shape, 3, dtype=torch.float64)
    real[..., 1], real[..., 2] = heights, 4.0
    return FLOOR.centre + (real - FLOOR.centre) / size


def told(heights, size=1.0, frames=300, trust=1.0):
    found = SizeBelief.usual(STD, torch.zeros(len(heights), dtype=torch.float64))
    seen = torch.full(heights.shape, trust, dtype=torch.float64)
    for _ in range(frames):
        found = told_by_floor(found, FLOOR, ankles_at(heights, size), seen, 30.0)
    return found


def standing(count=1):
    return torch.full((count, 2), _ANKLE, dtype=torch.float64)


@pytest.mark.parametrize("size", [0.9, 1.1])
def test_feet_on_the_floor_tell_the_size(size):
    assert float(told(standing(), size).log) == pytest.approx(math.log(size), abs=0.03)


def test_many_frames_do_not_make_the_size_certain():
    """The height that is given, and that of the ankle, are wrong by the same in all frames."""
    found = told(standing(), frames=3000)
    assert float(found.variance.sqrt()) > 0.8 * _LASTING / (1.5 - _ANKLE)
    assert float(found.variance.sqrt()) < 0.5 * STD


def test_lifted_and_hidden_feet_tell_nothing():
    lifted = told(standing() + 0.4)
    assert abs(float(lifted.log)) < 0.02
    hidden = told(standing(), size=1.1, trust=0.0)
    assert float(hidden.log) == 0 and float(hidden.variance) == pytest.approx(STD**2)
    one_foot = standing()
    one_foot[:, 1] += 0.5  # the lower one decides
    assert float(told(one_foot, 1.1).log) == pytest.approx(math.log(1.1), abs=0.03)


def test_a_camera_beside_the_feet_tells_no_size():
    low = FLOOR._replace(centre=torch.tensor([0.0, _ANKLE, 0.0]).double(), height=_ANKLE)
    found = SizeBelief.usual(STD, torch.zeros(1, dtype=torch.float64))
    for _ in range(100):
        found = told_by_floor(found, low, ankles_at(standing()), torch.ones(1, 2).double(), 30.0)
    assert float(found.variance) == pytest.approx(STD**2)


def test_a_larger_body_looks_the_same_and_its_tangent_is_that_of_finite_steps():
    rig, motion = ring(1), load_body_motion("whole-body")
    body = motion.articulation
    filter = BodyKalmanFilter(motion, rig, FPS)
    joints = moving_body(1)
    point = _begun(filter, joints, torch.ones_like(joints[..., 0], dtype=torch.bool), 1).mean
    point = point._replace(velocity=torch.randn_like(point.velocity), shifts=point.shifts + 0.01)
    centre = -(rig.rotation[0].mT @ rig.translation[0])
    log_size = torch.tensor([0.1], dtype=torch.float64)
    larger = resized(point, log_size, centre)
    expected = centre + math.exp(0.1) * (body.joints(point) - centre)
    torch.testing.assert_close(body.joints(larger), expected)
    torch.testing.assert_close(rig(body.joints(larger)).pixels, rig(body.joints(point)).pixels)
    step = 1e-6
    found = body.difference(resized(point, torch.full_like(log_size, step), centre), point) / step
    torch.testing.assert_close(tangent_of_size(body, point, centre), found, atol=1e-4, rtol=1e-4)
    small = 1e-6 * torch.randn(1, body.dim, dtype=torch.float64)
    moved = body.difference(resized(body.moved(point, small), log_size, centre), larger)
    torch.testing.assert_close(units_of_size(body, log_size) * small, moved, atol=1e-9, rtol=1e-4)


def ray_of(given, track):
    centre = -(given.rig.rotation[0].mT @ given.rig.translation[0])
    return track.joints3d[-1, PELVIS] - centre


@pytest.mark.slow
@pytest.mark.parametrize("smoothing", ["none", "full"])
def test_covariances_of_one_camera_do_not_know_the_distance(smoothing):
    given = scene(1, 25)
    found, sized = track(given, smoothing), track(given, smoothing, height=1.7)

    def along(poses):
        away = ray_of(given, poses)
        ray = away / away.norm()
        return float((ray @ poses.covariance3d[-1, PELVIS] @ ray).sqrt() / away.norm())

    assert 0.073 < along(found) < 0.08
    assert 0.028 < along(sized) < 0.04
    relative = found.details["covariance_from_pelvis"]
    assert relative.shape == (25, 15, 3, 3) and not relative[:, PELVIS].any()
    others = [j for j in range(15) if j != PELVIS]
    assert bool((torch.linalg.eigvalsh(relative[:, others]) > 0).all())
    leg = found.joints3d[-1, ANKLES[0]] - found.joints3d[-1, PELVIS]
    unit = leg / leg.norm()
    assert float((unit @ relative[-1, ANKLES[0]] @ unit).sqrt()) > 0.073 * float(leg.norm())


def seated(n_frames):
    """Somebody who sits still, [T, 15, 3]: thighs lie, shanks hang."""
    body, right_angle = Body.of_height(BODY_15, 1.7), math.sqrt(0.5)  # of a quaternion's vector
    state = torch.zeros(n_frames, body.dim, dtype=torch.float64)
    for side in ("left", "right"):
        state[:, 3 + 3 * BODY_15.parts.index(f"{side}_thigh")] = -right_angle
        state[:, 3 + 3 * BODY_15.parts.index(f"{side}_shank")] = right_angle
        state[:, 3 + 3 * BODY_15.parts.index(f"{side}_forearm")] = -0.6
    return body.joints(state)


def hidden(given, joints, frames=slice(None)):
    """The scene without keypoints of some joints."""
    keypoints, confidence = given.keypoints.clone(), given.confidence.clone()
    keypoints[frames, :, joints], confidence[frames, :, joints] = math.nan, 0.0
    return given._replace(keypoints=keypoints, confidence=confidence)


def squares_from_pelvis(given, track):
    """Squares of Mahalanobis distances of joints relative to the pelvis, [T, 15], 0 that of the pelvis."""
    error = track.joints3d - given.joints
    error = error - error[:, [PELVIS]]
    covariance = track.details["covariance_from_pelvis"] + 1e-9 * torch.eye(3)
    return (error * torch.linalg.solve(covariance, error[..., None])[..., 0]).sum(-1)


@pytest.mark.parametrize("smoothing", ["none", "full"])
def test_ellipsoids_of_legs_behind_a_desk_hold_somebody_who_sits(smoothing):
    joints, rig = seated(20), ring(1)
    whole = Scene(joints, rig, rig(joints).pixels, torch.ones(20, 1, 15, dtype=torch.float64))
    given = hidden(whole, [*HIPS, *LEGS])
    found = track(given, smoothing, height=1.7)
    off = (found.joints3d - joints)[:, LEGS].norm(dim=-1)
    assert float(off.max()) > 0.2  # guessed, as those of somebody who stands
    assert float(squares_from_pelvis(given, found)[:, LEGS].mean()) < 11.3  # 99 %


@pytest.mark.parametrize("smoothing", ["none", "full"])
def test_covariances_of_legs_grow_while_they_are_hidden(smoothing):
    given = hidden(scene(1, 25), LEGS, slice(5, 20))
    found = track(given, smoothing)
    ankle = found.details["covariance_from_pelvis"][:, ANKLES[0]].diagonal(dim1=-2, dim2=-1)
    std = ankle.sum(-1).sqrt()
    last = {"none": 19, "full": 12}[smoothing]  # smoothed, legs that will be seen are known too
    assert float(std[last]) > 1.8 * float(std[4])
    assert float(std[20]) < 1.2 * float(std[4])  # a keypoint is enough


def test_until_seen_counts_the_frames_to_the_next_keypoint():
    unseen = torch.tensor([torch.inf, 0.0, 0.1, 0.2, 0.0, 0.1])
    expected = torch.tensor([1.0, 0.0, 2.0, 1.0, 0.0, torch.inf])
    torch.testing.assert_close(until_seen(unseen[None, :, None])[0, :, 0], expected)


def test_several_cameras_say_nothing_of_the_pelvis():
    assert "covariance_from_pelvis" not in track(scene(2, 3)).details


@pytest.mark.slow
@pytest.mark.parametrize("height", [1.5, 1.9])
def test_a_camera_of_known_height_finds_how_large_a_person_is(height):
    given = scene(1, 30, height=height)
    floor = float(given.joints[..., 1].min()) - _ANKLE
    centre = -(given.rig.rotation[0].mT @ given.rig.translation[0])
    known = {"up": "y", "camera_height": float(centre[1]) - floor}
    without, found = track(given, "full", up="y"), track(given, "full", **known)

    def off(poses):
        return float((poses.joints3d - given.joints)[:, PELVIS].norm(dim=-1).mean())

    assert off(found) < 0.5 * off(without)
    assert abs(found.body.height / height - 1) < abs(without.body.height / height - 1)
    assert not any("size of a person" in note for note in found.notes)
    away = ray_of(given, found)
    wide, narrow = (float((away @ t.covariance3d[-1, 0] @ away).sqrt()) for t in (without, found))
    assert narrow < 0.6 * wide


@pytest.mark.parametrize(
    ("error", "said"),
    [(0.0, None), (-1.2, "feet are 1.* m below the floor"), (1.2, "m above the floor")],
)
def test_a_height_of_the_camera_that_fits_no_person_is_said(error, said):
    """It is in the axes of a wrong rotation, or the person stands elsewhere; the size is then a guess."""
    given = scene(1, 20)
    floor = float(given.joints[..., 1].min()) - _ANKLE
    centre = -(given.rig.rotation[0].mT @ given.rig.translation[0])
    height = float(centre[1]) - floor + error
    notes = " ".join(track(given, up="y", camera_height=height).notes)
    assert "camera_height" not in notes if said is None else re.search(said, notes)
    legs = hidden(given, LEGS, slice(0, 20))
    notes = " ".join(track(legs, up="y", camera_height=height).notes)
    assert "no foot was seen, so camera_height told nothing" in notes


def test_live_steps_find_the_size_of_whole_sequences():
    given = hidden(scene(1, 12), LEGS, slice(4, 12))
    tracker = kalman(given.rig, up="y", camera_height=1.9)
    whole = tracker(keypoints=given.keypoints)
    stream = tracker.init()
    for t in range(12):
        stream, pose = tracker.step(stream, keypoints=given.keypoints[t])
    torch.testing.assert_close(pose.joints3d[0], whole.joints3d[-1])
    torch.testing.assert_close(pose.covariance3d[0], whole.covariance3d[-1])
    torch.testing.assert_close(
        pose.details["covariance_from_pelvis"][0], whole.details["covariance_from_pelvis"][-1]
    )


def test_heights_of_cameras_that_tell_nothing_are_refused():
    with pytest.raises(InputError, match="2 cameras, which tell it themselves"):
        torchpose.BodyTracker(ring(2), "kalman", up="y", camera_height=1.5)
    with pytest.raises(InputError, match="the vertical, which is not known; give up"):
        torchpose.BodyTracker(ring(1), "kalman", camera_height=1.5)
    for height in (0.0, -1.0, 110.0, math.nan, "high"):
        with pytest.raises(InputError, match="between 0 and 30 m"):
            torchpose.BodyTracker(ring(1), "kalman", up="y", camera_height=height)
    with pytest.raises(InputError, match="camera_height does nothing"):
        torchpose.BodyTracker(ring(1), "apf", camera_height=1.5)
