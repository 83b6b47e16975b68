"""Lift the joints that one camera sees to both arms, frame by frame, with how far off they are."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchpose._core.network_file import FittedNetwork
from torchpose._core.tensor_file import FileKind
from torchpose.camera._virtual_camera import axes_along

_SHIPPED = Path(__file__).resolve().parents[1] / "weights" / "lifting" / "arms.safetensors"
_ARM = ("shoulder", "elbow", "hand")
JOINTS = (*(f"{joint}_{side}" for side in ("left", "right") for joint in _ARM), "head")
"""Joints that are lifted from, beside the neck."""
_N = len(JOINTS)
INPUTS = 4 * _N + 2
"""Number of `arm_features`."""
_WIDTH = 512
_UNIT = 0.2  # metres of an output
_MEMORY = 30.0  # seconds after which the extent of a joint counts for 1/e
_SMALLEST = 1e-3  # extent, of rays
_LARGEST = 5.0  # of rays that are far beside
_NEAREST = 0.05  # least depth of a ray


@dataclass(frozen=True)
class ArmLifterInfo:
    """Holds facts about the fit of an `ArmLifter`.

    Attributes:
        name: of the network. recordings: sets that it was fitted to. left_out: persons of these that it was
            not fitted to. licence: of the recordings and of the parameters. command: that made it.
    """

    name: str = ""
    recordings: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    licence: str = ""
    command: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "recordings", tuple(self.recordings))
        object.__setattr__(self, "left_out", tuple(self.left_out))


class LiftedArms(NamedTuple):
    """Holds both arms as a network has them.

    Attributes:
        ends: elbow and hand of left and right arm, metres from their shoulder, [..., 2, 2, 3].
        std: [..., 2, 2], metres, along every axis.
    """

    ends: Tensor
    std: Tensor


class ArmLifter(FittedNetwork):
    """Computes elbows and hands relative to the shoulders from `arm_features` of single frames.

    Two hidden layers. A second linear layer, of the same features, tells the standard deviation of every
    elbow and hand. 0.29 million parameters.

    Args:
        info: facts about the fit.
    """

    _kind = FileKind("torchpose-arm-lifter", 1, ArmLifterInfo)
    _words = "a network that lifts arms"

    def __init__(self, info: ArmLifterInfo | None = None) -> None:
        super().__init__(info)
        self.hidden = nn.Sequential(
            nn.Linear(INPUTS, _WIDTH), nn.ReLU(), nn.Linear(_WIDTH, _WIDTH), nn.ReLU()
        )
        self.bones = nn.Linear(_WIDTH, 12)
        self.spread = nn.Linear(_WIDTH, 4)

    def forward(self, seen: Float[Tensor, "*batch F"]) -> LiftedArms:
        """Return the arms that go with these features.

        In training the standard deviations pass no gradients on to the layers that they share with the arms.
        """
        features = self.hidden(seen)
        ends = self.bones(features).unflatten(-1, (2, 2, 3)).cumsum(-2)
        shared = features.detach() if self.training else features
        log_std = self.spread(shared).unflatten(-1, (2, 2))
        return LiftedArms(_UNIT * ends, _UNIT * log_std.exp())


def from_neck(
    rays: Float[Tensor, "*batch J 3"], neck: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch J 2"], Float[Tensor, "*batch 3 3"]]:
    """Return rays as a camera has them that looks at the neck, and the axes of that camera as columns.

    Args:
        rays, neck: K^-1 [u, v, 1].
    """
    axes = axes_along(neck)
    seen = rays @ axes
    return (seen[..., :2] / seen[..., 2:].clamp_min(_NEAREST)).clamp(-_LARGEST, _LARGEST), axes


def farthest_so_far(
    rays: Float[Tensor, "B T J 2"],
    given: Bool[Tensor, "B T J"],
    before: Float[Tensor, "B J"],
    fps: float,
) -> Float[Tensor, "B T J"]:
    """Return how far from the neck each joint was seen so far; what is long ago counts less.

        e_t = max(|r_t|, e_(t-1) exp(-1 / (30 s f)))

    Args:
        rays: of `from_neck`. given: which joints are measured. before: e after the frame before, 0 at the
            beginning. fps: frames per second f.
    """
    frames = torch.arange(1, rays.shape[1] + 1, device=rays.device).to(rays)
    faded = (frames / (_MEMORY * fps))[:, None]
    logs = torch.where(given, rays.norm(dim=-1), 0.0).log() + faded
    return (torch.cat([before[:, None].log(), logs], 1).cummax(1).values[:, 1:] - faded).exp()


def arm_features(
    rays: Float[Tensor, "*batch J 2"],
    given: Bool[Tensor, "*batch J"],
    farthest: Float[Tensor, "*batch J"],
    wrists: bool,
) -> Float[Tensor, "*batch F"]:
    """Return the inputs of an `ArmLifter`.

    They are the rays of `JOINTS` and how far from the neck these were seen so far, in units of the largest
    of these distances, the log of that, which joints are measured, and whether hands are wrists.

    Args:
        rays: of `from_neck`. given: which joints are measured. farthest: of `farthest_so_far`.
        wrists: whether hands are measured at the wrist.
    """
    largest = farthest.amax(-1, keepdim=True).clamp_min(_SMALLEST)
    apart = torch.where(given[..., None], rays, 0.0) / largest[..., None]
    kind = torch.full_like(largest, float(wrists))
    parts = apart.flatten(-2), farthest / largest, largest.log(), given.to(rays), kind
    return torch.cat(parts, -1)


@cache
def shipped_arm_lifter() -> ArmLifter:
    """Return the network that comes with the package; read once."""
    return ArmLifter.load(_SHIPPED)
