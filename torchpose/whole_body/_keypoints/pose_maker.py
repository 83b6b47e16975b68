"""Make poses of what the filter found, whose covariances hold what the cameras do not tell.

What is wrong with joints for long, frames do not average out. Somebody whom one of several cameras alone sees
may be larger and farther away by the same factor: with the deviation s of the log of persons' sizes and the
place c of the camera, the covariance of a joint p_j gets s^2 (p_j - c) (p_j - c)^T.

Cameras side by side tell the size, and the depths of which the lifting network is unsure (`only_camera`), the
better the larger the angle between their rays. With the mean c of their places, k of `telling`, and the ray
r_j from c to p_j, the covariance gets

    (s^2 (p_j - c) (p_j - c)^T + (1.25 s_j)^2 r_j r_j^T + s_l^2 I) / k^2.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.whole_body._keypoints.body_kalman import BodyKalmanFilter, CorrectedBody
from torchpose.whole_body._keypoints.body_size import outer
from torchpose.whole_body._keypoints.keypoint_poses import KeypointPoses, KeypointStream
from torchpose.whole_body._keypoints.known_person import std_of_legs
from torchpose.whole_body._keypoints.lifted_pose import telling
from torchpose.whole_body._keypoints.only_camera import untold_depths


class PoseMaker:
    """Makes poses of what a filter found.

    Args:
        filter: that found. side_by_side: whether it has several cameras, side by side.
        lasting_std: metres, along each axis, of what frames do not average out.
        lone_std: the same where one of several cameras alone sees a person, s_l.
    """

    def __init__(
        self, filter: BodyKalmanFilter, side_by_side: bool, lasting_std: float, lone_std: float
    ) -> None:
        self.filter, self.side_by_side = filter, side_by_side
        self.lasting_std, self.lone_std = lasting_std, lone_std

    def posed(
        self, stream: KeypointStream, found: CorrectedBody, started: Bool[Tensor, " B"]
    ) -> KeypointPoses:
        """Return the poses of a frame.

        Args:
            stream: after the frame. found: in it. started: who begins with it.
        """
        inlier = found.weighed.inlier
        return KeypointPoses(
            found.joints,
            self.covariance(found.joint_cov, found.joints, stream.alone, stream.spread),
            found.state.mean, found.state.cov, inlier, found.weighed.exchanged, found.log_evidence,
            ~(inlier > 0.5).any(-1).any(-1) | ~stream.begun, started, stream.alone,
            stream.faults.turn, stream.faults.off, found.state.scale, found.joint_cov,
            stream.size, stream.spread, stream.unseen,
        )  # fmt: skip

    def covariance(
        self,
        joint_cov: Float[Tensor, "*batch J 3 3"],
        joints: Float[Tensor, "*batch J 3"],
        alone: Int[Tensor, "*batch"],
        spread: Float[Tensor, "*batch J"],
    ) -> Float[Tensor, "*batch J 3 3"]:
        """Return covariances of joints with what frames do not average out, and cameras do not tell.

        Args:
            joint_cov: of the filter. joints: metres. alone, spread: as of `KeypointPoses`.
        """
        eye = torch.eye(3).to(joint_cov)
        lasting = self.lasting_std**2 * eye
        if self.side_by_side:
            lasting = lasting + self._hardly_told(joints, spread)
        by_one = alone >= 0
        if not bool(by_one.any()):
            return joint_cov + lasting
        by_one = by_one[..., None, None, None]
        centre = self.filter.maps.centre[alone.clamp_min(0)].unsqueeze(-2)
        wider = joint_cov + outer(std_of_legs(self.filter.motion) * (joints - centre))
        cov = torch.where(by_one, wider, joint_cov)
        return cov + torch.where(by_one, self.lone_std**2 * eye, lasting)

    def _hardly_told(
        self, joints: Float[Tensor, "*batch J 3"], spread: Float[Tensor, "*batch J"]
    ) -> Float[Tensor, "*batch J 3 3"]:
        """Return what one camera would not tell, as far as cameras side by side do not."""
        maps = self.filter.maps
        away = joints - maps.centre.mean(0)
        size = std_of_legs(self.filter.motion) ** 2 * outer(away)
        lone = self.lone_std**2 * torch.eye(3).to(joints)
        untold = size + untold_depths(away, spread) + lone
        return untold / telling(maps, joints)[..., None, None, None].square()
