"""The times of live frames beside the rate that their tracker is for."""

import math

import numpy as np
import pytest

from tests.video.test_detector import CAMERA, Performers
from torchpose import VideoTracker
from torchpose.video import VideoFrame
from torchpose.video._live_rate import LiveRate


def note_on(intervals, fps=30.0, missed=0):
    rate, now = LiveRate().after(5.0, 0, fps), 5.0
    for interval in intervals:
        now += interval
        rate = rate.after(now, missed, fps)
    return rate.note


@pytest.mark.parametrize(
    ("interval", "missed", "said"),
    [
        (1 / 30, 0, ""),
        (1 / 27, 0, ""),
        (1 / 12, 0, "frames come at 12 per second by their times, and the tracker is for 30"),
        (1 / 60, 0, "seem to move slower than they do; make the tracker with fps=60"),
        (1 / 12, 1, "at 24 per second"),
        (1 / 10, 2, ""),
    ],
)
def test_frames_tell_their_rate_by_their_times(interval, missed, said):
    note = note_on([interval] * 30, missed=missed)
    assert said in note and bool(note) == bool(said)
    assert not note_on([interval] * 29, missed=missed), "too few tell nothing"


def test_a_stall_a_pause_and_a_jittering_clock_are_no_other_rate():
    assert not note_on([1 / 30] * 20 + [0.9] + [1 / 30] * 20)
    assert not note_on([1 / 30] * 20 + [60.0] + [1 / 30] * 20)
    assert not note_on([0.005, 1 / 15 - 0.005] * 20)
    assert not note_on([0.0] * 40), "a clock that stands still tells nothing"
    rate = LiveRate()
    for time in (None, math.nan, "now"):
        rate = rate.after(time, 0, 30.0)
        assert rate == LiveRate()


def test_steps_note_that_the_times_of_frames_are_not_those_of_the_tracker(prior):
    """People seem to move at two and a half times their speed."""
    detector = Performers(0.0)
    tracker = VideoTracker(prior, CAMERA, detector=detector, method="mkf-fixed")
    state, image = tracker.init(), np.full((480, 640, 3), 90, np.uint8)
    for t in range(32):
        assert state.notes == ()
        state, people = tracker.step(state, VideoFrame(image, t / 12, t) if t else image)
    (note,) = state.notes
    assert "frames come at 12 per second" in note and note in people[0].pose.notes
