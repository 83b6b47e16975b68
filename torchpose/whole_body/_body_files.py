"""Write whole bodies for biomechanics and animation: TRC and C3D of markers, BVH of a skeleton."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.checks import check_choice
from torchpose.body._feet import ANKLES, FEET
from torchpose.body._kinematics import Body
from torchpose.body._skeleton import BODY_15
from torchpose.io._bvh_file import BvhNode, bvh_angles, write_bvh_motion
from torchpose.io._c3d_file import write_c3d
from torchpose.io._trc_file import write_trc
from torchpose.math._gaussian import mean_std
from torchpose.whole_body._body_feet import BodyFeet, TrackedPoints

BODY_FORMATS = ("trc", "c3d", "bvh")
UP_AXES = ("z", "y")
_CENTIMETRES = 100.0
_PREDICTED = 1.0  # seconds for which somebody whom no camera sees is where they are predicted
_Z_UP_TO_Y_UP = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))  # as Pose2Sim turns its axes


class BodyMotion3d(NamedTuple):
    """Holds what files of bodies are written from.

    Attributes:
        body: the body of the person. state: of that body. points: joints, and those of feet.
        coasting: frames in which no camera saw the person.
        fps: frames per second. first_frame: number of the first frame.
        feet: of the person, None where they were not tracked.
    """

    body: Body
    state: Float[Tensor, "T D"]
    points: TrackedPoints
    coasting: Bool[Tensor, " T"]
    fps: float
    first_frame: int
    feet: BodyFeet | None = None

    @property
    def present(self) -> Int[Tensor, " T"]:
        """Return the last frame up to each one, as a rule itself, in which the person is not absent."""
        frames = torch.arange(len(self.coasting), device=self.coasting.device)
        seen = frames.where(~self.coasting, -1).cummax(0).values
        return frames.where(frames - seen <= self.fps * _PREDICTED, 0).cummax(0).values


def write_body_file(path: str | Path, motion: BodyMotion3d, up: str | None) -> None:
    """Write a motion as ``.trc``, ``.c3d`` or ``.bvh``, by the suffix.

    Somebody whom no camera has seen for more than a second is somewhere else than predicted: markers are
    missing then, and BVH, which has no missing frames, repeats the last pose before.

    Args:
        path: the file, which is replaced.
        up: the axis of the world that points up; files then have y up. None keeps the axes of the world.

    Raises:
        InputError: another suffix or axis. OutputError: the file cannot be written.
    """
    path = Path(path)
    kind = path.suffix.lower().removeprefix(".")
    check_choice("the suffix of a file of bodies", kind, BODY_FORMATS)
    names, points, covariance = motion.points
    turn = _turn_to_y_up(up).to(points)
    if kind == "bvh":
        _write_skeleton(path, motion, turn)
        return
    present = motion.present
    absent = present != torch.arange(len(present), device=present.device)
    points = (points @ turn.mT).masked_fill(absent[:, None, None], torch.nan)
    names = marker_names(names)
    if kind == "trc":
        write_trc(path, points, names, motion.fps, first_frame=motion.first_frame)
    else:
        write_c3d(
            path, points, names, motion.fps, std=mean_std(covariance), y_up=up is not None,
            first_frame=motion.first_frame,
        )  # fmt: skip


def marker_names(joints: Sequence[str]) -> tuple[str, ...]:
    """Return the names of joints as Pose2Sim and its models for OpenSim have them.

    >>> marker_names(("pelvis", "neck", "left_elbow", "right_big_toe"))
    ('CHip', 'Neck', 'LElbow', 'RBigToe')
    """
    return tuple(map(_marker_name, joints))


def _marker_name(joint: str) -> str:
    if joint == "pelvis":
        return "CHip"
    *side, kind = joint.split("_", 1)
    return "".join(side)[:1].upper() + "".join(word.capitalize() for word in kind.split("_"))


def _turn_to_y_up(up: str | None) -> Float[Tensor, "3 3"]:
    """Return the rotation from the world to the axes of a file."""
    if up is not None:
        check_choice("up", up, UP_AXES)
    if up == "z":
        return torch.tensor(_Z_UP_TO_Y_UP, dtype=torch.float64)
    return torch.eye(3, dtype=torch.float64)


# --- the skeleton -----------------------------------------------------------------------------------


class _PartNode(NamedTuple):
    """A node of the file, and the part of the body with which it turns."""

    node: BvhNode
    part: int


def _write_skeleton(path: Path, motion: BodyMotion3d, turn: Float[Tensor, "3 3"]) -> None:
    """Write the rigid body of a track: the bones that it has in every frame, turned by the states.

    Feet that were tracked are joints in the places of the ankles, each with an end at its big toe.
    """
    state = motion.state.detach().cpu().double()
    turn = turn.cpu().double()
    parts = motion.body.part_rotations(state.to(motion.body.bone_lengths)).cpu().double()
    toes: list[Tensor] = []
    if motion.feet is not None:
        feet = parts[:, [BODY_15.part_of[a] for a in ANKLES]] @ motion.feet.rotation.cpu().double()
        toes = [*_toes(motion.feet, motion.points.points3d, feet)]
        parts = torch.cat([parts, feet], 1)
    nodes = _part_nodes(motion.body, toes)
    present = motion.present.cpu()
    parts, state = turn @ parts[present], state[present]
    world = torch.stack([parts[:, node.part] for node in nodes], 1)
    parents = [node.node.parent for node in nodes]
    above = world[:, [max(parent, 0) for parent in parents]]
    local = torch.cat([world[:, :1], above[:, 1:].mT @ world[:, 1:]], 1)
    position = _CENTIMETRES * state[:, :3] @ turn.mT
    write_bvh_motion(path, [node.node for node in nodes], position, bvh_angles(local), motion.fps)


def _toes(
    feet: BodyFeet, joints: Float[Tensor, "T J 3"], rotations: Float[Tensor, "T 2 3 3"]
) -> Float[Tensor, "2 3"]:
    """Return the median big toes from the ankles in the axes of the feet, centimetres."""
    toes = [FEET.index(f"{side}_big_toe") for side in ("left", "right")]
    away = (feet.points3d[:, toes] - joints[:, ANKLES]).cpu().double()
    return _CENTIMETRES * (rotations.mT @ away[..., None]).squeeze(-1).median(0).values


def _part_nodes(body: Body, toes: Sequence[Float[Tensor, "3"]]) -> list[_PartNode]:
    """Return a node for every joint, depth first, and one for every further part that turns about it.

    Args:
        body: of the person. toes: ends of both feet, whose parts follow on those of the body; or none.
    """
    nodes: list[_PartNode] = []
    _add_joint(nodes, body, 0, -1, dict(zip(ANKLES, toes, strict=False)))
    return nodes


def _add_joint(
    nodes: list[_PartNode], body: Body, joint: int, parent: int, toes: Mapping[int, Tensor]
) -> None:
    """Append the node of a joint and all below it.

    A node turns with the part of the bones that leave it. Where these are of several parts, it turns with
    the joint's own, and a node in the same place with each of the others.
    """
    skeleton = body.skeleton
    children: dict[int, list[int]] = {}
    for child, above in enumerate(skeleton.parents):
        if above == joint:
            children.setdefault(skeleton.part_of[child], []).append(child)
    own = next(iter(children)) if len(children) == 1 and parent >= 0 else skeleton.part_of[joint]
    x, y, z = (_CENTIMETRES * body.offsets[joint]).tolist() if parent >= 0 else (0.0, 0.0, 0.0)
    here = len(nodes)
    nodes.append(_PartNode(BvhNode(skeleton.names[joint], parent, (x, y, z)), own))
    if joint in toes:
        foot = skeleton.names[joint].replace("ankle", "foot")
        part = len(skeleton.parts) + ANKLES.index(joint)
        end_x, end_y, end_z = toes[joint].tolist()
        nodes.append(_PartNode(BvhNode(foot, here, end=(end_x, end_y, end_z)), part))
    for part, joints in children.items():
        base = here
        if part != own:
            base = len(nodes)
            nodes.append(_PartNode(BvhNode(f"{skeleton.parts[part]}_base", here), part))
        for child in joints:
            _add_joint(nodes, body, child, base, toes)
