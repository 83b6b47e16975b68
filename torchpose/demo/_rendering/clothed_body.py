"""Clothe recorded joints in another body than the tracker's.

A tracker's body has constant bone lengths and one or two tapered cylinders for each part. Here the
joints are the recorded ones, with all of the joint set (spine, hands, toes). The torso is a bundle of
cylinders in other places, hands, feet and head have other lengths, and the radius of every limb has a
factor of its own. So the images differ from a tracker's model.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from torchpose.body._limbs import Limbs
from torchpose.body._skeleton import BODY_15
from torchpose.io._mocap import MocapClip
from torchpose.skeleton._joint_sets import canonical_names

_SIDES = ("left", "right")
_LEG = 0.84
"""Length of thigh and shank, metres, of the person whose radii the tables below hold."""

# name, start, end, radii (m); X stands for the side
_LIMBS_OF_SIDES = (
    ("upper arm", "shoulder_X", "elbow_X", 0.056, 0.041),
    ("forearm", "elbow_X", "wrist_X", 0.044, 0.030),
    ("hand", "wrist_X", "hand_tip_X", 0.033, 0.030),
    ("thigh", "groin_X", "knee_X", 0.084, 0.060),
    ("shank", "knee_X", "ankle_X", 0.058, 0.038),
    ("foot", "heel_X", "ball_X", 0.036, 0.042),
    ("toes", "ball_X", "toe_tip_X", 0.040, 0.024),
    ("flank", "waist_X", "chest_X", 0.086, 0.092),
    ("buttock", "groin_X", "waist_X", 0.086, 0.084),
    ("shoulder blade", "chest_X", "shoulder_X", 0.080, 0.058),
    ("collar", "throat", "shoulder_X", 0.056, 0.052),
)
_LIMBS_OF_MIDDLE = (
    ("belly", "pelvis_front", "waist_front", 0.082, 0.084),
    ("breast", "waist_front", "chest_front", 0.084, 0.088),
    ("neck", "throat", "skull", 0.060, 0.056),
    ("skull", "skull", "crown", 0.086, 0.072),
    ("face", "jaw", "skull", 0.052, 0.070),
)


@dataclass(frozen=True)
class TrueShape:
    """Holds the differences of one person's outline from the average one.

    Args:
        radii: factor of each kind of limb, the same on both sides. lengths: factor of hands, feet
            and head. depth: factor of the depth of belly and breast.
    """

    radii: Mapping[str, float]
    lengths: Mapping[str, float]
    depth: float = 1.0

    @classmethod
    def draw(cls, seed: int, spread: float = 0.12) -> "TrueShape":
        """Return a person drawn from a seed: factors exp(spread n), n standard normal.

        Args:
            seed: the seed of the person. spread: standard deviation of the logarithm.
        """
        generator = torch.Generator().manual_seed(seed)
        kinds = [row[0] for row in (*_LIMBS_OF_SIDES, *_LIMBS_OF_MIDDLE)]
        n = len(kinds)
        drawn = torch.randn(n + 4, generator=generator, dtype=torch.float64)
        factors = (spread * drawn).clamp(-2.5 * spread, 2.5 * spread).exp().tolist()
        lengths = dict(zip(("hand", "foot", "head"), factors[n : n + 3], strict=True))
        return cls(dict(zip(kinds, factors[:n], strict=True)), lengths, factors[-1])


def true_limbs(clip: MocapClip, shape: TrueShape) -> Limbs:
    """Return the tapered cylinders around the recorded joints, [T, L, 3] and radii [L, 2]."""
    points, scale = _points(clip, shape)
    rows = [
        (kind, a.replace("X", side), b.replace("X", side), r, s)
        for kind, a, b, r, s in _LIMBS_OF_SIDES
        for side in _SIDES
    ]
    rows += list(_LIMBS_OF_MIDDLE)
    start = torch.stack([points[row[1]] for row in rows], -2)
    end = torch.stack([points[row[2]] for row in rows], -2)
    radii = torch.tensor(
        [[scale * shape.radii[kind] * r for r in (r0, r1)] for kind, _, _, r0, r1 in rows],
        dtype=start.dtype,
    )
    return Limbs(start, end, radii)


def limb_kinds() -> list[str]:
    """Return the kind of each limb of `true_limbs`, such as "forearm"."""
    sides = [row[0] for row in _LIMBS_OF_SIDES for _ in _SIDES]
    return [*sides, *(row[0] for row in _LIMBS_OF_MIDDLE)]


# --- where the outline is -------------------------------------------------------------------------


def _points(clip: MocapClip, shape: TrueShape) -> tuple[dict[str, Tensor], float]:
    """Return named points [T, 3] of the outline, and the person's size relative to the tables'."""
    joints = dict(zip(BODY_15.names, clip.joints.unbind(1), strict=True))
    extra = dict(zip(canonical_names(clip.names), clip.recorded.unbind(1), strict=True))
    scale = _size(joints) / _LEG
    across = normalize(
        joints["left_hip"] - joints["right_hip"]
        + joints["left_shoulder"] - joints["right_shoulder"], dim=-1
    )  # fmt: skip
    spine = normalize(joints["neck"] - joints["pelvis"], dim=-1)
    forward = normalize(torch.linalg.cross(across, spine), dim=-1)
    points = _trunk(joints, extra, across, forward, scale, shape)
    points |= _head(joints, spine, forward, scale * shape.lengths["head"])
    for side in _SIDES:
        points |= _arm(side, joints, extra, scale * shape.lengths["hand"])
        points |= _leg(side, joints, extra, across, clip.up, scale, shape)
    return points, scale


def _size(joints: Mapping[str, Tensor]) -> float:
    """Return the length of a leg, metres."""
    bones = [
        (joints[f"{side}_{a}"] - joints[f"{side}_{b}"]).norm(dim=-1)
        for side in _SIDES
        for a, b in (("hip", "knee"), ("knee", "ankle"))
    ]
    return float(torch.stack(bones).nanmean()) * 2


def _trunk(
    joints: Mapping[str, Tensor],
    extra: Mapping[str, Tensor],
    across: Float[Tensor, "T 3"],
    forward: Float[Tensor, "T 3"],
    scale: float,
    shape: TrueShape,
) -> dict[str, Tensor]:
    """Return points of the trunk about the spine, which is bent if the joint set has its joints."""
    pelvis, neck = joints["pelvis"], joints["neck"]
    waist = extra.get("lower_back", pelvis + 0.25 * (neck - pelvis))
    chest = extra.get("thorax", extra.get("upper_back", pelvis + 0.72 * (neck - pelvis)))
    out = scale * shape.depth
    points = {
        "pelvis_front": pelvis + 0.035 * out * forward,
        "waist_front": waist + 0.045 * out * forward,
        "chest_front": chest + 0.04 * out * forward,
        "throat": neck + 0.01 * scale * forward,
    }
    for side, sign in zip(_SIDES, (1.0, -1.0), strict=True):
        hip = joints[f"{side}_hip"]
        points[f"groin_{side}"] = hip + 0.01 * sign * scale * across
        points[f"waist_{side}"] = waist + (0.065 * sign * across + 0.01 * forward) * scale
        points[f"chest_{side}"] = chest + (0.075 * sign * across + 0.01 * forward) * scale
    return points


def _head(
    joints: Mapping[str, Tensor],
    spine: Float[Tensor, "T 3"],
    forward: Float[Tensor, "T 3"],
    scale: float,
) -> dict[str, Tensor]:
    """Return a skull whose middle is 17 cm above the neck on the way to the head, if there is one."""
    measured = normalize(joints["head"] - joints["neck"], dim=-1)
    along = torch.where(measured.isfinite().all(-1, keepdim=True), measured, spine)
    skull = joints["neck"] + 0.17 * scale * along
    jaw = skull + scale * (0.045 * forward - 0.06 * along)
    return {"skull": skull, "crown": skull + 0.06 * scale * along, "jaw": jaw}


def _arm(
    side: str, joints: Mapping[str, Tensor], extra: Mapping[str, Tensor], scale: float
) -> dict[str, Tensor]:
    elbow, wrist = joints[f"{side}_elbow"], joints[f"{side}_wrist"]
    direction = normalize(wrist - elbow, dim=-1)
    hand = extra.get(f"fingers_{side}", extra.get(f"hand_{side}"))
    if hand is not None:
        measured = hand - wrist
        far = (measured.norm(dim=-1, keepdim=True) > 0.02) & measured.isfinite().all(-1, True)
        direction = torch.where(far, normalize(measured, dim=-1), direction)
    return {
        f"shoulder_{side}": joints[f"{side}_shoulder"],
        f"elbow_{side}": elbow,
        f"wrist_{side}": wrist,
        f"hand_tip_{side}": wrist + 0.14 * scale * direction,
    }


def _leg(
    side: str,
    joints: Mapping[str, Tensor],
    extra: Mapping[str, Tensor],
    across: Float[Tensor, "T 3"],
    up: Float[Tensor, "3"],
    scale: float,
    shape: TrueShape,
) -> dict[str, Tensor]:
    """Return points of a leg; without a recorded foot it is at a right angle to the shank."""
    knee, ankle = joints[f"{side}_knee"], joints[f"{side}_ankle"]
    shank = normalize(knee - ankle, dim=-1)
    toe = next((extra[k] for k in (f"foot_{side}", f"toe_{side}", f"big_toe_{side}") if k in extra),
               None)  # fmt: skip
    if toe is None:
        ahead = normalize(torch.linalg.cross(across, shank), dim=-1) - 0.25 * shank
        direction = normalize(ahead, dim=-1)
    else:
        direction = normalize(toe - ankle, dim=-1)
    length = scale * shape.lengths["foot"]
    ball = ankle + 0.115 * length * direction
    return {
        f"knee_{side}": knee,
        f"ankle_{side}": ankle,
        f"heel_{side}": ankle - 0.035 * scale * (shank + direction),
        f"ball_{side}": ball,
        f"toe_tip_{side}": ball + 0.06 * length * (direction - 0.2 * up),
    }
