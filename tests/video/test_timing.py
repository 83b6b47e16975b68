"""The way to a constant rate, against the nearest frame found by trying all of them."""

import numpy as np
import pytest

from torchpose.errors import InputError
from torchpose.video._timing import Rate, Tally, frame_rate, shown_for, to_constant_rate


def resample(times, fps, snap=False):
    tally = Tally()
    shown = list(to_constant_rate(((t, i) for i, t in enumerate(times)), fps, tally, snap))
    return shown, tally


@pytest.mark.parametrize("seed", range(20))
def test_every_instant_shows_the_nearest_frame(seed):
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.exponential(1.0, 40)) + rng.uniform(0, 100)
    fps = float(rng.uniform(0.3, 3))
    shown, tally = resample(times.tolist(), fps)
    grid = times[0] + np.arange(len(shown)) / fps
    distance = np.abs(times[None, :] - grid[:, None])
    best = distance.min(1)
    np.testing.assert_allclose(distance[np.arange(len(shown)), shown], best, atol=1e-9)
    assert abs(grid[-1] - times[-1]) <= 0.5 / fps + 1e-9  # up to the last frame, and no further
    assert shown == sorted(shown)
    assert len(shown) == len(times) + tally.repeated - tally.dropped
    assert tally.dropped == len(times) - len(set(shown))


def test_jitter_at_a_constant_rate_changes_nothing():
    rng = np.random.default_rng(1)
    times = np.arange(500) / 30 + rng.uniform(-0.4, 0.4, 500) / 30
    shown, tally = resample(times.tolist(), 30.0, snap=True)
    assert shown == list(range(500))
    assert tally == Tally()


def test_lost_frames_are_filled_from_both_sides():
    places = [0, 1, 2, 7, 8, 9]
    shown, tally = resample([p / 30 for p in places], 30.0, snap=True)
    assert shown == [0, 1, 2, 2, 2, 3, 3, 3, 4, 5]
    assert tally == Tally(repeated=4)


def test_missing_times_follow_on():
    shown, tally = resample([None] * 7, 25.0, snap=True)
    assert shown == list(range(7))
    assert tally == Tally()


def test_a_time_that_does_not_advance_is_late_and_dropped():
    times = [0, 1, 2, 2, 3, 4]
    shown, tally = resample([t / 10 for t in times], 10.0, snap=True)
    assert shown == [0, 1, 2, 4, 5]
    assert tally.late == 1
    assert tally.dropped == 1


@pytest.mark.parametrize("jump", [-50.0, 3600.0])
def test_a_clock_that_jumps_is_a_cut(jump):
    times = [i / 30 + (jump if i >= 20 else 0.0) for i in range(40)]
    shown, tally = resample(times, 30.0, snap=True)
    assert shown == list(range(40))
    assert tally == Tally(restarts=1)


def test_a_still_picture_of_some_seconds_stays():
    shown, tally = resample([0.0, 0.1, 5.1, 5.2], 10.0, snap=True)
    assert len(shown) == 53
    assert tally == Tally(repeated=49)


def test_a_slow_series_is_not_full_of_cuts():
    shown, tally = resample([0.0, 15.0, 30.0], 1 / 15, snap=True)
    assert shown == [0, 1, 2]
    assert tally == Tally()


def test_nothing_and_one_frame():
    assert resample([], 30.0) == ([], Tally())
    assert resample([7.0], 30.0) == ([0], Tally())


@pytest.mark.parametrize("fps", [24000 / 1001, 25, 30, 60])
def test_rates_survive_times_in_milliseconds(fps):
    times = np.round(np.arange(200) / fps, 3)
    rate = frame_rate(times.tolist(), declared=fps)
    assert rate == Rate(fps, True)
    alone = frame_rate(times.tolist())
    assert alone is not None
    assert alone.fps == pytest.approx(fps, rel=1e-3)


def test_order_of_decoding_does_not_matter():
    times = [0.0, 0.4, 0.1, 0.2, 0.3, 0.7, 0.5, 0.6]
    rate = frame_rate(times)
    assert rate is not None
    assert rate.constant
    assert rate.fps == pytest.approx(10)


def test_rate_of_a_recording_with_lost_frames_is_the_nominal_one():
    places = np.delete(np.arange(200), [20, 21, 90, 150])
    rate = frame_rate((places / 30).tolist())
    assert rate is not None
    assert rate.constant
    assert rate.fps == pytest.approx(30)


def test_variable_rate_is_the_average():
    times = np.cumsum([0.0] + [1 / 30, 1 / 10] * 50)
    rate = frame_rate(times.tolist(), declared=30.0)
    assert rate is not None
    assert not rate.constant
    assert rate.fps == pytest.approx(100 / times[-1])


def test_no_rate_without_two_times():
    assert frame_rate([]) is None
    assert frame_rate([1.0, 1.0]) is None


def test_length_without_cuts():
    assert shown_for([]) == 0
    assert shown_for([3.0, 1.0, 2.0]) == 2
    assert shown_for([0.0, 1.0, 1000.0, 1001.0]) == 2
    assert shown_for([0.0, 20.0, 40.0]) == 40


@pytest.mark.parametrize("fps", [0.0, -1.0, float("nan")])
def test_rate_must_be_positive(fps):
    with pytest.raises(InputError, match="must be positive"):
        to_constant_rate([], fps, Tally())
