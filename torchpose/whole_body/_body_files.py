"""Write whole bodies for biomechanics and animation: TRC and C3D of markers, BVH of a skeleton."""

from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_choice
from torchpose.body._kinematics import Body
from torchpose.body._skeleton import BodySkeleton
from torchpose.io._bvh_file import BvhNode, bvh_angles, write_bvh_motion
from torchpose.io._c3d_file import write_c3d
from torchpose.io._trc_file import write_trc

BODY_FORMATS = ("trc", "c3d", "bvh")
UP_AXES = ("z", "y")
_CENTIMETRES = 100.0
_Z_UP_TO_Y_UP = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))  # as Pose2Sim turns its axes


class BodyMotion3d(NamedTuple):
    """Holds what files of bodies are written from.

    Attributes:
        body: the body of the person. state: of that body. joints: metres, world axes.
        std: of the joints, metres. fps: frames per second. first_frame: number of the first frame.
    """

    body: Body
    state: Float[Tensor, "T D"]
    joints: Float[Tensor, "T J 3"]
    std: Float[Tensor, "T J"]
    fps: float
    first_frame: int


def write_body_file(path: str | Path, motion: BodyMotion3d, up: str | None = None) -> None:
    """Write a motion as ``.trc``, ``.c3d`` or ``.bvh``, by the suffix.

    Args:
        path: the file, which is replaced.
        up: the axis of the world that points up; files then have y up. None keeps the axes of the world.

    Raises:
        InputError: another suffix or axis. OutputError: the file cannot be written.
    """
    path = Path(path)
    kind = path.suffix.lower().removeprefix(".")
    check_choice("the suffix of a file of bodies", kind, BODY_FORMATS)
    turn = _turn_to_y_up(up).to(motion.joints)
    joints, names = motion.joints @ turn.mT, marker_names(motion.body.skeleton)
    if kind == "bvh":
        _write_skeleton(path, motion, turn)
    elif kind == "trc":
        write_trc(path, joints, names, motion.fps, first_frame=motion.first_frame)
    else:
        write_c3d(
            path, joints, names, motion.fps, std=motion.std, y_up=up is not None,
            first_frame=motion.first_frame,
        )  # fmt: skip


def marker_names(skeleton: BodySkeleton) -> tuple[str, ...]:
    """Return the names of the joints as Pose2Sim and its models for OpenSim have them.

    >>> from torchpose.body import BODY_15
    >>> marker_names(BODY_15)[:5]
    ('CHip', 'Neck', 'Head', 'LShoulder', 'LElbow')
    """
    return tuple(map(_marker_name, skeleton.names))


def _marker_name(joint: str) -> str:
    if joint == "pelvis":
        return "CHip"
    side, _, kind = joint.rpartition("_")
    return side[:1].upper() + kind.capitalize()


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
    """Write the rigid body of a track: the bones that it has in every frame, turned by the states."""
    nodes = _part_nodes(motion.body)
    state = motion.state.detach().cpu().double()
    turn = turn.cpu().double()
    parts = turn @ motion.body.part_rotations(state.to(motion.body.bone_lengths)).cpu().double()
    world = torch.stack([parts[:, node.part] for node in nodes], 1)
    parents = [node.node.parent for node in nodes]
    above = world[:, [max(parent, 0) for parent in parents]]
    local = torch.cat([world[:, :1], above[:, 1:].mT @ world[:, 1:]], 1)
    position = _CENTIMETRES * state[:, :3] @ turn.mT
    write_bvh_motion(path, [node.node for node in nodes], position, bvh_angles(local), motion.fps)


def _part_nodes(body: Body) -> list[_PartNode]:
    """Return a node for every joint, depth first, and one for every further part that turns about it."""
    nodes: list[_PartNode] = []
    _add_joint(nodes, body, 0, -1)
    return nodes


def _add_joint(nodes: list[_PartNode], body: Body, joint: int, parent: int) -> None:
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
    for part, joints in children.items():
        base = here
        if part != own:
            base = len(nodes)
            nodes.append(_PartNode(BvhNode(f"{skeleton.parts[part]}_base", here), part))
        for child in joints:
            _add_joint(nodes, body, child, base)
