"""Cyclic motions of 30 columns, as smooth as walking, with noise of a known size; a prior over motion."""

import math

import torch
from torch import Tensor

from tests.priors.mixtures import random_mixture
from torchpose.body._articulation import Articulation
from torchpose.priors._body_motion import BodyMotion

CYCLE, NOISE = 66, 0.01  # frames of a cycle at 60 Hz; standard deviation of each column


def motion(
    frames: int, phase: float = 0.0, seed: int = 0, speed: float = 1.0, noise: float = NOISE
) -> Tensor:
    """Poses [frames, 30]: the same three harmonics whatever the seed, which is of the noise only."""
    loadings = torch.Generator().manual_seed(0)
    sizes = torch.tensor([0.25, 0.25, 0.08, 0.08, 0.03, 0.03], dtype=torch.float64)
    weights = torch.randn(6, 30, generator=loadings, dtype=torch.float64) * sizes[:, None]
    rest = 0.1 * torch.randn(30, generator=loadings, dtype=torch.float64)
    angle = phase + speed * 2 * math.pi * torch.arange(frames, dtype=torch.float64) / CYCLE
    waves = [wave for n in (1, 2, 3) for wave in ((n * angle).sin(), (n * angle).cos())]
    generator = torch.Generator().manual_seed(100 + seed)
    shaken = torch.randn(frames, 30, generator=generator, dtype=torch.float64)
    return rest + torch.stack(waves, 1) @ weights + noise * shaken


def some_body_motion(**changed) -> BodyMotion:
    """A prior over the motion of bodies, of which some arguments are others."""
    body = Articulation()
    n_angles = body.relative_columns.stop - body.relative_columns.start
    given = {
        "acceleration": torch.full((body.n_pose,), 3.0).double(),
        "decay": torch.full((body.n_pose,), 4.0).double(),
        "shift_std": torch.full((len(body.shifted),), 0.02).double(),
        "shift_time": torch.tensor([0.5]).double(),
        "pull_time": torch.tensor([1.0]).double(),
        "scale_mean": torch.zeros(len(body.groups)).double(),
        "scale_cov": 0.01 * torch.eye(len(body.groups)).double(),
        "poses": random_mixture(3, n_angles),
    }
    return BodyMotion(**(given | changed))
