"""Read OpenPose output: a folder with one `*_keypoints.json` per frame.

Other programs write the same files with the joint sets of their detectors, as Pose2Sim does under the names
`cam01_000031.json` and `cam01.0031.json`. How many keypoints a person has tells the set.

Of several people one is followed, the one of largest mean confidence in the first frame with people
(`torchpose.io._formats.followed_person`). An empty list of people is a frame without measurements.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchpose._core.checks import MOST_CONFIDENCE
from torchpose._core.reading import check_span, read_json, reading
from torchpose._core.wording import counted
from torchpose.errors import FileFormatError, InputError, NobodySeenError
from torchpose.io._formats.followed_person import follow_person
from torchpose.skeleton._joint_sets import COCO, HALPE, SKELETONS, WHOLE_BODY
from torchpose.skeleton._mediapipe_landmarks import LANDMARKS

_SUFFIX = "_keypoints.json"
_NAMES = f"*{_SUFFIX}, or *.json whose names end with the number of the frame"
_LAYOUTS = {  # what is taken of everybody's keypoints, by how many there are
    25: SKELETONS["openpose-25"].joints, 18: SKELETONS["openpose-18"].joints, 17: COCO,
    26: tuple(HALPE), 33: LANDMARKS, 133: WHOLE_BODY,
}  # fmt: skip
_PLACES = {26: list(HALPE.values())}  # of others the first ones are taken
_KNOWN = (
    "25 keypoints (BODY_25 or BODY_25B), 18 or 17 (COCO with and without a neck), 26 (Halpe), 33 (MediaPipe) "
    "or 133 (COCO-WholeBody)"
)
_BODY_25B = (
    "Nose", "LEye", "REye", "LEar", "REar", "LShoulder", "RShoulder", "LElbow", "RElbow", "LWrist", "RWrist",
    "LHip", "RHip", "LKnee", "RKnee", "LAnkle", "RAnkle", "Neck", "Head", "LBigToe", "LSmallToe", "LHeel",
    "RBigToe", "RSmallToe", "RHeel",
)  # fmt: skip
_MIDDLES = {"Neck": "Shoulder", "MidHip": "Hip"}  # of BODY_25
_OFF_MIDDLE = 0.08  # of a person's extent; a detector is off by a tenth of it
_EXPECTED = "OpenPose's JSON with people / pose_keypoints_2d"
_FAR = 1e9  # pixels; no keypoint is there
_BEGINNING = 4096  # bytes of a file, among which its people begin


class OpenPosePerson(NamedTuple):
    """Holds the keypoints of one person who was followed.

    Attributes:
        keypoints: [T, J, 2], pixels, NaN where missing. confidence: [T, J].
        names: of what is taken of the joint set that the files hold.
        n_people: how many people are in each frame [T]. first: number of the first file.
        notes: on confidences of another scale.
    """

    keypoints: np.ndarray
    confidence: np.ndarray
    names: tuple[str, ...]
    n_people: np.ndarray
    first: int
    notes: tuple[str, ...]


class OpenPosePeople(NamedTuple):
    """Holds the keypoints of everybody.

    Attributes:
        keypoints: [T, D, J, 2] of the up to D people of each frame, in the order of the file, NaN where
            there are fewer. confidence: [T, D, J]. names: as of one person. first: number of the first file.
        notes: as of one person.
    """

    keypoints: np.ndarray
    confidence: np.ndarray
    names: tuple[str, ...]
    first: int
    notes: tuple[str, ...]


def read_openpose(folder: str | Path) -> OpenPosePerson:
    """Read a folder of OpenPose JSON files, and follow one person.

    The number in front of ``_keypoints.json``, or of ``.json``, is the frame; frames without a file are
    missing.

    Args:
        folder: the folder.

    Returns:
        `OpenPosePerson`. BODY_25B has as many keypoints as BODY_25 in another order; where the necks and
        hips are tells which it is. Of Halpe's 26 and the 133 of COCO-WholeBody the 17 of COCO and the feet
        are taken.

    Raises:
        InputError: no such files. NobodySeenError: nobody in any of them. FileFormatError: not OpenPose's
            JSON, or another number of keypoints; the file is named.
    """
    frames, names, first, notes = _read_frames(folder)
    table = follow_person(frames, len(names))
    n_people = np.array([len(group) for group in frames])
    return OpenPosePerson(*_measured(table), names, n_people, first, notes)


def read_openpose_people(folder: str | Path) -> OpenPosePeople:
    """Read the keypoints of everybody in a folder of OpenPose JSON files.

    Args:
        folder: the folder.

    Returns:
        `OpenPosePeople`. An index says nothing about who it is.

    Raises:
        InputError, NobodySeenError, FileFormatError: as `read_openpose`.
    """
    frames, names, first, notes = _read_frames(folder)
    table = np.zeros((len(frames), max(map(len, frames)), len(names), 3))
    for row, group in enumerate(frames):
        if group:
            table[row, : len(group)] = np.stack(group)
    return OpenPosePeople(*_measured(table), names, first, notes)


def holds_openpose(folder: Path) -> bool:
    """Return whether a folder holds OpenPose's files, and not those of Azure Kinect, by names and people."""
    files = openpose_files(folder)
    if not files or files[0].name.endswith(_SUFFIX):
        return bool(files)
    with reading(files[0], _EXPECTED), files[0].open("rb") as stream:
        return b'"people"' in stream.read(_BEGINNING)


def _read_frames(
    folder: str | Path,
) -> tuple[list[list[np.ndarray]], tuple[str, ...], int, tuple[str, ...]]:
    """Return the keypoints [J, 3] of the people of every frame, the J names, the first number, and notes."""
    files = _files_by_frame(Path(folder))
    people = {frame: _people(path) for frame, path in files.items()}
    everybody = [person for group in people.values() for person in group]
    names = _layout(folder, everybody, len(files))
    first = min(files)
    places = _PLACES.get(len(everybody[0]), list(range(len(names))))
    taken = {frame: [one[places] for one in group] for frame, group in people.items()}
    frames = [taken.get(frame, []) for frame in range(first, max(files) + 1)]
    return frames, names, first, _notes_on_confidence(everybody)


def _notes_on_confidence(everybody: Sequence[np.ndarray]) -> tuple[str, ...]:
    """Return a note if confidences [J, 3] are scores of a scale on which nearly all of them count as 1."""
    most = max(float(person[:, 2].max()) for person in everybody)
    if most <= MOST_CONFIDENCE:
        return ()
    return (
        f"confidences of up to {most:.3g} are no probabilities: those above 1 count as 1, and the others as "
        "they are, so doubtful keypoints may count as sure ones; write probabilities from 0 to 1",
    )


def _layout(folder: str | Path, everybody: Sequence[np.ndarray], n_frames: int) -> tuple[str, ...]:
    """Return the names of the keypoints."""
    sizes = {len(person) for person in everybody}
    if not sizes:
        raise NobodySeenError(
            f"{folder}: nobody was found in any of {counted(n_frames, 'frame')}; look at what "
            "the detector wrote"
        )
    if len(sizes) > 1 or sizes.isdisjoint(_LAYOUTS):
        raise FileFormatError(
            f"{folder}: expected {_KNOWN} for everybody, got {', '.join(map(str, sorted(sizes)))}"
        )
    stacked = np.stack(everybody)
    return _BODY_25B if _is_body_25b(stacked) else _LAYOUTS[stacked.shape[1]]


def _measured(table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return keypoints [..., 2], NaN where missing, and confidence [...] of a table [..., 3]."""
    confidence = table[..., 2].clip(max=1.0)  # a peak of the heat map, which may exceed 1
    return np.where(confidence[..., None] > 0, table[..., :2], np.nan), confidence


def _files_by_frame(folder: Path) -> dict[int, Path]:
    with reading(folder, "a folder"):
        files = openpose_files(folder)
    if not files:
        if not any(folder.iterdir()):
            raise NobodySeenError(
                f"{folder}: the folder is empty; expected OpenPose files {_NAMES}"
            )
        raise InputError(f"{folder}: expected OpenPose files {_NAMES}, found none")
    found = [
        re.search(r"(\d+)$", path.name.removesuffix(_SUFFIX).removesuffix(".json"))
        for path in files
    ]
    numbers = [int(match.group(1)) for match in found if match is not None]
    if len(numbers) < len(files):  # names without numbers: their order is all there is
        return dict(enumerate(files))
    if len(set(numbers)) < len(files):
        raise FileFormatError(f"{folder}: two files have one frame number; expected one video")
    check_span(folder, max(numbers) - min(numbers) + 1, len(numbers))
    return dict(zip(numbers, files, strict=True))


def openpose_files(folder: Path) -> list[Path]:
    """Return the files of frames: those with OpenPose's names, else those with a number at the end."""
    files = sorted(folder.glob(f"*{_SUFFIX}"))
    return files or [path for path in sorted(folder.glob("*.json")) if path.stem[-1:].isdecimal()]


def _people(path: Path) -> list[np.ndarray]:
    """Return the keypoints [J, 3] (u, v, confidence) of everybody in one file, without empty ones."""
    content = read_json(path, _EXPECTED)
    with reading(path, _EXPECTED):
        listed = content["people"]
        flat = [p["pose_keypoints_2d"] if "pose_keypoints_2d" in p else p["pose_keypoints"]
                for p in listed]  # fmt: skip
        arrays = [np.asarray(values, dtype=np.float64) for values in flat]
    people = []
    for array in arrays:
        known = array[~np.isnan(array)]
        if array.ndim != 1 or array.size % 3 or not (np.abs(known) < _FAR).all():
            most = np.abs(known).max(initial=0.0)
            raise FileFormatError(
                f"{path}: pose_keypoints_2d must be x, y, confidence of each keypoint, below {_FAR:g}; "
                f"got {array.size} values up to {most:g}"
            )
        person = array.reshape(-1, 3)
        person[np.isnan(person).any(-1)] = 0.0  # Pose2Sim writes NaN for somebody who is not there
        if (person[:, 2] > 0).any():
            people.append(person)
    return people


def _is_body_25b(people: np.ndarray) -> bool:
    """Return whether keypoints [P, 25, 3] are in the order of BODY_25B.

    BODY_25 has its neck in the middle of the shoulders and a middle of the hips. In the other order what has
    these places is scattered over the body, or missing in a view from behind. Noise is a large share of an
    upper body alone, so the other order has to fit better, too.
    """
    if people.shape[1] != len(_BODY_25B):
        return False
    pixels = np.where(people[..., 2:] > 0, people[..., :2], np.nan)
    off = [_off_middle(pixels, _LAYOUTS[25], *pair) for pair in _MIDDLES.items()]
    known = [value for value in off if value is not None]
    other = _off_middle(pixels, _BODY_25B, "Neck", "Shoulder")
    if known:
        away = float(np.mean(known))
        return away > _OFF_MIDDLE and (other is None or other < away)
    return other is not None and other < _OFF_MIDDLE


def _off_middle(
    pixels: np.ndarray, names: tuple[str, ...], centre: str, joint: str
) -> float | None:
    """Return the median distance of a joint from a middle over the person's extent, None if unknown."""
    left, right, middle = (
        pixels[:, names.index(name)] for name in (f"L{joint}", f"R{joint}", centre)
    )
    away = np.linalg.norm(middle - (left + right) / 2, axis=-1)
    known = np.isfinite(away)
    if not known.any():
        return None
    seen = pixels[known]
    extent = (np.nanmax(seen, 1) - np.nanmin(seen, 1)).max(-1)
    return float(np.median(away[known] / np.maximum(extent, 1e-9)))
