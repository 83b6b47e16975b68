"""Lift the keypoints of one camera to joints by a causal network, with how far off it usually is."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose._core.network_file import FittedNetwork
from torchpose._core.tensor_file import FileKind
from torchpose.body._skeleton import BODY_15

_SHIPPED = Path(__file__).resolve().parents[1] / "weights" / "lifting"
_JOINTS = len(BODY_15.names)
INPUTS = 4 * _JOINTS + 4
"""Number of `lifting_features`."""
_WIDTH, _LAYERS = 256, 2
MEMORY = (_LAYERS, _WIDTH)
"""Sizes of the state of the recurrent network."""
_UNIT = 0.3  # metres of an output
_RATE, _RATES = 60.0, (0.25, 1.0)  # frames per second of an input, and its limits
_FARTHEST, _SMALLEST = 5.0, 1e-3  # extents of a body from its middle; extent of a ray
_USUAL = 0.1  # extent of the rays of a body of which nothing is seen


@dataclass(frozen=True)
class LiftingNetworkInfo:
    """Holds facts about the fit of a `LiftingNetwork`.

    Attributes:
        name: of the network. recordings: patterns that it was fitted to, by set. licence: of these and of
            the parameters. command: that made it. legs: metres of thigh and shank of the persons, on average.
    """

    name: str = ""
    recordings: tuple[str, ...] = ()
    licence: str = ""
    command: str = ""
    legs: float = 0.8

    def __post_init__(self) -> None:
        object.__setattr__(self, "recordings", tuple(self.recordings))


_KIND = FileKind("torchpose-lifting", 1, LiftingNetworkInfo)


class Lifted(NamedTuple):
    """Holds joints of `BODY_15` that a network found.

    Attributes:
        joints: [..., J, 3], metres from the pelvis, camera axes. std: [..., J], metres, along every axis.
    """

    joints: Tensor
    std: Tensor


class LiftingNetwork(FittedNetwork):
    """Computes the joints of a body relative to its pelvis from keypoints of one camera, frame by frame.

    Two layers of gated recurrent units and a linear one. A second linear layer, of the same features, tells
    the standard deviation of every joint. 0.66 million parameters.

    Args:
        info: facts about the fit.
    """

    _kind, _words = _KIND, "a network that lifts keypoints"

    def __init__(self, info: LiftingNetworkInfo | None = None) -> None:
        super().__init__(info)
        self.cells = nn.GRU(INPUTS, _WIDTH, _LAYERS, batch_first=True)
        self.places = nn.Linear(_WIDTH, 3 * _JOINTS)
        self.spread = nn.Linear(_WIDTH, _JOINTS)

    def forward(
        self, seen: Float[Tensor, "B T F"], memory: Float[Tensor, "B L W"] | None = None
    ) -> tuple[Lifted, Float[Tensor, "B L W"]]:
        """Return the joints of every frame, and the state of the recurrent network.

        In training the standard deviations pass no gradients on to the layers that they share with the
        joints.

        Args:
            seen: of `lifting_features`. memory: from the call before; None at the beginning.
        """
        before = None if memory is None else memory.transpose(0, 1).contiguous()
        features, after = self.cells(seen, before)
        joints = self.places(features).unflatten(-1, (_JOINTS, 3))
        shared = features.detach() if self.training else features
        log_std = self.spread(shared)
        return Lifted(_UNIT * joints, _UNIT * log_std.exp()), after.transpose(0, 1)


def lifting_features(
    rays: Float[Tensor, "*batch J 2"], confidence: Float[Tensor, "*batch J"], fps: float
) -> Float[Tensor, "*batch F"]:
    """Return the inputs of a `LiftingNetwork`.

    They are the rays relative to the median of those that there are, in units of their median extent, which
    of them there are and how sure, that median, the log of that extent, and the frame rate.

    Args:
        rays: (x, y) of K^-1 [u, v, 1], anything finite where there is no keypoint.
        confidence: of the keypoints, 0 where there is none. fps: frames per second.
    """
    there = confidence > 0.0
    known = rays.masked_fill(~there[..., None], torch.nan)
    middle = known.nanmedian(-2, keepdim=True).values.nan_to_num()
    off = torch.where(there[..., None], rays - middle, 0.0)  # no NaN, of which gradients are NaN
    extent = off.norm(dim=-1).masked_fill(~there, torch.nan).nanmedian(-1).values
    extent = extent.nan_to_num(_USUAL).clamp_min(_SMALLEST)
    apart = (off / extent[..., None, None]).clamp(-_FARTHEST, _FARTHEST)
    rate = torch.full_like(extent, min(max(fps / _RATE, _RATES[0]), _RATES[1]))
    parts = (
        apart.flatten(-2),
        there,
        confidence,
        middle[..., 0, :],
        extent.log()[..., None],
        rate[..., None],
    )
    return torch.cat([part.to(rays) for part in parts], -1)


@cache
def shipped_lifting_network(name: str = "whole-body") -> LiftingNetwork:
    """Return a network that comes with the package; read once.

    Args:
        name: "whole-body", or "upper-body", which was fitted on, to people whose hips and legs are hidden.
    """
    return LiftingNetwork.load(_SHIPPED / f"{name}.safetensors")
