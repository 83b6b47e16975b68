"""How near do Gaussian messages over rotations come to the true posterior, and what do they cost?

    python -m benchmarks.speed.tree_messages --threads 2

A Gaussian through a rotation, and belief propagation over a chain of three rotations, against draws;
on linear trees, against the dense joint Gaussian. Then the time of one pass over the ten parts of a
body for 114 hypotheses.
"""

import math
import sys

import torch
from torch import Tensor

from benchmarks._command import run_command
from benchmarks.speed._timing import Case, Setup, begin, take_turns
from torchpose.body import BODY_15
from torchpose.math import compose, conjugate, fit_gaussian, rotate_gaussian
from torchpose.math._tree_messages import message_tree, propagate
from torchpose.priors._limb_conditionals import PART_TREE, LimbConditionals, LimbInfo

DEGREES = (2, 5, 10, 15, 20, 30)  # standard deviation of a rotation about each axis
TOLERANCE = 1e-8  # from the dense joint Gaussian
HYPOTHESES = 114
CHAIN = ((0, 1), (1, 2))


def main(setup: Setup = Setup(runs=30)) -> None:
    """Run and print the tables."""
    report = begin("Gaussian messages over rotations", setup)
    draws, trials, sizes = (20_000, 2, (5,)) if setup.quick else (1_000_000, 6, DEGREES)
    worst = linear_error()
    report.add(
        f"Agreement on linear trees with the dense joint Gaussian: {worst:.1e}, at most "
        f"{TOLERANCE:g} allowed."
    )
    rows = [turn_row(size, draws) for size in sizes]
    report.table(("F(q, N): deviation", "mean", "covariance"), rows)
    rows = [chain_row(size, draws, trials) for size in sizes]
    report.table(
        ("chain of three: deviation", "posterior's deviation", "mean", "of it", "covariance"), rows
    )
    report.add(
        "Degrees. mean: distance of the means of rotations. of it: as a share of the posterior's "
        f"deviation. covariance: Frobenius norm of the difference, as a share. {draws:,} draws, whose "
        f"own error is in it; means of {trials} chains."
    )
    report.table(
        ("one pass, 10 parts", "hypotheses", "ms", "min ms", "CPU ms"), timing_rows(setup.runs)
    )
    report.close()
    if not worst < TOLERANCE:
        sys.exit("messages differ from the dense joint Gaussian by more than is allowed")


def normal(generator: torch.Generator, *sizes: int) -> Tensor:
    return torch.randn(*sizes, generator=generator, dtype=torch.float64)


def covariances(generator: torch.Generator, degrees: float, *batch: int) -> Tensor:
    """Draw covariances of vectors; the deviation is the root mean square over the axes."""
    a = normal(generator, *batch, 3, 3)
    cov = a @ a.mT + 0.05 * torch.eye(3).double()
    trace = cov.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    return cov * (3 * math.radians(degrees / 2) ** 2 / trace)


def drawn(generator: torch.Generator, mean: Tensor, cov: Tensor, count: int) -> Tensor:
    return mean + normal(generator, count, 3) @ torch.linalg.cholesky(cov).mT


def angle(a: Tensor, b: Tensor) -> float:
    """Return the degrees between rotations, root mean square."""
    half = compose(conjugate(a), b).norm(dim=-1).asin()
    return float(2 * half.square().mean().sqrt().rad2deg())


def apart(a: Tensor, b: Tensor) -> float:
    return float(((a - b).norm(dim=(-2, -1)) / b.norm(dim=(-2, -1))).mean())


def turn_row(degrees: float, count: int) -> list[str]:
    """Return the errors of a limb in its own part's space, with the part above 40 degrees off its centre."""
    g = torch.Generator().manual_seed(0)
    turn = torch.tensor([0.3, -0.1, 0.1]).double()
    new_centre = torch.tensor([0.0, 0.05, -0.05]).double()
    cov, mean = covariances(g, degrees), torch.tensor([0.1, 0.0, -0.1]).double()
    ours = rotate_gaussian(turn, mean, cov, new_centre=new_centre)
    draws = fit_gaussian(compose(turn, drawn(g, mean, cov, count)), new_centre)
    return [
        f"{degrees}",
        f"{angle(ours[0], draws[0]):.2f}",
        f"{100 * apart(ours[1], draws[1]):.1f} %",
    ]


def chain_row(degrees: float, count: int, trials: int) -> list[str]:
    found = [chain_errors(torch.Generator().manual_seed(i), degrees, count) for i in range(trials)]
    spread, mean, cov = (sum(values) / trials for values in zip(*found, strict=True))
    return [
        f"{degrees}", f"{spread:.1f}", f"{mean:.2f}", f"{100 * mean / spread:.0f} %",
        f"{100 * cov:.1f} %",
    ]  # fmt: skip


def chain_errors(g: torch.Generator, degrees: float, count: int) -> tuple[float, float, float]:
    """Return the posterior's deviation, the error of its mean, and the error of its covariance.

    The exact posterior comes from draws of the top part and of the conditionals below it, weighted
    by the observations of the parts below.
    """
    edges = torch.tensor(CHAIN)
    turns, centres = 0.4 * normal(g, 2, 3), torch.zeros(4, 3).double()
    for edge, (above, below) in enumerate((edges + 1).tolist()):
        centres[below] = compose(centres[above], turns[edge])
    model = LimbConditionals(
        LimbInfo(parts=("root", "top", "middle", "end")), edges + 1, 0.05 * normal(g, 2, 3),
        covariances(g, degrees, 2), turns, centres, torch.zeros(4, 3, 3).double(),
    )  # fmt: skip
    at, cov = 0.05 * normal(g, 3, 3), covariances(g, degrees, 3)
    shift = math.radians(degrees / 2) * normal(g, 3, 3)
    rotation = compose(centres[1], drawn(g, at[0], cov[0], count))
    rotations, log_weights = [rotation], torch.zeros(count).double()
    for edge, below in ((0, 1), (1, 2)):
        predicted, _ = model.transport(at[[edge]], cov[[edge]], torch.tensor([edge]), False)
        at[below] = predicted[0] + shift[below]
        x = drawn(g, model.mean[edge], model.covariance[edge], count)
        rotation = compose(rotation, compose(turns[edge], x))
        rotations.append(rotation)
        off = compose(conjugate(centres[below + 1]), rotation) - at[below]
        log_weights -= 0.5 * (off @ torch.linalg.inv(cov[below]) * off).sum(-1)
    ours = propagate(at, cov, model.tree, model.transport)
    true = fit_gaussian(torch.stack(rotations), centres[1:], log_weights)
    spread = 2 * (true[1].diagonal(dim1=-2, dim2=-1).mean().sqrt())
    return float(spread.rad2deg()), angle(ours[0], true[0]), apart(ours[1], true[1])


def linear_error() -> float:
    """Return the largest difference from the dense joint, x_j = A x_i + N(0, I) on a tree of six nodes."""
    g = torch.Generator().manual_seed(0)
    edges = torch.tensor([[0, 1], [0, 2], [2, 3], [2, 4], [4, 5]])
    matrix = torch.linalg.qr(normal(g, 5, 3, 3)).Q
    eye = torch.eye(3).double()

    def transport(mean: Tensor, cov: Tensor, e: Tensor, upward: bool) -> tuple[Tensor, Tensor]:
        a = matrix[e].mT if upward else matrix[e]
        return (a @ mean[..., None]).squeeze(-1), a @ cov @ a.mT + eye

    mean, cov = normal(g, 6, 3), covariances(g, 90, 6)
    ours = propagate(mean, cov, message_tree(edges, 6), transport)
    precision = torch.block_diag(*torch.linalg.inv(cov))
    for (i, j), a in zip(edges.tolist(), matrix, strict=True):
        residual = torch.zeros(3, 18).double()
        residual[:, 3 * j : 3 * j + 3], residual[:, 3 * i : 3 * i + 3] = eye, -a
        precision = precision + residual.mT @ residual
    joint = torch.linalg.inv(precision)
    shift = (torch.linalg.inv(cov) @ mean[..., None]).flatten()
    blocks = joint.reshape(6, 3, 6, 3).diagonal(dim1=0, dim2=2).movedim(-1, 0)
    off = (ours[0] - (joint @ shift).reshape(6, 3)).abs().max()
    return float(torch.maximum(off, (ours[1] - blocks).abs().max()))


def timing_rows(runs: int) -> list[list[str]]:
    g = torch.Generator().manual_seed(0)
    parts = BODY_15.parts
    edges = torch.tensor([[parts.index(name) for name in edge] for edge in PART_TREE])
    cases = []
    for dtype in (torch.float64, torch.float32):
        for directions in ("eigen", "cholesky"):
            model = LimbConditionals(
                LimbInfo(parts=parts), edges, 0.05 * normal(g, 9, 3), covariances(g, 10, 9),
                0.2 * normal(g, 9, 3), 0.2 * normal(g, 11, 3), covariances(g, 1, 11),
                directions=directions,
            ).to(dtype)  # fmt: skip
            mean = (0.1 * normal(g, HYPOTHESES, 10, 3)).to(dtype)
            cov = covariances(g, 10, HYPOTHESES, 10).to(dtype)

            @torch.inference_mode()
            def call(mean: Tensor = mean, cov: Tensor = cov, model=model) -> object:
                return propagate(mean, cov, model.tree, model.transport)

            cases.append(Case(f"{directions}, {str(dtype).split('.')[1]}", call, inner=5))
    timings = take_turns(cases, runs, warm=2)
    return [[t.case.name, str(HYPOTHESES), *t.milliseconds] for t in timings]


if __name__ == "__main__":
    run_command(main)
