"""Few frames of a performance, and pictures of chosen parts of it."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch

from torchpose.demo import demo_camera
from torchpose.demo._mannequin import BodyAngles
from torchpose.demo._performer import Performance, stage
from torchpose.demo._rendering import LOOKS
from torchpose.demo._rendering.look import wardrobe
from torchpose.demo._rendering.parts import Part, bodies
from torchpose.demo._rendering.performer import parts_at

CAMERA = demo_camera()
K = CAMERA.matrix.numpy()


def sampled(performance: Performance, frames: Sequence[int]) -> Performance:
    """Only some frames; for a shutter that is open for no time."""
    chosen = list(frames)
    angles = BodyAngles(*(x[chosen] for x in performance.angles))
    labels = tuple(performance.labels[i] for i in chosen)
    return stage(angles, labels, performance.fps, distance=float(performance.translation[2]))


def posture(left: dict[str, float], right: dict[str, float], distance: float = 2.0) -> Performance:
    """One frame of somebody who stands upright; angles of the arms in degrees."""
    names = ("abduction", "flexion", "twist", "elbow")
    arms = [[math.radians(side.get(n, 5.0)) for n in names] for side in (left, right)]
    zero = torch.zeros(1, 3, dtype=torch.float64)
    angles = BodyAngles(zero, zero, zero, torch.tensor([arms], dtype=torch.float64))
    return stage(angles, ("posture",), 30.0, distance=distance)


def painted(
    performance: Performance, frame: int, keep: Callable[[Part], bool] = lambda part: True
) -> np.ndarray:
    """The chosen parts on grey [480, 640, 3], far ones first, without blur, noise and room."""
    worn = [wardrobe(LOOKS["dark sleeves"])]
    parts = parts_at([bodies(performance)], worn, K, frame)
    canvas = np.full((480, 640, 3), 120, np.float32)
    for part in sorted(parts, key=lambda p: -p.depth):
        if keep(part):
            part.brush.paint(canvas)
    return canvas
