"""How fast are silhouettes of many particles compared with the observed ones?

    python -m benchmarks.speed.silhouettes --threads 2

Counts for 500 particles x 3 cameras x all limbs of the default body, at 160x120 and 640x480, beside a
loop over particles that draws polygons and circles by OpenCV, and beside masks of whole rows packed in
words of 64 bits. Then the cost against particles, cameras and chunk, memory, and what sorting costs.
All methods take turns. Counts are checked against the hull's definition, pixel by pixel.
"""

import contextlib
import ctypes
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from benchmarks._command import run_command
from benchmarks.speed._timing import Case, Report, Setup, begin, number, ratio, take_turns
from torchpose.body import BODY_15, Body, Limbs
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.whole_body import count_pixels
from torchpose.whole_body._silhouettes.outlines import (
    NEAR,
    ProjectedLimbs,
    outline,
    project_limbs,
)
from torchpose.whole_body._silhouettes.rendering import (
    PreparedSilhouettes,
    SilhouetteCounts,
    prepare_silhouettes,
    render_limbs,
)
from torchpose.whole_body._silhouettes.row_intervals import Strip, _row_ends, limb_intervals

SIZES = ((120, 160), (480, 640))
PARTICLES, CAMERAS = 500, 3
SPREAD_ROOT, SPREAD_PARTS = 0.05, 0.1  # metres; sines of half angles
SHIFT = 4  # bits of a pixel's fraction in OpenCV's drawings
GROUP = 32  # particles at a time for packed words, the best of 8 to 128
PACKAGES = ("numpy", "opencv-python-headless")


class Problem(NamedTuple):
    """Particles of a standing body, cameras around it, and the silhouette of one more particle."""

    body: Body
    state: torch.Tensor
    limbs: Limbs
    rig: CameraRig
    silhouettes: torch.Tensor
    prepared: PreparedSilhouettes
    height: int
    width: int


def main(setup: Setup = Setup(runs=9)) -> None:
    """Run and print the tables."""
    report = begin("Silhouettes: particles x cameras x limbs", setup)
    import cv2

    cv2.setNumThreads(setup.threads)
    n = 8 if setup.quick else PARTICLES
    sizes = ((30, 40), (60, 80)) if setup.quick else SIZES
    wrong = [check(make_problem(3, CAMERAS, *size), report) for size in sizes]
    compare(n, sizes, setup.runs, report)
    grow(n, sizes[0], setup.runs, setup.quick, report)
    chunks(n, sizes, setup.runs, setup.quick, report)
    sorting(n, sizes, setup.runs, report)
    report.close(PACKAGES)
    if any(wrong):
        sys.exit("counts differ from those of the definition")


def make_problem(
    n: int, cameras: int, height: int, width: int, dtype: torch.dtype = torch.float64
) -> Problem:
    body = Body.of_height(BODY_15, 1.75)
    g = torch.Generator().manual_seed(0)
    spread = torch.full((body.dim,), SPREAD_PARTS, dtype=torch.float64)
    spread[:3] = SPREAD_ROOT
    rest = torch.zeros(body.dim, dtype=torch.float64)
    rest[1] = 0.93
    state = rest + spread * torch.randn(n + 1, body.dim, generator=g, dtype=torch.float64)
    rig = make_rig(cameras, height, width)
    silhouettes = render_limbs(body.limbs(state[n]), rig, height, width)
    state, body = state[:n].to(dtype), body.to(dtype)
    return Problem(
        body, state, body.limbs(state), rig, silhouettes,
        prepare_silhouettes(silhouettes), height, width,
    )  # fmt: skip


def make_rig(n: int, height: int, width: int) -> CameraRig:
    """Return level cameras 3.5 m from the middle of the body, which fills two thirds of the height."""
    import cv2

    cameras = []
    for i in range(n):
        angle = 2 * math.pi * i / n + 0.4
        ahead, down = np.array([-math.sin(angle), 0, -math.cos(angle)]), np.array([0.0, -1, 0])
        R = np.stack([np.cross(down, ahead), down, ahead])
        t = -R @ (np.array([0, 0.95, 0]) - 3.5 * ahead)
        f = 525 / 640 * width
        vector = cv2.Rodrigues(R)[0].ravel()
        cameras.append(
            PinholeCamera(f, f, (width - 1) / 2, (height - 1) / 2, width, height, f"cam_{i}",
                          rotation=vector.tolist(), translation=t.tolist())
        )  # fmt: skip
    return CameraRig(cameras)


# --- methods


def ours(problem: Problem, chunk: int | None = None) -> Callable[[], SilhouetteCounts]:
    limbs, rig, prepared = problem.limbs, problem.rig, problem.prepared
    return lambda: count_pixels(limbs, None, rig, prepared, chunk=chunk)


def on_gpu(problem: Problem) -> Callable[[], SilhouetteCounts]:
    limbs, rig = Limbs(*(x.cuda() for x in problem.limbs)), problem.rig.cuda()
    prepared = problem.prepared._replace(
        before=problem.prepared.before.cuda(), area=problem.prepared.area.cuda()
    )

    def call() -> SilhouetteCounts:
        counts = count_pixels(limbs, None, rig, prepared)
        torch.cuda.synchronize()
        return counts

    return call


def tangent_polygons(limbs: ProjectedLimbs) -> np.ndarray:
    """Return the points where both outer tangents touch the discs, [C, N, L, 4, 2].

    They are NaN if one disc holds the other.
    """
    (ax, bx), (ay, by), (ra, rb) = (np.asarray(x) for x in limbs[:3])
    d = np.stack([bx - ax, by - ay], -1)
    squared, dr = (d * d).sum(-1), ra - rb
    with np.errstate(all="ignore"):
        along, across = dr / squared, np.sqrt(squared - dr * dr) / squared
    turned = np.stack([-d[..., 1], d[..., 0]], -1)
    a, b = np.stack([ax, ay], -1), np.stack([bx, by], -1)
    corners = []
    for side in (1, -1):
        normal = d * along[..., None] + side * turned * across[..., None]
        pair = [a + ra[..., None] * normal, b + rb[..., None] * normal]
        corners += pair[::side]
    return np.stack(corners, -2)


def opencv_loop(problem: Problem) -> SilhouetteCounts:
    """Count pixels by OpenCV: draw two circles and a polygon for each limb into an image per particle."""
    import cv2

    rig, height, width = problem.rig, problem.height, problem.width
    with torch.inference_mode():
        projected = project_limbs(problem.limbs, rig)
    one = 1 << SHIFT
    polygons = tangent_polygons(projected)
    drawn = ~np.isnan(polygons).any((-1, -2))
    polygons = np.nan_to_num(polygons * one).round().astype(np.int32)
    discs = [(np.asarray(x) * one).round().astype(int).tolist() for x in projected[:3]]
    n, n_limbs = problem.limbs.start.shape[:2]
    observed = problem.silhouettes.numpy().astype(np.uint8)
    image = np.zeros((height, width), np.uint8)
    model, overlap = np.zeros((n, len(rig)), np.int64), np.zeros((n, len(rig)), np.int64)
    xs, ys, rs = discs
    for c in range(len(rig)):
        for i in range(n):
            image[:] = 0
            for k in range(n_limbs):
                for end in (0, 1):
                    centre = xs[end][c][i][k], ys[end][c][i][k]
                    cv2.circle(image, centre, rs[end][c][i][k], 1, -1, cv2.LINE_8, SHIFT)
                if drawn[c, i, k]:
                    cv2.fillConvexPoly(image, polygons[c, i, k], 1, cv2.LINE_8, SHIFT)
            model[i, c] = cv2.countNonZero(image)
            overlap[i, c] = cv2.countNonZero(image & observed[c])
    counts = torch.from_numpy(model), torch.from_numpy(overlap)
    return SilhouetteCounts(*counts, problem.prepared.area.expand(n, -1))


def packed_rows(problem: Problem) -> SilhouetteCounts:
    """Count pixels by rows packed in words of 64 bits: unite the limbs, intersect with the silhouette."""
    height, width, rig = problem.height, problem.width, problem.rig
    n, n_limbs = problem.limbs.start.shape[:2]
    words = -(-width // 64)
    observed = np.zeros((len(rig), height, words * 64), np.uint8)
    observed[..., :width] = problem.silhouettes.numpy()
    observed = np.packbits(observed, -1, bitorder="little").view(np.uint64)
    model, overlap = np.zeros((n, len(rig)), np.int64), np.zeros((n, len(rig)), np.int64)
    y = torch.arange(height).to(problem.limbs.start).unsqueeze(-1)
    for first in range(0, n, GROUP):
        group = slice(first, min(first + GROUP, n))
        limbs = Limbs(problem.limbs.start[group], problem.limbs.end[group], problem.limbs.radii)
        with torch.inference_mode():
            outlines = outline(project_limbs(limbs, rig), height, width)
            count = len(outlines.n_rows)
            left, right = _row_ends(outlines, torch.arange(count), y.expand(-1, count))
            start = left.ceil_().clamp_(0, width).short().numpy()
            stop = np.maximum(right.floor_().add_(1).clamp_(0, width).short().numpy(), start)
        covered = np.zeros((height, len(rig), len(limbs.start), words), np.uint64)
        for w in range(words):
            mask = below(stop - 64 * w) & ~below(start - 64 * w)
            limbwise = mask.reshape(height, len(rig), -1, n_limbs)
            covered[..., w] = np.bitwise_or.reduce(limbwise, -1)
        common = covered & observed.transpose(1, 0, 2)[:, :, None]
        model[group] = np.bitwise_count(covered).sum((0, -1), dtype=np.int64).T
        overlap[group] = np.bitwise_count(common).sum((0, -1), dtype=np.int64).T
    counts = torch.from_numpy(model), torch.from_numpy(overlap)
    return SilhouetteCounts(*counts, problem.prepared.area.expand(n, -1))


def below(bits: np.ndarray) -> np.ndarray:
    """Return words with the lowest `bits` set; fewer than 0 counts as 0, more than 64 as 64."""
    bits = bits.clip(0, 64).astype(np.uint64)
    full = bits == 64
    return np.where(full, ~np.uint64(0), (np.uint64(1) << (bits % np.uint64(64))) - np.uint64(1))


def definition(problem: Problem) -> SilhouetteCounts:
    """Count pixels by the definition: a pixel is covered if it lies in a disc or between the tangents."""
    image = torch.zeros(len(problem.state), *problem.silhouettes.shape, dtype=torch.bool)
    y, x = torch.meshgrid(
        torch.arange(problem.height).double(), torch.arange(problem.width).double(), indexing="ij"
    )
    projected = project_limbs(problem.limbs, problem.rig)
    polygons = torch.from_numpy(tangent_polygons(projected))
    for k in range(projected.x.shape[-1]):
        inside = torch.zeros_like(image.transpose(0, 1))
        for end in (0, 1):
            dx, dy = (v[end, ..., k, None, None] for v in (projected.x, projected.y))
            inside |= (x - dx) ** 2 + (y - dy) ** 2 <= projected.radius[
                end, ..., k, None, None
            ] ** 2
        corners = polygons[:, :, k, :, :, None, None]
        sides = []
        for p, q in ((0, 1), (1, 2), (2, 3), (3, 0)):
            (px, py), (qx, qy) = corners[:, :, p].unbind(2), corners[:, :, q].unbind(2)
            sides.append((qx - px) * (y - py) - (qy - py) * (x - px))
        turns = torch.stack(sides)
        inside |= (turns >= 0).all(0) | (turns <= 0).all(0)
        image |= inside.transpose(0, 1)
    overlap = (image & problem.silhouettes).sum((-2, -1))
    return SilhouetteCounts(image.sum((-2, -1)), overlap, problem.prepared.area.expand_as(overlap))


# --- tables


def check(problem: Problem, report: Report) -> bool:
    """Return whether our counts differ from the definition's."""
    truth, counts = definition(problem), ours(problem)()
    wrong = any(not torch.equal(a, b) for a, b in zip(counts, truth, strict=True))
    packed, drawn = packed_rows(problem), opencv_loop(problem)
    same = torch.equal(packed.model, truth.model) and torch.equal(packed.overlap, truth.overlap)
    off = float((drawn.model - truth.model).abs().sum() / truth.model.sum())
    report.add(
        f"Agreement at {problem.width}x{problem.height} with every pixel's definition: torchpose "
        f"{'DIFFERS' if wrong else 'equal'}, packed words {'equal' if same else 'differ'}, areas drawn "
        f"by OpenCV {100 * off:.1f} % off."
    )
    return wrong


def compare(n: int, sizes: tuple[tuple[int, int], ...], runs: int, report: Report) -> None:
    rows = []
    for size in sizes:
        double = make_problem(n, CAMERAS, *size)
        single = make_problem(n, CAMERAS, *size, torch.float32)
        cases = [
            Case("torchpose, float64", ours(double)),
            Case("torchpose, float32", ours(single)),
            Case("limbs of the states (kinematics), float64", lambda p=double: p.body.limbs(p.state)),
            Case("packed words, float64", lambda p=double: packed_rows(p)),
            Case("OpenCV loop over particles", lambda p=double: opencv_loop(p)),
        ]  # fmt: skip
        if torch.cuda.is_available():
            cases.append(Case("torchpose, float32, GPU", on_gpu(single)))
        timings = take_turns(cases, runs)
        for timing in timings:
            peer = ratio(timing, timings[0])
            rows.append(
                [timing.case.name, f"{size[1]}x{size[0]}", *timing.milliseconds, number(peer.wall, 2),
                 number(peer.cpu, 2)]
            )  # fmt: skip
    limbs = len(BODY_15.limbs)
    report.add(f"{n} particles x {CAMERAS} cameras x {limbs} limbs:")
    report.table(("method", "size", "ms", "min ms", "CPU ms", "x torchpose", "CPU x"), rows)


def grow(n: int, size: tuple[int, int], runs: int, quick: bool, report: Report) -> None:
    """Time counts against particles and cameras."""
    particles = (n, 2 * n) if quick else (100, 200, 500, 1000, 2000, 5000)
    problems = [
        (f"{m} x {CAMERAS}", m * CAMERAS, make_problem(m, CAMERAS, *size)) for m in particles
    ]
    problems += [(f"{n} x {c}", n * c, make_problem(n, c, *size)) for c in (1, 2, 4)]
    cases = [Case(name, ours(problem), images) for name, images, problem in problems]
    rows = [
        [t.case.name, number(1e3 * t.median * t.case.units), number(1e6 * t.median)]
        for t in take_turns(cases, max(runs // 2, 1))
    ]
    report.add(f"Cost against particles and cameras, {size[1]}x{size[0]}, float64:")
    report.table(("particles x cameras", "ms", "us per image"), rows)


def chunks(
    n: int, sizes: tuple[tuple[int, int], ...], runs: int, quick: bool, report: Report
) -> None:
    """Time and memory against the number of particles at a time."""
    rows = []
    for size in sizes:
        problem = make_problem(n, CAMERAS, *size)
        values = [None, 1, 4] if quick else [None, 4, 8, 16, 32, 64, 128, 500]
        timings = take_turns([Case(str(v), ours(problem, v)) for v in values], max(runs // 2, 1))
        for value, timing in zip(values, timings, strict=True):
            peak = peak_memory(ours(problem, value))
            rows.append(
                [f"{size[1]}x{size[0]}", "default" if value is None else str(value),
                 number(1e3 * timing.median), "?" if peak is None else number(peak / 2**20)]
            )  # fmt: skip
    report.add("Cost against the chunk (memory: growth of the process while counting):")
    report.table(("size", "chunk", "ms", "MiB"), rows)


def peak_memory(call: Callable[[], object]) -> float | None:
    """Return the bytes that the process grows by during a call; None where the system does not tell."""
    status, reset = Path("/proc/self/status"), Path("/proc/self/clear_refs")
    if not (status.exists() and os.access(reset, os.W_OK)):
        return None

    def field(name: str) -> int:
        line = next(x for x in status.read_text().splitlines() if x.startswith(name))
        return 1024 * int(line.split()[1])

    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)  # what earlier calls left behind would hide the growth
    reset.write_text("5")
    before = field("VmRSS")
    call()
    return max(field("VmHWM") - before, 0)


def sorting(n: int, sizes: tuple[tuple[int, int], ...], runs: int, report: Report) -> None:
    """Time np.sort against torch.sort on the keys of one chunk."""
    rows = []
    for size in sizes:
        problem = make_problem(min(n, 32), CAMERAS, *size)
        outlines = outline(project_limbs(problem.limbs, problem.rig, NEAR), *size)
        strip = Strip(CAMERAS, *size)
        starts = limb_intervals(outlines, len(problem.state), strip).start
        keys = starts[
            torch.randperm(len(starts), generator=torch.Generator().manual_seed(0))
        ].long()
        array, tensor = keys.numpy(), keys
        small = array.astype(np.int32)
        inner = 1 if n < 32 else 20
        cases = [
            Case("np.sort, int64", lambda a=array: np.sort(a), len(keys), inner),
            Case("np.sort, int32", lambda a=small: np.sort(a), len(keys), inner),
            Case("torch.sort, int64", lambda t=tensor: t.sort(), len(keys), inner),
        ]
        for timing in take_turns(cases, runs):
            rows.append([timing.case.name, str(len(keys)), number(1e9 * timing.median)])
    report.add("Sorting the keys of 32 particles:")
    report.table(("method", "keys", "ns per key"), rows)


if __name__ == "__main__":
    run_command(main)
