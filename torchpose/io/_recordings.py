"""Read recordings of 3D joints of any supported sensor or software.

Joints come back in camera axes and metres; see `torchpose.io._formats.axes`. One module per
format reads a file; here its contents are checked and converted.
"""

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchpose._core.reading import npz_keys, read_text, reading, require_file
from torchpose._core.wording import first_of
from torchpose.errors import FileFormatError, InputError
from torchpose.io._formats.axes import (
    AXES,
    LIES,
    MIRRORED,
    axes_rotation,
    body_unit,
    check_upright,
    default_axes,
    heading,
    note_on_lying,
    note_on_mirroring,
)
from torchpose.io._formats.joint_tables import header_joints
from torchpose.io._formats.kinect_csv import ROW_LENGTHS, is_row, read_kinect_csv
from torchpose.io._formats.mocap_files import read_bvh, read_c3d
from torchpose.io._formats.raw_recording import (
    RawRecording,
    check_names,
    checked_rate,
    frame_ranges,
    read_npz_recording,
    read_opencv_recording,
)
from torchpose.io._formats.skeleton_files import read_azure_json, read_kinect_v1, read_ntu_skeleton
from torchpose.io._formats.table_rows import split_row
from torchpose.skeleton._joint_sets import identify_skeleton
from torchpose.skeleton._upper_body import UpperBody, to_upper_body

_READERS: dict[str, Callable[[Path], list[RawRecording]]] = {
    ".npz": read_npz_recording,
    ".yaml": read_opencv_recording,
    ".yml": read_opencv_recording,
    ".csv": read_kinect_csv,
    ".txt": read_kinect_v1,
    ".skeleton": read_ntu_skeleton,
    ".json": read_azure_json,
    ".bvh": read_bvh,
    ".c3d": read_c3d,
}
_SUFFIXES = tuple(_READERS)
_AXES_FILE = "axes.txt"
_SNIFFED = 65536  # bytes from the start of a file that tell whether it is a recording
_BACK_TO_CAMERA = (
    "by the shoulders the person's back is to the camera; if it is not, the joints are mirrored, or left and "
    "right exchanged"
)
DOUBTS = (LIES, MIRRORED, _BACK_TO_CAMERA)
"""How notes begin on recordings whose axes or sides are perhaps wrong."""
_BESIDE_BODY = 0.3  # most distance of a centred body's origin from its joints, over their extent
_SHOWN_JOINTS, _LISTED, _SHOWN_KEYS = 3, 2, 6  # joints, files and arrays that a note names
# arrays of keypoints, of results, and of what evaluations keep
_NO_RECORDINGS = ("keypoints", "joints2d", "joints3d", "state", "filtered")
_BACK = 2 * math.pi / 3  # radians of the mean heading, from which on the back is to the camera
_FAR = 1e9  # in the unit of the file; no joint is there


@dataclass
class Recording:
    """Holds a sequence of 3D joints of one person.

    Args:
        joints: [T, J, 3] float64, metres, camera axes; NaN where missing.
        names: J names as the file spells them.
        fps: frames per second, None if unknown.
        person, action, source: from the file, empty if it does not say.
        path: the file.
        weights: [T, J] in [0, 1], how far to trust each joint, 0 where it is missing; or None for all
            alike.
        skeleton: name of the joint set, empty if it is no known one.
        rotation: M [3, 3] with x_camera = M x_file, to go back to the axes of the file.
        notes: sentences on assumptions, conversions and omissions of the reader.
        companion: 0 for the person whose file it is, else which of the others in it.
        first_frame: number of the first frame in the file.
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
    notes: tuple[str, ...] = ()
    companion: int = 0
    first_frame: int = 0

    def __len__(self) -> int:
        return len(self.joints)

    @property
    def person_id(self) -> str:
        """Return the person, told apart from persons of the same name in other data sets.

        ``origin#person``: the origin is the repository that `source` names, else the folder. Files
        that were made from one repository share it, whatever folder they are in. Where a file names
        no person, its folder therefore stands for one. ``+1`` and so on are other people in the file.
        """
        folder = self.path.parent.resolve().name if self.path is not None else ""
        origin = re.split(r"[@\s]", self.source.strip(), maxsplit=1)[0] or folder
        other = f"+{self.companion}" if self.companion else ""
        return f"{origin}#{self.person}{other}"

    def upper_body(self, nose_as_head: bool = False) -> UpperBody:
        """Pick the eight joints of `torchpose.skeleton.UPPER_BODY` out of the recording's joint set.

        Args:
            nose_as_head: take the nose where there is no head.

        Returns:
            `UpperBody` with joints [T, 8, 3], metres, camera axes, NaN where the set lacks one, and the
            kinds of neck, hand and head.

        Raises:
            SkeletonError: unknown names, or none of the eight joints.
        """
        return to_upper_body(self.joints, self.names, nose_as_head)


def read_recording(path: str | Path, axes: str | None = None) -> list[Recording]:
    """Read the recordings of one file: one for each person in it.

    ``.npz``: `joints` [T, J, 3] and `names` [J]; optionally `fps`, `subject`, `action`, `source`,
    `axes`, `weights` [T, J]. ``.yaml``: the authors' OpenCV matrix. ``.csv``: rows of Kinect v1 or v2,
    or any joint set with a header. ``.txt``: Kinect v1. ``.skeleton``: NTU RGB+D. ``.json``: Azure Kinect.
    ``.bvh``, ``.c3d``: motion capture, with the extra ``mocap``.

    Millimetres and centimetres are recognised by the size of the body and converted; joints exactly
    at (0, 0, 0), with which sensors fill up, become missing. Other bodies in a file that are no
    people are left out. `Recording.notes` says so.

    Args:
        path: the file.
        axes: ``camera``, ``kinect``, ``y-up`` or ``z-up``; without it, what a file ``axes.txt`` in the
            folder says, else the file itself, else what its joint set usually has.

    Returns:
        A `Recording` per person, in camera axes; the one whose file it is first.

    Raises:
        InputError: no such file, an empty sequence, no joint anywhere. FileFormatError: truncated,
            another kind of file, wrong shapes, infinite values, no size of a body, upside down.
        SkeletonError: unknown joint names. MissingDependencyError: a library is needed.
    """
    path = require_file(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise FileFormatError(
            f"{path}: expected one of {', '.join(_SUFFIXES)}, got {path.suffix or 'no suffix'}"
        )
    with reading(path, "a recording of 3D joints"):
        return _read_recording(path, reader, axes or _axes_of_folder(path.parent))


def _axes_of_folder(folder: Path) -> str | None:
    """Return the axes of the recordings in a folder if a file says them: devices differ, folders hold one."""
    file = folder / _AXES_FILE
    if not file.is_file():
        return None
    axes = read_text(file, f"one of {', '.join(AXES)}").strip()
    if axes not in AXES:
        raise FileFormatError(f"{file}: expected one of {', '.join(AXES)}, got {axes!r:.40}")
    return axes


def _read_recording(
    path: Path, reader: Callable[[Path], list[RawRecording]], axes: str | None
) -> list[Recording]:
    found = reader(path)
    if not found:
        raise InputError(f"{path}: nobody is in any frame; expected a body in some")
    first, *others = found
    recordings, ghosts = [_finish(first, axes)], []
    for raw in others:
        try:
            recordings.append(_finish(raw, axes))
        except (FileFormatError, InputError) as error:  # sensors take furniture for people
            reason = str(error).removeprefix(f"{raw.where()}: ").split(";")[0]
            ghosts.append(f"other body {raw.companion} is left out: {reason}")
    recordings[0].notes += tuple(ghosts)
    return recordings


def cut_recording(recording: Recording, start: int, stop: int | None = None) -> Recording:
    """Return some frames of a recording.

    Args:
        recording: of all frames. start: the first frame. stop: the first one left out; None is the end.
    """
    weights = recording.weights
    return replace(
        recording,
        joints=recording.joints[start:stop],
        weights=None if weights is None else weights[start:stop],
        first_frame=recording.first_frame + start,
    )


def read_recordings(
    paths: str | Path | Iterable[str | Path], axes: str | None = None
) -> list[Recording]:
    """Read every recording in files and folders.

    Args:
        paths: one path or several; folders are searched, see `find_recordings`.
        axes: ``camera``, ``kinect``, ``y-up`` or ``z-up``, of all files; by default what each folder, file or
            joint set says, see `read_recording`.

    Returns:
        Recordings in camera axes, metres, in the order of the files.

    Raises:
        InputError, FileFormatError, SkeletonError, MissingDependencyError: as `read_recording`.
    """
    return [r for path in find_recordings(paths) for r in read_recording(path, axes)]


def find_recordings(paths: str | Path | Iterable[str | Path]) -> list[Path]:
    """Return the files with recordings among files and folders.

    Folders are searched with their subfolders. A folder's other files are passed over where it holds
    recordings as `.npz`, because they are those in another form. So are files of other content, and
    what `torchpose track` wrote; files that cannot be opened are listed, so that reading them says
    what is wrong.

    Args:
        paths: one path or several. A file is taken as it is.

    Returns:
        Paths without repetition, sorted within each folder.

    Raises:
        InputError: no such path, or no recording in any of them.
    """
    given = _as_paths(paths)
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
            + "".join(f"; {note}" for note in notes_on_unread_files(given, ()))
        )
    return list(dict.fromkeys(found))


def notes_on_unread_files(
    paths: str | Path | Iterable[str | Path], found: Iterable[Path]
) -> list[str]:
    """Return notes on files in folders that `find_recordings` passes over though they may be recordings.

    Args:
        paths: one path or several, as given to `find_recordings`. found: what that returned.
    """
    read = set(found)
    files = [f for p in _as_paths(paths) if p.is_dir() for f in sorted(p.rglob("*")) if f.is_file()]
    unread = [
        f
        for f in dict.fromkeys(files)
        if f not in read and f.name[0] != "." and f.name != _AXES_FILE
    ]
    nameless = [f for f in unread if f.suffix.lower() == ".npz" and _holds_something_else(f)]
    unread = [f for f in unread if f.suffix.lower() in _SUFFIXES[1:]]
    archives = {f.parent for f in read if f.suffix.lower() == ".npz"}
    beside = [f for f in unread if f.parent in archives]
    other = [f for f in unread if f.parent not in archives]
    notes = []
    if nameless:
        notes.append(
            f"not read, since they hold no arrays joints and names: {first_of(nameless, _LISTED)}; the first "
            f"has {first_of(npz_keys(nameless[0]), _SHOWN_KEYS)}"
        )
    if beside:
        notes.append(
            f"not read, since the folder holds recordings as .npz: {first_of(beside, _LISTED)}; if they "
            "are others, move them to another folder"
        )
    if other:
        notes.append(
            f"not read, since they do not begin as a recording does: {first_of(other, _LISTED)}; named "
            "alone, such a file tells what is wrong"
        )
    return notes


def _as_paths(paths: str | Path | Iterable[str | Path]) -> list[Path]:
    return [Path(paths)] if isinstance(paths, str | Path) else [Path(p) for p in paths]


# --- what is a recording --------------------------------------------------------------------------


def _recordings_in(folder: Path) -> list[Path]:
    files = sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    archives = [p for p in files if p.suffix.lower() == ".npz" and _may_hold_joints(p)]
    if archives:
        return archives
    return [p for p in files if p.suffix.lower() in _SUFFIXES[1:] and looks_recorded(p)]


def _may_hold_joints(path: Path) -> bool:
    try:
        return {"joints", "names"} <= set(npz_keys(path))
    except (FileFormatError, InputError):
        return True  # reading it gives the error


def _holds_something_else(path: Path) -> bool:
    """Return whether a readable .npz holds neither joints, nor keypoints, nor results of tracking."""
    return not (_may_hold_joints(path) or any(known in npz_keys(path) for known in _NO_RECORDINGS))


def looks_recorded(path: Path) -> bool:
    """Return whether a file that is no .npz begins as recordings of 3D joints do.

    Raises:
        InputError: it cannot be read.
    """
    with reading(path, "a recording"), path.open("rb") as stream:
        start = stream.read(_SNIFFED).decode("utf-8-sig", "replace")
    suffix = path.suffix.lower()
    if suffix in (".csv", ".txt"):
        lines = [line for line in start.splitlines() if line.strip() and not line.startswith("#")]
        first = split_row(lines[0]) if lines else []
        daily = suffix == ".txt" and first[1:] == ["20"]
        row = len(first) in ROW_LENGTHS and is_row(lines[0])
        return row or daily or (bool(lines) and bool(header_joints(lines[0])))
    if suffix == ".json":
        return '"joint_positions"' in start or '"bone_list"' in start
    if suffix == ".bvh":
        return not ("ROOT neck" in start and "JOINT head_base" in start)  # a result, no recording
    if suffix in (".yaml", ".yml"):
        return start.startswith("%YAML") and "opencv-matrix" in start
    return True


# --- checks and conversion ------------------------------------------------------------------------


def _finish(raw: RawRecording, axes: str | None) -> Recording:
    """Check the joints of a file and turn them into metres and camera axes."""
    where = raw.where()
    _check_shapes(raw)
    fps = checked_rate(where, raw.fps)
    check_names(where, raw.names)
    notes = list(raw.notes)
    joints = _trusted(raw, _missing(raw, notes))
    tensor = torch.from_numpy(joints)
    tensor = tensor * (1.0 if raw.unit is None else raw.unit)
    unit = body_unit(where, tensor, raw.names)
    if raw.unit is not None and unit.note:
        raise FileFormatError(
            f"{where}: the file states its unit ({raw.unit:g} m), but in it the body is no person's "
            f"size ({unit.note}); correct the unit"
        )
    notes += [unit.note] if unit.note else []
    tensor = tensor * unit.metres
    axes = axes or raw.axes or default_axes(where, raw.names)
    try:
        rotation = axes_rotation(tensor, raw.names, axes)
    except InputError as error:
        raise type(error)(f"{where}: {error}") from error
    tensor = tensor @ rotation.mT
    check_upright(where, tensor, raw.names)
    notes += (
        note_on_lying(tensor, raw.names)
        or note_on_mirroring(tensor, raw.names)
        or _notes_on_heading(tensor, raw.names)
    )
    skeleton = identify_skeleton(raw.names)
    weights = None
    if raw.weights is not None:
        weights = torch.from_numpy(np.where(np.isnan(joints).any(-1), 0.0, raw.weights))
    return Recording(
        tensor, raw.names, fps, raw.person, raw.action, raw.source, raw.path, weights,
        "" if skeleton is None else skeleton.name, rotation, tuple(notes), raw.companion,
        raw.first_frame,
    )  # fmt: skip


def _notes_on_heading(joints: Tensor, names: Sequence[str]) -> list[str]:
    """Return a note if the person's back is to the camera, as that of mirrored joints is."""
    angle = heading(joints, names)
    if angle is None or abs(angle) < _BACK:
        return []
    return [_BACK_TO_CAMERA]


def _check_shapes(raw: RawRecording) -> None:
    where, joints, weights = raw.where(), raw.joints, raw.weights
    if joints.ndim != 3 or joints.shape[1:] != (len(raw.names), 3):
        raise FileFormatError(
            f"{where}: joints must have shape [T, {len(raw.names)}, 3] for {len(raw.names)} names, "
            f"got {list(joints.shape)}"
        )
    if len(joints) == 0:
        raise InputError(f"{where}: the sequence is empty; expected one frame or more")
    far = np.abs(joints) > _FAR
    if far.any():
        frame, joint = np.argwhere(far)[0, :2]
        raise FileFormatError(
            f"{where}: joints must not be infinite or beyond {_FAR:g}, frame {raw.first_frame + frame} "
            f"is ({raw.names[joint]}); use NaN for what is missing"
        )
    if np.isnan(joints).all():
        raise InputError(f"{where}: every joint is NaN; expected some that are measured")
    if weights is None:
        return
    if weights.shape != joints.shape[:2]:
        raise FileFormatError(
            f"{where}: weights must have shape {list(joints.shape[:2])}, got {list(weights.shape)}"
        )
    if not (np.isfinite(weights).all() and (weights >= 0).all() and (weights <= 1).all()):
        raise FileFormatError(f"{where}: weights must lie in [0, 1]")


def _missing(raw: RawRecording, notes: list[str]) -> np.ndarray:
    """Return the joints, NaN where a coordinate is missing or all are exactly zero, and notes about both."""
    joints = np.where(np.isnan(raw.joints).any(-1, keepdims=True), np.nan, raw.joints)
    zero = (joints == 0).all(-1)
    always = np.flatnonzero(zero[~np.isnan(joints).all((1, 2))].all(0))
    if len(always) == 1 and _is_origin(np.delete(joints, always, 1)):
        zero[:, always] = False
        notes.append(f"centred on {raw.names[always[0]]}, which is always at zero")
    if not zero.any():
        return joints
    joints = np.where(zero[..., None], np.nan, joints)
    if np.isnan(joints).all():
        raise InputError(f"{raw.where()}: every joint is zero or NaN; expected some measured ones")
    empty = zero.all(1)
    if empty.any():
        frames = frame_ranges(np.flatnonzero(empty).tolist(), raw.first_frame)
        notes.append(f"no body (all joints at zero) in frames {frames}")
    notes += _zero_notes(zero & ~empty[:, None], raw)
    return joints


def _trusted(raw: RawRecording, joints: np.ndarray) -> np.ndarray:
    """Return the joints, NaN where their weight is zero: a sensor that lost a joint still writes a place."""
    if raw.weights is None:
        return joints
    joints = np.where((raw.weights == 0)[..., None], np.nan, joints)
    if np.isnan(joints).all():
        raise InputError(
            f"{raw.where()}: every joint has weight 0 or is missing; expected some that are tracked"
        )
    return joints


def _is_origin(others: np.ndarray) -> bool:
    """Return whether zero lies within the body that the other joints make, so that it is centred there."""
    measured = ~np.isnan(others).all((1, 2))
    low = np.where(np.isnan(others), np.inf, others)[measured].min(1)
    high = np.where(np.isnan(others), -np.inf, others)[measured].max(1)
    beside = _BESIDE_BODY * (high - low).max(-1, keepdims=True)
    inside = ((low - beside <= 0) & (high + beside >= 0)).all(-1)
    return bool(inside.mean() > 0.5) if len(inside) else False


def _zero_notes(zero: np.ndarray, raw: RawRecording) -> list[str]:
    found = np.flatnonzero(zero.any(0))
    notes = [
        f"{raw.names[j]} is exactly (0, 0, 0), so missing, in frames "
        f"{frame_ranges(np.flatnonzero(zero[:, j]).tolist(), raw.first_frame)}"
        for j in found[:_SHOWN_JOINTS]
    ]
    rest = [raw.names[j] for j in found[_SHOWN_JOINTS:]]
    return notes + [f"so are, in some frames, {', '.join(rest)}"] * bool(rest)
