"""Options, timing in turns, limits of the machine, and tables that the benchmarks of speed share.

Methods take turns (A B A B), so that other work on the machine hits all of them, and ratios are of
medians from one run. CPU time stands beside wall time: on a machine that is not idle, the CPU time of
a run with one thread is the figure to compare, since waiting for a core does not count.
"""

import contextlib
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from benchmarks._table_file import TableFile, save_text

THREAD_VARIABLES = ("OMP", "MKL", "OPENBLAS", "NUMBA")


class Setup(NamedTuple):
    """The options that benchmarks of speed share.

    Attributes:
        threads: cores for every library.
        runs: timed runs of each method.
        quick: a tiny problem, to see that it runs.
        out: file for the same as Markdown, or a folder.
    """

    threads: int = 2
    runs: int = 1
    quick: bool = False
    out: TableFile | None = None


class Case(NamedTuple):
    """One method under test.

    Attributes:
        name: as printed. call: one run, without arguments. units: frames, steps, ... of one call.
        inner: calls between two looks at the clock, for calls of less than about a millisecond.
    """

    name: str
    call: Callable[[], Any]
    units: float = 1
    inner: int = 1


class Timing(NamedTuple):
    """Seconds per unit of a case, one number for each run."""

    case: Case
    wall: list[float]
    cpu: list[float]

    @property
    def median(self) -> float:
        """Return the median wall time."""
        return statistics.median(self.wall)

    @property
    def best(self) -> float:
        """Return the smallest wall time."""
        return min(self.wall)

    @property
    def median_cpu(self) -> float:
        """Return the median CPU time of this process, over all of its threads."""
        return statistics.median(self.cpu)

    @property
    def milliseconds(self) -> list[str]:
        """Return median and best wall time, and the median CPU time, as cells of a table."""
        return [number(1e3 * seconds) for seconds in (self.median, self.best, self.median_cpu)]


class Ratio(NamedTuple):
    """How many times as long the peer takes, by wall time and by CPU time."""

    wall: float
    cpu: float


class Limits(NamedTuple):
    """What the machine can do: products of large matrices, copies, and the cost of one small call."""

    gflops_float64: float
    gflops_float32: float
    copy_gb: float
    call_us: float


def limit_threads(threads: int) -> None:
    """Pin every library to the same cores; to be called before peers are imported."""
    for name in THREAD_VARIABLES:
        os.environ[f"{name}_NUM_THREADS"] = str(threads)
    torch.set_num_threads(threads)
    with contextlib.suppress(AttributeError, OSError):
        # JAX sizes its pool by the cores that it may use.
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])
    with contextlib.suppress(ImportError):
        from threadpoolctl import threadpool_limits

        threadpool_limits(threads)


def begin(title: str, setup: Setup) -> "Report":
    """Pin every library to its cores, and return an empty report.

    Args:
        title: of the report. setup: of the benchmark.
    """
    limit_threads(setup.threads)
    return Report(title, setup.out, setup.threads)


def take_turns(cases: Sequence[Case], runs: int, warm: int = 1) -> list[Timing]:
    """Warm every case up, then time one run of each in turn, `runs` times over."""
    timings = [Timing(case, [], []) for case in cases]
    for case in cases:
        for _ in range(warm):
            case.call()
    for _ in range(runs):
        for timing in timings:
            _time_once(timing)
    return timings


def _time_once(timing: Timing) -> None:
    call, inner = timing.case.call, timing.case.inner
    wall, cpu = time.perf_counter(), time.process_time()
    for _ in range(inner):
        call()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    timing.wall.append(wall / inner / timing.case.units)
    timing.cpu.append(cpu / inner / timing.case.units)


def ratio(peer: Timing, ours: Timing) -> Ratio:
    """Return the ratio of the medians per unit."""
    return Ratio(peer.median / ours.median, peer.median_cpu / max(ours.median_cpu, 1e-12))


def measure_limits(quick: bool) -> Limits:
    """Measure the rates from which floors are computed, each the best of several runs."""
    size, runs = (256, 3) if quick else (1536, 7)
    rates = []
    for dtype in (torch.float64, torch.float32):
        a, b = torch.randn(2, size, size, dtype=dtype)
        product = Case("product", lambda a=a, b=b: a @ b)  # type: ignore[misc]
        rates.append(2e-9 * size**3 / take_turns([product], runs)[0].best)
    source = torch.randn((1 if quick else 32) * 2**20, dtype=torch.float64)
    target = torch.empty_like(source)
    copy = take_turns([Case("copy", lambda: target.copy_(source))], runs)[0].best
    one = torch.ones(1)
    call = take_turns([Case("call", lambda: one + one, inner=2000)], runs)[0].best
    return Limits(rates[0], rates[1], 2e-9 * source.nbytes / copy, 1e6 * call)


def limits_line(limits: Limits) -> str:
    """Return the limits of the machine as one line."""
    return (
        f"This machine: {limits.gflops_float64:.0f} GFLOP/s in float64, "
        f"{limits.gflops_float32:.0f} in float32 (products of large matrices), "
        f"{limits.copy_gb:.0f} GB/s (copies, read and written), {limits.call_us:.2f} us for one small call."
    )


def machine_line(threads: int, packages: Iterable[str] = ()) -> str:
    """Return processor, cores, versions, threads and load as one line that does not name the machine."""
    versions = [f"Python {platform.python_version()}", f"torch {torch.__version__}"]
    versions += [f"{name} {found}" for name in packages if (found := _version(name))]
    load = f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"
    return (
        f"{processor_model()}, {os.cpu_count()} cores, {threads} used; {', '.join(versions)}; "
        f"load {load}."
    )


def processor_model() -> str:
    """Return the processor's name, as far as the system tells."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return " ".join(line.split(":", 1)[1].split())
    return platform.processor() or platform.machine()


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table padded to equal widths; all columns but the first are aligned to the right."""
    table = [list(header), *(list(row) for row in rows)]
    widths = [max(len(row[i]) for row in table) for i in range(len(header))]
    lines = [_table_line(row, widths) for row in table]
    rule = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
    return "\n".join([lines[0], f"| {' | '.join(rule)} |", *lines[1:]])


def _table_line(row: Sequence[str], widths: Sequence[int]) -> str:
    first, *others = (
        cell.ljust(width) if i == 0 else cell.rjust(width)
        for i, (cell, width) in enumerate(zip(row, widths, strict=True))
    )
    return f"| {' | '.join([first, *others])} |"


def number(value: float, digits: int = 3) -> str:
    """Return a number with a few significant digits, without an exponent where it is not needed."""
    if value == 0 or not 1e-4 <= abs(value) < 1e7:
        return f"{value:.{digits - 1}e}" if value else "0"
    whole = len(str(int(abs(value)))) if abs(value) >= 1 else 0
    text = f"{value:,.{max(digits - whole, 0)}f}" if whole else f"{value:.{digits}g}"
    return text


class OperationCounter(TorchDispatchMode):
    """Counts the operations of torch that reach a kernel or make a view."""

    count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Count one operation, and run it."""
        self.count += 1
        return func(*args, **(kwargs or {}))


class Report:
    """Prints as it goes, and writes the same text as Markdown at the end if asked to."""

    def __init__(self, title: str, out: Path | None, threads: int) -> None:
        self.out, self.threads = out, threads
        self.parts: list[str] = []
        self.add(f"## {title}")

    def add(self, text: str) -> None:
        """Print and keep one paragraph or table."""
        print(text, end="\n\n", flush=True)
        self.parts.append(text)

    def leave_out(self, peer: str, error: ImportError) -> None:
        """Say that the rows of a peer are left out, and how it is installed."""
        self.add(
            f"{peer} cannot be imported ({error}): its rows are left out. benchmarks/README.md says how to "
            "install what torchpose is compared with."
        )

    def table(self, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        """Print and keep a Markdown table."""
        self.add(markdown_table(header, rows))

    def close(self, packages: Iterable[str] = (), limits: Limits | None = None) -> None:
        """Add a line about the machine, and write the file.

        Args:
            packages: whose versions are told. limits: of the machine, where they were measured.
        """
        if limits is not None:
            self.add(limits_line(limits))
        self.add(machine_line(self.threads, packages))
        save_text(self.out, "\n\n".join(self.parts) + "\n")
