"""A BVH reader for tests: parses any such file and poses it node by node, in NumPy."""

from pathlib import Path
from typing import NamedTuple

import numpy as np


class Node(NamedTuple):
    name: str
    parent: int
    offset: np.ndarray
    channels: tuple[str, ...]


class Motion(NamedTuple):
    nodes: list[Node]
    frames: np.ndarray
    frame_time: float


def read_bvh(path: Path) -> Motion:
    tokens = path.read_text().split()
    nodes: list[Node] = []
    open_nodes: list[int] = []
    i = 0
    assert tokens[i] == "HIERARCHY"
    i += 1
    while tokens[i] != "MOTION":
        if tokens[i] in ("ROOT", "JOINT", "End"):
            parent = open_nodes[-1] if open_nodes else -1
            assert tokens[i + 2] == "{" and tokens[i + 3] == "OFFSET"
            offset = np.array([float(t) for t in tokens[i + 4 : i + 7]])
            name = tokens[i + 1] if tokens[i] != "End" else f"end of {nodes[parent].name}"
            ends = tokens[i] == "End"
            i += 7
            channels: tuple[str, ...] = ()
            if not ends:
                assert tokens[i] == "CHANNELS"
                count = int(tokens[i + 1])
                channels = tuple(tokens[i + 2 : i + 2 + count])
                i += 2 + count
            open_nodes.append(len(nodes))
            nodes.append(Node(name, parent, offset, channels))
        else:
            assert tokens[i] == "}"
            open_nodes.pop()
            i += 1
    assert not open_nodes
    assert tokens[i + 1] == "Frames:" and tokens[i + 3 : i + 5] == ["Frame", "Time:"]
    count, frame_time = int(tokens[i + 2]), float(tokens[i + 5])
    frames = np.array([float(t) for t in tokens[i + 6 :]]).reshape(count, -1)
    assert frames.shape[1] == sum(len(node.channels) for node in nodes)
    return Motion(nodes, frames, frame_time)


def pose(motion: Motion, frame: int) -> dict[str, np.ndarray]:
    """Positions of all nodes in one frame, from the root outwards."""
    values = iter(motion.frames[frame])
    rotations: list[np.ndarray] = []
    places: list[np.ndarray] = []
    for node in motion.nodes:
        shift, turn = np.zeros(3), np.eye(3)
        for channel in node.channels:
            value = next(values)
            axis = "XYZ".index(channel[0])
            if channel.endswith("position"):
                shift[axis] = value
            else:
                turn = turn @ _about(axis, np.deg2rad(value))
        above = np.eye(3) if node.parent < 0 else rotations[node.parent]
        start = np.zeros(3) if node.parent < 0 else places[node.parent]
        places.append(start + above @ (node.offset + shift))
        rotations.append(above @ turn)
    return {node.name: place for node, place in zip(motion.nodes, places, strict=True)}


def _about(axis: int, angle: float) -> np.ndarray:
    turn = np.eye(3)
    a, b = (axis + 1) % 3, (axis + 2) % 3
    turn[a, a] = turn[b, b] = np.cos(angle)
    turn[b, a] = np.sin(angle)
    turn[a, b] = -turn[b, a]
    return turn
