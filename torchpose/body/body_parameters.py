"""What a body is built from: checks of its parameters, and the tables its kinematics rest on."""

import torch
from torch import Tensor

from torchpose.body.skeleton import BodySkeleton
from torchpose.errors import InputError, check_finite, check_shape

__all__ = [
    "check_limb_lengths",
    "checked_directions",
    "checked_lengths",
    "checked_radii",
    "checked_tips",
    "level_plan",
    "point_weights",
]

_SHORTEST = 1e-4  # metres: no limb is as short as a tenth of a millimetre


def checked_lengths(skeleton: BodySkeleton, lengths: Tensor) -> Tensor:
    """Return bone lengths [J], 0 for the root; raise `InputError` where one is not positive."""
    check_shape("bone_lengths", lengths, [len(skeleton.names)])
    lengths = lengths.clone()
    lengths[0] = 0.0
    wrong = ~((lengths[1:] > _SHORTEST) & torch.isfinite(lengths[1:]))
    if bool(wrong.any()):
        joint = int(torch.nonzero(wrong)[0]) + 1
        raise InputError(
            f"bone lengths must be positive, metres; the bone to {skeleton.names[joint]!r} has "
            f"{float(lengths[joint]):g}"
        )
    return lengths


def checked_directions(
    skeleton: BodySkeleton, directions: Tensor | None, device: torch.device
) -> Tensor:
    """Return unit directions [J, 3], the skeleton's by default; raise where one has no length."""
    given = directions
    if given is None:
        given = torch.tensor(skeleton.directions, dtype=torch.float64)
    given = given.to(device, torch.float64)
    check_shape("directions", given, [len(skeleton.names), 3])
    check_finite("directions", given)
    if bool((given[1:].norm(dim=-1) < _SHORTEST).any()):
        joint = int(given[1:].norm(dim=-1).argmin()) + 1
        raise InputError(f"the direction to {skeleton.names[joint]!r} has no length")
    return torch.nn.functional.normalize(given, dim=-1)


def checked_tips(skeleton: BodySkeleton, lengths: Tensor, tips: Tensor | None) -> Tensor:
    """Return offsets [K, 3] of the tips, metres; the skeleton's at the person's height by default."""
    if tips is None:
        share = torch.tensor([tip.offset for tip in skeleton.tips], dtype=torch.float64)
        return skeleton.height(lengths) * share.reshape(-1, 3).to(lengths.device)
    check_shape("tips", tips, [len(skeleton.tips), 3])
    check_finite("tips", tips)
    return tips.to(lengths)


def checked_radii(skeleton: BodySkeleton, radii: Tensor) -> Tensor:
    """Return radii [..., L, 2]; raise `InputError` where one is negative or not finite."""
    check_shape("radii", radii, ["...", len(skeleton.limbs), 2])
    check_finite("radii", radii)
    if bool((radii < 0).any()):
        limb = skeleton.limbs[int(torch.nonzero(radii < 0)[0, -2])].name
        raise InputError(f"radii must not be negative, metres; {limb!r} has {float(radii.min()):g}")
    return radii


def point_weights(skeleton: BodySkeleton, offsets: Tensor, tips: Tensor) -> Tensor:
    """Return how every point depends on the columns of every part's rotation, [3 P, J + K]."""
    n_points = len(skeleton.points)
    weights = offsets.new_zeros(len(skeleton.parts), 3, n_points)
    for level in skeleton.joint_levels[1:]:  # a joint moves with all that moves its parent
        for joint in level:
            weights[..., joint] = weights[..., skeleton.parents[joint]]
            weights[skeleton.part_of[joint], :, joint] += offsets[joint]
    for k, tip in enumerate(skeleton.tips, start=len(skeleton.names)):
        weights[..., k] = weights[..., skeleton.joint(tip.joint)]
        weights[skeleton.part(tip.part), :, k] += tips[k - len(skeleton.names)]
    return weights.flatten(0, 1)


def check_limb_lengths(skeleton: BodySkeleton, limb_weights: Tensor) -> None:
    """Raise if a limb has no length whatever the pose: both ends depend on the same rotations."""
    start, end = limb_weights.unflatten(-1, (-1, 2)).unbind(-1)
    lengths = (end - start).norm(dim=0)
    if bool((lengths < _SHORTEST).any()):
        limb = skeleton.limbs[int(lengths.argmin())]
        raise InputError(
            f"limb {limb.name!r} has zero length: {limb.start!r} and {limb.end!r} are one point; "
            "move one of them, or leave the limb out"
        )


def level_plan(skeleton: BodySkeleton) -> dict[str, list[int]]:
    """Return per level its parts and their parents' places in the level above; then the way back."""
    plan, above = {}, [0]
    for depth, level in enumerate(skeleton.part_levels[1:], start=1):
        plan[f"_parts_{depth}"] = list(level)
        plan[f"_above_{depth}"] = [above.index(skeleton.part_parents[part]) for part in level]
        above = list(level)
    in_levels = [part for level in skeleton.part_levels for part in level]
    return {**plan, "_order": [in_levels.index(part) for part in range(len(in_levels))]}
