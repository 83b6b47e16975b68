"""Azure Kinect, ``.json`` as the SDK's offline_processor writes it."""

from pathlib import Path
from typing import Any

import numpy as np

from torchpose._core.reading import read_json
from torchpose.errors import FileFormatError
from torchpose.io.formats.kinect_csv import KINECT_FPS, dropped_frames
from torchpose.io.formats.raw_recording import BodyFrame, RawRecording, join_bodies
from torchpose.skeleton.joint_sets import SKELETONS

__all__ = ["read_azure_json"]

_NAMES = SKELETONS["azure-32"].joints
_CONFIDENCE_WEIGHTS = (0.0, 0.5, 1.0, 1.0)  # out of range, occluded (predicted), medium, high
_CONFIDENCE_KEYS = ("joint_confidence", "joint_confidences", "confidence_level",
                    "confidence_levels", "joint_confidence_levels")  # fmt: skip
_MICROSECOND = 1e-6
_LATEST = 2.0**63  # of the SDK's stamps, which are whole numbers of 64 bits


def read_azure_json(path: Path) -> list[RawRecording]:
    """Read `frames`, each with `bodies` of a `body_id` and `joint_positions` [32, 3] in millimetres.

    Joints are in the axes of the depth camera (x right, y down, z away). Where bodies have a list of
    confidence levels (`joint_confidence`), 0 is missing, 1 (predicted) weighs one half and more weighs
    one. `joint_names` gives the order where it is there, `timestamp_usec` the frame rate.

    Raises:
        FileFormatError: no such file, another number of joints; the frame is named.
    """
    content = read_json(path, "JSON of the Azure Kinect")
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise FileFormatError(
            f"{path}: expected the Azure Kinect's 'frames' with 'bodies', found another kind of JSON"
        )
    names = content.get("joint_names", _NAMES)
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise FileFormatError(f"{path}: joint_names must be a list of text, got {names!r:.60}")
    names = tuple(names)
    frames, stamps = content["frames"], []
    bodies: list[BodyFrame] = []
    for number, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("bodies", []), list):
            raise FileFormatError(f"{path}, frame {number}: expected 'bodies'")
        bodies += [_read_body(path, number, body, len(names)) for body in frame.get("bodies", [])]
        stamp = frame.get("timestamp_usec")
        if isinstance(stamp, int | float) and abs(stamp) < _LATEST:
            stamps.append(float(stamp))
    fps, notes = _rate(path, stamps)
    return join_bodies(
        path, bodies, len(frames), names, fps, axes="camera", unit=0.001, action=path.stem,
        notes=notes,
    )  # fmt: skip


def _read_body(path: Path, frame: int, body: Any, n_joints: int) -> BodyFrame:
    where = f"{path}, frame {frame}"
    if not isinstance(body, dict) or not {"body_id", "joint_positions"} <= set(body):
        raise FileFormatError(f"{where}: expected 'body_id' and 'joint_positions' of each body")
    where += f", body {body['body_id']}"
    joints = _array(where, "joint_positions", body["joint_positions"], (n_joints, 3))
    found = [key for key in _CONFIDENCE_KEYS if key in body]
    weights = None
    if found:
        levels = _array(where, found[0], body[found[0]], (n_joints,))
        if not set(np.unique(levels)) <= {0.0, 1.0, 2.0, 3.0}:
            raise FileFormatError(f"{where}: confidence levels must be 0, 1, 2 or 3")
        weights = np.array(_CONFIDENCE_WEIGHTS)[levels.astype(int)]
    return BodyFrame(frame, str(body["body_id"]), joints, weights)


def _array(where: str, key: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    try:
        array = np.array(value, dtype=np.float64)  # null becomes NaN
    except (TypeError, ValueError, OverflowError) as error:
        raise FileFormatError(f"{where}: {key} must be numbers ({error})") from error
    if array.shape != shape:
        raise FileFormatError(
            f"{where}: {key} must have shape {list(shape)}, got {list(array.shape)}"
        )
    return array


def _rate(path: Path, stamps: list[float]) -> tuple[float, tuple[str, ...]]:
    steps = np.diff(stamps)
    if not len(steps):
        return KINECT_FPS, ("30 frames per second assumed: the file has no time stamps",)
    if (steps <= 0).any():
        frame = int(np.flatnonzero(steps <= 0)[0]) + 1
        raise FileFormatError(f"{path}, frame {frame}: time stamps must increase")
    return float(1 / (_MICROSECOND * np.median(steps))), tuple(dropped_frames(np.array(stamps)))
