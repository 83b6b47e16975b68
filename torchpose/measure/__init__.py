"""Measurements from images. So far: faces."""

from torchpose.measure.face import (
    FaceDetector,
    FaceTracker,
    FaceTracks,
    HaarFaceDetector,
    Region,
)

__all__ = ["FaceDetector", "FaceTracker", "FaceTracks", "HaarFaceDetector", "Region"]
