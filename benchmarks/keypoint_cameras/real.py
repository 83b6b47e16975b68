"""A real recording: how far each camera is from joints of the others, as calibrated and refined."""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.keypoint_bodies.real import Filmed, read_filmed
from benchmarks.keypoint_bodies.scoring import from_the_start
from benchmarks.keypoint_cameras.disturbed import with_poses
from benchmarks.keypoint_cameras.ways import track
from torchpose.camera import CameraRig
from torchpose.evaluation import Report
from torchpose.math._rotations import rotvec_to_matrix

_SURE = 0.5


def add_real_cameras(report: Report, data: Path) -> None:
    """Add the table of cameras left out, with cameras as calibrated and refined.

    Args:
        report: gets the table. data: folder with the sets.
    """
    filmed = read_filmed(data)
    half = len(filmed.keypoints) // 2
    first, second = _cut(filmed, 0, half), _cut(filmed, half, len(filmed.keypoints))
    table = report.table(
        "real", "A real camera predicted from three others (pixels)",
        ["all, median", "all, 90 %", "second half, median", "second half, 90 %"],
        digits=(1, 1, 1, 1),
        note="Pose2Sim's balancing person, OpenPose, 100 frames. Poses of all four cameras are refined with "
        "all frames, or with the first half and then scored on the second.",
    )  # fmt: skip
    found = {"as calibrated": filmed.rig, "refined, all frames": _refined(filmed)[0],
             "refined, first half": _refined(first)[0]}  # fmt: skip
    for name, rig in found.items():
        cells: list[float] = []
        for part in (filmed, second):
            errors = _left_out(rig, part)
            cells += errors.quantile(torch.tensor([0.5, 0.9], dtype=errors.dtype)).tolist()
        if name == "refined, first half":
            cells[:2] = [torch.nan] * 2
        table.add(name, cells)
    delays = report.table(
        "delays", "What refine=\"both\" finds there", [*filmed.rig.names], digits=(2,) * 4,
        note="Frames of 1/60 s, and degrees, each with a standard deviation.",
    )  # fmt: skip
    _, details = _refined(filmed, "both")
    std = details["camera_errors_std"][0]
    turn = _angles(rotvec_to_matrix(details["camera_rotation"][0]), filmed.rig.rotation)
    delays.add("delay (frames)", details["camera_delays"][0].tolist())
    delays.add("±", std[:, 6].tolist())
    delays.add("turn (degrees)", turn.tolist())
    delays.add("±", torch.rad2deg(std[:, :3].norm(dim=-1)).tolist())


def _cut(filmed: Filmed, begin: int, end: int) -> Filmed:
    return filmed._replace(
        keypoints=filmed.keypoints[begin:end], confidence=filmed.confidence[begin:end]
    )


def _refined(filmed: Filmed, what: str = "extrinsics") -> tuple[CameraRig, dict[str, Tensor]]:
    rig = _straight(filmed.rig)
    details = track(rig, filmed.keypoints, filmed.confidence, filmed.fps, refine=what).details
    rotation = rotvec_to_matrix(details["camera_rotation"][0])
    return with_poses(rig, rotation, details["camera_translation"][0]), details


def _straight(rig: CameraRig) -> CameraRig:
    """Return cameras without distortion, of which the keypoints are."""
    other = with_poses(rig, rig.rotation, rig.translation)
    other.distortions.zero_()
    return other


def _left_out(rig: CameraRig, filmed: Filmed) -> Float[Tensor, " N"]:
    """Return how far keypoints of each camera are from the joints of the others, pixels."""
    rig, errors = _straight(rig), []
    for c in range(len(rig)):
        rows = [k for k in range(len(rig)) if k != c]
        found = track(
            rig.select(rows), filmed.keypoints[:, rows], filmed.confidence[:, rows], filmed.fps
        )
        joints = from_the_start(found.joints3d, found.first_frame)
        off = (rig(joints).pixels[:, c] - filmed.keypoints[:, c]).norm(dim=-1)
        errors.append(off[filmed.confidence[:, c] > _SURE])
    return torch.cat(errors)


def _angles(a: Tensor, b: Tensor) -> Tensor:
    trace = (a * b).sum((-2, -1))
    return torch.rad2deg(((trace - 1) / 2).clamp(-1, 1).arccos())
