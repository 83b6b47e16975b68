"""2D keypoints of one person: .npz, .csv, and folders of OpenPose JSON.

Pixels, u to the right and v down. A keypoint that was not measured is NaN; a confidence of 0 or NaN
says so too.
"""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchpose._core.files import atomic_path, write_npz
from torchpose._core.reading import (
    check_span,
    npz_keys,
    one_number,
    one_text,
    read_npz,
    read_text,
    reading,
    require_file,
    texts,
)
from torchpose.camera._projection import check_intrinsics
from torchpose.errors import CameraError, FileFormatError, InputError, SkeletonError, check_rate
from torchpose.io._formats.openpose import read_openpose
from torchpose.io._formats.raw_recording import numbers
from torchpose.skeleton._joint_sets import canonical_names, identify_skeleton
from torchpose.skeleton._mediapipe_landmarks import derive_joints, lacks_joints
from torchpose.skeleton._upper_body import NECK_KINDS

__all__ = ["Keypoints", "read_keypoints", "write_keypoints"]

_MAX_GAP = 100_000  # frames; a larger jump of the frame number is taken for a damaged file
_LARGEST_IMAGE = 100_000  # pixels of a side
_FAR = 1e9  # pixels; no keypoint is there


@dataclass
class Keypoints:
    """A sequence of 2D keypoints of one person.

    Args:
        keypoints: [T, J, 2] float64, pixels, NaN where missing.
        names: J names as the file spells them.
        confidence: [T, J], 0 where missing, or None.
        fps: frames per second, None if unknown.
        K: camera matrix [3, 3], pixels, or None.
        image_size: (width, height), pixels, or None.
        neck: kind of neck if the joint set or the file tells, see `torchpose.skeleton`.
        path: the file or folder.
        notes: what was made of the file's keypoints, in plain words.
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

    def __len__(self) -> int:
        return len(self.keypoints)

    @property
    def measured(self) -> Tensor:
        """[T, J] bool, True where there is a measurement."""
        return torch.isfinite(self.keypoints).all(-1)


@dataclass
class _Raw:
    """What a file holds, before the checks."""

    keypoints: np.ndarray
    names: tuple[str, ...]
    confidence: np.ndarray | None = None
    fps: float | None = None
    K: np.ndarray | None = None
    image_size: np.ndarray | Sequence[float] | None = None
    neck: str | None = None


def read_keypoints(path: str | Path) -> Keypoints:
    """Read 2D keypoints of one person.

    ``.npz``: `keypoints` [T, J, 2] and `names` [J]; optionally `confidence` [T, J], `fps`, `K`
    [3, 3], `image_size` (width, height) and `neck` (its kind). MediaPipe files with `joints2d` and
    `visibility` in their place are read alike, and head, neck and hands are appended to the landmarks
    as priors have them (`torchpose.skeleton._mediapipe_landmarks`).

    ``.csv``: a header ``frame,NAME_x,NAME_y[,NAME_confidence],...`` and a row per frame, or the
    long form ``frame,name,x,y[,confidence]`` with a row per keypoint. Empty cells and absent frames
    are missing. Lines ``# fps = 30`` and ``# image_size = 640,480`` may stand above the header.

    A folder: OpenPose's ``*_keypoints.json``, one per frame, BODY_25 or COCO 18. Of several people,
    the most confident one is followed; see `torchpose.io._formats.openpose`.

    Args:
        path: file or folder.

    Raises:
        InputError: no such file, an empty sequence, nothing measured in any frame.
        FileFormatError: truncated, another kind of file, missing keys, wrong shapes, infinite
            values; the line is named where there are lines. SkeletonError: unknown joint names.
        CameraError: a `K` that is no camera matrix.
    """
    path = Path(path)
    with reading(path, "keypoints"):
        return _finish(path, _read(path))


def _read(path: Path) -> _Raw:
    if os.path.isdir(path):
        points, confidence, names = read_openpose(path)
        return _Raw(points, names, confidence)
    path = require_file(path)
    readers = {".npz": _read_npz, ".csv": _read_csv}
    if path.suffix.lower() not in readers:
        raise FileFormatError(
            f"{path}: expected keypoints as .npz, .csv or a folder of OpenPose JSON files, got "
            f"{path.suffix or 'no suffix'}"
        )
    return readers[path.suffix.lower()](path)


def write_keypoints(path: str | Path, keypoints: Keypoints) -> None:
    """Write keypoints as ``.npz`` or ``.csv`` (by suffix), in the form that `read_keypoints` reads.

    A ``.csv`` cannot hold the camera matrix.

    Raises:
        InputError: another suffix. OutputError: the file cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".npz":
        _write_npz(path, keypoints)
    elif suffix == ".csv":
        with atomic_path(path) as temporary:
            temporary.write_text(_to_csv(keypoints), encoding="utf-8")
    else:
        raise InputError(f"{path}: expected a name that ends in .npz or .csv")


# --- npz ------------------------------------------------------------------------------------------


def _read_npz(path: Path) -> _Raw:
    there = npz_keys(path)
    landmarks = "keypoints" not in there and "joints2d" in there
    points, seen = ("joints2d", "visibility") if landmarks else ("keypoints", "confidence")
    arrays = read_npz(path, (points, "names"), (seen, "fps", "K", "image_size", "neck"))
    given = {key: numbers(f"{path}: {key}", arrays[key])
             for key in (points, seen, "K", "image_size") if key in arrays}  # fmt: skip
    neck = one_text(path, "neck", arrays["neck"]) if "neck" in arrays else ""
    return _Raw(
        given[points], texts(path, "names", arrays["names"]), given.get(seen),
        one_number(path, "fps", arrays["fps"]) if "fps" in arrays else None,
        given.get("K"), given.get("image_size"), neck or None,
    )  # fmt: skip


def _write_npz(path: Path, data: Keypoints) -> None:
    arrays = {"keypoints": data.keypoints.cpu().numpy(), "names": np.array(data.names)}
    for key, value in (("confidence", data.confidence), ("K", data.K)):
        if value is not None:
            arrays[key] = value.cpu().numpy()
    for key in ("fps", "image_size", "neck"):
        if getattr(data, key) is not None:
            arrays[key] = np.asarray(getattr(data, key))
    write_npz(path, arrays)


# --- csv ------------------------------------------------------------------------------------------


def _read_csv(path: Path) -> _Raw:
    lines = read_text(path, "comma-separated text").splitlines()
    notes = [line for line in lines if line.startswith("#")]
    rows = [(number, [cell.strip() for cell in line.split(",")])
            for number, line in enumerate(lines, start=1)
            if line.strip() and not line.startswith("#")]  # fmt: skip
    if not rows:
        raise FileFormatError(f"{path}: expected a header frame,NAME_x,NAME_y,...; it is empty")
    header = rows[0][1]
    if header[0].lower() != "frame":
        raise FileFormatError(
            f"{path}, line {rows[0][0]}: expected a header frame,NAME_x,NAME_y[,NAME_confidence],... "
            f"or frame,name,x,y[,confidence], got {','.join(header)[:60]!r}"
        )
    for number, cells in rows:
        if len(cells) != len(header):
            raise FileFormatError(
                f"{path}, line {number}: expected {len(header)} cells as in the header, "
                f"got {len(cells)}"
            )
    long = [cell.lower() for cell in header[1:4]] == ["name", "x", "y"]
    raw = _long_rows(path, header, rows[1:]) if long else _wide_rows(path, header, rows[1:])
    raw.fps, raw.image_size = _csv_notes(path, notes)
    return raw


def _wide_rows(path: Path, header: list[str], rows: list[tuple[int, list[str]]]) -> _Raw:
    column = {name: i for i, name in enumerate(header)}
    names = [h[:-2] for h in header[1:] if h.endswith("_x")]
    wanted = {"frame"} | {f"{n}_{axis}" for n in names for axis in ("x", "y", "confidence")}
    strange = [h for h in header if h not in wanted]
    absent = [f"{n}_y" for n in names if f"{n}_y" not in column]
    if not names or strange or absent or len(column) != len(header):
        raise FileFormatError(
            f"{path}: expected columns frame,NAME_x,NAME_y[,NAME_confidence],... each once, got "
            f"{', '.join(strange + absent) or ','.join(header)}"
            + (" (absent)" if absent and not strange else "")
        )
    table = np.array([[_cell(path, number, c) for c in cells] for number, cells in rows])
    table = table.reshape(-1, len(header))
    index, count = _frames(path, table[:, 0], rows, repeated=False)
    joints = np.stack([table[:, [column[f"{n}_{a}"] for n in names]] for a in "xy"], -1)
    points = np.full((count, len(names), 2), np.nan)
    points[index] = joints
    confidence = None
    if any(f"{n}_confidence" in column for n in names):
        confidence = np.zeros((count, len(names)))
        for j, name in enumerate(names):
            given = column.get(f"{name}_confidence")
            confidence[index, j] = 1.0 if given is None else table[:, given]
    return _Raw(points, tuple(names), confidence)


def _long_rows(path: Path, header: list[str], rows: list[tuple[int, list[str]]]) -> _Raw:
    scored = [h.lower() for h in header[4:]] == ["confidence"]
    if len(header) != 4 + scored:
        raise FileFormatError(f"{path}: expected columns frame,name,x,y[,confidence]")
    names = list(dict.fromkeys(cells[1] for _, cells in rows))
    table = np.array([[_cell(path, number, c) for c in (cells[0], *cells[2:])]
                      for number, cells in rows]).reshape(-1, 3 + scored)  # fmt: skip
    index, count = _frames(path, table[:, 0], rows, repeated=True)
    joint = np.array([names.index(cells[1]) for _, cells in rows], dtype=int)
    if len(set(zip(index.tolist(), joint.tolist(), strict=True))) < len(rows):
        raise FileFormatError(
            f"{path}: a keypoint is given twice in one frame; expected one person"
        )
    points = np.full((count, len(names), 2), np.nan)
    points[index, joint] = table[:, 1:3]
    confidence = None
    if scored:
        confidence = np.zeros((count, len(names)))
        confidence[index, joint] = table[:, 3]
    return _Raw(points, tuple(names), confidence)


def _cell(path: Path, number: int, cell: str) -> float:
    if not cell:
        return math.nan
    try:
        return float(cell)
    except ValueError as error:
        raise FileFormatError(f"{path}, line {number}: expected a number, got {cell!r}") from error


def _frames(
    path: Path, frames: np.ndarray, rows: list[tuple[int, list[str]]], repeated: bool
) -> tuple[np.ndarray, int]:
    """Return the row -> index of its frame, counted from the first one, and the number of frames."""
    with np.errstate(invalid="ignore"):  # of infinite ones
        whole = np.isfinite(frames) & (frames % 1 == 0)
        steps = np.diff(frames, prepend=frames[:1] - (not repeated))
    bad = ~whole | (steps < (not repeated)) | (steps > _MAX_GAP)
    if bad.any():
        at = int(np.flatnonzero(bad)[0])
        raise FileFormatError(
            f"{path}, line {rows[at][0]}: frame numbers must be whole and increase, "
            f"got {rows[at][1][0] or 'none'}"
        )
    index = (frames - frames[:1]).astype(int)
    count = int(index[-1]) + 1 if len(index) else 0
    check_span(path, count, len(np.unique(index)))
    return index, count


def _csv_notes(path: Path, notes: list[str]) -> tuple[float | None, list[float] | None]:
    fps, size = None, None
    for note in notes:
        key, _, value = note.lstrip("# ").partition("=")
        try:
            if key.strip() == "fps":
                fps = float(value)
            elif key.strip() == "image_size":
                size = [float(v) for v in value.split(",")]
        except ValueError as error:
            raise FileFormatError(f"{path}: cannot read {note!r}") from error
    return fps, size


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


def _finish(path: Path, raw: _Raw) -> Keypoints:
    points, names = raw.keypoints, raw.names
    if points.ndim != 3 or points.shape[1:] != (len(names), 2):
        raise FileFormatError(
            f"{path}: keypoints must have shape [T, {len(names)}, 2] for {len(names)} names, got "
            f"{list(points.shape)}; a confidence goes into an array of its own"
        )
    if len(points) == 0:
        raise InputError(f"{path}: the sequence is empty; expected one frame or more")
    far = np.abs(points) > _FAR
    if far.any():
        frame = int(np.argwhere(far)[0, 0])
        raise FileFormatError(
            f"{path}: keypoints must not be infinite or beyond {_FAR:g} pixels, frame {frame}; use NaN"
        )
    try:
        canonical_names(names)
    except SkeletonError as error:
        raise SkeletonError(f"{path}: {error}") from error
    missing = np.isnan(points).any(-1)
    if raw.confidence is not None:
        confidence = _check_confidence(path, raw.confidence, points.shape[:2])
        missing |= confidence == 0
        confidence = np.where(missing, 0.0, confidence)
    if missing.all():
        raise InputError(f"{path}: no keypoint is measured in any of {len(points)} frames")
    try:
        fps = None if raw.fps is None else check_rate("fps", raw.fps)
    except InputError as error:
        raise FileFormatError(f"{path}: {error}") from error
    if raw.neck is not None and raw.neck not in NECK_KINDS:
        raise FileFormatError(
            f"{path}: neck must be one of {', '.join(NECK_KINDS)}, got {raw.neck!r}"
        )
    skeleton = identify_skeleton(names)
    keypoints = Keypoints(
        torch.from_numpy(np.where(missing[..., None], np.nan, points)), names,
        None if raw.confidence is None else torch.from_numpy(confidence), fps,
        _check_matrix(path, raw.K), _check_size(path, raw.image_size),
        raw.neck or (None if skeleton is None else skeleton.neck), path,
    )  # fmt: skip
    return _with_joints(keypoints) if lacks_joints(names) else keypoints


def _with_joints(data: Keypoints) -> Keypoints:
    """MediaPipe's landmarks with head, neck and hands appended."""
    points, confidence, names = derive_joints(data.keypoints, data.confidence, data.names)
    if confidence is not None:
        confidence = torch.where(torch.isfinite(points).all(-1), confidence, 0.0)
    note = (
        "head, neck and hands are put where the prior's are, from MediaPipe's ears, shoulders, "
        "wrists and index fingers"
    )
    return replace(
        data, keypoints=points, confidence=confidence, names=names, neck="neck", notes=(note,)
    )


def _check_confidence(path: Path, confidence: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if confidence.shape != shape:
        raise FileFormatError(
            f"{path}: confidence must have shape {list(shape)}, got {list(confidence.shape)}"
        )
    confidence = np.nan_to_num(confidence, nan=0.0, posinf=math.inf, neginf=-math.inf)
    if (confidence < 0).any() or np.isinf(confidence).any():
        bad = confidence[(confidence < 0) | np.isinf(confidence)][0]
        raise FileFormatError(f"{path}: confidences must be finite and at least 0, got {bad:g}")
    return confidence


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
