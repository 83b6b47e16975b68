"""Measure the bones of recorded persons, find wrong ones, and scale, mirror or turn bodies."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from torchpose._core.checks import check_shape
from torchpose.errors import InputError
from torchpose.io._recordings import Recording
from torchpose.learning._curation.joints import with_upper_joints
from torchpose.learning._training import MIRROR
from torchpose.skeleton._joint_sets import UPPER_BODY, canonical_names
from torchpose.skeleton._upper_body import BONES, scale_bones

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
    """Holds the bones of one person: median length in metres and robust spread of its logarithm, each [7]."""

    length: Tensor
    spread: Tensor


class WrongJoints(NamedTuple):
    """Marks the joints [T, 8] at the end of a wrong bone, and frames [T] in which there is no body at all."""

    joints: Tensor
    frames: Tensor


def bone_lengths(joints: Float[Tensor, "... 8 3"]) -> Float[Tensor, "... 7"]:
    """Return the lengths of `BONES`, NaN where an end is missing.

    >>> bone_lengths(torch.zeros(2, 8, 3)).shape
    torch.Size([2, 7])
    """
    check_shape("joints", joints, ["...", len(UPPER_BODY), 3])
    return (joints[..., _FARTHER, :] - joints[..., _NEARER, :]).norm(dim=-1)


def person_bones(recordings: Sequence[Recording]) -> dict[tuple[str, str | None], PersonBones]:
    """Return the usual bones of each person, by `person_id` and kind of neck.

    The median over all frames, and 1.4826 times the median distance of the logarithms from it.
    """
    poses: dict[tuple[str, str | None], list[Tensor]] = {}
    for recording in recordings:
        body = recording.upper_body()
        poses.setdefault((recording.person_id, body.neck), []).append(body.joints)
    return {person: _usual(torch.cat(joints)) for person, joints in poses.items()}


def find_wrong_joints(
    joints: Float[Tensor, "T 8 3"], usual: PersonBones, ratios: tuple[float, ...] = BONE_RATIOS
) -> WrongJoints:
    """Find joints at the ends of bones of a wrong length l: |log l - log L| > max(log r, 6 s).

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
    blamed.index_put_(_frames_and_joints(farther, _FARTHER), torch.tensor(True))
    blamed.index_put_(_frames_and_joints(wrong & ~farther, _NEARER), torch.tensor(True))
    nobody = wrong.sum(1) > _HALF * there.sum(1)
    return WrongJoints(blamed, nobody)


def human_size(usual: PersonBones, shoulders: float | None) -> str:
    """Return in words which bones are not of human size; an empty text if all are.

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


def _frames_and_joints(bones: Bool[Tensor, "T 7"], ends: Tensor) -> tuple[Tensor, Tensor]:
    frame, bone = torch.nonzero(bones, as_tuple=True)
    return frame, ends[bone]


def harmonise_bones(recordings: Sequence[Recording]) -> list[Recording]:
    """Give every person the bones of the mean person and keep the directions.

    Each of a person's bones is scaled by (mean over persons of median lengths) / (that person's
    median length). Bones that a person lacks stay out of the mean, and keep their length. Joints
    that are none of the eight stay where they are.

    Raises:
        InputError: no recordings.
    """
    if not recordings:
        raise InputError("expected at least one recording, got none")
    usual = person_bones(recordings)
    mean = torch.stack([bones.length for bones in usual.values()]).nanmean(0)
    harmonised = []
    for recording in recordings:
        body = recording.upper_body()
        factors = (mean / usual[recording.person_id, body.neck].length).nan_to_num(1.0)
        joints = scale_bones(body.joints, factors.to(body.joints.dtype))
        note = "bones scaled to the mean person's"
        changed = with_upper_joints(recording, joints)
        harmonised.append(replace(changed, notes=(*recording.notes, note)))
    return harmonised


def mirrored(recording: Recording) -> Recording:
    """Mirror a recording at x = 0, so that left joints become right ones.

    It is of the same person, so that splits keep both together. Joints whose counterpart is not in
    the joint set become missing.
    """
    names = canonical_names(recording.names)
    other = [names.index(n) if n in names else -1 for n in map(_counterpart, names)]
    absent = torch.tensor(other) < 0
    order = torch.tensor(other).clamp_min(0)
    joints = recording.joints[:, order] * MIRROR.to(recording.joints)
    joints = torch.where(absent[:, None], torch.nan, joints)
    weights = recording.weights
    if weights is not None:
        weights = torch.where(absent, 0.0, weights[:, order])
    notes = (*recording.notes, "mirrored")
    return replace(recording, joints=joints, weights=weights, notes=notes)


def _counterpart(name: str) -> str:
    if name.endswith("_left"):
        return name.removesuffix("left") + "right"
    if name.endswith("_right"):
        return name.removesuffix("right") + "left"
    return name


_NECK, _LEFT, _RIGHT = 4, 2, 5  # in UPPER_BODY


def torso_rotation(
    across: Float[Tensor, "... 3"], up: Float[Tensor, "... 3"] | None = None
) -> Float[Tensor, "... 3 3"]:
    """Return the rotation after which a torso faces the camera: R with rows x, y, z.

        x = a / |a|,  y = -(u - (u . x) x) / |...|,  z = x × y

    so that a, from the right to the left shoulder, is along x and u points up (-y). Without u the
    body is turned about the vertical alone.

    Args:
        across: a, camera axes, of any length. up: u, from the hips to the neck.

    >>> torso_rotation(torch.tensor([0.0, 0.0, 2.0])).mv(torch.tensor([0.0, 0.0, 2.0])).round()
    tensor([2., 0., 0.])
    """
    check_shape("across", across, ["...", 3])
    vertical = across.new_tensor([0.0, -1.0, 0.0]).expand_as(across)
    if up is None:
        up = vertical
        across = across * across.new_tensor([1.0, 0.0, 1.0])
    x = normalize(across, dim=-1)
    y = -normalize(up - (up * x).sum(-1, keepdim=True) * x, dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], -2)


def face_camera(recording: Recording, of: Literal["recording", "pose"] = "recording") -> Recording:
    """Turn a recording about its neck so that the torso faces the camera upright.

    With hips among the joints the line from them to the neck becomes vertical, too; without, the
    body is only turned about the vertical. The neck stays where it is.

    This changes what a prior learns. Its poses are relative to a body (BL section 3.1): after ``pose``
    they say nothing of how people turn and lean, which is then left to the random viewpoints; after
    ``recording`` what is kept is how they do so about their own mean.

    Args:
        recording: camera axes.
        of: one rotation for the recording, from its mean torso, or one for each pose. Poses without
            both shoulders take the mean's.

    Raises:
        InputError: no frame with neck and both shoulders, or another `of`.
    """
    if of not in ("recording", "pose"):
        raise InputError(f"of must be recording or pose, got {of!r}")
    joints = recording.upper_body().joints
    neck = joints[:, _NECK]
    across, up = joints[:, _LEFT] - joints[:, _RIGHT], _up(recording, neck)
    whole = torch.isfinite(across).all(-1) & torch.isfinite(neck).all(-1)
    if up is not None:
        whole &= torch.isfinite(up).all(-1)
    if not bool(whole.any()):
        raise InputError(
            f"{recording.path}, person {recording.person_id}: no frame has neck, both shoulders and, "
            "where the joint set has them, hips; it cannot be turned towards the camera"
        )
    mean = torso_rotation(across[whole].mean(0), None if up is None else up[whole].mean(0))
    turn = mean.expand(len(recording), 3, 3)
    if of == "pose":
        turn = torch.where(whole[:, None, None], torso_rotation(across, up), turn)
    centre = torch.where(torch.isfinite(neck), neck, neck[whole].mean(0))[:, None]
    turned = (recording.joints - centre) @ turn.mT + centre
    note = f"turned towards the camera, each {of}"
    return replace(recording, joints=turned, notes=(*recording.notes, note))


def _up(recording: Recording, neck: Tensor) -> Tensor | None:
    hips = _columns(recording.names, ("hip_left", "hip_right")) or _columns(
        recording.names, ("hip_center",)
    )
    return neck - recording.joints[:, hips].mean(1) if hips else None


def _columns(names: Sequence[str], wanted: Sequence[str]) -> list[int]:
    """Return the columns of joints, an empty list unless all are there."""
    canonical = canonical_names(names)
    found = [canonical.index(name) for name in wanted if name in canonical]
    return found if len(found) == len(wanted) else []
