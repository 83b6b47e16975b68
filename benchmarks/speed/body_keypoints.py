"""How long does a frame take when whole bodies are tracked from keypoints, live and in batches?

    python -m benchmarks.speed.body_keypoints --data DIR --threads 2

Clips of `benchmarks.keypoint_bodies`: keypoints of a moving person with noise, gaps, outliers and exchanged
sides in a ring of cameras, in batches the same clip several times. Live steps are timed one by one, the first
second apart, in which tracking begins. Beside them is Pose2Sim's way as that benchmark has it, which sees the
whole clip at once. The floor is the time of the large products of a step alone.
"""

import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks._command import run_command
from benchmarks.speed._timing import Case, Setup, begin, measure_limits, number, take_turns

CAMERAS = (4, 3, 2, 1)
BATCHES = (1, 16, 64)
_FRAMES, _QUICK_FRAMES = 150, 12
_BEGINS = 30  # frames in which tracking begins
_N, _ROWS, _ITERATIONS = (
    77,
    45,
    3,
)  # columns of a state, rows of fifteen joints, iterations of a correction
_BARS = (
    "Bars: a live step of four cameras at most 10 ms, 99 % under 20; 500 frames/s in batches of 64."
)


class Live(NamedTuple):
    """Seconds of steps: the median, the 99th percentile, the mean CPU time, and the longest of the start."""

    median: float
    late: float
    cpu: float
    start: float


def main(data: Path, setup: Setup = Setup()) -> None:
    """Run and print the tables.

    Args:
        data: folder with the sets. setup: of the benchmark.
    """
    import torch

    from benchmarks.keypoint_bodies.clips import CHOOSING, MHAD, read_clips

    report = begin("Whole bodies from keypoints", setup)
    clip = read_clips(data, {MHAD: CHOOSING[MHAD][3:4]})[MHAD][0]
    frames = _QUICK_FRAMES if setup.quick else _FRAMES
    limits = measure_limits(setup.quick)
    with torch.no_grad():
        steps = [(count, live(clip.of_cameras(count), frames)) for count in CAMERAS]
        report.table(
            ("cameras, live", "median ms", "99 % ms", "mean CPU ms", "start ms"),
            [(str(count), *(number(1000 * v) for v in found)) for count, found in steps],
        )
        batches = BATCHES[:2] if setup.quick else BATCHES
        report.table(
            ("four cameras", "frames/s", "frames/s of CPU", "Pose2Sim's way"),
            list(batch_rows(clip, frames // 3 if not setup.quick else frames, batches, setup.runs)),
        )
    floor = floor_flops()
    report.add(
        f"Floor: products and factors of {_ITERATIONS} iterations with {_ROWS} rows and {_N} columns are "
        f"{floor / 1e6:.1f} million operations, {floor / limits.gflops_float64 / 1e6:.2f} ms a frame at the "
        f"rate of this machine. {_BARS}"
    )
    report.close(limits=limits)


def live(clip: Any, frames: int) -> Live:
    """Track frame by frame.

    Args:
        clip: of keypoints. frames: how many.
    """
    import torchpose

    tracker = torchpose.BodyTracker(clip.rig, "kalman", fps=clip.fps)
    state, wall = tracker.init(), []
    cpu = 0.0
    begins = min(_BEGINS, frames // 2)
    for t in range(min(frames, len(clip.joints))):
        begun, used = time.perf_counter(), time.process_time()
        keypoints, confidence = clip.seen.keypoints[t], clip.seen.confidence[t]
        state, _ = tracker.step(state, keypoints=keypoints, confidence=confidence)
        wall.append(time.perf_counter() - begun)
        cpu += time.process_time() - used if t >= begins else 0.0
    later = sorted(wall[begins:])
    late = later[min(len(later) - 1, round(0.99 * len(later)))]
    return Live(statistics.median(later), late, cpu / len(later), max(wall[:begins]))


def batch_rows(clip: Any, frames: int, batches: Sequence[int], runs: int) -> Any:
    """Return the rows of whole sequences in batches.

    Args:
        clip: of keypoints. frames: of a sequence. batches: sizes. runs: of each.
    """
    import torchpose
    from benchmarks.keypoint_bodies.peers import pose2sim

    tracker = torchpose.BodyTracker(clip.rig, "kalman", fps=clip.fps)
    keypoints, confidence = clip.seen.keypoints[:frames], clip.seen.confidence[:frames]
    for batch in batches:
        many = (
            keypoints.expand(batch, *keypoints.shape),
            confidence.expand(batch, *confidence.shape),
        )
        units = batch * len(keypoints)
        ours, peer = take_turns(
            [
                Case("kalman", lambda many=many: tracker(keypoints=many[0], confidence=many[1]), units),
                Case("pose2sim", lambda: pose2sim(clip.rig, keypoints, confidence, clip.fps), len(keypoints)),
            ],
            max(1, runs), warm=0,
        )  # fmt: skip
        yield (
            f"{batch} at once",
            *(number(1 / seconds) for seconds in (ours.median, ours.median_cpu, peer.median)),
        )


def floor_flops() -> float:
    """Return the operations of the products of one frame."""
    predict = 2 * 2 * _N**3
    each = 2 * _ROWS * _N * _N + 2 * _ROWS * _ROWS * _N + _ROWS**3 / 3 + _ROWS**3
    return predict + _ITERATIONS * each + _ROWS**2 * _N + 2 * _ROWS * _N * _N


if __name__ == "__main__":
    run_command(main)
