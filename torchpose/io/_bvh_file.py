"""Write the hierarchy and the motion of a skeleton as a BVH file for animation software."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.files import atomic_path
from torchpose.math._rotations import matrix_to_euler

_ROTATIONS = "Zrotation Xrotation Yrotation"
_NOWHERE = (0.0, 0.0, 0.0)


class BvhNode(NamedTuple):
    """Describes a node of the hierarchy.

    Attributes:
        name: of the node. parent: index of its parent, -1 for the root.
        offset: from the parent at rest, in the unit of the file. end: from the node to the point in which it
            ends, if it has no child.
    """

    name: str
    parent: int
    offset: tuple[float, float, float] = _NOWHERE
    end: tuple[float, float, float] = _NOWHERE


def bvh_angles(rotations: Float[Tensor, "T N 3 3"]) -> Float[Tensor, "T N 3"]:
    """Return angles about z, x and y, in this order, degrees; none jumps by a whole turn.

    Args:
        rotations: of each node relative to its parent.
    """
    angles = torch.rad2deg(matrix_to_euler(rotations, "zxy"))
    return torch.from_numpy(np.unwrap(angles.numpy(), axis=0, period=360.0))


def write_bvh_motion(
    path: str | Path,
    nodes: Sequence[BvhNode],
    position: Float[Tensor, "T 3"],
    angles: Float[Tensor, "T N 3"],
    fps: float,
) -> None:
    """Write a motion as ``.bvh``; the file appears whole or not at all.

    Args:
        path: the file. nodes: depth first, the root first. position: of the root, in the unit of the file.
        angles: of the nodes in their order, from `bvh_angles`. fps: frames per second.

    Raises:
        OutputError: it cannot be written.
    """
    rows = torch.cat([position, angles.flatten(1)], 1).numpy()
    header = [
        "HIERARCHY",
        *_hierarchy(nodes),
        "MOTION",
        f"Frames: {len(rows)}",
        f"Frame Time: {1 / fps:.8f}",
    ]
    with atomic_path(path) as temporary, temporary.open("w", encoding="ascii") as stream:
        np.savetxt(stream, rows, fmt="%.6f", header="\n".join(header), comments="")


def _hierarchy(nodes: Sequence[BvhNode]) -> list[str]:
    """Return lines of the nodes with their offsets at rest; what has no child ends in a point."""
    lines: list[str] = []
    depths: list[int] = []
    parents = {node.parent for node in nodes}
    for i, node in enumerate(nodes):
        depth = 0 if node.parent < 0 else depths[node.parent] + 1
        lines += _closed(depths[-1:], depth)
        depths.append(depth)
        tab = "\t" * depth
        kind, places = ("ROOT", "6 Xposition Yposition Zposition") if depth == 0 else ("JOINT", "3")
        lines += [f"{tab}{kind} {node.name}", f"{tab}{{", f"{tab}\t{_offset(node.offset)}",
                  f"{tab}\tCHANNELS {places} {_ROTATIONS}"]  # fmt: skip
        if i not in parents:
            lines += [
                f"{tab}\tEnd Site",
                f"{tab}\t{{",
                f"{tab}\t\t{_offset(node.end)}",
                f"{tab}\t}}",
            ]
    return lines + _closed(depths[-1:], 0)


def _closed(last: list[int], depth: int) -> list[str]:
    """Return the braces that close the nodes down to a depth, after one of the last depth."""
    return ["\t" * open_depth + "}" for one in last for open_depth in range(one, depth - 1, -1)]


def _offset(offset: tuple[float, float, float]) -> str:
    return "OFFSET " + " ".join(f"{part:.6f}" for part in offset)
