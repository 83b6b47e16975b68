"""Measure the keypoints of all persons in a video by a detector, frame by frame."""

from typing import Any, NamedTuple, cast

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose._core.checks import check_count, check_rgb
from torchpose._core.images import Image
from torchpose.errors import InputError, TorchposeError
from torchpose.measure._detectors.associate import (
    PersonTracks,
    associate,
    crop_boxes,
    least_seen,
    no_tracks,
    person_scale,
    pseudo_faces,
    upper_rows,
    without_doubles,
)
from torchpose.measure._detectors.protocol import (
    CroppingDetector,
    Detections,
    KeypointDetector,
    checked_detections,
)
from torchpose.measure._persons import PersonRegister, Persons, largest_persons
from torchpose.measure._scene_cuts import SceneCuts, SceneState
from torchpose.skeleton._joint_sets import canonical_names
from torchpose.skeleton._mediapipe_landmarks import derive_joints, lacks_joints

LEAST_CONFIDENCE = 0.3
"""Of a keypoint, below which it counts as missing unless something else is asked for."""
_ANYWHERE = ("head", "neck")  # may lie above the image: they follow from face and shoulders
_BEYOND = 0.95  # probability that a keypoint cannot be seen which is put outside of the image
_KNOWN_FOR = 30.0  # seconds for which somebody who has left is remembered
_PRESENT = 1.0  # seconds for which somebody who is not detected counts as there
_CROPPED = 0.2  # seconds without a detection after which the whole image is searched


class FrameKeypoints(NamedTuple):
    """Holds the keypoints of N persons in a frame.

    Attributes:
        person: their numbers, in the order of appearance [N].
        keypoints: of the measurer's `names` [N, J, 2], pixels, NaN where missing.
        confidence: 0 to 1 [N, J]. sizes: about the widths of the shoulders, pixels [N].
        absent: the probability that a keypoint cannot be seen, NaN where nothing is known [N, J].
        cut: whether the video cuts to another scene before this frame.
    """

    person: Int[Tensor, " N"]
    keypoints: Float[Tensor, "N J 2"]
    confidence: Float[Tensor, "N J"]
    sizes: Float[Tensor, " N"]
    absent: Float[Tensor, "N J"]
    cut: bool = False

    @property
    def faces(self) -> None:
        """Return None: keypoints come without faces."""
        return None


class KeypointState(NamedTuple):
    """Holds the tracks of the persons, who they are, and the number of frames before.

    Attributes:
        followed: numbers of those who count [n]. scene: of `SceneCuts`.
    """

    tracks: PersonTracks
    persons: Persons
    frame: int
    followed: Int[Tensor, " n"]
    scene: SceneState


class KeypointMeasurer:
    """Measures the keypoints of all persons in a video by a detector, and tells the persons apart.

    A frame passes four stages: detection, of crops about the persons where the detector wants one person;
    removal of what is unsure or there twice; association with the persons of the frames before, by the
    distances of the keypoints; and recognition of who returns, by the colours of the clothes. Where the
    video cuts to another scene, the tracks begin anew.

    Args:
        detector: of keypoints. fps: frames per second.
        max_persons: at most so many persons at a time are measured, the largest; who is measured gives way
            to somebody a fifth larger. None takes all.
        min_confidence: of a keypoint, below which it counts as missing.
        name: of the detector, in messages.

    Attributes:
        names: of the keypoints; head, neck and hands follow the landmarks of MediaPipe.
        neck: kind of neck, if the detector or its landmarks tell.

    Raises:
        InputError: settings out of range.
    """

    def __init__(
        self,
        detector: KeypointDetector,
        fps: float = 30.0,
        max_persons: int | None = None,
        min_confidence: float = LEAST_CONFIDENCE,
        name: str = "the detector",
    ) -> None:
        if not 0 <= min_confidence <= 1:
            raise InputError(f"min_confidence must be in 0 to 1, got {min_confidence}")
        if max_persons is not None:
            check_count("max_persons", max_persons)
        self.detector, self.fps, self.max_persons = detector, float(fps), max_persons
        self.min_confidence, self._name = min_confidence, name
        self._given = tuple(str(one) for one in detector.names)
        self._derives = lacks_joints(self._given)
        self.names = self._given
        if self._derives:
            self.names = derive_joints(torch.zeros(1, len(self.names), 2), None, self.names)[2]
        self.neck: str | None = "neck" if self._derives else getattr(detector, "neck", None)
        self._upper = upper_rows(self.names)
        self._anywhere = torch.tensor([one in _ANYWHERE for one in canonical_names(self.names)])
        self.register = PersonRegister(within=round(_KNOWN_FOR * fps))
        self.scene_cuts = SceneCuts(fps)

    def init(self) -> KeypointState:
        """Return the state before the first frame, and reset the detector."""
        reset = getattr(self.detector, "reset", None)
        if callable(reset):
            reset()
        persons, scene = self.register.init(), self.scene_cuts.init()
        return KeypointState(no_tracks(len(self.names)), persons, 0, persons.last_seen, scene)

    def step(self, state: KeypointState, image: Image) -> tuple[KeypointState, FrameKeypoints]:
        """Return the next state and the keypoints of the next frame.

        Args:
            state: from `init` or the step before. image: RGB, uint8 [H, W, 3].

        Raises:
            InputError: another kind of image, or a detector that returns something else than it says.
        """
        check_rgb("a frame", image, empty=False)
        scene, cut = self.scene_cuts.step(state.scene, image)
        if cut:
            nobody = no_tracks(len(self.names))
            following = state.tracks.next_identity
            state = state._replace(tracks=nobody._replace(next_identity=following))
        found = self._sure(self._detect(state.tracks, image), image)
        scale = self._scale(found.keypoints)[1]
        found = _rows(found, without_doubles(Detections(*found[:2]), scale, self._upper))
        before = self._scale(state.tracks.keypoints)[1]
        tracks, owner = associate(state.tracks, found.keypoints, before, self._upper)
        persons, number = self._number(state, tracks, image)
        followed = self._followed(number, tracks, state.followed)
        chosen = torch.nonzero(torch.isin(number[owner], followed)).flatten()
        found, number = _rows(found, chosen), number[owner][chosen]
        size = self._scale(found.keypoints)[1]
        measured = FrameKeypoints(
            number, found.keypoints, found.confidence, size, found.absent, cut
        )
        return KeypointState(tracks, persons, state.frame + 1, followed, scene), measured

    def _detect(self, tracks: PersonTracks, image: Image) -> Detections:
        """Return all keypoints of a frame."""
        detector = self.detector
        if isinstance(detector, CroppingDetector):
            found = detector.detect_in(image, self._boxes(tracks, image))
        else:
            found = checked_detections(self._call(image), len(self._given), self._name)
        if not self._derives:
            return found
        points, confidence, _ = derive_joints(*found, self._given)
        return Detections(points, cast(Tensor, confidence))

    def _call(self, image: Image) -> Any:
        """Return the detections of a frame; errors of the detector are raised with its name."""
        try:
            return self.detector(image)
        except TorchposeError:
            raise
        except Exception as error:
            raise InputError(
                f"{self._name} failed on an image {list(image.shape)}: {type(error).__name__}: {error}"
            ) from error

    def _boxes(self, tracks: PersonTracks, image: Image) -> Float[Tensor, "N 4"] | None:
        """Return boxes about the persons of the last frames, None for the whole image."""
        recent = tracks.keypoints[tracks.unseen <= _CROPPED * self.fps]
        if not len(recent):
            return None
        return crop_boxes(recent, *self._scale(recent), (image.shape[1], image.shape[0]))

    def _scale(self, keypoints: Tensor) -> tuple[Tensor, Tensor]:
        return person_scale(keypoints, self.names)

    def _sure(self, found: Detections, image: Image) -> "_Sure":
        """Return the persons with enough keypoints, without those that are unsure or not in the image."""
        sure = (found.confidence >= self.min_confidence) & (found.confidence > 0)
        size = found.keypoints.new_tensor([image.shape[1], image.shape[0]])
        inside = ((found.keypoints >= 0) & (found.keypoints < size)).all(-1)
        sure &= inside | (self._anywhere & found.keypoints.isfinite().all(-1))
        keypoints = torch.where(sure[..., None], found.keypoints, torch.nan)
        there = sure[:, self._upper].sum(1) >= least_seen(len(self._upper))
        confidence = torch.where(sure, found.confidence, 0.0)
        beyond = found.keypoints.isfinite().all(-1) & ~inside & (found.confidence > 0)
        absent = torch.where(beyond, _BEYOND, torch.nan).to(confidence)
        return _Sure(keypoints[there], confidence[there], absent[there])

    def _number(
        self, state: KeypointState, tracks: PersonTracks, image: Image
    ) -> tuple[Persons, Int[Tensor, " P"]]:
        """Return the next register, and the numbers of the followed persons, -1 of those left out."""
        present = tracks.usable & (tracks.unseen <= _PRESENT * self.fps)
        faces = pseudo_faces(*self._scale(tracks.keypoints[present]))
        persons, number = self.register.step(
            state.persons, image, faces, tracks.identity[present], state.frame,
            tracks.unseen[present] == 0,
        )  # fmt: skip
        numbers = torch.full_like(tracks.identity, -1)
        numbers[present] = number
        return persons, numbers

    def _followed(
        self, number: Int[Tensor, " P"], tracks: PersonTracks, before: Int[Tensor, " n"]
    ) -> Int[Tensor, " m"]:
        """Return the numbers of the persons who count, the largest if there are too many.

        Somebody who is not detected for a moment keeps the place.
        """
        present = number >= 0
        number = number[present]
        if self.max_persons is None:
            return number
        size = self._scale(tracks.keypoints[present])[1]
        return number[largest_persons(number, size, before, self.max_persons)]


class _Sure(NamedTuple):
    """Holds `Detections` without unsure keypoints.

    Attributes:
        keypoints, confidence: NaN and 0 where missing. absent: as in `FrameKeypoints`.
    """

    keypoints: Tensor
    confidence: Tensor
    absent: Tensor


def _rows(found: _Sure, rows: Int[Tensor, " n"]) -> _Sure:
    return _Sure(*(values[rows] for values in found))
