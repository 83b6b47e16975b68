"""Track the upper body: 2D keypoints to 2D and 3D poses of eight joints with covariances."""

from torchpose._core.facade import set_up_facade
from torchpose.upper_body.estimator import Estimates, Estimator
from torchpose.upper_body.live import LivePose, StreamState
from torchpose.upper_body.methods import METHODS, method_options, register_method
from torchpose.upper_body.pose_track import PoseTrack
from torchpose.upper_body.process_noise import ProcessNoise
from torchpose.upper_body.single_poses import PoseFilter
from torchpose.upper_body.tracker import UpperBodyTracker

__all__ = [
    "METHODS",
    "Estimates",
    "Estimator",
    "LivePose",
    "PoseFilter",
    "PoseTrack",
    "ProcessNoise",
    "StreamState",
    "UpperBodyTracker",
    "method_options",
    "register_method",
]

set_up_facade(__name__)
