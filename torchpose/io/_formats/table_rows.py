"""Split the rows of tables into cells, and read their time stamps and frame rates."""

import contextlib
import datetime
import math
import re
from pathlib import Path

import numpy as np

from torchpose.errors import FileFormatError
from torchpose.io._formats.raw_recording import frame_ranges

KINECT_FPS = 30.0
KINECT_TICK = 1e-7  # Kinect v2's time stamps count 100 ns
_TICKS = {
    1.0: "seconds", 1e-3: "milliseconds", 1e-6: "microseconds", KINECT_TICK: "100 ns",
    1e-9: "nanoseconds",
}  # fmt: skip
_UNEVEN = 0.2  # seconds from time stamps, of frames at one rate, that are worth a note
_SLOWEST, FASTEST = 4.0, 250.0  # frames per second that a recording may have
_TIME = re.compile(
    r"(date|frame|relative|elapsed)?_?time(_?stamp)?(_(s|sec|ms|us|usec|ns|iso|utc))?"
)
_GAP = 1.5  # median steps
_FEWEST_STEPS = 4  # of which those over two frames are looked at
_LEAST_JITTER = 0.02  # of stamps, in frames
_SKIPS = 0.03  # probability that frames are missing between two rows
_MARKS = (";", "\t", ",")


def split_row(line: str) -> list[str]:
    """Return the cells of a row, at semicolons, tabs or commas, else at blanks.

    Between semicolons or tabs a comma is the decimal mark. Quotation marks around cells are left out.
    """
    for mark in _MARKS:
        if mark in line.strip():
            line = line.lstrip().rstrip(" ").removesuffix(mark)  # tabs at the end are empty cells
            line = line if mark == "," else re.sub(r"(?<=\d),(?=\d)", ".", line)
            return [cell.strip().strip('"') for cell in line.split(mark)]
    return [cell.strip('"') for cell in line.split()]


def split_rows(path: Path, rows: list[tuple[int, str]], width: int) -> list[tuple[int, list[str]]]:
    """Return the cells of rows, each with the number of its line.

    Args:
        path: for messages. rows: lines with their numbers. width: cells of the header, which rows may fall
            short of where they end with marks.

    Raises:
        FileFormatError: a row of another number of cells.
    """
    cells = []
    for number, line in rows:
        row = split_row(line)
        row += [""] * (width - len(row) if line.rstrip(" ").endswith(_MARKS) else 0)
        if len(row) != width:
            commas = len(row) > width and not set(_MARKS[:-1]) & set(line)
            raise FileFormatError(
                f"{path}, line {number}: expected {width} cells as in the header, got {len(row)}"
                + "; with decimal commas, separate cells by semicolons or tabs" * commas
            )
        cells.append((number, row))
    return cells


def is_time(name: str) -> bool:
    """Return whether a column of this name holds times.

    >>> is_time("Timestamp (ms)"), is_time("time"), is_time("frame")
    (True, True, False)
    """
    return _TIME.fullmatch(re.sub(r"\W+", "_", name).strip("_").lower()) is not None


def stamp_of(cell: str) -> float:
    """Return a time stamp as a number, NaN if the cell is empty.

    A date with a time, or a time of the day, by ISO 8601 become seconds.

    Raises:
        ValueError: it is neither.

    >>> stamp_of("1970-01-01T00:01:00.5"), stamp_of("00:01:00.5"), stamp_of("60.5")
    (60.5, 60.5, 60.5)
    """
    with contextlib.suppress(ValueError):
        return float(cell or math.nan)
    text = cell if "-" in cell[:10] else f"1970-01-01T{cell}"
    try:
        time = datetime.datetime.fromisoformat(text)
    except ValueError:
        raise ValueError(
            f"could not convert {cell!r:.40} to a number or a time as 2024-05-01T10:00:00.033"
        ) from None
    return (time if time.tzinfo else time.replace(tzinfo=datetime.UTC)).timestamp()


def usual_step(steps: np.ndarray) -> float:
    """Return the time from a frame to the next, of one or more positive steps between time stamps.

    It is the mean of the steps within a fifth of their median. Stamps in whole milliseconds have a median of
    33 at 30 frames per second. Where stamps jitter, steps may be short and long in turn, and the median
    be a short one. Steps over two frames vary less, and theirs counts if missing frames explain the
    long steps worse than jitter does.

    >>> usual_step(np.array([33, 33, 34, 33, 67, 33, 34, 34, 33]))
    33.375
    >>> usual_step(np.array([28, 52, 28, 52, 28, 52, 28, 52, 28]))
    40.0
    """
    over_one = _common_step(steps)
    if len(steps) < _FEWEST_STEPS:
        return over_one
    over_two = _common_step((steps[:-1] + steps[1:]) / 2)
    return min((over_one, over_two), key=lambda step: _misfit(steps, step))


def _common_step(steps: np.ndarray) -> float:
    median = np.quantile(steps, 0.5, method="lower")
    return float(steps[np.abs(steps - median) <= 0.2 * median].mean())


def _misfit(steps: np.ndarray, step: float) -> float:
    """Return the negative log-likelihood, up to a constant, of steps that are each some of one length."""
    counts = np.rint(steps / step).clip(min=1)
    off = np.sqrt(np.square(steps - counts * step).mean())
    noise = max(float(off), _LEAST_JITTER * step)
    return len(steps) * math.log(noise) - int((counts > 1).sum()) * math.log(_SKIPS)


def frame_rate(steps: np.ndarray, counts: np.ndarray | None = None) -> tuple[float | None, str]:
    """Return the frames per second between time stamps, and a note on their unit.

    Of seconds, milliseconds, microseconds, 100 ns and nanoseconds, the one that comes nearest to 30
    frames per second; None for steps that are none of them, such as numbers of frames.

    Args:
        steps: between stamps. counts: by how many frames each goes on, as far as they are counted.
    """
    later = steps > 0
    if not later.any():
        return None, ""
    step = _mean_step(steps[later], None if counts is None else counts[later])
    rates = {name: 1 / (tick * step) for tick, name in _TICKS.items()}
    name = min(rates, key=lambda name: abs(math.log(rates[name] / KINECT_FPS)))
    if not _SLOWEST <= rates[name] <= FASTEST:
        return None, ""
    return rates[name], f"time stamps taken for {name}: {rates[name]:.3g} frames per second"


def first_second(stamps: np.ndarray, fps: float) -> float | None:
    """Return the first of some time stamps in seconds, by the unit that comes nearest to a frame rate.

    None if no stamp is later than another.

    >>> first_second(np.array([2000, 2033, 2067]), 30.0)
    2.0
    """
    steps = np.diff(stamps)
    if not (steps > 0).any():
        return None
    step = usual_step(steps[steps > 0])
    tick = min(_TICKS, key=lambda tick: abs(math.log(fps * tick * step)))
    return float(stamps[0] * tick)


def notes_on_uneven_times(fps: float, frames: np.ndarray, stamps: np.ndarray) -> tuple[str, ...]:
    """Return a note if frames at the rate of `frame_rate` are far from their time stamps.

    Args:
        fps: frames per second. frames: numbers that increase. stamps: of these frames, increasing too.
    """
    step = _mean_step(np.diff(stamps), np.diff(frames))
    late = ((stamps - stamps[0]) / step - (frames - frames[0])) / fps
    worst = int(np.abs(late).argmax())
    if abs(late[worst]) <= _UNEVEN:
        return ()
    side = "after" if late[worst] < 0 else "before"
    return (
        f"the rate changes: at {fps:.3g} frames per second frame {frames[worst] - frames[0]:.0f} comes "
        f"{abs(late[worst]):.2g} s {side} its time stamp; resample the keypoints to one rate for right "
        "speeds and times",
    )


def _mean_step(steps: np.ndarray, counts: np.ndarray | None) -> float:
    """Return the time of one frame, where some steps may be several times as long as others."""
    counts = np.ones(len(steps)) if counts is None else counts
    each = steps / counts
    frames = counts * np.rint(each / usual_step(each)).clip(min=1)
    return float(steps.sum() / frames.sum())


def dropped_frames(stamps: np.ndarray, by: str = "time stamps") -> list[str]:
    """Return a note on frames that the sensor left out, by steps of more than 1.5 times the median one."""
    steps = np.diff(stamps)
    if not len(steps):
        return []
    ratio = steps / np.median(steps)
    after = np.flatnonzero(ratio > _GAP)
    if not len(after):
        return []
    count = int(np.round(ratio[after] - 1).sum())
    return [
        f"frames that are not in the file, by its {by}: {count}, after "
        f"{frame_ranges(after.tolist())}"
    ]


def stated_rate(path: Path, facts: dict[str, str], otherwise: float | None) -> float | None:
    """Return the frame rate that a file states among its facts, or another one.

    Raises:
        FileFormatError: it is no positive number.
    """
    if "fps" not in facts:
        return otherwise
    try:
        fps = float(facts["fps"])
    except ValueError:
        fps = math.nan
    if not 0 < fps < math.inf:
        raise FileFormatError(f"{path}: fps must be one positive number, got {facts['fps']!r}")
    return fps
