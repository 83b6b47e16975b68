"""Track bodies through keypoints: begin, filter, begin anew where a person was lost, smooth."""

from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from tqdm.auto import tqdm

from torchpose._core.module_state import derived
from torchpose.body._articulation import covariances_of
from torchpose.camera._rig import CameraRig
from torchpose.priors._body_motion import BodyMotion
from torchpose.whole_body._keypoints.body_kalman import (
    BodyGaussian,
    BodyKalmanFilter,
    CorrectedBody,
)
from torchpose.whole_body._keypoints.body_size import SizeBelief, outer
from torchpose.whole_body._keypoints.body_smoothing import BodyMoments, smooth
from torchpose.whole_body._keypoints.faulty_cameras import (
    LEAST_CAMERAS,
    CameraFaults,
    corrected,
    find_faults,
    looked_at_again,
    noted,
    watched,
    with_returned,
    without_still,
)
from torchpose.whole_body._keypoints.joint_triangulation import triangulate
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame, Weighed
from torchpose.whole_body._keypoints.keypoint_poses import (
    KeypointPoses,
    KeypointStep,
    KeypointStream,
)
from torchpose.whole_body._keypoints.keypoint_start import start, start_of_one
from torchpose.whole_body._keypoints.known_person import of_one_camera, std_of_legs
from torchpose.whole_body._keypoints.lifted_pose import (
    LifterMemory,
    PoseLifter,
    are_side_by_side,
    contradicts,
    corrected_by,
    telling,
)
from torchpose.whole_body._keypoints.lifting_network import Lifted
from torchpose.whole_body._keypoints.lone_camera import (
    NOBODY,
    SAME_NOISE,
    LoneNoise,
    frame_of,
    into_all,
    of_any_size,
    state_of,
)
from torchpose.whole_body._keypoints.nested import (
    FrameCollector,
    frame_at,
    mapped,
    part_of,
    replaced,
    taken,
    write_part,
)
from torchpose.whole_body._keypoints.only_camera import LASTING, OnlyCamera

LEAST_JOINTS = 6  # that are measured where tracking begins
_PATIENCE = 0.5  # seconds that a start waits for a second camera, which tells the distance
_LOST = 0.3  # share of keypoints below which the person is somewhere else
_LOST_TIME = 0.5  # seconds of that after which tracking begins anew
_AWAY = 0.5  # of a lost frame counts one in which nobody is seen: a second until a new start


class KeypointTracker(nn.Module):
    """Tracks bodies through frames of keypoints with a `BodyKalmanFilter`.

    Args:
        rig: the cameras. fps: frames per second. motion: how bodies move. n_iterations: of a correction.
        up: "y" or "z", the axis of the world that points up; without it one camera is taken to be level.
        lasting_std: metres, of what is wrong with joints for so long that frames do not average it out, along
            each axis; covariances of joints have it on top.
        lone: noise where one of several cameras alone sees a person.
        size_std: of the log of a person's size, in the covariances of poses of one camera; 0 leaves out what
            it does not tell.
        camera_height: metres of the only camera above the floor, which tells the size; needs `up`.
    """

    def __init__(
        self,
        rig: CameraRig,
        fps: float,
        motion: BodyMotion,
        n_iterations: int = 3,
        up: str | None = None,
        lasting_std: float = 0.0,
        lone: LoneNoise = SAME_NOISE,
        size_std: float = 0.0,
        camera_height: float | None = None,
    ) -> None:
        super().__init__()
        self.lasting_std, self.lone = lasting_std, lone
        self.size_std = size_std
        self._rig = (rig,)  # a tuple, so that its tensors are held once
        self.lifter = PoseLifter(rig, fps, motion, up) if are_side_by_side(rig) else None
        self.filter = BodyKalmanFilter(motion, rig, fps, n_iterations, up)
        self.only = OnlyCamera(self.filter, camera_height, lasting_std) if size_std > 0 else None

    def forward(
        self,
        frames: KeypointFrame,
        smoothing: bool = False,
        progress: bool = False,
        waited: float = 0.0,
        watch: bool = True,
        lengths: Int[Tensor, " B"] | None = None,
    ) -> KeypointPoses:
        """Track whole sequences.

        Args:
            frames: [B, T, C, J, ...]. smoothing: whether later frames count too. progress: show a bar.
            waited: frames for which the first one has waited for a second camera already.
            watch: as of `advance`. lengths: frames of each sequence, after which nothing is measured and from
                which smoothing begins; all if None.
        """
        n_frames = frames.pixels.shape[1]
        stream: KeypointStream | None = None
        every = FrameCollector(n_frames)
        for t in tqdm(range(n_frames), disable=not progress, unit="frame"):
            frame: KeypointFrame = frame_at(frames, t)
            stream, pose, found = self.advance(stream, frame, waited=waited, watch=watch)
            every.add(to_be_smoothed(pose, found) if smoothing else pose)
        if not smoothing:
            return every.sequence
        poses, widened = every.sequence
        # a frame in which tracking begins anew says nothing of those before
        if lengths is not None:
            past = torch.arange(n_frames, device=lengths.device) == lengths[:, None]
            poses = poses._replace(started=poses.started | past)
        return self.smoothed(poses, widened)

    def advance(
        self,
        stream: KeypointStream | None,
        frame: KeypointFrame,
        predicted: BodyGaussian | None = None,
        waited: float = 0.0,
        watch: bool = True,
    ) -> KeypointStep:
        """Track one more frame; the first one begins where there is no stream yet.

        Args:
            stream: of the frame before. frame: the keypoints. predicted: the states of the stream one frame
                later, if they are known already. waited: frames that the first one has waited for already.
            watch: whether cameras may be found to be wrong.

        Returns:
            The next stream, the poses of the frame [B, ...], and what the correction gave.
        """
        if len(self._rig[0]) == 1:
            step = self._advanced(stream, frame, predicted, waited)
            return step if self.only is None else self.only.at_size(step)
        if not watch:
            step = self._advanced(stream, frame, predicted, waited)
            return self._with_lone_cameras(stream, frame, step)
        faults = CameraFaults.none(frame) if stream is None else stream.faults
        given = without_still(frame, faults.pixels, faults.inlier)
        if stream is not None:
            faults = looked_at_again(self.filter, faults, given)
            stream = stream._replace(faults=faults)
        right = corrected(given, faults, self.filter.maps)
        step = self._advanced(stream, right, predicted, waited)
        step = self._with_lone_cameras(stream, right, step)
        return self._watched(step, frame, given, right)

    def _advanced(
        self,
        stream: KeypointStream | None,
        frame: KeypointFrame,
        predicted: BodyGaussian | None,
        waited: float,
    ) -> KeypointStep:
        """Return the next frame by all cameras together."""
        memory, lifted = self._lifted(stream, frame)
        count = frame.inlier.new_full((len(frame.inlier),), waited)
        enough = self._enough(frame, count if stream is None else stream.lost)
        if stream is None:
            due, nobody = enough, torch.full_like(enough, NOBODY, dtype=torch.long)
            found = self._started(frame, lifted)
            lost, faults = torch.zeros_like(count), CameraFaults.none(frame)
            size, never = SizeBelief.usual(self.size_std, count), frame.inlier[:, 0]
            stream = KeypointStream(
                found.state, enough, lost, nobody, memory, faults, size,
                torch.zeros_like(never), torch.full_like(never, torch.inf),
            )  # fmt: skip
        else:
            predicted = self.filter.predict(stream.state) if predicted is None else predicted
            found = self._followed(frame, lifted, predicted)
            due = ~stream.begun | (stream.lost > _LOST_TIME * self.filter.fps)
            if lifted is not None:
                due = due | contradicts(lifted, self.filter, predicted)
            due = enough & (due | self._seen_again(stream, frame))
            if bool(due.any()):
                found = self._begun_anew(found, frame, lifted, due)
            lost, alone = torch.where(due, 0.0, stream.lost), torch.where(due, NOBODY, stream.alone)
            stream = stream._replace(
                state=found.state, begun=stream.begun | due, lost=lost, alone=alone, memory=memory
            )
        if lifted is not None:
            spread = torch.where(lifted.std.isfinite(), lifted.std, stream.spread)
            seen = found.weighed.inlier.amax(1) > 0.5
            unseen = torch.where(seen, 0.0, stream.unseen + 1 / self.filter.fps)
            stream = stream._replace(spread=spread, unseen=unseen)
        stream = stream._replace(lost=self._lost(stream, frame, found.weighed))
        if lifted is not None:
            stream = stream._replace(memory=self._recalled(stream, frame))
        return stream, self._posed(stream, found, due), found

    def _posed(
        self, stream: KeypointStream, found: CorrectedBody, started: Bool[Tensor, " B"]
    ) -> KeypointPoses:
        """Return the poses of a frame."""
        inlier = found.weighed.inlier
        return KeypointPoses(
            found.joints,
            self._unsure(found.joint_cov, found.joints, stream.alone, stream.spread),
            found.state.mean, found.state.cov, inlier, found.weighed.exchanged, found.log_evidence,
            ~(inlier > 0.5).any(-1).any(-1) | ~stream.begun, started, stream.alone,
            stream.faults.turn, stream.faults.off, found.state.scale, found.joint_cov,
            stream.size, stream.spread, stream.unseen,
        )  # fmt: skip

    def first_frames(self, frames: KeypointFrame) -> Int[Tensor, " B"]:
        """Return the frames in which tracking begins, T where it never does.

        Args:
            frames: [B, T, C, J, ...].
        """
        count = len(frames.pixels)
        there = (frames.inlier > 0).flatten(2).any(-1)
        waited = there.cumsum(-1) - there.long()
        every = frames.map(lambda value: value.flatten(0, 1))
        enough = self._enough(every, waited.flatten().to(every.inlier)).view(count, -1)
        never = torch.ones_like(enough[:, :1])
        return torch.cat([enough, never], -1).int().argmax(-1)

    def _enough(self, frame: KeypointFrame, waited: Float[Tensor, " B"]) -> Bool[Tensor, " B"]:
        """Return whether tracking may begin: two cameras see the same joints, or one for long."""
        there = frame.inlier > 0
        n_needed = min(2, frame.inlier.shape[-2])
        enough = (there.sum(-2) >= n_needed).sum(-1) >= LEAST_JOINTS
        return enough | ((waited > _PATIENCE * self.filter.fps) & _sees_enough(there).any(-1))

    # --- cameras that are wrong -------------------------------------------------------------------

    def _watched(
        self, step: KeypointStep, frame: KeypointFrame, given: KeypointFrame, right: KeypointFrame
    ) -> KeypointStep:
        """Return the frame with cameras that are found to be wrong left out, or turned back.

        Args:
            step: the frame by cameras as they were known. frame: the keypoints. given: those that are new.
            right: as cameras would see them that are right.
        """
        stream, pose, found = step
        faults = noted(stream.faults, frame, given)
        if right.inlier.shape[1] >= LEAST_CAMERAS:
            several = stream.begun & (stream.alone < 0)
            fresh = pose.started & (faults.looks.n_frames == 0)
            faults, due = watched(self.filter, faults, found, right, several, fresh)
            if bool(faults.off.any()):
                faults = with_returned(self.filter, faults, found, given)
            rows = due.nonzero().squeeze(-1)
            if len(rows):
                stream = stream._replace(faults=faults)
                return self._explained((stream, pose, found), given, rows)
        return stream._replace(faults=faults), pose, found

    def _explained(
        self, step: KeypointStep, frame: KeypointFrame, rows: Int[Tensor, " N"]
    ) -> KeypointStep:
        """Return the frame with some persons begun anew, if that explains what cameras see."""
        stream, pose, before = taken(step, rows)
        begun = before if bool(pose.started.all()) else None
        faults, found, better = find_faults(self.filter, frame.take(rows), stream.faults, begun)
        stream = stream._replace(faults=faults)
        anew = stream._replace(state=found.state, lost=torch.zeros_like(stream.lost))
        explained = anew, self._posed(anew, found, torch.ones_like(better)), found
        kept = stream, pose, before
        chosen = better.nonzero().squeeze(-1)
        after = replaced(kept, chosen, taken(explained, chosen))
        return replaced(step, rows, after)

    # --- one of several cameras -------------------------------------------------------------------

    def _with_lone_cameras(
        self, before: KeypointStream | None, frame: KeypointFrame, step: KeypointStep
    ) -> KeypointStep:
        """Return the next frame with those whom one camera sees followed by that camera."""
        stream, pose, _ = step
        if not bool((pose.started | (stream.alone >= 0)).any()):
            return step
        there = frame.inlier > 0
        fresh = pose.started & ~self._triangulated(frame).any(-1) & _sees_enough(there).any(-1)
        alone = torch.where(fresh, there.sum(-1).argmax(-1), stream.alone)
        for camera in alone[alone >= 0].unique().tolist():
            for begins in (True, False):
                rows = ((alone == camera) & (fresh == begins)).nonzero().squeeze(-1)
                own = None if begins or before is None else taken(before, rows)
                if len(rows):
                    after = self._by_camera(camera, own, frame.take(rows), taken(step, rows))
                    step = replaced(step, rows, after)
        return step

    def _by_camera(
        self,
        camera: int,
        before: KeypointStream | None,
        frame: KeypointFrame,
        step: KeypointStep,
    ) -> KeypointStep:
        """Return the next frame of persons followed by one camera, in place of what all cameras gave."""
        stream, pose, found = step
        own = None if before is None else self._own(before, camera)
        seen = frame_of(frame, camera, self.lone.widening)
        after, one, by_one = self._lone_tracker(camera).advance(own, seen)
        state = by_one.state._replace(
            log_odds=into_all(found.state.log_odds, by_one.state.log_odds, camera),
            scale=into_all(found.state.scale, by_one.state.scale, camera),
            told=into_all(found.state.told, by_one.state.told, camera),
        )
        alone = torch.full_like(stream.alone, camera)
        lost = after.lost
        if before is not None:
            there = _sees_enough(frame.inlier > 0)
            gone = ~(seen.inlier > 0).flatten(1).any(-1) & there.any(-1)
            lost = torch.where(gone, before.lost + 1, lost)
        stream = stream._replace(
            state=state,
            begun=after.begun,
            lost=lost,
            alone=alone,
            memory=mapped(
                lambda every, one: into_all(every, one, camera), stream.memory, after.memory
            ),
        )
        pose = one._replace(
            covariance=self._unsure(by_one.joint_cov, by_one.joints, alone, after.spread),
            inlier=into_all(torch.zeros_like(pose.inlier), one.inlier, camera),
            exchanged=into_all(pose.exchanged, one.exchanged, camera),
            alone=alone,
            turn=pose.turn,
            off=pose.off,
            scale=state.scale,
        )
        found = by_one._replace(state=state, weighed=found.weighed)
        return stream, pose, found

    def _own(self, stream: KeypointStream, camera: int) -> KeypointStream:
        """Return a stream as one camera has it for which there is no other."""
        state, alone = state_of(stream.state, camera), torch.full_like(stream.alone, NOBODY)
        memory = mapped(lambda every: every[:, [camera]], stream.memory)
        return stream._replace(state=state, alone=alone, memory=memory)

    def _lone_tracker(self, camera: int) -> "KeypointTracker":
        """Return what tracks by one of the cameras alone; it is set up when it is needed first."""
        rig, filter = self._rig[0], self.filter

        def make() -> KeypointTracker:
            motion, device = of_one_camera(filter.motion), rig.matrix.device
            own = KeypointTracker(
                rig.select([camera]), filter.fps, motion, filter.n_iterations, filter.up
            )
            return own.to(device)  # the network that lifts, too

        return derived(self, ("alone", camera), (*rig.buffers(), *filter.motion.buffers()), make)

    def _seen_again(self, stream: KeypointStream, frame: KeypointFrame) -> Bool[Tensor, " B"]:
        """Return on whose bodies cameras agree that one camera had to guess."""
        alone = stream.alone >= 0
        if not bool(alone.any()):
            return alone
        return alone & (self._triangulated(frame).sum(-1) >= LEAST_JOINTS)

    def _triangulated(self, frame: KeypointFrame) -> Bool[Tensor, "B J"]:
        """Return on which joints cameras agree."""
        return triangulate(self.filter.maps, frame).isfinite().all(-1)

    # --- one frame --------------------------------------------------------------------------------

    def _lifted(
        self, stream: KeypointStream | None, frame: KeypointFrame
    ) -> tuple[LifterMemory, Lifted | None]:
        """Return what the lifter remembers, and what it lifts in a frame."""
        before = None if stream is None else stream.memory
        if self.lifter is None:
            return before or LifterMemory.none(frame.inlier[..., 0]), None
        lifted, memory = self.lifter(frame, before)
        return memory, lifted

    def _recalled(self, stream: KeypointStream, frame: KeypointFrame) -> LifterMemory:
        """Return what the lifter remembers, nothing where nobody has been seen for long.

        Otherwise it would lift somebody who returns to the pose of who left for half a second.
        """
        nobody = ~(frame.inlier > 0).flatten(1).any(-1)
        rows = (nobody & (stream.lost > _LOST_TIME * self.filter.fps)).nonzero().squeeze(-1)
        if not len(rows):
            return stream.memory
        none = LifterMemory.none(frame.inlier[rows][..., 0])
        none = mapped(lambda new, own: new.to(own), none, stream.memory)
        return replaced(stream.memory, rows, none)

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
        return replaced(found, persons, self._started(frame.take(persons), theirs))

    def _unsure(
        self,
        joint_cov: Float[Tensor, "*batch J 3 3"],
        joints: Float[Tensor, "*batch J 3"],
        alone: Int[Tensor, "*batch"],
        spread: Float[Tensor, "*batch J"],
    ) -> Float[Tensor, "*batch J 3 3"]:
        """Return covariances of joints with what frames do not average out, and one camera does not tell."""
        lasting = self.lasting_std**2 * torch.eye(3).to(joint_cov)
        if len(self._rig[0]) > 1 and self.lifter is not None:
            lasting = lasting + self._hardly_told(joints, spread)
        if not bool((alone >= 0).any()):
            return joint_cov + lasting
        std = std_of_legs(self.filter.motion)
        wider = of_any_size(joint_cov, joints, alone, self.filter.maps, std)
        lone = self.lone.lasting_std**2 * torch.eye(3).to(joint_cov)
        return wider + torch.where((alone >= 0)[..., None, None, None], lone, lasting)

    def _hardly_told(
        self, joints: Float[Tensor, "*batch J 3"], spread: Float[Tensor, "*batch J"]
    ) -> Float[Tensor, "*batch J 3 3"]:
        """Return what one camera would not tell, as far as cameras side by side do not.

        With the mean c of their places, k of `telling` and the ray r_j from c to a joint p_j, it is

            (s^2 (p_j - c) (p_j - c)^T + (1.25 s_j)^2 r_j r_j^T + s_l^2 I) / k^2.
        """
        maps = self.filter.maps
        away = joints - maps.centre.mean(0)
        size = std_of_legs(self.filter.motion) ** 2 * outer(away)
        rays = torch.nn.functional.normalize(away, dim=-1)
        depth = (LASTING * spread).square()[..., None, None] * outer(rays)
        lone = self.lone.lasting_std**2 * torch.eye(3).to(joints)
        return (size + depth + lone) / telling(maps, joints)[..., None, None, None].square()

    def _lost(
        self, stream: KeypointStream, frame: KeypointFrame, weighed: Weighed
    ) -> Float[Tensor, " B"]:
        """Return for how many frames in a row keypoints have been of something else, or of the other side.

        A camera that seems to exchange sides counts half: detectors do so for moments, and where it goes on,
        it is the body that has them the wrong way round. Frames without any keypoint count half, too: a
        prediction over more than a second is too wide to be corrected.
        """
        expected = frame.inlier.sum((-2, -1))
        found = weighed.inlier.sum((-2, -1))
        turned = (weighed.exchanged > 0.5).any(-1).any(-1)
        grown = stream.lost + torch.where(found < _LOST * expected, 1.0, 0.5)
        astray = (found < _LOST * expected) | turned
        lost = torch.where(astray, grown, 0.0)
        lost = torch.where(stream.begun, lost, stream.lost + 1)
        return torch.where(expected > 0, lost, stream.lost + _AWAY * stream.begun.to(lost))

    # --- whole sequences --------------------------------------------------------------------------

    def smoothed(self, filtered: KeypointPoses, widened: Float[Tensor, "B T N"]) -> KeypointPoses:
        """Return poses for which later frames count too, up to where tracking began anew.

        Args:
            filtered: with states of `to_be_smoothed`, which are written over. widened: as there.
        """
        poses = filtered if self.only is None else self.only.as_last_told(filtered)
        states = BodyMoments(poses.point, poses.state_cov)
        for rows, part in smooth(self.filter, states, widened, poses.started):
            write_part(_told(poses), rows, _told(self._as_smoothed(part_of(poses, rows), part)))
        return poses

    def _as_smoothed(self, poses: KeypointPoses, smoothed: BodyMoments) -> KeypointPoses:
        """Return poses with the states, and joints, that were smoothed."""
        point, cov = smoothed
        joints, jacobian = self.filter.articulation.linearise(point)
        joint_cov = covariances_of(jacobian, cov)
        poses = poses._replace(
            joints=joints,
            covariance=self._unsure(joint_cov, joints, poses.alone, poses.spread),
            point=point,
            state_cov=cov,
            joint_cov=joint_cov,
        )
        return poses if self.only is None else self.only.sized(poses)


def to_be_smoothed(
    pose: KeypointPoses, found: CorrectedBody
) -> tuple[KeypointPoses, Float[Tensor, "B N"]]:
    """Return the poses of a frame with the states as they were filtered, and by what these were widened."""
    return pose._replace(point=found.state.mean, state_cov=found.state.cov), found.widened


def _told(poses: KeypointPoses) -> tuple[Any, ...]:
    """Return what smoothing changes."""
    return poses.joints, poses.covariance, poses.point, poses.state_cov, poses.joint_cov


def _sees_enough(there: Bool[Tensor, "B C J"]) -> Bool[Tensor, "B C"]:
    """Return which cameras see enough joints of a person for a start by themselves."""
    return there.sum(-1) >= LEAST_JOINTS
