"""Correct the pose of a body in one camera by what a network lifts.

The filter's errors in depth and the network's are nearly independent: one knows how bodies move and that
they keep their lengths, the other what poses look like. The network has seen the same keypoints as the filter
and is wrong for many frames in a row. So it takes part in the estimate of a frame, but not in the prediction
of the next one:

    l_j = p_j(x) - p_pelvis(x) + e_j,   e_j ~ N(0, (c s_j)^2 I),

with the joints l_j that it found, their standard deviations s_j, and a factor c for persons unlike those that
it was fitted to. The mean is that of an iterated extended Kalman filter. The covariance remains the filter's:
on persons of neither fit it would be too small, since what two estimates of the same keypoints have in common
is not known.
"""

import copy

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose.body._articulation import Articulation, BodyPoint
from torchpose.body._skeleton import BODY_15
from torchpose.camera._rig import CameraRig
from torchpose.priors._body_motion import BodyMotion
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame
from torchpose.whole_body._keypoints.known_person import length_of_legs
from torchpose.whole_body._keypoints.lifting_network import (
    Lifted,
    LiftingNetwork,
    lifting_features,
    shipped_lifting_network,
)

__all__ = ["PoseLifter", "corrected_by", "nothing_lifted"]

_FACTOR = 2.0  # on the network's standard deviations
_ITERATIONS = 3
_LEAST_JOINTS = 6  # keypoints without which a frame is not lifted
_PELVIS = BODY_15.joint("pelvis")
_OTHERS = [j for j in range(len(BODY_15.names)) if j != _PELVIS]


class PoseLifter(nn.Module):
    """Lifts the keypoints of one camera to joints of a person of known size.

    Args:
        rig: of one camera. fps: frames per second. motion: of the person, whose legs tell the size.
        network: that lifts; the shipped one by default.
    """

    def __init__(
        self,
        rig: CameraRig,
        fps: float,
        motion: BodyMotion,
        network: LiftingNetwork | None = None,
    ) -> None:
        super().__init__()
        self.network = copy.deepcopy(network or shipped_lifting_network())
        self.fps = fps
        self.size = length_of_legs(motion) / self.network.info.legs
        self.register_buffer("matrix", rig.matrix[0].clone(), persistent=False)
        self.register_buffer("rotation", rig.rotation[0].clone(), persistent=False)
        self.matrix: Tensor
        self.rotation: Tensor

    def forward(
        self, frame: KeypointFrame, memory: Float[Tensor, "B L W"] | None
    ) -> tuple[Lifted, Float[Tensor, "B L W"]]:
        """Return joints relative to the pelvis in world axes, and what the network keeps in mind.

        Args:
            frame: of keypoints. memory: of the frame before; None at the beginning.
        """
        sure = frame.inlier[:, 0]
        rays = (frame.pixels[:, 0] - self.matrix[:2, 2]) / self.matrix.diagonal()[:2]
        seen = lifting_features(rays, sure, self.fps).to(self.network.places.weight)
        lifted, memory = self.network(seen[:, None], memory)
        joints, std = (self.size * value[:, 0].to(rays) for value in lifted)
        enough = (sure > 0).sum(-1, keepdim=True) >= _LEAST_JOINTS
        return Lifted(joints @ self.rotation, torch.where(enough, std, torch.inf)), memory


def nothing_lifted(joints: Float[Tensor, "*batch J 3"]) -> Lifted:
    """Return what says nothing about these joints."""
    return Lifted(torch.zeros_like(joints), torch.full_like(joints[..., 0], torch.inf))


def corrected_by(
    lifted: Lifted, body: Articulation, mean: BodyPoint, cov: Float[Tensor, "B N N"]
) -> BodyPoint:
    """Return the mean of states given the joints that a network lifted.

    Args:
        lifted: [B, J], world axes. body: whose states they are. mean, cov: of the states before.
    """
    precise = (1 / (_FACTOR * lifted.std[..., _OTHERS, None])).expand(*cov.shape[:-2], -1, 3)
    scale = precise.flatten(-2)
    point, d = mean, torch.zeros_like(cov[..., 0])
    for _ in range(_ITERATIONS):
        joints, jacobian = body.linearise(point)
        apart = (joints - joints[..., [_PELVIS], :])[..., _OTHERS, :]
        H = (jacobian - jacobian[..., [_PELVIS], :, :])[..., _OTHERS, :, :].flatten(-3, -2)
        H = scale[..., None] * H
        off = scale * (lifted.joints[..., _OTHERS, :] - apart).flatten(-2)
        HP = H @ cov
        spread = HP @ H.mT
        chol = torch.linalg.cholesky((spread + spread.mT) / 2 + torch.eye(H.shape[-2]).to(H))
        wanted = off[..., None] + H @ d[..., None]
        d = (HP.mT @ torch.cholesky_solve(wanted, chol)).squeeze(-1)
        point = body.moved(mean, d)
    return body.swung(point, body.joints(point))
