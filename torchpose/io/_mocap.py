"""Read motion capture as clips of whole bodies: fifteen joints at one rate, in the axes of the file.

`torchpose.io._recordings` turns everybody towards the camera; a room with several calibrated cameras
has axes of its own, so here they are those of the file, in metres.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.body._skeleton import body_joints
from torchpose.errors import InputError
from torchpose.io._recordings import Recording, read_recordings
from torchpose.math._hermite import hermite

_UNNAMED = "unnamed"


@dataclass(frozen=True)
class MocapClip:
    """Describes one trial of one person.

    Args:
        joints: [T, 15, 3] of `torchpose.body.BODY_15`, metres, axes of the room (right-handed); NaN
            where the file has none.
        recorded: [T, J, 3], every joint of the file, the same axes. names: their J names.
        up: [3], the unit vector that points up.
        fps: frames per second. person, action: from the file. trial: name of the file.
        person_id: the person, told apart from others of the same name (`Recording.person_id`).
    """

    joints: Tensor
    recorded: Tensor
    names: tuple[str, ...]
    up: Tensor
    fps: float
    person: str = _UNNAMED
    action: str = ""
    trial: str = ""
    person_id: str = ""

    def __len__(self) -> int:
        return len(self.joints)

    def cut(self, start: int, stop: int) -> "MocapClip":
        """Return the frames from `start` to before `stop`."""
        rows = slice(start, stop)
        return replace(self, joints=self.joints[rows], recorded=self.recorded[rows])


def read_mocap(
    paths: str | Path | Iterable[str | Path],
    fps: float | None = 60.0,
    actions: Sequence[str] = (),
    axes: str | None = None,
) -> list[MocapClip]:
    """Read files and folders of 3D joints as clips of one rate.

    Whatever `torchpose.io.read_recording` reads, among them the common ``.npz`` with the
    15 joints of HumanEva, the 16 of Berkeley MHAD, the 31 and 23 of CMU and the 21 of Pose2Sim.

    Args:
        paths: files or folders. fps: rate to resample to; None keeps that of each file.
        actions: only these, if any are given. axes: the axes of the files, if they are not what they say.

    Returns:
        Clips in the order of the files.

    Raises:
        InputError: no recording, none of these actions, or a file without a frame rate.
        SkeletonError: joints of which no body can be made.
    """
    recordings = read_recordings(paths, axes)
    known = sorted({r.action for r in recordings})
    wanted = [r for r in recordings if not actions or r.action in actions]
    if not wanted:
        raise InputError(
            f"{paths}: expected recordings of {', '.join(actions)}; there are {', '.join(known)}"
        )
    return [_clip(recording, fps) for recording in wanted]


def resample_frames(
    points: Float[Tensor, "T *rest"], fps: float, target: float
) -> Float[Tensor, "S *rest"]:
    """Return the points at another rate: every n-th frame where that is enough, else cubic Hermite pieces.

        p(s) = h00 p_k + h10 m_k + h01 p_(k+1) + h11 m_(k+1),   m_k = (p_(k+1) - p_(k-1)) / 2

    Args:
        points: [T, ...], at `fps`; NaN spreads to the frames that are made of it.
        target: the new rate.

    Returns:
        [S, ...], from the first frame on, as many as lie within the sequence.

    >>> resample_frames(torch.arange(9.0), 120.0, 60.0)
    tensor([0., 2., 4., 6., 8.])
    """
    if not (fps > 0 and target > 0):
        raise InputError(f"frame rates must be positive, got {fps:g} and {target:g}")
    ratio = fps / target
    if abs(ratio - round(ratio)) < 1e-6 and round(ratio) >= 1:
        return points[:: round(ratio)]
    count = int((len(points) - 1) / ratio + 1e-6) + 1
    place = torch.arange(count, dtype=points.dtype, device=points.device) * ratio
    k = place.long().clamp_max(max(len(points) - 2, 0))
    s = (place - k).reshape(-1, *[1] * (points.ndim - 1))
    padded = torch.cat([_before(points), points, _before(points.flip(0))])
    slope = (padded[2:] - padded[:-2]) / 2
    after = (k + 1).clamp_max(len(points) - 1)
    return hermite(s, (points[k], points[after]), (slope[k], slope[after]))


def _before(points: Float[Tensor, "T *rest"]) -> Float[Tensor, "1 *rest"]:
    """Return the frame before the first, on the parabola through the first three."""
    if len(points) < 3:
        return 2 * points[:1] - points[1:2] if len(points) > 1 else points[:1]
    return 3 * points[:1] - 3 * points[1:2] + points[2:3]


def _clip(recording: Recording, fps: float | None) -> MocapClip:
    if recording.fps is None and fps is not None:
        raise InputError(
            f"{recording.path}: the file states no frame rate, and {fps:g} per second are asked "
            "for; add `fps` to the file"
        )
    rate = float(recording.fps or 0.0) if fps is None else fps
    recorded = recording.joints.double() @ recording.rotation  # back to the axes of the file
    if fps is not None and recording.fps is not None:
        recorded = resample_frames(recorded, recording.fps, fps)
    down = recording.rotation[1]  # y of camera axes, in those of the file
    words = recording.person.split()
    return MocapClip(
        body_joints(recorded, recording.names), recorded, recording.names, -down, rate,
        words[0] if words else _UNNAMED, recording.action,
        recording.path.stem if recording.path is not None else "", recording.person_id,
    )  # fmt: skip
