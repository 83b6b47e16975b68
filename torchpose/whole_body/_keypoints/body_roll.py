"""Find which way a body points in the only camera, so that keypoints can be turned until it is upright.

A camera that is rolled about its optical axis sees a person who stands as a level one sees a person who lies:
rays turned by R_z are exactly those of the rolled camera. Trunk and legs tell the turn, averaged over time,
and nothing is turned while one of the two is about upright: people bend, and sit with their legs stretched.
"""

import math
from typing import NamedTuple, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.body._skeleton import BODY_15

_LIMIT = math.cos(math.radians(60.0))  # from upright, beyond which a body is turned
_TIME = 0.3  # seconds over which directions are averaged
_LEAST_HIPS = 2  # of both and the pelvis: trunk and legs both depend on them
_CLEAR = 0.5  # length of an average of unit directions, below which they contradict each other
_CHAIN = (("left_shoulder", "right_shoulder", "neck"), ("left_hip", "right_hip", "pelvis"),
          ("left_ankle", "right_ankle"))  # fmt: skip
_JOINTS = [[BODY_15.joint(name) for name in names] for names in _CHAIN]


class BodyRoll(NamedTuple):
    """Holds how a body points in an image whose y points down.

    Attributes:
        limbs: [*batch, 2, 2], mean unit directions from hips to shoulders and from ankles to hips; 0 where
            they have not been seen. up: [*batch, 2], the unit direction that is taken to be upwards.
    """

    limbs: Tensor
    up: Tensor

    @classmethod
    def upright(cls, like: Float[Tensor, "*batch"]) -> Self:
        """Return what is taken of bodies before they are seen."""
        up = torch.tensor([0.0, -1.0]).to(like)
        return cls(like.new_zeros(*like.shape, 2, 2), up.expand(*like.shape, 2))

    @property
    def turn(self) -> Float[Tensor, "*batch 3 3"]:
        """Return the rotation about the optical axis after which the bodies are upright."""
        return turn_upright(self.up)


def turn_upright(up: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation about the optical axis that turns a unit direction in the image to -y."""
    x, y = (-up).unbind(-1)
    o, one = torch.zeros_like(x), torch.ones_like(x)
    rows = [[y, -x, o], [x, y, o], [o, o, one]]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def next_roll(
    roll: BodyRoll, rays: Float[Tensor, "B J 2"], there: Bool[Tensor, "B J"], fps: float
) -> tuple[BodyRoll, Bool[Tensor, " B"]]:
    """Return how bodies point after a frame, and which are taken to point elsewhere than before.

    Args:
        roll: after the frame before. rays: (x, y) of K^-1 [u, v, 1]. there: which keypoints there are.
        fps: frames per second.
    """
    limbs = _averaged(roll.limbs, _limbs(rays, there), 1 - math.exp(-1 / (_TIME * fps)))
    level = torch.zeros_like(roll.up)
    level[:, 1] = -1.0
    whole = torch.nn.functional.normalize(limbs.sum(1), dim=-1)
    whole = torch.where((whole * level).sum(-1, keepdim=True) > _LIMIT, level, whole)
    away = _away(limbs, roll.up)
    up = torch.where(away[:, None], whole, roll.up)
    return BodyRoll(limbs, up), away


def _away(limbs: Float[Tensor, "B 2 2"], up: Float[Tensor, "B 2"]) -> Bool[Tensor, " B"]:
    """Return where trunk and legs both point far from a direction, and not against each other."""
    along, length = (limbs * up[:, None]).sum(-1), limbs.norm(dim=-1)
    far = ((along < _LIMIT * length) & (length > _CLEAR)).all(-1)
    return far & (limbs.prod(1).sum(-1) > 0.0)


def _limbs(rays: Float[Tensor, "B J 2"], there: Bool[Tensor, "B J"]) -> Float[Tensor, "B 2 2"]:
    """Return unit directions from hips to shoulders and from ankles to hips, NaN where one is not seen."""
    known = rays.masked_fill(~there[..., None], torch.nan)
    top, middle, low = (known[:, joints].nanmedian(1).values for joints in _JOINTS)
    limbs = torch.stack([top - middle, middle - low], 1)
    told = there[:, _JOINTS[1]].sum(-1) >= _LEAST_HIPS
    return (limbs / limbs.norm(dim=-1, keepdim=True)).masked_fill(~told[:, None, None], torch.nan)


def _averaged(
    before: Float[Tensor, "B 2 2"], now: Float[Tensor, "B 2 2"], share: float
) -> Float[Tensor, "B 2 2"]:
    """Return averages with the values of a frame; the first one counts for all before."""
    first = (before == 0.0).all(-1, keepdim=True)
    mean = torch.where(first, now, torch.lerp(before, now, share))
    return torch.where(now.isfinite(), mean, before)
