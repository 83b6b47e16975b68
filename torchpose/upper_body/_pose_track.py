"""Hold the result of tracking, poses with covariances, and read and write its file."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from torchpose._core.estimates import check_estimates, check_number_range, frame_facts, to_tensor
from torchpose._core.files import write_npz
from torchpose._core.reading import check_arrays, one_text, read_npz, texts
from torchpose.camera._projection import check_intrinsics
from torchpose.camera._tilt import unit_up
from torchpose.errors import CameraError, FileFormatError
from torchpose.skeleton._joint_sets import UPPER_BODY

BONE_NAMES = ("upper_arm", "forearm_to_hand", "shoulder_width", "head_height")
"""Lengths of bones in the order of `PoseTrack.bone_lengths`, unless it has forearms to the wrist."""

FRAME_FIELDS = (
    "joints2d",
    "joints3d",
    "covariance2d",
    "covariance3d",
    "observed",
    "log_evidence",
    "effective_sample_size",
    "inlier_probability",
    "bone_lengths",
    "bone_covariance",
)
"""What a `PoseTrack` holds for every frame."""

# Files of older releases have none of these.
_ADDED = ("effective_sample_size", "inlier_probability", "bone_lengths", "bone_covariance", "up")
_OF_CAMERA = ("K", "up")
# Kinds and sizes in a file, of several sequences behind that of the batch.
_FIELDS = {
    "joints2d": ("f", "T 8 2"),
    "joints3d": ("f", "T 8 3"),
    "covariance2d": ("f", "T 8 2 2"),
    "covariance3d": ("f", "T 8 3 3"),
    "observed": ("b", "T 8"),
    "log_evidence_arms": ("f", "T 2"),
    "effective_sample_size": ("f", "T 2"),
    "inlier_probability": ("f", "T 8"),
    "bone_lengths": ("f", "T 4"),
    "bone_covariance": ("f", "T 4 4"),
    "lengths": ("i", ""),
    "failed_at": ("i", ""),
    "K": ("f", "3 3"),
    "up": ("f", "3"),
}


@dataclass
class PoseTrack:
    """Holds the upper-body poses of B sequences of T frames; J = 8 joints in the order of `UPPER_BODY`.

    Past the length of a sequence its last pose is repeated.

    Attributes:
        joints2d: [B, T, 8, 2], the joints in the image, pixels of the input's camera. They are expected
            there; where bones of constant length do not reach, `joints3d` project elsewhere.
        joints3d: [B, T, 8, 3], the joints in space, metres, in the axes of `frame`.
        covariance2d: [B, T, 8, 2, 2], their covariances, pixels squared.
        covariance3d: [B, T, 8, 3, 3], their covariances, metres squared, in the same axes and relative to
            the body. How far it is from the camera is much less certain, and is not in them.
        observed: [B, T, 8], True where the joint was measured, False where it was inferred because no
            keypoint was given or it was an outlier.
        log_evidence: [B, T, 2], the increments log p(z_t | z_1:t-1) of the left and of the right arm.
            Both arms contain head and neck, so their sum is a score and not an evidence. With smoothing
            over all frames, keypoints that were put into gaps may count as measured.
        lengths: [B], the number of frames of each sequence.
        matrix: the camera matrix K [3, 3] of the input.
        failed_at: [B], the first frame that is NaN because the filter degenerated, -1 if none.
        names: the names of the joints. fps: the number of frames per second, or None.
        frame: the axes of the joints: "camera" (x right, y down, z forward), or "body" for those of the
            prior's recordings.
        up: [3], the direction that points up in the axes of the camera, of length one; None where it is not
            known, and the camera was taken to be about level.
        notes: the assumptions about camera, neck and hands, and whether covariances had to be mended,
            in plain words.
        first_frame: the frame of the video or recording that the first pose belongs to.
        method: the name of the estimator that ran, one of `torchpose.upper_body.METHODS`; "unknown" in
            files of older releases.
        effective_sample_size: [B, T, 2], 1 / sum_j w_j^2 (BL 25) of the particles or tracks of the left
            and of the right arm; NaN in files of older releases. If one particle has all the weight, the
            estimate is not to be trusted; if one track has it, the filter is sure of a component.
        inlier_probability: [B, T, 8], the probability that the keypoint of a joint is no outlier; below
            1/2 it was treated as missing. NaN where no keypoint was given or screened, and in files of
            older releases.
        bone_lengths: [B, T, 4], the lengths of bones as estimated before each frame, metres, in the order
            of `bone_names`; NaN for methods that learn none and in files of older releases. One camera
            does not distinguish a large body from a near one, so their common scale is that of the prior
            or of lengths that were given.
        bone_covariance: [B, T, 4, 4], the covariance of these lengths, metres squared; most of it is the
            uncertainty of their common scale.
        bone_names: the names of these bones: upper_arm, forearm (to the wrist) or forearm_to_hand,
            shoulder_width and head_height (above Kinect's neck).
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
    effective_sample_size: Tensor = field(default_factory=lambda: torch.empty(0))
    inlier_probability: Tensor = field(default_factory=lambda: torch.empty(0))
    bone_lengths: Tensor = field(default_factory=lambda: torch.empty(0))
    bone_covariance: Tensor = field(default_factory=lambda: torch.empty(0))
    bone_names: tuple[str, ...] = BONE_NAMES
    up: Tensor | None = None

    def __post_init__(self) -> None:
        if self.effective_sample_size.numel() == 0:
            self.effective_sample_size = torch.full_like(self.log_evidence, torch.nan)
        if self.inlier_probability.numel() == 0:
            self.inlier_probability = torch.full_like(self.joints2d[..., 0], torch.nan)
        if self.bone_lengths.numel() == 0:
            self.bone_lengths = torch.full_like(self.joints3d[..., :4, 0], torch.nan)
        if self.bone_covariance.numel() == 0:
            lengths = self.bone_lengths
            self.bone_covariance = lengths.new_full((*lengths.shape, lengths.shape[-1]), torch.nan)

    def __len__(self) -> int:
        return self.joints3d.shape[0]

    @property
    def failed(self) -> Tensor:
        """Return whether the filter degenerated, [B], as `LivePose.failed`."""
        return self.failed_at >= 0

    def sequence(self, index: int) -> "PoseTrack":
        """Return one sequence, cut to its own length, as a batch of one.

        Args:
            index: the index of the sequence; -1 is the last.

        Returns:
            Track with B = 1 and T = `lengths[index]`.
        """
        n = int(self.lengths[index])
        rows = slice(index, index + 1) if index != -1 else slice(-1, None)
        cut: dict[str, Any] = {name: getattr(self, name)[rows, :n] for name in FRAME_FIELDS}
        cut |= {name: getattr(self, name)[rows] for name in ("lengths", "failed_at")}
        return replace(self, **cut)

    def in_precision(self, dtype: torch.dtype) -> Self:
        """Return the same poses with floating-point numbers of a dtype.

        Args:
            dtype: the floating-point type, such as torch.float32.

        Returns:
            Track with the same shapes; this one if it has the dtype.
        """
        if self.joints3d.dtype == dtype:
            return self
        fields = {name: getattr(self, name) for name in FRAME_FIELDS}
        narrowed = {n: v.to(dtype) for n, v in fields.items() if v.is_floating_point()}
        return replace(self, **narrowed)

    def save(self, path: str | Path) -> None:
        """Write an .npz: one sequence without its batch dimension, several with it.

        `log_evidence` in the file is the score, the sum over both arms; `log_evidence_arms` has them
        apart. Keys: joints2d, joints3d, covariance2d, covariance3d, observed, log_evidence,
        log_evidence_arms, effective_sample_size, inlier_probability, bone_lengths, bone_covariance,
        bone_names, names, fps (NaN if unknown), K, frame, failed_at, lengths, notes, first_frame, method;
        up if it is known.

        Args:
            path: the .npz file, which is replaced if there is one.

        Raises:
            OutputError: the file cannot be written.
        """
        single = len(self) == 1

        def array(value: Tensor) -> np.ndarray:
            value = value.detach().cpu()
            return (value[0] if single else value).numpy()

        arrays: dict[str, Any] = {
            name: array(getattr(self, name)) for name in (*FRAME_FIELDS, "failed_at", "lengths")
        }
        arrays["log_evidence"] = array(self.log_evidence.sum(-1))
        arrays["log_evidence_arms"] = array(self.log_evidence)
        arrays["names"] = np.array(self.names)
        arrays["fps"] = np.array(np.nan if self.fps is None else self.fps)
        arrays["K"] = self.matrix.detach().cpu().numpy()
        if self.up is not None:
            arrays["up"] = self.up.detach().cpu().numpy()
        arrays["frame"] = np.array(self.frame)
        arrays["notes"] = np.array(self.notes, dtype=str)
        arrays["first_frame"] = np.array(self.first_frame)
        arrays["method"] = np.array(self.method)
        arrays["bone_names"] = np.array(self.bone_names)
        write_npz(path, arrays)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what `save` wrote.

        Args:
            path: .npz file.

        Returns:
            Track with a batch dimension, of one sequence or several.

        Raises:
            InputError: no such file. FileFormatError: truncated, not poses, or fields that do not
                agree: other shapes or types, joints without a covariance, values out of range.
            CameraError: K is no camera matrix.
        """
        always = [key for key in _FIELDS if key not in _ADDED]
        required = (*always, "names", "frame", "fps", "notes")
        arrays = read_npz(path, required, ("first_frame", "method", "bone_names", *_ADDED))
        fields = {key: size for key, size in _FIELDS.items() if key in arrays}
        single = arrays["joints3d"].ndim == 3
        batch = "" if single else "B "
        sizes = check_arrays(
            path,
            arrays,
            {
                k: f"{kind} {batch * (k not in _OF_CAMERA)}{size}"
                for k, (kind, size) in fields.items()
            },
        )
        if not all(sizes.values()):
            raise FileFormatError(f"{path}: expected poses of one frame or more, got none")
        tensors: dict[str, Any] = {key: to_tensor(arrays[key]) for key in fields}
        tensors = {k: v[None] if single and k not in _OF_CAMERA else v for k, v in tensors.items()}
        tensors["log_evidence"] = tensors.pop("log_evidence_arms")
        tensors["matrix"] = tensors.pop("K")
        names = texts(path, "names", arrays["names"])
        if names != UPPER_BODY:
            raise FileFormatError(
                f"{path}: expected the joints {', '.join(UPPER_BODY)}, got {', '.join(names)}"
            )
        track = cls(
            **tensors, names=names, frame=one_text(path, "frame", arrays["frame"]),
            method=one_text(path, "method", arrays.get("method", np.array("unknown"))),
            bone_names=texts(path, "bone_names", arrays.get("bone_names", np.array(BONE_NAMES))),
            **frame_facts(path, arrays),
        )  # fmt: skip
        track._check(path)
        return track

    def _check(self, path: str | Path) -> None:
        """Raise unless the values agree with one another; the types and shapes do."""
        if self.frame not in ("camera", "body"):
            raise FileFormatError(
                f"{path}: frame must be 'camera' or 'body', got {self.frame!r:.60}"
            )
        try:
            check_intrinsics("K", self.matrix)
        except CameraError as error:
            raise CameraError(f"{path}: {error}") from error
        if self.up is not None:
            self.up = unit_up(f"{path}: up", self.up)
        n_frames = self.joints3d.shape[1]
        check_number_range(path, "lengths", self.lengths, 1, n_frames)
        check_number_range(path, "failed_at", self.failed_at, -1, n_frames - 1)
        check_estimates(path, "joints2d", self.joints2d, self.covariance2d)
        check_estimates(path, "joints3d", self.joints3d, self.covariance3d)
        outside = (self.inlier_probability < 0) | (self.inlier_probability > 1)
        if bool(outside.any()):
            raise FileFormatError(f"{path}: expected inlier_probability between 0 and 1, or NaN")
        self._check_bones(path)
        failed = torch.nonzero(self.failed_at >= 0).reshape(-1)
        whole = self.joints3d[failed, self.failed_at[failed]].isfinite().flatten(1).all(-1)
        if bool(whole.any()) or bool(self.log_evidence.isposinf().any()):
            raise FileFormatError(
                f"{path}: expected NaN in the frame of failed_at and no infinite log_evidence_arms"
            )

    def _check_bones(self, path: str | Path) -> None:
        """Raise unless the lengths of bones are lengths, or unknown."""
        if len(self.bone_names) != len(BONE_NAMES):
            raise FileFormatError(
                f"{path}: expected {len(BONE_NAMES)} bone_names, got {', '.join(self.bone_names):.80}"
            )
        if bool((self.bone_lengths <= 0).any() or self.bone_lengths.isinf().any()):
            raise FileFormatError(f"{path}: expected positive bone_lengths, or NaN")
        check_estimates(path, "bone_lengths", self.bone_lengths, self.bone_covariance)
