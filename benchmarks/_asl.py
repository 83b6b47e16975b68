"""The webcam clips of `video_asl` and MediaPipe's landmarks of them, as the eight joints."""

from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from torchpose._core.reading import read_npz
from torchpose.skeleton import UPPER_BODY
from torchpose.skeleton._joint_sets import canonical_names
from torchpose.skeleton._mediapipe_landmarks import derive_joints

CLIPS = ("again", "brother", "help", "bird", "milk", "book", "learn")
BURN_IN = 15
VISIBLE = 0.5
FPS, SIZE = 30.0, (640, 480)
GROUPS = {"head": (3,), "shoulders": (2, 5), "elbows": (1, 6), "hands": (0, 7)}


class Clip(NamedTuple):
    """What MediaPipe saw in a clip; head, neck and hands are `torchpose.skeleton._mediapipe_landmarks`'s.

    Attributes:
        points: [T, 8, 2], pixels, in the order of `UPPER_BODY`. points3d: [T, 8, 3], metres.
        visibility: [T, 8]. known: [T, 8], visible, in the image and after the burn-in.
        ears, nose, wrists: [T, 2], [T, 2] and [T, 2, 2], pixels; left wrist first.
        width: mean distance of the shoulders, pixels.
    """

    name: str
    points: Tensor
    points3d: Tensor
    visibility: Tensor
    known: Tensor
    ears: Tensor
    nose: Tensor
    wrists: Tensor
    width: float


def read_clip(folder: Path, name: str, model: int = 1) -> Clip:
    """Return MediaPipe's landmarks of a clip, those of its full (1) or heavy (2) model."""
    arrays = read_npz(folder / f"{name}_mediapipe_pose{model}.npz")
    names = [str(n) for n in arrays["names"]]
    points = torch.from_numpy(arrays["joints2d"]).double()
    points3d = torch.from_numpy(arrays["joints3d"]).double()
    visibility = torch.from_numpy(arrays["visibility"]).double()
    points, seen, all_names = derive_joints(points, visibility, names)
    points3d, _, _ = derive_joints(points3d, None, names)
    if seen is None:
        raise ValueError(f"{name}: expected a visibility of the landmarks")
    where = {n: i for i, n in enumerate(canonical_names(all_names))}
    eight = [where[n] for n in UPPER_BODY]
    joints, seen = points[:, eight], seen[:, eight]
    inside = ((joints >= 0) & (joints < torch.tensor(SIZE))).all(-1)
    inside[:, [3, 4]] = True  # the head may be cut off above the face
    known = inside & (seen >= VISIBLE)
    known[:BURN_IN] = False
    return Clip(
        name,
        joints,
        points3d[:, eight],
        seen,
        known,
        points[:, [where["ear_left"], where["ear_right"]]].mean(1),
        points[:, where["nose"]],
        points[:, [where["wrist_left"], where["wrist_right"]]],
        float((joints[:, 2] - joints[:, 5]).norm(dim=-1).mean()),
    )


def begun(clip: Clip, n_frames: int | None) -> Clip:
    """Return the first frames of a clip, or all."""
    return Clip(*(x[:n_frames] if isinstance(x, Tensor) else x for x in clip))


def pad(parts: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Return sequences as one batch, padded with NaN (False), and their lengths."""
    lengths = torch.tensor([len(part) for part in parts])
    fill = False if parts[0].dtype == torch.bool else torch.nan
    batch = parts[0].new_full((len(parts), int(lengths.max()), *parts[0].shape[1:]), fill)
    for row, part in zip(batch, parts, strict=True):
        row[: len(part)] = part
    return batch, lengths
