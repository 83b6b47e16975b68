"""Made-up actions of 36 angles: smooth loops through the space of postures, in many speeds and styles."""

import math

import torch
from torch import Tensor


def performances(
    count: int = 12, action: int = 0, frames: int = 40, noise: float = 2.0, seed: int = 0
) -> list[Tensor]:
    """From a start posture to the farthest one and back, each at a speed and in a manner of its own."""
    shape = torch.Generator().manual_seed(1000 + action)
    loadings = torch.randn(4, 36, generator=shape, dtype=torch.float64)
    rest = 10 * torch.randn(36, generator=shape, dtype=torch.float64)
    scale = torch.tensor([30.0, 15.0, 8.0, 4.0], dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    found = []
    for _ in range(count):
        length = frames + int(torch.randint(-frames // 4, frames // 4, (), generator=generator))
        early = 0.25 * (torch.rand((), generator=generator, dtype=torch.float64) - 0.5)
        t = torch.linspace(0, 1, length, dtype=torch.float64)
        phase = 2 * math.pi * (t + early * t * (1 - t))
        waves = torch.stack([1 - phase.cos(), phase.sin(), (2 * phase).sin(), (2 * phase).cos()], 1)
        style = 1 + 0.05 * torch.randn(4, generator=generator, dtype=torch.float64)
        offset = noise * torch.randn(36, generator=generator, dtype=torch.float64)
        shaken = 0.1 * noise * torch.randn(length, 36, generator=generator, dtype=torch.float64)
        found.append(rest + offset + (waves * scale * style) @ loadings / 2 + shaken)
    return found
