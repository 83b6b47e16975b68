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
        _Furniture(large, rng).draw()
        soft = cv2.GaussianBlur(large, (0, 0), 2 * max(width / 640, 0.4))
        small = cv2.resize(soft, (width, height), interpolation=cv2.INTER_AREA)
        picture = small.astype(np.float32)
    plaster = smooth_noise((height, width), (1.2, 1.2), seed + 11)
    return np.clip(picture + 0.8 * plaster[..., None], 0, 255).astype(np.float32)


class _Furniture:
    """Draws furniture into the picture of a room, some of it of the colour of skin."""

    def __init__(self, picture: Image, rng: np.random.Generator) -> None:
        self._picture, self._rng = picture, rng
        self._size = picture.shape[1], picture.shape[0]

    def draw(self) -> None:
        """Draw all of it."""
        self._floor()
        self._board()
        self._shelf()
        self._table()
        self._chair()

    def _box(self, left: float, top: float, right: float, bottom: float, colour: NDArray) -> None:
        import cv2

        width, height = self._size
        corners = [(left * width, top * height), (right * width, bottom * height)]
        a, b = ((round(u), round(v)) for u, v in corners)
        cv2.rectangle(self._picture, a, b, [float(c) for c in colour], -1, cv2.LINE_AA)

    def _shade(self, colour: tuple[float, float, float], spread: float = 6) -> NDArray:
        return np.clip(np.array(colour) + self._rng.uniform(-spread, spread, 3), 0, 255)

    def _floor(self) -> None:
        """Draw the floor and the skirting board."""
        self._box(0, 0.90, 1, 1, self._shade((128, 112, 98)))
        self._box(0, 0.875, 1, 0.90, self._shade((222, 222, 218)))

    def _board(self) -> None:
        """Draw a board with notes on the wall, a little askew as boards are."""
        shift = self._rng.uniform(-0.02, 0.02)
        board = np.array([(0.70, 0.16), (0.93, 0.13), (0.935, 0.60), (0.705, 0.585)])
        board[:, 0] += shift
        middle = board.mean(0)
        self._polygon((board - middle) * 1.05 + middle, self._shade((226, 228, 230)))
        self._polygon(board, self._shade((52, 96, 142)))
        for _ in range(3):
            u, v = self._rng.uniform(0.73, 0.88) + shift, self._rng.uniform(0.2, 0.5)
            self._box(u, v, u + 0.03, v + 0.05, self._shade((206, 204, 178), 18))

    def _polygon(self, corners: NDArray, colour: NDArray) -> None:
        import cv2

        sixteenths = np.round(corners * self._size * 16).astype(np.int32)
        cv2.fillPoly(self._picture, [sixteenths], colour.tolist(), cv2.LINE_AA, 4)

    def _shelf(self) -> None:
        """Draw a shelf with books."""
        left = 0.03 + self._rng.uniform(-0.01, 0.02)
        self._box(left, 0.28, left + 0.20, 0.30, self._shade((104, 82, 64)))
        spine = ((70, 84, 110), (118, 56, 52), (82, 104, 82), (170, 164, 148), (58, 58, 64))
        at = left + 0.008
        while at < left + 0.165:
            thick, tall = self._rng.uniform(0.011, 0.02), self._rng.uniform(0.09, 0.15)
            shade = self._shade(spine[self._rng.integers(len(spine))], 14)
            self._box(at, 0.28 - tall, at + thick, 0.279, shade)
            at += thick + 0.002

    def _table(self) -> None:
        """Draw a table with a monitor that shows something of the colour of skin."""
        self._box(0, 0.725, 0.235, 0.745, self._shade((148, 116, 86)))
        self._box(0.01, 0.745, 0.03, 0.90, self._shade((112, 88, 66)))
        self._box(0.195, 0.745, 0.215, 0.90, self._shade((112, 88, 66)))
        self._box(0.085, 0.68, 0.115, 0.725, self._shade((48, 50, 54)))
        self._box(0.01, 0.43, 0.195, 0.685, self._shade((36, 38, 42)))
        self._box(0.02, 0.447, 0.185, 0.668, self._shade((214, 176, 150)))
        self._box(0.03, 0.47, 0.10, 0.65, self._shade((192, 138, 110)))

    def _chair(self) -> None:
        """Draw a chair at the right."""
        self._box(0.84, 0.66, 0.985, 0.82, self._shade((54, 58, 66)))
        self._box(0.82, 0.80, 1.0, 0.84, self._shade((44, 47, 54)))
        self._box(0.90, 0.84, 0.92, 0.98, self._shade((70, 72, 78)))


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
