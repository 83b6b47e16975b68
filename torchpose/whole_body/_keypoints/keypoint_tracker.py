"""Track bodies through keypoints: begin, filter, begin anew where a person was lost, smooth."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from tqdm.auto import tqdm

from torchpose.body._articulation import BodyPoint
from torchpose.camera._rig import CameraRig
from torchpose.priors._body_motion import BodyMotion
from torchpose.whole_body._keypoints.body_kalman import (
    BodyGaussian,
    BodyKalmanFilter,
    CorrectedBody,
)
from torchpose.whole_body._keypoints.body_smoothing import smooth
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame, RigMaps, Weighed
from torchpose.whole_body._keypoints.keypoint_start import start, start_of_one
from torchpose.whole_body._keypoints.lifted_pose import PoseLifter, contradicts, corrected_by
from torchpose.whole_body._keypoints.lifting_network import Lifted
from torchpose.whole_body._keypoints.nested import mapped, taken
from torchpose.whole_body._keypoints.upright import Upright, camera_up

__all__ = ["LEAST_JOINTS", "KeypointPoses", "KeypointStream", "KeypointTracker", "stacked"]

LEAST_JOINTS = 6  # that are measured where tracking begins
_PATIENCE = 0.5  # seconds that a start waits for a second camera, without which it has no distance
_LOST = 0.3  # share of keypoints below which the person is somewhere else
_LOST_TIME = 0.5  # seconds of that after which tracking begins anew


class KeypointStream(NamedTuple):
    """Holds the state of tracking B persons between two frames.

    Attributes:
        state: Gaussians of [B]. begun: [B], whether the person was found.
        lost: [B], for how many frames in a row most keypoints have been of something else, or the person has
            waited for a start.
        memory: [B, L, W], of the network that lifts keypoints of one camera; empty with several.
    """

    state: BodyGaussian
    begun: Tensor
    lost: Tensor
    memory: Tensor


class KeypointPoses(NamedTuple):
    """Holds the poses of B persons; of T frames [B, T, ...], or of one [B, ...].

    Attributes:
        joints: [..., J, 3], metres, world axes. covariance: [..., J, 3, 3], metres squared.
        point: the states, on the manifold. state_cov: [..., N, N], in their tangent spaces.
        inlier: [..., C, J], probability that a keypoint was a joint's. exchanged: [..., C, 2], of sides of
            arms, of legs. log_evidence: [...]. coasting: [...], where nothing was measured. started: [...],
            where tracking began.
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


class KeypointTracker(nn.Module):
    """Tracks bodies through frames of keypoints with a `BodyKalmanFilter`.

    Args:
        rig: the cameras. fps: frames per second. motion: how bodies move. n_iterations: of a correction.
        upright: how people lean, if it is known which way is up; with one camera, this is taken to be level.
        lasting_std: metres, of what is wrong with joints for so long that frames do not average it out, along
            each axis; covariances of joints have it on top.
    """

    def __init__(
        self,
        rig: CameraRig,
        fps: float,
        motion: BodyMotion,
        n_iterations: int = 3,
        upright: Upright | None = None,
        lasting_std: float = 0.0,
    ) -> None:
        super().__init__()
        self.lasting_std = lasting_std
        self.lifter: PoseLifter | None = None
        if len(rig) == 1:
            upright = camera_up(rig) if upright is None else upright
            self.lifter = PoseLifter(rig, fps, motion, upright.direction)
        self.filter = BodyKalmanFilter(motion, RigMaps.of(rig), fps, n_iterations, upright)

    def forward(
        self, frames: KeypointFrame, smoothing: bool = False, progress: bool = False
    ) -> KeypointPoses:
        """Track whole sequences.

        Args:
            frames: [B, T, C, J, ...]. smoothing: whether later frames count too. progress: show a bar.
        """
        n_frames = frames.pixels.shape[1]
        stream: KeypointStream | None = None
        poses, corrected = [], []
        for t in tqdm(range(n_frames), disable=not progress, unit="frame"):
            frame = frames.map(lambda value: value[:, t])  # noqa: B023
            stream, pose, found = self.advance(stream, frame)
            poses.append(pose)
            if smoothing:
                corrected.append(found)
        filtered = stacked(poses)
        return self.smoothed(filtered, corrected) if smoothing else filtered

    def advance(
        self,
        stream: KeypointStream | None,
        frame: KeypointFrame,
        predicted: BodyGaussian | None = None,
    ) -> tuple[KeypointStream, KeypointPoses, CorrectedBody]:
        """Track one more frame; the first one begins where there is no stream yet.

        Args:
            stream: of the frame before. frame: the keypoints. predicted: the states of the stream one frame
                later, if they are known already.

        Returns:
            The next stream, the poses of the frame [B, ...], and what the correction gave.
        """
        memory, lifted = self._lifted(stream, frame)
        waited = frame.inlier.new_zeros(len(frame.inlier)) if stream is None else stream.lost
        enough = self._enough(frame, waited)
        if stream is None:
            due = enough
            found = self._started(frame, lifted)
            stream = KeypointStream(found.state, enough, torch.zeros_like(waited), memory)
        else:
            predicted = self.filter.predict(stream.state) if predicted is None else predicted
            found = self._followed(frame, lifted, predicted)
            due = ~stream.begun | (stream.lost > _LOST_TIME * self.filter.fps)
            if lifted is not None:
                due = due | contradicts(lifted, self.filter, predicted)
            due = enough & due
            if bool(due.any()):
                found = self._begun_anew(found, frame, lifted, due)
            stream = KeypointStream(
                found.state, stream.begun | due, torch.where(due, 0.0, stream.lost), memory
            )
        inlier = found.weighed.own + found.weighed.other
        stream = stream._replace(lost=self._lost(stream, frame, found.weighed))
        pose = KeypointPoses(
            found.joints, self._lasting(found.joint_cov), found.state.mean, found.state.cov, inlier,
            found.weighed.exchanged, found.log_evidence,
            ~(inlier > 0.5).any(-1).any(-1) | ~stream.begun, due,
        )  # fmt: skip
        return stream, pose, found

    def _enough(self, frame: KeypointFrame, waited: Float[Tensor, " B"]) -> Bool[Tensor, " B"]:
        """Return whether tracking may begin: two cameras see the same joints, or have not for long."""
        n_seeing = (frame.inlier > 0).sum(-2)
        n_needed = min(2, frame.inlier.shape[-2])
        patient = waited <= _PATIENCE * self.filter.fps
        needed = torch.where(patient, n_needed, 1)
        return (n_seeing >= needed[:, None]).sum(-1) >= LEAST_JOINTS

    # --- one frame --------------------------------------------------------------------------------

    def _lifted(
        self, stream: KeypointStream | None, frame: KeypointFrame
    ) -> tuple[Float[Tensor, "B L W"], Lifted | None]:
        """Return what the network keeps in mind, and what it lifts in a frame of one camera."""
        if self.lifter is None:
            return frame.inlier.new_zeros(len(frame.inlier), 0, 0), None
        lifted, memory = self.lifter(frame, None if stream is None else stream.memory)
        return memory, lifted

    def _followed(
        self, frame: KeypointFrame, lifted: Lifted | None, predicted: BodyGaussian
    ) -> CorrectedBody:
        """Return the persons of a stream in the next frame."""
        if lifted is not None:
            predicted = corrected_by(lifted, self.filter, predicted)
        return self.filter.correct(predicted, frame)

    def _started(self, frame: KeypointFrame, lifted: Lifted | None) -> CorrectedBody:
        """Return persons who begin with this frame."""
        if self.lifter is None or lifted is None:
            return start(self.filter, frame)
        return start_of_one(self.filter, frame, lifted, self.lifter.placed(lifted, frame))

    def _begun_anew(
        self,
        found: CorrectedBody,
        frame: KeypointFrame,
        lifted: Lifted | None,
        due: Bool[Tensor, " B"],
    ) -> CorrectedBody:
        """Return what was found, with the persons who are due begun with this frame."""
        persons = due.nonzero().squeeze(-1)
        theirs = None if lifted is None else taken(lifted, persons)
        return found.put(persons, self._started(frame.take(persons), theirs))

    def _lasting(self, joint_cov: Float[Tensor, "*batch J 3 3"]) -> Float[Tensor, "*batch J 3 3"]:
        """Return covariances of joints with what frames do not average out."""
        return joint_cov + self.lasting_std**2 * torch.eye(3).to(joint_cov)

    def _lost(
        self, stream: KeypointStream, frame: KeypointFrame, weighed: Weighed
    ) -> Float[Tensor, " B"]:
        """Return for how many frames in a row keypoints have been of something else, or of the other side.

        A camera that seems to exchange sides counts half: detectors do so for moments, and where it goes on,
        it is the body that has them the wrong way round.
        """
        expected = frame.inlier.sum((-2, -1))
        found = (weighed.own + weighed.other).sum((-2, -1))
        turned = (weighed.exchanged > 0.5).any(-1).any(-1)
        grown = stream.lost + torch.where(found < _LOST * expected, 1.0, 0.5)
        astray = (found < _LOST * expected) | turned
        lost = torch.where(astray, grown, 0.0)
        lost = torch.where(stream.begun, lost, stream.lost + 1)
        return torch.where(expected > 0, lost, stream.lost)

    # --- whole sequences --------------------------------------------------------------------------

    def smoothed(
        self,
        filtered: KeypointPoses,
        corrected: Sequence[CorrectedBody],
    ) -> KeypointPoses:
        """Return poses for which later frames count too, up to where tracking began anew."""
        widened = torch.stack([found.widened for found in corrected])
        states = [found.state for found in corrected]
        result = smooth(self.filter, states, widened, filtered.started.mT)
        point = result.mean.map(lambda value: value.transpose(0, 1))
        cov = result.cov.transpose(0, 1)
        joints, jacobian = self.filter.articulation.linearise(point)
        joint_cov = (jacobian @ cov.unsqueeze(-3)) @ jacobian.mT
        joint_cov = self._lasting(joint_cov)
        return filtered._replace(joints=joints, covariance=joint_cov, point=point, state_cov=cov)


def stacked(poses: Sequence[Any]) -> Any:
    """Return named tuples of tensors [B, ...] as one of tensors [B, T, ...]."""
    return mapped(lambda *values: torch.stack(values, 1), *poses)
