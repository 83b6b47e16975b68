"""The problem of the mixture Kalman filter: a prior over the arm, its noise, and sequences from it."""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchpose.filters import MixtureKalmanFilter, make_transition
from torchpose.priors import GaussianMixture

DIM = 21
OBSERVED = [0, 1, 9, 10, 12, 13]  # u, v of hand, head and neck
PROCESS = [560.0, 560, 1, 56, 56, 1] + [25.0, 25, 1] * 3 + [0.5] * 3 + [0.01] * 3
NOISE = [9.0] * len(OBSERVED)  # three pixels
UNIFORM_WEIGHT = 1e-3
RELEASED = Path("signer") / "released_prior_Training20_02.npz"


class Problem(NamedTuple):
    """A prior over arm states [D], Q [D], R [Z] and the measured dimensions."""

    source: str
    prior: GaussianMixture
    process_cov: Tensor
    measurement_cov: Tensor
    observed: list[int]


def make_problem(path: Path | None = None, synthetic: bool = False) -> Problem:
    """Return the problem with the released prior if there is one, else with a synthetic one of its scales."""
    found = path or (None if synthetic else _released_file())
    if found is None:
        source, prior = "synthetic prior of 30 components", synthetic_prior()
    else:
        source, prior = f"prior {found.name}, left arm", released_prior(found)
    noise = (torch.tensor(PROCESS, dtype=torch.float64), torch.tensor(NOISE, dtype=torch.float64))
    return Problem(source, prior, *noise, OBSERVED)


def _released_file() -> Path | None:
    folder = os.environ.get("TORCHPOSE_DATA")
    path = Path(folder) / RELEASED if folder else None
    return path if path is not None and path.is_file() else None


def released_prior(path: Path) -> GaussianMixture:
    """Return the left arm of a prior in the layout of the authors' released files."""
    with np.load(path) as file:
        parts = (torch.tensor(file[f"left_{k}"]) for k in ("weights", "means", "covariances"))
        weights, means, covariances = (part.double() for part in parts)
    covariances = (covariances + covariances.mT) / 2
    return GaussianMixture(weights.flatten() / weights.sum(), means, covariances)


def synthetic_prior(n_components: int = 30) -> GaussianMixture:
    """Return a mixture as ill-scaled as the released one: eigenvalues from 1e-6 to 2e4."""
    generator = torch.Generator().manual_seed(0)
    scale = torch.tensor([60.0, 60.0, 0.3] * 5 + [0.1] * 3 + [0.2] * 3, dtype=torch.float64)
    centre = torch.tensor([320.0, 240.0, 2.0] * 5 + [0.0] * 6, dtype=torch.float64)
    means = centre + scale * _normal(generator, n_components, DIM)
    factor = scale[:, None] * _normal(generator, n_components, DIM, 8) / 8**0.5
    values, vectors = torch.linalg.eigh(factor @ factor.mT)
    values = values * (2e4 / values.amax(-1, keepdim=True))
    covariances = (vectors * values.clamp_min(1e-6)[:, None]) @ vectors.mT
    weights = 0.2 + torch.rand(n_components, generator=generator, dtype=torch.float64)
    return GaussianMixture(weights / weights.sum(), means, (covariances + covariances.mT) / 2)


def draw_sequences(problem: Problem, batch: int, n_frames: int, seed: int = 1) -> Tensor:
    """Return measurements [B, T, Z] of states that follow one component for 50 frames, then another."""
    generator = torch.Generator().manual_seed(seed)
    prior = problem.prior
    model = make_transition(
        "paper", prior.means, prior.covariances, torch.diag(problem.process_cov)
    )
    noise = torch.linalg.cholesky(model.noise + 1e-9 * torch.eye(DIM).double())
    component = torch.multinomial(prior.weights, batch, True, generator=generator)
    state, states = prior.means[component], []
    for t in range(n_frames):
        if t % 50 == 49:
            component = torch.multinomial(prior.weights, batch, True, generator=generator)
        jump = noise[component] @ _normal(generator, batch, DIM, 1)
        moved = model.matrix[component] @ state[..., None] + jump
        state = moved[..., 0] + model.offset[component]
        states.append(state[:, problem.observed])
    z = torch.stack(states, 1)
    return z + problem.measurement_cov.sqrt() * _normal(generator, *z.shape)


def make_filter(problem: Problem, **options: object) -> MixtureKalmanFilter:
    """Return the mixture Kalman filter of the problem, without gradients."""
    if options.get("tracks", "fixed") == "fixed":
        options.setdefault("uniform_weight", UNIFORM_WEIGHT)
    parts = (problem.prior, problem.process_cov, problem.measurement_cov, problem.observed)
    return MixtureKalmanFilter(*parts, **options)  # type: ignore[arg-type]


def _normal(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)
