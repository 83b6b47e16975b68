"""Match postures with a performance and gate them (AS 6), for one action or a bank."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.errors import InputError
from torchpose.priors._actions.postures import normalise_postures

GATE_WIDTH = 2.0
"""Deviations on either side of the matched posture that (AS 6) allows."""

CLAMP_ROUNDS = 10
"""In which postures are moved into a gate."""

_MARGIN = 0.9  # of the gate, to which postures are clamped in rounds
_INSIDE = 1 - 1e-6  # of the gate, to which projections are clamped: the border is outside
_CHUNK = 4_000_000  # entries of a table of distances


class Acceptance(NamedTuple):
    """Holds the share of postures that the gate accepts, for each way to choose j.

    Attributes:
        drawn: j drawn from its Gaussian, as in the filter. best: the most likely j. any: any j at all.
    """

    drawn: float
    best: float
    any: float


def match_postures(
    log_weights: Float[Tensor, "*batch K"], uniform: Float[Tensor, "*batch"]
) -> Int[Tensor, "*batch"]:
    """Draw an index for every row, by the inverse of its distribution function.

    Args:
        log_weights: [..., K], of any common factor. uniform: [...], in [0, 1).

    >>> match_postures(torch.tensor([[0.0, 0.0], [0.0, -99.0]]), torch.tensor([0.6, 0.9]))
    tensor([1, 0])
    """
    share = log_weights.softmax(-1).cumsum(-1)
    place = torch.searchsorted(share, (uniform * share[..., -1])[..., None])
    return place.squeeze(-1).clamp_max(log_weights.shape[-1] - 1)


def clamp_offset(
    offset: Float[Tensor, "*batch D"], std: Float[Tensor, "*batch D"], width: float
) -> Float[Tensor, "*batch D"]:
    """Return the offset z - g from a matched posture, moved to just within the gate.

    Args:
        offset: [..., D]. std: sigma of the posture, [..., D]. width: the width of the gate, in sigma.
    """
    reach = _INSIDE * width * std
    return offset.clamp(-reach, reach)


def clamp_in_rounds(
    postures: Float[Tensor, "*batch 36"],
    inside: Bool[Tensor, "*batch"],
    clamp: Callable[[Tensor, float], Tensor],
    width: float,
    rounds: int,
) -> Float[Tensor, "*batch 36"]:
    """Clamp and normalise postures in turn, see `ActionSpace.clamp_postures`.

    Args:
        postures: [..., 36]. inside: [...], those that stay. clamp: postures to the gate of a width.
        width: the width of the gate. rounds: 0 clamps once.
    """
    if rounds < 0:
        raise InputError(f"rounds must be 0 or more, got {rounds}")
    moved = clamp(postures, width) if rounds == 0 else postures
    for _ in range(rounds):
        moved = normalise_postures(clamp(moved, _MARGIN * width))
    return torch.where(inside[..., None], postures, moved)


def passes_any_gate(
    z: Float[Tensor, "N D"],
    performance: Float[Tensor, "K D"],
    std: Float[Tensor, "K D"],
    width: float,
) -> Bool[Tensor, " N"]:
    """Return whether there is any posture of the performance in whose gate z lies."""
    parts = z.split(max(1, _CHUNK // performance.numel()))
    reach = width * std
    near = [((part[:, None] - performance).abs() < reach).all(-1).any(-1) for part in parts]
    return torch.cat(near)


def check_gate_width(width: float) -> None:
    """Check that the width of a gate, in deviations, is positive and finite."""
    if not 0 < width < float("inf"):
        raise InputError(f"the gate's width must be positive, in deviations, got {width}")
