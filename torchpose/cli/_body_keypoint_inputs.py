"""Read the keypoints of a body in calibrated cameras: from files, or by a detector in videos."""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from torchpose._core.terminal import show_progress
from torchpose._core.wording import counted, numbered_frames
from torchpose.cli._track import OTHER_TABLES, is_video
from torchpose.errors import FileFormatError, InputError, NobodySeenError, SkeletonError
from torchpose.skeleton._mediapipe_landmarks import count_given

if TYPE_CHECKING:
    from torchpose.camera._pinhole import PinholeCamera
    from torchpose.measure._keypoint_measurer import FrameKeypoints, KeypointMeasurer
    from torchpose.video._source_interface import VideoSource

_FPS = 30.0
_DIFFERENT = 0.1  # share of frames by which inputs of one rate hardly differ
_SAME_RATE = 3  # digits


class DetectorSettings(NamedTuple):
    """Holds what finds keypoints in videos.

    Attributes:
        where: file of a model, or package:factory. min_confidence: of a keypoint, None for the usual one.
    """

    where: str
    min_confidence: float | None


class CameraKeypoints(NamedTuple):
    """Holds the keypoints of one camera, of D detections: of everybody, or of one who is followed.

    Attributes:
        points: of the joints of `BODY_15` [T, D, 15, 2], pixels, NaN where missing; if the input has feet
            [T, D, 21, 2], followed by those of `FEET`.
        confidence: [T, D, 15] or [T, D, 21].
        fps, size: of the images, (width, height), None if unknown. notes: of the reader.
        n_people: how many people the frames show [T], where one of them is followed.
        first: the number that the input gives to the first frame; None if it numbers none.
        first_time: seconds, the time that it gives to the first frame in place of a number, if it does.
    """

    points: Tensor
    confidence: Tensor
    fps: float | None
    size: tuple[int, int] | None
    notes: tuple[str, ...] = ()
    n_people: Tensor | None = None
    first: int | None = None
    first_time: float | None = None

    def after(self, n_frames: int) -> "CameraKeypoints":
        """Return the keypoints after some frames without any."""
        if not n_frames:
            return self
        points, confidence = (
            torch.cat([value.new_full((n_frames, *value.shape[1:]), missing), value])
            for value, missing in ((self.points, torch.nan), (self.confidence, 0.0))
        )
        n_people = self.n_people
        if n_people is not None:
            n_people = torch.cat([n_people.new_zeros(n_frames), n_people])
        return self._replace(points=points, confidence=confidence, n_people=n_people)


class BodyKeypoints(NamedTuple):
    """Holds the keypoints of all cameras, in step.

    Attributes:
        points: of the joints of `BODY_15` [T, C, 15, 2], pixels, NaN where missing, if an input has feet
            [T, C, 21, 2], followed by those of `FEET`; of everybody [T, C, D, ..., 2], of D detections in any
            order.
        confidence: as points, without pixels. cameras: for the images in which the keypoints are.
        fps: frames per second. notes: on what was assumed.
        lengths: how many frames the input of each camera has, None if it holds nobody.
    """

    points: Tensor
    confidence: Tensor
    cameras: "list[PinholeCamera]"
    fps: float
    notes: tuple[str, ...]
    lengths: tuple[int | None, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the keypoints."""
        from torchpose.body._feet import FEET
        from torchpose.body._skeleton import BODY_15

        return (*BODY_15.names, *FEET)[: self.points.shape[-2]]


def are_keypoints(inputs: Sequence[str], detector: str | None) -> bool:
    """Return whether a body is tracked by keypoints: those of files, or of a detector.

    Raises:
        FileFormatError: a file of data that is no keypoints.
        InputError: a camera, an input that is not there, an empty folder beside videos or nothing else,
            keypoints beside videos without a detector, or a detector without videos.
    """
    from torchpose.video._source import is_camera

    for number in filter(is_camera, inputs):
        raise InputError(
            f"{number} is taken for a camera: expected recordings, which are read more than once; record "
            "it to a file first"
        )
    for path in map(Path, inputs):
        if path.suffix.lower() in OTHER_TABLES and path.exists():
            raise FileFormatError(
                f"{path}: expected keypoints of one camera as .npz, .csv or a folder of OpenPose JSON files, "
                f"one per frame, got {path.suffix}"
            )
    empty = [path for path in inputs if Path(path).is_dir() and not any(Path(path).iterdir())]
    videos = [path for path in inputs if is_video(path) and path not in empty]
    if empty and (videos or len(empty) == len(inputs)):
        raise InputError(
            f"{empty[0]}: expected OpenPose JSON files or images, but the folder is empty"
        )
    if detector is not None and not videos:
        raise InputError("--detector finds keypoints in videos, and all inputs are keypoints")
    if detector is None and 0 < len(videos) < len(inputs):
        missing = "" if Path(videos[0]).exists() else ", and is not there"
        raise InputError(
            f"{videos[0]} is taken for a video{missing}, and others for keypoints; --detector finds the "
            "keypoints in videos"
        )
    return detector is not None or not videos


def read_body_keypoints(
    inputs: Sequence[str],
    cameras: "Sequence[PinholeCamera]",
    *,
    detector: DetectorSettings | None = None,
    fps: float | None = None,
    delays: Sequence[int] | None = None,
    other_rates: Sequence[float] = (),
    everybody: bool = False,
) -> BodyKeypoints:
    """Read the keypoints of all cameras and bring them in step.

    Args:
        inputs: for each camera a file or folder of keypoints, or with a detector a video.
        cameras: calibrated, in the same order. detector: of the keypoints in videos.
        fps: of all inputs. delays: frames by which each began too early.
        other_rates: of videos of the same recording, which count where no input states a rate.
        everybody: take all people of every frame, and not one who is followed.

    Raises:
        InputError, FileFormatError, SkeletonError: inputs that cannot be read, different frame rates, an
            input of two cameras. NobodySeenError: no input has a keypoint.
        CameraError: images of another shape than the camera's.
    """
    from torchpose.camera._choice import fit_to_size

    _refuse_twice([Path(path).resolve() for path in inputs], inputs)
    found, blind = _read_all(inputs, cameras, detector, fps, everybody)
    seeing, parts = list(found), list(found.values())
    used, delays = [inputs[c] for c in seeing], [(delays or [0] * len(inputs))[c] for c in seeing]
    _refuse_twice([_contents(part) for part in parts], used)
    fitted, sizes = list(cameras), list[str]()
    for c, part in found.items():
        fitted[c], said = fit_to_size(cameras[c], part.size, inputs[c])
        sizes += said
    rates = [part.fps for part in parts if part.fps is not None] or list(other_rates)
    rate, notes = common_rate(rates, fps)
    lengths = tuple(len(found[c].points) if c in found else None for c in range(len(inputs)))
    parts, numbered = _in_time(parts, used)
    points, confidence, more = _in_step(parts, delays, used)
    notes += numbered + more + tuple(sizes) + blind
    notes += tuple(
        f"{path}: {n}" for path, part in zip(used, parts, strict=True) for n in part.notes
    )
    notes += tuple(_crowd_notes(parts, [cameras[c] for c in seeing]))
    points = _of_all(points, seeing, len(cameras), torch.nan)
    confidence = _of_all(confidence, seeing, len(cameras), 0.0)
    if not everybody:
        points, confidence = points[:, :, 0], confidence[:, :, 0]
    return BodyKeypoints(points, confidence, fitted, rate, notes, lengths)


def _read_all(
    inputs: Sequence[str],
    cameras: "Sequence[PinholeCamera]",
    detector: DetectorSettings | None,
    fps: float | None,
    everybody: bool,
) -> tuple[dict[int, CameraKeypoints], tuple[str, ...]]:
    """Return the keypoints of the cameras that have some, by their places, and notes on the others.

    Raises:
        NobodySeenError: no camera has one.
    """
    found: dict[int, CameraKeypoints] = {}
    notes: list[str] = []
    for c, (path, camera) in enumerate(zip(inputs, cameras, strict=True)):
        try:
            found[c] = _read(path, detector, fps, everybody, camera.image_size)
        except NobodySeenError as error:
            if len(notes) + 1 == len(inputs):
                raise
            notes.append(f"camera {camera.name} is not used: {error}")
    return found, tuple(notes)


def _of_all(values: Tensor, places: Sequence[int], count: int, missing: float) -> Tensor:
    """Return values [T, S, ...] of some cameras as those of all [T, C, ...]."""
    every = values.new_full((len(values), count, *values.shape[2:]), missing)
    every[:, list(places)] = values
    return every


def _refuse_twice(values: Sequence[object], inputs: Sequence[str]) -> None:
    """Raise `InputError` where two inputs are the same one, as their values tell."""
    for i, value in enumerate(values):
        if value is not None and value in values[:i]:
            raise InputError(
                f"{inputs[values.index(value)]} and {inputs[i]} hold the same keypoints, which two cameras "
                "cannot see; give each camera its own"
            )


def _contents(part: CameraKeypoints) -> bytes | None:
    """Return the keypoints of a camera, to be compared; None if a detector found nobody."""
    return part.points.numpy().tobytes() if bool((part.confidence > 0).any()) else None


def _crowd_notes(
    parts: Sequence[CameraKeypoints], cameras: "Sequence[PinholeCamera]"
) -> Iterator[str]:
    """Say in which cameras several people stand, of whom one is followed."""
    from torchpose.io._keypoints import said_of_crowd

    for part, camera in zip(parts, cameras, strict=True):
        if crowd := said_of_crowd(part.n_people, part.points[:, 0]):
            yield f"camera {camera.name}: {crowd}, and --persons all tracks everybody"


def common_rate(rates: Sequence[float], given: float | None) -> tuple[float, tuple[str, ...]]:
    """Return the frame rate of all inputs, and a note where it is not what they say.

    Raises:
        InputError: different rates, and none given.
    """
    known = sorted({round(rate, _SAME_RATE) for rate in rates})
    said = ", ".join(f"{rate:g}" for rate in known)
    if given is not None:
        other = any(abs(rate - given) > 10**-_SAME_RATE for rate in known)
        return given, (f"inputs of {said} fps are taken at the given {given:g} fps",) * other
    if len(known) > 1:
        raise InputError(
            f"the inputs must have one frame rate, got {said} fps; bring them to one rate, or give that "
            "of all by --fps"
        )
    if not known:
        return _FPS, (f"no input states a frame rate: {_FPS:g} fps assumed, --fps says another",)
    return rates[0], ()


def _in_time(
    parts: list[CameraKeypoints], inputs: Sequence[str]
) -> tuple[list[CameraKeypoints], tuple[str, ...]]:
    """Return the keypoints with frames of one number, or of one time, side by side, and a note on that.

    Numbers, and times, count where all inputs are of one kind and have most of them in common: another kind
    of file, or another cut of a video, may count from elsewhere.
    """
    firsts, what, shown = _first_frames(parts)
    begin = min(firsts)
    if len(set(firsts)) == 1:
        return parts, (f"frame 0 is number {begin} of the files",) * (begin > 0)
    said = f"the first frames of the inputs have the {what} {shown}"
    one_kind = len({Path(path).suffix.lower() for path in inputs}) == 1
    lengths = [len(part.points) for part in parts]
    shared = min(map(sum, zip(firsts, lengths, strict=True))) - max(firsts)
    if not one_kind or 2 * shared < min(lengths):
        return parts, (f"{said}; they are taken as simultaneous",)
    moved = [part.after(first - begin) for part, first in zip(parts, firsts, strict=True)]
    counted = f", frame 0 is number {begin}" if begin else ""
    return moved, (f"{said}; frames of one {what[:-1]} are taken as simultaneous{counted}",)


def _first_frames(parts: Sequence[CameraKeypoints]) -> tuple[list[int], str, str]:
    """Return the numbers of the first frames, what they are of, and that in words.

    Where all inputs have times in place of numbers, frames are counted from the earliest time.
    """
    times = [(p.first_time, p.fps) for p in parts if p.first_time is not None and p.fps is not None]
    if len(times) < len(parts):
        firsts = [part.first or 0 for part in parts]
        return firsts, "numbers", ", ".join(map(str, firsts))
    begin = min(time for time, _ in times)
    firsts = [round(fps * (time - begin)) for time, fps in times]
    return firsts, "times", ", ".join(f"{time:.12g} s" for time, _ in times)


def _in_step(
    parts: Sequence[CameraKeypoints], delays: Sequence[int], inputs: Sequence[str]
) -> tuple[Tensor, Tensor, tuple[str, ...]]:
    """Return keypoints and confidence of the frames that all cameras have, and a note on the others."""
    lengths = [len(part.points) - delay for part, delay in zip(parts, delays, strict=True)]
    if min(delays) < 0 or min(lengths) < 1:
        worst = lengths.index(min(lengths)) if min(delays) >= 0 else delays.index(min(delays))
        raise InputError(
            f"--delays must be from 0 to below the number of frames, got {delays[worst]} for "
            f"{inputs[worst]}, which has {len(parts[worst].points)}"
        )
    n = min(lengths)
    rows = [slice(delay, delay + n) for delay in delays]
    most, joints = (max(part.points.shape[axis] for part in parts) for axis in (1, 2))
    points = torch.stack(
        [_padded(p.points[r], most, joints, torch.nan) for p, r in zip(parts, rows, strict=True)], 1
    )
    confidence = torch.stack(
        [_padded(p.confidence[r], most, joints, 0.0) for p, r in zip(parts, rows, strict=True)], 1
    )
    shown = ", ".join(map(str, lengths))
    note = f"the inputs have {shown} frames; the first {n} of each are used"
    if n < (1 - _DIFFERENT) * max(lengths):
        note += "; if they show the same time, their frame rates differ: bring them to one rate"
    return points, confidence, (note,) * (len(set(lengths)) > 1)


def _padded(values: Tensor, most: int, joints: int, missing: float) -> Tensor:
    """Return values [T, D, J, ...] with more detections and joints, which are missing."""
    frames, _, _, *rest = values.shape
    padded = values.new_full((frames, most, joints, *rest), missing)
    padded[:, : values.shape[1], : values.shape[2]] = values
    return padded


# --- one camera -----------------------------------------------------------------------------------


def _read(
    path: str,
    detector: DetectorSettings | None,
    fps: float | None,
    everybody: bool,
    size: tuple[int, int] | None,
) -> CameraKeypoints:
    """Read one camera, whose images were calibrated with a size."""
    if detector is not None and is_video(path):
        return _detect(path, detector, fps, everybody)
    from torchpose.io._formats.openpose import read_openpose_people
    from torchpose.io._keypoints import in_pixels, is_filled, read_keypoints

    if everybody and Path(path).is_dir():
        people = read_openpose_people(path)
        missing = is_filled(people.keypoints) | ~(people.confidence > 0)
        table, notes = in_pixels(Path(path), people.keypoints, missing, size)
        trust = torch.from_numpy(people.confidence).masked_fill(torch.from_numpy(missing), 0.0)
        points, confidence, cut = _of_body(path, torch.from_numpy(table), trust, people.names, size)
        notes = (*people.notes, *notes, *cut)
        return CameraKeypoints(points, confidence, None, None, notes, first=people.first)
    found = read_keypoints(path, size)
    points, confidence, cut = _of_body(
        path, found.keypoints, found.confidence, found.names, found.image_size or size
    )
    derived = count_given(found.names) < len(found.names)  # joints that are not used here
    notes = (*(found.notes[:-1] if derived else found.notes), *cut)
    return CameraKeypoints(
        points[:, None], confidence[:, None], found.fps, found.image_size, notes, found.n_people,
        found.first_frame, found.first_time,
    )  # fmt: skip


def _of_body(
    source: str,
    points: Tensor,
    confidence: Tensor | None,
    names: Sequence[str],
    size: tuple[int, int] | None,
) -> tuple[Tensor, Tensor, tuple[str, ...]]:
    """Return keypoints [..., 15, 2] and confidence [..., 15] of `BODY_15`'s joints, and of feet, and notes.

    Heads and necks that were put where the prior of the upper body has them are none of this body.

    Args:
        size: of the images, (width, height), None if it is not known.
    """
    from torchpose.body._feet import foot_points
    from torchpose.body._skeleton import body_joints
    from torchpose.io._keypoints import is_on_border

    given = count_given(names)
    points = points[..., :given, :]
    there = torch.isfinite(points).all(-1)
    trust = there.to(points) if confidence is None else confidence[..., :given].to(points)
    there &= trust > 0
    cut = there & is_on_border(points, points.new_tensor(size or (math.inf, math.inf)))
    table = torch.cat([points, trust[..., None]], -1)
    table = table.masked_fill(~(there & ~cut)[..., None], torch.nan)
    try:
        joints = body_joints(table, names[:given])
    except SkeletonError as error:
        raise SkeletonError(f"{source}: {error}") from error
    feet = foot_points(table, names[:given])
    if feet is not None and bool(feet.isfinite().any()):
        joints = torch.cat([joints, feet], -2)
    return joints[..., :2], joints[..., 2].nan_to_num(0.0), _note_on_border(int(cut.sum()))


def _note_on_border(count: int) -> tuple[str, ...]:
    """Return a note on keypoints on the border of the image, if there are some."""
    return (
        f"{counted(count, 'keypoint')} on the border of the image count{'s' * (count == 1)} as missing: "
        "detectors put there what is beyond it",
    ) * (count > 0)


def _detect(
    path: str, settings: DetectorSettings, fps: float | None, everybody: bool
) -> CameraKeypoints:
    """Find the keypoints in a video, of everybody or of the person whom most frames show."""
    from torchpose.video._source import open_video

    with open_video(path, fps=fps) as source:
        measurer = _measurer(settings, source.fps)
        frames = list(_measured(measurer, source))
        notes = _note_on_cuts(frames)
        if not everybody:
            person, others = _most_seen(frames)
            notes += others
            frames = [_of_person(frame, person) for frame in frames]
        points, confidence = _table(frames, len(measurer.names))
        points, confidence, cut = _of_body(
            settings.where, points, confidence, measurer.names, source.size
        )
        notes = (*source.notes, *notes, *cut)
        return CameraKeypoints(points, confidence, source.fps, source.size, notes)


def _note_on_cuts(frames: "Sequence[FrameKeypoints]") -> tuple[str, ...]:
    cuts = [t for t, frame in enumerate(frames) if frame.cut]
    if not cuts:
        return ()
    return (
        f"the video cuts to another scene at {numbered_frames(cuts)}, and bodies are tracked on: split it "
        "there",
    )


def _of_person(frame: "FrameKeypoints", person: int) -> "FrameKeypoints":
    rows = frame.person == person
    return frame._replace(
        person=frame.person[rows],
        keypoints=frame.keypoints[rows],
        confidence=frame.confidence[rows],
        sizes=frame.sizes[rows],
        absent=frame.absent[rows],
    )


def _table(frames: "Sequence[FrameKeypoints]", n_joints: int) -> tuple[Tensor, Tensor]:
    """Return keypoints [T, D, J, 2] and confidence [T, D, J] of the detections of all frames."""
    most = max([1, *(len(frame.person) for frame in frames)])
    points = torch.full((len(frames), most, n_joints, 2), torch.nan, dtype=torch.float64)
    confidence = torch.zeros(points.shape[:3], dtype=torch.float64)
    for t, frame in enumerate(frames):
        n = len(frame.person)
        points[t, :n], confidence[t, :n] = frame.keypoints, frame.confidence
    return points, confidence


def _measurer(settings: DetectorSettings, fps: float) -> "KeypointMeasurer":
    from torchpose.measure._detectors.load import load_detector
    from torchpose.measure._keypoint_measurer import LEAST_CONFIDENCE, KeypointMeasurer

    least = LEAST_CONFIDENCE if settings.min_confidence is None else settings.min_confidence
    found = load_detector(settings.where, fps)
    return KeypointMeasurer(found, fps, min_confidence=least, name=settings.where)


def _measured(measurer: "KeypointMeasurer", source: "VideoSource") -> "Iterator[FrameKeypoints]":
    from tqdm.auto import tqdm

    bar: Any = tqdm(source, total=source.n_frames, disable=not show_progress(), unit="frame",
                    desc=f"keypoints of {Path(source.name).name}")  # fmt: skip
    state = measurer.init()
    for frame in bar:
        state, found = measurer.step(state, frame.image)
        yield found


def _most_seen(frames: "Sequence[FrameKeypoints]") -> tuple[int, tuple[str, ...]]:
    """Return the number of the person in most frames, -1 if there is none, and a note on others."""
    seen = Counter(number for frame in frames for number in frame.person.tolist())
    if not seen:
        return -1, ("the detector found nobody",)
    person, count = seen.most_common(1)[0]
    note = (
        f"of {len(seen)} persons the one in most frames ({count} of {len(frames)}) is tracked; --persons all "
        "tracks everybody"
    )
    return person, (note,) * (len(seen) > 1)
