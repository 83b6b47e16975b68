"""Compare the times of live frames with the rate that a tracker is for."""

import math
from collections.abc import Sequence
from numbers import Real
from statistics import fmean, median
from typing import Any, NamedTuple

_TELLING = 30  # intervals between frames that tell their rate
_WRONG = 0.2  # share by which a rate is another one, as for `CameraSource`; clocks jitter by less
_PAUSE = 1.0  # seconds without a frame, which are a pause


class LiveRate(NamedTuple):
    """Holds at what rate the last frames came.

    Attributes:
        time: of the last frame, seconds, None if it has none.
        intervals: seconds between the last frames, those counted that a camera missed.
        note: that the rate is not the expected one, once it was not; else empty.
    """

    time: float | None = None
    intervals: tuple[float, ...] = ()
    note: str = ""

    def after(self, time: Any, missed: int, fps: float) -> "LiveRate":
        """Return the rate after one more frame.

        Args:
            time: seconds; what is no time counts as none. missed: the number of frames right before.
            fps: the expected rate.
        """
        if self.note:
            return self
        told = isinstance(time, Real) and math.isfinite(time)
        now = float(time) if told else None
        if now is None or self.time is None or not 0 < now - self.time <= _PAUSE:
            return self._replace(time=now)
        last = (*self.intervals[1 - _TELLING :], (now - self.time) / (1 + missed))
        return LiveRate(now, last, _note(last, fps))


def _note(intervals: Sequence[float], fps: float) -> str:
    """Return what is wrong if both the usual and the mean interval are: one stall is no other rate."""
    if len(intervals) < _TELLING:
        return ""
    rates = [1 / median(intervals), 1 / fmean(intervals)]
    rate = min(rates, key=lambda rate: abs(math.log(rate / fps)))
    if abs(math.log(rate / fps)) <= math.log1p(_WRONG):
        return ""
    return (
        f"frames come at {rate:.3g} per second by their times, and the tracker is for {fps:g}: people seem "
        f"to move {'faster' if rate < fps else 'slower'} than they do; make the tracker with fps={rate:.3g}"
    )
