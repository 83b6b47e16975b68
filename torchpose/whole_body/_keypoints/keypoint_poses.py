"""Hold bodies tracked through keypoints: the state between two frames, and the poses of frames."""

from typing import NamedTuple

from torch import Tensor

from torchpose.body._articulation import BodyPoint
from torchpose.whole_body._keypoints.body_kalman import BodyGaussian, CorrectedBody
from torchpose.whole_body._keypoints.body_size import SizeBelief
from torchpose.whole_body._keypoints.faulty_cameras import CameraFaults
from torchpose.whole_body._keypoints.lifted_pose import LifterMemory
from torchpose.whole_body._keypoints.still_joints import StillJoints


class KeypointStream(NamedTuple):
    """Holds the state of tracking B persons between two frames.

    Attributes:
        state: Gaussians of [B]. begun: [B], whether the person was found.
        lost: [B], for how many frames in a row most keypoints have been of something else, or there were
            none, which counts half, or the person has waited for a start.
        alone: [B], which of several cameras alone the person is followed by, -1 if by all.
        memory: of [B], of what lifts the keypoints of each camera.
        faults: of the cameras, as each person tells them.
        size: of [B], of the only camera, in which the filter does not tell it.
        spread: [B, J], metres, standard deviations of the network's joints in the last frame that it lifted.
        unseen: [B, J], seconds since a keypoint was a joint's, infinite where none has been.
        coasting: [B], of whom nothing was measured in the last frame.
        own_sides: [B, C, 2], of `evidence_of_own_sides`.
        still: of [B], which joints stood still when they were last seen.
    """

    state: BodyGaussian
    begun: Tensor
    lost: Tensor
    alone: Tensor
    memory: LifterMemory
    faults: CameraFaults
    size: SizeBelief
    spread: Tensor
    unseen: Tensor
    coasting: Tensor
    own_sides: Tensor
    still: StillJoints


class KeypointPoses(NamedTuple):
    """Holds the poses of B persons; of T frames [B, T, ...], or of one [B, ...].

    Attributes:
        joints: [..., J, 3], metres, world axes. covariance: [..., J, 3, 3], metres squared.
        point: the states, on the manifold. state_cov: [..., N, N], in their tangent spaces.
        inlier: [..., C, J], probability that a keypoint was a joint's. exchanged: [..., C, 2], of sides of
            arms, of legs. log_evidence: [...]. coasting: [...], where nothing was measured. started: [...],
            where tracking began. alone: [...], which of several cameras alone decided, -1 if all did.
        turn: [..., C, 3, 3], rotation in world axes by which keypoints of a camera were turned back.
        off: [..., C], which cameras counted not.
        scale: [..., C], factors of the cameras' noise. joint_cov: [..., J, 3, 3], without what frames do not
            average out, which `covariance` has on top.
        size, spread, unseen: as of `KeypointStream`; what they tell is in the poses already.
    """

    joints: Tensor
    covariance: Tensor
    point: BodyPoint
    state_cov: Tensor
    inlier: Tensor
    exchanged: Tensor
    log_evidence: Tensor
    coasting: Tensor
    started: Tensor
    alone: Tensor
    turn: Tensor
    off: Tensor
    scale: Tensor
    joint_cov: Tensor
    size: SizeBelief
    spread: Tensor
    unseen: Tensor


KeypointStep = tuple[KeypointStream, KeypointPoses, CorrectedBody]
