"""Real silhouettes of depth cameras, and errors and pictures of bodies that are tracked in them."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchmarks._data import data_files
from benchmarks.bodies.tracking import PARTS
from torchpose._core.files import atomic_path, check_output_folder
from torchpose.body import BODY_15, Body, body_joints, fit_body, fit_state
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.evaluation import Report
from torchpose.metrics import joint_errors
from torchpose.video._overlay import draw_body
from torchpose.whole_body import render
from torchpose.whole_body._silhouettes.shape import fit_radii

_ENLARGED = 2  # pixels of the picture for one of a silhouette
HEAD_TOP = 0.11
"""Metres: the Kinect's head is in the middle of the head."""
PELVIS = BODY_15.joint("pelvis")


class Filmed(NamedTuple):
    """What is tracked: silhouettes [T, C, H, W] of a rig, and the reference [T, 15, 3]."""

    silhouettes: Tensor
    rig: CameraRig
    joints: Tensor


def part_means(found: Tensor, truth: Tensor, centred: bool) -> list[float]:
    """Return the mean distance of all joints and of each part, mm.

    Args:
        found, truth: joints [T, 15, 3]. centred: whether the pelvis is moved to the origin first.
    """
    if centred:
        found, truth = found - found[:, [PELVIS]], truth - truth[:, [PELVIS]]
    gap = 1000 * joint_errors(found, truth)
    columns = [list(range(15)), *([BODY_15.joint(n) for n in names] for names in PARTS.values())]
    return [float(gap[:, c].nanmean()) for c in columns]


def draw(
    report: Report, data: Filmed, body: Body, states: Tensor, out: Path, name: str, columns: int = 6
) -> None:
    """Draw the silhouettes in grey with the body over them, a row per camera, frames from left to right."""
    import cv2

    _, _, height, width = data.silhouettes.shape
    chosen = torch.linspace(0, len(states) - 1, columns).round().long().tolist()
    model = render(body, states, data.rig, height, width)
    seen = data.rig(body.joints(states)).pixels
    size = (_ENLARGED * width, _ENLARGED * height)
    rows = []
    for c in range(len(data.rig)):
        cells = []
        for t in chosen:
            grey = np.where(data.silhouettes[t, c].numpy(), 150, 255).astype(np.uint8)
            picture = cv2.resize(cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB), size,
                                 interpolation=cv2.INTER_NEAREST)  # fmt: skip
            pixels = _ENLARGED * (seen[t, c] + 0.5) - 0.5
            drawn = draw_body(picture, pixels, body.skeleton, model=model[t, c])
            cells.append(np.pad(drawn, ((0, 2), (0, 2), (0, 0))))
        rows.append(np.hstack(cells))
    check_output_folder((out / name).parent)
    with atomic_path(out / name) as path:
        cv2.imwrite(str(path), cv2.cvtColor(np.vstack(rows), cv2.COLOR_RGB2BGR))
    report.pictures.append(name)


def seeded(seed: int) -> torch.Generator:
    """Return a new generator with this seed."""
    return torch.Generator().manual_seed(seed)


def mean_of(found: Sequence[Tensor], truth: Tensor, centred: bool) -> list[float]:
    """Return the mean of `part_means` over seeds."""
    parts = torch.tensor([part_means(f, truth, centred) for f in found])
    return [float(x) for x in parts.mean(0)]


def kinect(folder: Path, person: str, action: str, trials: str) -> Iterator[Tensor]:
    """Yield the recorded joints [T, 15, 3] of a person's trials, in right-handed axes of the room, y up."""
    pattern = f"{person}_a*_{action}_t[{trials}].npz"
    for path in data_files(folder / "kinect_utd_mhad", pattern):
        with np.load(path) as z:
            yield body_joints(torch.from_numpy(z["joints"]).double(), list(z["names"]))


def fit_to_view(trials: Sequence[Tensor], other: Filmed) -> Body:
    """Return the body of a person: bone lengths of trials, radii of some silhouettes of another action."""
    body = fit_body(torch.cat(list(trials)), head_top=HEAD_TOP)
    rows = torch.linspace(0, len(other.joints) - 1, 6).round().long()
    states = fit_state(body, other.joints[rows])
    return fit_radii(body, states, other.silhouettes[rows], other.rig, seed=0)


def one_view(folder: Path, person: str, action: str) -> Filmed:
    """Return the segmented depth of trial 1 and its skeleton, shifted by the lag that the set gives."""
    (path, *_) = data_files(folder / "utd_mhad_silhouettes", f"{person}_a*_{action}_t1.npz")
    with np.load(path) as z:
        shape = z["sil_shape"]
        masks = np.unpackbits(z["sil_packed"], axis=-1)[..., : shape[2]].astype(bool)
        joints = body_joints(torch.from_numpy(z["joints"]).double(), list(z["names"]))
        lag, K = int(z["mask_lag"]), z["K"].astype(float)
    # the depth image is mirrored: turned over, it is that of a camera which stands on its head
    camera = PinholeCamera(
        K[0, 0], K[1, 1], 319 - K[0, 2], K[1, 2], 320, 240, "depth", rotation=(0.0, 0.0, np.pi)
    )
    silhouettes = torch.from_numpy(np.ascontiguousarray(masks[:, :, ::-1]))[:, None]
    n = min(len(joints), len(silhouettes) - lag)
    rig = CameraRig([camera]).scaled(120, 160)
    small = silhouettes[lag : lag + n, :, ::2, ::2]
    return Filmed(small, rig, joints[:n])
