"""Read skeletons of sensors' software: Kinect v1 text, NTU RGB+D, Azure Kinect JSON."""

import re
from pathlib import Path
from typing import Any

import numpy as np

from torchpose._core.reading import read_json, read_text, reading
from torchpose._core.wording import counted
from torchpose.errors import FileFormatError
from torchpose.io._formats.kinect_csv import read_kinect_csv
from torchpose.io._formats.raw_recording import (
    LEVEL_WEIGHTS,
    SENSOR_WEIGHTS,
    BodyFrame,
    RawRecording,
    join_bodies,
)
from torchpose.io._formats.table_rows import KINECT_FPS, dropped_frames, split_row
from torchpose.skeleton._joint_sets import SKELETONS

_KINECT_V1_NAMES = SKELETONS["kinect-v1-20"].joints
_ROWS_PER_BODY = 2 * len(_KINECT_V1_NAMES)  # each joint in metres, then in pixels


def read_kinect_v1(path: Path) -> list[RawRecording]:
    """Read a ``.txt`` file with the 20 joints of Kinect v1 in the order of the SDK.

    Two layouts: one row per frame, as `read_kinect_csv` takes it (60 coordinates, or 80 numbers, a
    time or the frame's number in front), and that of MSR Daily Activity 3D: the numbers of
    frames and joints, then of each frame the number of rows and the rows, two for each joint, of
    which the first is x, y, z in metres. Its bodies are told apart by their place alone.

    Raises:
        FileFormatError: another layout, or a truncated file. The rows of MSR-Action3D are one: their
            joints have an order of their own, for which left and right are not documented.
    """
    lines = [line for line in read_text(path, "rows of numbers").splitlines() if line.strip()]
    lengths = {len(split_row(line)) for line in lines[:60]}
    if lengths <= {3, 4} and len(lines) >= len(_KINECT_V1_NAMES) and lengths:
        raise FileFormatError(
            f"{path}: rows of {max(lengths)} numbers, one for each joint, do not say which joint is "
            "which (MSR-Action3D has an order of its own); write a .csv with a header of NAME_x, "
            "NAME_y, NAME_z"
        )
    first = split_row(lines[0]) if lines else []
    if len(first) == 2 and first[1] == str(len(_KINECT_V1_NAMES)):
        return _read_daily(path, lines)
    return read_kinect_csv(path)


def _read_daily(path: Path, lines: list[str]) -> list[RawRecording]:
    with reading(path, "rows of numbers"):
        values = np.array([float(cell) for line in lines for cell in line.split()])
    if not np.isfinite(values).all():
        raise FileFormatError(
            f"{path}: expected finite numbers, got {values[~np.isfinite(values)][0]}"
        )
    n_frames, place = int(values[0]), 2
    frames: list[BodyFrame] = []
    for frame in range(n_frames):
        if place >= len(values):
            raise FileFormatError(
                f"{path}: expected {counted(n_frames, 'frame')}, ends in frame {frame}"
            )
        rows = int(values[place])
        block = values[place + 1 : place + 1 + 4 * rows]
        if rows % _ROWS_PER_BODY or rows < 0 or len(block) != 4 * rows:
            raise FileFormatError(
                f"{path}, frame {frame}: expected {_ROWS_PER_BODY} rows of 4 numbers for each body, "
                f"got {rows} of which {len(block) // 4} are there"
            )
        place += 1 + 4 * rows
        bodies = block.reshape(-1, len(_KINECT_V1_NAMES), 2, 4)[:, :, 0, :3]
        frames += [
            BodyFrame(frame, str(i), joints) for i, joints in enumerate(bodies) if joints.any()
        ]
    return join_bodies(
        path, frames, n_frames, _KINECT_V1_NAMES, KINECT_FPS, axes="kinect", action=path.stem,
        notes=("30 frames per second assumed: the file does not say",),
    )  # fmt: skip


_NTU_NAMES = SKELETONS["kinect-v2-25"].joints
_FPS = 30.0
_DIGITS = 9  # of the number of frames, bodies or joints
_JOINT_NUMBERS = 12  # x, y, z, pixels in two images, quaternion, tracking state
_FILE_NAME = re.compile(r"S\d{3}C\d{3}(P\d{3})R\d{3}(A\d{3})")


def read_ntu_skeleton(path: Path) -> list[RawRecording]:
    """Read a ``.skeleton`` file: metres, Kinect axes, 30 frames per second, tracking states.

    The person is the P of the file's name and the action its A (S001C001P001R001A001); other names
    leave the person to the folder. Of several bodies the one tracked longest is that person;
    see `torchpose.io._formats.raw_recording.join_bodies` for the others.

    Raises:
        FileFormatError: truncated, or another kind of file; line and frame are named.
    """
    lines = read_text(path, "an NTU skeleton file", "ascii").split("\n")
    reader = _Lines(path, lines)
    n_frames = reader.count("the number of frames")
    frames = [body for frame in range(n_frames) for body in _read_frame(reader, frame)]
    if any(line.strip() for line in lines[reader.place :]):
        raise FileFormatError(
            f"{path}, line {reader.place + 1}: expected the end after {counted(n_frames, 'frame')}, got more"
        )
    named = _FILE_NAME.match(path.stem)
    person, action = named.groups() if named else ("", path.stem)
    notes = () if named else ("no P in the file's name: the folder stands for the person",)
    return join_bodies(
        path, frames, n_frames, _NTU_NAMES, _FPS, axes="kinect", unit=1.0, person=person, action=action,
        source="NTU-RGB+D" if named else "", notes=notes,
    )  # fmt: skip


class _Lines:
    """Reads the lines of a file one after the other."""

    def __init__(self, path: Path, lines: list[str]) -> None:
        self.path, self.lines, self.place = path, lines, 0

    def cells(self, what: str) -> list[str]:
        if self.place >= len(self.lines) or not self.lines[self.place].strip():
            raise FileFormatError(
                f"{self.path}, line {self.place + 1}: expected {what}, the file ends"
            )
        self.place += 1
        return self.lines[self.place - 1].split()

    def count(self, what: str) -> int:
        cells = self.cells(what)
        if len(cells) != 1 or not cells[0].isdigit() or len(cells[0]) > _DIGITS:
            got = " ".join(cells)[:40]
            raise FileFormatError(f"{self.path}, line {self.place}: expected {what}, got {got!r}")
        return int(cells[0])


def _read_frame(reader: _Lines, frame: int) -> list[BodyFrame]:
    bodies = []
    for _ in range(reader.count(f"the number of bodies in frame {frame}")):
        body = reader.cells(f"a body of frame {frame}")[0]
        n_joints = reader.count(f"the number of joints in frame {frame}")
        if n_joints != len(_NTU_NAMES):
            raise FileFormatError(
                f"{reader.path}, line {reader.place}, frame {frame}: expected {len(_NTU_NAMES)} joints, "
                f"got {n_joints}"
            )
        joints = np.array([_read_joint(reader, frame, name) for name in _NTU_NAMES])
        weights = np.array(SENSOR_WEIGHTS)[joints[:, 3].astype(int)]
        bodies.append(BodyFrame(frame, body, joints[:, :3], weights))
    return bodies


def _read_joint(reader: _Lines, frame: int, name: str) -> list[float]:
    cells = reader.cells(f"{name} of frame {frame}")
    try:
        numbers = [float(cell) for cell in cells]
    except ValueError as error:
        raise FileFormatError(
            f"{reader.path}, line {reader.place}, frame {frame}: expected numbers ({error})"
        ) from error
    if len(numbers) != _JOINT_NUMBERS or numbers[-1] not in (0, 1, 2):
        raise FileFormatError(
            f"{reader.path}, line {reader.place}, frame {frame}: expected {_JOINT_NUMBERS} numbers of "
            f"{name}, the last a tracking state of 0, 1 or 2; got {' '.join(cells)[:60]!r}"
        )
    return [*numbers[:3], numbers[-1]]


_AZURE_NAMES = SKELETONS["azure-32"].joints
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
    names = content.get("joint_names", _AZURE_NAMES)
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
        weights = np.array(LEVEL_WEIGHTS)[levels.astype(int)]
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
