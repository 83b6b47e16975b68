"""How much memory does a large batch of sequences need beyond its inputs and outputs?

    python -m benchmarks.speed.batch_memory --threads 2

1,000 sequences of 1,000 frames through the fixed-track filter, and a smaller batch with covariances.
Each case runs in a process of its own and reports the peak of its resident memory while the filter
works; gains and libraries are loaded before, by a short run.
"""

import sys
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

from benchmarks._command import run_command
from benchmarks.speed._memory import MB, forget_peak, peak_resident, resident, return_free_memory
from benchmarks.speed._new_process import call_in_new_process
from benchmarks.speed._timing import Setup, begin, number

TOLERANCE = 1e-10
_MODULE = "benchmarks.speed.batch_memory"
HEADER = ("case", "B", "T", "inputs MB", "outputs MB", "beyond MB", "beyond/outputs", "frames/s")


class Size(NamedTuple):
    """Sequences, frames, and whether covariances are returned."""

    batch: int
    frames: int
    covariances: bool


def main(setup: Setup = Setup()) -> None:
    """Run and print the table."""
    report = begin("Memory of a batch of sequences", setup)
    sizes = [Size(1000, 1000, False), Size(100, 1000, False), Size(100, 1000, True)]
    if setup.quick:
        sizes = [Size(8, 200, True)]
    found = [call_in_new_process(setup.threads, _MODULE, measure.__name__, *size) for size in sizes]
    report.table(HEADER, table_rows(sizes, found))
    worst = max(result["error"] for result in found)
    report.add(
        "Agreement of a sequence in the batch with the same sequence alone: largest |difference| of the "
        f"means / max(|mean|, 1) {worst:.1e}, at most {TOLERANCE:g} allowed."
    )
    report.add(
        "Outputs: means, weights, evidence and covariances as returned. Beyond: the peak of resident "
        "memory while the filter works, less what was resident before and less the outputs."
    )
    report.close()
    if not worst < TOLERANCE:
        sys.exit("a sequence comes out differently in a batch")


def measure(batch: int, frames: int, covariances: bool) -> dict[str, Any]:
    """Filter once; return bytes of inputs, outputs and the peak beyond both, seconds and the error."""
    import torch

    from benchmarks.speed._arm import draw_sequences, make_filter, make_problem

    problem = make_problem()
    tracker = make_filter(problem)
    z = draw_sequences(problem, batch, frames)
    with torch.inference_mode():
        tracker(z[:2], return_cov=covariances)
        return_free_memory()
        before = resident()
        forget_peak()
        start = time.perf_counter()
        out = tracker(z, return_cov=covariances)
        seconds, peak = time.perf_counter() - start, peak_resident()
        parts = [out.mean, out.log_weights, out.log_evidence, out.failed_at]
        parts += [] if out.cov is None else [out.cov]
        outputs = sum(part.numel() * part.element_size() for part in parts)
        alone, inside = tracker(z[-1:]).mean[0], out.mean[-1]
        error = float(((inside - alone).abs() / alone.abs().clamp_min(1)).max())
    beyond = peak - before - outputs
    numbers = {"inputs": z.nbytes, "outputs": outputs, "beyond": beyond}
    return {**numbers, "seconds": seconds, "error": error}


def table_rows(sizes: list[Size], found: list[dict[str, Any]]) -> Iterator[list[str]]:
    for size, result in zip(sizes, found, strict=True):
        name = "fixed tracks, covariances too" if size.covariances else "fixed tracks"
        cells = [f"{result[key] / MB:.1f}" for key in ("inputs", "outputs", "beyond")]
        rate = number(size.batch * size.frames / result["seconds"])
        share = number(result["beyond"] / result["outputs"])
        yield [name, str(size.batch), str(size.frames), *cells, share, rate]


if __name__ == "__main__":
    run_command(main)
