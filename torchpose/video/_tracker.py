"""Track the poses of all persons in a video."""

import sys
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from tqdm.auto import tqdm

from torchpose._core.checks import check_rgb
from torchpose._core.images import Image
from torchpose._core.module_state import derived
from torchpose.camera._pinhole import PinholeCamera
from torchpose.errors import InputError
from torchpose.measure._association import HandAssociation
from torchpose.measure._detectors.load import check_detector, load_detector
from torchpose.measure._detectors.protocol import KeypointDetector
from torchpose.measure._face import FaceDetector, FaceTracks
from torchpose.measure._head import HeadNeck
from torchpose.measure._keypoints import (
    LEAST_CONFIDENCE,
    FrameKeypoints,
    KeypointMeasurer,
    KeypointState,
)
from torchpose.measure._upper_body import (
    HAND_TRACKERS,
    Candidates,
    FrameMeasurements,
    MeasurerState,
    UpperBodyMeasurer,
)
from torchpose.priors._upper_body import UpperBodyPrior
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.upper_body._pose_track import PoseTrack
from torchpose.upper_body._tracker import UpperBodyTracker
from torchpose.video._person_stream import Measured, PersonStream, PersonStreamState
from torchpose.video._prefetch import prefetch
from torchpose.video._recording import TrackedPerson, TrackedRecording

__all__ = ["LivePerson", "TrackedPerson", "VideoState", "VideoTracker", "Watcher"]

Found = FrameMeasurements | FrameKeypoints
Watcher = Callable[[Image, Found, dict[int, PoseTrack]], None]
"""Is called with a frame, its measurements, and the poses of the persons in it by number."""

_HANDS = [UPPER_BODY.index("hand_left"), UPPER_BODY.index("hand_right")]
_BLOCK = 32  # frames of a recording that are filtered together


class VideoState(NamedTuple):
    """Holds the state of `VideoTracker.step`: of the measurer, of all streams, and the last poses."""

    measurer: MeasurerState | KeypointState
    streams: dict[int, PersonStreamState]
    poses: dict[int, PoseTrack]


class LivePerson(NamedTuple):
    """Holds a person in one frame: number, pose (a track of one frame), and measurements."""

    number: int
    pose: PoseTrack
    measured: Measured


class VideoTracker(nn.Module):
    """Tracks all persons in a video: `UpperBodyMeasurer`, then an `UpperBodyTracker` for each person.

    With `detector` the keypoints of that take the place of what `UpperBodyMeasurer` measures; each person's
    are tracked with their confidences, as keypoints in files are. A detector may also be an object with the
    attribute `names`, of J keypoints, that is called with an RGB image [H, W, 3] and returns keypoints
    [N, J, 2], pixels, and confidence [N, J], 0 to 1, of N persons.

    `forward` tracks a recording, `init` and `step` a camera. A frame passes three stages, each of which
    takes and returns values: the measurer gives `FrameMeasurements`, the streams of the persons
    (`PersonStream.advance_all`) turn these into a `TrackedBlock` for each, by the `UpperBodyTracker`. A
    recording's blocks are kept in files until it has ended (`TrackedRecording`).

    Args:
        prior: from `load_prior` or `fit_upper_body_prior`.
        camera: of the video.
        fps: frames per second. All frames are taken to be equally far apart.
        hands: the hand tracker: "learnt" (default), "grid" (without its network) or "mean-shift", the
            paper's method.
        background: detect the foreground, for a static camera.
        elbows: measure elbows, where the torso with its sleeves is widest.
        edges: correct swapped hands by the edges of the arms (`HandAssociation`); takes about twice
            the time of the poses.
        candidates: also reinitialise the hand tracker at the hands of the last pose; frames are then
            measured and filtered in turn, which is slower.
        face_detector: by default Haar's.
        max_persons: track only the N largest faces, or persons of a detector.
        head_neck: offsets of head and neck from the face.
        detector: of keypoints, in place of faces, skin and hands: a model in ONNX (.onnx), a pose
            landmarker of MediaPipe (.task), or package:factory, which Python imports and calls.
        min_confidence: with a detector, of a keypoint, below which it is missing (default 0.3).
        max_gap: seconds without measurements after which a person has no pose; None is never.
        seed: of methods that draw; every person has a generator.
        **options: to `UpperBodyTracker`, such as method, smoothing or frame.

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
        elbows: bool = False,
        edges: bool = False,
        candidates: bool = False,
        face_detector: FaceDetector | None = None,
        max_persons: int | None = None,
        head_neck: HeadNeck | None = None,
        detector: str | Path | KeypointDetector | None = None,
        min_confidence: float | None = None,
        max_gap: float | None = 5.0,
        seed: int = 0,
        **options: Any,
    ) -> None:
        super().__init__()
        if max_gap is not None and not max_gap > 0:
            raise InputError(f"max_gap must be positive, got {max_gap}")
        if candidates and hands == "mean-shift":
            raise InputError(f"candidates need hands='learnt' or 'grid', got {hands!r}")
        self.measurer: UpperBodyMeasurer | KeypointMeasurer
        if detector is None:
            if min_confidence is not None:
                raise InputError("min_confidence is of keypoints: give a detector, or leave it out")
            self.measurer = UpperBodyMeasurer(
                prior, fps, hands, background, elbows, face_detector, max_persons, head_neck
            )
        else:
            _refuse_measurer(
                hands=hands != HAND_TRACKERS[0], background=background, elbows=elbows, edges=edges,
                candidates=candidates, face_detector=face_detector is not None,
                head_neck=head_neck is not None,
            )  # fmt: skip
            self.measurer = _keypoint_measurer(detector, fps, max_persons, min_confidence)
            options.setdefault("neck", self.measurer.neck)
        self.candidates = candidates
        smoothing = options.pop("smoothing", None)
        tracker = UpperBodyTracker(prior, camera, fps=fps, max_gap=None, **options)
        association = HandAssociation() if edges else None
        self.stream = PersonStream(tracker, self.measurer.names, seed, association)
        self.smoothing = smoothing
        self._options = {"fps": fps, "max_gap": None, **options}
        _ = self.smoother  # raises errors of the options before any work
        self.fps = float(fps)
        self.gap = sys.maxsize if max_gap is None else round(max_gap * fps)

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

    def step(self, state: VideoState, image: Image | Tensor) -> tuple[VideoState, list[LivePerson]]:
        """Return the next state and the persons in one more frame of a camera.

        Args:
            state: from `init` or the step before. image: RGB, uint8, an array [H, W, 3] or a tensor
                [3, H, W].

        Returns:
            The next state, and the persons seen within the last `max_gap`.

        Raises:
            InputError: another kind of image, or a tracker that smooths.
        """
        if self.smoother is not None:
            raise InputError("a camera is tracked frame by frame: expected smoothing=None")
        image = as_image(image)
        candidates = _candidates(state.poses) if self.candidates else None
        measurer, measured = self._measure_frame(state.measurer, image, None, candidates)
        streams, tracked = self.stream.advance_all(state.streams, [measured], [image], self.gap)
        people = [LivePerson(n, tracked[n].poses, tracked[n].measured) for n in streams]
        return VideoState(measurer, streams, {p.number: p.pose for p in people}), people

    def forward(
        self,
        frames: Iterable[Any] | Tensor,
        progress: bool = False,
        n_frames: int | None = None,
        folder: str | Path | None = None,
        watch: Watcher | None = None,
    ) -> list[TrackedPerson]:
        """Return the poses of all persons in a recording, in memory independent of its length.

        Args:
            frames: RGB, uint8, arrays [H, W, 3], or what has such an `image` (a `VideoSource`); or a
                tensor [T, 3, H, W].
            progress: whether to show a bar. n_frames: for the bar.
            folder: for temporary files, some 1.2 kB for every pose.
            watch: is called for every frame; frames are then filtered one by one, which is slower.

        Returns:
            The persons who were seen for half a second or longer, the longest seen first.

        Raises:
            InputError: another kind of image. OutputError: the disk is full.
        """
        recording = TrackedRecording(self.tracker, self.stream.names, self.gap, folder)
        size = _BLOCK if watch is None and not self.candidates else 1
        streams: dict[int, PersonStreamState] = {}
        last: dict[int, PoseTrack] = {}
        measured = self._measure(frames, last)
        if not self.candidates:
            measured = prefetch(measured, size)  # while the block before is filtered
        shown = iter(tqdm(measured, total=n_frames, disable=not progress, unit="frame"))
        while block := list(islice(shown, size)):
            images, found = zip(*block, strict=True)
            streams, tracked = self.stream.advance_all(streams, found, images, self.gap)
            recording.append(tracked, len(block))
            last.clear()
            last.update({n: part.poses for n, part in tracked.items() if _is_pose(part.poses)})
            if watch is not None:
                watch(images[-1], found[-1], dict(last))
        return recording.finish(self.smoother)

    def _measure(
        self, frames: Iterable[Any] | Tensor, last: dict[int, PoseTrack]
    ) -> Iterator[tuple[Image, Found]]:
        """Yield frames and what is measured in them; faces are found ahead, in another thread.

        `last` holds the poses of the frame before, for candidates.
        """
        state = self.measurer.init()
        for image, tracks in prefetch(self._follow_faces(frames, state)):
            with torch.no_grad():
                candidates = _candidates(last) if self.candidates else None
                state, measured = self._measure_frame(state, image, tracks, candidates)
            yield image, measured

    def _measure_frame(
        self,
        state: MeasurerState | KeypointState,
        image: Image,
        tracks: FaceTracks | None,
        candidates: dict[int, Candidates] | None,
    ) -> tuple[MeasurerState | KeypointState, Found]:
        """Return the next state of the measurer, and what is measured in a frame."""
        if isinstance(self.measurer, UpperBodyMeasurer) and isinstance(state, MeasurerState):
            return self.measurer.step(state, image, tracks, candidates)
        if isinstance(self.measurer, KeypointMeasurer) and isinstance(state, KeypointState):
            return self.measurer.step(state, image)
        raise InputError(
            "expected a state of this tracker's init or step, got one of another tracker"
        )

    def _follow_faces(
        self, frames: Iterable[Any] | Tensor, state: MeasurerState | KeypointState
    ) -> Iterator[tuple[Image, FaceTracks | None]]:
        """Yield frames and the faces in them, None with a detector of keypoints."""
        tracks = state.faces if isinstance(state, MeasurerState) else None
        for frame in frames:
            image = as_image(getattr(frame, "image", frame))
            if isinstance(self.measurer, UpperBodyMeasurer) and tracks is not None:
                with torch.no_grad():
                    tracks = self.measurer.follow_faces(tracks, image)
            yield image, tracks


def _keypoint_measurer(
    detector: str | Path | KeypointDetector,
    fps: float,
    max_persons: int | None,
    min_confidence: float | None,
) -> KeypointMeasurer:
    """Return what measures by a detector, which is loaded if it is a file or the name of a factory."""
    if isinstance(detector, str | Path):
        name, loaded = str(detector), load_detector(detector, fps, max_persons)
    else:
        name = type(detector).__name__
        loaded = check_detector(detector, name)
    least = LEAST_CONFIDENCE if min_confidence is None else min_confidence
    return KeypointMeasurer(loaded, fps, max_persons, least, name)


def _refuse_measurer(**given: bool) -> None:
    """Raise `InputError` for options of `UpperBodyMeasurer`, which a detector replaces."""
    for option, used in given.items():
        if used:
            raise InputError(
                f"{option} is of the measurer of faces and hands, whose place a detector takes; leave it out"
            )


def as_image(image: Any) -> Image:
    """Return a frame as an array [H, W, 3]; tensors are [3, H, W]."""
    if isinstance(image, Tensor):
        if image.ndim != 3 or image.shape[0] != 3 or image.dtype != torch.uint8:
            raise InputError(
                "a frame must be an RGB tensor [3, H, W] of uint8, got "
                f"{list(image.shape)} of {image.dtype}"
            )
        return np.ascontiguousarray(image.permute(1, 2, 0).cpu().numpy())
    check_rgb("a frame", image)
    return np.asarray(image)


def _candidates(poses: dict[int, PoseTrack]) -> dict[int, Candidates]:
    """Return where the poses of a frame have the hands, by person."""
    return {
        n: Candidates(pose.joints2d[0, -1, _HANDS], pose.covariance2d[0, -1, _HANDS])
        for n, pose in poses.items()
    }


def _is_pose(track: PoseTrack) -> bool:
    return bool(track.joints3d.isfinite().all())
