"""Frames of rendered performers, and the truth about them."""

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from torchpose.camera.pinhole import PinholeCamera
from torchpose.demo.performer import Performance
from torchpose.demo.rendering.body import Bodies, bodies
from torchpose.demo.rendering.look import LOOKS, Look, Wardrobe, wardrobe
from torchpose.demo.rendering.paint import Box
from torchpose.demo.rendering.parts import Part, body_parts
from torchpose.demo.rendering.scene import Scene, Sensor, room
from torchpose.errors import CameraError, InputError

__all__ = ["Image", "render_performance"]

Image = NDArray[np.uint8]
Array = NDArray[np.float32]
_STEP = 2.0  # pixels of movement for one picture of the motion blur
_MOST = 8  # pictures of the motion blur
_STILL = 0.5  # pixels: what moves less is painted once


def render_performance(
    performance: Performance | Sequence[Performance],
    camera: PinholeCamera,
    *,
    seed: int = 0,
    scene: Scene | None = None,
    look: str | Look | Sequence[str | Look] = "dark sleeves",
) -> Iterator[Image]:
    """Render frames of one or more animated performers.

    The head is cut out of the portrait that matplotlib ships and moves rigidly with the pose; the
    rest is painted. What is nearer hides what is farther. Motion blur is the mean of several
    pictures over the time for which the shutter is open.

    Args:
        performance: one, or several of the same length, in the axes of the camera.
        camera: its K and image size; its pose in the room is not used.
        seed: of room, noise and flicker. scene: see `Scene`.
        look: a name out of `LOOKS` or a `Look`, for each performer or for all. Performers beyond
            the first have the portrait mirrored and another complexion when names are given.

    Yields:
        RGB, uint8, [H, W, 3]. The same arguments give the same frames.

    Raises:
        MissingDependencyError: matplotlib is not installed. CameraError: a camera without image
            size. InputError: no performance, different lengths, an unknown look.

    >>> from torchpose.demo import demo_camera, performer
    >>> frames = list(render_performance(performer(n_frames=2), demo_camera()))
    >>> frames[0].shape, frames[0].dtype
    ((480, 640, 3), dtype('uint8'))
    """
    shown, size = check_performances(performance, camera)
    worn = [wardrobe(one) for one in choose_looks(look, len(shown))]
    people = [bodies(one) for one in shown]
    return _frames(people, worn, camera, size, seed, scene or Scene(), shown[0].fps)


def _frames(
    people: list[Bodies],
    worn: list[Wardrobe],
    camera: PinholeCamera,
    size: tuple[int, int],
    seed: int,
    scene: Scene,
    fps: float,
) -> Iterator[Image]:
    background = room(*size, scene, seed)
    empty = np.rint(background).astype(np.uint8)
    sensor = Sensor(*size, scene, seed, fps)
    K = camera.matrix.double().cpu().numpy()
    canvas = background.copy()
    for frame in range(len(people[0].joints)):
        half = scene.exposure / 2
        middle = parts_at(people, worn, K, frame)
        shut = parts_at(people, worn, K, frame - half), parts_at(people, worn, K, frame + half)
        moved = [_movement(a, b) for a, b in zip(*shut, strict=True)]
        order = np.argsort([-part.depth for part in middle], kind="stable")
        n = min(math.ceil(max(moved) / _STEP), _MOST)
        if n > 1:
            times = frame + half * np.linspace(-1, 1, n)
            blurred = [parts_at(people, worn, K, float(t)) for t in times]
        else:
            blurred = []
        touched = _paint(canvas, middle, blurred, order, np.array(moved) < _STILL)
        image = empty.copy()
        touched.of(image)[:] = np.rint(touched.of(canvas)).clip(0, 255)
        touched.of(canvas)[:] = touched.of(background)
        yield sensor(image, frame)


def _paint(
    canvas: Array,
    middle: list[Part],
    blurred: list[list[Part]],
    order: NDArray,
    still: NDArray,
) -> Box:
    """Paint the parts in their order; returns the part of the canvas that was painted over.

    What stands still and is hidden by nothing that moves is painted once; from there on everything
    is painted at every time, and the mean is taken.
    """
    count = 0
    while count < len(order) and (still[order[count]] or not blurred):
        middle[order[count]].brush.paint(canvas)
        count += 1
    boxes = [part.brush.box(canvas.shape) for part in middle]
    rest = order[count:]
    if len(rest):
        moving = _union([p[i].brush.box(canvas.shape) for p in blurred for i in rest])
        before = moving.of(canvas).copy()
        total = np.zeros_like(before)
        for parts in blurred:
            moving.of(canvas)[:] = before
            for i in rest:
                parts[i].brush.paint(canvas)
            total += moving.of(canvas)
        moving.of(canvas)[:] = total / np.float32(len(blurred))
        boxes.append(moving)
    return _union(boxes)


def _union(boxes: list[Box]) -> Box:
    full = [box for box in boxes if not box.empty]
    if not full:
        return Box(0, 0, 0, 0)
    left, top, right, bottom = zip(*full, strict=True)
    return Box(min(left), min(top), max(right), max(bottom))


def _movement(a: Part, b: Part) -> float:
    """Pixels."""
    return float(np.abs(a.brush.anchors - b.brush.anchors).max())


# --- what is shown, and where -----------------------------------------------------------------------


def parts_at(
    people: Sequence[Bodies], worn: Sequence[Wardrobe], K: NDArray, time: float
) -> list[Part]:
    """Return the parts of all persons at a time in frames, person by person, always in the same order."""
    return [
        part
        for body, wear in zip(people, worn, strict=True)
        for part in body_parts(body.at(time), wear, K)
    ]


def check_performances(
    performance: Performance | Sequence[Performance], camera: PinholeCamera
) -> tuple[list[Performance], tuple[int, int]]:
    """Return performances as a list, and width and height of the image.

    Raises:
        CameraError: a camera without image size. InputError: no performance, different lengths.
    """
    shown = [performance] if isinstance(performance, Performance) else list(performance)
    lengths = {len(one.joints) for one in shown}
    if len(lengths) != 1 or 0 in lengths:
        raise InputError(
            f"performance must be one or more of the same length, got lengths {sorted(lengths)}"
        )
    size = camera.image_size
    if size is None:
        raise CameraError("the camera must say its image size: PinholeCamera(..., width, height)")
    return shown, size


def choose_looks(look: str | Look | Sequence[str | Look], n: int) -> list[Look]:
    """Return a look for each of n performers; see `render_performance`."""
    given = [look] * n if isinstance(look, str | Look) else list(look)
    if len(given) != n:
        raise InputError(f"look must be one, or one for each of {n} performers, got {len(given)}")
    chosen = []
    for i, one in enumerate(given):
        if isinstance(one, str):
            if one not in LOOKS:
                raise InputError(f"look must be one of {', '.join(LOOKS)}, got {one!r}")
            one = LOOKS[one]
            if i % 2:
                one = one._replace(mirrored=True, tone=(0.90, 0.86, 0.84))
        chosen.append(one)
    return chosen
