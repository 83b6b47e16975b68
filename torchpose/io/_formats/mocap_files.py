"""Read motion capture as recordings of joints: BVH files by bvhio, C3D files by c3d."""

import re
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchpose._core.reading import read_text, reading
from torchpose.errors import FileFormatError, MissingDependencyError, SkeletonError
from torchpose.io._formats.axes import unit_from_text
from torchpose.io._formats.raw_recording import RawRecording
from torchpose.skeleton._joint_sets import canonical_name

# Words of a node for each joint. Many files call the shoulder joint "arm" and put a node "shoulder"
# at the collar; there the node "hand" stands in the wrist.
_ARM_WORDS = ("arm", "uparm", "upperarm", "shldr")
_SIDED = {
    "forearm": "elbow", "lowarm": "elbow", "lowerarm": "elbow", "elbow": "elbow",
    "wrist": "wrist", "hand": "hand", "shoulder": "shoulder", "collar": "clavicle",
    "clavicle": "clavicle", "upleg": "hip", "upperleg": "hip", "thigh": "hip", "hip": "hip",
    "leg": "knee", "lowleg": "knee", "lowerleg": "knee", "shin": "knee", "calf": "knee",
    "knee": "knee", "foot": "ankle", "ankle": "ankle", "toebase": "toe", "toe": "toe",
} | dict.fromkeys(_ARM_WORDS, "shoulder")  # fmt: skip
_CENTRAL = {"hips": "hip_center", "hip": "hip_center", "pelvis": "hip_center", "spine": "spine",
            "neck": "neck", "neck01": "neck", "head": "head"}  # fmt: skip
_LONGEST_HIERARCHY = 1_000_000  # characters; a person with all fingers has some ten thousand
_NEEDED = ("head", "shoulder_left", "shoulder_right", "elbow_left", "elbow_right")


def bvh_joint_names(nodes: list[str]) -> dict[str, str]:
    """Return which node of a file stands for which joint.

    Nodes may have a prefix up to a colon (``mixamorig:LeftArm``). Where there are nodes for arm and
    forearm, "LeftArm" is the shoulder, "LeftForeArm" the elbow, "LeftHand" the wrist, and
    "LeftShoulder" the collar. Fingers, further spine nodes and the like are left out.

    Args:
        nodes: names, from the root outwards.

    Returns:
        Node by joint.

    >>> names = bvh_joint_names(["Hips", "Neck", "LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand"])
    >>> names["shoulder_left"], names["elbow_left"], names["wrist_left"]
    ('LeftArm', 'LeftForeArm', 'LeftHand')
    """
    words = [(node, *_split(node)) for node in nodes]
    as_arms = any(word in _ARM_WORDS for _, word, side in words if side)
    found: dict[str, str] = {}
    for node, word, side in words:
        part = _SIDED.get(word) if side else _CENTRAL.get(word)
        if part is None:
            continue
        if as_arms and word in ("shoulder", "hand"):
            part = {"shoulder": "clavicle", "hand": "wrist"}[word]
        found.setdefault(f"{part}_{side}" if side else part, node)
    return found


def read_bvh(path: Path) -> list[RawRecording]:
    """Read the positions of the joints in every frame, y up, by bvhio's forward kinematics.

    The head is the middle between the node of the head and the end of its bone, because that node
    stands where head and neck meet; without such an end it is the node.

    Raises:
        MissingDependencyError: bvhio is not installed. SkeletonError: no node for the head, a
            shoulder or an elbow. FileFormatError: damaged or truncated.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about how bvhio imports another library
            import bvhio
    except ImportError as error:
        raise MissingDependencyError(
            f"{path}: reading BVH files needs bvhio; run `python -m pip install bvhio`"
        ) from error
    _check(path)
    with reading(path, "a BVH file"):
        container = bvhio.readAsBvh(str(path))
        root = bvhio.convertBvhToHierarchy(container.Root).loadRestPose(recursive=True)
    nodes = {joint.Name: joint for joint, _, _ in reversed(root.layout())}
    names = bvh_joint_names([joint.Name for joint, _, _ in root.layout()])
    missing = [joint for joint in _NEEDED if joint not in names]
    if missing:
        raise SkeletonError(
            f"{path}: no node stands for {', '.join(missing)}; found {', '.join(list(nodes)[:30])}"
        )
    head = next(j for j, _, _ in container.Root.layout() if j.Name == names["head"])
    tip, tip_note = _head_end(head, nodes[names["head"]])
    place = list(names).index("head")
    joints = np.empty((container.FrameCount, len(names), 3))
    for frame in range(container.FrameCount):
        root.loadPose(frame)
        joints[frame] = [tuple(nodes[node].PositionWorld) for node in names.values()]
        if tip is not None:
            end = np.array(tuple(nodes[names["head"]].pointToWorld(tip)))
            joints[frame, place] = (joints[frame, place] + end) / 2
    dropped = [node for node in nodes if node not in names.values()]
    notes = ["nodes: " + ", ".join(f"{node} is {joint}" for joint, node in names.items())]
    notes += [tip_note] if tip_note else []
    notes += [f"nodes not used: {', '.join(dropped[:8])}{' ...' * (len(dropped) > 8)}"] * bool(
        dropped
    )
    rate = 1 / container.FrameTime if container.FrameTime > 0 else None
    return [
        RawRecording(path, joints, tuple(names), rate, "y-up", action=path.stem, notes=tuple(notes))
    ]


def _split(node: str) -> tuple[str, str]:
    """Return a node's name without prefix and side, and the side."""
    name = node.rsplit(":", 1)[-1]
    name = re.sub(r"^mixamorig\d*_?", "", name)
    sided = (
        re.fullmatch(r"(left|right)[ _.-]?(.+)", name, re.IGNORECASE)
        or re.fullmatch(r"([lr])(?:[ _.-]+|(?=[A-Z]))(.+)", name)
        or re.fullmatch(r"([LR])[ _.-]?(.+)", name)
    )
    if sided:
        side, word = sided.groups()
    else:
        behind = re.fullmatch(r"(.+?)[ _.-](left|right|l|r)", name, re.IGNORECASE)
        word, side = behind.groups() if behind else (name, "")
    side = {"l": "left", "r": "right"}.get(side.lower()[:1], "")
    return re.sub(r"[^a-z0-9]", "", word.lower()), side


def _head_end(head: Any, posed: Any) -> tuple[Any, str]:
    """Return the end of the head's bone in the axes of its node, or None, and a note.

    Args:
        head: the node as the file has it. posed: the same, at rest, where nothing is turned.
    """
    ends = [child for child in head.Children if re.search(r"end|top", child.Name, re.IGNORECASE)]
    if head.Children and not ends:
        return None, ""
    tip = ends[0].Offset if ends else head.EndSite
    if not any(tip):
        return None, ""
    return posed.pointToLocal(posed.PositionWorld + tip), (
        "the head is the middle between its node and the end of its bone"
    )


def _check(path: Path) -> None:
    """Raise unless the file is whole; bvhio never returns from a truncated one."""
    text = read_text(path, "a BVH file", "utf-8")
    hierarchy, mark, motion = text.partition("MOTION")
    if not hierarchy.lstrip().startswith("HIERARCHY") or not mark:
        raise FileFormatError(
            f"{path}: expected HIERARCHY and MOTION; it is truncated or no BVH file"
        )
    if len(hierarchy) > _LONGEST_HIERARCHY:
        raise FileFormatError(
            f"{path}: expected a HIERARCHY of at most {_LONGEST_HIERARCHY} characters, got "
            f"{len(hierarchy)}"
        )
    if not hierarchy.count("{") == hierarchy.count("}") > 0:
        raise FileFormatError(f"{path}: the braces of the HIERARCHY do not match")
    header = re.match(r"\s*Frames:\s*(\d+)\s*Frame Time:\s*(\S+)[^\n]*\n?", motion)
    if header is None:
        raise FileFormatError(f"{path}: expected 'Frames:' and 'Frame Time:' after MOTION")
    rows = [row.split() for row in motion[header.end() :].splitlines() if row.strip()]
    channels = sum(int(n[:9]) for n in re.findall(r"CHANNELS\s+(\d+)", hierarchy))
    if len(rows) < int(header[1][:18]):
        raise FileFormatError(f"{path}: expected {header[1]} frames, ends after {len(rows)}")
    short = next((i for i, row in enumerate(rows) if len(row) != channels), None)
    if short is not None:
        raise FileFormatError(
            f"{path}, frame {short}: expected {channels} numbers, got {len(rows[short])}"
        )


class C3DPoints(NamedTuple):
    """Holds the points of a file: their labels, [T, N, 3] as written, frames per second, unit, axis up."""

    labels: list[str]
    points: np.ndarray
    rate: float
    unit: str
    up: str


_UP = {"+Z": "z-up", "+Y": "y-up"}


def read_c3d(path: Path) -> list[RawRecording]:
    """Read the points whose labels are names of joints; others are left out, and named.

    A prefix up to a colon is dropped (``subject:LElbow``). Points with a residual of -1 are missing.
    The unit is POINT:UNITS; axes follow from POINT:Y_SCREEN, the axis that points up on a screen.

    Raises:
        MissingDependencyError: c3d is not installed. SkeletonError: no point is named as a joint.
        FileFormatError: damaged or truncated.
    """
    found = read_c3d_points(path)
    columns = _joint_columns(path, found.labels)
    joints = found.points[:, list(columns.values())]
    unused = [label.strip() for i, label in enumerate(found.labels) if i not in columns.values()]
    notes = [f"points not used: {', '.join(unused[:8])}{' ...' * (len(unused) > 8)}"] * bool(unused)
    return [
        RawRecording(
            path, joints, tuple(columns), found.rate if found.rate > 0 else None,
            _UP.get(found.up.upper()), unit_from_text(found.unit), action=path.stem, notes=tuple(notes),
        )
    ]  # fmt: skip


def read_c3d_points(path: Path) -> C3DPoints:
    """Read every point of a file under any label; NaN where the residual is -1.

    Raises:
        MissingDependencyError: c3d is not installed. FileFormatError: damaged or truncated.
    """
    try:
        import c3d
    except ImportError as error:
        raise MissingDependencyError(
            f"{path}: reading C3D files needs c3d; run `python -m pip install c3d`"
        ) from error
    try:
        with path.open("rb") as stream, warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            reader = c3d.Reader(stream)
            labels = [str(label) for label in reader.point_labels][: reader.point_used]
            frames = [points for _, points, _ in reader.read_frames()]
            expected, rate = reader.frame_count, float(reader.point_rate)
            unit = _text(reader, "POINT:UNITS")
            up = _text(reader, "POINT:Y_SCREEN")
    except Exception as error:  # a damaged file makes the library raise anything, even NameError
        raise FileFormatError(
            f"{path}: expected a C3D file; it is damaged or of another kind ({error})"
        ) from error
    if len(frames) < expected or any("end of file" in str(note.message) for note in said):
        raise FileFormatError(f"{path}: expected {expected} frames, ends in frame {len(frames)}")
    points = np.array(frames).reshape(-1, len(labels), 5)
    placed = np.where(points[..., 3:4] < 0, np.nan, points[..., :3]).astype(np.float64)
    return C3DPoints(labels, placed, rate, unit, up)


def _text(reader: Any, key: str) -> str:
    parameter = reader.get(key)
    return "" if parameter is None else str(parameter.string_value).strip("\0 ")


def _joint_columns(path: Path, labels: list[str]) -> dict[str, int]:
    """Return the columns by the name of their joint, without those that are none."""
    columns: dict[str, int] = {}
    for column, label in enumerate(labels):
        name = re.sub(r"^.*:", "", label).strip()
        try:
            canonical_name(name)
        except SkeletonError:
            continue
        columns.setdefault(name, column)
    if not columns:
        shown = ", ".join(label.strip() for label in labels[:20]) or "none"
        raise SkeletonError(
            f"{path}: expected points that are named as joints (LElbow, head, ...), got {shown}; "
            "markers on the skin are no joints: export the joint centres of your software"
        )
    return columns
