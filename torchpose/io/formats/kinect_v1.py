"""Text files of Kinect v1 skeletons: rows of 20 joints, and MSR Daily Activity 3D."""

from pathlib import Path

import numpy as np

from torchpose._core.reading import read_text, reading
from torchpose.errors import FileFormatError
from torchpose.io.formats.kinect_csv import KINECT_FPS, read_kinect_csv, split_row
from torchpose.io.formats.raw_recording import BodyFrame, RawRecording, join_bodies
from torchpose.skeleton.joint_sets import SKELETONS

__all__ = ["read_kinect_v1"]

_NAMES = SKELETONS["kinect-v1-20"].joints
_ROWS_PER_BODY = 2 * len(_NAMES)  # each joint in metres, then in pixels


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
    if lengths <= {3, 4} and len(lines) >= len(_NAMES) and lengths:
        raise FileFormatError(
            f"{path}: rows of {max(lengths)} numbers, one for each joint, do not say which joint is "
            "which (MSR-Action3D has an order of its own); write a .csv with a header of NAME_x, "
            "NAME_y, NAME_z"
        )
    first = split_row(lines[0]) if lines else []
    if len(first) == 2 and first[1] == str(len(_NAMES)):
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
            raise FileFormatError(f"{path}: expected {n_frames} frames, ends in frame {frame}")
        rows = int(values[place])
        block = values[place + 1 : place + 1 + 4 * rows]
        if rows % _ROWS_PER_BODY or rows < 0 or len(block) != 4 * rows:
            raise FileFormatError(
                f"{path}, frame {frame}: expected {_ROWS_PER_BODY} rows of 4 numbers for each body, "
                f"got {rows} of which {len(block) // 4} are there"
            )
        place += 1 + 4 * rows
        bodies = block.reshape(-1, len(_NAMES), 2, 4)[:, :, 0, :3]
        frames += [
            BodyFrame(frame, str(i), joints) for i, joints in enumerate(bodies) if joints.any()
        ]
    return join_bodies(
        path, frames, n_frames, _NAMES, KINECT_FPS, axes="kinect", action=path.stem,
        notes=("30 frames per second assumed: the file does not say",),
    )  # fmt: skip
