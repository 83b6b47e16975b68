"""Measurements from images: faces and skin."""

from torchpose.measure.face import (
    FaceDetector,
    FaceTracker,
    FaceTracks,
    HaarFaceDetector,
    Region,
)
from torchpose.measure.skin import SkinModel, SkinState, rgb_to_lab

__all__ = [
    "FaceDetector",
    "FaceTracker",
    "FaceTracks",
    "HaarFaceDetector",
    "Region",
    "SkinModel",
    "SkinState",
    "rgb_to_lab",
]
