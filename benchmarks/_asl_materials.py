"""The clips of `video_asl` with the true places of hands, as they are and changed, and their faces."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchmarks._asl import BURN_IN, FPS, Clip, read_clip
from torchpose.errors import InputError
from torchpose.measure._face import FaceTracker
from torchpose.video import open_video

CHANGES = ("mirrored", "late", "small", "half rate", "dark", "reversed")


class Material(NamedTuple):
    """A clip to be tracked.

    Attributes:
        frames: RGB [T, 480, 640, 3]. truth: left and right hand [T, 2, 2], NaN where unknown.
        tolerance: pixels. faces: (x, y, B) [T, 3], NaN where there is none. fps: its frame rate.
    """

    frames: np.ndarray
    truth: Tensor
    tolerance: float
    faces: Tensor
    fps: float


def read_material(folder: Path, name: str, change: str = "") -> Material:
    """Return a clip, as it is or changed, with its faces."""
    clip = read_clip(folder, name)
    with open_video(folder / f"{name}.mkv") as video:
        frames = np.stack([frame.image for frame in video])
    frames = frames[-len(clip.points) :]  # of "brother" MediaPipe had all frames but the first
    truth, tolerance, fps = _truth(clip), clip.width / 4, FPS
    if change:
        frames, truth, scale, fps = _changed(change, frames, truth)
        tolerance *= scale
    return Material(frames, truth, tolerance, follow_face(frames), fps)


def _truth(clip: Clip) -> Tensor:
    known = clip.known.clone()
    known[:BURN_IN] = False
    return torch.where(known[:, [0, 7], None], clip.points[:, [0, 7]], torch.nan)


def _changed(
    change: str, frames: np.ndarray, truth: Tensor
) -> tuple[np.ndarray, Tensor, float, float]:
    """Return frames and truth after a change, the scale of the image, and the frame rate."""
    import cv2

    width = frames.shape[2]
    if change == "mirrored":
        mirrored = truth.flip(1).clone()
        mirrored[..., 0] = width - 1 - mirrored[..., 0]
        return np.ascontiguousarray(frames[:, :, ::-1]), mirrored, 1.0, FPS
    if change == "late":
        return frames[10:], torch.cat([truth[10:20] * torch.nan, truth[20:]]), 1.0, FPS
    if change == "small":
        shrunk = [cv2.resize(f, (480, 360), interpolation=cv2.INTER_AREA) for f in frames]
        border = [cv2.copyMakeBorder(f, 120, 0, 100, 60, cv2.BORDER_REPLICATE) for f in shrunk]
        return np.stack(border), 0.75 * truth + torch.tensor([100.0, 120.0]), 0.75, FPS
    if change == "half rate":
        return frames[::2], truth[::2], 1.0, FPS / 2
    if change == "dark":
        rng = np.random.default_rng(0)
        noise = rng.normal(0, 4, frames.shape).astype(np.float32)
        dark = np.clip(frames * np.float32([0.66, 0.6, 0.62]) + noise, 0, 255)
        return dark.astype(np.uint8), truth, 1.0, FPS
    if change == "reversed":
        late = truth.flip(0).clone()
        late[:BURN_IN] = torch.nan
        return frames[::-1].copy(), late, 1.0, FPS
    raise InputError(f"changes are {', '.join(CHANGES)}, got {change!r}")


def follow_face(frames: np.ndarray) -> Tensor:
    """Return the longest-lived face of every frame [T, 3], NaN where none may be used."""
    import cv2

    tracker = FaceTracker()
    tracks, faces = tracker.init(), []
    for frame in frames:
        tracks = tracker.step(tracks, cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY))
        usable = tracker.usable(tracks)
        nowhere = torch.full((3,), torch.nan, dtype=torch.float64)
        longest = int(torch.where(usable, tracks.age, -1).argmax()) if bool(usable.any()) else -1
        faces.append(tracks.mean[longest, :3] if longest >= 0 else nowhere)
    return torch.stack(faces)
