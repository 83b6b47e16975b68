"""Millimetres and centimetres, told by the size of the body."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.errors import FileFormatError
from torchpose.skeleton.joint_sets import canonical_names

__all__ = ["METRES_PER", "Unit", "body_unit", "unit_from_text"]

METRES_PER = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_TEXT = {"m": "metres", "cm": "centimetres", "mm": "millimetres"}
_LARGEST = 5.0  # metres: nobody spans more
_SHOULDERS = (0.15, 0.65)  # metres between the shoulders, from a child to the widest
_NARROWEST = 0.05  # metres between the shoulders of nobody
_SPAN = (0.3, 3.0)  # metres that some joints of a body span, where there are no shoulders


class Unit(NamedTuple):
    """Metres per unit, and a note for people if it is not the metre."""

    metres: float
    note: str


def unit_from_text(text: str) -> float | None:
    """Return the metres per unit of what a file calls its unit, or None if it is none of the known ones."""
    word = text.strip().lower().rstrip("s.")
    known = {"m": 1.0, "metre": 1.0, "meter": 1.0, "cm": 0.01, "centimetre": 0.01,
             "centimeter": 0.01, "mm": 0.001, "millimetre": 0.001, "millimeter": 0.001}  # fmt: skip
    return known.get(word)


def body_unit(where: str, joints: Float[Tensor, "T J 3"], names: Sequence[str]) -> Unit:
    """Return the unit in which these joints make a body.

    A body that spans at most 5, with its shoulders at least 0.05 apart, is in metres. Others are in
    centimetres or millimetres, whichever puts the shoulders 15 to 65 cm apart; without shoulders,
    whichever makes the body 0.3 to 3 m large.

    Args:
        where: the file (and person), for messages. joints: NaN where missing. names: of the J joints.

    Raises:
        FileFormatError: neither of the three makes a body.
    """
    span = _median((_largest(joints) - _smallest(joints)).amax(-1))
    shoulders = _shoulder_width(joints, names)
    if span is None or (span <= _LARGEST and not 0 < (shoulders or 1.0) < _NARROWEST):
        return Unit(1.0, "")
    size, bounds = (span, _SPAN) if shoulders is None else (shoulders, _SHOULDERS)
    for unit in ("cm", "mm"):
        if bounds[0] <= size * METRES_PER[unit] < bounds[1]:
            what = "the body spans" if shoulders is None else "the shoulders are apart"
            return Unit(
                METRES_PER[unit],
                f"taken for {_TEXT[unit]} ({what} {size:.4g}) and converted to metres",
            )
    apart = "" if shoulders is None else f" and its shoulders are {shoulders:.4g} apart"
    raise FileFormatError(
        f"{where}: the body spans {span:.4g}{apart}, which is no person in metres, centimetres or "
        "millimetres; convert the file to metres"
    )


def _shoulder_width(joints: Tensor, names: Sequence[str]) -> float | None:
    index = {name: i for i, name in enumerate(canonical_names(names))}
    if "shoulder_left" not in index or "shoulder_right" not in index:
        return None
    across = joints[:, index["shoulder_left"]] - joints[:, index["shoulder_right"]]
    return _median(across.norm(dim=-1))


def _largest(joints: Tensor) -> Tensor:
    return torch.where(joints.isnan(), -math.inf, joints).amax(1)


def _smallest(joints: Tensor) -> Tensor:
    return torch.where(joints.isnan(), math.inf, joints).amin(1)


def _median(values: Tensor) -> float | None:
    values = values[torch.isfinite(values)]
    return float(values.median()) if len(values) else None
