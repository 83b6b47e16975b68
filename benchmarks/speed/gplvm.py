"""How fast does a manifold predict the poses of particles, and how long does its fit take?

    python -m benchmarks.speed.gplvm --threads 2 --data $TORCHPOSE_DATA/mocap_cmu_walk

A back-constrained GPLVM of 350 poses of 30 columns with 2 latent dimensions predicts the poses of 500
and of 10,000 latent points, with and without their variance. gpytorch has the same kernel, noise and
latent points, one output for each column and its caches filled, where it can be imported; it forms
the covariance of all the points that it is given, so it gets them 500 at a time (30 outputs of 10,000
points would need 24 GB). Methods take turns, and every result is compared with plain inverses in
float64. Then ten evaluations of the objective and its gradient, as in ten steps of Adam, and a whole
fit. With the recordings of CMU walks: how well held-out trials come back from manifolds and from
principal components, and the standard deviations for the filter.
"""

import contextlib
import copy
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchmarks._command import run_command
from benchmarks._data import data_files
from benchmarks.speed._gplvm_walks import held_out_tables
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
from torchpose.learning import fit_gplvm
from torchpose.learning._gplvm_fit import GPLVMFit
from torchpose.priors import BackConstrainedGPLVM

FRAMES, COLUMNS, CYCLE = 350, 30, 66
SIZES = (500, 10_000)
TOLERANCE = 1e-7  # of |difference| over the largest |truth|, for torchpose in float64
PEER_CHUNK = 500  # poses that gpytorch gets at once
GOAL = 20  # times gpytorch's speed
HEADER = (
    "prediction", "poses", "ms", "min ms", "CPU ms", "x torchpose", "CPU x", "mean", "variance",
)  # fmt: skip
FIT_HEADER = ("fit", "ms", "min ms", "CPU ms", "x torchpose", "CPU x")
PACKAGES = ("numpy", "gpytorch", "linear-operator")


class Method(NamedTuple):
    """A way to predict: `call` is timed and returns the mean [N, Q] and the variance [N] or None."""

    name: str
    call: Callable[[], tuple[Any, Any]]
    variance: bool
    peer: bool = False


def main(
    setup: Setup = Setup(runs=9),
    *,
    data: Path | None = None,
    persons: Sequence[str] = ("07", "08", "35", "39"),
) -> None:
    """Run and print the tables.

    Args:
        setup: see `Setup`.
        data: folder of mocap_cmu_walk; none: no held-out table.
        persons: of it.
    """
    if data is not None:
        data_files(data, *(f"s{person}_*.npz" for person in persons))  # missing ones are said first
    report = begin("A manifold: prediction and fit", setup)
    frames, sizes = (40, (60,)) if setup.quick else (FRAMES, SIZES)
    poses = walk(frames)
    manifold = fit_gplvm(poses, steps=3)
    limits, failed, rows, ratios = measure_limits(setup.quick), False, [], []
    for count in sizes:
        z = latent_points(manifold, count)
        truth = true_prediction(manifold, z)
        methods = make_methods(manifold, z, report, quiet=count != sizes[0])
        errors = [errors_of(method, truth) for method in methods]
        worst = max(errors[0])
        report.add(
            f"Agreement of torchpose (float64, {count:,} poses) with plain inverses: {worst:.1e} of "
            f"the largest value, at most {TOLERANCE:g} allowed."
        )
        failed |= not worst < TOLERANCE
        timings = take_turns([Case(m.name, m.call) for m in methods], setup.runs, warm=2)
        rows += prediction_rows(methods, timings, errors, count)
        rows.append(floor_row(manifold, count, limits))
        ratios += speedups(methods, timings, count)
    report.table(HEADER, rows)
    report.add("mean, variance: largest |difference| over the largest |truth|.")
    if ratios:
        report.add(f"{'; '.join(ratios)} (the aim: {GOAL} times).")
    report.table(FIT_HEADER, fit_rows(poses, manifold, setup.quick))
    if data is not None:
        held_out_tables(data, persons, report)
    report.close(PACKAGES, limits)
    if failed:
        sys.exit("torchpose differs from the plain computation by more than is allowed")


def walk(frames: int) -> Tensor:
    """Return a cyclic motion of quaternion vectors."""
    generator = torch.Generator().manual_seed(0)
    angle = 2 * math.pi * torch.arange(frames, dtype=torch.float64) / CYCLE
    waves = torch.stack([f(n * angle) for n in (1, 2, 3) for f in (torch.sin, torch.cos)], 1)
    sizes = torch.tensor([0.25, 0.25, 0.08, 0.08, 0.03, 0.03], dtype=torch.float64)
    weights = torch.randn(6, COLUMNS, generator=generator, dtype=torch.float64) * sizes[:, None]
    noise = torch.randn(frames, COLUMNS, generator=generator, dtype=torch.float64)
    return waves @ weights + 0.02 * noise


def latent_points(manifold: BackConstrainedGPLVM, count: int) -> Tensor:
    """Draw particles about the trajectory."""
    generator = torch.Generator().manual_seed(1)
    chosen = torch.randint(len(manifold.latents), (count,), generator=generator)
    noise = torch.randn(count, 2, generator=generator, dtype=torch.float64)
    return manifold.latents[chosen] + 0.1 * noise


def true_prediction(manifold: BackConstrainedGPLVM, z: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Return (MR 25) and (MR 26) by plain inverses, noise included."""
    beta, beta0, gamma, _ = (float(value.exp()) for value in manifold.kernel)
    noise = float(manifold.kernel.noise)
    latents, mean = manifold.latents.numpy(), manifold.poses.mean(0).numpy()

    def kernel(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        squared = ((a[:, None] - b) ** 2).sum(-1)
        return beta * np.exp(-0.5 * gamma * squared) + beta0

    inverse = np.linalg.inv(kernel(latents, latents) + noise * np.eye(len(latents)))
    cross = kernel(z.numpy(), latents)
    variance = beta + beta0 + noise - np.einsum("nt,ts,ns->n", cross, inverse, cross)
    return cross @ inverse @ (manifold.poses.numpy() - mean) + mean, variance


# --- methods


def make_methods(
    manifold: BackConstrainedGPLVM, z: Tensor, report: Report, quiet: bool
) -> list[Method]:
    """Return torchpose's methods, then gpytorch's if it can be imported."""
    methods = [
        method
        for dtype in (torch.float64, torch.float32)
        for method in torchpose_methods(manifold, z, dtype)
    ]
    try:
        for dtype in (torch.float64, torch.float32):
            methods += gpytorch_methods(manifold, z, dtype)
    except ImportError as error:
        if not quiet:
            report.leave_out("gpytorch", error)
    return methods


def torchpose_methods(
    manifold: BackConstrainedGPLVM, z: Tensor, dtype: torch.dtype
) -> list[Method]:
    module, points = copy.deepcopy(manifold).to(dtype), z.to(dtype)

    @torch.inference_mode()
    def both() -> tuple[Any, Any]:
        return module.to_pose(points)

    @torch.inference_mode()
    def mean() -> tuple[Any, Any]:
        return module.pose_mean(points), None

    name = f"torchpose, {str(dtype).split('.')[1]}"
    return [Method(f"{name}, mean and variance", both, True), Method(f"{name}, mean", mean, False)]


def gpytorch_methods(manifold: BackConstrainedGPLVM, z: Tensor, dtype: torch.dtype) -> list[Method]:
    """Return an exact GP with a batch of outputs that share the kernel."""
    import gpytorch

    model = gpytorch_model(manifold, dtype)
    mean, noise = manifold.poses.mean(0).to(dtype), manifold.kernel.noise
    chunks, settings = z.to(dtype).split(PEER_CHUNK), gpytorch.settings

    def both() -> tuple[Any, Any]:
        with torch.no_grad(), settings.fast_pred_var():
            found = [model(chunk) for chunk in chunks]
            variance = torch.cat([out.variance[0] for out in found])
            return torch.cat([out.mean.mT for out in found]) + mean, variance + noise

    def only_mean() -> tuple[Any, Any]:
        with torch.no_grad(), settings.fast_pred_var(), settings.skip_posterior_variances():
            return torch.cat([model(chunk).mean.mT for chunk in chunks]) + mean, None

    name = f"gpytorch, {str(dtype).split('.')[1]}"
    return [
        Method(f"{name}, mean and variance", both, True, peer=True),
        Method(f"{name}, mean", only_mean, False, peer=True),
    ]


def gpytorch_model(manifold: BackConstrainedGPLVM, dtype: torch.dtype) -> Any:
    """Return gpytorch's model in evaluation mode, with kernel, noise and latent points of the manifold."""
    import gpytorch

    columns = manifold.dim
    beta, beta0, gamma, _ = (float(value.exp()) for value in manifold.kernel)
    tiny = gpytorch.constraints.GreaterThan(1e-12)

    class Outputs(gpytorch.models.ExactGP):
        def __init__(self, x: Tensor, y: Tensor, likelihood: Any) -> None:
            super().__init__(x, y, likelihood)
            smooth = gpytorch.kernels.RBFKernel(lengthscale_constraint=tiny)
            self.smooth = gpytorch.kernels.ScaleKernel(smooth, outputscale_constraint=tiny)
            self.constant = gpytorch.kernels.ConstantKernel(constant_constraint=tiny)
            self.mean = gpytorch.means.ZeroMean(batch_shape=torch.Size([columns]))

        def forward(self, x: Tensor) -> Any:
            shared = (self.smooth(x) + self.constant(x)).expand(columns, len(x), len(x))
            return gpytorch.distributions.MultivariateNormal(self.mean(x), shared)

    likelihood = gpytorch.likelihoods.GaussianLikelihood(noise_constraint=tiny)
    targets = (manifold.poses - manifold.poses.mean(0)).mT.to(dtype)
    model = Outputs(manifold.latents.to(dtype), targets, likelihood).to(dtype)
    likelihood.noise = float(manifold.kernel.noise)
    model.smooth.outputscale, model.smooth.base_kernel.lengthscale = beta, gamma**-0.5
    model.constant.constant = torch.tensor([beta0], dtype=dtype)
    return model.eval()


# --- fit


def fit_rows(poses: Tensor, manifold: BackConstrainedGPLVM, quick: bool) -> list[list[str]]:
    """Return the times of ten evaluations of objective and gradient of both, and of a whole fit."""
    target, gamma = poses - poses.mean(0), float(manifold.gamma_x)
    ours = GPLVMFit(target, 2, gamma, "adam")
    cases = [Case("torchpose, 10 steps of Adam", ours.step)]
    with contextlib.suppress(ImportError):
        cases.append(Case("gpytorch, 10 steps of Adam", gpytorch_steps(manifold)))
    runs = 1 if quick else 3
    timings = take_turns(cases, runs)
    whole = Case(
        "torchpose, whole fit (3 steps of 10 L-BFGS iterations)",
        lambda: fit_gplvm(poses, steps=3),
    )
    timings += take_turns([whole], runs)
    found = []
    for timing in timings:
        ratios = (
            ["", ""] if timing.case is whole else [number(r) for r in ratio(timing, timings[0])]
        )
        found.append([timing.case.name, *timing.milliseconds, *ratios])
    return found


def gpytorch_steps(manifold: BackConstrainedGPLVM) -> Callable[[], None]:
    """Return ten steps of Adam on the marginal likelihood, with latent points by back constraints."""
    import gpytorch

    model = gpytorch_model(manifold, torch.float64).train()
    poses, targets = manifold.poses, model.train_targets
    similar = torch.exp(-0.5 * manifold.gamma_x * torch.cdist(poses, poses).square())
    weights = torch.nn.Parameter(manifold.weights.clone())
    evidence = gpytorch.mlls.ExactMarginalLogLikelihood(model.likelihood, model)
    adam = torch.optim.Adam([weights, *model.parameters()], lr=0.05)

    def steps() -> None:
        for _ in range(10):
            adam.zero_grad()
            latents = similar @ weights + manifold.bias
            model.set_train_data(latents, targets, strict=False)
            loss = (
                0.5 * latents.square().sum() - len(poses) * evidence(model(latents), targets).sum()
            )
            loss.backward()
            adam.step()

    return steps


# --- results


def errors_of(method: Method, truth: tuple[np.ndarray, np.ndarray]) -> list[float]:
    """Return the largest |difference| over the largest |truth|, of mean and variance."""
    errors = []
    for value, expected in zip(method.call(), truth, strict=True):
        if value is not None:
            difference = np.abs(value.double().numpy() - expected)
            errors.append(float(difference.max() / np.abs(expected).max()))
    return errors


def prediction_rows(
    methods: list[Method], timings: list[Timing], errors: list[list[float]], count: int
) -> list[list[str]]:
    rows = []
    for method, timing, error in zip(methods, timings, errors, strict=True):
        ours = timings[0 if method.variance else 1]
        cells = [*timing.milliseconds, *map(number, ratio(timing, ours))]
        shown = [f"{e:.0e}" for e in error] + [""] * (2 - len(error))
        rows.append([method.name, f"{count:,}", *cells, *shown])
    return rows


def speedups(methods: list[Method], timings: list[Timing], count: int) -> list[str]:
    """Return gpytorch's time over torchpose's in the same precision, in words."""
    found = []
    by_name = {method.name: timing for method, timing in zip(methods, timings, strict=True)}
    for method in methods:
        if method.peer:
            own = by_name[method.name.replace("gpytorch", "torchpose")]
            what = method.name.removeprefix("gpytorch, ")
            wall, cpu = ratio(by_name[method.name], own)
            found.append(
                f"{count:,} poses, {what}: {wall:.0f} times gpytorch's speed, CPU {cpu:.0f}"
            )
    return found


def floor_row(manifold: BackConstrainedGPLVM, count: int, limits: Limits) -> list[str]:
    """Return the arithmetic of mean and variance at the rate of large products as a row."""
    frames = len(manifold.poses)
    flops = count * frames * (2 * manifold.dim + frames + 2 * (manifold.latent_dim + 2))
    seconds = 1e-9 * flops / limits.gflops_float64
    return ["floor, float64, mean and variance", f"{count:,}", number(1e3 * seconds), *[""] * 6]


if __name__ == "__main__":
    run_command(main)
