"""Bones, joints and ellipses drawn into images, with outlines that show on any picture."""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

__all__ = ["Color", "Pen", "rgb"]

Image = NDArray[np.uint8]
Color = tuple[int, int, int]

_LIGHT, _DARK = (255, 255, 255), (20, 20, 20)
_SHIFT = 3  # cv2 takes coordinates in eighths of a pixel
_REACH = 8  # what lies further out than so many image sizes is nonsense, and is left out


class Pen:
    """cv2 with outlines, in widths that fit the image; skips what cannot be drawn."""

    def __init__(self, canvas: Image) -> None:
        height, width = canvas.shape[:2]
        self.canvas = canvas
        self.scale = math.sqrt(height * width / (640 * 480))
        self.limit = _REACH * max(height, width)
        self.bone_width = max(1, round(3 * self.scale))
        self.edge = max(1, round(self.scale))
        self.thin = max(1, round(0.6 * self.scale))
        self.radius = max(1.5, 4.5 * self.scale)

    def drawable(self, *numbers: float) -> bool:
        return all(math.isfinite(n) and abs(n) <= self.limit for n in numbers)

    def bone(self, a: list[float], b: list[float], color: Color) -> None:
        if self.drawable(*a, *b):
            self.line(a, b, _outline(color), self.bone_width + 2 * self.edge)
            self.line(a, b, color, self.bone_width)

    def line(self, a: list[float], b: list[float], color: Color, width: int) -> None:
        import cv2

        cv2.line(self.canvas, _fixed(a), _fixed(b), color, width, cv2.LINE_AA, _SHIFT)

    def joint(self, point: list[float], color: Color, filled: bool) -> None:
        import cv2

        if not self.drawable(*point):
            return
        around, inner = _outline(color), self.radius - 1.5 * self.edge
        rings = [(self.radius + self.edge, around), (self.radius, color)]
        for radius, paint in rings if filled else [*rings, (max(inner, 0.0), around)]:
            size = max(1, round(radius * (1 << _SHIFT)))
            cv2.circle(self.canvas, _fixed(point), size, paint, -1, cv2.LINE_AA, _SHIFT)

    def ellipse(
        self, point: list[float], shape: list[float], color: Color, outlined: bool = False
    ) -> None:
        import cv2

        if not (self.drawable(*point, *shape[:2]) and math.isfinite(shape[2])):
            return
        strokes = [(_outline(color), 2 * self.edge + self.thin)] if outlined else []
        for paint, width in [*strokes, (color, self.thin)]:
            cv2.ellipse(
                self.canvas, _fixed(point), _fixed(shape[:2]), shape[2], 0, 360, paint, width,
                cv2.LINE_AA, _SHIFT,
            )  # fmt: skip

    def box(self, face: list[float], color: Color) -> None:
        import cv2

        if self.drawable(*face):
            x, y, half = face[0], face[1], face[2] / 2
            corners = _fixed([x - half, y - half]), _fixed([x + half, y + half])
            for paint, width in ((_outline(color), self.edge + 2), (color, self.edge)):
                cv2.rectangle(self.canvas, *corners, paint, width, cv2.LINE_AA, _SHIFT)

    def cross(self, point: list[float], color: Color) -> None:
        if self.drawable(*point):
            arm = 1.6 * self.radius
            for paint, width in ((_outline(color), 3 * self.edge), (color, self.edge)):
                for dx, dy in ((arm, arm), (arm, -arm)):
                    ends = [point[0] - dx, point[1] - dy], [point[0] + dx, point[1] + dy]
                    self.line(*ends, paint, width)

    def label(self, text: str, joints: list[list[float]], head: int, color: Color) -> None:
        """Over the head, else over the highest joint that is there, and inside the image."""
        import cv2

        there = [joint for joint in joints if self.drawable(*joint)]
        if not text or not there:
            return
        text = text.encode("ascii", "replace").decode()  # all that cv2's letters have
        size = max(0.35, 0.5 * self.scale)
        (width, height), base = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, self.edge)
        over = joints[head]
        x, y = over if over in there else min(there, key=lambda joint: joint[1])
        rows, columns = self.canvas.shape[:2]
        left = round(min(max(x - width / 2, 2), max(2, columns - width - 2)))
        top = y - 10 * self.radius - base
        bottom = round(min(max(top, height + 2), max(height + 2, rows - base - 2)))
        for paint, stroke in ((_outline(color), 3 * self.edge), (color, self.edge)):
            cv2.putText(
                self.canvas, text, (left, bottom), cv2.FONT_HERSHEY_SIMPLEX, size, paint, stroke,
                cv2.LINE_AA,
            )  # fmt: skip


def _fixed(point: list[float]) -> tuple[int, int]:
    return round(point[0] * (1 << _SHIFT)), round(point[1] * (1 << _SHIFT))


@lru_cache(maxsize=32)
def rgb(text: str) -> Color:
    return int(text[1:3], 16), int(text[3:5], 16), int(text[5:7], 16)


@lru_cache(maxsize=32)
def _outline(color: Color) -> Color:
    """Black around light colours, white around dark ones, so that both show on any picture."""
    return _DARK if 0.3 * color[0] + 0.59 * color[1] + 0.11 * color[2] > 140 else _LIGHT
