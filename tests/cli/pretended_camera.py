"""A camera that plays images, in place of the one before which `torchpose track 0` runs."""

from collections.abc import Callable, Iterable
from types import SimpleNamespace
from typing import Any

import cv2

from torchpose.video._camera import CameraSource


class PretendedCamera:
    """Plays images at 30 a second of its own clock.

    Args:
        images: BGR. missed: whether a frame is missed before the next image, by how many are left.
    """

    def __init__(
        self, images: Iterable[Any], missed: Callable[[int], bool] = lambda left: False
    ) -> None:
        self.left, self.missed, self.now = list(images), missed, 0.0

    def isOpened(self):
        return True

    def read(self):
        self.now += (1 + self.missed(len(self.left))) / 30
        return (True, self.left.pop(0)) if self.left else (False, None)

    def get(self, prop):
        return 30.0 if prop == cv2.CAP_PROP_FPS else 0.0

    def set(self, prop, value):
        return True

    def release(self):
        pass


def use_camera(monkeypatch, camera: PretendedCamera) -> None:
    """Let the command open this camera, whose clock is the only one."""
    clock = SimpleNamespace(perf_counter=lambda: camera.now, sleep=lambda seconds: None)
    monkeypatch.setattr("torchpose.video._camera.time", clock)
    monkeypatch.setattr(
        "torchpose.video.open_video",
        lambda where, fps=None: CameraSource(int(where), fps, capture=lambda index: camera),
    )
