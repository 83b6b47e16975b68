"""Walkers pass each other, a peer groups their detections, and measures have known values."""

import math

import pytest
import torch

from benchmarks.keypoint_bodies.clips import CLEAN
from benchmarks.keypoint_people.clips import let_pass
from benchmarks.keypoint_people.grouping import filled, grouped, join_frames, ray_distances
from benchmarks.keypoint_people.methods import METHODS, alone, together
from benchmarks.keypoint_people.scoring import Found, score_people
from torchpose.demo._rendering.walk import walk, walk_clip

FRAMES = 16


@pytest.fixture(scope="module")
def passing():
    """Two persons without faults of a detector, and with these."""
    clip = walk_clip(walk(seconds=2.0))
    middle = len(clip) // 2
    starts = (middle - FRAMES // 2, middle - FRAMES)
    both = [clip.cut(start, start + FRAMES) for start in starts]
    return let_pass(both, faults=CLEAN), let_pass(both)


def test_walkers_pass_within_half_a_metre(passing):
    clip, faulty = passing
    assert clip.joints.shape == (FRAMES, 2, 15, 3)
    apart = (clip.joints[:, 0, 0] - clip.joints[:, 1, 0]).norm(dim=-1)
    assert 0.2 < float(apart.min()) < 0.7
    assert bool((clip.place >= 0).all())
    assert not bool((faulty.keypoints.isfinite()).all())


def test_each_person_has_the_own_keypoints(passing):
    clip = passing[0]
    for person in range(2):
        keypoints, confidence = clip.of_person(person)
        torch.testing.assert_close(keypoints, clip.rig(clip.joints[:, person]).pixels)
        assert bool((confidence > 0).all())
    assert len(clip.place.unique(dim=0)) > 1  # the order changes


def test_rays_of_one_person_meet(passing):
    clip = passing[0]
    distance = ray_distances(clip.rig, clip.keypoints[0], clip.confidence[0])
    place = clip.place[0]
    own = [float(distance[0, place[0, p], 1, place[1, p]]) for p in range(2)]
    other = [float(distance[0, place[0, p], 1, place[1, 1 - p]]) for p in range(2)]
    assert max(own) < 1e-6 < min(other)


def test_grouped_detections_are_the_persons(passing):
    clip, faulty = passing
    score = score_people(grouped(clip), clip.joints)
    assert score.error < 1e-3 and score.tracked == 100.0
    assert (score.switches, score.false) == (0, 0.0)
    gaps = grouped(faulty)
    assert any(bool(one.joints.isnan().any()) for one in gaps)
    whole = filled(gaps, faulty.fps)
    assert all(bool(one.joints.isfinite().all()) for one in whole)
    score = score_people(whole, faulty.joints)
    assert score.error < 40 and score.tracked >= score_people(gaps, faulty.joints).tracked


def test_bodies_are_joined_by_their_distance(passing):
    joints = passing[0].joints
    frames = [frame.flip(0) if t % 2 else frame for t, frame in enumerate(joints)]
    found = join_frames(frames, 60.0)
    assert [len(one.joints) for one in found] == [FRAMES, FRAMES]
    for one, person in zip(found, joints.unbind(1), strict=True):
        torch.testing.assert_close(one.joints, person)
    assert join_frames(frames[:5], 60.0) == []  # too short


def test_measures_have_known_values(passing):
    truth = passing[0].joints
    first, second = truth.unbind(1)
    off = torch.tensor([0.03, 0.0, 0.04], dtype=torch.float64)
    score = score_people([Found(0, first + off), Found(0, second)], truth)
    assert score.error == pytest.approx(25.0)
    assert (score.switches, score.tracked, score.false) == (0, 100.0, 0.0)
    half = FRAMES // 2
    parts = [Found(0, first[:half]), Found(half, first[half:]), Found(0, second + 9)]
    broken = score_people(parts, truth)
    assert (broken.switches, broken.tracked, broken.false) == (1, 50.0, 50.0)
    assert math.isnan(score_people([], truth).error)


@pytest.mark.slow
def test_the_tracker_alone_and_together(passing):
    clip = passing[1].of_cameras(3)
    clip = clip._replace(
        joints=clip.joints[:8], keypoints=clip.keypoints[:8], confidence=clip.confidence[:8],
        place=clip.place[:8],
    )  # fmt: skip
    for way in (together, alone):
        score = score_people(way(clip, "none"), clip.joints)
        assert score.error < 40 and score.switches == 0
    assert {"grouped", "torchpose", "alone, known"} <= METHODS.keys()
