"""HumanEva-I in its own folder layout, so that holders of its licence can run the original tables.

    ROOT/S1/Mocap_Data/Walking_1.c3d  (or .mat), Static.c3d, S1.mp
    ROOT/S1/Calibration_Data/C1.cal ... C3.cal, BW1.cal ... BW4.cal
    ROOT/S1/Sync_Data/Walking_1_(C1).ofs ...
    ROOT/S1/Image_Data/Walking_1_(C1).avi ...
    ROOT/Background/Background_1_(C1).avi ...

A video may also be a folder of its frames, without the ``.avi``. Millimetres become metres; the axes
are those of the room, z up. Frames of a trial are numbered from one, at the rate of the videos, as in
the lists of the data set.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks._humaneva_joints import SHOULDER_OFFSETS, joint_centres
from torchpose._core.reading import read_text, reading, require_file
from torchpose.body import body_joints
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.errors import FileFormatError, InputError, MissingDependencyError
from torchpose.io._formats.mocap_files import read_c3d_points
from torchpose.io._mocap import MocapClip
from torchpose.skeleton import SKELETONS

__all__ = [
    "PARTITIONS",
    "HumanEvaTrial",
    "StreamOffset",
    "find_humaneva",
    "is_humaneva",
    "read_calibration",
    "read_humaneva",
    "read_stream_offset",
]

FPS = 60.0
COLOUR_CAMERAS = ("C1", "C2", "C3")
_ALL_CAMERAS = (*COLOUR_CAMERAS, "BW1", "BW2", "BW3", "BW4")
_COLOUR_SIZE = (640, 480)
_MM = 1e-3
_HALF_MARKER = 7.0  # mm
_FAR = 1e8  # no number of a calibration or an offset is as large

PARTITIONS: dict[tuple[str, str], tuple[int, int, int]] = {
    ("S1", "Walking"): (6, 590, 1203), ("S1", "Jog"): (6, 367, 740),
    ("S1", "ThrowCatch"): (6, 473, 945), ("S1", "Gestures"): (6, 395, 801),
    ("S1", "Box"): (6, 385, 789),
    ("S2", "Walking"): (6, 438, 876), ("S2", "Jog"): (6, 398, 795),
    ("S2", "ThrowCatch"): (6, 550, 1128), ("S2", "Gestures"): (6, 500, 901),
    ("S2", "Box"): (6, 382, 734),
    ("S3", "Walking"): (6, 448, 939), ("S3", "Jog"): (6, 401, 842),
    ("S3", "ThrowCatch"): (6, 493, 1027), ("S3", "Gestures"): (6, 533, 1102),
    ("S3", "Box"): (6, 512, 1021),
}  # fmt: skip
"""First and last frame of trial 1 for validation, and last frame of its part for training."""


class StreamOffset(NamedTuple):
    """How a video and the motion capture belong together; frames are numbered from one.

    mocap = `mocap` + (video - `video`) `scale`.
    """

    video: float
    mocap: float
    scale: float


@dataclass(frozen=True)
class HumanEvaTrial:
    """One trial: joints at the frames of its videos, and the files of its cameras.

    Args:
        person, action, trial: such as S1, Walking, 1.
        joints: [T, 15, 3] of the joint set humaneva-15, metres, z up; NaN in frames in which markers
            were lost. names: of those.
        calibrations: of the cameras that were asked for.
        videos: their videos, for those that are there.
        first_frames: of each camera, which image of its video (from zero) belongs to `joints[0]`.
        backgrounds: videos of the empty room of each camera.
        notes: what was assumed.
    """

    person: str
    action: str
    trial: str
    joints: Tensor
    names: tuple[str, ...]
    calibrations: tuple[PinholeCamera, ...]
    videos: dict[str, Path]
    first_frames: dict[str, int]
    backgrounds: dict[str, tuple[Path, ...]]
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.joints)

    @property
    def cameras(self) -> CameraRig:
        """Return the rig of the cameras, at the size of their videos."""
        return CameraRig(self.calibrations)

    def clip(self, start: int | None = None, stop: int | None = None) -> MocapClip:
        """Return frames `start` to `stop`, numbered from one, both included, as a clip of fifteen joints."""
        rows = slice(None if start is None else start - 1, stop)
        joints = self.joints[rows]
        up = joints.new_tensor([0.0, 0.0, 1.0])
        return MocapClip(
            body_joints(joints, self.names), joints, self.names, up, FPS, self.person, self.action,
            f"{self.action}_{self.trial}",
        )  # fmt: skip


def is_humaneva(root: str | Path) -> bool:
    """Return whether a folder is laid out as HumanEva-I.

    >>> is_humaneva("nowhere")
    False
    """
    return any(Path(root).glob("S*/Mocap_Data"))


def find_humaneva(root: str | Path) -> list[tuple[str, str, str]]:
    """Return (person, action, trial) of every trial with motion capture below a folder.

    Raises:
        InputError: there is none.
    """
    found = set()
    for path in Path(root).glob("S*/Mocap_Data/*_*.*"):
        match = re.fullmatch(r"([A-Za-z]+)_(\d+)\.(c3d|mat)", path.name, re.IGNORECASE)
        if match:
            found.add((path.parent.parent.name, match[1], match[2]))
    if not found:
        raise InputError(
            f"{root}: expected HumanEva-I, S1/Mocap_Data/Walking_1.c3d and so on; found no such file"
        )
    return sorted(found)


def read_humaneva(
    root: str | Path,
    person: str,
    action: str,
    trial: str | int,
    cameras: Sequence[str] = COLOUR_CAMERAS,
) -> HumanEvaTrial:
    """Read one trial of HumanEva-I, its motion capture synchronised with its videos.

    Args:
        root: folder that holds S1, S2, ... and Background. person, action, trial: which.
        cameras: of the rig, among C1 to C3 and BW1 to BW4.

    Raises:
        InputError: a file is missing. FileFormatError: a file is damaged or of another kind.
        MissingDependencyError: c3d (or SciPy for .mat files) is not installed.
    """
    folder = Path(root) / person
    name = f"{action}_{trial}"
    calibrated = [read_calibration(folder / "Calibration_Data" / f"{c}.cal") for c in cameras]
    offsets = _offsets(folder / "Sync_Data", name)
    common, firsts = _common_clock(offsets)
    notes = [] if offsets else ["no .ofs file: the videos start with the motion capture"]
    points = _points(folder / "Mocap_Data", name)
    measures, missing = _measures(folder / "Mocap_Data", person)
    notes += missing
    joints = joint_centres(points, measures)
    at_video = _interpolated(joints, common)
    videos = {c: _videos(folder / "Image_Data", f"{name}_({c})") for c in cameras}
    backgrounds = {c: _videos(Path(root) / "Background", f"Background_*_({c})") for c in cameras}
    return HumanEvaTrial(
        person, action, str(trial), torch.from_numpy(at_video * _MM),
        SKELETONS["humaneva-15"].joints, tuple(calibrated),
        {c: paths[0] for c, paths in videos.items() if paths},
        {c: firsts.get(c, 0) for c in cameras}, backgrounds, tuple(notes),
    )  # fmt: skip


def read_calibration(path: str | Path) -> PinholeCamera:
    """Read a camera of HumanEva: f, c (pixels), skew, five distortions, R by rows, T (mm), 22 numbers.

    x_camera = R x_world + T; distortions are in OpenCV's order.

    Raises:
        InputError: no such file. FileFormatError: other than 22 numbers. CameraError: bad values.
    """
    import cv2

    path = require_file(path)
    values = _numbers(path, 22)
    fx, fy, cx, cy, skew = values[:5]
    R = np.array(values[10:19]).reshape(3, 3)
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-2):
        raise FileFormatError(
            f"{path}: numbers 11 to 19 must be a rotation matrix, got {R.tolist()}"
        )
    size = _COLOUR_SIZE if path.stem in COLOUR_CAMERAS else (None, None)
    with reading(path, "a camera of HumanEva"):
        return PinholeCamera(
            fx, fy, cx, cy, size[0], size[1], path.stem, skew=skew * fx, distortions=values[5:10],
            rotation=cv2.Rodrigues(R)[0].ravel().tolist(),
            translation=[_MM * t for t in values[19:]],
        )  # fmt: skip


def read_stream_offset(path: str | Path) -> StreamOffset:
    """Read the three numbers of an .ofs file.

    Raises:
        InputError: no such file. FileFormatError: other numbers, or a scale that is not positive.
    """
    path = require_file(path)
    offset = StreamOffset(*_numbers(path, 3))
    if not offset.scale > 0:
        raise FileFormatError(f"{path}: the scale must be positive, got {offset.scale:g}")
    return offset


def _videos(folder: Path, name: str) -> tuple[Path, ...]:
    """Return the videos of a name, or folders of their frames."""
    files = [path for path in folder.glob(f"{name}.avi") if path.is_file()]
    return tuple(sorted(files or [path for path in folder.glob(name) if path.is_dir()]))


def _numbers(path: Path, count: int) -> list[float]:
    text = read_text(path, f"{count} numbers")
    with reading(path, f"{count} numbers"):
        values = [float(word) for word in text.split()]
    if len(values) != count or not (np.abs(values) < _FAR).all():
        raise FileFormatError(
            f"{path}: expected {count} finite numbers, got {len(values)} (none may be above {_FAR:g})"
        )
    return values


# --- one clock for all streams --------------------------------------------------------------------


def _offsets(folder: Path, name: str) -> dict[str, StreamOffset]:
    paths = {camera: folder / f"{name}_({camera}).ofs" for camera in _ALL_CAMERAS}
    return {c: read_stream_offset(path) for c, path in paths.items() if path.is_file()}


def _common_clock(offsets: Mapping[str, StreamOffset]) -> tuple[StreamOffset, dict[str, int]]:
    """Return the mocap frame of frame one of the trial, and the image (from zero) that each camera then has.

    As the data set's own tools do it: frame one is the earliest image that any camera has; the scale
    is the mean of all; where it lies before the motion capture, all start with that.
    """
    if not offsets:
        return StreamOffset(1.0, 1.0, 120.0 / FPS), {}
    first = next(iter(offsets.values()))
    starts = {c: o.video + (first.mocap - o.mocap) / o.scale for c, o in offsets.items()}
    scale = sum(o.scale for o in offsets.values()) / len(offsets)
    earliest = min(starts.values())
    mocap = first.mocap - scale * (earliest - 1)
    images = {c: start - earliest + 1 for c, start in starts.items()}
    if mocap < 1:
        images = {c: image - (mocap - 1) / scale for c, image in images.items()}
        mocap = 1.0
    return StreamOffset(1.0, mocap, scale), {c: round(i) - 1 for c, i in images.items()}


def _interpolated(joints: Float[np.ndarray, "S 15 3"], clock: StreamOffset) -> np.ndarray:
    """Return the joints at the frames of the videos, linear between those of the motion capture."""
    last = len(joints) - 1
    count = int(np.floor((last - (clock.mocap - 1)) / clock.scale + 1e-9)) + 1
    if count < 1:
        raise InputError(
            f"the videos start {clock.mocap - 1 - last:.0f} frames after the motion capture ends"
        )
    place = clock.mocap - 1 + clock.scale * np.arange(count)
    low = np.minimum(np.floor(place).astype(int), last)
    high = np.minimum(low + 1, last)
    share = (place - low)[:, None, None]
    exact = share == 0
    return np.where(exact, joints[low], (1 - share) * joints[low] + share * joints[high])


# --- motion capture -------------------------------------------------------------------------------


def _points(folder: Path, name: str) -> dict[str, np.ndarray]:
    """Return the points [S, 3] by label, mm, NaN where they were lost: the .c3d, else the .mat."""
    c3d, mat = folder / f"{name}.c3d", folder / f"{name}.mat"
    if c3d.is_file():
        found = read_c3d_points(c3d)
        return _by_label(found.labels, found.points)
    if mat.is_file():
        return _points_of_mat(mat)
    raise InputError(f"{folder}: expected {name}.c3d or {name}.mat, found neither")


def _by_label(labels: Sequence[str], points: np.ndarray) -> dict[str, np.ndarray]:
    points = np.where((points == 0).all(-1, keepdims=True), np.nan, points)
    names = [re.sub(r"^.*:", "", str(label)).strip() for label in labels]
    found: dict[str, np.ndarray] = {}
    for i, label in enumerate(names):
        found.setdefault(label, points[:, i].astype(np.float64))
    return found


def _points_of_mat(path: Path) -> dict[str, np.ndarray]:
    """Return the markers in a .mat file of the data set's tools: Markers [S, N, 3], ParameterGroup."""
    try:
        from scipy.io import loadmat
    except ImportError as error:
        raise MissingDependencyError(
            f"{path}: reading .mat files needs SciPy; install it, or give the .c3d file"
        ) from error
    try:
        content = loadmat(str(path), simplify_cells=True)
        groups = {str(g["name"]): g for g in np.atleast_1d(content["ParameterGroup"]).tolist()}
        parameters = np.atleast_1d(groups["POINT"]["Parameter"]).tolist()
        labels = next(p["data"] for p in parameters if str(p["name"]) == "LABELS")
        return _by_label([str(label) for label in labels], np.asarray(content["Markers"], float))
    except Exception as error:  # a damaged file makes the library raise anything
        raise FileFormatError(
            f"{path}: expected Markers and ParameterGroup with POINT LABELS ({error})"
        ) from error


def _measures(folder: Path, person: str) -> tuple[dict[str, float], list[str]]:
    """Return half the shoulders' width and the shoulder offsets of a person (mm), and what is missing."""
    measures: dict[str, float] = {}
    notes = []
    static = folder / "Static.c3d"
    if static.is_file():
        found = read_c3d_points(static)
        points = _by_label(found.labels, found.points)
        if {"LSHO", "RSHO"} <= points.keys():
            width = np.nanmean(np.linalg.norm(points["LSHO"] - points["RSHO"], axis=-1))
            measures["shoulders"] = float(width) / 2 - _HALF_MARKER
    if "shoulders" not in measures:
        notes.append("no Static.c3d: the torso's upper end is not corrected for its depth")
    path = folder / f"{person}.mp"
    text = ""
    if path.is_file():
        with reading(path, "numbers of a person"):
            text = path.read_text(encoding="utf-8", errors="replace")
    for key in SHOULDER_OFFSETS:
        match = re.search(rf"\$\S*{key}\s*=\s*([-+.\deE]+)", text)
        if match:
            with reading(path, f"a number of {key}"):
                measures[key] = float(match[1])
        else:
            notes.append(f"no {key} in {path.name}: that upper arm is not corrected for it")
    return measures, notes
