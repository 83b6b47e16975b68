"""Model cameras: pinhole cameras and rigs, projection and lifting, viewpoints."""

from torchpose._core.facade import set_up_facade
from torchpose.camera._pinhole import PinholeCamera, load_cameras, save_cameras
from torchpose.camera._projection import lift, map_pixels, project
from torchpose.camera._rig import CameraRig
from torchpose.camera._viewpoints import ViewRange, sample_viewpoints

__all__ = [
    "CameraRig",
    "PinholeCamera",
    "ViewRange",
    "lift",
    "load_cameras",
    "map_pixels",
    "project",
    "sample_viewpoints",
    "save_cameras",
]

set_up_facade(__name__)
