"""Cameras: pinhole models, rigs, projection and lifting, viewpoints."""

from torchpose._core.moved import moved_names
from torchpose.camera.lifting import (
    arm_in_body_frame,
    arm_in_camera_frame,
    join_arms,
    pixel_covariances,
)
from torchpose.camera.pinhole import PinholeCamera, load_cameras, save_cameras
from torchpose.camera.projection import (
    backproject,
    check_intrinsics,
    intrinsics,
    lift,
    map_pixel_covariance,
    map_pixels,
    project,
)
from torchpose.camera.rig import CameraRig, RigView, as_rig, undistortion_maps
from torchpose.camera.viewpoints import PAPER_VIEWS, Viewpoints, ViewRange, sample_viewpoints

__all__ = [
    "PAPER_VIEWS",
    "CameraRig",
    "PinholeCamera",
    "RigView",
    "ViewRange",
    "Viewpoints",
    "arm_in_body_frame",
    "arm_in_camera_frame",
    "as_rig",
    "backproject",
    "check_intrinsics",
    "intrinsics",
    "join_arms",
    "lift",
    "load_cameras",
    "map_pixel_covariance",
    "map_pixels",
    "pixel_covariances",
    "project",
    "sample_viewpoints",
    "save_cameras",
    "undistortion_maps",
]

__getattr__ = moved_names(__name__)
