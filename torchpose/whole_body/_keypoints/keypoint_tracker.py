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
from torchpose.priors._lifting_network import Lifted
from torchpose.whole_body._keypoints.begin_anew import (
    LEAST_JOINTS,
    are_lost,
    frames_lost,
    may_begin,
    sees_enough,
    sees_most,
)
from torchpose.whole_body._keypoints.body_kalman import (
    BodyGaussian,
    BodyKalmanFilter,
    CorrectedBody,
    Widened,
)
from torchpose.whole_body._keypoints.body_size import SizeBelief
from torchpose.whole_body._keypoints.body_smoothing import (
    BodyMoments,
    beginnings,
    from_last_seen,
    smooth,
)
from torchpose.whole_body._keypoints.faulty_cameras import (
    CameraFaults,
    corrected,
    looked_at_again,
    without_still,
)
from torchpose.whole_body._keypoints.joint_triangulation import triangulate
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame
from torchpose.whole_body._keypoints.keypoint_poses import (
    KeypointPoses,
    KeypointStep,
    KeypointStream,
)
from torchpose.whole_body._keypoints.keypoint_start import likeliest_start, start_of_one
from torchpose.whole_body._keypoints.known_person import of_one_camera
from torchpose.whole_body._keypoints.lasting_exchange import are_wrong, evidence_of_own_sides
from torchpose.whole_body._keypoints.lifted_pose import (
    LifterMemory,
    PoseLifter,
    are_side_by_side,
    contradicts,
    corrected_by,
    legs_guessed_by,
    shares_of_usual,
    spread_of_hidden,
)
from torchpose.whole_body._keypoints.lone_camera import (
    NOBODY,
    SAME_NOISE,
    LoneNoise,
    are_together,
    frame_of,
    step_by_one,
    stream_of,
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
from torchpose.whole_body._keypoints.only_camera import OnlyCamera
from torchpose.whole_body._keypoints.pose_maker import PoseMaker
from torchpose.whole_body._keypoints.still_joints import StillJoints, with_still_joints
from torchpose.whole_body._keypoints.watched_cameras import by_right_cameras

_LEAST_SHARE = 1e-9  # least share of information: with none the variance would be infinite
# What is found in a frame; the last are those who begin with it.
_Found = tuple[KeypointStream, CorrectedBody, Bool[Tensor, " B"]]


class KeypointTracker(nn.Module):
    """Tracks bodies through frames of keypoints with a `BodyKalmanFilter`.

    Args:
        rig: the cameras. fps: frames per second. motion: how bodies move.
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
        up: str | None = None,
        lasting_std: float = 0.0,
        lone: LoneNoise = SAME_NOISE,
        size_std: float = 0.0,
        camera_height: float | None = None,
    ) -> None:
        super().__init__()
        self.lone, self.size_std = lone, size_std
        self._rig = (rig,)  # a tuple, so that its tensors are held once
        self.lifter = PoseLifter(rig, fps, motion, up) if are_side_by_side(rig) else None
        self.filter = BodyKalmanFilter(motion, rig, fps, up)
        stereo = len(rig) > 1 and self.lifter is not None
        self.poses = PoseMaker(self.filter, stereo, lasting_std, lone.lasting_std)
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
        after, pose, found = self._stepped(stream, frame, predicted, waited, watch)
        return after._replace(coasting=pose.coasting), pose, found

    def _stepped(
        self,
        stream: KeypointStream | None,
        frame: KeypointFrame,
        predicted: BodyGaussian | None,
        waited: float,
        watch: bool,
    ) -> KeypointStep:
        """Return the next frame, by cameras of which some may be found to be wrong."""
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
        return by_right_cameras(self.poses, step, frame, given, right)

    def _advanced(
        self,
        stream: KeypointStream | None,
        frame: KeypointFrame,
        predicted: BodyGaussian | None,
        waited: float,
    ) -> KeypointStep:
        """Return the next frame by all cameras together."""
        if stream is None:
            stream, found, due = self._first(frame, waited)
        else:
            stream, found, due = self._next(stream, frame, predicted)
        lost = frames_lost(stream.lost, stream.begun, frame, found.weighed)
        stream = stream._replace(lost=lost)
        if self.lifter is not None:
            stream = stream._replace(memory=self._recalled(stream, frame))
        return stream, self.poses.posed(stream, found, due), found

    def _first(self, frame: KeypointFrame, waited: float) -> _Found:
        """Return what is found in the first frame."""
        memory, lifted = self._lifted(None, frame)
        count = frame.inlier.new_full((len(frame.inlier),), waited)
        begun = may_begin(frame, count, self.filter.fps)
        found = self._started(frame, lifted)
        never = torch.full_like(frame.inlier[:, 0], torch.inf)
        stream = KeypointStream(
            state=found.state,
            begun=begun,
            lost=torch.zeros_like(count),
            alone=torch.full_like(begun, NOBODY, dtype=torch.long),
            memory=memory,
            faults=CameraFaults.none(frame),
            size=SizeBelief.usual(self.size_std, count),
            spread=torch.zeros_like(never),
            unseen=never,
            coasting=torch.zeros_like(begun),
            own_sides=torch.zeros_like(found.state.log_odds),
            still=StillJoints.none(never),
        )
        return self._with_lifted(stream, lifted, found), found, begun

    def _next(
        self, stream: KeypointStream, frame: KeypointFrame, predicted: BodyGaussian | None
    ) -> _Found:
        """Return what is found in the frame after that of a stream."""
        memory, lifted = self._lifted(stream, frame)
        if predicted is None:
            predicted = self.filter.predict(stream.state, stream.coasting)
        predicted = with_still_joints(self.filter, predicted, stream.still, frame)
        if lifted is None:
            memory, spread, likely = self._with_guessed_legs(stream, memory, frame, predicted)
            stream = stream._replace(spread=spread)
        else:
            likely = corrected_by(lifted, self.filter, predicted)
        found = self.filter.correct(likely, frame)
        if lifted is None:  # else a network knows the sides
            stream, found = self._with_own_sides(stream, likely, frame, found)
        due = ~stream.begun | are_lost(stream.lost, self.filter.fps)
        if lifted is not None:
            due = due | contradicts(lifted, self.filter, predicted)
        due = due | self._seen_again(stream, frame)
        due = due & may_begin(frame, stream.lost, self.filter.fps)
        if bool(due.any()):
            found = self._begun_anew(found, frame, lifted, due)
        stream = stream._replace(
            state=found.state,
            begun=stream.begun | due,
            lost=torch.where(due, 0.0, stream.lost),
            alone=torch.where(due, NOBODY, stream.alone),
            memory=memory,
            still=stream.still.forgotten(due),
        )
        if lifted is None:
            stream = stream._replace(unseen=stream.unseen.masked_fill(due[:, None], torch.inf))
        return self._with_lifted(stream, lifted, found), found, due

    def _with_own_sides(
        self,
        stream: KeypointStream,
        predicted: BodyGaussian,
        frame: KeypointFrame,
        found: CorrectedBody,
    ) -> tuple[KeypointStream, CorrectedBody]:
        """Return what was found, with limbs turned back that were on the wrong side of the body."""
        evidence = evidence_of_own_sides(self.filter, frame, found, stream.lost, stream.own_sides)
        wrong = are_wrong(evidence)
        if bool(wrong.any()):
            found = self.filter.turned_back(found, predicted, frame, wrong)
        return stream._replace(own_sides=evidence.masked_fill(wrong, 0.0)), found

    # --- one of several cameras -------------------------------------------------------------------

    def _with_lone_cameras(
        self, before: KeypointStream | None, frame: KeypointFrame, step: KeypointStep
    ) -> KeypointStep:
        """Return the next frame with those whom one camera sees followed by that camera."""
        stream, pose, _ = step
        if not bool((pose.started | (stream.alone >= 0)).any()):
            return step
        fresh = pose.started & ~self._triangulated(frame).any(-1) & sees_enough(frame).any(-1)
        alone = torch.where(fresh, sees_most(frame), stream.alone)
        for camera in alone[alone >= 0].unique().tolist():
            for begins in (True, False):
                rows = ((alone == camera) & (fresh == begins)).nonzero().squeeze(-1)
                own = None if begins else taken(before, rows)
                if len(rows):
                    after = self._by_camera(camera, own, frame.take(rows), taken(step, rows))
                    step = replaced(step, rows, after)
        return self._handed_over(frame, step)

    def _handed_over(self, frame: KeypointFrame, step: KeypointStep) -> KeypointStep:
        """Return the next frame with those whom their camera has lost followed by one that finds them there.

        Who begins anew in another camera must be where the person is expected. Somebody else does not replace
        a person whom a detector misses for a moment.
        """
        stream, pose, _ = step
        enough = sees_enough(frame)
        by_own = enough.gather(1, stream.alone.clamp_min(0)[:, None]).squeeze(1)
        left = (stream.alone >= 0) & ~by_own & enough.any(-1)
        other = sees_most(frame)
        for camera in other[left].unique().tolist():
            rows = (left & (other == camera)).nonzero().squeeze(-1)
            begun = self._by_camera(camera, None, frame.take(rows), taken(step, rows))
            found = are_together(taken(pose, rows), begun[1]).nonzero().squeeze(-1)
            step = replaced(step, rows[found], taken(begun, found))
        return step

    def _by_camera(
        self, camera: int, before: KeypointStream | None, frame: KeypointFrame, step: KeypointStep
    ) -> KeypointStep:
        """Return the next frame of persons followed by one camera, in place of what all cameras gave."""
        own = None if before is None else stream_of(before, camera)
        seen = frame_of(frame, camera, self.lone.widening)
        by_one = self._lone_tracker(camera).advance(own, seen)
        stream, pose, found = step_by_one(step, by_one, camera)
        if before is not None:
            gone = ~seen.there.flatten(1).any(-1) & sees_enough(frame).any(-1)
            stream = stream._replace(lost=torch.where(gone, before.lost + 1, stream.lost))
        cov = self.poses.covariance(found.joint_cov, found.joints, pose.alone, pose.spread)
        return stream, pose._replace(covariance=cov), found

    def _lone_tracker(self, camera: int) -> "KeypointTracker":
        """Return what tracks by one of the cameras alone; it is set up when it is needed first."""
        rig, filter = self._rig[0], self.filter

        def make() -> KeypointTracker:
            motion, device = of_one_camera(filter.motion), rig.matrix.device
            own = KeypointTracker(rig.select([camera]), filter.fps, motion, filter.up)
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

    def _with_guessed_legs(
        self,
        stream: KeypointStream,
        memory: LifterMemory,
        frame: KeypointFrame,
        predicted: BodyGaussian,
    ) -> tuple[LifterMemory, Float[Tensor, "B J"], BodyGaussian]:
        """Return what the lifter remembers, how unsure it is, and predictions with the legs that it guesses.

        They are those of persons of whom no camera sees a hip.
        """
        rows, spread = self.filter.without_hips(frame), torch.zeros_like(frame.inlier[:, 0])
        if not len(rows):
            return memory, spread, predicted
        lifted, after = self._guesser(frame.take(rows), taken(memory, rows))
        likely = legs_guessed_by(lifted, self.filter, taken(predicted, rows))
        share = self.filter.transition.share * shares_of_usual(stream.unseen[rows])
        if bool((share > 0).any()):
            likely = self.filter.with_usual_legs(likely, share.clamp_min(_LEAST_SHARE))
        spread[rows] = spread_of_hidden(lifted)
        return replaced(memory, rows, after), spread, replaced(predicted, rows, likely)

    @property
    def _guesser(self) -> PoseLifter:
        """Return the lifter of cameras that are apart; it is set up when it is needed first."""
        rig, filter = self._rig[0], self.filter

        def make() -> PoseLifter:
            return PoseLifter(rig, filter.fps, filter.motion, filter.up).to(rig.matrix.device)

        return derived(self, "guesser", (*rig.buffers(), *filter.motion.buffers()), make)

    def _with_lifted(
        self, stream: KeypointStream, lifted: Lifted | None, found: CorrectedBody
    ) -> KeypointStream:
        """Return the stream with how unsure lifted joints are, and for how long joints have not been seen.

        It also has which of them stand still.
        """
        seen, dt = found.weighed.inlier.amax(1) > 0.5, 1 / self.filter.fps
        unseen = torch.where(seen, 0.0, stream.unseen + dt)
        still = stream.still.later(found.speeds, seen, dt)
        stream = stream._replace(unseen=unseen, still=still)
        if lifted is None:
            return stream
        spread = torch.where(lifted.std.isfinite(), lifted.std, stream.spread)
        return stream._replace(spread=spread)

    def _recalled(self, stream: KeypointStream, frame: KeypointFrame) -> LifterMemory:
        """Return what the lifter remembers, nothing where nobody has been seen for long.

        Otherwise it would lift somebody who returns to the pose of who left for half a second.
        """
        nobody = ~frame.there.flatten(1).any(-1)
        rows = (nobody & are_lost(stream.lost, self.filter.fps)).nonzero().squeeze(-1)
        if not len(rows):
            return stream.memory
        none = LifterMemory.none(frame.inlier[rows][..., 0])
        none = mapped(lambda new, own: new.to(own), none, stream.memory)
        return replaced(stream.memory, rows, none)

    def _started(self, frame: KeypointFrame, lifted: Lifted | None) -> CorrectedBody:
        """Return persons who begin with this frame."""
        if self.lifter is None or lifted is None:
            return likeliest_start(self.filter, frame)
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
        begun = self._started(frame.take(persons), taken(lifted, persons))
        return replaced(found, persons, begun)

    # --- whole sequences --------------------------------------------------------------------------

    def smoothed(self, filtered: KeypointPoses, widened: Widened) -> KeypointPoses:
        """Return poses for which later frames count too, up to where somebody was found anew.

        Args:
            filtered: with states of `to_be_smoothed`, which are written over. widened: as there.
        """
        seen, carriers = filtered.unseen == 0, self.filter.articulation.carriers
        jumped = from_last_seen(widened.jumped, seen, filtered.started, carriers)
        poses = filtered if self.only is None else self.only.as_last_told(filtered)
        states = BodyMoments(poses.point, poses.state_cov)
        wider = jumped + widened.carried
        begun = beginnings(poses.started, poses.coasting, self.filter.fps)
        for rows, part in smooth(self.filter, states, wider, widened.factor, begun, poses.coasting):
            smoothed = self._as_smoothed(part_of(poses, rows), part)
            write_part(_smoothed_fields(poses), rows, _smoothed_fields(smoothed))
        return poses

    def _as_smoothed(self, poses: KeypointPoses, smoothed: BodyMoments) -> KeypointPoses:
        """Return poses with the states, and joints, that were smoothed."""
        point, cov = smoothed
        joints, jacobian = self.filter.articulation.linearise(point)
        joint_cov = covariances_of(jacobian, cov)
        poses = poses._replace(
            joints=joints,
            covariance=self.poses.covariance(joint_cov, joints, poses.alone, poses.spread),
            point=point,
            state_cov=cov,
            joint_cov=joint_cov,
        )
        return poses if self.only is None else self.only.sized(poses)


def to_be_smoothed(pose: KeypointPoses, found: CorrectedBody) -> tuple[KeypointPoses, Widened]:
    """Return the poses of a frame with the states as they were filtered, and by what these were widened."""
    return pose._replace(point=found.state.mean, state_cov=found.state.cov), found.widened


def _smoothed_fields(poses: KeypointPoses) -> tuple[Any, ...]:
    """Return what smoothing changes."""
    return poses.joints, poses.covariance, poses.point, poses.state_cov, poses.joint_cov
