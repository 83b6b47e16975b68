"""Describe the limbs of a body, and check the parameters that a body is built from."""

from functools import lru_cache
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose._core.checks import check_finite, check_shape
from torchpose._core.module_state import outside_inference
from torchpose.body._skeleton import BodySkeleton
from torchpose.errors import InputError, ShapeError


class Limbs(NamedTuple):
    """Holds the tapered cylinders with round ends of a body's L limbs.

    Attributes:
        start, end: [..., L, 3], the middles of both ends, metres, world axes.
        radii: [L, 2] or [..., L, 2], radius at the start and at the end, metres, not negative.
            A limb whose start is its end is a ball.
    """

    start: Float[Tensor, "*batch L 3"]
    end: Float[Tensor, "*batch L 3"]
    radii: Float[Tensor, "*radii L 2"]

    def select(self, index: Tensor) -> "Limbs":
        """Return some of the limbs.

        Args:
            index: indices [l], or bool [L].

        Returns:
            `Limbs` with l limbs, in the order of `index`.
        """
        return Limbs(self.start[..., index, :], self.end[..., index, :], self.radii[..., index, :])


def check_limbs(limbs: Limbs) -> None:
    """Raise unless both ends have one shape and radii fit them.

    Raises:
        ShapeError: shapes differ. InputError: a radius is negative or NaN.
    """
    check_shape("start of the limbs", limbs.start, ["...", "L", 3])
    shape = tuple(limbs.start.shape)
    if tuple(limbs.end.shape) != shape:
        raise ShapeError(f"both ends of the limbs must have shape {shape}, got {limbs.end.shape}")
    radii = tuple(limbs.radii.shape)
    wanted = (*shape[:-1], 2)
    if len(radii) < 2 or len(radii) > len(wanted) or not _broadcasts(radii, wanted):
        raise ShapeError(
            f"radii of the limbs must have shape [{shape[-2]}, 2] or {list(wanted)}, "
            f"got {list(radii)}"
        )
    if not bool((limbs.radii >= 0).all()):
        raise InputError(
            f"radii of the limbs must be 0 m or more, got {float(limbs.radii.min()):g}"
        )


def _broadcasts(shape: tuple[int, ...], target: tuple[int, ...]) -> bool:
    tail = target[len(target) - len(shape) :]
    if shape[-2:] != tail[-2:]:
        return False
    return all(s in (1, t) for s, t in zip(shape[:-2], tail[:-2], strict=True))


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
    """Return the linear map [3 P, J + K] from the columns of the parts' rotations to all points."""
    carried = _carried(skeleton).to(offsets)
    weights = torch.einsum("pij,ia->paj", carried, torch.cat([offsets, tips]))
    return weights.flatten(0, 1)


@lru_cache(maxsize=16)
@outside_inference()
def _carried(skeleton: BodySkeleton) -> Float[Tensor, "P N N"]:
    """Return whether a part turns the offset of a point on the way from the root to another, N = J + K."""
    n_joints, n_points = len(skeleton.names), len(skeleton.points)
    parents = [*skeleton.parents, *(skeleton.joint(tip.joint) for tip in skeleton.tips)]
    parts = [*skeleton.part_of, *(skeleton.part(tip.part) for tip in skeleton.tips)]
    carried = torch.zeros(len(skeleton.parts), n_points, n_points, dtype=torch.float64)
    joints = [joint for level in skeleton.joint_levels[1:] for joint in level]
    for point in (*joints, *range(n_joints, n_points)):  # moves with all that moves its parent
        carried[..., point] = carried[..., parents[point]]
        carried[parts[point], point, point] = 1
    return carried


def check_limb_lengths(skeleton: BodySkeleton, limb_weights: Tensor) -> None:
    """Check that no limb has zero length in every pose, as one whose ends turn with the same parts."""
    start, end = limb_weights.unflatten(-1, (-1, 2)).unbind(-1)
    lengths = (end - start).norm(dim=0)
    if bool((lengths < _SHORTEST).any()):
        limb = skeleton.limbs[int(lengths.argmin())]
        raise InputError(
            f"limb {limb.name!r} has zero length: {limb.start!r} and {limb.end!r} are one point; "
            "move one of them, or leave the limb out"
        )


def chained(
    module: nn.Module, turns: Float[Tensor, "*batch P 3 3"], n_levels: int
) -> Float[Tensor, "*batch P 3 3"]:
    """Return the products of all turns from the root to each part.

    Args:
        module: with a buffer for each entry of `level_plan`. turns: of every part in the part above.
        n_levels: of the tree of parts.
    """
    world = [turns[..., :1, :, :]]
    for depth in range(1, n_levels):
        parts, above = module.get_buffer(f"_parts_{depth}"), module.get_buffer(f"_above_{depth}")
        world.append(world[-1].index_select(-3, above) @ turns.index_select(-3, parts))
    return torch.cat(world, -3).index_select(-3, module.get_buffer("_order"))


def level_plan(skeleton: BodySkeleton) -> dict[str, list[int]]:
    """Return per level its parts and their parents' places in the level above; then the way back."""
    plan, above = {}, [0]
    for depth, level in enumerate(skeleton.part_levels[1:], start=1):
        plan[f"_parts_{depth}"] = list(level)
        plan[f"_above_{depth}"] = [above.index(skeleton.part_parents[part]) for part in level]
        above = list(level)
    in_levels = [part for level in skeleton.part_levels for part in level]
    return {**plan, "_order": [in_levels.index(part) for part in range(len(in_levels))]}
