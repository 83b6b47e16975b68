"""Cyclic motions of 30 columns, as smooth as walking, and with noise of a known size."""

import math

import torch
from torch import Tensor

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
