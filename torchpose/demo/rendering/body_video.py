"""Videos of a whole body in calibrated cameras: shaded limbs before a wall, and the empty scene.

The body is painted as the protocols' outlines are: other limbs, other radii and a trunk of other pieces
than the body that a tracker moves.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpose.body.limbs import Limbs
from torchpose.body.skeleton import BODY_15
from torchpose.camera.pinhole import PinholeCamera
from torchpose.demo.rendering.clothed_body import TrueShape, limb_kinds, true_limbs
from torchpose.demo.rendering.gait import Walk
from torchpose.demo.rendering.look import smooth_noise
from torchpose.demo.rendering.paint import Capsule, paint_capsule
from torchpose.errors import InputError
from torchpose.io.mocap import MocapClip

__all__ = ["empty_scene", "render_body_video", "walk_clip"]

Image = NDArray[np.uint8]
Array = NDArray[np.float32]

_SHIRT, _SKIN, _TROUSERS, _SHOES = (44, 84, 158), (206, 150, 120), (34, 58, 108), (236, 236, 240)
_WORN = {
    "forearm": _SKIN, "hand": _SKIN, "neck": _SKIN, "skull": (84, 58, 40), "face": _SKIN,
    "thigh": _TROUSERS, "shank": _TROUSERS, "buttock": _TROUSERS, "foot": _SHOES, "toes": _SHOES,
}  # fmt: skip
_WALL, _FLOOR = (196.0, 200.0, 194.0), (150.0, 132.0, 112.0)
_TO_WALL = 7.0  # metres from the camera, where wall and floor meet
_NOISE, _NOISES = 2.5, 8  # of the sensor, of 255; pictures of it that take turns
_NEAR = 0.2  # metres, in front of which nothing is painted


def walk_clip(walk: Walk) -> MocapClip:
    """Return a walk as the clip of a recording, y up."""
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    return MocapClip(
        walk.joints, walk.joints, BODY_15.names, up, walk.fps, "walker", "walk", "walk"
    )


def empty_scene(camera: PinholeCamera, seed: int = 0) -> Array:
    """Return the room without anybody [H, W, 3], 0 to 255: a wall, a floor, a skirting board, plaster.

    Args:
        camera: level, with the size of its image. seed: of the plaster and the light.

    Raises:
        InputError: a camera without a size.
    """
    if camera.image_size is None:
        raise InputError(
            "a camera that is rendered needs the size of its image; give width and height"
        )
    width, height = camera.image_size
    place = -camera.rotation_matrix.mT @ camera.translation
    floor = int(float(camera.matrix[1, 2] + camera.matrix[1, 1] * place[1] / _TO_WALL))
    x, y = np.linspace(0, 1, width)[None, :, None], np.linspace(0, 1, height)[:, None, None]
    light = 1.02 - 0.15 * x - 0.08 * y
    rows = np.arange(height)[:, None, None]
    picture = np.where(rows < floor, np.array(_WALL), np.array(_FLOOR)) * light
    board = (rows >= floor - 6) & (rows < floor)
    picture = np.where(board, 226.0 * light, picture)
    plaster = smooth_noise((height, width), (1.5, 1.5), seed + 31)
    return np.clip(picture + 3.0 * plaster[..., None], 0, 255).astype(np.float32)


def render_body_video(
    folder: str | Path, walk: Walk, cameras: list[PinholeCamera], seed: int = 0
) -> tuple[list[Path], list[Path]]:
    """Write a video for each camera, NAME.mp4, and a picture of its empty scene, NAME-empty.png.

    Args:
        folder: that exists. walk: who walks. cameras: with names and sizes, y up.
        seed: of the shape of the body, the rooms and the sensors' noise.

    Returns:
        Paths of the videos and of the pictures.
    """
    import cv2

    from torchpose._core.files import atomic_path
    from torchpose.video.writer import VideoWriter

    limbs = true_limbs(walk_clip(walk), TrueShape.draw(seed))
    colours = [np.array(_WORN.get(kind, _SHIRT), np.float32) for kind in limb_kinds()]
    videos, pictures = [], []
    for i, camera in enumerate(cameras):
        room = empty_scene(camera, seed + i)
        videos.append(Path(folder) / f"{camera.name}.mp4")
        with VideoWriter(videos[-1], walk.fps, camera.image_size or (0, 0)) as writer:
            for image in _frames(limbs, colours, camera, room, seed + i):
                writer.write(image)
        pictures.append(Path(folder) / f"{camera.name}-empty.png")
        with atomic_path(pictures[-1]) as temporary:
            coded = cv2.imencode(".png", _bytes(room)[..., ::-1])[1]
            temporary.write_bytes(coded.tobytes())
    return videos, pictures


def _frames(
    limbs: Limbs, colours: list[Array], camera: PinholeCamera, room: Array, seed: int
) -> Iterator[Image]:
    start, end = (_seen(points, camera) for points in (limbs.start, limbs.end))  # [T, L, 3]
    radii = limbs.radii.double().numpy() * float(camera.matrix[1, 1])
    rng = np.random.default_rng([seed, 7])
    noise = [rng.normal(0, _NOISE, room.shape).astype(np.float32) for _ in range(_NOISES)]
    for t in range(len(start)):
        canvas = room.copy()
        depth = start[t, :, 2] + end[t, :, 2]
        for i in np.argsort(-depth):
            a, b = start[t, i], end[t, i]
            if min(a[2], b[2]) > _NEAR:
                capsule = Capsule(
                    (a[0], a[1]), (b[0], b[1]), radii[i, 0] / a[2], radii[i, 1] / b[2]
                )
                paint_capsule(canvas, capsule, colours[i])
        yield _bytes(canvas + noise[rng.integers(_NOISES)])


def _seen(points: Tensor, camera: PinholeCamera) -> NDArray:
    """Return the pixels and depth [T, L, 3] of points."""
    seen = camera(points)
    return np.asarray(seen.double().numpy())


def _bytes(picture: Array) -> Image:
    return np.clip(picture + 0.5, 0, 255).astype(np.uint8)
