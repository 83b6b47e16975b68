"""Hold what recordings tell about feet: how they are turned while legs are in a pose, and how they move."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose._core.module_state import outside_inference
from torchpose._core.tensor_file import FileKind, read_tensors, write_tensors
from torchpose.body._articulation import Articulation, BodyPoint
from torchpose.body._skeleton import other_side

_SHIPPED = Path(__file__).resolve().parents[1] / "weights" / "feet" / "whole-body.safetensors"
_LEG = ("left_thigh", "left_shank", "right_thigh", "right_shank")
# Entries R32 - R23 and R21 - R12 of a matrix, by its axis.
_PLUS, _MINUS = {0: 7, 2: 3}, {0: 5, 2: 1}
_FARTHEST = 3.0  # standard deviations, beyond which angles and rates count no more


@dataclass(frozen=True)
class FootPriorInfo:
    """Holds facts about the fit of a `FootPrior`.

    Attributes:
        name: of the prior. recordings: patterns that it was fitted to, by set. licence: of these and of the
            parameters. command: that made it.
    """

    name: str = ""
    recordings: tuple[str, ...] = ()
    licence: str = ""
    command: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "recordings", tuple(self.recordings))


_KIND = FileKind(
    "torchpose-feet",
    1,
    FootPriorInfo,
    tensors={
        "feature_mean": "F", "feature_std": "F", "slope": "F 3", "mean": "3", "turn_std": "3",
        "turn_rate": "3",
    },
    positive=("feature_std", "turn_std", "turn_rate"),
)  # fmt: skip


class FootPrior(nn.Module):
    """Holds a prior over the rotation of feet relative to their shanks.

    The rotation vector of a left foot is m + A^T f + x. The features f are the turns of both legs (sines of
    angles times axes) and their rates, over their standard deviations. What is left, x, is a critically
    damped process about zero along each axis, with covariance s^2 (1 + r t) exp(-r t) over
    the time t. A right foot is the mirror image.

    Args:
        feature_mean, feature_std: [F], of the features. slope: A [F, 3]. mean: m [3], radians.
        turn_std: s [3], radians. turn_rate: r [3], 1/s. info: facts about the fit.
    """

    feature_mean: Tensor
    feature_std: Tensor
    slope: Tensor
    mean: Tensor
    turn_std: Tensor
    turn_rate: Tensor
    sides: Tensor

    def __init__(
        self,
        feature_mean: Float[Tensor, " F"],
        feature_std: Float[Tensor, " F"],
        slope: Float[Tensor, "F 3"],
        mean: Float[Tensor, " 3"],
        turn_std: Float[Tensor, " 3"],
        turn_rate: Float[Tensor, " 3"],
        info: FootPriorInfo | None = None,
    ) -> None:
        super().__init__()
        own = {
            "feature_mean": feature_mean, "feature_std": feature_std, "slope": slope, "mean": mean,
            "turn_std": turn_std, "turn_rate": turn_rate,
            "sides": torch.tensor([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0]]),
        }  # fmt: skip
        with outside_inference():
            for name, value in own.items():
                self.register_buffer(name, value.detach().double().clone(), persistent=False)
        self.legs = LegTurns(Articulation())
        self.info = info or FootPriorInfo()

    def centre(self, point: BodyPoint) -> Float[Tensor, "*batch 2 3"]:
        """Return the expected rotation vectors m + A^T f of both feet, radians, in the axes of the shanks."""
        features = self.legs.features(point)
        features = (features - self.feature_mean) / self.feature_std
        turned = self.mean + features.clamp(-_FARTHEST, _FARTHEST) @ self.slope
        return turned * self.sides

    def save(self, path: str | Path) -> None:
        """Write the prior as safetensors; the file appears whole or not at all.

        Raises:
            OutputError: the file cannot be written.
        """
        write_tensors(path, _KIND, self.info, {name: getattr(self, name) for name in _KIND.tensors})

    @classmethod
    def load(cls, path: str | Path) -> FootPrior:
        """Read a prior that `save` wrote.

        Raises:
            InputError: no such file. FileFormatError: truncated, foreign, damaged, or newer.
        """
        info, tensors = read_tensors(path, _KIND)
        return cls(**tensors, info=info)


@cache
def shipped_foot_prior() -> FootPrior:
    """Return the prior that comes with the package; read once."""
    return FootPrior.load(_SHIPPED)


class LegTurns(nn.Module):
    """Computes how both legs are turned, and how fast; each foot has its own leg first, the right mirrored.

    Args:
        articulation: of the bodies.
    """

    plus: Tensor
    minus: Tensor
    rates: Tensor
    signs: Tensor

    def __init__(self, articulation: Articulation) -> None:
        super().__init__()
        parts = articulation.skeleton.parts
        turns = zip(articulation.axis_part.tolist(), articulation.axis.tolist(), strict=True)
        places = [(parts[part], axis) for part, axis in turns]
        legs = [(part, axis) for part in _LEG for axis in (0, 2)]
        sides = [legs, [(other_side(part), axis) for part, axis in legs]]
        index = {
            "plus": [[9 * parts.index(p) + _PLUS[a] for p, a in side] for side in sides],
            "minus": [[9 * parts.index(p) + _MINUS[a] for p, a in side] for side in sides],
            "rates": [[3 + places.index(place) for place in side] for side in sides],
        }
        for name, value in index.items():
            self.register_buffer(name, torch.tensor(value), persistent=False)
        mirrored = [1.0 if axis == 0 else -1.0 for _, axis in legs]
        signs = torch.tensor([[1.0] * len(legs), mirrored], dtype=torch.float64)
        self.register_buffer("signs", torch.cat([signs / 2, signs], -1), persistent=False)

    def features(self, point: BodyPoint) -> Float[Tensor, "*batch 2 F"]:
        """Return the turns of both legs, sines of angles times axes, and their rates, 1/s."""
        entries = point.rotations.flatten(-3)
        twice = entries[..., self.plus] - entries[..., self.minus]
        return torch.cat([twice, point.velocity[..., self.rates]], -1) * self.signs
