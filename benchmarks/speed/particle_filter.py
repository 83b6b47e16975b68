"""Time per step of the particle filters, beside plain NumPy, other libraries and the floor.

    python -m benchmarks.speed.particle_filter --particles 10000 --steps 20 --threads 2

Two models: the arm of Burke & Lasenby (21 dimensions, 30 components, 8 of them measured; synthetic, or
a prior given by --prior), against their algorithm as a NumPy loop over components; and a random walk
without a prior, which the libraries `particles`, `cuthbert` and `torchfilter` can express as well,
where they are installed. Runs of all methods take turns, so that other work on the machine hits all.
"""

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from benchmarks.speed._arm import DIM, PROCESS, released_prior
from benchmarks.speed._timing import Case, Report, begin, number, parser, take_turns
from torchpose.filters import BootstrapParticleFilter, make_transition
from torchpose.filters._walk import MixtureWalk
from torchpose.priors import GaussianMixture

PACKAGES = ("numpy", "particles", "cuthbert", "torchfilter")
NOISE = [9.0] * 8
MEASURED = [9, 10, 0, 1, 12, 13, 3, 4]  # u, v of head, hand, neck, elbow


class Problem(NamedTuple):
    """A prior, its noise, and measurements z [T, Z]."""

    prior: GaussianMixture
    process: torch.Tensor
    noise: torch.Tensor
    observed: list[int]
    z: torch.Tensor


def main() -> None:
    args, report = begin("Particle filters: one step", options())
    n, steps = (200, 3) if args.quick else (args.particles, args.steps)
    problem = arm_problem(args.prior, steps)
    add_table(report, f"arm, {n} particles", arm_rows(problem, n), args.runs, steps)
    report.add(floor_text(problem, n))
    report.add(density_error_text(problem))
    if not args.no_peers:
        shared = walk_problem(steps)
        report.add(f"Random walk without a prior, exact log-evidence {exact_evidence(shared):.2f}.")
        rows = walk_rows(shared, n, report)
        add_table(report, f"random walk, {n} particles", rows, args.runs, steps)
    report.close(PACKAGES)


def options() -> argparse.ArgumentParser:
    made = parser(__doc__, runs=7)
    made.add_argument("--particles", type=int, default=10_000)
    made.add_argument("--steps", type=int, default=20, help="frames of a run")
    made.add_argument("--prior", type=Path, help=".npz with left_weights, left_means, ...")
    made.add_argument("--no-peers", action="store_true", help="leave out the other libraries")
    return made


# --- problems


def arm_problem(path: Path | None, n_steps: int) -> Problem:
    """The arm model, and measurements of a path drawn from it."""
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
    """Thirty components with the scales of an arm: pixels beside metres and radians."""
    g = torch.Generator().manual_seed(0)
    scale = torch.tensor([120.0, 90.0, 0.4] * 5 + [0.1] * 3 + [0.2] * 3, dtype=torch.float64)
    low = torch.randn(n_components, DIM, 8, generator=g).double() / 8**0.5
    covs = 0.1 * (low @ low.mT + 1e-4 * torch.eye(DIM)) * scale[:, None] * scale
    centre = torch.tensor([320.0, 240.0, 2.0] * 5 + [0.0] * 6, dtype=torch.float64)
    means = centre + torch.randn(n_components, DIM, generator=g).double() * scale
    weights = torch.rand(n_components, generator=g).double() + 0.2
    return GaussianMixture(weights / weights.sum(), means, covs)


def walk_problem(n_steps: int) -> Problem:
    """x_t = x_{t-1} + N(0, Q) from N(0, I), 8 of 21 dimensions measured; a prior too wide to matter."""
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
    """log p(z_1:T) of the random walk by the Kalman filter."""
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
            report.add(f"{name}: not installed ({error.name}).")
    return rows


def component_log_density(x: np.ndarray, means: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """log N(x | mu_i, L_i L_i^T), [N, K], one component after the other."""
    out = np.empty((len(x), len(means)))
    for i, (mean, factor) in enumerate(zip(means, factors, strict=True)):
        white = np.linalg.solve(factor, (x - mean).T)
        out[:, i] = -0.5 * (white**2).sum(0) - np.log(np.diag(factor)).sum()
    return out - 0.5 * DIM * math.log(2 * math.pi)


def log_sum_exp(a: np.ndarray, axis: int = -1) -> np.ndarray:
    top = a.max(axis, keepdims=True)
    return np.log(np.exp(a - top).sum(axis)) + top.squeeze(axis)


def systematic(weights: np.ndarray, u: float) -> np.ndarray:
    n = len(weights)
    edges = np.cumsum(weights)
    return np.searchsorted(edges / edges[-1], (np.arange(n) + u) / n).clip(max=n - 1)


def likelihood(problem: Problem, x: np.ndarray, z: np.ndarray) -> np.ndarray:
    noise = problem.noise.numpy()
    residual = x[:, problem.observed] - z
    return -0.5 * (residual**2 / noise + np.log(2 * math.pi * noise)).sum(1)


def numpy_model(problem: Problem) -> tuple[np.ndarray, ...]:
    """log pi, mu, Cholesky factors of Sigma and of Q + Sigma, Q."""
    process = np.diag(problem.process.numpy())
    covs = problem.prior.covariances.numpy()
    factors = np.linalg.cholesky(covs), np.linalg.cholesky(covs + process)
    return np.log(problem.prior.weights.numpy()), problem.prior.means.numpy(), *factors, process


def numpy_mixture(problem: Problem, n: int) -> Callable[[], float]:
    rng = np.random.default_rng(0)
    log_pi, means, _, wide, process = numpy_model(problem)
    parts = make_transition(
        "paper", problem.prior.means, problem.prior.covariances, torch.tensor(process)
    )
    matrix, offset = parts.matrix.numpy(), parts.offset.numpy()
    factor = torch.linalg.cholesky(parts.noise).numpy()

    def move(x: np.ndarray) -> np.ndarray:
        logits = component_log_density(x, means, wide) + log_pi
        edges = np.cumsum(np.exp(logits - logits.max(1, keepdims=True)), 1)
        chosen = (edges < rng.random((n, 1)) * edges[:, -1:]).sum(1)
        new = np.empty_like(x)
        for i in range(len(means)):
            rows = chosen == i
            noise = rng.standard_normal((int(rows.sum()), DIM))
            new[rows] = x[rows] @ matrix[i].T + offset[i] + noise @ factor[i].T
        return new

    def run() -> float:
        x = problem.prior.sample((n,)).numpy()
        total, log_weights = 0.0, np.full(n, -math.log(n))
        for z in problem.z.numpy():
            x, log_weights = numpy_resample(rng, x, log_weights)
            x = move(x)
            log_weights = log_weights + likelihood(problem, x, z)
            increment = float(log_sum_exp(log_weights))
            total, log_weights = total + increment, log_weights - increment
        return total

    return run


def numpy_resample(
    rng: np.random.Generator, x: np.ndarray, log_weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    weights = np.exp(log_weights)
    n = len(weights)
    if 1 / (weights**2).sum() >= n / 2:
        return x, log_weights
    return x[systematic(weights, rng.random())], np.full(n, -math.log(n))


def numpy_walk(problem: Problem, n: int) -> Callable[[], float]:
    rng = np.random.default_rng(0)
    log_pi, means, narrow, wide, process = numpy_model(problem)
    step = np.linalg.cholesky(process)

    def run() -> float:
        x = problem.prior.sample((n,)).numpy()
        total, log_weights = 0.0, np.full(n, -math.log(n))
        for z in problem.z.numpy():
            x, log_weights = numpy_resample(rng, x, log_weights)
            evidence = log_sum_exp(component_log_density(x, means, wide) + log_pi)
            x = x + rng.standard_normal((n, DIM)) @ step.T
            prior = log_sum_exp(component_log_density(x, means, narrow) + log_pi)
            predicted = log_weights + prior - evidence
            predicted -= log_sum_exp(predicted)
            log_weights = predicted + likelihood(problem, x, z)
            increment = float(log_sum_exp(log_weights))
            total, log_weights = total + increment, log_weights - increment
        return total

    return run


def particles_walk(problem: Problem, n: int) -> Callable[[], float]:
    import particles
    from particles import distributions as d
    from particles import state_space_models as ssm

    process, noise = problem.process.numpy(), np.diag(problem.noise.numpy()).astype(float)

    class Walk(ssm.StateSpaceModel):
        def PX0(self) -> Any:
            return d.MvNormal(loc=np.zeros(DIM), cov=np.eye(DIM) + process)

        def PX(self, t: int, xp: np.ndarray) -> Any:
            return d.MvNormal(loc=xp, cov=process)

        def PY(self, t: int, xp: np.ndarray, x: np.ndarray) -> Any:
            return d.MvNormal(loc=x[:, problem.observed], cov=noise)

    def run() -> float:
        model = ssm.Bootstrap(ssm=Walk(), data=problem.z.numpy())
        filter_ = particles.SMC(fk=model, N=n, resampling="systematic", ESSrmin=0.5)
        filter_.run()
        return float(filter_.logLt)

    return run


def cuthbert_walk(problem: Problem, n: int) -> Callable[[], float]:
    import jax
    from cuthbert import filter as run_filter
    from cuthbert.smc import particle_filter
    from cuthbertlib.resampling import systematic as resampling

    step = jax.numpy.asarray(np.linalg.cholesky(problem.process.numpy()), "float32")
    index = jax.numpy.asarray(problem.observed)
    noise = jax.numpy.asarray(problem.noise.numpy(), "float32")
    constant = -0.5 * float(np.log(2 * math.pi * problem.noise.numpy()).sum())
    model = particle_filter.build_filter(
        lambda key: jax.random.normal(key, (DIM,)),
        lambda key, x, inputs: x + step @ jax.random.normal(key, (DIM,)),
        lambda before, x, y: constant - 0.5 * ((x[index] - y) ** 2 / noise).sum(),
        n,
        resampling.resampling,
    )
    z = jax.numpy.asarray(problem.z.numpy(), "float32")

    @jax.jit
    def filtered(key: Any) -> Any:
        start = model.init_prepare(key=jax.random.fold_in(key, 1))
        return run_filter(model, z, start, key=key).log_normalizing_constant[-1]

    key = jax.random.key(0)
    return lambda: float(filtered(key))


def torchfilter_walk(problem: Problem, n: int) -> Callable[[], float]:
    import torchfilter

    step = torch.linalg.cholesky(problem.process).float()
    noise = problem.noise.float()
    z = problem.z.float()

    class Dynamics(torchfilter.base.DynamicsModel):
        def __init__(self) -> None:
            super().__init__(state_dim=DIM)

        def forward(self, *, initial_states: Any, controls: Any) -> Any:
            return initial_states, step.expand(len(initial_states), DIM, DIM)

    class Measure(torchfilter.base.ParticleFilterMeasurementModel):
        def __init__(self) -> None:
            super().__init__(state_dim=DIM)

        def forward(self, *, states: Any, observations: Any) -> Any:
            residual = states[..., problem.observed] - observations[:, None]
            return -0.5 * (residual.square() / noise).sum(-1)

    tracker = torchfilter.filters.ParticleFilter(
        dynamics_model=Dynamics(), measurement_model=Measure(), num_particles=n
    ).eval()

    @torch.no_grad()
    def run() -> float:
        tracker.initialize_beliefs(mean=torch.zeros(1, DIM), covariance=torch.eye(DIM)[None])
        for y in z:
            tracker(observations=y[None], controls=torch.zeros(1, 1))
        return math.nan

    return run


# --- tables


def add_table(
    report: Report, title: str, calls: dict[str, Callable[[], float]], runs: int, steps: int
) -> None:
    """Milliseconds of a step of every method, and the log-evidence of its first run."""
    evidence = {name: call() for name, call in calls.items()}  # warms up as well
    cases = [Case(name, call, steps) for name, call in calls.items()]
    timings = take_turns(cases, runs, warm=0)
    header = (title, "median ms", "min ms", "CPU ms", "ratio", "log-evidence")
    rows = [
        (
            t.case.name, *(number(1e3 * value) for value in (t.median, t.best, t.median_cpu)),
            number(t.median / timings[0].median), f"{evidence[t.case.name]:.2f}",
        )
        for t in timings
    ]  # fmt: skip
    report.table(header, rows)
    report.add("Per step; ratio to the first row.")


def floor_text(problem: Problem, n: int) -> str:
    """What no arrangement avoids: the noise, and one product of all residuals, in cache."""
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
    """Largest error of the float32 log density against float64, on draws of the prior."""
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
    main()
