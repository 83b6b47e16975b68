"""What do gradients of the poses cost, and do poses stay as they are when gradients are asked for?

    python -m benchmarks.speed.gradients --threads 1

100 frames of head and hands through `UpperBodyTracker` over windows, over single poses, and, for one
sequence, as it is by default: without gradients, and forward and backward with gradients for every
keypoint. Each case runs in a process of its own (with --quick in this one) and reports CPU seconds and the
peak of its resident memory beyond what was resident before; gains and libraries are loaded before, by a
short run.
"""

import sys
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

from benchmarks._command import run_command
from benchmarks.speed._memory import MB, forget_peak, peak_resident, resident, return_free_memory
from benchmarks.speed._new_process import call_in_new_process
from benchmarks.speed._timing import Setup, begin, number

METHODS = ("window-mixture", "mkf-fixed", "multiple-model")
JUMPING = 2
"""Poses of bones jump where other hypotheses are chosen: no differences are like its gradient."""

NAMES = ("head", "hand_left", "hand_right")
TOLERANCE, SLOPE_TOLERANCE = 1e-9, 1e-5
_MODULE = "benchmarks.speed.gradients"
HEADER = ("method", "B", "T", "CPU s", "with gradients", "ratio", "MB", "with gradients")


class Case(NamedTuple):
    """Which of `METHODS`, sequences, and frames."""

    method: int
    batch: int
    frames: int


Way = tuple[int, int, int, bool]
"""A case, and whether gradients are asked for."""


def main(setup: Setup = Setup()) -> None:
    """Run and print the table."""
    report = begin("Gradients of poses", setup)
    cases = [Case(method, batch, 100) for method in (0, 1) for batch in (1, 16)]
    cases.append(Case(JUMPING, 1, 100))
    if setup.quick:
        cases = [Case(0, 1, 6), Case(1, 1, 6), Case(JUMPING, 1, 3)]
    ways = [(*case, on) for case in cases for on in (False, True)]
    if setup.quick:  # whose peaks mean nothing
        results = [measure(*way) for way in ways]
    else:  # so that a peak is its own
        results = [
            call_in_new_process(setup.threads, _MODULE, measure.__name__, *way) for way in ways
        ]
    found = list(zip(results[::2], results[1::2], strict=True))
    report.table(HEADER, table_rows(cases, found))
    moved = max(result["moved"] for _, result in found)
    slope = max(result["slope"] for _, result in found)
    report.add(
        "Agreement: asking for gradients moves no number of joints, covariances and log-evidence by more "
        f"than {moved:.1e} of max(|number|, 1), at most {TOLERANCE:g} allowed; gradients along a random "
        f"direction differ from central differences by {slope:.1e} of them, at most {SLOPE_TOLERANCE:g} "
        f"({METHODS[JUMPING]} jumps, and is left out of this)."
    )
    report.close()
    if not (moved <= TOLERANCE and slope <= SLOPE_TOLERANCE):
        sys.exit("gradients are not those of the poses")


def measure(method: int, batch: int, frames: int, gradients: bool) -> dict[str, Any]:
    """Track once: CPU seconds, bytes beyond what was there, and agreement with and of gradients."""
    import torch

    from torchpose import UpperBodyTracker, load_prior

    prior = load_prior("kinect-upper-body")
    tracker = UpperBodyTracker(prior, camera=prior.camera, method=METHODS[method])
    keypoints = draw_keypoints(batch, frames)
    with torch.no_grad():
        plain = tracker(keypoints, names=NAMES)  # gains are known from here on
    if gradients:
        keypoints = keypoints.requires_grad_()
        tracker(keypoints[:1, :2], names=NAMES).joints3d.sum().backward()
        keypoints.grad = None
    return_free_memory()
    before = resident()
    forget_peak()
    start = time.process_time()
    with torch.set_grad_enabled(gradients):
        track = tracker(keypoints, names=NAMES)
        if gradients:
            track.joints3d.sum().backward()
    numbers = {"seconds": time.process_time() - start, "beyond": peak_resident() - before}
    if not gradients:
        return numbers
    with torch.no_grad():
        moved = max(
            float(((getattr(track, name) - value).abs() / value.abs().clamp_min(1)).max())
            for name in ("joints2d", "joints3d", "covariance2d", "covariance3d", "log_evidence")
            for value in (getattr(plain, name),)
        )
        slope = 0.0 if method == JUMPING else slope_error(tracker, keypoints)
        return {**numbers, "moved": moved, "slope": slope}


def slope_error(tracker: Any, keypoints: Any) -> float:
    """Return |gradient - central difference| / |gradient| of the summed joints along a random direction."""
    import torch

    generator = torch.Generator().manual_seed(1)
    along = torch.randn(keypoints.shape, generator=generator, dtype=keypoints.dtype)
    step = 1e-4 * along  # pixels
    ahead, behind = (
        tracker(keypoints.detach() + shift, names=NAMES).joints3d.sum() for shift in (step, -step)
    )
    wanted = float((ahead - behind) / 2e-4)
    return abs(float((keypoints.grad * along).sum()) - wanted) / abs(wanted)


def draw_keypoints(batch: int, frames: int) -> Any:
    """Draw head and hands that wander about, pixels [B, T, 3, 2]."""
    import torch

    generator = torch.Generator().manual_seed(0)
    place = torch.tensor([[320.0, 120.0], [400.0, 240.0], [240.0, 240.0]], dtype=torch.float64)
    shape = (batch, frames, 3, 2)
    steps = torch.randn(shape, generator=generator, dtype=torch.float64)
    return place + 2 * steps.cumsum(1)


def table_rows(
    cases: list[Case], found: list[tuple[dict[str, Any], dict[str, Any]]]
) -> Iterator[list[str]]:
    for case, (plain, learning) in zip(cases, found, strict=True):
        name = METHODS[case.method]
        seconds = [number(result["seconds"]) for result in (plain, learning)]
        memory = [f"{result['beyond'] / MB:.0f}" for result in (plain, learning)]
        share = f"{learning['seconds'] / plain['seconds']:.1f}"
        yield [name, str(case.batch), str(case.frames), *seconds, share, *memory]


if __name__ == "__main__":
    run_command(main)
