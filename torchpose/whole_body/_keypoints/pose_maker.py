"""Make poses of what the filter found, whose covariances hold what the cameras do not tell.

What is wrong with joints for long, frames do not average out. Somebody whom one of several cameras alone sees
may be larger and farther away by the same factor: with the deviation s of the log of persons' sizes and the
place c of the camera, the covariance of a joint p_j gets s^2 (p_j - c) (p_j - c)^T.

Cameras side by side tell the size, and the depths of which the lifting network is unsure (`only_camera`), the
better the larger the angle between their rays. With the mean c of their places, k of `telling`, and the ray
r_j from c to p_j, the covariance gets

    (s^2 (p_j - c) (p_j - c)^T + (1.25 s_j)^2 r_j r_j^T + s_l^2 I) / k^2.

Hips and legs of a person of whom none of several cameras sees a hip get (1.25 s_j)^2 I (`spread_of_hidden`).
Relative to the pelvis p_0 joints in cameras side by side get the same with p_j - p_0 in place of p_j - c; k
is 1 where one camera alone sees the person.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.body._skeleton import BODY_15
from torchpose.whole_body._keypoints.body_kalman import BodyKalmanFilter, CorrectedBody
from torchpose.whole_body._keypoints.body_size import outer
from torchpose.whole_body._keypoints.keypoint_poses import KeypointPoses, KeypointStream
from torchpose.whole_body._keypoints.known_person import std_of_legs
from torchpose.whole_body._keypoints.lifted_pose import telling
from torchpose.whole_body._keypoints.only_camera import LASTING, relative_covariances, untold_depths

_PELVIS = BODY_15.joint("pelvis")


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
        else:
            lasting = lasting + (LASTING * spread).square()[..., None, None] * eye
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
        k = telling(maps, joints)
        return self._untold_by_one(away, away, spread) / k[..., None, None, None].square()

    def _untold_by_one(
        self,
        grown: Float[Tensor, "*batch J 3"],
        away: Float[Tensor, "*batch J 3"],
        spread: Float[Tensor, "*batch J"],
    ) -> Float[Tensor, "*batch J 3 3"]:
        """Return what one camera does not tell of joints.

        Args:
            grown: metres that joints move by if the log of the size grows by one. away: from the camera.
            spread: as of `KeypointPoses`.
        """
        size = std_of_legs(self.filter.motion) ** 2 * outer(grown)
        return size + untold_depths(away, spread) + self.lone_std**2 * torch.eye(3).to(away)

    def covariance_from_pelvis(self, poses: KeypointPoses) -> Float[Tensor, "T J 3 3"]:
        """Return the covariances of joints relative to the pelvis, whose own is zero; metres squared.

        Args:
            poses: of T frames, [T], in cameras side by side.
        """
        joints, maps = poses.joints, self.filter.maps
        apart, away = joints - joints[..., [_PELVIS], :], joints - maps.centre.mean(0)
        k = torch.where(poses.alone >= 0, 1.0, telling(maps, joints))
        untold = self._untold_by_one(apart, away, poses.spread)
        return relative_covariances(self.filter, poses, untold / k[..., None, None, None].square())
