"""Convert the axes and units of files to metres in camera axes; nothing else converts them.

Camera axes: x right, y down, z forward (away from the camera). Every conversion is a rotation."""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_choice
from torchpose.errors import FileFormatError
from torchpose.skeleton._joint_sets import canonical_names, identify_skeleton

Axes = Literal["camera", "kinect", "y-up", "z-up"]
AXES: tuple[str, ...] = get_args(Axes)

_TO_CAMERA = {
    "camera": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    # Kinect SDK: y up, x towards the sensor's own left, z away from it
    "kinect": ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    # someone who faces +z in a y-up room faces the camera afterwards
    "y-up": ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)),
    # and so does someone who faces -y in a z-up room
    "z-up": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
}


def default_axes(where: str, names: Sequence[str]) -> str:
    """Return the axes of a file that does not state them, by its joint set.

    Raises:
        FileFormatError: the joints are no known set; `where` is named.
    """
    skeleton = identify_skeleton(names)
    if skeleton is None:
        raise FileFormatError(
            f"{where}: these {len(names)} joints are no known set, so the axes are not known; "
            f"state them: axes = {', '.join(AXES)} (key `axes` in the .npz, `# axes = ...` above the "
            "header of a table, a file axes.txt in the folder, or --axes of torchpose fit)"
        )
    return skeleton.axes


def axes_rotation(
    joints: Float[Tensor, "T J 3"], names: Sequence[str], axes: str
) -> Float[Tensor, "3 3"]:
    """Return the rotation from the axes of a file to camera axes.

    y-up and z-up rooms have no camera: those are turned about the vertical so that the mean heading
    faces the camera, except for joint sets whose people face it anyway (Berkeley MHAD).

    Args:
        joints: [T, J, 3] in the axes of the file, metres.
        names: the J names.
        axes: ``camera``, ``kinect``, ``y-up`` or ``z-up``.

    Returns:
        M [3, 3]: x_camera = M x_file.

    Raises:
        InputError: other axes.
    """
    check_choice("axes", axes, AXES)
    base = torch.tensor(_TO_CAMERA[axes], dtype=joints.dtype)
    skeleton = identify_skeleton(names)
    if axes in ("camera", "kinect") or (skeleton is not None and not skeleton.turned):
        return base
    angle = heading(joints @ base.mT, names)
    if angle is None:
        return base
    cos, sin = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]], dtype=joints.dtype)
    return turn @ base


def heading(joints: Float[Tensor, "T J 3"], names: Sequence[str]) -> float | None:
    """Return the mean heading about the vertical: 0 faces the camera, positive is to the person's left.

    The heading of a frame is at a right angle to the horizontal line from the right to the left
    shoulder (or hip); the mean is over unit vectors.

    Args:
        joints: [T, J, 3] in camera axes (y down).
        names: the J names.

    Returns:
        The angle in (-pi, pi], radians, or None without shoulders and hips.
    """
    unit = _across(joints, names)
    if unit is None:
        return None
    x, z = unit[unit.isfinite().all(-1)].mean(0).tolist()
    return math.atan2(z, x)


def _across(joints: Float[Tensor, "T J 3"], names: Sequence[str]) -> Float[Tensor, "T 2"] | None:
    """Return unit vectors (x, z) from the right to the left shoulder (or hip), NaN where unknown."""
    where = {name: i for i, name in enumerate(canonical_names(names))}
    for part in ("shoulder", "hip"):
        left, right = where.get(f"{part}_left"), where.get(f"{part}_right")
        if left is None or right is None:
            continue
        across = (joints[:, left] - joints[:, right])[:, [0, 2]]
        length = across.norm(dim=-1, keepdim=True)
        unit = across / length.where(length > 1e-6, math.nan)
        if bool(unit.isfinite().any()):
            return unit
    return None


def check_upright(where: str, joints: Float[Tensor, "T J 3"], names: Sequence[str]) -> None:
    """Raise unless the head is above the body, by medians over the frames, in camera axes.

    The head (else the neck) is compared with the hips; without hips with the shoulders; without
    those with the hands, which do not rest above the head.

    Raises:
        FileFormatError: upside down, or not in metres; `where` is named.
    """
    index = {name: i for i, name in enumerate(canonical_names(names))}
    extent = (joints.nan_to_num(-math.inf).amax(1) - joints.nan_to_num(math.inf).amin(1)).amax(-1)
    extent = extent[torch.isfinite(extent)]
    if len(extent) and float(extent.median()) > 5:
        raise FileFormatError(
            f"{where}: the joints span {float(extent.median()):.0f} m, expected metres; "
            "divide by 1000 if these are millimetres"
        )
    tops = [p for p in ("head", "upper_neck", "neck", "shoulder_center", "nose") if p in index]
    if not tops:
        return
    head = joints[:, index[tops[0]], 1]
    for below in (("hip_left", "hip_right", "hip_center"),
                  ("shoulder_left", "shoulder_right"),
                  ("hand_left", "hand_right", "wrist_left", "wrist_right")):  # fmt: skip
        rows = [index[name] for name in below if name in index]
        drop = joints[:, rows, 1].nanmean(1) - head
        drop = drop[torch.isfinite(drop)]
        if rows and len(drop):
            if float(drop.median()) < 0:
                _raise_upside_down(where, tops[0], below[0].split("_")[0], float(drop.median()))
            return


def note_on_lying(joints: Float[Tensor, "T J 3"], names: Sequence[str]) -> list[str]:
    """Return a note if the head is rather beside the body than above it, by the median over frames.

    So it is in wrong axes that exchange up and forwards, which put nobody upside down. The head is compared
    with the hips, without hips with the shoulders, from which a neck is too near.

    Args:
        joints: [T, J, 3] in camera axes (y down), metres. names: the J names.
    """
    index = {name: i for i, name in enumerate(canonical_names(names))}
    tops = [p for p in ("head", "upper_neck", "neck", "shoulder_center") if p in index]
    parts: tuple[str, ...] = ("hip_left", "hip_right", "hip_center")
    if not index.keys() & parts and "head" in index:
        parts = ("shoulder_left", "shoulder_right")
    below = [part for part in parts if part in index]
    if not tops or not below:
        return []
    line = joints[:, [index[name] for name in below]].nanmean(1) - joints[:, index[tops[0]]]
    lean = _median(torch.atan2(line[:, [0, 2]].norm(dim=-1), line[:, 1]))
    if lean is None or lean < _LYING:
        return []
    part = below[0].split("_")[0]
    return [
        f"{LIES}: from the {part}s to the {tops[0]} it is {math.degrees(lean):.0f} degrees from the vertical "
        "in the median frame; of somebody who stands or sits the axes are others, which --axes says "
        f"({', '.join(AXES)}), or a file axes.txt in the folder"
    ]


def note_on_mirroring(joints: Float[Tensor, "T J 3"], names: Sequence[str]) -> list[str]:
    """Return a note if toes and hands are behind the body by the shoulders, as those of mirrored joints are.

    It is told by the mean of how far toes are before ankles, and hands before shoulders, each the median over
    the frames.

    Args:
        joints: [T, J, 3] in camera axes (y down), metres. names: the J names.
    """
    index = {name: i for i, name in enumerate(canonical_names(names))}
    across = _across(joints, names)
    if across is None:
        return []
    forwards = torch.stack([across[:, 1], -across[:, 0]], -1)
    found = []
    for base, ends in (("ankle", ("toe", "big_toe", "foot")), ("shoulder", ("hand", "wrist"))):
        end = next((name for name in ends if f"{name}_left" in index), "")
        sides = [
            side for side in ("left", "right") if {f"{base}_{side}", f"{end}_{side}"} <= {*index}
        ]
        steps = [joints[:, index[f"{end}_{s}"]] - joints[:, index[f"{base}_{s}"]] for s in sides]
        reach = [(step[:, [0, 2]] * forwards).sum(-1) for step in steps]
        median = _median(torch.cat(reach)) if reach else None
        if median is not None:
            found.append(median)
    return [MIRRORED] if found and sum(found) / len(found) < -_BEHIND else []


def _raise_upside_down(where: str, top: str, below: str, drop: float) -> None:
    raise FileFormatError(
        f"{where}: after conversion to camera axes (y down) the {top} lies {-100 * drop:.0f} cm "
        f"below the {below}s in the median frame; the axes are others than assumed: state them with "
        f"axes = {', '.join(AXES)} (key `axes` in the .npz, --axes, or a file axes.txt in the folder; the "
        "Azure Kinect SDK gives camera axes)"
    )


LIES = "by these axes the person lies"
"""How the note on a recording begins in which somebody lies."""
MIRRORED = (
    "by the shoulders toes and hands are behind the body: the joints are mirrored, as in left-handed axes, "
    "which no --axes corrects (change the sign of one coordinate in the file), or left and right are "
    "exchanged"
)
"""The note on a recording of joints that are mirrored."""
_LYING = math.pi / 3  # from the vertical
_BEHIND = 0.03  # metres; of 1,276 recordings the mean is never below 0.013
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
    """Return the metres per unit by the name of the unit, or None for an unknown name."""
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
    missing = joints.isnan()
    low, high = joints.masked_fill(missing, math.inf), joints.masked_fill(missing, -math.inf)
    span = _median((high.amax(1) - low.amin(1)).amax(-1))
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


def _median(values: Tensor) -> float | None:
    values = values[torch.isfinite(values)]
    return float(values.median()) if len(values) else None
