"""Measurements from images: faces, skin, hands, edges, background, silhouettes."""

from torchpose._core.facade import set_up_facade
from torchpose.measure.face import (
    FaceDetector,
    FaceTracker,
    HaarFaceDetector,
)
from torchpose.measure.hand_prior import HandPrior
from torchpose.measure.hand_settings import HandSettings
from torchpose.measure.hands import HandTracker
from torchpose.measure.head_neck import FaceOffsets, HeadNeck
from torchpose.measure.mean_shift import mean_shift
from torchpose.measure.mean_shift_hands import MeanShiftHandTracker
from torchpose.measure.mediapipe import MediaPipeFaceDetector, MediaPipePose
from torchpose.measure.skin import SkinModel
from torchpose.measure.skin_mixture import SkinMixtureModel
from torchpose.measure.upper_body import UpperBodyMeasurer

__all__ = [
    "FaceDetector",
    "FaceOffsets",
    "FaceTracker",
    "HaarFaceDetector",
    "HandPrior",
    "HandSettings",
    "HandTracker",
    "HeadNeck",
    "MeanShiftHandTracker",
    "MediaPipeFaceDetector",
    "MediaPipePose",
    "SkinMixtureModel",
    "SkinModel",
    "UpperBodyMeasurer",
    "mean_shift",
]

set_up_facade(__name__)
