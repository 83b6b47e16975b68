"""Recordings of 3D joints: the common .npz, the authors' OpenCV file, Kinect v2 CSV.

Joints come back in camera axes and metres; see `torchpose.io.axes` for how.
"""

import math
import re
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchpose.errors import (
    FileFormatError,
    InputError,
    MissingDependencyError,
    SkeletonError,
)
from torchpose.io.axes import axes_rotation, check_upright, default_axes
from torchpose.io.files import read_npz, require_file
from torchpose.joint_sets import SKELETONS, UPPER_BODY, canonical_names, identify_skeleton
from torchpose.skeleton import UpperBody, to_upper_body

__all__ = ["Recording", "find_recordings", "read_recording", "read_recordings"]

_SUFFIXES = (".npz", ".yaml", ".yml", ".csv")
_TRACKING_WEIGHTS = (0.0, 0.5, 1.0)  # Kinect v2: not tracked, inferred, tracked
_KINECT_TICK = 1e-7  # its time stamps count 100 ns


@dataclass
class Recording:
    """A sequence of 3D joints of one person.

    Args:
        joints: [T, J, 3] float64, metres, camera axes; NaN where missing.
        names: J names as the file spells them.
        fps: frames per second, None if unknown.
        person, action, source: from the file, empty if it does not say.
        path: the file.
        weights: [T, J] in [0, 1], how far to trust each joint, or None for all alike.
        skeleton: name of the joint set, empty if it is no known one.
        rotation: M [3, 3] with x_camera = M x_file, to go back to the axes of the file.
    """

    joints: Tensor
    names: tuple[str, ...]
    fps: float | None = None
    person: str = ""
    action: str = ""
    source: str = ""
    path: Path | None = None
    weights: Tensor | None = None
    skeleton: str = ""
    rotation: Tensor = field(default_factory=lambda: torch.eye(3, dtype=torch.float64))

    def __len__(self) -> int:
        return len(self.joints)

    @property
    def person_id(self) -> str:
        """The person, told apart from persons of the same name in other data sets.

        ``origin#person``: the origin is the repository that `source` names, else the folder. Files
        that were made from one repository share it, whatever folder they are in.
        """
        folder = self.path.resolve().parent.name if self.path is not None else ""
        origin = re.split(r"[@\s]", self.source.strip(), maxsplit=1)[0] or folder
        return f"{origin}#{self.person}"

    def upper_body(self, nose_as_head: bool = False) -> UpperBody:
        """The eight joints [T, 8, 3] with the kinds of neck, hand and head."""
        return to_upper_body(self.joints, self.names, nose_as_head)


def read_recording(path: str | Path, axes: str | None = None) -> list[Recording]:
    """Read the recordings of one file.

    ``.npz``: `joints` [T, J, 3] in metres and `names` [J]; optionally `fps`, `subject`, `action`,
    `source`, `axes`, `weights` [T, J]. ``.yaml``: the authors' OpenCV matrix of T x 24, joints in
    the order of `UPPER_BODY`. ``.csv``: Kinect v2 as in LabanotationSuite, 25 joints with tracking
    state (inferred joints weigh 0.5, those not tracked are missing) and time stamps in 100 ns.

    Args:
        path: the file.
        axes: ``camera``, ``kinect``, ``y-up`` or ``z-up``; without it, what the file says, else
            what its joint set usually has.

    Returns:
        One `Recording` per sequence in the file (one, for these formats), in camera axes.

    Raises:
        InputError: no such file, an empty sequence, no joint anywhere. FileFormatError: truncated,
            another kind of file, wrong shapes, infinite values, upside down.
        SkeletonError: unknown joint names. MissingDependencyError: OpenCV is needed for ``.yaml``.
    """
    path = require_file(path)
    readers = {".npz": _read_npz, ".yaml": _read_yaml, ".yml": _read_yaml, ".csv": _read_kinect_csv}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise FileFormatError(
            f"{path}: expected one of {', '.join(_SUFFIXES)}, got {path.suffix or 'no suffix'}"
        )
    return [_finish(reader(path), axes)]


def read_recordings(
    paths: str | Path | Iterable[str | Path], axes: str | None = None
) -> list[Recording]:
    """Read every recording in files and folders; see `find_recordings` and `read_recording`."""
    return [r for path in find_recordings(paths) for r in read_recording(path, axes)]


def find_recordings(paths: str | Path | Iterable[str | Path]) -> list[Path]:
    """Files with recordings among files and folders.

    Folders are searched with their subfolders. A folder's `.yaml` and `.csv` files are passed over
    where it holds recordings as `.npz`, because they are those in another form. So are files of
    other content; files that cannot be opened are listed, so that reading them says what is wrong.

    Args:
        paths: one path or several. A file is taken as it is.

    Returns:
        Paths without repetition, sorted within each folder.

    Raises:
        InputError: no such path, or no recording in any of them.
    """
    given = [Path(paths)] if isinstance(paths, str | Path) else [Path(p) for p in paths]
    found: list[Path] = []
    for path in given:
        if path.is_dir():
            folders = [path, *sorted(p for p in path.rglob("*") if p.is_dir())]
            found += [file for folder in folders for file in _recordings_in(folder)]
        elif path.is_file():
            found.append(path)
        else:
            raise InputError(f"{path}: no such file or folder")
    if not found:
        raise InputError(
            f"expected recordings of 3D joints ({', '.join(_SUFFIXES)}), found none in "
            f"{', '.join(map(str, given)) or 'no paths at all'}"
        )
    return list(dict.fromkeys(found))


# --- what is a recording --------------------------------------------------------------------------


def _recordings_in(folder: Path) -> list[Path]:
    files = sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    archives = [p for p in files if p.suffix.lower() == ".npz" and _may_hold_joints(p)]
    if archives:
        return archives
    return [p for p in files if p.suffix.lower() in _SUFFIXES[1:] and _looks_recorded(p)]


def _may_hold_joints(path: Path) -> bool:
    try:
        with zipfile.ZipFile(path) as archive:
            return {"joints.npy", "names.npy"} <= set(archive.namelist())
    except (zipfile.BadZipFile, OSError):
        return True  # reading it gives the error


def _looks_recorded(path: Path) -> bool:
    with path.open("rb") as stream:
        start = stream.read(4096).decode("utf-8", "replace")
    if path.suffix.lower() == ".csv":
        return len(start.split("\n", 1)[0].rstrip().rstrip(",").split(",")) == 1 + 25 * 4
    return start.startswith("%YAML") and "opencv-matrix" in start


# --- readers --------------------------------------------------------------------------------------


@dataclass
class _Raw:
    """What a file holds, before conversion."""

    path: Path
    joints: np.ndarray
    names: tuple[str, ...]
    fps: float | None
    axes: str | None = None
    person: str = ""
    action: str = ""
    source: str = ""
    weights: np.ndarray | None = None


def _read_npz(path: Path) -> _Raw:
    arrays = read_npz(
        path,
        required=("joints", "names"),
        optional=("fps", "subject", "action", "source", "axes", "weights"),
    )
    joints = _numbers(f"{path}: joints", arrays["joints"])
    names = tuple(str(n) for n in np.atleast_1d(arrays["names"]).ravel())
    weights = arrays.get("weights")
    text = {key: str(arrays[key].item()) if key in arrays and arrays[key].size == 1 else ""
            for key in ("subject", "action", "source", "axes")}  # fmt: skip
    fps = None
    if "fps" in arrays:
        value = _numbers(f"{path}: fps", arrays["fps"])
        if value.size != 1 or not 0 < float(value.item()) < math.inf:
            raise FileFormatError(f"{path}: fps must be one positive number, got {value.tolist()}")
        fps = float(value.item())
    return _Raw(
        path, joints, names, fps, text["axes"] or None, text["subject"], text["action"],
        text["source"], None if weights is None else _numbers(f"{path}: weights", weights),
    )  # fmt: skip


def _read_yaml(path: Path) -> _Raw:
    try:
        import cv2
    except ImportError as error:
        raise MissingDependencyError(
            f"{path}: reading OpenCV files needs OpenCV; install opencv-python-headless"
        ) from error
    expected = f"an OpenCV FileStorage with one matrix of T x {3 * len(UPPER_BODY)}"
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{path}: expected {expected}, got another kind of file") from error
    if "opencv-matrix" not in text:  # OpenCV prints its own complaint about foreign files
        raise FileFormatError(f"{path}: expected {expected}, found no matrix")
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        nodes = [storage.getNode(key) for key in storage.root().keys()]  # noqa: SIM118
        matrices = [node.mat() for node in nodes if node.isMap()]
        storage.release()
    except (cv2.error, SystemError) as error:
        raise FileFormatError(
            f"{path}: expected {expected}; it is truncated or damaged ({_first_line(error)})"
        ) from error
    if len(matrices) != 1 or matrices[0] is None or matrices[0].shape[1:] != (3 * len(UPPER_BODY),):
        shapes = [None if m is None else m.shape for m in matrices]
        raise FileFormatError(f"{path}: expected {expected}, got matrices of {shapes}")
    joints = matrices[0].reshape(-1, len(UPPER_BODY), 3)
    # the source states no rate; Kinect v1 records 30 frames per second
    return _Raw(path, joints, UPPER_BODY, 30.0, "camera")


def _read_kinect_csv(path: Path) -> _Raw:
    names = SKELETONS["kinect-v2-25"].joints
    width = 1 + 4 * len(names)
    rows: list[list[float]] = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{path}: expected Kinect v2 rows of numbers, got bytes") from error
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        fields = line.strip().removesuffix(",").split(",")
        try:
            row = [float(value) for value in fields]
        except ValueError as error:
            raise FileFormatError(f"{path}, line {number}: expected numbers ({error})") from error
        if len(row) != width:
            raise FileFormatError(
                f"{path}, line {number}: expected {width} numbers (time stamp, then x, y, z and "
                f"tracking state of {len(names)} joints), got {len(row)}"
            )
        if not set(row[4::4]) <= {0.0, 1.0, 2.0}:
            raise FileFormatError(f"{path}, line {number}: tracking states must be 0, 1 or 2")
        if rows and row[0] <= rows[-1][0]:
            raise FileFormatError(
                f"{path}, line {number}: time stamps must increase, got {row[0]:.0f} after "
                f"{rows[-1][0]:.0f}"
            )
        rows.append(row)
    table = np.array(rows).reshape(-1, width)
    values = table[:, 1:].reshape(-1, len(names), 4)
    weights = np.array(_TRACKING_WEIGHTS)[values[..., 3].astype(int)]
    joints = np.where(weights[..., None] > 0, values[..., :3], np.nan)
    steps = np.diff(table[:, 0]) * _KINECT_TICK
    fps = float(1 / np.median(steps)) if len(steps) else None
    return _Raw(path, joints, names, fps, "kinect", action=path.stem, weights=weights)


# --- checks and conversion ------------------------------------------------------------------------


def _numbers(name: str, array: np.ndarray) -> np.ndarray:
    if array.dtype.kind not in "fiub":
        raise FileFormatError(f"{name} must be numbers, got {array.dtype}")
    return array.astype(np.float64)


def _first_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__


def _finish(raw: _Raw, axes: str | None) -> Recording:
    """Check what was read and turn it into camera axes."""
    path, joints = raw.path, raw.joints
    if joints.ndim != 3 or joints.shape[1:] != (len(raw.names), 3):
        raise FileFormatError(
            f"{path}: joints must have shape [T, {len(raw.names)}, 3] for {len(raw.names)} names, "
            f"got {list(joints.shape)}"
        )
    if len(joints) == 0:
        raise InputError(f"{path}: the sequence is empty; expected one frame or more")
    if np.isinf(joints).any():
        frame = int(np.argwhere(np.isinf(joints))[0, 0])
        raise FileFormatError(f"{path}: joints must not be infinite, frame {frame} is; use NaN")
    if np.isnan(joints).all():
        raise InputError(f"{path}: every joint is NaN; expected some that are measured")
    _check_weights(path, raw.weights, joints)
    try:
        canonical_names(raw.names)
    except SkeletonError as error:
        raise SkeletonError(f"{path}: {error}") from error
    # a joint with one coordinate missing is missing
    joints = np.where(np.isnan(joints).any(-1, keepdims=True), np.nan, joints)
    tensor = torch.from_numpy(joints)
    skeleton = identify_skeleton(raw.names)
    axes = axes or raw.axes or default_axes(str(path), raw.names)
    try:
        rotation = axes_rotation(tensor, raw.names, axes)
    except InputError as error:
        raise type(error)(f"{path}: {error}") from error
    tensor = tensor @ rotation.mT
    check_upright(str(path), tensor, raw.names)
    return Recording(
        tensor, raw.names, raw.fps, raw.person, raw.action, raw.source, path,
        None if raw.weights is None else torch.from_numpy(raw.weights),
        "" if skeleton is None else skeleton.name, rotation,
    )  # fmt: skip


def _check_weights(path: Path, weights: np.ndarray | None, joints: np.ndarray) -> None:
    if weights is None:
        return
    if weights.shape != joints.shape[:2]:
        raise FileFormatError(
            f"{path}: weights must have shape {list(joints.shape[:2])}, got {list(weights.shape)}"
        )
    if not (np.isfinite(weights).all() and (weights >= 0).all() and (weights <= 1).all()):
        raise FileFormatError(f"{path}: weights must lie in [0, 1]")
