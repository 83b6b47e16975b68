"""torchpose.demo"""

from torchpose.demo.mannequin import ANGLE_LIMITS, BodyAngles, BodySize, angles_to_joints
from torchpose.demo.performer import (
    KEYPOINT_NAMES,
    Performance,
    demo_camera,
    hip_sway,
    minimum_jerk,
    noisy_keypoints,
    performer,
    performer_angles,
    stage,
    sway,
)

__all__ = [
    "ANGLE_LIMITS",
    "KEYPOINT_NAMES",
    "BodyAngles",
    "BodySize",
    "Performance",
    "angles_to_joints",
    "demo_camera",
    "hip_sway",
    "minimum_jerk",
    "noisy_keypoints",
    "performer",
    "performer_angles",
    "stage",
    "sway",
]
