"""Persons of a recording: who comes, goes and returns, from scripted measurements."""

import functools
import weakref

import pytest
import torch

from torchpose.demo import KEYPOINT_NAMES, demo_camera, noisy_keypoints, performer
from torchpose.measure._hand_likelihood import without_elbows
from torchpose.measure._upper_body_measurer import MEASURED, FrameMeasurements, rounded_covariance
from torchpose.upper_body import UpperBodyTracker
from torchpose.video._person_stream import PersonStream
from torchpose.video._recording import TrackedRecording

FIELDS = ("joints2d", "joints3d", "covariance3d")
GAP = 8


@pytest.fixture(scope="module")
def tracker(prior):
    return UpperBodyTracker(prior, demo_camera(), fps=30.0, max_gap=None)


@pytest.fixture(scope="module")
def quick_tracker(prior):
    """Of one of the two methods that the other one averages."""
    return UpperBodyTracker(prior, demo_camera(), "window-mixture", fps=30.0, max_gap=None)


@pytest.fixture(scope="module")
def keypoints():
    order = [KEYPOINT_NAMES.index(name) for name in MEASURED]
    return noisy_keypoints(performer(120).joints, std_px=2.0)[:, order]


@pytest.fixture(scope="module")
def tracked_alone(keypoints):
    """What a tracker says of some frames by themselves: tracked_alone(tracker, first, last)."""

    @functools.cache
    def track(tracker, first, last):
        cov = COV.double().expand(1, last - first, -1, -1, -1)
        return tracker(keypoints[None, first:last], names=MEASURED, covariance=cov)

    return track


COV = torch.full((4,), 9.0, dtype=torch.float64)[:, None, None] * torch.eye(2)


def frames(keypoints, present):
    """Measurements of each frame; `present` [T] holds the numbers of who is there."""
    found = []
    for t, numbers in enumerate(present):
        person = torch.tensor(numbers, dtype=torch.long)
        points = keypoints[t].expand(len(numbers), -1, -1) + 5.0 * person[:, None, None]
        nothing = without_elbows(
            points[:, 2:],
            COV[:2].expand(len(numbers), -1, -1, -1),
            torch.ones(len(numbers), 2),
            torch.ones(len(numbers), 2, dtype=torch.bool),
        )
        cov = COV.double().expand(len(numbers), -1, -1, -1)
        found.append(FrameMeasurements(person, points, cov, torch.zeros(len(numbers), 3), nothing))
    return found


def test_absent_hands_reach_the_tracker(tracker, keypoints):
    """Of a person whose right hand is missing throughout, and cannot be seen."""
    points = keypoints.clone()
    points[:, MEASURED.index("hand_right")] = torch.nan
    gone = torch.tensor([[0.01, 0.99]])
    found = [
        frame._replace(hands=frame.hands._replace(absent=gone))
        for frame in frames(points, [[0]] * 20)
    ]
    (person,) = record(tracker, found, 8)
    absent = torch.full((1, 20, len(MEASURED)), torch.nan, dtype=torch.float64)
    absent[..., 2:] = gone
    torch.testing.assert_close(person.absent, absent[0], equal_nan=True)
    cov = COV.double().expand(1, 20, -1, -1, -1)
    told = tracker(points[None, :20], names=MEASURED, covariance=cov, absent=absent)
    for name in FIELDS:
        torch.testing.assert_close(
            getattr(person.track, name), getattr(told, name), rtol=1e-9, atol=1e-9
        )
    plain = tracker(points[None, :20], names=MEASURED, covariance=cov)
    assert not torch.allclose(plain.joints3d, told.joints3d)


def record(tracker, found, size, smoother=None):
    stream, states = PersonStream(tracker, MEASURED), {}
    kept = TrackedRecording(tracker, MEASURED, GAP)
    for start in range(0, len(found), size):
        block = found[start : start + size]
        states, tracked = stream.advance_all(states, block, (), GAP)
        kept.append(tracked, len(block))
    return kept.finish(smoother)


@pytest.mark.slow
@pytest.mark.parametrize("size", [1, 7, 32, 64])
def test_one_person_is_tracked_as_from_keypoints(tracker, keypoints, tracked_alone, size):
    found = frames(keypoints, [[0]] * 40)
    (person,) = record(tracker, found, size)
    assert (person.number, person.first_frame, len(person)) == (0, 0, 40)
    whole = tracked_alone(tracker, 0, 40)
    for name in FIELDS:
        torch.testing.assert_close(
            getattr(person.track, name), getattr(whole, name), rtol=1e-9, atol=1e-9
        )


@pytest.mark.parametrize("size", [1, 9, 32])
@pytest.mark.parametrize("n_before", [10, 25])
def test_poses_end_when_somebody_is_away_for_too_long_and_begin_anew(
    quick_tracker, keypoints, tracked_alone, n_before, size
):
    """With 10 frames before, somebody is away for too long and returns within one block of 32."""
    present = [[]] * 5 + [[0]] * n_before + [[]] * 15 + [[0]] * 12 + [[]] * 14
    (person,) = record(quick_tracker, frames(keypoints, present), size)
    back = n_before + 15
    assert (person.first_frame, len(person)) == (5, back + 12)
    there = person.track.joints3d[0].isfinite().all(-1).all(-1)
    assert torch.nonzero(~there).flatten().tolist() == list(range(n_before + GAP, back))
    observed = person.track.observed[0]
    assert not observed[n_before:back].any() and observed[back:, 3:5].all()
    anew = tracked_alone(quick_tracker, 5 + back, 17 + back)
    torch.testing.assert_close(
        person.track.joints3d[0, back:], anew.joints3d[0], rtol=1e-9, atol=1e-9
    )
    assert person.track.failed_at.tolist() == [-1]


def test_single_frames_of_a_camera_are_kept_in_few_tensors(quick_tracker, keypoints):
    """One of a frame takes kilobytes, which were some 500 MB in an hour."""
    stream, there = PersonStream(quick_tracker, MEASURED), []
    (block,) = stream.advance_all({}, frames(keypoints[:1], [[0]]), (), GAP)[1][0]
    kept = TrackedRecording(quick_tracker, MEASURED, GAP)
    for t in range(100):
        measured = block.measured._replace(keypoints=keypoints[None, t].clone())
        there.append(weakref.ref(measured.keypoints))
        kept.append({0: [block._replace(measured=measured)]}, 1)
        del measured
    assert sum(one() is not None for one in there) < 32
    (person,) = kept.finish()
    expected = keypoints[:100]
    torch.testing.assert_close(person.keypoints, expected, rtol=0, atol=0, equal_nan=True)


@pytest.fixture(scope="module")
def two_persons(keypoints):
    """Frames of two persons, one of whom leaves for too long twice, once within a block."""
    present = [[]] * 5 + [[0]] * 10 + [[1]] * 14 + [[0, 1]] * 11 + [[1]] * 12 + [[0]] * 9
    return frames(keypoints, present)


@pytest.fixture(scope="module")
def one_by_one(tracker, two_persons):
    """Their poses, frame by frame."""
    return record(tracker, two_persons, 1)


@pytest.mark.slow
@pytest.mark.parametrize("size", [9, 32, 64])
def test_blocks_give_what_single_frames_give(tracker, two_persons, one_by_one, size):
    blocks = record(tracker, two_persons, size)
    assert [p.number for p in blocks] == [p.number for p in one_by_one] == [1, 0]
    for alone, together in zip(one_by_one, blocks, strict=True):
        for name in (*FIELDS, "observed", "log_evidence", "failed_at"):
            torch.testing.assert_close(
                getattr(together.track, name), getattr(alone.track, name),
                rtol=1e-9, atol=1e-9, equal_nan=True,
            )  # fmt: skip
        torch.testing.assert_close(together.keypoints, alone.keypoints, equal_nan=True)


def test_persons_do_not_mix_and_the_one_seen_longest_is_first(tracker, keypoints):
    present = [[0, 1]] * 15 + [[1, 2]] * 8 + [[1]] * 10
    people = record(tracker, frames(keypoints, present), 16)
    assert [(p.number, p.first_frame, len(p)) for p in people] == [(1, 0, 33), (0, 0, 15)]
    alone = record(tracker, frames(keypoints, [[1]] * 33), 16)[0]
    torch.testing.assert_close(people[0].track.joints3d, alone.track.joints3d)
    assert torch.equal(people[0].keypoints, alone.keypoints)


def test_smoothed_poses_respect_long_gaps_too(tracker, keypoints):
    present = [[0]] * 10 + [[]] * 15 + [[0]] * 10
    smoother = UpperBodyTracker(
        tracker.prior, demo_camera(), fps=30.0, max_gap=None, smoothing="full"
    )
    (person,) = record(tracker, frames(keypoints, present), 32, smoother)
    there = person.track.joints3d[0].isfinite().all(-1).all(-1)
    assert torch.nonzero(~there).flatten().tolist() == list(range(10 + GAP, 25))
    (filtered,) = record(tracker, frames(keypoints, present), 32)
    assert not torch.allclose(person.track.joints3d[0, :10], filtered.track.joints3d[0, :10])


def test_covariances_are_rounded_to_few_levels_of_the_same_size():
    std = torch.linspace(1, 40, 400, dtype=torch.float64)
    rounded = rounded_covariance(std.square()[:, None, None] * torch.eye(2))
    ratio = rounded[:, 0, 0].sqrt() / std
    assert ratio.min() > 2**-0.26 and ratio.max() < 2**0.26
    assert len(rounded[:, 0, 0].unique()) <= 12 and bool((rounded[:, 0, 1] == 0).all())
