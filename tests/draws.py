"""Draw random numbers in tests."""

import torch


def generator(seed: int = 0) -> torch.Generator:
    """A generator of its own, begun at a seed."""
    return torch.Generator().manual_seed(seed)
