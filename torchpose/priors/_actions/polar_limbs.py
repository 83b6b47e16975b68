"""List the twelve limbs whose relative angles make a posture, and order the 36 angles."""

from collections.abc import Sequence
from typing import NamedTuple

from torchpose.errors import SkeletonError

Axis = tuple[float, float, float]


class PolarLimb(NamedTuple):
    """Describes a bone whose direction is given in the axes of its parent limb.

    Attributes:
        name: the name of the limb. parent: name of the limb that it hangs on, "" for the root.
        start, end: names of the joints of `BODY_15` it runs between.
        straight: direction in the parent's axes at which the axes are carried on unturned.
        rest: direction in the parent's axes that stands for a joint that is not known.
    """

    name: str
    parent: str
    start: str
    end: str
    straight: Axis
    rest: Axis


def _limbs() -> list[tuple[str, str, str, str, Axis, Axis]]:
    up, down = (0.0, 1.0, 0.0), (0.0, -1.0, 0.0)
    limbs = [("torso", "", "pelvis", "neck", up, up), ("head", "torso", "neck", "head", up, up)]
    for side, x in (("left", 1.0), ("right", -1.0)):
        out = (x, 0.0, 0.0)
        clavicle, arm, forearm = (f"{side}_{kind}" for kind in ("clavicle", "upper_arm", "forearm"))
        thigh, shank = f"{side}_thigh", f"{side}_shank"
        shoulder, elbow, wrist = (f"{side}_{kind}" for kind in ("shoulder", "elbow", "wrist"))
        hip, knee, ankle = (f"{side}_{kind}" for kind in ("hip", "knee", "ankle"))
        limbs += [
            (clavicle, "torso", "neck", shoulder, out, out),
            (arm, clavicle, shoulder, elbow, out, down),
            (forearm, arm, elbow, wrist, out, out),
            (thigh, "", hip, knee, down, down),
            (shank, thigh, knee, ankle, down, down),
        ]
    return limbs


LIMBS_12 = tuple(PolarLimb(*row) for row in _limbs())
"""Torso, head, and of either side clavicle (neck to shoulder), upper arm, forearm, thigh, shank."""

_NAMES = tuple(limb.name for limb in LIMBS_12)

LIMB_PARENTS = tuple(_NAMES.index(limb.parent) if limb.parent else -1 for limb in LIMBS_12)
"""Index of the limb that each one hangs on, -1 for the root."""

POSTURE_DIM = 3 * len(LIMBS_12)
"""36 angles: those of a limb stand together, about x (left), y (up), z (forward)."""


def check_limbs(names: Sequence[str]) -> None:
    """Raise `SkeletonError` unless these are the names of `LIMBS_12`, in their order."""
    if tuple(names) != _NAMES:
        raise SkeletonError(
            f"postures are of the limbs {', '.join(_NAMES)}, in this order; got "
            f"{', '.join(map(str, names)) or 'none'}"
        )
