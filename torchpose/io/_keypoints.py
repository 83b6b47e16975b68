"""Read and write 2D keypoints of one person: .npz, .csv, and folders of OpenPose JSON.

Pixels, u to the right and v down. A keypoint that was not measured is NaN, or has a confidence
of 0 or NaN.
"""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from torchpose._core.checks import (
    CONFIDENCE_ADVICE,
    MOST_CONFIDENCE,
    check_pixels,
    check_shape,
    check_tensors,
)
from torchpose._core.files import atomic_path, write_npz
from torchpose._core.reading import reading, require_file
from torchpose._core.wording import counted
from torchpose.camera._projection import check_intrinsics
from torchpose.errors import (
    CameraError,
    FileFormatError,
    InputError,
    NobodySeenError,
)
from torchpose.io._formats.keypoint_files import (
    RawKeypoints,
    read_csv_keypoints,
    read_npz_keypoints,
)
from torchpose.io._formats.openpose import read_openpose
from torchpose.io._formats.raw_recording import check_names, checked_rate
from torchpose.skeleton._joint_sets import identify_skeleton
from torchpose.skeleton._mediapipe_landmarks import derive_joints, lacks_joints
from torchpose.skeleton._upper_body import NECK_KINDS, neck_of_detectors

_LARGEST_IMAGE = 100_000  # pixels of a side
_FAR = 1e9  # pixels; no keypoint is there
_BORDER = 0.5  # pixels from the middle of the last pixel to the edge of the image
_MOST = 0.8  # share of coordinates that lie between 0 and 1 if they are shares of the image


@dataclass
class Keypoints:
    """Holds a sequence of 2D keypoints of one person.

    Args:
        keypoints: [T, J, 2] float64, pixels, NaN where missing.
        names: J names as the file spells them.
        confidence: [T, J], 0 where missing, or None.
        fps: frames per second, None if unknown.
        K: camera matrix [3, 3], pixels, or None.
        image_size: (width, height), pixels, or None.
        neck: kind of neck if the joint set or the file tells, see `torchpose.skeleton`.
        path: the file or folder.
        notes: sentences on conversions of the file's keypoints.
        n_people: how many people are in each frame [T], of whom one is followed; None if the file holds one.
        first_frame: the number that the file gives to the first frame; None if it numbers none.
        first_time: seconds, the time stamp of the first frame, of tables in which times number the frames.
    """

    keypoints: Tensor
    names: tuple[str, ...]
    confidence: Tensor | None = None
    fps: float | None = None
    K: Tensor | None = None
    image_size: tuple[int, int] | None = None
    neck: str | None = None
    path: Path | None = None
    notes: tuple[str, ...] = ()
    n_people: Tensor | None = None
    first_frame: int | None = None
    first_time: float | None = None

    def __len__(self) -> int:
        return len(self.keypoints)

    @property
    def measured(self) -> Tensor:
        """Return [T, J] bool, True where there is a measurement."""
        return torch.isfinite(self.keypoints).all(-1)


def said_of_crowd(n_people: Tensor | None, points: Tensor) -> str:
    """Return a phrase about several people in the frames, of whom one is followed; empty without.

    Args:
        n_people: how many are in each frame [T], None if one is. points: of the followed person
            [T, J, 2], pixels.
    """
    several = torch.zeros(0) if n_people is None else (n_people > 1).nonzero()
    if n_people is None or not len(several):
        return ""
    seen = points.isfinite().all(-1)
    first = int(seen.any(-1).int().argmax())
    u, v = points[first][seen[first]].mean(0).tolist()
    missing = int((~seen.any(-1) & (n_people > 0)).sum())
    return (
        f"several people, up to {int(n_people.max())}, from frame {int(several[0])} on; one of them is "
        f"tracked, about pixel ({u:.0f}, {v:.0f}) in frame {first}"
        + f", who is missing in {counted(missing, 'frame that shows', 'frames that show')} others"
        * bool(missing)
    )


def read_keypoints(path: str | Path, image_size: tuple[int, int] | None = None) -> Keypoints:
    """Read 2D keypoints of one person.

    ``.npz``: `keypoints` [T, J, 2] and `names` [J]; optionally `confidence` [T, J], `fps`, `K`
    [3, 3], `image_size` (width, height) and `neck` (its kind). `joints2d` may stand for `keypoints`. To
    MediaPipe's landmarks head, neck and hands are appended as priors have them
    (`torchpose.skeleton._mediapipe_landmarks`).

    ``.csv``: a header ``frame,NAME_x,NAME_y[,NAME_confidence],...`` and a row per frame, or the
    long form ``frame,name,x,y[,confidence]`` with a row per keypoint. Empty cells and absent frames
    are missing. Lines ``# fps = 30`` and ``# image_size = 640,480`` may stand above the header.

    In both, `visibility` is the confidence where there is none. A column of times gives the rate where no
    line states it. Cells may be separated by semicolons or tabs. Columns of z are passed over,
    and a note says so. Frames, names and scores may be called otherwise, as MediaPipe's scripts do.

    Keypoints that are shares of the image, from 0 to 1, are multiplied by its size where this is known.

    A folder: OpenPose's ``*_keypoints.json``, or those of Pose2Sim, one per frame, of BODY_25, BODY_25B,
    COCO, Halpe, MediaPipe or COCO-WholeBody. Of several people, the most confident one is followed; see
    `torchpose.io._formats.openpose`.

    Args:
        path: file or folder.
        image_size: (width, height) of the images, pixels, where the file does not state it; it counts for
            keypoints that are shares of the image alone.

    Returns:
        `Keypoints` with [T, J, 2] in pixels, u to the right and v down.

    Raises:
        InputError: no such file. NobodySeenError: an empty sequence, nothing measured in any frame.
        FileFormatError: truncated, another kind of file, missing keys, wrong shapes, infinite
            values; the line is named where there are lines. SkeletonError: unknown joint names.
        CameraError: a `K` that is no camera matrix.
    """
    path = Path(path)
    with reading(path, "keypoints"):
        return _finish(path, _read(path), image_size)


def _read(path: Path) -> RawKeypoints:
    if os.path.isdir(path):
        found = read_openpose(path)
        return RawKeypoints(
            found.keypoints,
            found.names,
            found.confidence,
            n_people=found.n_people,
            first_frame=found.first,
            notes=found.notes,
        )
    path = require_file(path)
    readers = {".npz": read_npz_keypoints, ".csv": read_csv_keypoints}
    if path.suffix.lower() not in readers:
        raise FileFormatError(
            f"{path}: expected keypoints as .npz, .csv or a folder of OpenPose JSON files, got "
            f"{path.suffix or 'no suffix'}; write those of other programs as a .csv with the columns "
            "frame,name,x,y,confidence, or an .npz (docs/file-formats.md, Other programs)"
        )
    return readers[path.suffix.lower()](path)


def write_keypoints(path: str | Path, keypoints: Keypoints) -> None:
    """Write keypoints as ``.npz`` or ``.csv`` (by suffix), in the form that `read_keypoints` reads.

    A ``.csv`` cannot hold the camera matrix.

    Args:
        path: the file, which is replaced; ends in .npz or .csv.
        keypoints: the keypoints of one person.

    Raises:
        InputError: another suffix, or arrays in place of tensors. ShapeError: other than a point, and a
            confidence, for each name. OutputError: the file cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    points, confidence = keypoints.keypoints, keypoints.confidence
    check_tensors(keypoints=points, confidence=confidence, K=keypoints.K)
    check_shape("keypoints", points, ["T", len(keypoints.names), 2])
    if confidence is not None:
        check_shape("confidence", confidence, list(points.shape[:2]))
    if suffix == ".npz":
        _write_npz(path, keypoints)
    elif suffix == ".csv":
        with atomic_path(path) as temporary:
            temporary.write_text(_to_csv(keypoints), encoding="utf-8")
    else:
        raise InputError(f"{path}: expected a name that ends in .npz or .csv")


def _write_npz(path: Path, data: Keypoints) -> None:
    arrays = {"keypoints": data.keypoints.numpy(force=True), "names": np.array(data.names)}
    for key, value in (("confidence", data.confidence), ("K", data.K)):
        if value is not None:
            arrays[key] = value.numpy(force=True)
    for key in ("fps", "image_size", "neck"):
        if getattr(data, key) is not None:
            arrays[key] = np.asarray(getattr(data, key))
    write_npz(path, arrays)


def _to_csv(data: Keypoints) -> str:
    lines = []
    if data.fps is not None:
        lines.append(f"# fps = {data.fps!r}")
    if data.image_size is not None:
        lines.append(f"# image_size = {data.image_size[0]},{data.image_size[1]}")
    kinds = ("x", "y") if data.confidence is None else ("x", "y", "confidence")
    lines.append(",".join(["frame", *(f"{n}_{k}" for n in data.names for k in kinds)]))
    values = data.keypoints
    if data.confidence is not None:
        values = torch.cat([values, data.confidence.to(values)[..., None]], -1)
    for frame, row in enumerate(values.flatten(1).tolist()):
        lines.append(",".join([str(frame), *("" if math.isnan(v) else repr(v) for v in row)]))
    return "\n".join(lines) + "\n"


# --- checks ---------------------------------------------------------------------------------------


def _finish(path: Path, raw: RawKeypoints, image_size: tuple[int, int] | None) -> Keypoints:
    points, names = raw.keypoints, raw.names
    _check_points(path, points, names)
    filled = is_filled(points)
    missing = np.isnan(points).any(-1) | filled
    if raw.confidence is not None:
        confidence = _check_confidence(path, raw.confidence, points.shape[:2])
        filled &= confidence > 0
        missing |= confidence == 0
        confidence = np.where(missing, 0.0, confidence)
    if missing.all():
        raise NobodySeenError(
            f"{path}: no keypoint is measured in any of {counted(len(points), 'frame')}"
        )
    size = _check_size(path, raw.image_size)
    points, scaled = in_pixels(path, points, missing, size or image_size)
    notes = (*raw.notes, *scaled, *_note_of_filled(int(filled.sum())))
    fps, neck = checked_rate(path, raw.fps), _neck_of(path, raw)
    keypoints = Keypoints(
        torch.from_numpy(np.where(missing[..., None], np.nan, points)), names,
        None if raw.confidence is None else torch.from_numpy(confidence), fps,
        _check_matrix(path, raw.K), size, neck, path,
        notes=notes,
        n_people=None if raw.n_people is None else torch.from_numpy(raw.n_people),
        first_frame=raw.first_frame,
        first_time=raw.first_time,
    )  # fmt: skip
    return _with_joints(keypoints) if lacks_joints(names) else keypoints


def _check_points(path: Path, points: np.ndarray, names: Sequence[str]) -> None:
    if points.ndim != 3 or points.shape[1:] != (len(names), 2):
        raise FileFormatError(
            f"{path}: keypoints must have shape [T, {len(names)}, 2] for {len(names)} names, got "
            f"{list(points.shape)}; a confidence goes into an array of its own"
        )
    if len(points) == 0:
        raise NobodySeenError(f"{path}: the sequence is empty; expected one frame or more")
    far = np.abs(points) > _FAR
    if far.any():
        frame = int(np.argwhere(far)[0, 0])
        raise FileFormatError(
            f"{path}: keypoints must not be infinite or beyond {_FAR:g} pixels, frame {frame}; use NaN"
        )
    check_names(path, names)


def _neck_of(path: Path, raw: RawKeypoints) -> str | None:
    """Return the kind of neck that a file states, or that its names have."""
    if raw.neck is not None and raw.neck not in NECK_KINDS:
        raise FileFormatError(
            f"{path}: neck must be one of {', '.join(NECK_KINDS)}, got {raw.neck!r}"
        )
    skeleton = identify_skeleton(raw.names)
    return raw.neck or (neck_of_detectors(raw.names) if skeleton is None else skeleton.neck)


def _with_joints(data: Keypoints) -> Keypoints:
    """Return MediaPipe's landmarks with head, neck and hands appended."""
    points, confidence, names = derive_joints(data.keypoints, data.confidence, data.names)
    if confidence is not None:
        confidence = torch.where(torch.isfinite(points).all(-1), confidence, 0.0)
    note = (
        "head, neck and hands are put where the prior's are, from MediaPipe's ears, shoulders, "
        "wrists and index fingers"
    )
    notes = (*data.notes, note)
    return replace(
        data, keypoints=points, confidence=confidence, names=names, neck="neck", notes=notes
    )


_Points = TypeVar("_Points", np.ndarray, Tensor)


def is_filled(points: _Points) -> _Points:
    """Return which keypoints [..., 2] are (0, 0) or (-1, -1), as detectors write where nothing was found."""
    return (points == 0).all(-1) | (points == -1).all(-1)


def is_on_border(points: Tensor, size: Tensor) -> Tensor:
    """Return which keypoints [..., 2] are on the border of the image, onto which detectors clip those beyond.

    Args:
        points: pixels. size: width and height [..., 2], infinite if they are not known.
    """
    last = (points - (size - _BORDER)).abs() <= _BORDER  # clipped to the last pixel, or to the size
    return ((points == 0) | last).any(-1)


def in_pixels(
    path: Path, points: np.ndarray, missing: np.ndarray, size: tuple[int, int] | None
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return keypoints [..., 2] in pixels: shares of an image of known size are multiplied by it.

    Args:
        path: of the file, for messages. points: the keypoints. missing: which are none [...].
        size: (width, height) of the images, None if it is not known.

    Raises:
        FileFormatError: they are no pixels, and the size is not known or they are no shares either.
    """
    try:
        check_pixels("keypoints", torch.from_numpy(points), torch.from_numpy(~missing))
    except InputError as error:
        known = points[~missing]
        if size is None or ((known >= 0) & (known <= 1)).mean() < _MOST:
            raise FileFormatError(f"{path}: {error}") from error
    else:
        return points, ()
    note = (
        f"keypoints between 0 and 1 are multiplied by the {size[0]} x {size[1]} pixels of the image"
    )
    return points * np.array(size), (note,)


def _note_of_filled(count: int) -> tuple[str, ...]:
    return (
        f"{counted(count, 'keypoint')} at exactly (0, 0) or (-1, -1) count{'s' * (count == 1)} as missing",
    ) * (count > 0)


def _check_confidence(path: Path, confidence: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if confidence.shape != shape:
        raise FileFormatError(
            f"{path}: confidence must have shape {list(shape)}, got {list(confidence.shape)}"
        )
    confidence = np.nan_to_num(confidence, nan=0.0, posinf=math.inf, neginf=-math.inf)
    if (confidence < 0).any() or np.isinf(confidence).any():
        bad = confidence[(confidence < 0) | np.isinf(confidence)][0]
        raise FileFormatError(
            f"{path}: confidences must be finite and at least 0, got {bad:g}; {CONFIDENCE_ADVICE}"
        )
    if confidence.max(initial=0.0) > MOST_CONFIDENCE:
        raise FileFormatError(
            f"{path}: confidences must lie in [0, 1], got {confidence.max():g}; {CONFIDENCE_ADVICE}"
        )
    return confidence.clip(max=1.0)


def _check_matrix(path: Path, matrix: np.ndarray | None) -> Tensor | None:
    if matrix is None:
        return None
    K = torch.from_numpy(np.ascontiguousarray(matrix))
    try:
        check_intrinsics("K", K)
        if K.ndim != 2:
            raise CameraError(f"K must have shape [3, 3], got {list(K.shape)}")
    except CameraError as error:
        raise CameraError(f"{path}: {error}") from error
    return K


def _check_size(path: Path, size: np.ndarray | Sequence[float] | None) -> tuple[int, int] | None:
    if size is None:
        return None
    values = np.asarray(size, dtype=np.float64).ravel()
    if values.size != 2 or not ((values >= 1) & (values <= _LARGEST_IMAGE)).all():
        raise FileFormatError(f"{path}: image_size must be (width, height), got {values.tolist()}")
    return int(values[0]), int(values[1])
