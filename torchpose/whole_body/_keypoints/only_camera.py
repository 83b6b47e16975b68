"""Say of poses in the only camera how large the person is, and what the camera does not tell.

That are the size, since who is larger and farther looks the same (`body_size`), and depths of which the
network that lifts is unsure. It errs in the same way for long, so frames do not average that out, and each
joint keeps 1.25 times the network's standard deviation s_j along its ray. With p_j from the place of the
camera, the ray r_j, and covariances P_j of the filter,

    P_j + var(l) p_j p_j^T + (1.25 s_j)^2 r_j r_j^T.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.body._feet import ANKLES
from torchpose.body._skeleton import BODY_15
from torchpose.whole_body._keypoints.body_kalman import BodyKalmanFilter
from torchpose.whole_body._keypoints.body_size import (
    Floor,
    outer,
    resized,
    tangent_of_size,
    told_by_floor,
    units_of_size,
)
from torchpose.whole_body._keypoints.keypoint_poses import KeypointPoses, KeypointStep
from torchpose.whole_body._keypoints.nested import mapped

# On the network's standard deviations. With it 90 % ellipsoids hold 89 % of the joints of persons who are
# strangers to a network that was fitted without them.
_LASTING = 1.25
_PELVIS = BODY_15.joint("pelvis")


class OnlyCamera:
    """Puts poses of one camera at the size that is believed; covariances hold what it does not tell.

    Args:
        filter: of this camera. height: of the camera above the floor, metres, which tells the size of
            persons where it is known which way is up; None if it is not known.
        lasting_std: metres, of what is wrong with joints for so long that frames do not average it out.
    """

    def __init__(self, filter: BodyKalmanFilter, height: float | None, lasting_std: float) -> None:
        self.filter, self.height, self.lasting_std = filter, height, lasting_std

    @property
    def centre(self) -> Float[Tensor, "3"]:
        """Return the place of the camera."""
        maps = self.filter.maps
        return -torch.linalg.solve(maps.matrix[0], maps.shift[0])

    def at_size(self, step: KeypointStep) -> KeypointStep:
        """Return a frame at the sizes that are believed after it."""
        stream, pose, found = step
        if self.height is not None and self.filter.upright is not None:
            floor = Floor(self.filter.upright.direction, self.centre, self.height)
            trust = found.weighed.inlier[:, 0, ANKLES] * stream.begun[:, None]
            ankles = found.joints[:, ANKLES]
            size = told_by_floor(stream.size, floor, ankles, trust, self.filter.fps)
            stream, pose = stream._replace(size=size), pose._replace(size=size)
        return stream, self.sized(pose), found

    def at_last_size(self, poses: KeypointPoses) -> KeypointPoses:
        """Return sequences [B, T] at the sizes that are believed after their last frames."""
        last = mapped(lambda value: value[:, -1:].expand_as(value), poses.size)
        return self.sized(poses._replace(size=last))

    def sized(self, poses: KeypointPoses) -> KeypointPoses:
        """Return poses, as the filter has them, at the sizes that are stated with them."""
        body, centre, log_size = self.filter.articulation, self.centre, poses.size.log
        if self.height is not None:
            units = units_of_size(body, log_size)
            point = resized(poses.point, log_size, centre)
            poses = poses._replace(
                joints=body.joints(point),
                point=point,
                state_cov=units[..., None] * poses.state_cov * units[..., None, :],
                joint_cov=(2 * log_size).exp()[..., None, None, None] * poses.joint_cov,
            )
        away, variance = poses.joints - centre, poses.size.variance[..., None, None]
        lasting = self.lasting_std**2 * torch.eye(3).to(away)
        of_size = variance[..., None] * outer(away)
        along = tangent_of_size(body, poses.point, centre)
        return poses._replace(
            state_cov=poses.state_cov + variance * outer(along),
            covariance=poses.joint_cov + lasting + of_size + self._unsure_depth(poses),
        )

    def covariance_from_pelvis(self, poses: KeypointPoses) -> Float[Tensor, "*batch J 3 3"]:
        """Return the covariances of joints relative to the pelvis, whose own is zero; metres squared."""
        _, jacobian = self.filter.articulation.linearise(poses.point)
        apart = jacobian - jacobian[..., [_PELVIS], :, :]
        lasting = self._unsure_depth(poses)
        lasting[..., _PELVIS, :, :] = 0
        return apart @ poses.state_cov.unsqueeze(-3) @ apart.mT + lasting

    def _unsure_depth(self, poses: KeypointPoses) -> Float[Tensor, "*batch J 3 3"]:
        """Return the covariances of what the network does not tell of depths."""
        rays = torch.nn.functional.normalize(poses.joints - self.centre, dim=-1)
        return (_LASTING * poses.spread).square()[..., None, None] * outer(rays)
