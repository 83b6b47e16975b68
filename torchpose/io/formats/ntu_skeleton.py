"""NTU RGB+D skeletons, ``.skeleton``: Kinect v2, several bodies per file that come and go."""

import re
from pathlib import Path

import numpy as np

from torchpose._core.reading import read_text
from torchpose.errors import FileFormatError
from torchpose.io.formats.raw_recording import SENSOR_WEIGHTS, BodyFrame, RawRecording, join_bodies
from torchpose.skeleton.joint_sets import SKELETONS

__all__ = ["read_ntu_skeleton"]

_NAMES = SKELETONS["kinect-v2-25"].joints
_FPS = 30.0
_DIGITS = 9  # of the number of frames, bodies or joints
_JOINT_NUMBERS = 12  # x, y, z, pixels in two images, quaternion, tracking state
_FILE_NAME = re.compile(r"S\d{3}C\d{3}(P\d{3})R\d{3}(A\d{3})")


def read_ntu_skeleton(path: Path) -> list[RawRecording]:
    """Read a ``.skeleton`` file: metres, Kinect axes, 30 frames per second, tracking states.

    The person is the P of the file's name and the action its A (S001C001P001R001A001); other names
    leave the person to the folder. Of several bodies the one tracked longest is that person;
    see `torchpose.io.formats.raw_recording.join_bodies` for the others.

    Raises:
        FileFormatError: truncated, or another kind of file; line and frame are named.
    """
    lines = read_text(path, "an NTU skeleton file", "ascii").split("\n")
    reader = _Lines(path, lines)
    n_frames = reader.count("the number of frames")
    frames = [body for frame in range(n_frames) for body in _read_frame(reader, frame)]
    if any(line.strip() for line in lines[reader.place :]):
        raise FileFormatError(
            f"{path}, line {reader.place + 1}: expected the end after {n_frames} frames, got more"
        )
    named = _FILE_NAME.match(path.stem)
    person, action = named.groups() if named else ("", path.stem)
    notes = () if named else ("no P in the file's name: the folder stands for the person",)
    return join_bodies(
        path, frames, n_frames, _NAMES, _FPS, axes="kinect", unit=1.0, person=person, action=action,
        source="NTU-RGB+D" if named else "", notes=notes,
    )  # fmt: skip


class _Lines:
    """The lines of a file, one after the other."""

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
        if n_joints != len(_NAMES):
            raise FileFormatError(
                f"{reader.path}, line {reader.place}, frame {frame}: expected {len(_NAMES)} joints, "
                f"got {n_joints}"
            )
        joints = np.array([_read_joint(reader, frame, name) for name in _NAMES])
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
