"""Measure faces, skin, hands, edges and foreground in images."""

from torchpose._core.facade import set_up_facade
from torchpose.measure._face_detector import FaceDetector, HaarFaceDetector
from torchpose.measure._hands import HandTracker
from torchpose.measure._head import HeadNeck
from torchpose.measure._mean_shift_hands import MeanShiftHandTracker
from torchpose.measure._mediapipe import MediaPipeFaceDetector, MediaPipePose
from torchpose.measure._skin_mixture import SkinMixtureModel
from torchpose.measure._upper_body_measurer import UpperBodyMeasurer

__all__ = [
    "FaceDetector",
    "HaarFaceDetector",
    "HandTracker",
    "HeadNeck",
    "MeanShiftHandTracker",
    "MediaPipeFaceDetector",
    "MediaPipePose",
    "SkinMixtureModel",
    "UpperBodyMeasurer",
]

set_up_facade(__name__)
