"""Detect keypoints by a pose landmarker of MediaPipe."""

from pathlib import Path

from torch import Tensor

from torchpose._core.images import Image
from torchpose.measure._mediapipe import MediaPipePose


class MediaPipeDetector:
    """Detects the landmarks of all persons; frames are taken to be equally far apart.

    Args:
        path: file of a pose landmarker (.task). fps: frames per second. max_persons: most that are detected.

    Attributes:
        names: of the 33 landmarks, head, neck and hands. neck: kind of that neck.

    Raises:
        MissingDependencyError: no mediapipe. InputError: no such file, or another kind of model.
    """

    names = MediaPipePose.names
    neck = "neck"

    def __init__(self, path: Path, fps: float = 30.0, max_persons: int = 1) -> None:
        self._settings, self._fps = (path, max_persons), fps
        self._pose, self._frame = MediaPipePose(*self._settings), 0

    def reset(self) -> None:
        """Begin another video, without the persons whom the model followed."""
        if self._frame:
            self._pose.close()
            self._pose, self._frame = MediaPipePose(*self._settings), 0

    def __call__(self, image: Image) -> tuple[Tensor, Tensor]:
        """Return landmarks [N, 37, 2], pixels, and their visibility [N, 37]."""
        found = self._pose(image, self._frame / self._fps)
        self._frame += 1
        return found.points, found.visibility.clamp(0.0, 1.0)
