"""Real cameras, each predicted from others: OpenPose's keypoints of a balancing person.

The recording of Pose2Sim has no truth. A method sees one, two or three of its four cameras; its joints are
projected into each of the others, and compared with what OpenPose found there. The head is the middle of its
ears, and the pelvis that of its hips.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks.keypoint_bodies.methods import Method, row_of, takes
from torchpose._core.reading import read_npz
from torchpose.body import body_joints
from torchpose.camera import CameraRig
from torchpose.evaluation import Report

_FOLDER = "multicam_pose2sim"
_SURE = 0.5  # confidence from which a keypoint of the camera left out counts
_QUICK_FRAMES = 12


class Filmed(NamedTuple):
    """What OpenPose found in all cameras.

    Attributes:
        rig: cameras. keypoints: [T, C, 15, 2], undistorted pixels, NaN where missing.
        confidence: [T, C, 15]. fps: frames per second.
    """

    rig: CameraRig
    keypoints: Tensor
    confidence: Tensor
    fps: float


def read_filmed(data: Path) -> Filmed:
    """Return the recording.

    Args:
        data: folder with multicam_pose2sim/.
    """
    rig = CameraRig.load(data / _FOLDER / "raw" / "Calib_qualisys.toml")
    arrays = read_npz(data / _FOLDER / "balancing_4cam.npz")
    found = torch.from_numpy(arrays["openpose_2d"]).double().transpose(0, 1)
    names, fps = [str(name) for name in arrays["openpose_names"]], float(arrays["fps"])
    found = found.masked_fill((found[..., 2] <= 0)[..., None], torch.nan)
    found = body_joints(found, names)
    keypoints = undistorted(rig, found[..., :2])
    return Filmed(rig, keypoints, found[..., 2].nan_to_num(), fps)


def undistorted(rig: CameraRig, keypoints: Float[Tensor, "T C J 2"]) -> Float[Tensor, "T C J 2"]:
    """Return pixels as cameras without distortion would see them; the matrix K stays."""
    import cv2

    straight = torch.full_like(keypoints, torch.nan)
    for camera in range(len(rig)):
        known = keypoints[:, camera].isfinite().all(-1)
        matrix, distortions = (x[camera].numpy() for x in (rig.matrix, rig.distortions))
        points = keypoints[:, camera][known].numpy()[:, None]
        found = cv2.undistortPoints(points, matrix, distortions, P=matrix)
        straight[:, camera][known] = torch.from_numpy(found[:, 0])
    return straight


def predicted(method: Method, filmed: Filmed, cameras: int) -> Float[Tensor, " N"]:
    """Return how far keypoints of cameras left out are from a method's joints, pixels.

    Args:
        method: what is tried. filmed: recording. cameras: how many the method sees; all choices of so
            many are tried.
    """
    errors = []
    for chosen in itertools.combinations(range(len(filmed.rig)), cameras):
        rows = list(chosen)
        estimate = method(
            filmed.rig.select(rows), filmed.keypoints[:, rows], filmed.confidence[:, rows],
            filmed.fps,
        )  # fmt: skip
        off = (filmed.rig(estimate.joints).pixels - filmed.keypoints).norm(dim=-1)
        others = [c for c in range(len(filmed.rig)) if c not in rows]
        errors.append(off[:, others][filmed.confidence[:, others] > _SURE])
    return torch.cat(errors)


def add_real_table(report: Report, methods: Mapping[str, Method], data: Path, quick: bool) -> None:
    """Add the table of cameras left out.

    Args:
        report: gets the table. methods: by name. data: folder with the sets. quick: few frames.
    """
    filmed = read_filmed(data)
    if quick:
        parts = filmed.keypoints[:_QUICK_FRAMES], filmed.confidence[:_QUICK_FRAMES]
        filmed = Filmed(filmed.rig, *parts, filmed.fps)
    counts = range(len(filmed.rig) - 1, 0, -1)
    title = "A real camera predicted from others (pixels)"
    columns = [f"{n} cameras, {what}" for n in counts for what in ("median", "90 %", "none %")]
    table = report.table(
        "real", title, [c.replace("1 cameras", "1 camera") for c in columns],
        note="All cameras left out and all choices of the others. 'none': keypoints for which there is no "
        "joint; they count in neither quantile. A method marked * has seen no later frame.",
    )  # fmt: skip
    for name, method in tqdm(methods.items(), desc="real"):
        cells: list[float] = []
        for cameras in counts:
            if not takes(name, cameras):
                cells += [torch.nan] * 3
                continue
            errors = predicted(method, filmed, cameras)
            known = errors[errors.isfinite()]
            quantiles = known.quantile(torch.tensor([0.5, 0.9], dtype=known.dtype))
            cells += [*quantiles.tolist(), 100 * float(errors.isnan().double().mean())]
        table.add(row_of(name), cells)
