"""How fast is EM for a mixture with full covariances, beside scikit-learn, at equal likelihood?

    python -m benchmarks.speed.expectation_maximisation --threads 2

Exactly 20 iterations on 100,000 points of 21 dimensions with 30 components, all from one common start.
One float64 function computes the mean log-likelihood of every result. scikit-learn runs in float64;
torchgmm and pomegranate, where they can be imported, only know float32.
"""

import logging
import math
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

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
from torchpose.math import expectation_maximisation
from torchpose.math._mixture_em import MixtureParameters

DIM, RIDGE = 21, 1e-6
TOLERANCE = 1e-6  # of the difference of mean log-likelihoods, torchpose - scikit-learn in float64
HEADER = (
    "method", "s", "min s", "ms/iteration", "CPU s", "x torchpose", "CPU x", "mean log-likelihood",
)  # fmt: skip
PACKAGES = ("numpy", "scikit-learn", "torchgmm", "pomegranate")


class Problem(NamedTuple):
    """Points [N, D], the start, iterations."""

    x: Tensor
    start: MixtureParameters
    iterations: int


class Method(NamedTuple):
    """`call` fits and returns weights, means and covariances."""

    name: str
    call: Callable[[], Any]


def main(setup: Setup = Setup(runs=3), *, points: int = 100_000) -> None:
    """Run and print the table.

    Args:
        setup: see `Setup`.
        points: to fit to.
    """
    report = begin("Expectation-maximisation, 30 components, 21 dimensions", setup)
    points, iterations, n_components = (2000, 3, 4) if setup.quick else (points, 20, 30)
    problem = make_problem(points, n_components, iterations)
    report.add(
        f"{points:,} points, {n_components} components, {iterations} iterations from one start "
        f"(mean log-likelihood {mean_log_likelihood(problem.x, problem.start):.6f})."
    )
    methods = make_methods(problem, report)
    found = {m.name: mean_log_likelihood(problem.x, wide(m.call())) for m in methods}
    failed = report_agreement(report, found)
    timings = take_turns([Case(m.name, m.call) for m in methods], setup.runs, warm=0)
    limits = measure_limits(setup.quick)
    report.table(HEADER, table_rows(timings, found, iterations))
    report.add(floor_text(problem, limits))
    report.close(PACKAGES, limits)
    if failed:
        sys.exit("torchpose and scikit-learn do not reach the same likelihood")


def make_problem(n: int, n_components: int, iterations: int) -> Problem:
    """Draw overlapping clusters of unequal shape, scaled to unit variance; start from a point of each."""
    rng = np.random.default_rng(0)
    each = -(-n // n_components)
    parts = []
    for _ in range(n_components):
        shape = rng.standard_normal((DIM, DIM)) * rng.uniform(0.2, 1.0, DIM)
        centre = 3 * rng.standard_normal(DIM)
        parts.append(rng.standard_normal((each, DIM)) @ shape.T + centre)
    x = np.concatenate(parts)
    x = (x - x.mean(0)) / x.std(0)
    means, x = x[::each][:n_components], x[rng.permutation(len(x))[:n]]
    covariances = np.repeat(0.3 * np.cov(x.T)[None], n_components, 0)
    weights = np.full(n_components, 1 / n_components)
    start = MixtureParameters(*(torch.tensor(a) for a in (weights, means, covariances)))
    return Problem(torch.tensor(x), start, iterations)


def mean_log_likelihood(x: Tensor, mixture: MixtureParameters) -> float:
    """Return the mean log-likelihood in float64, by whitened residuals of one component at a time."""
    terms = []
    for weight, mean, covariance in zip(*mixture, strict=True):
        factor = torch.linalg.cholesky(covariance)
        white = torch.linalg.solve_triangular(factor, (x - mean).T, upper=False)
        squared, log_det = white.square().sum(0), factor.diagonal().log().sum()
        terms.append(weight.log() - 0.5 * squared - log_det - 0.5 * DIM * math.log(2 * math.pi))
    return float(torch.stack(terms).logsumexp(0).mean())


def wide(result: Any) -> MixtureParameters:
    """Return the result of any method as float64 tensors."""
    parts = (torch.as_tensor(part).detach().double() for part in result)
    return MixtureParameters(*parts)


# --- methods


def make_methods(problem: Problem, report: Report) -> list[Method]:
    """Return torchpose's methods, then every peer that can be imported."""
    methods = [torchpose_fit(problem, dtype) for dtype in (torch.float64, torch.float32)]
    for name, make in PEERS.items():
        try:
            methods.append(make(problem))
        except ImportError as error:
            report.leave_out(name, error)
    return methods


def torchpose_fit(problem: Problem, dtype: torch.dtype) -> Method:
    floor = torch.full((DIM,), RIDGE, dtype=torch.float64)
    options = {"max_iter": problem.iterations, "tol": 0.0, "floor": floor, "dtype": dtype}

    def call() -> Any:
        return expectation_maximisation(problem.x, problem.start, **options)[0]  # type: ignore[arg-type]

    return Method(f"torchpose, {str(dtype).split('.')[1]}", call)


def scikit_learn_fit(problem: Problem) -> Method:
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.mixture import GaussianMixture

    x, start = problem.x.numpy(), problem.start
    options = {
        "n_components": len(start.weights), "tol": 0.0, "max_iter": problem.iterations,
        "reg_covar": RIDGE, "weights_init": start.weights.numpy(), "means_init": start.means.numpy(),
        "precisions_init": torch.linalg.inv(start.covariances).numpy(),
    }  # fmt: skip

    def call() -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            fit = GaussianMixture(**options).fit(x)
        if fit.n_iter_ != problem.iterations:
            raise RuntimeError(f"scikit-learn stopped after {fit.n_iter_} iterations")
        return fit.weights_, fit.means_, fit.covariances_

    return Method("scikit-learn, float64", call)


def torchgmm_fit(problem: Problem) -> Method:
    from torchgmm.bayes import GaussianMixture

    for name in ("pytorch_lightning", "lightning.pytorch"):
        logging.getLogger(name).setLevel(logging.ERROR)
    x, means = problem.x.float(), problem.start.means.float()
    silent = ("enable_progress_bar", "enable_model_summary", "logger", "enable_checkpointing")
    trainer = {
        "max_epochs": problem.iterations,
        "accelerator": "cpu",
        **dict.fromkeys(silent, False),
    }

    def call() -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            fit = GaussianMixture(
                len(means), covariance_type="full", init_means=means, convergence_tolerance=0.0,
                covariance_regularization=RIDGE, trainer_params=trainer,
            ).fit(x)  # fmt: skip
        return fit.model_.component_probs, fit.model_.means, fit.model_.covariances

    return Method("torchgmm, float32, own start of the covariances", call)


def pomegranate_fit(problem: Problem) -> Method:
    from pomegranate.distributions import Normal
    from pomegranate.gmm import GeneralMixtureModel

    x, (weights, means, covariances) = problem.x.float(), (p.float() for p in problem.start)

    def call() -> Any:
        pairs = zip(means.clone(), covariances.clone(), strict=True)
        parts = [Normal(*pair, covariance_type="full") for pair in pairs]
        fit = GeneralMixtureModel(
            parts, priors=weights.clone(), max_iter=problem.iterations, tol=-1e30
        ).fit(x)
        distributions = fit.distributions
        return (
            fit.priors,
            torch.stack([d.means for d in distributions]),
            torch.stack([d.covs for d in distributions]),
        )

    return Method("pomegranate, float32", call)


PEERS: dict[str, Callable[[Problem], Method]] = {
    "scikit-learn": scikit_learn_fit,
    "torchgmm": torchgmm_fit,
    "pomegranate": pomegranate_fit,
}


# --- results


def report_agreement(report: Report, found: dict[str, float]) -> bool:
    """Report the difference of torchpose and scikit-learn; return True if it is too large."""
    ours, theirs = found["torchpose, float64"], found.get("scikit-learn, float64")
    if theirs is None:
        report.add("Agreement: scikit-learn cannot be imported, nothing to compare with.")
        return False
    difference = abs(ours - theirs)
    report.add(
        f"Agreement of torchpose and scikit-learn in float64: mean log-likelihoods differ by "
        f"{difference:.1e}, at most {TOLERANCE:g} allowed."
    )
    return not difference < TOLERANCE


def table_rows(
    timings: list[Timing], found: dict[str, float], iterations: int
) -> Iterator[list[str]]:
    ours = timings[0]
    for timing in timings:
        each = 1e3 * timing.median / iterations
        cells = (timing.median, timing.best, each, timing.median_cpu, *ratio(timing, ours))
        likelihood = f"{found[timing.case.name]:.6f}"
        yield [timing.case.name, *(number(cell) for cell in cells), likelihood]


def floor_text(problem: Problem, limits: Limits) -> str:
    """Return the floor: two products of all points' features with one table, at the measured rate."""
    n_features = 1 + DIM + DIM * (DIM + 1) // 2
    flops = 4e-9 * len(problem.x) * n_features * len(problem.start.weights) * problem.iterations
    wide_s, narrow_s = flops / limits.gflops_float64, flops / limits.gflops_float32
    return (
        f"Floor: two products with {n_features} features per point are {flops:.1f} GFLOP in all, "
        f"{wide_s:.2f} s in float64 and {narrow_s:.2f} s in float32 at the rate of large products."
    )


if __name__ == "__main__":
    run_command(main)
