"""Methods without a body filter, each from keypoints of calibrated cameras to joints.

Each takes a rig, keypoints [T, C, J, 2] in undistorted pixels, confidence [T, C, J] and the frames per
second, and returns an `Estimate`.
"""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from benchmarks.keypoint_bodies.joint_filters import Settings, filter_pixels, filter_points
from benchmarks.keypoint_bodies.least_squares import fit_bodies
from benchmarks.keypoint_bodies.scoring import Estimate
from benchmarks.keypoint_bodies.triangulation import (
    held,
    interpolated,
    low_pass,
    sure_keypoints,
    triangulate,
    triangulate_subsets,
    without_outliers,
)
from torchpose.camera import CameraRig

Pixels = Float[Tensor, "T C J 2"]
Confidence = Float[Tensor, "T C J"]

POINTS = Settings(acceleration=30.0, noise=0.04)
"""Noise of the filter over points, chosen on `clips.CHOOSING`."""

PIXELS = Settings(acceleration=10.0, noise=12.0)
"""Noise of the filter over pixels, chosen on `clips.CHOOSING`."""


def standing_still(
    rig: CameraRig, keypoints: Pixels, confidence: Confidence, fps: float
) -> Estimate:
    """Triangulate all sure keypoints; where there is no point, the last one stays."""
    weights = confidence * sure_keypoints(keypoints, confidence)
    return Estimate(held(triangulate(rig, keypoints, weights)))


def pose2sim(rig: CameraRig, keypoints: Pixels, confidence: Confidence, fps: float) -> Estimate:
    """Triangulate as Pose2Sim does by default, and fill gaps of any length.

    Cameras that disagree are left out, outliers over time replaced, and a low-pass of 6 Hz smooths. Pose2Sim
    holds the last value in gaps of more than 20 frames.
    """
    points = interpolated(triangulate_subsets(rig, keypoints, confidence).points)
    return Estimate(low_pass(without_outliers(points), fps))


def points_filter(
    rig: CameraRig, keypoints: Pixels, confidence: Confidence, fps: float
) -> Estimate:
    """Filter triangulated points, every joint by itself at a constant velocity."""
    return Estimate(*filter_points(rig, keypoints, confidence, fps, POINTS))


def pixels_filter(
    rig: CameraRig, keypoints: Pixels, confidence: Confidence, fps: float
) -> Estimate:
    """Filter pixels, every joint by itself at a constant velocity."""
    return Estimate(*filter_pixels(rig, keypoints, confidence, fps, PIXELS))


def least_squares(
    rig: CameraRig, keypoints: Pixels, confidence: Confidence, fps: float
) -> Estimate:
    """Triangulate, then minimise the terms of aniposelib over the whole clip."""
    sure = sure_keypoints(keypoints, confidence)
    points = triangulate(rig, keypoints, sure.to(confidence))
    return Estimate(fit_bodies(rig, keypoints, confidence * sure, points))
