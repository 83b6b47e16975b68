"""Paint shaded limbs, filled outlines and sprites on a float image, with soft edges."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

LIGHT = (-0.38, -0.52, 0.765)
"""Direction to the lamp: x right, y down in the image, z towards the camera."""

_AMBIENT, _DIFFUSE, _ROOT = 0.52, 0.56, 0.90


class Box(NamedTuple):
    """Holds a part of an image, pixels; right and bottom are outside."""

    left: int
    top: int
    right: int
    bottom: int

    @classmethod
    def around(cls, points: NDArray, margin: float, shape: tuple[int, ...]) -> "Box":
        """Return the box of points [N, 2] with a margin, cut to an image of shape (height, width, ...)."""
        low, high = points.min(0) - margin, points.max(0) + margin + 1
        left, top = (min(max(math.floor(v), 0), s) for v, s in zip(low, shape[1::-1], strict=True))
        right, bottom = (
            min(max(math.ceil(v), 0), s) for v, s in zip(high, shape[1::-1], strict=True)
        )
        return cls(left, top, max(right, left), max(bottom, top))

    @property
    def empty(self) -> bool:
        """Return whether the box has no pixels."""
        return self.right <= self.left or self.bottom <= self.top

    def of(self, image: NDArray) -> NDArray:
        """Return that part of the image, as a view."""
        return image[self.top : self.bottom, self.left : self.right]


class Capsule(NamedTuple):
    """Holds a tapered limb in the image: two round ends (x, y), radii, pixels.

    With `bulge` the second end is cut off, that many radii beyond the point.
    """

    start: tuple[float, float]
    end: tuple[float, float]
    radius_start: float
    radius_end: float
    bulge: float | None = None

    def box(self, shape: tuple[int, ...]) -> Box:
        """Return the part of an image that it may cover."""
        ends = np.array([self.start, self.end])
        return Box.around(ends, max(self.radius_start, self.radius_end) + 1, shape)

    def field(self, box: Box) -> tuple[Array, Array, Array]:
        """Return the opacity, place along the limb (0 to 1) and across it (-1 to 1) in the box.

        The opacity falls from 1 to 0 over one pixel about the edge.
        """
        bulge = math.inf if self.bulge is None else self.bulge * self.radius_end
        x = np.arange(box.left, box.right, dtype=np.float32)[None]
        y = np.arange(box.top, box.bottom, dtype=np.float32)[:, None]
        dx, dy = self.end[0] - self.start[0], self.end[1] - self.start[1]
        square = max(dx * dx + dy * dy, 1e-6)
        length = math.sqrt(square)
        x, y = x - np.float32(self.start[0]), y - np.float32(self.start[1])
        free = x * np.float32(dx / square) + y * np.float32(dy / square)
        along = np.clip(free, 0, 1)
        taper = np.float32(self.radius_end - self.radius_start)
        radius = along * taper + np.float32(self.radius_start)
        off_x, off_y = x - along * np.float32(dx), y - along * np.float32(dy)
        distance = np.sqrt(off_x * off_x + off_y * off_y)
        edge = radius - distance
        if bulge < math.inf:
            edge = np.minimum(edge, (1 - free) * np.float32(length) + np.float32(bulge))
        alpha = np.clip(edge + np.float32(0.5), 0, 1)
        if length < 1e-2:
            return alpha, along, off_x / radius
        across = (off_y * np.float32(dx / length) - off_x * np.float32(dy / length)) / radius
        return alpha, along, across


def paint_capsule(
    canvas: Array,
    limb: Capsule,
    colour: NDArray,
    folds: float = 0.0,
    root: float = 0.0,
) -> None:
    """Paint a limb, shaded as a cylinder.

    Args:
        canvas: [H, W, 3] float32, painted on. limb: where. colour: [3].
        folds: strength of the creases of a sleeve. root: share of the length over which the limb
            fades in from the part that it is joined to.
    """
    box = limb.box(canvas.shape)
    if box.empty:
        return
    alpha, along, across = limb.field(box)
    shade = _lit(limb, across)
    if folds:
        wave = np.sin(along * np.float32(15.0) + across * np.float32(2.5) + np.float32(0.6))
        crease = wave * np.sin(along * np.float32(6.3) - across * np.float32(1.7))
        shade = shade * (1 + np.float32(folds) * crease)
    if root:
        grown = np.clip(along / np.float32(root), 0, 1)
        shade = np.float32(_ROOT) + (grown * grown * (3 - 2 * grown)) * (shade - np.float32(_ROOT))
    picture = shade[..., None] * np.asarray(colour, np.float32)
    _blend(box.of(canvas), picture, alpha)


def _lit(limb: Capsule, across: Array) -> Array:
    """Return the brightness of a cylinder: ambient light and Lambert's law."""
    dx, dy = limb.end[0] - limb.start[0], limb.end[1] - limb.start[1]
    length = max(math.hypot(dx, dy), 1e-2)
    sideways = (-dy * LIGHT[0] + dx * LIGHT[1]) / length
    across = np.clip(across, -1, 1)
    outwards = np.sqrt(1 - across * across)
    light = across * np.float32(sideways) + outwards * np.float32(LIGHT[2])
    return np.float32(_AMBIENT) + np.float32(_DIFFUSE) * np.maximum(light, 0)


def polygon_box(points: NDArray, shape: tuple[int, ...]) -> Box:
    """Return the part of an image that a filled outline may cover."""
    return Box.around(points, 1, shape)


def paint_polygon(canvas: Array, points: NDArray, texture: Array, to_image: NDArray) -> None:
    """Paint an outline filled with a texture.

    Args:
        canvas: [H, W, 3] float32, painted on. points: outline [N, 2], pixels.
        texture: [h, w, 3], float32. to_image: affine map [2, 3] from its pixels to the image's.
    """
    import cv2

    box = polygon_box(points, canvas.shape)
    if box.empty:
        return
    size = (box.right - box.left, box.bottom - box.top)
    alpha = polygon_alpha(points, box)
    shifted = np.array(to_image, np.float64)
    shifted[:, 2] -= (box.left, box.top)
    picture = cv2.warpAffine(
        texture, shifted, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    _blend(box.of(canvas), picture, alpha)


def polygon_alpha(points: NDArray, box: Box) -> Array:
    """Return the opacity of a filled outline in a box, edges antialiased."""
    import cv2

    mask = np.zeros((box.bottom - box.top, box.right - box.left), np.uint8)
    fixed = np.round(16 * (points - (box.left, box.top))).astype(np.int32)
    cv2.fillPoly(mask, [fixed], 255, cv2.LINE_AA, 4)
    return mask.astype(np.float32) / np.float32(255)


class Sprite(NamedTuple):
    """Holds a picture with opacity, also at half, a quarter, ... of its size.

    Attributes:
        levels: [h, w, 4] float32 each: red, green, blue times opacity (0 to 255), opacity (0 to 1).
        origin: its place in the first level, pixels. scale: metres per pixel of the first level.
    """

    levels: tuple[Array, ...]
    origin: tuple[float, float]
    scale: float

    @classmethod
    def of(
        cls, rgb: NDArray, alpha: NDArray, origin: tuple[float, float], scale: float
    ) -> "Sprite":
        """Return the sprite of a picture [h, w, 3], 0 to 255, and its opacity [h, w], 0 to 1."""
        import cv2

        alpha = np.asarray(alpha, np.float32)[..., None]
        level = np.concatenate([np.asarray(rgb, np.float32) * alpha, alpha], -1)
        levels = [level]
        while min(level.shape[:2]) >= 24:
            level = cv2.resize(level, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            levels.append(level)
        return cls(tuple(levels), origin, scale)


def paint_sprite(canvas: Array, sprite: Sprite, place: NDArray, axes: NDArray) -> None:
    """Paint a sprite, rotated and foreshortened.

    Args:
        canvas: [H, W, 3] float32, painted on. place: of its origin in the image [2], pixels.
        axes: [2, 2] columns: pixels of the image for a metre of the sprite's x and y.
    """
    box, level, to_image = place_sprite(canvas.shape, sprite, place, axes)
    if box.empty:
        return
    warped = warp_sprite(box, level, to_image)
    target = box.of(canvas)
    target *= 1 - warped[..., 3:]
    target += warped[..., :3]


def place_sprite(
    shape: tuple[int, ...], sprite: Sprite, place: NDArray, axes: NDArray
) -> tuple[Box, Array, NDArray]:
    """Return the box in the image, level of the sprite with about as many pixels, map between the two."""
    per_pixel = np.asarray(axes, np.float64) * sprite.scale
    size = max(float(np.sqrt(abs(np.linalg.det(per_pixel)))), 1e-6)
    n = min(max(math.floor(math.log2(1 / size) + 0.2), 0), len(sprite.levels) - 1)
    level, factor = sprite.levels[n], 2.0**n
    linear = per_pixel * factor
    origin = (np.asarray(sprite.origin) + 0.5) / factor - 0.5
    to_image = np.concatenate([linear, (place - linear @ origin)[:, None]], 1)
    height, width = level.shape[:2]
    corners = np.array([(0, 0), (width, 0), (0, height), (width, height)], np.float64) - 0.5
    box = Box.around(corners @ linear.T + to_image[:, 2], 1, shape)
    return box, level, to_image


def warp_sprite(box: Box, level: Array, to_image: NDArray) -> Array:
    """Return the sprite as it appears in the box [h, w, 4]."""
    import cv2

    shifted = to_image.copy()
    shifted[:, 2] -= (box.left, box.top)
    size = (box.right - box.left, box.bottom - box.top)
    warped = cv2.warpAffine(
        level, shifted, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
    )
    return np.asarray(warped, np.float32)


def _blend(target: Array, picture: NDArray, alpha: Array) -> None:
    target += alpha[..., None] * (picture - target)
