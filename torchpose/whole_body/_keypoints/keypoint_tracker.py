"""Track bodies through keypoints: begin, filter, begin anew where a person was lost, smooth."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
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
from torchpose.whole_body._keypoints.depth_flips import flip
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame, RigMaps, Weighed
from torchpose.whole_body._keypoints.keypoint_start import start
from torchpose.whole_body._keypoints.lifted_pose import PoseLifter, corrected_by, nothing_lifted
from torchpose.whole_body._keypoints.lifting_network import Lifted
from torchpose.whole_body._keypoints.nested import mapped, taken
from torchpose.whole_body._keypoints.upright import Upright, camera_up

__all__ = ["LEAST_JOINTS", "KeypointPoses", "KeypointStream", "KeypointTracker", "stacked"]

LEAST_JOINTS = 6  # that are measured where tracking begins
_HYPOTHESES = 16  # that are tracked from one camera, which does not see the depth of limbs
_SHARE = (
    0.1  # of a frame's evidence about hypotheses: its errors are like those of the frames before
)
_KEPT = 0.3  # seconds over which evidence about hypotheses is summed up
_FLIP_TIME = 0.1  # seconds after which a limb is mirrored in depth
_PATIENCE = 0.5  # seconds that a start waits for a second camera, without which it has no distance
_LOST = 0.3  # share of keypoints below which the person is somewhere else
_LOST_TIME = 0.5  # seconds of that after which tracking begins anew
_AT_ONCE = 256  # poses that are corrected together: derivatives of many fill the memory


class KeypointStream(NamedTuple):
    """Holds the state of tracking between two frames, of M hypotheses for each of B persons.

    Attributes:
        state: Gaussians of [B * M]. log_weights: [B, M], of the hypotheses, not normalised.
        begun: [B], whether the person was found. lost: [B], for how many frames in a row most keypoints have
            been of something else, or has waited for a start. age: [B], frames since tracking began.
        memory: [B, L, W], of the network that lifts keypoints of one camera; empty without it.
    """

    state: BodyGaussian
    log_weights: Tensor
    begun: Tensor
    lost: Tensor
    age: Tensor
    memory: Tensor


class KeypointPoses(NamedTuple):
    """Holds the poses of B persons; of T frames [B, T, ...], or of one [B, ...].

    Attributes:
        joints: [..., J, 3], metres, world axes. covariance: [..., J, 3, 3], metres squared.
        point: the states, on the manifold. state_cov: [..., N, N], in their tangent spaces.
        inlier: [..., C, J], probability that a keypoint was a joint's. exchanged: [..., C, 2], of sides of
            arms, of legs. log_evidence: [...]. coasting: [...], where nothing was measured. started: [...],
            where tracking began. lifted: what a network found in one camera.
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
    lifted: Lifted


class KeypointTracker(nn.Module):
    """Tracks bodies through frames of keypoints with a `BodyKalmanFilter`.

    Args:
        rig: the cameras. fps: frames per second. motion: how bodies move. n_iterations: of a correction.
        upright: how people lean, if it is known which way is up; with one camera, this is taken to be level.
        lasting_std: metres, of what is wrong with joints for so long that frames do not average it out, along
            each axis; covariances of joints have it on top.
        lifter: of the keypoints of one camera, which corrects the poses that are returned.
    """

    def __init__(
        self,
        rig: CameraRig,
        fps: float,
        motion: BodyMotion,
        n_iterations: int = 3,
        upright: Upright | None = None,
        lasting_std: float = 0.0,
        lifter: PoseLifter | None = None,
    ) -> None:
        super().__init__()
        self.lasting_std, self.lifter = lasting_std, lifter
        if upright is None and len(rig) == 1:
            upright = camera_up(rig)
        self.filter = BodyKalmanFilter(motion, RigMaps.of(rig), fps, n_iterations, upright)
        self.n_hypotheses = _HYPOTHESES if len(rig) == 1 else 1

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
            stream, pose, found = self._advanced(stream, frame)
            poses.append(pose)
            if smoothing:
                corrected.append(found)
        filtered = stacked(poses)
        return self.smoothed(filtered, corrected) if smoothing else self._reported(filtered)

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
            The next stream, the poses of the frame [B, ...], and the corrected hypotheses as one Gaussian.
        """
        stream, pose, found = self._advanced(stream, frame, predicted)
        return stream, self._reported(pose), found

    def _advanced(
        self,
        stream: KeypointStream | None,
        frame: KeypointFrame,
        predicted: BodyGaussian | None = None,
    ) -> tuple[KeypointStream, KeypointPoses, CorrectedBody]:
        """Return what `advance` does, with poses as the filter has them."""
        waited = frame.inlier.new_zeros(len(frame.inlier)) if stream is None else stream.lost
        enough = self._enough(frame, waited)
        if stream is None:
            due = torch.ones_like(enough)
            stream, found = self._started(frame)
            stream = stream._replace(begun=enough)
        else:
            stream, found = self._followed(stream, frame, predicted)
            due = enough & (~stream.begun | (stream.lost > _LOST_TIME * self.filter.fps))
            if bool(due.any()):
                stream, found = self._begun_anew(stream, found, frame, due)
        chosen = self._merged(stream, found)
        inlier = chosen.weighed.own + chosen.weighed.other
        stream = stream._replace(lost=self._lost(stream, frame, chosen.weighed))
        stream, lifted = self._lifted(stream, frame, chosen.joints)
        pose = KeypointPoses(
            chosen.joints, chosen.joint_cov, chosen.state.mean, chosen.state.cov, inlier,
            chosen.weighed.exchanged, chosen.log_evidence,
            ~(inlier > 0.5).any(-1).any(-1) | ~stream.begun, due & enough, lifted,
        )  # fmt: skip
        return stream, pose, chosen

    def _enough(self, frame: KeypointFrame, waited: Float[Tensor, " B"]) -> Bool[Tensor, " B"]:
        """Return whether tracking may begin: two cameras see the same joints, or have not for long."""
        n_seeing = (frame.inlier > 0).sum(-2)
        n_needed = min(2, frame.inlier.shape[-2])
        patient = waited <= _PATIENCE * self.filter.fps
        needed = torch.where(patient, n_needed, 1)
        return (n_seeing >= needed[:, None]).sum(-1) >= LEAST_JOINTS

    # --- one frame --------------------------------------------------------------------------------

    def _followed(
        self, stream: KeypointStream, frame: KeypointFrame, predicted: BodyGaussian | None = None
    ) -> tuple[KeypointStream, CorrectedBody]:
        count, n_each = stream.log_weights.shape
        every = torch.arange(count, device=frame.pixels.device).repeat_interleave(n_each)
        predicted = self.filter.predict(stream.state) if predicted is None else predicted
        found = self.filter.correct(predicted, frame.take(every))
        told = _SHARE * found.log_evidence.view(count, n_each)
        weights = math.exp(-1 / (_KEPT * self.filter.fps)) * stream.log_weights + told
        weights = weights - weights.amax(-1, keepdim=True)
        stream = stream._replace(state=found.state, log_weights=weights, age=stream.age + 1)
        return self._with_flip(stream, found) if n_each > 1 else (stream, found)

    def _with_flip(
        self, stream: KeypointStream, found: CorrectedBody
    ) -> tuple[KeypointStream, CorrectedBody]:
        """Return hypotheses of which, now and then, the unlikeliest has become another depth of a limb."""
        every = max(1, round(_FLIP_TIME * self.filter.fps))
        due = (stream.age % every == 0).nonzero().squeeze(-1)
        if not len(due):
            return stream, found
        weights = stream.log_weights
        likeliest, unlikeliest = weights.argmax(-1), weights.argmin(-1)
        best = found.take(self._rows(likeliest, weights)[due])
        mirrored = flip(self.filter, best.state, best.joints, stream.age[due] // every)
        proposed = weights.amax(-1)[due] + mirrored.log_ratio
        taken = (proposed > weights.amin(-1)[due]).nonzero().squeeze(-1)
        changed = best._replace(state=mirrored.state).take(taken)
        changed = changed._replace(joints=self.filter.articulation.joints(changed.state.mean))
        rows = due[taken]
        found = found.put(self._rows(unlikeliest, weights)[rows], changed)
        weights = weights.index_put((rows, unlikeliest[rows]), proposed[taken])
        return stream._replace(state=found.state, log_weights=weights), found

    def _started(self, frame: KeypointFrame) -> tuple[KeypointStream, CorrectedBody]:
        """Return the likeliest hypotheses of a start."""
        found, weights = start(self.filter, frame, self.n_hypotheses)
        count = len(weights)
        zero = weights.new_zeros(count)
        begun = torch.ones(count, dtype=torch.bool, device=weights.device)
        weights = _SHARE * (weights - weights[:, :1])
        nothing = weights.new_zeros(count, 0, 0)
        return KeypointStream(found.state, weights, begun, zero, zero.long(), nothing), found

    def _begun_anew(
        self,
        stream: KeypointStream,
        found: CorrectedBody,
        frame: KeypointFrame,
        due: Bool[Tensor, " B"],
    ) -> tuple[KeypointStream, CorrectedBody]:
        """Return the stream with the elements that are due begun with this frame."""
        persons = due.nonzero().squeeze(-1)
        new, new_found = self._started(frame.take(persons))
        n_new = stream.log_weights.shape[1]
        rows = (persons[:, None] * n_new + torch.arange(n_new, device=due.device)).flatten()
        stream = KeypointStream(
            stream.state.put(rows, new.state),
            stream.log_weights.index_copy(0, persons, new.log_weights),
            stream.begun | due,
            torch.where(due, 0.0, stream.lost),
            torch.where(due, 0, stream.age),
            stream.memory,
        )
        return stream, found.put(rows, new_found)

    def _lifted(
        self, stream: KeypointStream, frame: KeypointFrame, joints: Float[Tensor, "B J 3"]
    ) -> tuple[KeypointStream, Lifted]:
        """Return the stream with its memory of the frame, and what the network lifts in it."""
        if self.lifter is None:
            return stream, nothing_lifted(joints)
        lifted, memory = self.lifter(frame, stream.memory if stream.memory.numel() else None)
        return stream._replace(memory=memory), lifted

    def _reported(self, poses: KeypointPoses) -> KeypointPoses:
        """Return the poses as they are reported: corrected by what was lifted, with errors that last."""
        if self.lifter is None:
            return poses._replace(covariance=self._lasting(poses.covariance))
        body, batch = self.filter.articulation, poses.coasting.shape
        states = (poses.lifted, poses.point, poses.state_cov)
        flat = mapped(lambda value: value.flatten(0, len(batch) - 1), states)
        rows = torch.arange(math.prod(batch), device=poses.coasting.device).split(_AT_ONCE)
        points = [
            corrected_by(lifted, body, mean, cov)
            for lifted, mean, cov in (taken(flat, part) for part in rows)
        ]
        point = mapped(lambda *values: torch.cat(values).unflatten(0, batch), *points)
        joints, jacobian = body.linearise(point)
        joint_cov = (jacobian @ poses.state_cov.unsqueeze(-3)) @ jacobian.mT
        return poses._replace(joints=joints, covariance=self._lasting(joint_cov), point=point)

    def _merged(self, stream: KeypointStream, found: CorrectedBody) -> CorrectedBody:
        """Return the Gaussian with the mean and covariance of all hypotheses, in the likeliest one's tangent.

        d = sum_m w_m (x_m - x),   P = sum_m w_m (P_m + (x_m - x - d) (x_m - x - d)^T).
        """
        count, n_each = stream.log_weights.shape
        if n_each == 1:
            return found
        body = self.filter.articulation
        chosen = found.take(self._rows(stream.log_weights.argmax(-1), stream.log_weights))
        middle = chosen.state.mean.map(lambda value: value.repeat_interleave(n_each, 0))
        weights = stream.log_weights.softmax(-1)[..., None]
        steps = body.difference(found.state.mean, middle).unflatten(0, (count, n_each))
        step = (weights * steps).sum(1)
        off = weights.sqrt() * (steps - step[:, None])
        covs = found.state.cov.unflatten(0, (count, n_each))
        cov = (weights[..., None] * covs).sum(1) + off.mT @ off
        point = body.moved(chosen.state.mean, step)
        point = body.swung(point, body.joints(point))
        joints, jacobian = body.linearise(point)
        joint_cov = (jacobian @ cov.unsqueeze(-3)) @ jacobian.mT
        state = chosen.state._replace(mean=point, cov=(cov + cov.mT) / 2)
        return chosen._replace(state=state, joints=joints, joint_cov=joint_cov)

    def _rows(self, chosen: Int[Tensor, " B"], weights: Float[Tensor, "B M"]) -> Int[Tensor, " B"]:
        """Return the rows of one hypothesis of each element."""
        count, n_each = weights.shape
        return torch.arange(count, device=chosen.device) * n_each + chosen

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
        return self._reported(
            filtered._replace(joints=joints, covariance=joint_cov, point=point, state_cov=cov)
        )

    def _lasting(self, joint_cov: Float[Tensor, "*batch J 3 3"]) -> Float[Tensor, "*batch J 3 3"]:
        """Return covariances of joints with what frames do not average out."""
        return joint_cov + self.lasting_std**2 * torch.eye(3).to(joint_cov)


def stacked(poses: Sequence[Any]) -> Any:
    """Return named tuples of tensors [B, ...] as one of tensors [B, T, ...]."""
    return mapped(lambda *values: torch.stack(values, 1), *poses)
