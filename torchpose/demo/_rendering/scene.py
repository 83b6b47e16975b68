"""Render the room behind the performer, and the noise and flicker of the camera."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchpose._core.images import Image
from torchpose.demo._rendering.look import smooth_noise
from torchpose.demo._rendering.paint import Array
from torchpose.errors import InputError


@dataclass(frozen=True)
class Scene:
    """Holds the settings of room and camera.

    Args:
        clutter: furniture behind the performers, some of the colour of skin; else a bare wall.
        noise: standard deviation of the sensor's noise at middle grey, of 255; it grows with the
            square root of the brightness (shot noise).
        exposure: part of a frame's time for which the shutter is open (motion blur), 0 to 1.
        flicker: standard deviation of the slow change of the illumination, as a share.

    Raises:
        InputError: values out of these ranges.
    """

    clutter: bool = True
    noise: float = 2.5
    exposure: float = 0.5
    flicker: float = 0.0

    def __post_init__(self) -> None:
        if not (0 <= self.noise <= 50 and 0 <= self.exposure <= 1 and 0 <= self.flicker <= 0.2):
            raise InputError(
                "Scene needs noise in [0, 50], exposure in [0, 1] and flicker in [0, 0.2], got "
                f"{self.noise}, {self.exposure} and {self.flicker}"
            )


def room(width: int, height: int, scene: Scene, seed: int = 0) -> Array:
    """Return the background [height, width, 3], float32, 0 to 255.

    Args:
        width, height: pixels. scene: see `Scene`. seed: the seed of the places and shades of the furniture.
    """
    import cv2

    rng = np.random.default_rng([seed, 1])
    wall = np.array([199.0, 203.0, 202.0]) + rng.uniform(-8, 8, 3)
    x, y = np.linspace(0, 1, width)[None], np.linspace(0, 1, height)[:, None]
    light = 1.03 - 0.20 * x - 0.10 * y + 0.05 * np.exp(-8 * ((x - 0.25) ** 2 + (y - 0.1) ** 2))
    picture = (light[..., None] * wall).astype(np.float32)
    if scene.clutter:
        wide = cv2.resize(picture, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
        large = np.clip(wide, 0, 255).astype(np.uint8)
        _furnish(large, rng)
        soft = cv2.GaussianBlur(large, (0, 0), 2 * max(width / 640, 0.4))
        small = cv2.resize(soft, (width, height), interpolation=cv2.INTER_AREA)
        picture = small.astype(np.float32)
    plaster = smooth_noise((height, width), (1.2, 1.2), seed + 11)
    return np.clip(picture + 0.8 * plaster[..., None], 0, 255).astype(np.float32)


def _furnish(picture: Image, rng: np.random.Generator) -> None:
    """Draw a board, a shelf with books, a monitor with a skin-coloured picture, a chair, skirting."""
    import cv2

    height, width = picture.shape[:2]

    def box(left: float, top: float, right: float, bottom: float, colour: NDArray) -> None:
        corners = [(left * width, top * height), (right * width, bottom * height)]
        a, b = ((round(u), round(v)) for u, v in corners)
        cv2.rectangle(picture, a, b, [float(c) for c in colour], -1, cv2.LINE_AA)

    def shade(colour: tuple[float, float, float], spread: float = 6) -> NDArray:
        return np.clip(np.array(colour) + rng.uniform(-spread, spread, 3), 0, 255)

    # Floor and skirting board.
    box(0, 0.90, 1, 1, shade((128, 112, 98)))
    box(0, 0.875, 1, 0.90, shade((222, 222, 218)))
    # A board on the wall, a little askew as boards are.
    shift = rng.uniform(-0.02, 0.02)
    board = np.array([(0.70, 0.16), (0.93, 0.13), (0.935, 0.60), (0.705, 0.585)])
    board[:, 0] += shift
    corners = np.round(board * (width, height) * 16).astype(np.int32)
    frame = np.round(((board - board.mean(0)) * 1.05 + board.mean(0)) * (width, height) * 16)
    cv2.fillPoly(picture, [frame.astype(np.int32)], shade((226, 228, 230)).tolist(), cv2.LINE_AA, 4)
    cv2.fillPoly(picture, [corners], shade((52, 96, 142)).tolist(), cv2.LINE_AA, 4)
    for _ in range(3):  # notes
        u, v = rng.uniform(0.73, 0.88) + shift, rng.uniform(0.2, 0.5)
        box(u, v, u + 0.03, v + 0.05, shade((206, 204, 178), 18))
    # A shelf with books.
    left = 0.03 + rng.uniform(-0.01, 0.02)
    box(left, 0.28, left + 0.20, 0.30, shade((104, 82, 64)))
    at = left + 0.008
    while at < left + 0.165:
        thick, tall = rng.uniform(0.011, 0.02), rng.uniform(0.09, 0.15)
        spine = ((70, 84, 110), (118, 56, 52), (82, 104, 82), (170, 164, 148), (58, 58, 64))
        box(at, 0.28 - tall, at + thick, 0.279, shade(spine[rng.integers(len(spine))], 14))
        at += thick + 0.002
    # A table with a monitor that shows something of the colour of skin.
    box(0, 0.725, 0.235, 0.745, shade((148, 116, 86)))
    box(0.01, 0.745, 0.03, 0.90, shade((112, 88, 66)))
    box(0.195, 0.745, 0.215, 0.90, shade((112, 88, 66)))
    box(0.085, 0.68, 0.115, 0.725, shade((48, 50, 54)))
    box(0.01, 0.43, 0.195, 0.685, shade((36, 38, 42)))
    box(0.02, 0.447, 0.185, 0.668, shade((214, 176, 150)))
    box(0.03, 0.47, 0.10, 0.65, shade((192, 138, 110)))
    # A chair at the right.
    box(0.84, 0.66, 0.985, 0.82, shade((54, 58, 66)))
    box(0.82, 0.80, 1.0, 0.84, shade((44, 47, 54)))
    box(0.90, 0.84, 0.92, 0.98, shade((70, 72, 78)))


class Sensor:
    """Adds noise and flicker, the same in every run with one seed.

    Args:
        width, height: pixels. scene: how much of them. seed: the seed of the noise. fps: for the flicker.
    """

    def __init__(self, width: int, height: int, scene: Scene, seed: int, fps: float) -> None:
        self._rng = np.random.default_rng([seed, 2])
        self._size, self._scene = (width, height), scene
        # Sampling a picture of normal numbers takes longer than all the rest. So one larger picture
        # is sampled, and every frame has another part of it, mirrored at random.
        extra = self._extra = 96 if scene.noise else 0
        if scene.noise:
            bank = self._rng.standard_normal((height + extra, width + extra, 3), dtype=np.float32)
            self._bank = bank
        levels = np.arange(256, dtype=np.float32)
        self._sigma = scene.noise * np.sqrt((levels + 20) / 148)
        self._phase = self._rng.uniform(0, 2 * math.pi, 3)
        self._turn = 2 * math.pi * np.array([0.31, 0.83, 1.9]) / fps

    def __call__(self, image: Image, frame: int) -> Image:
        """Return the image as the sensor records it."""
        import cv2

        if self._scene.flicker:
            wave = np.sin(self._phase + self._turn * frame).sum() * math.sqrt(2 / 3)
            gain = 1 + self._scene.flicker * float(wave)
            table = np.clip(np.round(np.arange(256) * gain), 0, 255).astype(np.uint8)
            image = np.asarray(cv2.LUT(image, table), np.uint8)
        if not self._scene.noise:
            return image
        width, height = self._size
        left, top, flip = self._rng.integers(0, (self._extra + 1, self._extra + 1, 3))
        noise = self._bank[top : top + height, left : left + width]
        if flip:
            noise = np.asarray(cv2.flip(noise, int(flip) - 1), np.float32)
        scaled = cv2.multiply(noise, cv2.LUT(image, self._sigma))
        return np.asarray(cv2.add(image, scaled, dtype=cv2.CV_8U), np.uint8)
