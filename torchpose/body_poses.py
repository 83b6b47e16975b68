"""The poses of a tracked whole body, with their uncertainty, and their file."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from torchpose.body.kinematics import Body
from torchpose.body.skeleton import BODY_15
from torchpose.camera import PinholeCamera
from torchpose.errors import FileFormatError, SkeletonError
from torchpose.io.files import read_npz, write_npz

__all__ = ["BodyPoses", "load_body"]

_FRAMES = (
    "state",
    "state_std",
    "joints3d",
    "covariance3d",
    "log_evidence",
    "effective_sample_size",
    "coasting",
    "respread",
)
_DETAIL = "detail_"  # of the keys of what only some filters report
_BODY = ("bone_lengths", "offsets", "tips", "radii", "centres")


@dataclass
class BodyPoses:
    """Poses of one person in T frames; J joints and states of D numbers, as their body has.

    Attributes:
        body: whose states they are.
        state: [T, D], the estimates. state_std: [T, D], in the units of a step (`Body.difference`).
        joints3d: [T, J, 3], joints of the estimates, metres, world axes.
        covariance3d: [T, J, 3, 3], second moment of the particles' joints about them, metres squared;
            with the Gaussians within particles, of a filter that has them.
        log_evidence, effective_sample_size: [T]. coasting: [T], True where no camera saw the person.
        respread: [T], True where all particles had died and were spread about the last estimate.
        fps: frames per second, or None. notes: what was assumed, in plain words.
        first_frame: of the videos, that of the first pose.
        details: what only some filters report, by name, [T, ...] each (`BodyTrack.details`): of
            `ConstrainedParticleFilter` "acceptance", "clamped", "actions" and so on.
        action_names: of the columns of ``details["actions"]``.
    """

    body: Body
    state: Tensor
    state_std: Tensor
    joints3d: Tensor
    covariance3d: Tensor
    log_evidence: Tensor
    effective_sample_size: Tensor
    coasting: Tensor
    respread: Tensor
    fps: float | None = None
    notes: tuple[str, ...] = field(default_factory=tuple)
    first_frame: int = 0
    details: dict[str, Tensor] = field(default_factory=dict)
    action_names: tuple[str, ...] = field(default_factory=tuple)

    def __len__(self) -> int:
        return len(self.state)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the joints."""
        return self.body.skeleton.names

    def save(self, path: str | Path) -> None:
        """Write an .npz: what holds for each frame, `names`, `fps` (NaN if unknown), `notes`,
        `first_frame`, `action_names`, details as `detail_acceptance` and so on, and the body as
        `body_bone_lengths`, `body_radii` and so on.

        Raises:
            OutputError: the file cannot be written.
        """
        arrays: dict[str, Any] = {
            name: getattr(self, name).detach().cpu().numpy() for name in _FRAMES
        }
        arrays |= {f"body_{n}": getattr(self.body, n).detach().cpu().numpy() for n in _BODY}
        for name, value in self.details.items():
            arrays[_DETAIL + name] = value.detach().cpu().numpy()
        arrays["action_names"] = np.array(self.action_names, dtype=str)
        arrays["body_skeleton"] = np.array(self.body.skeleton.name)
        arrays["body_frame"] = np.array(self.body.frame)
        arrays["names"] = np.array(self.names)
        arrays["fps"] = np.array(np.nan if self.fps is None else self.fps)
        arrays["notes"] = np.array(self.notes, dtype=str)
        arrays["first_frame"] = np.array(self.first_frame)
        write_npz(path, arrays)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what `save` wrote.

        Raises:
            InputError: no such file. FileFormatError: not such poses, or details of other frames.
            SkeletonError: another skeleton.
        """
        arrays = read_npz(path, (*_FRAMES, "fps", "notes", "first_frame"))
        details = {
            key.removeprefix(_DETAIL): torch.from_numpy(value)
            for key, value in arrays.items()
            if key.startswith(_DETAIL)
        }
        for name, value in details.items():
            if value.ndim < 1 or len(value) != len(arrays["state"]):
                raise FileFormatError(
                    f"{path}: expected {_DETAIL}{name} of {len(arrays['state'])} frames, got the "
                    f"sizes {list(value.shape)}"
                )
        fps = float(arrays["fps"])
        return cls(
            load_body(path),
            **{name: torch.from_numpy(arrays[name]) for name in _FRAMES},
            fps=None if np.isnan(fps) else fps,
            notes=tuple(str(n) for n in arrays["notes"]),
            first_frame=int(arrays["first_frame"]),
            details=details,
            action_names=tuple(str(n) for n in arrays.get("action_names", ())),
        )

    def seen_by(self, camera: PinholeCamera) -> "CameraPoses":
        """The joints in a camera's axes, for `torchpose.report.write_report`."""
        R, t = (m.to(self.joints3d) for m in (camera.rotation_matrix, camera.translation))
        return CameraPoses(
            joints3d=(self.joints3d @ R.mT + t)[None],
            covariance3d=(R @ self.covariance3d @ R.mT)[None],
            observed=~self.coasting[None, :, None].expand(1, -1, len(self.names)),
            failed_at=torch.full((1,), -1),
            names=self.names,
            fps=self.fps,
        )


@dataclass
class CameraPoses:
    """Poses in the axes of a camera; see `torchpose.report.packing.ReportedTrack`."""

    joints3d: Tensor
    covariance3d: Tensor
    observed: Tensor
    failed_at: Tensor
    names: tuple[str, ...]
    fps: float | None
    frame: str = "camera"

    def __len__(self) -> int:
        return len(self.joints3d)


def load_body(path: str | Path) -> Body:
    """The body of poses that were saved: bone lengths, limbs and centres of a person.

    Raises:
        InputError: no such file. FileFormatError: not such poses. SkeletonError: another skeleton.
    """
    keys = tuple(f"body_{name}" for name in (*_BODY, "skeleton", "frame"))
    arrays = read_npz(path, keys, ())
    skeleton, frame = str(arrays["body_skeleton"]), str(arrays["body_frame"])
    if skeleton != BODY_15.name:
        raise SkeletonError(f"{path}: expected a body of {BODY_15.name!r}, got {skeleton!r}")
    if frame not in ("parent", "body"):
        raise FileFormatError(f"{path}: expected body_frame 'parent' or 'body', got {frame!r}")
    tensors = {name: torch.from_numpy(arrays[f"body_{name}"]) for name in _BODY}
    return Body(
        BODY_15,
        tensors["bone_lengths"],
        tensors["radii"],
        directions=torch.nn.functional.normalize(tensors["offsets"], dim=-1),
        centres=tensors["centres"],
        frame="parent" if frame == "parent" else "body",
        tips=tensors["tips"],
    )
