"""How fast is one Kalman step of many filters at once, beside the Kalman filter libraries?

    python -m benchmarks.speed.kalman_step --threads 2

Predict, update and log-likelihood of 30 and of 256 filters, each with its own 21 x 21 transition and
noise; 8 of the 21 dimensions are measured. Peers are run where they can be imported; all take turns,
and every result is compared with a plain float64 computation that forms and inverts everything.
"""

import sys
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import torch

from benchmarks._command import run_command
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
from torchpose.math import kalman_predict, kalman_update

DIM, OBSERVED = 21, [0, 1, 3, 4, 9, 10, 12, 13]
SIZES = (30, 256)
TOLERANCE = 1e-10  # of |difference| / max(|truth|, 1) for torchpose in float64
HEADER = (
    "method", "filters", "ms", "min ms", "CPU ms", "x torchpose", "CPU x", "mean", "cov", "log-lik.",
)  # fmt: skip
PACKAGES = ("numpy", "filterpy", "simdkalman", "torch-kf", "dynamax", "jax")


class Problem(NamedTuple):
    """F, Q [B, D, D], H [Z, D], R [Z, Z], mean [B, D], covariance [B, D, D], z [Z]."""

    F: np.ndarray
    Q: np.ndarray
    H: np.ndarray
    R: np.ndarray
    mean: np.ndarray
    cov: np.ndarray
    z: np.ndarray


class Step(NamedTuple):
    """What a step returns: mean [B, D], covariance [B, D, D], log-likelihood [B] or None."""

    mean: Any
    cov: Any
    log_likelihood: Any = None


class Method(NamedTuple):
    """A method: `call` is timed, `result` turns what it returns into a `Step`."""

    name: str
    call: Callable[[], Any]
    result: Callable[[Any], Step] = lambda out: Step(*out)


def main(setup: Setup = Setup(runs=15)) -> None:
    """Run and print the tables."""
    report = begin("One Kalman step, 21 dimensions, 8 measured", setup)
    sizes, inner = ((8,), 1) if setup.quick else (SIZES, 50)
    limits, failed = measure_limits(setup.quick), False
    rows: list[list[str]] = []
    for n_filters in sizes:
        problem = make_problem(n_filters)
        methods = make_methods(problem, report, quiet=n_filters != sizes[0])
        truth = true_step(problem)
        errors = [error_of(method, truth) for method in methods]
        worst = max(errors[0])
        report.add(
            f"Agreement of torchpose (float64, {n_filters} filters) with plain inverses: {worst:.1e} of "
            f"max(|truth|, 1), at most {TOLERANCE:g} allowed."
        )
        failed |= not worst < TOLERANCE
        cases = [Case(m.name, m.call, 1, inner if fast(m) else 1) for m in methods]
        timings = take_turns(cases, setup.runs, warm=3)
        rows += table_rows(timings, errors, n_filters)
        rows.append(floor_row(n_filters, limits))
    report.table(HEADER, rows)
    report.add("mean, cov, log-lik.: largest |difference| / max(|truth|, 1).")
    report.close(PACKAGES, limits)
    if failed:
        sys.exit("torchpose differs from the plain computation by more than is allowed")


def fast(method: Method) -> bool:
    return "loop" not in method.name


def make_problem(n_filters: int) -> Problem:
    """Draw stable random systems."""
    rng = np.random.default_rng(0)
    transition = np.eye(DIM) + 0.01 * rng.standard_normal((n_filters, DIM, DIM))
    noise = 0.01 * np.eye(DIM) * rng.uniform(0.5, 2, (n_filters, 1, 1))
    root = rng.standard_normal((n_filters, DIM, DIM)) / 5
    cov = root @ root.transpose(0, 2, 1) + np.eye(DIM)
    mean, z = rng.standard_normal((n_filters, DIM)), rng.standard_normal(len(OBSERVED))
    measurement_cov = 0.05 * np.eye(len(OBSERVED))
    return Problem(transition, noise, np.eye(DIM)[OBSERVED], measurement_cov, mean, cov, z)


def true_step(problem: Problem) -> Step:
    """Return the step by the textbook's formulas in float64 NumPy."""
    F, Q, H, R, mean, cov, z = problem
    mean = np.einsum("bij,bj->bi", F, mean)
    cov = F @ cov @ F.transpose(0, 2, 1) + Q
    innovation = z - mean @ H.T
    S = H @ cov @ H.T + R
    inverse = np.linalg.inv(S)
    gain = cov @ H.T @ inverse
    squared = np.einsum("bi,bij,bj->b", innovation, inverse, innovation)
    log_likelihood = -0.5 * (squared + np.linalg.slogdet(S)[1] + len(z) * np.log(2 * np.pi))
    mean = mean + np.einsum("bij,bj->bi", gain, innovation)
    return Step(mean, cov - gain @ S @ gain.transpose(0, 2, 1), log_likelihood)


# --- methods


def stack_steps(steps: Any) -> Step:
    """Return the steps of a loop over filters as one."""
    return Step(*(np.stack(parts) for parts in zip(*steps, strict=True)))


def make_methods(problem: Problem, report: Report, quiet: bool) -> list[Method]:
    """Return torchpose's methods, then every peer that can be imported."""
    methods = [torchpose_step(problem, torch.float64), torchpose_step(problem, torch.float32)]
    methods.append(numpy_loop(problem))
    for name, make in PEERS.items():
        try:
            methods += make(problem)
        except ImportError as error:
            if not quiet:
                report.leave_out(name, error)
    return methods


def torchpose_step(problem: Problem, dtype: torch.dtype) -> Method:
    F, Q, _, R, mean, cov, z = (torch.tensor(value, dtype=dtype) for value in problem)
    offset, observed = torch.zeros_like(mean), torch.tensor(OBSERVED)
    z = z.expand(len(mean), -1)

    @torch.inference_mode()
    def call() -> Any:
        predicted = kalman_predict(mean, cov, F, offset, Q)
        return kalman_update(*predicted, z, R, observed)

    return Method(f"torchpose, {str(dtype).split('.')[1]}", call)


def numpy_loop(problem: Problem) -> Method:
    F, Q, H, R, means, covs, z = problem
    constant = len(z) * np.log(2 * np.pi)

    def one(F: np.ndarray, Q: np.ndarray, mean: np.ndarray, cov: np.ndarray) -> Any:
        mean, cov = F @ mean, F @ cov @ F.T + Q
        cross = H @ cov
        S, e = cross @ H.T + R, z - H @ mean
        gain = np.linalg.solve(S, cross).T
        squared = e @ np.linalg.solve(S, e)
        log_likelihood = -0.5 * (squared + np.linalg.slogdet(S)[1] + constant)
        return mean + gain @ e, cov - gain @ cross, log_likelihood

    def call() -> Any:
        return [one(*parts) for parts in zip(F, Q, means, covs, strict=True)]

    return Method("NumPy loop, float64", call, stack_steps)


def filterpy_steps(problem: Problem) -> list[Method]:
    from filterpy.kalman import KalmanFilter

    filters = []
    for F, Q in zip(problem.F, problem.Q, strict=True):
        filters.append(KalmanFilter(DIM, len(OBSERVED)))
        filters[-1].F, filters[-1].Q, filters[-1].H, filters[-1].R = F, Q, problem.H, problem.R

    def call() -> Any:
        out = []
        for f, mean, cov in zip(filters, problem.mean, problem.cov, strict=True):
            f.x, f.P = mean[:, None], cov
            f.predict()
            f.update(problem.z[:, None])
            out.append((f.x[:, 0], f.P, f.log_likelihood))
        return out

    name = "filterpy loop, float64"
    return [Method(name, call, stack_steps)]


def simdkalman_steps(problem: Problem) -> list[Method]:
    from simdkalman import primitives

    F, Q, H, R, mean, cov, z = problem
    n = len(mean)
    H, R = np.broadcast_to(H, (n, *H.shape)).copy(), np.broadcast_to(R, (n, *R.shape)).copy()
    z = np.broadcast_to(z[:, None], (n, len(z), 1)).copy()

    def call() -> Any:
        predicted = primitives.predict(mean[..., None], cov, F, Q)
        return primitives._update(*predicted, H, R, z, log_likelihood=True)

    def result(out: Any) -> Step:
        return Step(out[0][..., 0], out[1], np.reshape(out[-1], n))

    return [Method("simdkalman, float64", call, result)]


def torch_kf_steps(problem: Problem) -> list[Method]:
    from torch_kf import GaussianState, KalmanFilter

    methods = []
    for dtype in (torch.float64, torch.float32):
        F, Q, H, R, mean, cov, z = (torch.tensor(value, dtype=dtype) for value in problem)
        tracker = KalmanFilter(F, H, Q, R, joseph_update=False)  # its faster form
        state, measured = GaussianState(mean[..., None], cov), z[:, None]

        @torch.inference_mode()
        def call(tracker: Any = tracker, state: Any = state, z: Any = measured) -> Any:
            predicted = tracker.predict(state)
            projection = tracker.project(predicted)
            updated = tracker.update(predicted, z, projection=projection)
            return updated, projection.log_likelihood(z)

        def result(out: Any) -> Step:
            return Step(out[0].mean[..., 0], out[0].covariance, out[1].reshape(-1))

        methods.append(Method(f"torch-kf, {str(dtype).split('.')[1]}", call, result))
    return methods


def dynamax_steps(problem: Problem) -> list[Method]:
    import jax
    from dynamax.linear_gaussian_ssm.inference import _condition_on, _predict
    from jax.scipy.stats import multivariate_normal

    jax.config.update("jax_enable_x64", True)
    methods = []
    for dtype in ("float64", "float32"):
        F, Q, H, R, mean, cov, z = (jax.numpy.asarray(value, dtype) for value in problem)
        none = jax.numpy.zeros
        inputs, B, b = none(1, dtype), none((DIM, 1), dtype), none(DIM, dtype)
        D, d = none((len(z), 1), dtype), none(len(z), dtype)

        def one(
            F: Any, Q: Any, mean: Any, cov: Any, fixed: Any = (H, R, z, B, b, D, d, inputs)
        ) -> Any:
            H, R, z, B, b, D, d, inputs = fixed
            mean, cov = _predict(mean, cov, F, B, b, Q, inputs)
            log_likelihood = multivariate_normal.logpdf(z, H @ mean, H @ cov @ H.T + R)
            return *_condition_on(mean, cov, H, D, d, R, inputs, z), log_likelihood

        many = jax.jit(jax.vmap(one))
        call = lambda f=many, parts=(F, Q, mean, cov): jax.block_until_ready(f(*parts))  # noqa: E731
        methods.append(Method(f"dynamax (vmap, jit), {dtype}", call))
    return methods


PEERS: dict[str, Callable[[Problem], list[Method]]] = {
    "filterpy": filterpy_steps,
    "simdkalman": simdkalman_steps,
    "torch-kf": torch_kf_steps,
    "dynamax": dynamax_steps,
}


# --- results


def error_of(method: Method, truth: Step) -> list[float]:
    """Return the largest |difference| / max(|truth|, 1) of mean, covariance and log-likelihood."""
    found = method.result(method.call())
    errors = []
    for value, expected in zip(found, truth, strict=True):
        difference = np.abs(np.asarray(value, dtype=float) - expected)
        errors.append(float((difference / np.maximum(np.abs(expected), 1)).max()))
    return errors


def table_rows(
    timings: list[Timing], errors: list[list[float]], n_filters: int
) -> Iterator[list[str]]:
    ours = timings[0]
    for timing, error in zip(timings, errors, strict=True):
        cells = [*timing.milliseconds, *map(number, ratio(timing, ours))]
        yield [timing.case.name, str(n_filters), *cells, *(f"{e:.0e}" for e in error)]


def floor_row(n_filters: int, limits: Limits) -> list[str]:
    """Return the time of the arithmetic and of one pass over inputs and outputs as a row."""
    z = len(OBSERVED)
    products = 4 * DIM**3 + 4 * DIM**2  # F P F^T, F m and their sums
    update = z**3 / 3 + z * z * DIM + 2 * z * DIM * DIM + 4 * z * DIM  # factor, solve, W^T W, mean
    flops, moved = n_filters * (products + update), 8 * n_filters * (4 * DIM * DIM + 2 * DIM)
    seconds = 1e-9 * (flops / limits.gflops_float64 + moved / limits.copy_gb)
    return ["floor, float64", str(n_filters), number(1e3 * seconds), *[""] * 7]


if __name__ == "__main__":
    run_command(main)
