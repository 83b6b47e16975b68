"""The methods of the comparison by the names of their rows."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

import torchpose
from benchmarks.keypoint_bodies import peers
from benchmarks.keypoint_bodies.lifters import load_lifters
from benchmarks.keypoint_bodies.scoring import Estimate, from_the_start
from torchpose.body import BODY_15
from torchpose.camera import CameraRig

Method = Callable[[CameraRig, Tensor, Tensor, float], Estimate]
"""From a rig, keypoints [T, C, 15, 2], confidence [T, C, 15] and frames per second to joints."""


def track(
    rig: CameraRig,
    keypoints: Tensor,
    confidence: Tensor,
    fps: float,
    smoothing: str = "none",
    **options: Any,
) -> Estimate:
    """Track the body with torchpose.

    Args:
        rig: cameras. keypoints: pixels, undistorted. confidence: of a detector. fps: frames per
            second. smoothing: of the poses. options: of the tracker.
    """
    tracker = torchpose.BodyTracker(rig, method="kalman", fps=fps, **options)
    poses = tracker(
        keypoints=keypoints, confidence=confidence, names=BODY_15.names, smoothing=smoothing
    )
    covariance = poses.covariance3d
    if len(rig) == 1:  # errors are relative to the pelvis there
        covariance = poses.details["covariance_from_pelvis"]
    values = (poses.joints3d, covariance)
    return Estimate(*(from_the_start(value, poses.first_frame) for value in values))


METHODS: dict[str, Method] = {
    "kalman": track,
    "kalman-smoothed": partial(track, smoothing="full"),
    "least-squares": peers.least_squares,
    "pose2sim": peers.pose2sim,
    "pixels-filter": peers.pixels_filter,
    "points-filter": peers.points_filter,
    "standing-still": peers.standing_still,
}
"""Methods that learn nothing; those of `OURS` take one camera as well, the others two or more."""

OURS = ("kalman", "kalman-smoothed")
LIFTERS = ("gru", "mlp", "mean-pose")
"""Methods that learn, and take one camera."""

CAUSAL = ("kalman", "pixels-filter", "points-filter", "standing-still", *LIFTERS)


def methods_of(
    chosen: Sequence[str], data: Path, weights: Path | None, quick: bool
) -> dict[str, Method]:
    """Return methods by name.

    Args:
        chosen: names. data: folder with the sets. weights: file of `load_lifters`.
        quick: as of `load_lifters`.
    """
    lifters: Mapping[str, Method] = {}
    if set(chosen) & set(LIFTERS):
        lifters = load_lifters(data, weights, quick)
    known = {**METHODS, **lifters}
    return {name: known[name] for name in chosen}


def row_of(name: str, causal: Container[str] = CAUSAL) -> str:
    """Return the name of a method's row, which marks those that have seen no later frame."""
    return f"{name} *" if name in causal else name


def takes(name: str, cameras: int) -> bool:
    """Return whether a method takes so many cameras."""
    return name in OURS or (name in LIFTERS) == (cameras == 1)
