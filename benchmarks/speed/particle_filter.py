"""Time per step of the particle filters, beside plain NumPy, other libraries and the floor.

    python -m benchmarks.speed.particle_filter --particles 10000 --steps 20 --threads 2

Two models: the arm of Burke & Lasenby (21 dimensions, 30 components, 8 of them measured; synthetic, or
a prior given by --prior), against their algorithm as a NumPy loop over components; and a random walk
without a prior, which the libraries `particles`, `cuthbert` and `torchfilter` can express as well,
where they are installed. Runs of all methods take turns, so that other work on the machine hits all.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks._command import run_command
from benchmarks.speed._arm import DIM, PROCESS, released_prior
from benchmarks.speed._particle_peers import (
    Problem,
    cuthbert_walk,
    numpy_mixture,
    numpy_walk,
    particles_walk,
    torchfilter_walk,
)
from benchmarks.speed._timing import Case, Report, Setup, begin, number, take_turns
from torchpose.filters import BootstrapParticleFilter, make_transition
from torchpose.filters._walk import MixtureWalk
from torchpose.priors import GaussianMixture

PACKAGES = ("numpy", "particles", "cuthbert", "torchfilter")
NOISE = [9.0] * 8
MEASURED = [9, 10, 0, 1, 12, 13, 3, 4]  # u, v of head, hand, neck, elbow


def main(
    setup: Setup = Setup(runs=7),
    *,
    particles: int = 10_000,
    steps: int = 20,
    prior: Path | None = None,
    no_peers: bool = False,
) -> None:
    """Run and print the tables.

    Args:
        setup: see `Setup`.
        particles: of each filter.
        steps: frames of a run.
        prior: .npz with left_weights, left_means, ....
        no_peers: leave out the other libraries.
    """
    report = begin("Particle filters: one step", setup)
    n, steps = (200, 3) if setup.quick else (particles, steps)
    problem = arm_problem(prior, steps)
    add_table(report, f"arm, {n} particles", arm_rows(problem, n), setup.runs, steps)
    report.add(floor_text(problem, n))
    report.add(density_error_text(problem))
    if not no_peers:
        shared = walk_problem(steps)
        report.add(f"Random walk without a prior, exact log-evidence {exact_evidence(shared):.2f}.")
        rows = walk_rows(shared, n, report)
        add_table(report, f"random walk, {n} particles", rows, setup.runs, steps)
    report.close(PACKAGES)


# --- problems


def arm_problem(path: Path | None, n_steps: int) -> Problem:
    """Return the arm model, and measurements of a path drawn from it."""
    prior = synthetic_prior() if path is None else released_prior(path)
    process = torch.tensor(PROCESS, dtype=torch.float64)
    g = torch.Generator().manual_seed(1)
    parts = make_transition("paper", prior.means, prior.covariances, torch.diag(process))
    k = int(prior.weights.argmax())
    x, z = prior.means[k], []
    for _ in range(n_steps):
        noise = torch.linalg.cholesky(parts.noise[k]) @ torch.randn(DIM, generator=g).double()
        x = parts.matrix[k] @ x + parts.offset[k] + noise
        z.append(x[MEASURED] + 3 * torch.randn(len(MEASURED), generator=g).double())
    return Problem(prior, process, torch.tensor(NOISE), MEASURED, torch.stack(z))


def synthetic_prior(n_components: int = 30) -> GaussianMixture:
    """Return thirty components with the scales of an arm: pixels beside metres and radians."""
    g = torch.Generator().manual_seed(0)
    scale = torch.tensor([120.0, 90.0, 0.4] * 5 + [0.1] * 3 + [0.2] * 3, dtype=torch.float64)
    low = torch.randn(n_components, DIM, 8, generator=g).double() / 8**0.5
    covs = 0.1 * (low @ low.mT + 1e-4 * torch.eye(DIM)) * scale[:, None] * scale
    centre = torch.tensor([320.0, 240.0, 2.0] * 5 + [0.0] * 6, dtype=torch.float64)
    means = centre + torch.randn(n_components, DIM, generator=g).double() * scale
    weights = torch.rand(n_components, generator=g).double() + 0.2
    return GaussianMixture(weights / weights.sum(), means, covs)


def walk_problem(n_steps: int) -> Problem:
    """Return the random walk x_t = x_{t-1} + N(0, Q) from N(0, I), with 8 of 21 dimensions measured.

    Its prior is too wide to matter.
    """
    g = torch.Generator().manual_seed(2)
    a = 0.05 * torch.randn(DIM, DIM, generator=g).double()
    process = a @ a.mT + 0.01 * torch.eye(DIM)
    factor, x, z = torch.linalg.cholesky(process), torch.zeros(DIM).double(), []
    for _ in range(n_steps):
        x = x + factor @ torch.randn(DIM, generator=g).double()
        z.append(x[:8] + 0.5**0.5 * torch.randn(8, generator=g).double())
    one = torch.ones(1, dtype=torch.float64)
    prior = GaussianMixture(one, torch.zeros(1, DIM).double(), 1e6 * torch.eye(DIM).double()[None])
    return Problem(prior, process, torch.full((8,), 0.5), list(range(8)), torch.stack(z))


def exact_evidence(problem: Problem) -> float:
    """Return log p(z_1:T) of the random walk by the Kalman filter."""
    process, z = problem.process.numpy(), problem.z.numpy()
    h, noise = np.eye(DIM)[problem.observed], np.diag(problem.noise.numpy())
    m, p, total = np.zeros(DIM), np.eye(DIM), 0.0
    for y in z:
        p = p + process
        s, e = h @ p @ h.T + noise, y - h @ m
        quad, log_det = e @ np.linalg.solve(s, e), np.linalg.slogdet(s)[1]
        total -= 0.5 * (quad + log_det + len(y) * math.log(2 * math.pi))
        gain = np.linalg.solve(s, h @ p).T
        m, p = m + gain @ e, p - gain @ s @ gain.T
    return total


# --- methods: each is a call that filters all steps once and returns the log-evidence


def ours(problem: Problem, **options: Any) -> Callable[[], float]:
    g = torch.Generator().manual_seed(0)
    tracker = BootstrapParticleFilter(*problem[:4], **options)

    def run() -> float:
        return float(tracker(problem.z[None], generator=g).log_evidence.sum())

    return run


def arm_rows(problem: Problem, n: int) -> dict[str, Callable[[], float]]:
    rows = {
        f"torchpose, {proposal}": ours(problem, proposal=proposal, n_particles=n)
        for proposal in ("mixture", "random-walk", "random-walk-unscaled")
    }
    rows["torchpose, mixture, float64"] = ours(problem, n_particles=n, dtype=torch.float64)
    rows["NumPy, mixture (BL 14, 23)"] = numpy_mixture(problem, n)
    rows["NumPy, random-walk (BL 26)"] = numpy_walk(problem, n)
    return rows


def walk_rows(problem: Problem, n: int, report: Report) -> dict[str, Callable[[], float]]:
    start = {"n_particles": n, "initial_cov": torch.eye(DIM)}
    rows = {
        "torchpose, mixture of one": ours(problem, **start),
        "torchpose, random-walk": ours(problem, proposal="random-walk", **start),
    }
    for name, make in (
        ("particles", particles_walk),
        ("cuthbert (jit)", cuthbert_walk),
        ("torchfilter", torchfilter_walk),
    ):
        try:
            rows[name] = make(problem, n)
        except ImportError as error:
            report.leave_out(name, error)
    return rows


# --- tables


def add_table(
    report: Report, title: str, calls: dict[str, Callable[[], float]], runs: int, steps: int
) -> None:
    """Add the milliseconds of a step of every method, and the log-evidence of its first run."""
    evidence = {name: call() for name, call in calls.items()}  # warms up as well
    cases = [Case(name, call, steps) for name, call in calls.items()]
    timings = take_turns(cases, runs, warm=0)
    header = (title, "median ms", "min ms", "CPU ms", "ratio", "log-evidence")
    rows = [
        (
            t.case.name, *t.milliseconds,
            number(t.median / timings[0].median), f"{evidence[t.case.name]:.2f}",
        )
        for t in timings
    ]  # fmt: skip
    report.table(header, rows)
    report.add("Per step; ratio to the first row.")


def floor_text(problem: Problem, n: int) -> str:
    """Return the floor in words: drawing the noise, and one product of all residuals, in cache."""
    k = problem.prior.n_components
    rows, points = torch.randn(k * DIM, DIM + 1), torch.randn(DIM + 1, 512)
    out = torch.empty(k * DIM, 512)

    def products() -> None:
        for _ in range(math.ceil(n / 512)):
            torch.mm(rows, points, out=out)

    cases = [Case("noise", lambda: torch.randn(n, DIM)), Case("products", products)]
    noise, product = (1e3 * timing.best for timing in take_turns(cases, 20))
    flops = 2e-6 * n * k * DIM * (DIM + 1)
    return (
        f"Floor: {noise:.2f} ms for {n * DIM:,} normal numbers, {product:.2f} ms for the residuals "
        f"({flops:.0f} MFLOP, {flops / product:.0f} GFLOP/s)."
    )


def density_error_text(problem: Problem) -> str:
    """Return the largest error of the float32 log density on draws of the prior, in words."""
    covariance = torch.diag(problem.process)
    walk = MixtureWalk(problem.prior.parameters_tuple(), covariance, torch.float32)
    wide = MixtureWalk(problem.prior.parameters_tuple(), covariance, torch.float64)
    x = problem.prior.sample((5000,), generator=torch.Generator().manual_seed(3))
    white = walk.whiten(x)
    pairs = zip(
        walk.log_prior_and_evidence(white), wide.log_prior_and_evidence(white.double()), strict=True
    )
    phi, evidence = (float((a - b).abs().max()) for a, b in pairs)
    return f"Largest error of the log density in float32: prior {phi:.1e}, evidence {evidence:.1e}."


if __name__ == "__main__":
    run_command(main)
