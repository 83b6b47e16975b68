"""Detect faces and measure landmarks by MediaPipe.

Both take a model file that the user gives; nothing is downloaded. `mediapipe` is imported only when one
of them is made.
"""

import importlib
import math
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_count, check_grey, check_rgb
from torchpose._core.images import Image
from torchpose.errors import InputError, MissingDependencyError
from torchpose.measure._face_detector import Region
from torchpose.skeleton._mediapipe_landmarks import DERIVED_JOINTS, LANDMARKS, derive_joints


class _Task:
    """Closes a task of MediaPipe at the end of a `with` block."""

    _task: Any

    def close(self) -> None:
        """Close the model, which cannot be used afterwards."""
        self._task.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class MediaPipeFaceDetector(_Task):
    """Detects faces by a model of MediaPipe, with bounding boxes like those of the Haar cascade.

    MediaPipe's box is smaller than the cascade's, and lower:
        size = 1.15 b,   centre = box's centre - (0, 0.13 b),   b: side of MediaPipe's box.
    These are medians over seven webcam clips of three signers, where the cascade saw a face too: 1.18
    and 0.17 for the short-range model, 1.11 and 0.11 for the full-range one; from clip to clip the
    size varies by 5 %.

    Args:
        model: file of a face detector (.tflite). The short-range model detects faces that fill a good
            part of what it is shown; in whole frames of 640x480 it misses most that are 80 pixels wide.
        min_confidence: of a detection, 0 to 1.
        tiles: a whole frame is also searched in overlapping squares, this many side by side along its
            shorter edge, which finds faces so much smaller; 1 is the whole frame alone, enough for a
            full-range model. The region about a known face is always searched as a whole.
        scale, raise_by: 1.15 and 0.13 above, for another model.

    Raises:
        MissingDependencyError: no mediapipe. InputError: no such file, or one that holds no face
            detector.

    Example:
        ``FaceTracker(MediaPipeFaceDetector("blaze_face_short_range.tflite"))``
    """

    def __init__(
        self,
        model: str | Path,
        min_confidence: float = 0.5,
        tiles: int = 2,
        scale: float = 1.15,
        raise_by: float = 0.13,
    ) -> None:
        _check_confidence(min_confidence)
        check_count("tiles", tiles)
        if not (scale > 0 and math.isfinite(scale) and math.isfinite(raise_by)):
            raise InputError(
                f"scale must be positive and raise_by finite, got {scale} and {raise_by}"
            )
        path = _require_model(model, "a face detector (.tflite)")
        mediapipe = _require_mediapipe()
        vision = mediapipe.tasks.vision
        options = vision.FaceDetectorOptions(
            base_options=mediapipe.tasks.BaseOptions(model_asset_path=str(path)),
            running_mode=vision.RunningMode.IMAGE,
            min_detection_confidence=min_confidence,
        )
        self._mediapipe = mediapipe
        self._task = _load(vision.FaceDetector, options, path, "a face detector (.tflite)")
        self.tiles, self.scale, self.raise_by = tiles, scale, raise_by

    def __call__(self, image: Image, region: Region | None = None) -> Float[Tensor, "N 3"]:
        """Return the faces of a grey image; see `torchpose.measure.FaceDetector`."""
        check_grey("image", image)
        height, width = image.shape
        if region is None:
            views = [(0, 0, width, height), *_squares(width, height, self.tiles)]
        else:
            views = [region[:4]]
        faces = torch.cat([self._search(image, *view) for view in views])
        if region is not None:
            size = faces[:, 2]
            faces = faces[(size >= region.smallest) & (size <= region.largest)]
        return _strongest(faces)

    def _search(self, image: Image, left: int, top: int, right: int, bottom: int) -> Tensor:
        """Return (x, y, size, confidence) of the faces in a part of the image, [n, 4]."""
        image = image[top:bottom, left:right]
        if image.size == 0:
            return torch.zeros(0, 4, dtype=torch.float64)
        found = self._task.detect(_wrap(self._mediapipe, np.repeat(image[..., None], 3, 2)))
        faces = []
        for detection in found.detections:
            box = detection.bounding_box
            side = (box.width + box.height) / 2
            x, y = left + box.origin_x + box.width / 2, top + box.origin_y + box.height / 2
            score = detection.categories[0].score
            faces.append((x, y - self.raise_by * side, self.scale * side, score))
        return torch.tensor(faces, dtype=torch.float64).reshape(-1, 4)


def _squares(width: int, height: int, tiles: int) -> list[tuple[int, int, int, int]]:
    """Return squares that cover an image and overlap by at least half; none for one tile."""
    if tiles == 1:
        return []
    side = -(-min(width, height) // tiles)
    starts = [
        np.linspace(0, edge - side, -(-2 * (edge - side) // side) + 1).astype(int).tolist()
        for edge in (width, height)
    ]
    return [(x, y, x + side, y + side) for y in starts[1] for x in starts[0]]


def _strongest(faces: Float[Tensor, "n 4"]) -> Float[Tensor, "m 3"]:
    """Return the faces without those within half a size of a more confident one."""
    faces = faces[faces[:, 3].argsort(descending=True)]
    size = faces[:, 2]
    near = torch.cdist(faces[:, :2], faces[:, :2]) <= torch.maximum(size, size[:, None]) / 2
    return faces[~torch.tril(near, -1).any(1), :3]


class PoseLandmarks(NamedTuple):
    """Holds the landmarks of the N persons in a frame.

    Attributes:
        points: pixels, [N, 37, 2]: the 33 landmarks and the head, neck and hands that
            `torchpose.skeleton._mediapipe_landmarks.derive_joints` makes of them. Those outside of the
            image are extrapolated by MediaPipe and have a low visibility.
        visibility: 0 to 1, [N, 37].
        joints3d: of the 33 landmarks, [N, 33, 3], metres, camera axes, from the middle of the hips:
            MediaPipe's own estimate from a single frame.
    """

    points: Float[Tensor, "N 37 2"]
    visibility: Float[Tensor, "N 37"]
    joints3d: Float[Tensor, "N 33 3"]


class MediaPipePose(_Task):
    """Measures the joints of one person or several by a model of MediaPipe's pose landmarker.

    MediaPipe tracks persons itself, and may return them in another order in the next frame.

    Args:
        model: file of a pose landmarker (.task): lite, full or heavy.
        max_people: most persons that are detected.
        min_confidence: of a person, 0 to 1.

    Attributes:
        names: of the 37 points, for `torchpose.UpperBodyTracker`; that tracker is to be made with
            ``neck="neck"``.

    Raises:
        MissingDependencyError: no mediapipe. InputError: no such file, one that holds no pose
            landmarker, or max_people below 1.

    Example:
        ::

            with MediaPipePose("pose_landmarker_full.task") as pose:
                state = tracker.init(1, names=pose.names)
                for frame in video:
                    found = pose(frame.image, frame.time)
                    state, live = tracker.step(state, *pose.of_one(found))
    """

    names: tuple[str, ...] = (*LANDMARKS, *DERIVED_JOINTS)

    def __init__(self, model: str | Path, max_people: int = 1, min_confidence: float = 0.5) -> None:
        _check_confidence(min_confidence)
        check_count("max_people", max_people)
        path = _require_model(model, "a pose landmarker (.task)")
        mediapipe = _require_mediapipe()
        vision = mediapipe.tasks.vision
        options = vision.PoseLandmarkerOptions(
            base_options=mediapipe.tasks.BaseOptions(model_asset_path=str(path)),
            running_mode=vision.RunningMode.VIDEO,
            num_poses=max_people,
            min_pose_detection_confidence=min_confidence,
            min_pose_presence_confidence=min_confidence,
            min_tracking_confidence=min_confidence,
        )
        self._mediapipe = mediapipe
        self._task = _load(vision.PoseLandmarker, options, path, "a pose landmarker (.task)")
        self._time, self._stamp = -math.inf, -1

    def __call__(self, image: Image, time: float) -> PoseLandmarks:
        """Return the landmarks of all persons in a frame.

        Args:
            image: RGB, [H, W, 3], uint8. time: seconds, later than that of the frame before.

        Raises:
            InputError: another kind of image, or a time that is not later.
        """
        check_rgb("image", image)
        if not (time > self._time and math.isfinite(time)):
            raise InputError(
                f"time must be finite and later than that of the frame before ({self._time} s), "
                f"got {time}; make a new MediaPipePose for another video"
            )
        self._time, self._stamp = time, max(round(1000 * time), self._stamp + 1)
        found = self._task.detect_for_video(_wrap(self._mediapipe, image), self._stamp)
        rows = [[(p.x, p.y, p.visibility) for p in person] for person in found.pose_landmarks]
        world = [[(p.x, p.y, p.z) for p in person] for person in found.pose_world_landmarks]
        flat = torch.tensor(rows, dtype=torch.float64).reshape(-1, len(LANDMARKS), 3)
        pixels = flat[..., :2] * flat.new_tensor([image.shape[1], image.shape[0]])
        points, visibility, _ = derive_joints(pixels, flat[..., 2], LANDMARKS)
        joints3d = torch.tensor(world, dtype=torch.float64).reshape(-1, len(LANDMARKS), 3)
        return PoseLandmarks(points, _require_visibility(visibility), joints3d)

    def of_one(self, found: PoseLandmarks) -> tuple[Tensor, Tensor]:
        """Return the keypoints of the first person.

        Args:
            found: landmarks of N persons in one image.

        Returns:
            Keypoints [1, 37, 2], pixels, and confidence [1, 37], 0 to 1; NaN and 0 where nobody was found.
        """
        if len(found.points):
            return found.points[:1], found.visibility[:1]
        return torch.full((1, len(self.names), 2), torch.nan), torch.zeros(1, len(self.names))


def _require_visibility(tensor: Tensor | None) -> Tensor:
    if tensor is None:
        raise InputError("expected a visibility of every landmark, got none")
    return tensor


def _wrap(mediapipe: ModuleType, image: Image) -> Any:
    return mediapipe.Image(
        image_format=mediapipe.ImageFormat.SRGB, data=np.ascontiguousarray(image)
    )


def _check_confidence(value: float) -> None:
    if not 0 <= value <= 1:
        raise InputError(f"min_confidence must be in 0 to 1, got {value}")


def _require_model(path: str | Path, kind: str) -> Path:
    path = Path(path)
    if not path.is_file():
        raise InputError(
            f"{path}: expected the model file of {kind}, there is no such file; download one that "
            "MediaPipe's models page describes and name it here"
        )
    return path


def _require_mediapipe() -> ModuleType:
    """Return the package, with its Tasks API."""
    try:
        mediapipe = importlib.import_module("mediapipe")
    except ImportError as error:
        raise MissingDependencyError(
            "this needs the package mediapipe, which is not installed; run "
            "`pip install 'torchpose[mediapipe]'` and name a model file, which MediaPipe's models page "
            "describes"
        ) from error
    if not hasattr(mediapipe, "tasks"):
        raise MissingDependencyError(
            f"this needs mediapipe with its Tasks API, got "
            f"{getattr(mediapipe, '__version__', 'an unknown version')}; run "
            "`pip install --upgrade mediapipe`"
        )
    return mediapipe


def _load(task: Any, options: Any, path: Path, kind: str) -> Any:
    """Return the task with its model; MediaPipe's errors depend on its version."""
    try:
        return task.create_from_options(options)
    except (RuntimeError, ValueError, OSError) as error:
        first = str(error).partition("\n")[0]
        raise InputError(
            f"{path}: expected the model file of {kind}; MediaPipe: {first}"
        ) from error
