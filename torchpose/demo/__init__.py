"""Animate a performer with known joints, for the demo, the examples and the tests."""

from torchpose._core.facade import set_up_facade
from torchpose.demo._performer import KEYPOINT_NAMES, demo_camera, noisy_keypoints, performer

__all__ = ["KEYPOINT_NAMES", "demo_camera", "noisy_keypoints", "performer"]

set_up_facade(__name__)
