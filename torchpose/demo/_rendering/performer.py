"""Render frames and videos of performers, with ground truth."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from torchpose._core.checks import check_choice
from torchpose._core.files import write_npz
from torchpose._core.images import Image
from torchpose.camera._pinhole import PinholeCamera
from torchpose.camera._projection import project
from torchpose.demo._performer import Performance
from torchpose.demo._rendering.look import LOOKS, Look, Wardrobe, wardrobe
from torchpose.demo._rendering.paint import Array, Box
from torchpose.demo._rendering.parts import Bodies, Part, bodies, body_parts
from torchpose.demo._rendering.scene import Scene, Sensor, room
from torchpose.errors import CameraError, InputError
from torchpose.skeleton._joint_sets import UPPER_BODY

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
    """Yield rendered frames of one or more animated performers.

    The head is a portrait from matplotlib that moves rigidly with the pose; the other parts are painted.
    Nearer parts occlude farther ones. Motion blur is the mean of several pictures over the exposure.

    Args:
        performance: one, or several of the same length, in the axes of the camera.
        camera: its K and image size; its pose in the room is not used.
        seed: the seed of room, noise and flicker. scene: see `Scene`.
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
    """Paint the parts in their order, and return the part of the canvas that was painted.

    Static parts behind all moving ones are painted once. The others are painted at every time of the
    exposure, and the mean is taken.
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
    """Return the largest movement of a part, pixels."""
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
            check_choice("look", one, LOOKS)
            one = LOOKS[one]
            if i % 2:
                one = one._replace(mirrored=True, tone=(0.90, 0.86, 0.84))
        chosen.append(one)
    return chosen


class Truth(NamedTuple):
    """Holds the ground truth of one performer.

    Attributes:
        joints3d: camera axes, metres, in the order of `UPPER_BODY`. joints2d: pixels.
        occluded: whether the joint is occluded or outside of the image.
    """

    joints3d: Float[Tensor, "T 8 3"]
    joints2d: Float[Tensor, "T 8 2"]
    occluded: Bool[Tensor, "T 8"]


def performance_truth(
    performance: Performance | Sequence[Performance],
    camera: PinholeCamera,
    look: str | Look | Sequence[str | Look] = "dark sleeves",
) -> tuple[Truth, ...]:
    """Return the ground truth of each performer in `render_performance` of the same arguments.

    A joint is occluded when the nearest part at its pixel is not its own. Its own parts are its limbs,
    for a shoulder the torso too, for the neck torso, neck and head.

    Raises:
        See `render_performance`.
    """
    shown, size = check_performances(performance, camera)
    worn = [wardrobe(one) for one in choose_looks(look, len(shown))]
    people = [bodies(one) for one in shown]
    K = camera.matrix.double().cpu()
    eye, origin = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    joints3d = torch.stack([one.joints.double() for one in shown])
    joints2d = project(joints3d, K, eye, origin)[..., :2]
    hidden = [
        _hidden(parts_at(people, worn, K.numpy(), frame), pixels, size)
        for frame, pixels in enumerate(joints2d.transpose(0, 1).numpy())
    ]
    occluded = torch.from_numpy(np.stack(hidden, 1))
    return tuple(Truth(*one) for one in zip(joints3d, joints2d, occluded, strict=True))


def _own_parts(joint: str) -> set[str]:
    kind, _, side = joint.partition("_")
    return {
        "hand": {f"hand_{side}"},
        "elbow": {f"upper_arm_{side}", f"forearm_{side}"},
        "shoulder": {f"upper_arm_{side}", "torso"},
        "head": {"head"},
        "neck": {"neck", "torso", "head"},
    }[kind]


_OWN = tuple(_own_parts(joint) for joint in UPPER_BODY)


def _hidden(parts: list[Part], pixels: NDArray, size: tuple[int, int]) -> NDArray:
    """Return which joints of N persons are occluded [N, 8]; the parts are in order of the persons."""
    each = len(parts) // len(pixels)
    shape = (size[1], size[0])
    boxes = [part.brush.box(shape) for part in parts]
    nearest_first = np.argsort([part.depth for part in parts], kind="stable")
    hidden = np.zeros(pixels.shape[:2], bool)
    for person, joint in np.ndindex(hidden.shape):
        u, v = (round(p) for p in pixels[person, joint].tolist())
        if not (0 <= u < size[0] and 0 <= v < size[1]):
            hidden[person, joint] = True
            continue
        here = Box(u, v, u + 1, v + 1)
        for i in nearest_first:
            left, top, right, bottom = boxes[i]
            inside = left <= u < right and top <= v < bottom
            if inside and float(parts[i].brush.alpha(here)[0, 0]) > 0.5:
                own = i // each == person and parts[i].name in _OWN[joint]
                hidden[person, joint] = not own
                break
    return hidden


def render_video(
    path: str | Path,
    performance: Performance | Sequence[Performance],
    camera: PinholeCamera,
    fps: float | None = None,
    *,
    seed: int = 0,
    scene: Scene | None = None,
    look: str | Look | Sequence[str | Look] = "dark sleeves",
    truth: str | Path | None = None,
) -> tuple[Truth, ...]:
    """Write a rendered H.264 video and its ground truth, which is returned.

    Args:
        path: of the video, ending in .mp4; its folder must exist.
        performance, camera, seed, scene, look: see `render_performance`.
        fps: the frame rate of the file; by default the performance's own.
        truth: of the file with the truth (.npz), by default truth.npz in the folder of the video:
            joints3d [T, 8, 3], joints2d [T, 8, 2], occluded [T, 8], names, labels, fps, K,
            image_size. Further performers go to truth_p02.npz and so on.

    Returns:
        The ground truth of each performer.

    Raises:
        See `render_performance` and `torchpose.video.VideoWriter`.
    """
    from torchpose.video._writer import VideoWriter

    path = Path(path)
    shown, size = check_performances(performance, camera)
    rate = shown[0].fps if fps is None else float(fps)
    known = performance_truth(shown, camera, look)
    with VideoWriter(path, rate, size) as writer:
        for image in render_performance(shown, camera, seed=seed, scene=scene, look=look):
            writer.write(image)
    first = path.with_name("truth.npz") if truth is None else Path(truth)
    for i, (one, shows) in enumerate(zip(known, shown, strict=True), start=1):
        target = first if i == 1 else first.with_name(f"{first.stem}_p{i:02d}{first.suffix}")
        arrays = {
            "joints3d": one.joints3d.numpy(),
            "joints2d": one.joints2d.numpy(),
            "occluded": one.occluded.numpy(),
            "names": np.array(UPPER_BODY),
            "labels": np.array(shows.labels),
            "fps": np.array(rate),
            "K": camera.matrix.double().cpu().numpy(),
            "image_size": np.array(size),
        }
        write_npz(target, arrays)
    return known
