"""Define the appearance of the performer: clothes, skin, head, textures of torso, neck and hands.

Head and skin are cut out of a portrait (`grace_hopper.jpg`, in the public domain) that comes with
matplotlib. It is read from there and not copied.
"""

from functools import lru_cache
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchpose._core.images import Image
from torchpose.demo._rendering.paint import Array, Capsule, Sprite, paint_capsule
from torchpose.errors import InputError, MissingDependencyError

Colour = tuple[float, float, float]

# Left, top (metres on the torso, from the neck) and pixels per metre of the torso's texture.
TORSO_TEXTURE = (-0.32, -0.12, 250.0)
_HAND_SCALE = 0.00102  # metres per pixel of a hand's sprite
_HAND_ORIGIN = (106.0, 66.0)

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


class Look(NamedTuple):
    """Holds the clothes of a performer.

    Attributes:
        clothes, trousers: colours, red, green, blue, 0 to 255.
        sleeves: "long", or "short" with bare forearms.
        mirrored: the portrait with left and right exchanged. tone: factors on the skin's colour.
    """

    clothes: Colour
    trousers: Colour = (44.0, 52.0, 74.0)
    sleeves: Literal["long", "short"] = "long"
    mirrored: bool = False
    tone: Colour = (1.0, 1.0, 1.0)


LOOKS = {
    "dark sleeves": Look((47.0, 51.0, 62.0)),
    "short sleeves": Look((96.0, 104.0, 108.0), (50.0, 54.0, 56.0), "short"),
    "skin-coloured jumper": Look((196.0, 128.0, 92.0), (62.0, 70.0, 92.0)),
}
"""Looks by name, in ascending difficulty of finding hands by colour."""


class Wardrobe(NamedTuple):
    """Holds the colours and textures of a look.

    Attributes:
        look: as given. portrait: head, neck, skin. skin: colour of bare arms [3].
        torso: texture of the clothes, see `TORSO_TEXTURE`. neck: texture of the neck.
        hand: sprite of an open hand: x along the fingers, y to the thumb, about the hand joint.
    """

    look: Look
    portrait: Portrait
    skin: Array
    torso: Array
    neck: Array
    hand: Sprite


@lru_cache(maxsize=8)
def wardrobe(look: Look) -> Wardrobe:
    """Return the textures of a look.

    Raises:
        MissingDependencyError: matplotlib is not installed. InputError: colours that are none.
    """
    colours = np.array([look.clothes, look.trousers], np.float64)
    if not ((colours >= 0) & (colours <= 255)).all() or look.sleeves not in ("long", "short"):
        raise InputError(
            "Look needs colours of three numbers from 0 to 255 and sleeves 'long' or 'short', got "
            f"{look}"
        )
    portrait = load_portrait(look.mirrored, look.tone)
    skin = portrait.skin
    return Wardrobe(
        look, portrait, skin, _torso(np.asarray(look.clothes, np.float32)), _neck(portrait),
        _hand(portrait, look.sleeves == "short"),
    )  # fmt: skip


def smooth_noise(shape: tuple[int, int], sigma: tuple[float, float], seed: int) -> Array:
    """Return the Gaussian noise [h, w] of unit variance, smoothed by (vertical, horizontal) pixels."""
    import cv2

    white = np.random.default_rng(seed).standard_normal(shape).astype(np.float32)
    noise = np.asarray(cv2.GaussianBlur(white, (0, 0), sigmaX=sigma[1], sigmaY=sigma[0]))
    return noise.astype(np.float32) / max(float(noise.std()), 1e-6)


def _torso(colour: Array) -> Array:
    left, top, scale = TORSO_TEXTURE
    height, width = round(0.82 * scale), round(-2 * left * scale)
    x = (left + (np.arange(width) + 0.5) / scale)[None] + np.zeros((height, 1))
    y = (top + (np.arange(height) + 0.5) / scale)[:, None] + np.zeros((1, width))
    across = np.clip(x / 0.20, -1, 1)
    # A barrel lit from the upper left, darker towards the hem, with soft upright folds.
    light = 0.64 + 0.38 * np.sqrt(1 - 0.85 * across**2) - 0.04 * across - 0.16 * (y - 0.1)
    folds = smooth_noise((height, width), (0.045 * scale, 0.012 * scale), 5)
    folds += 0.4 * smooth_noise((height, width), (0.012 * scale, 0.05 * scale), 6)
    light *= 1 + 0.03 * folds * np.clip((y - 0.05) / 0.2, 0.2, 1)
    ring = np.exp(-0.5 * ((np.hypot(x / 0.070, (y + 0.068) / 0.070) - 1) / 0.08) ** 2)
    hem = np.exp(-0.5 * ((y - 0.535) / 0.004) ** 2)
    light *= 1 - 0.22 * ring - 0.25 * hem
    return np.clip(light[..., None] * colour, 0, 255).astype(np.float32)


def _neck(portrait: Portrait) -> Array:
    """Return the portrait's neck, rounded, in the shadow of the chin."""
    import cv2

    skin = cv2.resize(portrait.neck, (64, 64), interpolation=cv2.INTER_LINEAR)
    across = np.linspace(-1, 1, 64)[None]
    down = np.linspace(0, 1, 64)[:, None]
    light = (0.60 + 0.40 * np.sqrt(1 - 0.9 * across**2)) * (
        0.60 + 0.46 * np.clip(1.6 * down - 0.2, 0, 1)
    )
    # A little of the cheek's colour: the portrait's own neck lies in deep shadow.
    skin = cv2.GaussianBlur(skin, (0, 0), 1.5)
    tone = 0.35 * skin + 0.65 * portrait.skin * (skin.mean(-1, keepdims=True) / skin.mean())
    return np.clip(tone * light[..., None], 0, 255).astype(np.float32)


def _hand(portrait: Portrait, bare: bool) -> Sprite:
    """Return a relaxed open hand: palm, four fingers and a thumb, each lit as a round thing."""
    import cv2

    x0, y0 = _HAND_ORIGIN
    shape = (150, 218)
    canvas = np.zeros((*shape, 3), np.float32)
    alpha = np.zeros(shape, np.float32)

    def add(limb: Capsule, colour: NDArray) -> None:
        paint_capsule(canvas, limb, colour)
        box = limb.box(shape)
        view = box.of(alpha)
        np.maximum(view, limb.field(box)[0], out=view)

    def limb(ax: float, ay: float, bx: float, by: float, ra: float, rb: float) -> Capsule:
        return Capsule((x0 + ax, y0 + ay), (x0 + bx, y0 + by), ra, rb)

    skin = 1.08 * portrait.skin
    # Pixels from the hand joint; the wrist is at x = -60.
    add(limb(-102, 0, -40, 0, 25, 30), skin)
    add(limb(-22, 4, -4, 0, 33, 39), skin)
    fingers = ((-31, 8, 58, -37, 9.5, 7.5), (-11, 16, 79, -14, 10, 8), (10, 17, 84, 11, 10, 8),
               (30, 14, 73, 36, 10, 8))  # fmt: skip
    for root, x, tip_x, tip_y, wide, narrow in fingers:
        add(limb(x - 12, root, tip_x, tip_y, wide, narrow), 0.98 * skin)
    add(limb(-34, 26, 24, 62, 15, 9), 1.0 * skin)
    palm = np.exp(-0.5 * ((np.arange(shape[1]) - x0 - 2)[None] / 24) ** 2)
    palm = palm * np.exp(-0.5 * ((np.arange(shape[0]) - y0)[:, None] / 30) ** 2)
    canvas += 0.75 * palm[..., None].astype(np.float32) * (skin - canvas)
    cheek = cv2.resize(portrait.cheek, shape[::-1], interpolation=cv2.INTER_CUBIC)
    grain = cheek / np.maximum(cv2.GaussianBlur(cheek, (0, 0), 25), 1)
    mottled = smooth_noise(shape, (9, 9), 8)[..., None]
    canvas *= np.clip(grain, 0.85, 1.15) * (1 + 0.03 * mottled)
    # A bare wrist fades into the forearm, another one ends within its cuff.
    start, width = (98, 20) if bare else (69, 3)
    wrist = np.clip((np.arange(shape[1]) - x0 + start) / width, 0, 1)[None]
    soft = cv2.GaussianBlur(alpha, (0, 0), 1.0) * wrist
    return Sprite.of(np.clip(canvas, 0, 255), soft, _HAND_ORIGIN, _HAND_SCALE)


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
