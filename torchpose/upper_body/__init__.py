"""Track the upper body: 2D keypoints to 2D and 3D poses of eight joints with covariances."""

from torchpose._core.facade import set_up_facade
from torchpose.upper_body._estimator import Estimates, Estimator
from torchpose.upper_body._live import LivePose
from torchpose.upper_body._methods import METHODS, method_options, register_method
from torchpose.upper_body._pose_track import PoseTrack
from torchpose.upper_body._single_poses import PoseFilter, ProcessNoise
from torchpose.upper_body._tracker import UpperBodyTracker

__all__ = [
    "METHODS",
    "Estimates",
    "Estimator",
    "LivePose",
    "PoseFilter",
    "PoseTrack",
    "ProcessNoise",
    "UpperBodyTracker",
    "method_options",
    "register_method",
]

set_up_facade(__name__)
