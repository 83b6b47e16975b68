"""Bones that are too long or too short for their person, and the joints to blame."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.errors import check_shape
from torchpose.io.recordings import Recording
from torchpose.skeleton.joint_sets import UPPER_BODY
from torchpose.skeleton.upper_body import BONES

__all__ = [
    "BONE_RATIOS",
    "PersonBones",
    "bone_lengths",
    "find_wrong_joints",
    "human_size",
    "person_bones",
]

BONE_RATIOS = (1.75, 2.5, 1.75, 1.75, 2.5, 1.75, 1.75)
"""How many times its usual length a bone may have, or the inverse, in the order of `BONES`. A neck
comes nearer to its shoulders when they are shrugged, so those bones may vary more."""

_SPREADS = 6.0  # robust standard deviations that are never an outlier
_HALF = 0.5  # of the measured bones: with more that are wrong, there is no body
_TO_STD = 1.4826  # of a normal distribution, times the median absolute deviation
_HUMAN = {"shoulders": (0.15, 0.65), "an upper arm": (0.12, 0.5), "a forearm": (0.12, 0.5)}
_NEARER = torch.tensor([nearer for nearer, _ in BONES])
_FARTHER = torch.tensor([farther for _, farther in BONES])


class PersonBones(NamedTuple):
    """Bones of one person: median length in metres and robust spread of its logarithm, each [7]."""

    length: Tensor
    spread: Tensor


class WrongJoints(NamedTuple):
    """Joints [T, 8] at the end of a wrong bone, and frames [T] in which there is no body at all."""

    joints: Tensor
    frames: Tensor


def bone_lengths(joints: Float[Tensor, "... 8 3"]) -> Float[Tensor, "... 7"]:
    """Lengths of `BONES`, NaN where an end is missing.

    >>> bone_lengths(torch.zeros(2, 8, 3)).shape
    torch.Size([2, 7])
    """
    check_shape("joints", joints, ["...", len(UPPER_BODY), 3])
    return (joints[..., _FARTHER, :] - joints[..., _NEARER, :]).norm(dim=-1)


def person_bones(recordings: Sequence[Recording]) -> dict[tuple[str, str | None], PersonBones]:
    """Usual bones of each person, by `person_id` and kind of neck.

    The median over all frames, and 1.4826 times the median distance of the logarithms from it.
    """
    poses: dict[tuple[str, str | None], list[Tensor]] = {}
    for recording in recordings:
        body = recording.upper_body()
        poses.setdefault((recording.person_id, body.neck), []).append(body.joints)
    return {person: _usual(torch.cat(joints)) for person, joints in poses.items()}


def find_wrong_joints(
    joints: Float[Tensor, "T 8 3"],
    usual: PersonBones,
    ratios: tuple[float, ...] = BONE_RATIOS,
) -> WrongJoints:
    """Joints at the ends of bones of a wrong length l: |log l - log L| > max(log r, 6 s).

    Of a wrong bone, that end is to blame at which the larger share of bones is wrong, else the more
    of them, else the farther one. A frame in which more than half of the measured bones are wrong
    holds no body.

    Args:
        joints: metres; NaN where missing.
        usual: L and s of the person. ratios: r of each bone.
    """
    check_shape("joints", joints, [None, len(UPPER_BODY), 3])
    length = bone_lengths(joints)
    there = torch.isfinite(length) & torch.isfinite(usual.length)
    bound = torch.maximum(length.new_tensor(ratios).log(), _SPREADS * usual.spread.nan_to_num(0.0))
    wrong = there & ((length / usual.length).log().abs() > bound)
    ends = torch.zeros(len(BONES), len(UPPER_BODY), dtype=length.dtype)
    bones = torch.arange(len(BONES))
    ends[bones, _NEARER] = ends[bones, _FARTHER] = 1.0
    count = wrong.to(length) @ ends
    share = count / (there.to(length) @ ends).clamp_min(1.0)
    score = share + 0.01 * count
    farther = wrong & (score[:, _FARTHER] >= score[:, _NEARER])
    blamed = torch.zeros(joints.shape[:2], dtype=torch.bool)
    blamed.index_put_(_places(farther, _FARTHER), torch.tensor(True))
    blamed.index_put_(_places(wrong & ~farther, _NEARER), torch.tensor(True))
    nobody = wrong.sum(1) > _HALF * there.sum(1)
    return WrongJoints(blamed, nobody)


def human_size(usual: PersonBones, shoulders: float | None) -> str:
    """What about these bones is no person's, in words; empty if nothing is.

    Args:
        usual: of the person. shoulders: median width in metres, None if unknown.
    """
    length = usual.length.tolist()
    width = math.nan if shoulders is None else shoulders
    for part, values in (
        ("shoulders", (width,)),
        ("an upper arm", (length[2], length[5])),
        ("a forearm", (length[3], length[6])),
    ):
        low, high = _HUMAN[part]
        wrong = [value for value in values if math.isfinite(value) and not low <= value <= high]
        if wrong:
            return (
                f"{part} of {100 * wrong[0]:.0f} cm; people have {100 * low:.0f} to "
                f"{100 * high:.0f} cm"
            )
    return ""


def _usual(joints: Tensor) -> PersonBones:
    length = bone_lengths(joints.double())
    median = length.nanmedian(0).values
    return PersonBones(median, _TO_STD * (length / median).log().abs().nanmedian(0).values)


def _places(bones: Bool[Tensor, "T 7"], ends: Tensor) -> tuple[Tensor, Tensor]:
    frame, bone = torch.nonzero(bones, as_tuple=True)
    return frame, ends[bone]
