"""How much faster is tracking on a GPU than on the cores of the same machine, with the same numbers?

    python -m benchmarks.speed.gpu --data DIR --threads 16

The mixture Kalman filter over one arm, the default tracker of upper bodies, offline and live, and whole
bodies from keypoints of four cameras and of one, in batches of several sizes, each on both devices in turn.
Estimates of both are compared; the run fails if they differ. Trackers make many small operations, each of
which has to be started, so the floor of a live step on a GPU is the time that it takes to start them.
"""

import copy
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

import torchpose
from benchmarks._command import run_command
from benchmarks.keypoint_bodies.clips import CHOOSING, MHAD, Clip, read_clips
from benchmarks.speed._arm import Problem, draw_sequences, make_filter, make_problem
from benchmarks.speed._timing import Case, OperationCounter, Setup, begin, number, take_turns
from torchpose.demo import KEYPOINT_NAMES, noisy_keypoints, performer
from torchpose.errors import InputError

DEVICES = ("cpu", "cuda")
TOLERANCE = 1e-3
"""Of |difference| / max(|estimate|, 1), pixels or metres; sums in another order are told from there on."""

HEADER = ("", "B", "CPU frames/s", "GPU frames/s", "ratio", "difference")
_NAMES = list(KEYPOINT_NAMES)


class Row(NamedTuple):
    """What is timed: its name, sequences, frames of each, and what makes a call for a device.

    Estimates of `drawn` tracks depend on the device's random numbers and are not compared.
    """

    name: str
    batch: int
    frames: int
    on: Callable[[str], Callable[[], Tensor]]
    drawn: bool = False


def main(data: Path, setup: Setup = Setup(runs=3)) -> None:
    """Run and print the table.

    Args:
        data: folder with the sets. setup: of the benchmark.

    Raises:
        InputError: without a GPU.
    """
    if not torch.cuda.is_available():
        raise InputError("this benchmark needs a CUDA device, and torch finds none")
    report = begin("Tracking on a GPU", setup)
    rows = [*filter_rows(setup.quick), *upper_body_rows(setup.quick), *body_rows(data, setup.quick)]
    found = []
    with torch.inference_mode():
        for row in rows:
            found.append(measure(row, setup.runs))
            print(*found[-1].cells, flush=True)
    report.table(HEADER, (each.cells for each in found))
    report.add(f"{torch.cuda.get_device_name()}. {floor_text()}")
    report.close()
    failed = [f"{r.name} (B = {r.batch})" for r, f in zip(rows, found, strict=True) if not f.agrees]
    if failed:
        sys.exit(f"these differ by more than {TOLERANCE:g}: {'; '.join(failed)}")


class Measured(NamedTuple):
    """Cells of a row of the table, and whether the estimates of both devices agree."""

    cells: tuple[str, ...]
    agrees: bool


def measure(row: Row, runs: int) -> Measured:
    """Return the speed of a row on both devices, and how much their estimates differ.

    Args:
        row: of the table. runs: timed runs on each device.
    """
    calls = [row.on(device) for device in DEVICES]
    here, there = (call().double().cpu() for call in calls)
    error = float(((there - here).abs() / here.abs().clamp_min(1)).nan_to_num(0.0).max())
    same_gaps = bool((here.isfinite() == there.isfinite()).all())
    cases = [Case(row.name, finished(call), row.batch * row.frames) for call in calls]
    cpu, gpu = take_turns(cases, runs, warm=0)
    numbers = (1 / cpu.median, 1 / gpu.median, cpu.median / gpu.median)
    shown = "" if row.drawn else f"{error:.0e}"
    return Measured(
        (row.name, str(row.batch), *(number(value) for value in numbers), shown),
        row.drawn or (same_gaps and error <= TOLERANCE),
    )


def finished(call: Callable[[], Tensor]) -> Callable[[], None]:
    """Return a call that waits for the device.

    Args:
        call: on any device.
    """

    def run() -> None:
        call()
        torch.cuda.synchronize()

    return run


# --- rows


def filter_rows(quick: bool) -> Iterator[Row]:
    """Yield the rows of the mixture Kalman filter over one arm.

    Args:
        quick: small batches only.
    """
    problem = make_problem()
    for batch, frames in ((2, 10),) if quick else ((64, 60), (1024, 10)):
        z = draw_sequences(problem, batch, frames)
        generator = torch.Generator().manual_seed(5)
        scale = 0.5 + torch.rand(z.shape, generator=generator, dtype=z.dtype)
        seen = torch.rand(*z.shape[:2], z.shape[2] // 2, generator=generator) > 0.05
        mask = seen.repeat_interleave(2, -1)
        noise = torch.diag_embed(9 * scale)
        yield Row("arm: fixed tracks", batch, frames, filtering(problem, "fixed", z))
        yield Row(
            "arm: fixed, R of every frame",
            batch,
            frames,
            filtering(problem, "fixed", z, measurement_cov=noise),
        )
        yield Row(
            "arm: fixed, 5 % missing", batch, frames, filtering(problem, "fixed", z, mask=mask)
        )
        yield Row(
            "arm: sampled tracks", batch, frames, filtering(problem, "sampled", z), drawn=True
        )
        short = z[: max(2, batch // 4), :10]
        yield Row("arm: split tracks", len(short), 10, filtering(problem, "split", short))  # fmt: skip


def filtering(
    problem: Problem, tracks: str, z: Tensor, **given: Tensor
) -> Callable[[str], Callable[[], Tensor]]:
    """Return what makes a call of the filter for a device.

    Args:
        problem: of one arm. tracks: of the filter. z: measurements [B, T, Z]. given: to each call.
    """

    def on(device: str) -> Callable[[], Tensor]:
        tracker, there = make_filter(problem, tracks=tracks).to(device), z.to(device)
        options = {name: value.to(device) for name, value in given.items()}
        return lambda: tracker(there, **options).mean

    return on


def upper_body_rows(quick: bool) -> Iterator[Row]:
    """Yield the rows of the default tracker of upper bodies.

    Args:
        quick: small batches only.
    """
    for batch, frames in ((2, 6),) if quick else ((16, 20), (256, 6)):
        for changing in (False, True):
            said = "another confidence in every frame" if changing else "constant noise"
            yield Row(f"upper body: {said}", batch, frames, upper_body(batch, frames, changing))
    for batch in (1,) if quick else (1, 64):
        frames = 6 if quick else 12
        yield Row("upper body: live", batch, frames, live_upper_body(batch, frames))


def performances(batch: int, frames: int, changing: bool) -> tuple[Tensor, Tensor]:
    """Return keypoints [B, T, J, 2] of performers, and confidences.

    Args:
        batch: performers; beyond eight they repeat. frames: of each. changing: confidences.
    """
    few = [
        noisy_keypoints(performer(frames, seed=i).joints, std_px=3.0) for i in range(min(8, batch))
    ]
    keypoints = torch.stack([few[i % 8] for i in range(batch)])
    confidence = torch.ones_like(keypoints[..., 0])
    if changing:
        generator = torch.Generator().manual_seed(1)
        drawn = torch.rand(confidence.shape, generator=generator, dtype=confidence.dtype)
        confidence = 0.3 + 0.7 * drawn
    return keypoints, confidence


def upper_body(batch: int, frames: int, changing: bool) -> Callable[[str], Callable[[], Tensor]]:
    """Return what makes a call of the default tracker over whole sequences for a device.

    Args:
        batch, frames, changing: as of `performances`.
    """
    keypoints, confidence = performances(batch, frames, changing)

    def on(device: str) -> Callable[[], Tensor]:
        prior = torchpose.load_prior("kinect-upper-body")
        tracker = torchpose.UpperBodyTracker(prior, prior.camera).to(device)
        given = keypoints.to(device), confidence.to(device)
        return lambda: tracker(*given, _NAMES).joints3d

    return on


def live_upper_body(batch: int, frames: int) -> Callable[[str], Callable[[], Tensor]]:
    """Return what makes a call of the default tracker step by step for a device.

    Args:
        batch, frames: as of `performances`.
    """
    keypoints, _ = performances(batch, frames, False)

    def on(device: str) -> Callable[[], Tensor]:
        prior = torchpose.load_prior("kinect-upper-body")
        tracker = torchpose.UpperBodyTracker(prior, prior.camera).to(device)
        there = keypoints.to(device)

        def call() -> Tensor:
            state, joints = tracker.init(batch, _NAMES), []
            for frame in there.unbind(1):
                state, pose = tracker.step(state, frame)
                joints.append(pose.joints3d)
            return torch.stack(joints, 1)

        return call

    return on


def body_rows(data: Path, quick: bool) -> Iterator[Row]:
    """Yield the rows of whole bodies from keypoints.

    Args:
        data: folder with the sets. quick: small batches only.
    """
    clip = read_clips(data, {MHAD: CHOOSING[MHAD][3:4]})[MHAD][0]
    frames = 8 if quick else 12
    for cameras in (4, 1):
        of = clip.of_cameras(cameras)
        said = "four cameras" if cameras == 4 else "one camera"
        for batch in (1, 2) if quick else (1, 128):
            yield Row(f"whole body: {said}", batch, frames, whole_body(of, batch, frames))


def whole_body(clip: Clip, batch: int, frames: int) -> Callable[[str], Callable[[], Tensor]]:
    """Return what makes a call of the tracker of whole bodies for a device.

    Args:
        clip: of keypoints. batch: how many times it is tracked. frames: of each.
    """
    keypoints, confidence = (
        value[:frames].expand(batch, frames, *value.shape[1:])
        for value in (clip.seen.keypoints, clip.seen.confidence)
    )

    def on(device: str) -> Callable[[], Tensor]:
        rig = copy.deepcopy(clip.rig)  # which moves with the tracker
        tracker = torchpose.BodyTracker(rig, "kalman", fps=clip.fps).to(device)
        given = {"keypoints": keypoints.to(device), "confidence": confidence.to(device)}
        return lambda: torch.stack([track.joints3d for track in tracker(**given)])

    return on


# --- floor


def floor_text() -> str:
    """Return how long it takes to start the operations of a live step, in words."""
    one = torch.ones(1, device="cuda")
    add = Case("one operation", finished(lambda: [one + one for _ in range(1000)][-1]), units=1000)
    start = take_turns([add], 7)[0].median
    prior = torchpose.load_prior("kinect-upper-body")
    tracker = torchpose.UpperBodyTracker(prior, prior.camera).to("cuda")
    keypoints, _ = performances(1, 12, False)
    state = tracker.init(1, _NAMES)
    with torch.inference_mode():
        for frame in keypoints[:, :6].to("cuda").unbind(1):
            state, _ = tracker.step(state, frame)
        with OperationCounter() as counter:
            for frame in keypoints[:, 6:].to("cuda").unbind(1):
                state, _ = tracker.step(state, frame)
    operations = counter.count / 6
    return (
        f"Starting one small operation takes {1e6 * start:.1f} us, and a live step of the upper body makes "
        f"{operations:,.0f} of them or of views: {1e3 * start * operations:.1f} ms at most, the floor "
        "of a step on the GPU, whatever the number of streams."
    )


if __name__ == "__main__":
    run_command(main)
