"""Track the upper body: 2D keypoints to 2D and 3D poses of eight joints with covariances."""

from torchpose._core.facade import set_up_facade
from torchpose.upper_body.live import LivePose, StreamState
from torchpose.upper_body.methods import METHODS
from torchpose.upper_body.pose_track import PoseTrack
from torchpose.upper_body.tracker import UpperBodyTracker

__all__ = ["METHODS", "LivePose", "PoseTrack", "StreamState", "UpperBodyTracker"]

set_up_facade(__name__)
