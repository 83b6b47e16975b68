"""How long does a live step of the upper body take, on one core?

    python -m benchmarks.speed.upper_body_live --threads 1

Head, neck and hands of the performer of `torchpose.demo` with 3 px of noise, tracked frame by frame by the
default tracker of the prior that comes with torchpose, beside the paper's filter. Steps are timed one by one
after the first frames. Confidence that differs in every frame gives each frame a noise of its own.
"""

import statistics
import time
from typing import Any, NamedTuple

from benchmarks._command import run_command
from benchmarks.speed._timing import OperationCounter, Setup, begin, number

_FRAMES, _QUICK_FRAMES = 60, 8
_BEGINS = 5  # frames that are not timed
_COUNTED = 6  # frames whose operations are counted: lengths of bones are learnt in one of so many
_BARS = (
    "Bars, CPU time: constant noise 6 ms, another confidence in every frame 8 ms, 16 streams 20 ms."
)


class _Case(NamedTuple):
    """Streams under test: their number, whether confidence changes, and the method; None is the default."""

    name: str
    streams: int
    confidence: bool
    method: str | None = None


_CASES = (
    _Case("constant noise", 1, False),
    _Case("another confidence in every frame", 1, True),
    _Case("16 streams", 16, False),
    _Case("16 streams, another confidence", 16, True),
    _Case("the paper's filter, constant noise", 1, False, "mkf-fixed"),
)


def main(setup: Setup = Setup(threads=1)) -> None:
    """Print the table.

    Args:
        setup: see `Setup`.
    """
    report = begin("Live steps of the upper body", setup)

    n_frames = _QUICK_FRAMES if setup.quick else _FRAMES
    cases = _CASES[:2] if setup.quick else _CASES
    rows = [(case.name, *_row(case, n_frames, max(1, setup.runs))) for case in cases]
    header = ("", "median CPU ms", "mean CPU ms", "median ms", "torch operations")
    report.table(header, rows)
    report.add(f"Of one step. {_BARS}")
    report.close()


def _row(case: _Case, n_frames: int, runs: int) -> tuple[str, ...]:
    """Return the figures of a case."""
    import torch

    tracker, keypoints, confidence = _problem(case, n_frames)
    # what is made in inference mode is kept from no step to the next: the tracker is made outside of it
    with torch.inference_mode():
        step_times = [_times(tracker, keypoints, confidence) for _ in range(runs + 1)][1:]
        state = _begun(tracker, keypoints)
        for t in range(n_frames - _COUNTED):
            state, _ = tracker.step(state, keypoints[:, t], confidence[:, t])
    wall, cpu = ([t for times in step_times for t in times[i]] for i in (0, 1))
    with OperationCounter() as counter, torch.inference_mode():
        for t in range(n_frames - _COUNTED, n_frames):
            state, _ = tracker.step(state, keypoints[:, t], confidence[:, t])
    times = (statistics.median(cpu), statistics.mean(cpu), statistics.median(wall))
    return *(number(1000 * value) for value in times), f"{counter.count / _COUNTED:,.0f}"


def _problem(case: _Case, n_frames: int) -> tuple[Any, Any, Any]:
    """Return the tracker, keypoints and confidence of a case."""
    import torch

    import torchpose
    from torchpose.demo import noisy_keypoints, performer

    prior = torchpose.load_prior("kinect-upper-body")
    tracker = torchpose.UpperBodyTracker(prior, prior.camera, case.method, fps=30.0)
    moves = [performer(n_frames, seed=seed).joints for seed in range(case.streams)]
    keypoints = torch.stack([noisy_keypoints(joints, std_px=3.0) for joints in moves])
    confidence = torch.ones_like(keypoints[..., 0])
    if case.confidence:
        generator = torch.Generator().manual_seed(1)
        confidence = 0.3 + 0.7 * torch.rand(confidence.shape, generator=generator).to(confidence)
    return tracker, keypoints, confidence


def _begun(tracker: Any, keypoints: Any) -> Any:
    from torchpose.demo import KEYPOINT_NAMES

    return tracker.init(len(keypoints), names=list(KEYPOINT_NAMES))


def _times(tracker: Any, keypoints: Any, confidence: Any) -> tuple[list[float], list[float]]:
    """Return wall and CPU time of the steps after the first ones, seconds."""
    state, wall, cpu = _begun(tracker, keypoints), [], []
    for t in range(keypoints.shape[1]):
        begun, used = time.perf_counter(), time.process_time()
        state, _ = tracker.step(state, keypoints[:, t], confidence[:, t])
        wall.append(time.perf_counter() - begun)
        cpu.append(time.process_time() - used)
    return wall[_BEGINS:], cpu[_BEGINS:]


if __name__ == "__main__":
    run_command(main)
