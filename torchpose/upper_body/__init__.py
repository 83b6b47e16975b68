"""Track the upper body: 2D keypoints to 2D and 3D poses of eight joints with covariances."""

from torchpose._core.facade import set_up_facade
from torchpose.upper_body._estimator import Estimates, Estimator
from torchpose.upper_body._estimator_table import METHODS, method_options, register_method
from torchpose.upper_body._live_pose import LivePose
from torchpose.upper_body._measured_joints import arm_measurements, pixel_indices
from torchpose.upper_body._pose_files import write_bvh
from torchpose.upper_body._pose_track import PoseTrack
from torchpose.upper_body._single_poses import PoseFilter, ProcessNoise
from torchpose.upper_body._upper_body_tracker import UpperBodyTracker

__all__ = [
    "METHODS",
    "Estimates",
    "Estimator",
    "LivePose",
    "PoseFilter",
    "PoseTrack",
    "ProcessNoise",
    "UpperBodyTracker",
    "arm_measurements",
    "method_options",
    "pixel_indices",
    "register_method",
    "write_bvh",
]

set_up_facade(__name__)
