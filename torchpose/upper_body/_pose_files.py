"""Write poses for other programs: a BVH file for animation, a table for spreadsheets."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_shape
from torchpose._core.files import atomic_path
from torchpose.camera._tilt import level_rotation
from torchpose.errors import InputError
from torchpose.io._bvh_file import BvhNode, bvh_angles, write_bvh_motion
from torchpose.math._rotations import cross_matrix
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.upper_body._pose_track import PoseTrack

_FPS = 30.0
_TO_Y_UP = (1.0, -1.0, -1.0)  # camera axes to x left, y up, z forward, for one who faces the camera
_CENTIMETRES = 100.0


class _Bone(NamedTuple):
    """A node that turns, and the joint at the end of the bone that it turns."""

    node: str
    end: str
    rest: tuple[float, float, float]


# Level by level, so that a parent comes before its children; the two sides of a level go together.
_LEVELS = (
    (
        _Bone("head_base", "head", (0.0, 1.0, 0.0)),
        _Bone("collar_left", "shoulder_left", (1.0, 0.0, 0.0)),
        _Bone("collar_right", "shoulder_right", (-1.0, 0.0, 0.0)),
    ),
    (
        _Bone("shoulder_left", "elbow_left", (1.0, 0.0, 0.0)),
        _Bone("shoulder_right", "elbow_right", (-1.0, 0.0, 0.0)),
    ),
    (
        _Bone("elbow_left", "hand_left", (1.0, 0.0, 0.0)),
        _Bone("elbow_right", "hand_right", (-1.0, 0.0, 0.0)),
    ),
)
_BONES = tuple(bone for level in _LEVELS for bone in level)
# In the order of the file, which is depth first: what turns, and the tips, which do not.
_CHAINS = (
    ("head_base", "head"),
    ("collar_left", "shoulder_left", "elbow_left", "hand_left"),
    ("collar_right", "shoulder_right", "elbow_right", "hand_right"),
)


class BvhMotion(NamedTuple):
    """Skeleton and motion of T frames for a BVH file.

    Attributes:
        lengths: the lengths of the bones that end in `ends` [7], centimetres.
        position: the place of the neck, the root [T, 3], centimetres; x left, y up, z forward.
        angles: about z, x and y, in this order, degrees: the root's, then those of the nodes in the
            order of the file, tips (zero) included [T, 11, 3].
        ends: the names of the joints at which the bones end.
    """

    lengths: Tensor
    position: Tensor
    angles: Tensor
    ends: tuple[str, ...]


def write_bvh(track: PoseTrack, path: str | Path) -> None:
    """Write one sequence as ``.bvh``; the file appears whole or not at all.

    The root is the neck, since the hips are not tracked. It turns with the line of the shoulders and
    stays upright otherwise; from it come a chain to the head and one along each arm. Bones have the
    median of their lengths over the frames, in centimetres; at rest the arms point sideways (a T
    pose) and the person faces +z, with y up: that of the camera, or of the world where `PoseTrack.up` is
    known. Rotations are ``Zrotation Xrotation Yrotation``.

    Positions of joints do not tell how a bone is twisted about its own axis. Every bone is turned
    into its direction on the shortest way from its parent's, which leaves that twist undetermined:
    a palm's direction cannot be read from this file. Frames that are NaN repeat the one before them.

    Args:
        track: one sequence. path: the file.

    Raises:
        InputError: not one sequence, or no frame with a pose. OutputError: it cannot be written.
    """
    if len(track) != 1:
        raise InputError(f"a BVH file holds one sequence, got {len(track)}; see PoseTrack.sequence")
    joints = track.joints3d[0]
    if track.up is not None and track.frame == "camera":
        joints = joints @ level_rotation(track.up).to(joints).mT
    motion = joints_to_bvh(joints)
    write_bvh_motion(path, _nodes(motion), motion.position, motion.angles, track.fps or _FPS)


def joints_to_bvh(joints: Float[Tensor, "T 8 3"]) -> BvhMotion:
    """Return positions of joints as bone lengths and rotations.

    The root's axes are x along the shoulders, z = x × up, y = z × x. A bone of direction u is turned
    by the shortest arc from its direction at rest d to R^T u, R the rotation of its parent.

    Args:
        joints: [T, 8, 3], metres, camera axes (or the body frame, which has the same directions).

    Returns:
        `BvhMotion` in float64.

    Raises:
        InputError: no frame in which all joints are finite.
    """
    check_shape("joints", joints, [None, len(UPPER_BODY), 3])
    points = _fill(joints.detach().cpu().double()) * joints.new_tensor(_TO_Y_UP).cpu().double()
    where = {name: points[:, i] * _CENTIMETRES for i, name in enumerate(UPPER_BODY)}
    root = _shoulder_axes(where["shoulder_left"] - where["shoulder_right"])
    turned: dict[str, Tensor] = {}
    lengths = []
    parent = root[:, None]  # [T, 1 or bones of the level, 3, 3]
    for depth, level in enumerate(_LEVELS):
        starts = torch.stack([where.get(bone.node, where["neck"]) for bone in level], 1)
        bones = torch.stack([where[bone.end] for bone in level], 1) - starts
        lengths.append(bones.norm(dim=-1).median(0).values)
        rest = points.new_tensor([bone.rest for bone in level])
        local = _shortest_arc(rest, (parent.mT @ bones[..., None])[..., 0])
        turned |= {bone.node: local[:, i] for i, bone in enumerate(level)}
        parent = parent @ local
        if depth == 0:
            parent = parent[:, 1:]  # nothing follows the head
    still = torch.eye(3, dtype=torch.float64).expand_as(root)
    nodes = [root, *(turned.get(name, still) for chain in _CHAINS for name in chain)]
    angles = bvh_angles(torch.stack(nodes, 1))
    return BvhMotion(torch.cat(lengths), where["neck"], angles, tuple(b.end for b in _BONES))


def _fill(joints: Tensor) -> Tensor:
    """Replace frames with a joint that is not finite by the last good one, or the first at all."""
    good = torch.isfinite(joints).all(-1).all(-1)
    if not bool(good.any()):
        raise InputError(
            f"expected a frame in which all joints are finite, got none among {len(joints)}"
        )
    index = torch.where(good, torch.arange(len(joints)), -1).cummax(0).values
    first = int(torch.nonzero(good)[0])
    return joints[index.clamp_min(first)]


def _shoulder_axes(line: Tensor) -> Tensor:
    """Return rotations [T, 3, 3] with x along the line [T, 3] and y as upright as that allows."""
    x = torch.nn.functional.normalize(line, dim=-1)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=x.dtype).expand_as(x)
    z = torch.linalg.cross(x, up)
    upright = z.norm(dim=-1, keepdim=True)
    # of one who lies on the side, only the shoulders are followed
    lying = (upright < 1e-3)[..., None]
    z = z / upright.clamp_min(1e-3)
    framed = torch.stack([x, torch.linalg.cross(z, x), z], -1)
    return torch.where(lying, _shortest_arc(torch.eye(3, dtype=x.dtype)[0], line), framed)


def _shortest_arc(
    start: Float[Tensor, "*#batch 3"], goal: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3 3"]:
    """Return the smallest rotation that takes one direction into another.

    R = I + [v]x + [v]x^2 / (1 + c),   v = a × b, c = a . b; half a turn about z where b = -a.

    Args:
        start: unit vectors a at right angles to z. goal: b, of any length; 0 stands for a.
    """
    start = start.expand_as(goal)
    norm = goal.norm(dim=-1, keepdim=True)
    goal = torch.where(norm > 1e-9, goal / norm.clamp_min(1e-9), start)
    v, c = torch.linalg.cross(start, goal), (start * goal).sum(-1)
    skew = cross_matrix(v)
    eye = torch.eye(3, dtype=goal.dtype)
    opposite = (1 + c < 1e-12)[..., None, None]
    arc = eye + skew + skew @ skew / (1 + c).clamp_min(1e-12)[..., None, None]
    half_turn = torch.diag(goal.new_tensor([-1.0, -1.0, 1.0]))
    return torch.where(opposite, half_turn, arc)


def _nodes(motion: BvhMotion) -> list[BvhNode]:
    """Return the nodes with their offsets at rest."""
    lengths = dict(zip(motion.ends, motion.lengths.tolist(), strict=True))
    rests = {bone.end: bone.rest for bone in _BONES}  # what is no end of a bone starts in the neck
    nodes = [BvhNode("neck", -1)]
    for chain in _CHAINS:
        parent = 0
        for name in chain:
            x, y, z = (lengths.get(name, 0.0) * part for part in rests.get(name, (0.0, 0.0, 0.0)))
            nodes.append(BvhNode(name, parent, (x, y, z)))
            parent = len(nodes) - 1
    return nodes


_FRAMES_AT_A_TIME = 4096
_COLUMNS = ("x2d", "y2d", "x", "y", "z", "std_x", "std_y", "std_z", "observed")


def write_pose_csv(track: PoseTrack, path: str | Path) -> None:
    """Write one sequence as ``.csv``; the file appears whole or not at all.

    Lines that begin with ``#`` stand above the header and say what the columns are. Then a row for
    each frame: ``frame`` (of the recording), ``time`` (s), for each joint ``NAME_x2d``,
    ``NAME_y2d`` (pixels),
    ``NAME_x``, ``NAME_y``, ``NAME_z`` and their standard deviations ``NAME_std_x``, ... (m),
    ``NAME_observed`` (1 measured, 0 inferred), and at last ``log_evidence``. What is NaN is empty.

    Raises:
        InputError: not one sequence. OutputError: the file cannot be written.
    """
    if len(track) != 1:
        raise InputError(f"a table holds one sequence, got {len(track)}; see PoseTrack.sequence")
    header = ["frame", "time", *(f"{n}_{c}" for n in track.names for c in _COLUMNS), "log_evidence"]
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8") as stream:
        stream.write("\n".join([*_preamble(track), ",".join(header)]) + "\n")
        for start in range(0, track.joints3d.shape[1], _FRAMES_AT_A_TIME):
            stream.writelines(_rows(track, slice(start, start + _FRAMES_AT_A_TIME)))


def _rows(track: PoseTrack, frames: slice) -> Iterator[str]:
    """Return lines of some frames."""
    fps = track.fps or 30.0
    std = track.covariance3d[0, frames].diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
    observed = track.observed[0, frames, :, None].to(std)
    parts = [track.joints2d[0, frames].to(std), track.joints3d[0, frames], std, observed]
    joints, score = torch.cat(parts, -1).tolist(), track.log_evidence[0, frames].sum(-1).tolist()
    first = track.first_frame + frames.start
    for frame, (row, evidence) in enumerate(zip(joints, score, strict=True), start=first):
        cells = [_joint_cells(joint) for joint in row]
        yield ",".join([str(frame), f"{frame / fps:.4f}", *cells, _cell(evidence, 6)]) + "\n"


def _preamble(track: PoseTrack) -> list[str]:
    axes = "camera axes: x right, y down, z forward" if track.frame == "camera" else "body frame"
    return [
        "# NAME_x2d, NAME_y2d: pixels; NAME_x, NAME_y, NAME_z and their standard deviations "
        f"NAME_std_*: metres ({axes})",
        "# NAME_observed: 1 measured, 0 inferred; log_evidence: sum over both arms, a score",
        f"# fps = {track.fps if track.fps is not None else 'unknown (time is for 30)'}",
        *(f"# note: {note}" for note in track.notes),
    ]


def _joint_cells(joint: list[float]) -> str:
    pixels, metres, seen = joint[:2], joint[2:8], joint[8]
    cells = [*(_cell(v, 3) for v in pixels), *(_cell(v, 6) for v in metres), str(int(seen))]
    return ",".join(cells)


def _cell(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else ""
