"""Measurements from images: faces, skin, hands, edges, background, silhouettes."""

from torchpose._core.moved import moved_names
from torchpose.measure.association import AssociationState, HandAssociation
from torchpose.measure.background import BackgroundModel
from torchpose.measure.brightness_background import BrightnessBackground, PixelKind
from torchpose.measure.edges import Segments, edge_map, find_segments, limb_votes
from torchpose.measure.face import FaceDetector, FaceTracker, FaceTracks, HaarFaceDetector, Region
from torchpose.measure.hand_measurements import HandMeasurements
from torchpose.measure.hand_prior import HandPrior
from torchpose.measure.hand_settings import HandSettings
from torchpose.measure.hands import HandState, HandTracker
from torchpose.measure.head_neck import FACE_OFFSETS, FaceOffsets, HeadNeck
from torchpose.measure.mean_shift import MeanShift, mean_shift
from torchpose.measure.mean_shift_hands import MeanShiftHandState, MeanShiftHandTracker
from torchpose.measure.mediapipe import MediaPipeFaceDetector, MediaPipePose, PoseLandmarks
from torchpose.measure.persons import PersonRegister, Persons
from torchpose.measure.skin import SkinModel, SkinState, rgb_to_lab
from torchpose.measure.skin_mixture import SkinMixtureModel, SkinMixtureState
from torchpose.measure.torso import TorsoElbows, clothes_likelihood, elbows_from_torso
from torchpose.measure.upper_body import (
    MEASURED,
    FrameMeasurements,
    MeasurerState,
    UpperBodyMeasurer,
)

__all__ = [
    "FACE_OFFSETS",
    "MEASURED",
    "AssociationState",
    "BackgroundModel",
    "BrightnessBackground",
    "FaceDetector",
    "FaceOffsets",
    "FaceTracker",
    "FaceTracks",
    "FrameMeasurements",
    "HaarFaceDetector",
    "HandAssociation",
    "HandMeasurements",
    "HandPrior",
    "HandSettings",
    "HandState",
    "HandTracker",
    "HeadNeck",
    "MeanShift",
    "MeanShiftHandState",
    "MeanShiftHandTracker",
    "MeasurerState",
    "MediaPipeFaceDetector",
    "MediaPipePose",
    "PersonRegister",
    "Persons",
    "PixelKind",
    "PoseLandmarks",
    "Region",
    "Segments",
    "SkinMixtureModel",
    "SkinMixtureState",
    "SkinModel",
    "SkinState",
    "TorsoElbows",
    "UpperBodyMeasurer",
    "clothes_likelihood",
    "edge_map",
    "elbows_from_torso",
    "find_segments",
    "limb_votes",
    "mean_shift",
    "rgb_to_lab",
]

__getattr__ = moved_names(__name__)
