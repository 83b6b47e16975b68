"""Track the poses of all persons in a video."""

import math
import sys
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from numbers import Integral
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Unpack

import numpy as np
import torch
from torch import Tensor, nn
from tqdm.auto import tqdm

from torchpose._core.checks import check_rgb, check_tracked_rate, number_of
from torchpose._core.images import Image
from torchpose._core.module_state import derived
from torchpose._core.uncompiled import uncompiled
from torchpose.camera._pinhole import PinholeCamera
from torchpose.errors import InputError
from torchpose.measure._association import HandAssociation
from torchpose.measure._detectors.load import check_detector, load_detector
from torchpose.measure._detectors.protocol import KeypointDetector
from torchpose.measure._face_detector import FaceDetector
from torchpose.measure._head import HeadNeck
from torchpose.measure._keypoint_measurer import (
    LEAST_CONFIDENCE,
    KeypointMeasurer,
    KeypointState,
)
from torchpose.measure._upper_body_measurer import (
    HAND_TRACKERS,
    Candidates,
    MeasurerState,
    UpperBodyMeasurer,
)
from torchpose.priors._arms import shipped_arm_prior
from torchpose.priors._upper_body_prior import UpperBodyPrior
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.upper_body._estimator_table import BONES, method_options
from torchpose.upper_body._pose_track import PoseTrack
from torchpose.upper_body._tracker_options import MethodOptions, TrackerOptions
from torchpose.upper_body._upper_body_tracker import UpperBodyTracker
from torchpose.video._live_rate import LiveRate
from torchpose.video._measurers import (
    Found,
    MeasuredBlock,
    Measurer,
    SeenFrame,
    block_of,
    look_ahead,
    measure_blocks,
    measurer_of,
)
from torchpose.video._other_process import AHEAD, cores, look_ahead_elsewhere
from torchpose.video._person_stream import (
    Measured,
    PersonStream,
    PersonStreamState,
    TrackedBlock,
)
from torchpose.video._prefetch import prefetch
from torchpose.video._recording import TrackedPerson, TrackedRecording, with_note_on_cuts
from torchpose.video._source_interface import VideoFrame

Watcher = Callable[[Image, Found, dict[int, PoseTrack]], None]
"""Is called with a frame, its measurements, and the poses of the persons in it by number."""

_HANDS = [UPPER_BODY.index("hand_left"), UPPER_BODY.index("hand_right")]
_SAME_RATE = 0.01  # share by which the rate of a video may differ from that of the tracker
_BLOCK = 32  # frames of a recording that are filtered together
_LEAST_AHEAD, _WAITING = 4, 50_000_000  # frames that wait to be measured, and bytes of their images


class VideoState(NamedTuple):
    """Holds the state of `VideoTracker` between two frames.

    Attributes:
        measurer: the state of the measurer. streams: the states of the persons by number.
        poses: the last poses of the persons in `streams`, without those of filters that degenerated.
        n_frames: the number of frames so far. cuts: those of them that begin another scene.
        size: (width, height) of these frames; None before the first.
        rate: what the times of the last frames tell, where they have some.
    """

    measurer: MeasurerState | KeypointState
    streams: dict[int, PersonStreamState]
    poses: dict[int, PoseTrack]
    n_frames: int = 0
    cuts: tuple[int, ...] = ()
    size: tuple[int, int] | None = None
    rate: LiveRate = LiveRate()

    @property
    def notes(self) -> tuple[str, ...]:
        """Return what is wrong with the frames: they come at another rate than that of the tracker."""
        return (self.rate.note,) if self.rate.note else ()


class LivePerson(NamedTuple):
    """Holds a person in one frame.

    Attributes:
        number: the number of the person, in the order of appearance.
        pose: a track of one frame; `pose.failed` [1] says whether the filter degenerated, as in a
            `PoseTrack` and a `LivePose`. `pose.notes` name the frames that begin another scene, and say
            what `VideoState.notes` do.
        measured: the measurements in the frame.
    """

    number: int
    pose: PoseTrack
    measured: Measured


class VideoTracker(nn.Module):
    """Tracks all persons in a video: `UpperBodyMeasurer`, then an `UpperBodyTracker` for each person.

    With `detector` the keypoints of that take the place of what `UpperBodyMeasurer` measures; each person's
    are tracked with their confidences, as keypoints in files are. A detector may also be an object with the
    attribute `names`, of J keypoints, that is called with an RGB image [H, W, 3] and returns keypoints
    [N, J, 2], pixels, and confidence [N, J], 0 to 1, of N persons.

    `forward` tracks a recording, `init` and `step` a camera, `advance` some more frames of either. A frame
    passes three stages, each of which takes and returns values: `Measurer.look` sees what images alone tell,
    `Measurer.step` measures the persons, and `PersonStream.advance_all` turns the measurements into poses
    by the `UpperBodyTracker`. Where the video cuts to another scene, all of them begin anew. Of a recording
    the first runs ahead in a thread, that of a detector the second too, and the poses are kept in files
    until it has ended (`TrackedRecording`).

    Args:
        prior: the prior over upper bodies, from `load_prior` or `fit_upper_body_prior`.
        camera: the camera that took the video. Frames must have its image size, if it has one.
        fps: the number of frames per second. All frames are taken to be equally far apart; those of a
            camera that nobody read are counted (`VideoFrame.missed`). A video that knows its rate must have
            this one.
        hands: the hand tracker: "learnt" (default), "grid" (without its network) or "mean-shift", the
            paper's method.
        background: detect the foreground, for a static camera. The background is kept in the tracker, which
            then serves one stream, each frame once.
        elbows: measure elbows: by the network, or without one where the torso with its sleeves is widest.
            By default they are measured if hands are "learnt".
        edges: correct swapped hands by the edges of the arms (`HandAssociation`); takes about twice
            the time of the poses.
        candidates: also reinitialise the hand tracker at the hands of the last pose; frames are then
            measured and filtered in turn, which is slower.
        face_detector: the detector of faces; by default Haar's.
        max_persons: measure at most N persons at a time: the largest faces, or persons of a detector. One who
            is measured gives way only to somebody a fifth larger, and counts as one who left.
        head_neck: the offsets of head and neck from the face; see `UpperBodyMeasurer`.
        detector: find keypoints with a detector, in place of faces, skin and hands: a model in ONNX
            (.onnx), a pose landmarker of MediaPipe (.task), or package:factory, which Python imports and
            calls.
        min_confidence: treat keypoints of a detector as missing below this confidence (default 0.3).
        max_gap: the time without measurements after which a person has no pose, seconds; None for never.
        seed: the seed of methods that draw; every person has a generator.
        **options: further options of `UpperBodyTracker`, such as method, smoothing or frame. The method is
            "articulated" by default where its prior over arms knows all persons of `prior`, as it does those
            of the shipped ones, and where no option of another method is given; else as there.

    Raises:
        InputError, CameraError, PriorError: as those.

    Example:
        >>> import numpy as np, torchpose
        >>> prior = torchpose.load_prior("kinect-upper-body")
        >>> camera = torchpose.PinholeCamera.from_image_size(160, 120)
        >>> tracker = torchpose.VideoTracker(prior, camera)
        >>> tracker(np.zeros((5, 120, 160, 3), np.uint8))  # no persons
        []
    """

    def __init__(
        self,
        prior: UpperBodyPrior,
        camera: PinholeCamera | None = None,
        *,
        fps: float = 30.0,
        hands: str = "learnt",
        background: bool = False,
        elbows: bool | None = None,
        edges: bool = False,
        candidates: bool = False,
        face_detector: FaceDetector | None = None,
        max_persons: int | None = None,
        head_neck: HeadNeck | None = None,
        detector: str | Path | KeypointDetector | None = None,
        min_confidence: float | None = None,
        max_gap: float | None = 5.0,
        seed: int = 0,
        **options: Unpack[TrackerOptions],
    ) -> None:
        super().__init__()
        for name, value in (("max_persons", max_persons), ("seed", seed)):
            if value is not None and (isinstance(value, bool) or not isinstance(value, int)):
                raise InputError(f"{name} must be a whole number, got {value!r}")
        switches = {
            "background": background,
            "elbows": elbows,
            "edges": edges,
            "candidates": candidates,
        }
        for name, value in switches.items():
            if value is not None and value not in (True, False):
                raise InputError(f"{name} must be True or False, got {value!r}")
        check_tracked_rate(fps)
        if max_gap is not None and not number_of(max_gap) > 0:
            raise InputError(
                f"max_gap must be positive, seconds, or None for never, got {max_gap!r}"
            )
        if candidates and hands == "mean-shift":
            raise InputError(f"candidates need hands='learnt' or 'grid', got {hands!r}")
        self.measurer: UpperBodyMeasurer | KeypointMeasurer
        if detector is None:
            given: dict[str, Any] = {"min_confidence": min_confidence, **options}
            for option in ("min_confidence", "measurement_std", "neck"):
                if given.get(option) is not None:
                    raise InputError(f"{option} is of keypoints: give a detector, or leave it out")
            self.measurer = UpperBodyMeasurer(
                prior, fps, hands, background, elbows, face_detector, max_persons, head_neck
            )
        else:
            _refuse_measurer(
                hands=hands != HAND_TRACKERS[0], background=background, elbows=elbows is not None,
                edges=edges,
                candidates=candidates, face_detector=face_detector is not None,
                head_neck=head_neck is not None,
            )  # fmt: skip
            self.measurer = _keypoint_measurer(detector, fps, max_persons, min_confidence)
            options.setdefault("neck", self.measurer.neck)
        if detector is None:
            options["method"] = options.get("method") or _method_of(prior, options)
        self.candidates = candidates
        smoothing = options.pop("smoothing", None)
        tracker = UpperBodyTracker(prior, camera, fps=fps, max_gap=None, **options)
        association = HandAssociation() if edges else None
        self.stream = PersonStream(tracker, self.measurer.names, seed, association)
        self.smoothing = smoothing
        self._options: dict[str, Any] = {"fps": fps, "max_gap": None, **options}
        smoother = self.smoother  # raises errors of the options before any work
        self.smoothing = None if smoother is None else smoother.smoothing
        self.fps = float(fps)
        away = math.inf if max_gap is None else max_gap * fps
        self.gap = sys.maxsize if math.isinf(away) else min(round(away), sys.maxsize)

    @property
    def tracker(self) -> UpperBodyTracker:
        """Return the tracker of the poses of all persons."""
        return self.stream.tracker

    @property
    def smoother(self) -> UpperBodyTracker | None:
        """Return the smoother of recordings, with the same prior and camera; None without smoothing."""
        if self.smoothing is None:
            return None
        own = self.tracker
        given = self._options | own.given_options
        given |= {"measurement_std": own.measurement_std, "smoothing": self.smoothing}
        sources = (*own.parameters(), *own.buffers())
        return derived(
            self, "smoother", sources, lambda: UpperBodyTracker(own.prior, own.camera, **given)
        )

    def init(self) -> VideoState:
        """Return the state before the first frame."""
        return VideoState(self.measurer.init(), {}, {})

    @uncompiled
    def step(
        self, state: VideoState, image: Image | Tensor | VideoFrame
    ) -> tuple[VideoState, list[LivePerson]]:
        """Return the next state and the persons in one more frame of a camera.

        Args:
            state: the state from `init` or the step before. image: the frame, RGB, uint8, an array
                [H, W, 3] or a tensor [3, H, W]; or a `VideoFrame` of a camera, which counts the frames that
                were missed before it. They take the time of frames in which nothing was measured. The
                times of thirty frames at another rate than `fps` are in `VideoState.notes`.

        Returns:
            The next state, and the persons seen within the last `max_gap`.

        Raises:
            InputError: an image of another kind, or of another size than the camera's or the frames before, a
            tracker that smooths, or what is no state of it.
        """
        state, tracked = self.advance(state, [image])
        people = []
        for number in state.streams:
            _, poses, measured = tracked[number][-1].last()
            poses = with_note_on_cuts(poses, state.cuts)
            poses = replace(poses, notes=(*poses.notes, *state.notes))
            people.append(LivePerson(number, poses, measured))
        return state, people

    @uncompiled
    def advance(
        self, state: VideoState, images: Iterable[Any] | Tensor
    ) -> tuple[VideoState, dict[int, list[TrackedBlock]]]:
        """Return the next state and the poses in some more frames: those of `step` for one after the other.

        Args:
            state: the state from `init` or the call before. images: the frames, as in `forward`.

        Returns:
            The next state, and by number of each person the parts of these frames in which there are
            poses, each with the place of its first frame (`start`).

        Raises:
            InputError: an image of another kind, or of another size than the camera's or the frames before, a
                video with another rate than `fps`, a tracker that smooths, or what is no state of it.
        """
        if self.smoother is not None:
            raise InputError("a camera is tracked frame by frame: expected smoothing=None")
        if not isinstance(state, VideoState):
            raise InputError(
                f"state must be a VideoState, got {type(state).__name__}; begin with init, and pass on what "
                "the step before returned"
            )
        size, rate = state.size, state.rate

        def sized() -> Iterator[tuple[Image, int]]:
            nonlocal size, rate
            for image, missed, time in self._timed(images, state.size):
                size = image.shape[1], image.shape[0]
                rate = rate.after(time, missed, self.fps)
                yield image, missed

        seen = look_ahead(self._measurer, state.measurer, sized())
        tracked: dict[int, list[TrackedBlock]] = {}
        place, last = 0, state
        for after, block, poses in self._blocks(state, seen, _BLOCK):
            for number, parts in poses.items():
                placed = (part._replace(start=place + part.start) for part in parts)
                tracked.setdefault(number, []).extend(placed)
            place, last = place + len(block.found), after
        return last._replace(size=size, rate=rate), tracked

    @uncompiled
    def forward(
        self,
        frames: Iterable[Any] | Tensor,
        progress: bool = False,
        n_frames: int | None = None,
        folder: str | Path | None = None,
        watch: Watcher | None = None,
        workers: int = 0,
    ) -> list[TrackedPerson]:
        """Return the poses of all persons in a recording, in memory independent of its length.

        Args:
            frames: RGB, uint8, arrays [H, W, 3], or what has such an `image` (a `VideoSource`); or a
                tensor [T, 3, H, W].
            progress: whether to show a bar. n_frames: the number of frames, for the bar.
            folder: for temporary files, some 1.2 kB for every pose.
            watch: is called for every frame; frames are then filtered one by one, which is slower. A frame
                that a camera gave and nobody read is shown by the next one.
            workers: 1 for another process that looks ahead in place of a thread, which is faster; the poses
                are the same. It is started for 450 frames or more, and takes some 400 MB of memory. With
                `detector`, `background` or `watch`, on one core, and on Windows there is none.

        Returns:
            The persons who were seen for half a second or longer, the longest seen first.

        Raises:
            InputError: no images, one of another kind or another size than the camera's, or a video with
                another rate than `fps`. OutputError: the disk is full.
        """
        recording = TrackedRecording(self.tracker, self.stream.names, self.gap, folder)
        record(self, recording, frames, progress, n_frames, watch, workers)
        return recording.finish(self.smoother)

    if TYPE_CHECKING:  # nn.Module has Any
        __call__ = forward

    def _images(self, frames: Iterable[Any] | Tensor) -> Iterator[tuple[Image, int]]:
        """Return images, and how many frames were missed before each, once their rate is known."""
        timed = self._timed(frames)
        return ((image, missed) for image, missed, _ in timed)

    def _timed(
        self, frames: Iterable[Any] | Tensor, size: tuple[int, int] | None = None
    ) -> Iterator[tuple[Image, int, Any]]:
        """Return images, how many frames were missed before each, and times, once their rate is known.

        Args:
            frames: see `forward`. size: (width, height) of the frames before, None if there are none.
        """
        _check_frames(frames)
        rate = getattr(frames, "fps", None) if getattr(frames, "knows_rate", True) else None
        if rate and abs(rate / self.fps - 1) > _SAME_RATE:
            raise InputError(
                f"the video has {rate:g} frames per second, and the tracker is for {self.fps:g}; "
                f"make the tracker with fps={rate:g}, or open the video with fps={self.fps:g}"
            )
        return _images_of_size(frames, self.tracker.camera.image_size, size)

    def _seen(
        self, state: VideoState, frames: Iterable[Any] | Tensor, n_frames: int | None, others: int
    ) -> Generator[SeenFrame, None, None]:
        """Return the frames of a recording with what they show, from a thread or from another process.

        Args:
            state: before the frames. frames, n_frames: see `forward`. others: the most other processes.
        """
        images = self._images(frames)
        width, height = self.tracker.camera.image_size or (0, 0)
        ahead = min(AHEAD, max(_LEAST_AHEAD, _WAITING // max(3 * width * height, 1)))
        if others == 0 or cores() == 1 or isinstance(self.measurer, KeypointMeasurer):
            return prefetch(look_ahead(self._measurer, state.measurer, images), ahead)
        if n_frames is None:
            n_frames = getattr(frames, "n_frames", None)
        return look_ahead_elsewhere(self._measurer, state.measurer, images, n_frames, ahead)

    @property
    def _measurer(self) -> Measurer:
        return measurer_of(self.measurer)

    def _blocks(
        self, state: VideoState, seen: Iterable[SeenFrame], size: int, ahead: bool = False
    ) -> Generator[tuple[VideoState, MeasuredBlock, dict[int, list[TrackedBlock]]], None, None]:
        """Yield the next state, the measurements and the poses of each block of frames.

        With candidates every frame is a block, since it is measured with the poses of the one before.

        Args:
            state: the state before the frames. seen: the frames with what they show.
            size: the least number of frames of a block; the last one may be shorter.
            ahead: whether frames are measured in another thread while the block before is filtered.
        """
        measurer = self._measurer
        if self.candidates:
            for frame in seen:
                own, found = measurer.step(state.measurer, frame, _candidates(state.poses))
                block = block_of(frame, found, own)
                state, tracked = self._follow(state, block)
                yield state, block, tracked
            return
        # edges of arms are looked for in images, and who watches sees them
        keep = size == 1 or self.stream.association is not None
        blocks = measure_blocks(measurer, state.measurer, seen, size, keep)
        with closing(prefetch(blocks, 1) if ahead else blocks) as measured:
            for block in measured:
                state, tracked = self._follow(state, block)
                yield state, block, tracked

    def _follow(
        self, state: VideoState, block: MeasuredBlock
    ) -> tuple[VideoState, dict[int, list[TrackedBlock]]]:
        """Return the next state and the poses in a block of measured frames."""
        images, found, own, cut = block
        before = {} if cut else state.streams
        streams, tracked = self.stream.advance_all(before, found, images, self.gap)
        last = {number: tracked[number][-1].poses for number in streams}
        poses = {n: pose for n, pose in last.items() if bool(pose.joints3d[:, -1].isfinite().all())}
        cuts = (*state.cuts, state.n_frames) if cut else state.cuts
        return VideoState(own, streams, poses, state.n_frames + len(found), cuts), tracked


def record(
    tracker: VideoTracker,
    recording: TrackedRecording,
    frames: Iterable[Any] | Tensor,
    progress: bool = False,
    n_frames: int | None = None,
    watch: Watcher | None = None,
    workers: int = 0,
) -> None:
    """Track all frames into a recording, which holds the poses of those before an error too.

    Args:
        tracker: tracks them. recording: without poses yet. frames and others: of `VideoTracker.forward`.
    """
    if workers not in (0, 1):
        raise InputError(f"workers must be 0 or 1, got {workers!r}")
    start, size = tracker.init(), _BLOCK if watch is None else 1
    if watch is None:
        ahead = tracker._seen(start, frames, n_frames, workers)
    else:  # who watches sees a frame soon after it was taken
        ahead = prefetch(look_ahead(tracker._measurer, start.measurer, tracker._images(frames)))
    with (
        closing(ahead) as seen,  # no thread reads on when the caller gets an error
        closing(tracker._blocks(start, seen, size, tracker._measurer.heavy)) as blocks,
        tqdm(total=n_frames, disable=not progress, unit="frame") as bar,
    ):
        for state, block, tracked in blocks:
            recording.append(tracked, len(block.found), state.cuts)
            bar.update(len(block.found))
            if watch is not None:
                for _ in block.found:
                    watch(block.images[-1], block.found[-1], dict(state.poses))


def _keypoint_measurer(
    detector: str | Path | KeypointDetector,
    fps: float,
    max_persons: int | None,
    min_confidence: float | None,
) -> KeypointMeasurer:
    """Return the measurer of a detector, which is loaded if it is a file or the name of a factory."""
    if isinstance(detector, str | Path):
        name, loaded = str(detector), load_detector(detector, fps, max_persons)
    else:
        name = type(detector).__name__
        loaded = check_detector(detector, name)
    least = LEAST_CONFIDENCE if min_confidence is None else min_confidence
    return KeypointMeasurer(loaded, fps, max_persons, least, name)


def _method_of(prior: UpperBodyPrior, options: TrackerOptions) -> str | None:
    """Return bones alone where these were fitted to all persons of the prior, else None."""
    of_others = {"window", "steady", *MethodOptions.__annotations__} - set(method_options(BONES))
    given = {name for name, value in options.items() if value is not None}
    persons = set(prior.info.persons)
    known = bool(persons) and persons <= set(shipped_arm_prior().info.persons)
    return BONES if known and of_others.isdisjoint(given) else None


def _refuse_measurer(**given: bool) -> None:
    """Raise `InputError` for options of `UpperBodyMeasurer`, which a detector replaces."""
    for option, used in given.items():
        if used:
            raise InputError(
                f"{option} is of the measurer of faces and hands, whose place a detector takes; leave it out"
            )


def _check_frames(frames: Any) -> None:
    """Raise `InputError` for what are no frames, such as the path of a video."""
    several = hasattr(frames, "__iter__") or hasattr(frames, "__getitem__")
    if isinstance(frames, str | bytes | PathLike) or not several:
        raise InputError(
            "frames must be RGB images of uint8: a tensor [T, 3, H, W], an array [T, H, W, 3], or what yields"
            f" them, got {type(frames).__name__}; torchpose.video.open_video(path) opens a file or a folder"
        )


def as_image(image: Any) -> Image:
    """Return a frame as an array [H, W, 3]; tensors are [3, H, W]."""
    if isinstance(image, Tensor):
        if image.ndim != 3 or image.shape[0] != 3 or image.dtype != torch.uint8:
            raise InputError(
                "a frame must be an RGB tensor [3, H, W] of uint8, got "
                f"{list(image.shape)} of {image.dtype}"
            )
        image = np.ascontiguousarray(image.permute(1, 2, 0).cpu().numpy())
    check_rgb("a frame", image, empty=False)
    return np.asarray(image)


def _images_of_size(
    frames: Iterable[Any] | Tensor,
    of_camera: tuple[int, int] | None,
    before: tuple[int, int] | None,
) -> Iterator[tuple[Image, int, Any]]:
    """Yield images of frames, the numbers missed and times, all of the size of the camera, or of the first.

    Args:
        frames: with images. of_camera: (width, height) of its images, if it is known.
        before: of the frames before, None if there are none.
    """
    given = "those before are" if of_camera is None else "the camera is for images"
    size = before if of_camera is None else of_camera
    for frame in frames:
        image = as_image(getattr(frame, "image", frame))
        own = image.shape[1], image.shape[0]
        size = own if size is None else size
        if own != size:
            raise InputError(
                f"a frame is of {own[0]} x {own[1]} pixels, and {given} of {size[0]} x {size[1]}; give the "
                "camera of the frames, or frames of one size"
            )
        missed = getattr(frame, "missed", 0)
        if not isinstance(missed, Integral) or missed < 0:
            raise InputError(f"missed must be a whole number of frames, 0 or more, got {missed!r}")
        yield image, int(missed), getattr(frame, "time", None)


def _candidates(poses: dict[int, PoseTrack]) -> dict[int, Candidates]:
    """Return the hands of the last poses with their covariances, by person."""
    return {
        n: Candidates(pose.joints2d[0, -1, _HANDS], pose.covariance2d[0, -1, _HANDS])
        for n, pose in poses.items()
    }
