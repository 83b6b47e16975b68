"""Describe feet: heel, big toe and small toe of each side, and where joint sets have them.

A foot is a rigid part beyond the shank that turns about the ankle. Its axes are those of the shank where a
person stands with the foot at a right angle to it: x to the person's left, y up, z forward.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_shape
from torchpose.body._skeleton import BODY_15
from torchpose.skeleton._joint_sets import canonical_names

_SIDES = ("left", "right")
_POINTS = ("heel", "big_toe", "small_toe")
FEET = tuple(f"{side}_{point}" for side in _SIDES for point in _POINTS)
"""Names of the six points of feet."""
ANKLES = tuple(BODY_15.joint(f"{side}_ankle") for side in _SIDES)
"""Joints about which feet turn."""

FOOT_BONES = tuple(
    pair
    for side, ankle in enumerate(ANKLES)
    for heel in (len(BODY_15.names) + 3 * side,)
    for pair in ((ankle, heel), (heel, heel + 1), (heel, heel + 2), (ankle, heel + 1))
)
"""Lines between ankles, heels and toes, of the fifteen joints followed by `FEET`."""

_SPELLINGS = {  # canonical names that may stand for a point, the best one first
    "heel": ("heel",),
    "big_toe": ("big_toe", "foot_index", "toe", "foot"),
    "small_toe": ("small_toe",),
}
# Of the shank to the outside; of the small toe also the share of the big toe's distance.
_BIG_TOE, _SMALL_TOE = -0.03, (0.07, 0.8)


def foot_points(
    points: Float[Tensor, "*batch K C"], names: Sequence[str]
) -> Float[Tensor, "*batch 6 C"] | None:
    """Pick the points of feet, `FEET`, out of a joint set.

    MediaPipe's foot_index, the toe of motion capture and the foot of a Kinect, in sets that have an ankle
    too, stand for the big toe.

    Args:
        points: [..., K, C]. names: the K names.

    Returns:
        [..., 6, C], NaN where the set lacks a point; None where it lacks all.

    Raises:
        ShapeError: K names and another number of points. SkeletonError: an unknown name, or one twice.
    """
    check_shape("points", points, ["...", len(names), None])
    canonical = canonical_names(names)
    found = [_find(side, point, canonical) for side in _SIDES for point in _POINTS]
    if all(place is None for place in found):
        return None
    unknown = torch.full_like(points[..., 0, :], torch.nan)
    return torch.stack([unknown if i is None else points[..., i, :] for i in found], -2)


def _find(side: str, point: str, canonical: Sequence[str]) -> int | None:
    spellings = _SPELLINGS[point]
    if f"ankle_{side}" not in canonical:  # then a foot is the ankle of the body
        spellings = tuple(name for name in spellings if name != "foot")
    wanted = [f"{name}_{side}" for name in spellings]
    return next((canonical.index(name) for name in wanted if name in canonical), None)


def foot_shape() -> Float[Tensor, "2 3 3"]:
    """Return the points of an average left and right foot from the ankle, in lengths of the shank, foot axes.

    Heel and toes are those of the body of silhouettes (`BODY_15.tips`).
    """
    shank = BODY_15.proportions[ANKLES[0]]
    offsets = {tip.name: torch.tensor(tip.offset, dtype=torch.float64) for tip in BODY_15.tips}
    heel, toe = (offsets[f"left_{name}"] / shank for name in ("heel", "toe"))
    out, share = _SMALL_TOE
    big = toe + torch.tensor([_BIG_TOE, 0.0, 0.0], dtype=toe.dtype)
    small = torch.stack([toe.new_tensor(out), toe[1], share * toe[2]])
    left = torch.stack([heel, big, small])
    return torch.stack([left, left * left.new_tensor([-1.0, 1.0, 1.0])])
