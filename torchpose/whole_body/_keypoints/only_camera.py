"""Say of poses in the only camera how large the person is, and what the camera does not tell.

That are the size, since who is larger and farther looks the same (`body_size`), and depths of which the
network that lifts is unsure. It errs in the same way for long, so frames do not average that out, and each
joint keeps 1.25 times the network's standard deviation s_j along its ray. A joint without a keypoint for
the time t_j is where the network guesses it again and again, so it comes to keep 2.5 times that deviation in
all directions. With p_j from the place of the camera, the ray r_j, and covariances P_j of the filter,

    P_j + var(l) p_j p_j^T + (1.25 s_j)^2 r_j r_j^T + u_j (2.5 s_j)^2 I,   u_j = 1 - exp(-t_j / (0.5 s)).

The network's deviations are those from the pelvis, which counts as seen where a hip is. Relative to it the
larger of u_j and u_pelvis is in place of u_j. In the room, an unseen pelvis is as far off as the neck is from
it, and takes unseen joints along: they have u_j u_pelvis (2.5 s_neck)^2 I on top.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.body._articulation import covariances_of
from torchpose.body._feet import ANKLES
from torchpose.body._skeleton import BODY_15
from torchpose.whole_body._keypoints.body_kalman import HIPS, BodyKalmanFilter
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
LASTING = 1.25
_LASTING_UNSEEN, _FORGOTTEN = 2.5, 0.5  # seconds
_PELVIS, _NECK = BODY_15.joint("pelvis"), BODY_15.joint("neck")


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
        return self.filter.maps.centre[0]

    @property
    def floor(self) -> Floor | None:
        """Return the floor that tells the size, None if it is not known where it is."""
        if self.height is None or self.filter.upright is None:
            return None
        return Floor(self.filter.upright.direction, self.centre, self.height)

    def at_size(self, step: KeypointStep) -> KeypointStep:
        """Return a frame at the sizes that are believed after it."""
        stream, pose, found = step
        floor = self.floor
        if floor is not None:
            trust = found.weighed.inlier[:, 0, ANKLES] * stream.begun[:, None]
            ankles = found.joints[:, ANKLES]
            size = told_by_floor(stream.size, floor, ankles, trust, self.filter.fps)
            stream, pose = stream._replace(size=size), pose._replace(size=size)
        return stream, self.sized(pose), found

    def as_last_told(self, poses: KeypointPoses) -> KeypointPoses:
        """Return sequences [B, T] with the sizes that are believed after their last frames, to be `sized`.

        How long joints have not been seen is told by later frames as well.
        """
        last = mapped(lambda value: value[:, -1:].expand_as(value), poses.size)
        unseen = torch.minimum(poses.unseen, until_seen(poses.unseen) / self.filter.fps)
        return poses._replace(size=last, unseen=unseen)

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
        unsure = self._unsure(poses, _guessed_in_room(poses))
        return poses._replace(
            state_cov=poses.state_cov + variance * outer(along),
            covariance=poses.joint_cov + lasting + of_size + unsure,
        )

    def covariance_from_pelvis(self, poses: KeypointPoses) -> Float[Tensor, "T J 3 3"]:
        """Return the covariances of joints relative to the pelvis, whose own is zero; metres squared.

        Args:
            poses: of T frames, [T].
        """
        return relative_covariances(
            self.filter, poses, self._unsure(poses, _guessed_from_pelvis(poses))
        )

    def _unsure(
        self, poses: KeypointPoses, variances: Float[Tensor, "*batch J"]
    ) -> Float[Tensor, "*batch J 3 3"]:
        """Return the covariances of depths that the network does not tell, and `variances` each way."""
        depths = untold_depths(poses.joints - self.centre, poses.spread)
        return depths + variances[..., None, None] * torch.eye(3).to(depths)


def relative_covariances(
    filter: BodyKalmanFilter, poses: KeypointPoses, lasting: Float[Tensor, "*batch J 3 3"]
) -> Float[Tensor, "*batch J 3 3"]:
    """Return the covariances of joints relative to the pelvis by the state, and what lasts on top.

    Args:
        filter: whose poses they are. lasting: of joints relative to the pelvis; its own is left out.
    """
    _, jacobian = filter.articulation.linearise(poses.point)
    apart = jacobian - jacobian[..., [_PELVIS], :, :]
    lasting[..., _PELVIS, :, :] = 0
    return covariances_of(apart, poses.state_cov) + lasting


def untold_depths(
    away: Float[Tensor, "*batch J 3"], spread: Float[Tensor, "*batch J"]
) -> Float[Tensor, "*batch J 3 3"]:
    """Return the covariances (1.25 s_j)^2 r_j r_j^T of joints in depths of which the network is unsure.

    Args:
        away: from the camera to the joints, metres. spread: s_j, metres.
    """
    rays = torch.nn.functional.normalize(away, dim=-1)
    return (LASTING * spread).square()[..., None, None] * outer(rays)


def _guessed_in_room(poses: KeypointPoses) -> Float[Tensor, "*batch J"]:
    """Return the variances of joints in the room that the network guesses."""
    share, variances = _shares_and_variances(poses)
    of_pelvis = share[..., [_PELVIS]] * variances[..., [_NECK]]
    guessed = share * (variances + of_pelvis)
    guessed[..., _PELVIS] = of_pelvis[..., 0]
    return guessed


def _guessed_from_pelvis(poses: KeypointPoses) -> Float[Tensor, "*batch J"]:
    """Return the variances of joints relative to the pelvis if one of both is guessed."""
    share, variances = _shares_and_variances(poses)
    return torch.maximum(share, share[..., [_PELVIS]]) * variances


def _shares_and_variances(
    poses: KeypointPoses,
) -> tuple[Float[Tensor, "*batch J"], Float[Tensor, "*batch J"]]:
    """Return u_j and (2.5 s_j)^2."""
    unseen = poses.unseen.clone()
    unseen[..., _PELVIS] = unseen[..., HIPS].amin(-1)
    return -torch.expm1(-unseen / _FORGOTTEN), (_LASTING_UNSEEN * poses.spread).square()


def until_seen(unseen: Float[Tensor, "B T J"]) -> Float[Tensor, "B T J"]:
    """Return for how many frames joints will not be seen, infinite where none follows in which they are.

    Args:
        unseen: how long they have not been.
    """
    now = torch.arange(unseen.shape[1]).to(unseen)[:, None]
    seen = torch.where(unseen == 0, now, torch.inf)
    return seen.flip(1).cummin(1).values.flip(1) - now
