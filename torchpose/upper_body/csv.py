"""Poses as a table for spreadsheets."""

import math
from collections.abc import Iterator
from pathlib import Path

import torch

from torchpose._core.files import atomic_path
from torchpose.errors import InputError
from torchpose.upper_body.pose_track import PoseTrack

__all__ = ["write_pose_csv"]

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
    """Lines of some frames."""
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
