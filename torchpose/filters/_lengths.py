"""Tell the frames of sequences that are shorter than their batch, and fill those past their ends."""

import torch
from jaxtyping import Bool, Int, Shaped
from torch import Tensor


def inside_lengths(lengths: Int[Tensor, " B"], n_frames: int) -> Bool[Tensor, "B T"]:
    """Return True up to the length of each sequence."""
    return torch.arange(n_frames, device=lengths.device) < lengths[:, None]


def held_past_lengths(
    values: Shaped[Tensor, "B T *rest"], lengths: Int[Tensor, " B"]
) -> Shaped[Tensor, "B T *rest"]:
    """Return values with the last one of each sequence repeated past its length."""
    batch, n_frames = values.shape[:2]
    held = torch.minimum(torch.arange(n_frames, device=lengths.device), lengths[:, None] - 1)
    return values[torch.arange(batch, device=lengths.device)[:, None], held]
