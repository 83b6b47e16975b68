"""The result of tracking: poses with covariances, and their file."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from torchpose.errors import FileFormatError
from torchpose.io.files import read_npz, write_npz
from torchpose.skeleton import UPPER_BODY

__all__ = ["FRAME_FIELDS", "PoseTrack"]

FRAME_FIELDS = (
    "joints2d",
    "joints3d",
    "covariance2d",
    "covariance3d",
    "observed",
    "log_evidence",
)
"""What a `PoseTrack` holds for every frame."""

_KEYS = ("joints2d", "joints3d", "covariance3d", "observed", "log_evidence", "names")


@dataclass
class PoseTrack:
    """Upper-body poses of B sequences of T frames; J = 8 joints in the order of `UPPER_BODY`.

    Past the length of a sequence its last pose is repeated.

    Attributes:
        joints2d: [B, T, 8, 2], pixels of the input's camera.
        joints3d: [B, T, 8, 3], metres, in `frame`.
        covariance2d: [B, T, 8, 2, 2], pixels squared. covariance3d: [B, T, 8, 3, 3], metres squared.
        observed: [B, T, 8], True where the joint was measured, False where it was inferred.
        log_evidence: increments log p(z_t | z_1:t-1) of the left and of the right arm, [B, T, 2].
            Both arms contain head and neck, so their sum is a score and not an evidence.
        names: of the joints. fps: frames per second, or None. lengths: [B].
        matrix: camera matrix K [3, 3] of the input.
        frame: "camera" (x right, y down, z forward) or "body" (that of the prior's recordings).
        failed_at: [B], the first frame that is NaN because the filter degenerated, -1 if none.
        notes: what was assumed about camera, neck and hands, in plain words.
        method: the estimator that ran, one of `torchpose.tracking.METHODS`; "unknown" in files of
            older releases.
        first_frame: of the video or recording, that of the first pose.
    """

    joints2d: Tensor
    joints3d: Tensor
    covariance2d: Tensor
    covariance3d: Tensor
    observed: Tensor
    log_evidence: Tensor
    lengths: Tensor
    matrix: Tensor
    failed_at: Tensor
    names: tuple[str, ...] = UPPER_BODY
    fps: float | None = None
    frame: str = "camera"
    notes: tuple[str, ...] = field(default_factory=tuple)
    first_frame: int = 0
    method: str = "unknown"

    def __len__(self) -> int:
        return self.joints3d.shape[0]

    def sequence(self, index: int) -> "PoseTrack":
        """One sequence, cut to its own length, as a batch of one."""
        n = int(self.lengths[index])
        rows = slice(index, index + 1) if index != -1 else slice(-1, None)
        cut: dict[str, Any] = {name: getattr(self, name)[rows, :n] for name in FRAME_FIELDS}
        cut |= {name: getattr(self, name)[rows] for name in ("lengths", "failed_at")}
        return replace(self, **cut)

    def in_precision(self, dtype: torch.dtype) -> Self:
        """Return the same poses with floating-point numbers of a dtype; this track if they are."""
        if self.joints3d.dtype == dtype:
            return self
        fields = {name: getattr(self, name) for name in FRAME_FIELDS}
        narrowed = {n: v.to(dtype) for n, v in fields.items() if v.is_floating_point()}
        return replace(self, **narrowed)

    def save(self, path: str | Path) -> None:
        """Write an .npz: one sequence without its batch dimension, several with it.

        `log_evidence` in the file is the score, the sum over both arms; `log_evidence_arms` has them
        apart. Keys: joints2d, joints3d, covariance2d, covariance3d, observed, log_evidence,
        log_evidence_arms, names, fps (NaN if unknown), K, frame, failed_at, lengths, notes,
        first_frame, method.

        Raises:
            OutputError: the file cannot be written.
        """
        single = len(self) == 1

        def array(value: Tensor) -> np.ndarray:
            value = value.detach().cpu()
            return (value[0] if single else value).numpy()

        arrays: dict[str, Any] = {
            name: array(getattr(self, name))
            for name in (
                "joints2d",
                "joints3d",
                "covariance2d",
                "covariance3d",
                "observed",
                "failed_at",
                "lengths",
            )
        }
        arrays["log_evidence"] = array(self.log_evidence.sum(-1))
        arrays["log_evidence_arms"] = array(self.log_evidence)
        arrays["names"] = np.array(self.names)
        arrays["fps"] = np.array(np.nan if self.fps is None else self.fps)
        arrays["K"] = self.matrix.detach().cpu().numpy()
        arrays["frame"] = np.array(self.frame)
        arrays["notes"] = np.array(self.notes, dtype=str)
        arrays["first_frame"] = np.array(self.first_frame)
        arrays["method"] = np.array(self.method)
        write_npz(path, arrays)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what `save` wrote.

        Raises:
            InputError: no such file. FileFormatError: truncated, or not poses.
        """
        extra = ("log_evidence_arms", "covariance2d", "K", "frame", "failed_at", "lengths")
        arrays = read_npz(path, (*_KEYS, *extra, "fps", "notes"))
        single = arrays["joints3d"].ndim == 3
        if arrays["joints3d"].ndim not in (3, 4) or arrays["joints3d"].shape[-1] != 3:
            raise FileFormatError(
                f"{path}: expected joints3d of shape [T, J, 3] or [B, T, J, 3], "
                f"got {list(arrays['joints3d'].shape)}"
            )

        def tensor(name: str) -> Tensor:
            value = torch.from_numpy(np.array(arrays[name]))
            return value[None] if single else value

        fps = float(arrays["fps"])
        return cls(
            joints2d=tensor("joints2d"),
            joints3d=tensor("joints3d"),
            covariance2d=tensor("covariance2d"),
            covariance3d=tensor("covariance3d"),
            observed=tensor("observed"),
            log_evidence=tensor("log_evidence_arms"),
            lengths=tensor("lengths"),
            matrix=torch.from_numpy(arrays["K"]),
            failed_at=tensor("failed_at"),
            names=tuple(str(n) for n in arrays["names"]),
            fps=None if np.isnan(fps) else fps,
            frame=str(arrays["frame"]),
            notes=tuple(str(n) for n in arrays["notes"]),
            # files of older releases have neither
            first_frame=int(arrays.get("first_frame", 0)),
            method=str(arrays.get("method", "unknown")),
        )
