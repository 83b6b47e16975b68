"""How many covariances had to be mended before they factorised, by frame and batch element."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

if TYPE_CHECKING:
    from torchpose.filters.gains import Edge

__all__ = ["Mending", "mending", "mending_of_edges", "stacked"]


class Mending(NamedTuple):
    """What `mended_cholesky` had to do.

    Attributes:
        mended: number of covariances that got a jitter, [B] or [B, T].
        jitter: the largest of them, as a share of each variance, [B] or [B, T], float64.
    """

    mended: Tensor
    jitter: Tensor


def mending(like: Float[Tensor, "B *rest"], *jitters: Tensor | None) -> Mending:
    """Sum up one frame.

    Args:
        like: tells the number of elements and the device.
        jitters: of its covariances, [B, ...] each; None where all factorised as they were.
    """
    found = [jitter.reshape(len(like), -1) for jitter in jitters if jitter is not None]
    if not found:
        mended = torch.zeros(len(like), dtype=torch.long, device=like.device)
        return Mending(mended, mended.double())
    joint = torch.cat(found, 1)
    return Mending((joint > 0).sum(1), joint.double().amax(1))


def stacked(frames: Sequence[Mending]) -> Mending:
    """Return the sums of several frames [B] as one [B, T]."""
    mended = torch.stack([frame.mended for frame in frames], 1)
    return Mending(mended, torch.stack([frame.jitter for frame in frames], 1))


def mending_of_edges(edges: "Sequence[list[Edge]]", group: Tensor) -> Mending:
    """Sum up all frames of sequences that share their gains.

    Args:
        edges: per frame, one for each history of masks, or a single one for all.
        group: history of each element [B].
    """
    mended = torch.zeros(len(group), len(edges), dtype=torch.long, device=group.device)
    jitter = mended.double()
    for t, taken in enumerate(edges):
        if any(edge.mended for edge in taken):
            own = group if len(taken) > 1 else torch.zeros_like(group)
            mended[:, t] = mended.new_tensor([edge.mended for edge in taken])[own]
            jitter[:, t] = jitter.new_tensor([edge.jitter for edge in taken])[own]
    return Mending(mended, jitter)
