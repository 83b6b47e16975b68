"""The truth about a rendered performance, and videos with their truth beside them."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from torchpose._core.files import write_npz
from torchpose.camera.pinhole import PinholeCamera
from torchpose.camera.projection import project
from torchpose.demo.performer import Performance
from torchpose.demo.rendering.body import bodies
from torchpose.demo.rendering.look import Look, wardrobe
from torchpose.demo.rendering.paint import Box
from torchpose.demo.rendering.parts import Part
from torchpose.demo.rendering.performer import (
    check_performances,
    choose_looks,
    parts_at,
    render_performance,
)
from torchpose.demo.rendering.scene import Scene
from torchpose.skeleton.joint_sets import UPPER_BODY

__all__ = ["Truth", "performance_truth", "render_video"]


class Truth(NamedTuple):
    """Where the joints of one performer are.

    Attributes:
        joints3d: camera axes, metres, in the order of `UPPER_BODY`. joints2d: pixels.
        occluded: something nearer hides the joint, or it lies outside the image.
    """

    joints3d: Float[Tensor, "T 8 3"]
    joints2d: Float[Tensor, "T 8 2"]
    occluded: Bool[Tensor, "T 8"]


def performance_truth(
    performance: Performance | Sequence[Performance],
    camera: PinholeCamera,
    look: str | Look | Sequence[str | Look] = "dark sleeves",
) -> tuple[Truth, ...]:
    """Return the truth about what `render_performance` shows of the same arguments, one for each performer.

    A joint is occluded when the nearest part that is painted over its pixel is not its own: its limb,
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
    """Return which joints of N persons are hidden [N, 8]; the parts come person by person."""
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
    """Render to an H.264 file, with the truth beside it.

    Args:
        path: of the video, ending in .mp4; its folder must exist.
        performance, camera, seed, scene, look: see `render_performance`.
        fps: of the file; by default the performance's own.
        truth: of the file with the truth (.npz), by default truth.npz in the folder of the video:
            joints3d [T, 8, 3], joints2d [T, 8, 2], occluded [T, 8], names, labels, fps, K,
            image_size. Further performers go to truth_p02.npz and so on.

    Returns:
        `Truth` of each performer.

    Raises:
        See `render_performance` and `torchpose.video.VideoWriter`.
    """
    from torchpose.video.writer import VideoWriter

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
