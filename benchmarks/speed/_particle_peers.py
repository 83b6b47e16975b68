"""The peers of `benchmarks.speed.particle_filter`: the paper's algorithm in NumPy, and other libraries.

Each is a call that filters all steps once and returns the log-evidence.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch

from benchmarks.speed._arm import DIM
from torchpose.filters import make_transition
from torchpose.priors import GaussianMixture


class Problem(NamedTuple):
    """A prior, its noise, and measurements z [T, Z]."""

    prior: GaussianMixture
    process: torch.Tensor
    noise: torch.Tensor
    observed: list[int]
    z: torch.Tensor


def component_log_density(x: np.ndarray, means: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Return log N(x | mu_i, L_i L_i^T), [N, K], computed component by component."""
    out = np.empty((len(x), len(means)))
    for i, (mean, factor) in enumerate(zip(means, factors, strict=True)):
        white = np.linalg.solve(factor, (x - mean).T)
        out[:, i] = -0.5 * (white**2).sum(0) - np.log(np.diag(factor)).sum()
    return out - 0.5 * DIM * math.log(2 * math.pi)


def log_sum_exp(a: np.ndarray) -> np.ndarray:
    top = a.max(-1, keepdims=True)
    return np.log(np.exp(a - top).sum(-1)) + top.squeeze(-1)


def systematic(weights: np.ndarray, u: float) -> np.ndarray:
    n = len(weights)
    edges = np.cumsum(weights)
    return np.searchsorted(edges / edges[-1], (np.arange(n) + u) / n).clip(max=n - 1)


def likelihood(problem: Problem, x: np.ndarray, z: np.ndarray) -> np.ndarray:
    noise = problem.noise.numpy()
    residual = x[:, problem.observed] - z
    return -0.5 * (residual**2 / noise + np.log(2 * math.pi * noise)).sum(1)


def numpy_model(problem: Problem) -> tuple[np.ndarray, ...]:
    """Return log pi, mu, Cholesky factors of Sigma and of Q + Sigma, and Q."""
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
