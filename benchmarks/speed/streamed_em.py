"""How long does EM over 10 million states take that no memory holds, and what do two processes give?

    python -m benchmarks.speed.streamed_em --threads 2

20 steps over 10 million states of an arm (21 dimensions, 30 components), which are drawn anew in every
step from recorded poses (`--data DIR`) or made-up ones. Then one process of one thread and two of one
thread each take turns, and scikit-learn, torchgmm and the fit in memory take 20 steps over 100,000
states that they can hold, all from one start.
"""

import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median

import torch

from benchmarks._command import run_command
from benchmarks.speed._memory import MB
from benchmarks.speed._streamed_jobs import Job, Run, in_processes
from benchmarks.speed._timing import (
    Case,
    Report,
    Setup,
    Timing,
    begin,
    measure_limits,
    number,
    ratio,
    take_turns,
)
from benchmarks.speed.expectation_maximisation import (
    PACKAGES,
    TOLERANCE,
    Method,
    Problem,
    make_problem,
    mean_log_likelihood,
    scikit_learn_fit,
    torchgmm_fit,
    torchpose_fit,
    wide,
)
from torchpose.io._recordings import find_recordings
from torchpose.learning._samplers import TensorSource
from torchpose.learning._streamed_em import StreamedEM, run_streamed
from torchpose.math._mixture_em import MixtureParameters

MILLION = 1_000_000
STEPS, COMPONENTS = 20, 30
SAME = 1e-8  # of the log-likelihoods of one process and of two
AIM = 1.7
IDLE = 0.9  # share of both cores that has to be free for the two processes to mean anything
STREAMED = (
    "states", "processes x threads", "start s", "s/step", "s for 20 steps", "CPU s/step",
    "resident before MB", "peak MB", "log-likelihood",
)  # fmt: skip
SCALING = ("processes x threads", "states", "s/step", "min s/step", "CPU s/step", "x one process")
PEERS = (
    "method",
    "s",
    "s/(step, million states)",
    "CPU s",
    "x streamed",
    "CPU x",
    "log-likelihood",
)


def main(
    setup: Setup = Setup(runs=3), *, samples: int = 10 * MILLION, data: str | None = None
) -> None:
    """Run and print the tables.

    Args:
        setup: see `Setup`.
        samples: of the longest fit.
        data: folder of recordings, such as kinect_utd_mhad.
    """
    if data is not None:
        find_recordings([data])  # the processes read them, and missing ones are said before
    report = begin("EM over states that are not held in memory", setup)
    limits = measure_limits(setup.quick)
    failed = report_scaling(report, setup, data)
    failed |= report_streamed(report, setup, samples, data)
    failed |= report_peers(report, setup)
    report.close(PACKAGES, limits)
    if failed:
        sys.exit("results that should be the same are not")


# --- tables


def report_scaling(report: Report, setup: Setup, data: str | None) -> bool:
    """Time one process of one thread and two of one thread each, in turn; return True if they disagree."""
    samples, components = (20_000, 4) if setup.quick else (2 * MILLION, COMPONENTS)
    job = Job(samples, components, 3, data)
    idle = report_load(report, setup.quick)
    runs: dict[int, list[Run]] = {1: [], 2: []}
    for _ in range(setup.runs):
        for size, found in runs.items():
            found.append(in_processes(job._replace(size=size), setup.quick))
    gain = median(r.step for r in runs[1]) / median(r.step for r in runs[2])
    rows = []
    for found in runs.values():
        times = (
            median(r.step for r in found),
            min(r.best for r in found),
            median(r.cpu for r in found),
        )
        factor = gain if found[0].job.size == 2 else 1.0
        cells = [number(value) for value in (*times, factor)]
        rows.append([found[0].name, f"{samples:,}", *cells])
    report.table(SCALING, rows)
    text = f"Two processes of one thread are {gain:.2f} times as fast as one (aim {AIM})."
    if idle < IDLE:
        text += " The machine was busy, so this says little: repeat it when two cores are free."
    report.add(text)
    difference = abs(runs[1][0].log_likelihood - runs[2][0].log_likelihood)
    report.add(
        f"Agreement of one process and two after {job.steps - 1} steps: mean log-likelihoods differ by "
        f"{difference:.1e}, at most {SAME:g} allowed."
    )
    return not difference < SAME


def report_load(report: Report, quick: bool) -> float:
    """Report how busy the machine is before the runs, and return the share of it that is free."""
    before, seconds = _cpu_ticks(), 0.1 if quick else 2
    time.sleep(seconds)
    spent = [after - first for after, first in zip(_cpu_ticks(), before, strict=True)]
    idle = spent[0] / spent[1] if spent[1] else 1.0
    load = f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"
    report.add(
        f"Before the runs: load {load}, {100 * idle:.0f} % of {os.cpu_count()} cores idle over {seconds:g} s"
        f"{'' if idle >= IDLE else ' (BUSY)'}."
    )
    return idle


def _cpu_ticks() -> tuple[float, float]:
    """Return idle and all ticks of all cores so far."""
    try:
        fields = Path("/proc/stat").read_text().splitlines()[0].split()[1:]
    except OSError:
        return 0.0, 0.0
    ticks = [float(field) for field in fields]
    return ticks[3] + ticks[4], sum(ticks)


def report_streamed(report: Report, setup: Setup, samples: int, data: str | None) -> bool:
    """Time 20 steps over few and over many states; return True if one process and two disagree."""
    samples, components, steps = (20_000, 4, 3) if setup.quick else (samples, COMPONENTS, STEPS)
    threads = setup.threads
    jobs = [
        Job(samples // 10, components, steps, data, threads),
        Job(samples, components, steps, data, threads),
    ]
    if threads > 1:
        jobs.append(jobs[-1]._replace(threads=1, size=threads))
    report_load(report, setup.quick)
    runs = [in_processes(job, setup.quick) for job in jobs]
    report.table(STREAMED, (streamed_row(run) for run in runs))
    small, large = runs[0], runs[1]
    share = large.found[0]["drawing"] / large.cpu
    held = 8 * samples * 22 / MB
    report.add(
        f"Ten times the states take {large.peak - small.peak:+.0f} MB at the peak; in memory they would "
        f"be {held:,.0f} MB. Drawing the states is {100 * share:.0f} % of a step's CPU time."
    )
    if len(runs) < 3:
        return False
    difference = abs(runs[1].log_likelihood - runs[2].log_likelihood)
    report.add(
        f"Agreement of one process and {threads} after {steps - 1} steps: mean log-likelihoods differ "
        f"by {difference:.1e}, at most {SAME:g} allowed."
    )
    return not difference < SAME


def streamed_row(run: Run) -> list[str]:
    first = run.found[0]
    return [
        f"{run.job.samples:,}", run.name, number(first["start"]), number(run.step),
        number(sum(first["steps"]) * STEPS / run.job.steps), number(run.cpu),
        f"{max(r['before'] for r in run.found) / MB:.0f}", f"{run.peak:.0f}",
        f"{run.log_likelihood:.6f}",
    ]  # fmt: skip


# --- peers


def report_peers(report: Report, setup: Setup) -> bool:
    """Time steps over states that all methods can hold; return True if scikit-learn differs."""
    points, n_components, steps = (2000, 4, 3) if setup.quick else (100_000, COMPONENTS, STEPS)
    problem = make_problem(points, n_components, steps)
    report.add(
        f"{points:,} states, {n_components} components, {steps} steps from one start, "
        f"{setup.threads} threads. Nothing is extrapolated: the others hold states and "
        "responsibilities in memory."
    )
    methods = list(peer_methods(problem, report))
    found = {m.name: mean_log_likelihood(problem.x, wide(m.call())) for m in methods}
    timings = take_turns([Case(m.name, m.call) for m in methods], setup.runs, warm=0)
    report.table(PEERS, peer_rows(timings, found, problem))
    ours, theirs = found[methods[0].name], found.get("scikit-learn, float64")
    if theirs is None:
        report.add("Agreement: scikit-learn cannot be imported, nothing to compare with.")
        return False
    report.add(
        f"Agreement of the streamed fit and scikit-learn: mean log-likelihoods differ by "
        f"{abs(ours - theirs):.1e}, at most {TOLERANCE:g} allowed."
    )
    return not abs(ours - theirs) < TOLERANCE


def peer_methods(problem: Problem, report: Report) -> Iterator[Method]:
    """Yield the streamed fit, the fit in memory, and every peer that can be imported."""
    for dtype in (torch.float64, torch.float32):
        yield streamed_fit(problem, dtype)
    in_memory = torchpose_fit(problem, torch.float64)
    yield in_memory._replace(name="in memory, float64")
    peers: dict[str, Callable[[Problem], Method]] = {
        "scikit-learn": scikit_learn_fit, "torchgmm": torchgmm_fit
    }  # fmt: skip
    for name, make in peers.items():
        try:
            yield make(problem)
        except ImportError as error:
            report.leave_out(name, error)


def streamed_fit(problem: Problem, dtype: torch.dtype) -> Method:
    source, n_components = TensorSource(problem.x), len(problem.start.weights)

    def call() -> MixtureParameters:
        em = StreamedEM.start(source, n_components, init=problem.start, dtype=dtype)
        run_streamed(em, source, max_iter=problem.iterations, tol=0.0)
        return em.mixture().parameters_tuple()

    return Method(f"streamed, {str(dtype).split('.')[1]}", call)


def peer_rows(
    timings: list[Timing], found: dict[str, float], problem: Problem
) -> Iterator[list[str]]:
    for timing in timings:
        each = timing.median / problem.iterations / len(problem.x) * MILLION
        cells = (timing.median, each, timing.median_cpu, *ratio(timing, timings[0]))
        likelihood = f"{found[timing.case.name]:.6f}"
        yield [timing.case.name, *(number(cell) for cell in cells), likelihood]


if __name__ == "__main__":
    run_command(main)
