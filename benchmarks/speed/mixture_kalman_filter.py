"""How much faster is the mixture Kalman filter than the released algorithm, with the same numbers?

    python -m benchmarks.speed.mixture_kalman_filter --threads 2

The released tracker, a plain NumPy loop over frames and components (and the same loop in Octave where
`octave` is installed), against torchpose in the same run, taking turns: fixed tracks offline and
online, with measurement noise of its own in every frame, with missing joints, with smoothing; and the
sampled and split trackers. Means are compared with the NumPy loop; the run fails if they differ.

The prior is that of --prior, else the authors' released one if TORCHPOSE_DATA names the folder that
holds it (signer/released_prior_Training20_02.npz), else a synthetic one of the same scales.
"""

import itertools
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchmarks._command import run_command
from benchmarks.speed import _released
from benchmarks.speed._arm import (
    DIM,
    UNIFORM_WEIGHT,
    Problem,
    draw_sequences,
    make_filter,
    make_problem,
)
from benchmarks.speed._octave import find_octave, run_octave
from benchmarks.speed._timing import (
    Case,
    Limits,
    Report,
    Setup,
    Timing,
    begin,
    measure_limits,
    number,
    ratio,
    take_turns,
)
from torchpose.filters import MixtureKalmanFilter

TOLERANCE = {torch.float64: 1e-8, torch.float32: 1e-3}  # of |difference| / max(|reference|, 1)
HEADER = ("method", "B", "dtype", "ms/call", "frames/s", "x NumPy", "x NumPy, CPU", "error")


class Sizes(NamedTuple):
    """Sequences of a batch, and frames: offline, of one sequence and of a batch otherwise, of loops."""

    batch: int
    long: int
    single: int
    batched: int
    slow: int


class Method(NamedTuple):
    """One row of the table.

    Attributes:
        name, batch, dtype: as printed. frames: of each sequence. call: returns means, [B, T, D].
        reference: the means that the first sequence must have [T, D], where the NumPy loop has them.
    """

    name: str
    batch: int
    dtype: torch.dtype
    frames: int
    call: Callable[[], Tensor]
    reference: np.ndarray | None = None


def main(
    setup: Setup = Setup(runs=7),
    *,
    batch: int = 64,
    prior: Path | None = None,
    synthetic: bool = False,
) -> None:
    """Run and print the tables.

    Args:
        setup: see `Setup`.
        batch: sequences of the large batch.
        prior: .npz with left_weights, left_means, ....
        synthetic: a synthetic prior in any case.
    """
    report = begin("Mixture Kalman filter against the released algorithm", setup)
    sizes = Sizes(2, 40, 10, 10, 5) if setup.quick else Sizes(batch, 1000, 200, 40, 10)
    problem = make_problem(prior, synthetic)
    report.add(describe(problem, sizes))
    loop = NumpyLoop(problem)
    with torch.inference_mode():
        methods = make_methods(problem, loop, sizes)
        errors = [error_of(method) for method in methods]
        failed = report_agreement(report, methods, errors)
        z = draw_sequences(problem, 1, sizes.single)[0].numpy()
        peer = Case("released algorithm, NumPy loop", lambda: loop(z), len(z))
        cases = [Case(m.name, m.call, m.batch * m.frames) for m in methods]
        timings = take_turns([peer, *cases], setup.runs)
        octave = octave_text(loop, z, setup.runs)
        limits = measure_limits(setup.quick)
    report.table(HEADER, table_rows(methods, errors, timings))
    report.add(octave)
    report.add(floor_text(problem, limits))
    report.close(["numpy"], limits)
    if failed:
        sys.exit(f"these differ from the NumPy loop by more than is allowed: {'; '.join(failed)}")


def describe(problem: Problem, sizes: Sizes) -> str:
    return (
        f"{problem.source}: {problem.prior.n_components} components, {DIM} dimensions, "
        f"{len(problem.observed)} measured (hand, head, neck). Offline rows filter {sizes.long} frames, "
        f"the others and the NumPy loop {sizes.single}, or {sizes.batched} in a batch (split tracks: "
        f"{sizes.slow}). Gains of constant noise are known from the warm-up unless the row says otherwise."
    )


class NumpyLoop:
    """The released algorithm on the same problem."""

    def __init__(self, problem: Problem) -> None:
        weights, means, covariances = (p.numpy() for p in problem.prior.parameters_tuple())
        noise = (np.diag(problem.process_cov.numpy()), np.diag(problem.measurement_cov.numpy()))
        self.model = _released.make_model((weights, means, covariances), *noise, problem.observed)

    def __call__(
        self, z: np.ndarray, mask: Tensor | None = None, noise: Tensor | None = None
    ) -> np.ndarray:
        seen = None if mask is None else mask.numpy()
        own = None if noise is None else noise.numpy()
        return _released.fixed_tracks(self.model, z, UNIFORM_WEIGHT, seen, own)[0]


# --- methods


def make_methods(problem: Problem, loop: NumpyLoop, sizes: Sizes) -> list[Method]:
    """Return all methods of torchpose, for one sequence and for a batch."""
    made: list[Method] = []
    for batch in (1, sizes.batch):
        z = draw_sequences(problem, batch, sizes.long)
        made += offline_methods(problem, loop, z)
        frames = sizes.single if batch == 1 else sizes.batched
        made += short_methods(problem, loop, z[:, :frames])
        made.append(split_method(problem, z[:, : frames if batch == 1 else sizes.slow]))
    return made


def offline_methods(problem: Problem, loop: NumpyLoop, z: Tensor) -> list[Method]:
    batch, frames, _ = z.shape
    reference = loop(z[0].numpy())
    made = []
    for dtype in (torch.float64, torch.float32):
        tracker, cast = make_filter(problem, dtype=dtype), z.to(dtype)
        call = lambda f=tracker, z=cast: f(z).mean  # noqa: E731
        made.append(Method("fixed tracks", batch, dtype, frames, call, reference))
    anew = Method(
        "fixed tracks, new filter: gains too", batch, torch.float64, frames,
        lambda: make_filter(problem)(z).mean, reference,
    )  # fmt: skip
    return [*made, anew]


def short_methods(problem: Problem, loop: NumpyLoop, z: Tensor) -> list[Method]:
    batch, frames, n_obs = z.shape
    tracker, wide = make_filter(problem), torch.float64
    noise, masks = random_noise(batch, frames, n_obs), random_masks(batch, frames, n_obs)
    first = next(masks)
    masks = itertools.chain([first], masks)
    z0 = z[0].numpy()
    plain = loop(z0)
    generator = torch.Generator().manual_seed(0)
    sampled = make_filter(problem, tracks="sampled")
    size = (batch, wide, frames)
    return [
        Method("fixed tracks, online", *size, lambda: run_online(tracker, z), plain),
        Method("fixed tracks, R of every frame", *size,
               lambda: tracker(z, measurement_cov=noise).mean, loop(z0, noise=noise[0])),
        Method("fixed tracks, 5 % missing", *size,
               lambda: tracker(z, mask=next(masks)).mean, loop(z0, mask=first[0])),
        Method("fixed tracks, covariances too", *size, lambda: tracker(z, return_cov=True).mean, plain),
        Method("fixed tracks, smoothed", *size, lambda: tracker.smooth(z).mean),
        Method("sampled tracks", *size, lambda: sampled(z, generator=generator).mean),
    ]  # fmt: skip


def split_method(problem: Problem, z: Tensor) -> Method:
    tracker = make_filter(problem, tracks="split")
    return Method("split tracks", len(z), torch.float64, z.shape[1], lambda: tracker(z).mean)


def run_online(tracker: MixtureKalmanFilter, z: Tensor) -> Tensor:
    state, means = tracker.init(len(z)), []
    for frame in z.unbind(1):
        state, out = tracker.step(state, frame)
        means.append(out.mean)
    return torch.stack(means, 1)


def random_noise(batch: int, frames: int, n_obs: int) -> Tensor:
    """Draw R [B, T, Z, Z], between half and one and a half times nine pixels squared."""
    generator = torch.Generator().manual_seed(5)
    scale = 0.5 + torch.rand(batch, frames, n_obs, generator=generator, dtype=torch.float64)
    return torch.diag_embed(9 * scale)


def random_masks(batch: int, frames: int, n_obs: int) -> Iterator[Tensor]:
    """Yield masks [B, T, Z] in which each joint is missing in 5 % of the frames."""
    generator = torch.Generator().manual_seed(6)
    while True:
        seen = torch.rand(batch, frames, n_obs // 2, generator=generator) > 0.05
        yield seen.repeat_interleave(2, -1)


# --- results


def error_of(method: Method) -> float | None:
    """Return the largest |difference| / max(|reference|, 1) of the first means; NaN if any is lost."""
    means = method.call().double().numpy()
    if not np.isfinite(means).all():
        return float("nan")
    if method.reference is None:
        return None
    mean = means[0]
    return float((np.abs(mean - method.reference) / np.maximum(np.abs(method.reference), 1)).max())


def report_agreement(
    report: Report, methods: list[Method], errors: list[float | None]
) -> list[str]:
    """Report the difference from the NumPy loop, and return the methods that differ too much."""
    pairs = [(m, e) for m, e in zip(methods, errors, strict=True) if e is not None]
    said = []
    for dtype, allowed in TOLERANCE.items():
        worst = np.max([e for m, e in pairs if m.dtype == dtype])  # NaN if one of them is
        said.append(f"{worst:.1e} in {name_of(dtype)} (at most {allowed:g} allowed)")
    report.add(
        "Agreement with the NumPy loop: largest |difference| of the means / max(|reference|, 1) "
        f"{', '.join(said)}."
    )
    return [f"{m.name} (B = {m.batch}): {e:.1e}" for m, e in pairs if not e < TOLERANCE[m.dtype]]


def name_of(dtype: torch.dtype) -> str:
    return str(dtype).split(".")[1]


def table_rows(
    methods: list[Method], errors: list[float | None], timings: list[Timing]
) -> Iterator[list[str]]:
    loop = timings[0]
    yield row(loop, loop, 1, "float64", "")
    for method, error, timing in zip(methods, errors, timings[1:], strict=True):
        shown = "" if error is None else f"{error:.0e}"
        yield row(timing, loop, method.batch, name_of(method.dtype), shown)


def row(timing: Timing, loop: Timing, batch: int, dtype: str, error: str) -> list[str]:
    times = ratio(loop, timing)
    milliseconds = 1e3 * timing.median * timing.case.units
    cells = (milliseconds, 1 / timing.median, times.wall, times.cpu)
    return [timing.case.name, str(batch), dtype, *(number(cell) for cell in cells), error]


def octave_text(loop: NumpyLoop, z: np.ndarray, runs: int) -> str:
    """Run the same loop in Octave, and return its speed in words; no part of it is torchpose."""
    program = find_octave()
    if program is None:
        return "Octave is not installed: its row is left out."
    reference = loop(z)
    mean, seconds = run_octave(program, loop.model, z, UNIFORM_WEIGHT, runs)
    error = (np.abs(mean - reference) / np.maximum(np.abs(reference), 1)).max()
    rate = len(z) / float(np.median(seconds))
    return (
        f"The same loop in Octave: {rate:.0f} frames per second; its means differ by {error:.0e}."
    )


def floor_text(problem: Problem, limits: Limits) -> str:
    """Return the floor of fixed tracks with known gains, per frame, in words."""
    n_tracks, n_obs = problem.prior.n_components, len(problem.observed)
    flops = 2 * n_tracks * (DIM * DIM + 2 * n_obs * DIM + n_obs * n_obs + DIM)
    written = 8 * (DIM + n_tracks + 1)
    compute, memory = flops / limits.gflops_float64 / 1e3, written / limits.copy_gb / 1e3
    return (
        f"Floor of fixed tracks with known gains, float64: {flops / 1e3:.0f} kFLOP per frame (predict, "
        f"innovate, whiten, correct, average) are {compute:.2f} us at the rate of large products; "
        f"{written} bytes of results are {memory:.2f} us: {1e6 / (compute + memory):,.0f} frames per second."
    )


if __name__ == "__main__":
    run_command(main)
