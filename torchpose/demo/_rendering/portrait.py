"""Cut head, neck and skin of the performer out of a portrait that comes with matplotlib.

The portrait (`grace_hopper.jpg`, in the public domain) is read from matplotlib and not copied. A sprite
is a small picture with opacity, in metres about an origin of its own.
"""

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchpose._core.images import Image
from torchpose.errors import InputError, MissingDependencyError

__all__ = ["FACE_BOX", "Portrait", "Sprite", "load_portrait"]

Array = NDArray[np.float32]

FACE_BOX = 0.165
"""Side of the Haar cascade's bounding box of an adult's face, metres."""

# Pixels of the portrait: the middle of its Haar box, a side, the outline of the head with hat and
# hair, and rectangles (left, top, right, bottom) of nothing but skin. The box on the portrait itself
# is 228 pixels wide; about the small heads of rendered frames the cascade draws a larger one.
_FACE, _FACE_SIDE = (267.0, 219.0), 258.0
_HEAD = (
    (262, 23), (284, 26), (298, 36), (305, 42), (325, 51), (341, 65), (351, 80), (355, 87), (362, 87),
    (367, 96), (370, 120), (370, 150), (368, 180), (374, 190), (374, 206), (368, 226), (363, 248),
    (359, 262), (360, 280), (354, 294), (344, 302), (335, 299), (326, 308), (316, 319), (304, 328),
    (290, 333), (264, 335), (242, 333), (224, 326), (216, 316), (208, 301), (196, 296), (180, 289),
    (166, 281), (159, 268), (161, 250), (163, 236), (157, 215), (154, 205), (154, 195), (157, 185),
    (154, 170), (152, 150), (152, 125), (155, 106), (161, 94), (173, 86), (175, 80), (182, 65),
    (192, 53), (206, 44), (218, 40), (224, 32), (237, 25), (250, 23),
)  # fmt: skip
_NECK = (226, 344, 304, 384)
_SATURATION = 0.8
_CHEEKS = ((196, 232, 216, 262), (318, 236, 338, 266))


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


class Portrait(NamedTuple):
    """Holds the parts of the portrait.

    Attributes:
        head: sprite about the middle of the face, scaled to FACE_BOX.
        neck: skin of the neck [h, w, 3]. cheek: smooth skin [h, w, 3].
        skin: median colour of the cheeks [3]. All 0 to 255, red, green, blue, float32.
    """

    head: Sprite
    neck: Array
    cheek: Array
    skin: Array


@lru_cache(maxsize=8)
def load_portrait(mirrored: bool = False, tone: tuple[float, float, float] = (1, 1, 1)) -> Portrait:
    """Return the parts of the portrait.

    Args:
        mirrored: whether left and right are exchanged, so that performers differ.
        tone: factors of red, green and blue, for another complexion.

    Raises:
        MissingDependencyError: matplotlib is not installed. InputError: one without the portrait.
    """
    import cv2

    picture = _read().astype(np.float32)
    grey = picture.mean(-1, keepdims=True)
    picture = grey + _SATURATION * (picture - grey)  # as pale as a webcam shows skin
    picture = np.clip(picture * np.asarray(tone, np.float32), 0, 255)
    alpha = np.zeros(picture.shape[:2], np.uint8)
    cv2.fillPoly(alpha, [_smooth(np.array(_HEAD, np.float64))], 255, cv2.LINE_AA, 4)
    alpha = cv2.GaussianBlur(alpha, (0, 0), 1.3).astype(np.float32) / 255
    # Soft, but inwards only: half-transparent pixels would carry the portrait's background along.
    alpha = np.clip(2 * alpha - 1, 0, 1)
    top, bottom, left, right = 10, 345, 140, 390
    crop, mask = picture[top:bottom, left:right], alpha[top:bottom, left:right]
    x, y = _FACE[0] - left, _FACE[1] - top
    neck = _cut(picture, _NECK)
    cheeks = [cv2.resize(_cut(picture, box), (20, 30)) for box in _CHEEKS]
    cheek = np.concatenate(cheeks, 1).astype(np.float32)
    skin = np.median(cheek.reshape(-1, 3), 0)
    if mirrored:
        crop, mask, x, neck = crop[:, ::-1], mask[:, ::-1], crop.shape[1] - 1 - x, neck[:, ::-1]
    head = Sprite.of(crop, mask, (x, y), FACE_BOX / _FACE_SIDE)
    return Portrait(head, np.ascontiguousarray(neck), cheek, skin.astype(np.float32))


def _read() -> Image:
    try:
        from matplotlib import cbook
    except ImportError as error:
        raise MissingDependencyError(
            "the rendered performer has the face of a portrait that comes with matplotlib, which is "
            "not installed; `python -m pip install matplotlib` brings it"
        ) from error
    import cv2

    path = Path(str(cbook.get_sample_data("grace_hopper.jpg", asfileobj=False)))
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None
    if picture is None:
        raise InputError(f"{path}: expected matplotlib's sample image; reinstall matplotlib")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8)


def _cut(picture: Array, box: tuple[int, int, int, int]) -> Array:
    left, top, right, bottom = box
    return picture[top:bottom, left:right]


def _smooth(outline: NDArray) -> NDArray:
    """Return an outline with corners cut twice (Chaikin), in sixteenths of a pixel."""
    for _ in range(2):
        following = np.roll(outline, -1, 0)
        pair = np.stack([0.75 * outline + 0.25 * following, 0.25 * outline + 0.75 * following], 1)
        outline = pair.reshape(-1, 2)
    return np.round(16 * outline).astype(np.int32)
