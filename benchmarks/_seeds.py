"""Seeds and generators from names, so that what is drawn for a recording depends on nothing else."""

from typing import Any

import torch

from torchpose.evaluation._trials import settings_hash


def seed_of(*facts: Any) -> int:
    """Return a seed for some facts, such as the name of a recording and a seed of all recordings."""
    return int(settings_hash(facts)[:8], 16)


def generator_of(*facts: Any) -> torch.Generator:
    """Return a generator that has `seed_of` these facts."""
    return torch.Generator().manual_seed(seed_of(*facts))
