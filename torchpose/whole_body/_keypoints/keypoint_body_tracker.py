"""Track one person or several recordings through keypoints of calibrated cameras, to `BodyTrack`."""

import copy
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Integer
from torch import Tensor, nn

from torchpose._core.checks import (
    check_choice,
    check_height,
    check_positive,
    check_shape,
    number_of,
)
from torchpose.body._feet import ANKLES, FEET
from torchpose.body._kinematics import Body
from torchpose.camera._rig import CameraRig
from torchpose.errors import InputError, NobodySeenError, ShapeError
from torchpose.filters._lengths import inside_lengths
from torchpose.filters._measurements import check_lengths
from torchpose.priors._body_motion import BodyMotion
from torchpose.priors._foot_prior import shipped_foot_prior
from torchpose.priors._shipped import load_body_motion
from torchpose.whole_body._body_track import BodyTrack, repeat_last
from torchpose.whole_body._keypoints.begin_anew import LEAST_JOINTS, first_frames
from torchpose.whole_body._keypoints.camera_conventions import check_conventions
from torchpose.whole_body._keypoints.camera_notes import notes_on_refined
from torchpose.whole_body._keypoints.camera_refinement import (
    REFINED,
    RefinedCameras,
    details_of_cameras,
    in_time,
    refine_cameras,
    whole_delays,
)
from torchpose.whole_body._keypoints.camera_units import check_units
from torchpose.whole_body._keypoints.coarse_delays import shifted, shifted_flags
from torchpose.whole_body._keypoints.faulty_cameras import LEAST_CAMERAS, without_still_frames
from torchpose.whole_body._keypoints.foot_filter import FootFilter, FootGaussian, FootPoses
from torchpose.whole_body._keypoints.foot_tracker import step_feet, track_feet
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame, RigMaps
from torchpose.whole_body._keypoints.keypoint_notes import (
    TOO_FEW,
    late_note,
    notes_on_cameras_now,
    notes_on_still_cameras,
)
from torchpose.whole_body._keypoints.keypoint_poses import KeypointPoses, KeypointStream
from torchpose.whole_body._keypoints.keypoint_reader import KeypointReader
from torchpose.whole_body._keypoints.keypoint_tracker import KeypointTracker
from torchpose.whole_body._keypoints.known_person import (
    of_one_camera,
    std_of_legs,
    with_body,
    with_height,
)
from torchpose.whole_body._keypoints.lone_camera import LoneNoise
from torchpose.whole_body._keypoints.nested import mapped, part_of, taken
from torchpose.whole_body._keypoints.track_builder import TrackBuilder, without_poses
from torchpose.whole_body._keypoints.turned_cameras import angles_of, is_turned

SMOOTHING = ("none", "full")
PIXEL_STD = 1.0
"""Pixels, how far keypoints are from projected joints, beside what they are off in space."""
_KEYPOINT_STD = 0.012  # metres
_KEYPOINT_STD_OF_ONE = 0.03  # where no other camera corrects errors that stay from frame to frame
_HIGHEST_CAMERA = 30.0  # metres above the floor
_DOUBT_OF_LEGS = 2.0  # of several cameras, in which toes are seen well and a body may be astray
_LASTING_OF_ONE = 2 / 3  # of the deviation of keypoints, what lasts in one camera


class LiveBody(NamedTuple):
    """Holds the state of tracking one person live: of the body, and of the feet if keypoints have some."""

    body: KeypointStream
    feet: FootGaussian | None


class KeypointBodyTracker(nn.Module):
    """Tracks whole bodies through keypoints of calibrated cameras; see `BodyTracker` with "kalman".

    Args:
        rig: the cameras. fps: frames per second. body: the person's, whose bone lengths are kept, or None.
        height: of the person, metres, or None. motion: how bodies move, or its name or file.
        keypoint_std: metres, how far a detector's joints are from the body's, along each axis.
        pixel_std: pixels, how far they are apart from that; None is the usual, of both.
        up: "y" or "z", the axis of the world that points up, if it is known.
        camera_height: metres of the only camera above the floor, if it is known; needs `up`.

    Raises:
        InputError: values out of range; a height of several cameras, or without `up`.
    """

    def __init__(
        self,
        rig: CameraRig,
        fps: float,
        *,
        body: Body | None = None,
        height: float | None = None,
        motion: BodyMotion | str | Path = "whole-body",
        keypoint_std: float | None = None,
        pixel_std: float | None = None,
        up: str | None = None,
        camera_height: float | None = None,
    ) -> None:
        super().__init__()
        _check_camera_height(camera_height, rig, up)
        self.up = up
        self._rig, self.fps = (rig,), float(fps)  # a tuple: its tensors are those of who gives it
        alone = len(rig) == 1
        std_of_one = _KEYPOINT_STD_OF_ONE if keypoint_std is None else keypoint_std
        if keypoint_std is None:
            keypoint_std = _KEYPOINT_STD_OF_ONE if alone else _KEYPOINT_STD
        keypoint_std = check_positive("keypoint_std", keypoint_std)
        self.reader = KeypointReader(
            rig, keypoint_std, PIXEL_STD if pixel_std is None else pixel_std
        )
        motion = motion if isinstance(motion, BodyMotion) else load_body_motion(motion)
        if body is not None:
            motion = with_body(motion, body)
        elif height is not None:
            motion = with_height(motion, check_height(height))
        size_std = std_of_legs(motion) if alone else 0.0
        if alone:
            motion = of_one_camera(motion, told=body is not None or height is not None)
        sized = body is not None or height is not None or camera_height is not None
        lasting = _LASTING_OF_ONE * keypoint_std if alone else 0.0
        self.tracker = KeypointTracker(
            rig, self.fps, motion, up=up, lasting_std=lasting,
            lone=LoneNoise((std_of_one / keypoint_std) ** 2, _LASTING_OF_ONE * std_of_one),
            size_std=size_std, camera_height=camera_height,
        )  # fmt: skip
        told = height if body is None else body.height
        self.builder = TrackBuilder(self.tracker, rig, self.fps, sized, told)
        self.feet = FootFilter(
            motion.articulation, copy.deepcopy(shipped_foot_prior()), self.fps,
            doubt=1.0 if alone else _DOUBT_OF_LEGS,
        )  # fmt: skip

    @property
    def rig(self) -> CameraRig:
        """Return the cameras."""
        return self._rig[0]

    @torch.no_grad()
    def forward(
        self,
        keypoints: Float[Tensor, "*B T C J 2"],
        confidence: Float[Tensor, "*B T C J"] | None = None,
        names: Sequence[str] | None = None,
        *,
        covariance: Float[Tensor, "*B T C J"] | None = None,
        smoothing: str = "none",
        refine: str = "none",
        lengths: Integer[Tensor, " S"] | None = None,
        progress: bool = False,
    ) -> BodyTrack | list[BodyTrack]:
        """Track whole sequences; see `BodyTracker.forward`."""
        check_choice("smoothing", smoothing, SMOOTHING)
        self._check_refine(refine, keypoints)
        check_shape("keypoints", keypoints, ["...", "T", len(self.rig), None, 2])
        if keypoints.ndim not in (4, 5):
            raise ShapeError(
                f"keypoints must have shape [T, C, J, 2] or [B, T, C, J, 2], got {list(keypoints.shape)}"
            )
        if keypoints.ndim == 5 and len(keypoints) == 0:
            raise InputError(
                f"keypoints must hold at least one sequence, got {list(keypoints.shape)}"
            )
        frames, feet = self.reader.frames_and_feet(keypoints, confidence, names, covariance)
        single = keypoints.ndim == 4
        if single:
            frames, feet = mapped(lambda value: value[None], (frames, feet))
        n_frames = frames.pixels.shape[1]
        ends = check_lengths(lengths, len(frames.pixels), n_frames, frames.pixels.device)
        frames = _until(frames, ends)
        feet = None if feet is None else _until(feet, ends)
        self.check_cameras(frames)
        begun = self.first_frames(frames)
        if refine != "none":
            frames, feet = mapped(lambda value: value[:, begun[0] :], (frames, feet))
            refined = self._refined_track(
                frames, feet, refine, smoothing == "full", progress, begun[0]
            )
            return repeat_last(refined, n_frames - int(ends))
        poses = self.tracker(frames, smoothing == "full", progress, lengths=ends)
        found = self.feet_of(poses, feet, smoothing == "full")
        tracks = []
        for b, end in enumerate(ends.tolist()):
            own, seen, standing = part_of(taken((poses, frames, found), b), slice(0, end), 0)
            track = self.builder.track(own, seen, cameras=b == 0, feet=standing)
            track.notes += late_note(track.first_frame, TOO_FEW)
            tracks.append(repeat_last(track, n_frames - end))
        return tracks[0] if single else tracks

    @torch.no_grad()
    def step(
        self,
        stream: LiveBody | None,
        keypoints: Float[Tensor, "C J 2"],
        confidence: Float[Tensor, "C J"] | None = None,
        names: Sequence[str] | None = None,
        *,
        covariance: Float[Tensor, "C J"] | None = None,
    ) -> tuple[LiveBody, BodyTrack]:
        """Track one more frame; see `BodyTracker.step`."""
        check_shape("keypoints", keypoints, [len(self.rig), None, 2])
        before, standing = (None, None) if stream is None else stream
        followed = before is not None and bool(before.begun)
        given = self.reader.frames_and_feet(keypoints, confidence, names, covariance, followed)
        frame, feet = mapped(lambda value: value[None], given)
        body, pose, _ = self.tracker.advance(before, frame)
        if bool(body.begun) and not followed:
            self.check_cameras(frame.map(lambda value: value[:, None]))
        found = None
        if feet is not None:
            standing, found = step_feet(self.feet, standing, self.tracker.filter.maps, pose, feet)
        track = self.builder.track(pose, frame, summed_up=False, feet=found, followed=followed)
        faults = taken(body.faults, 0)
        track.notes = notes_on_cameras_now(
            self.rig.names, faults.still, faults.off, angles_of(faults.turn)
        )
        return LiveBody(body, standing), track if bool(body.begun) else without_poses(track)

    def feet_of(
        self, poses: KeypointPoses, frames: KeypointFrame | None, smoothing: bool
    ) -> FootPoses | None:
        """Return the feet of tracked bodies [B, T], None without keypoints of feet."""
        if frames is None:
            return None
        return track_feet(self.feet, self.tracker.filter.maps, poses, frames, smoothing)

    def first_frames(self, frames: KeypointFrame) -> list[int]:
        """Return the frames in which sequences begin.

        Args:
            frames: [B, T, C, J, ...].

        Raises:
            NobodySeenError: one of them never does.
        """
        seen = frames.there.flatten(1).any(-1)
        if not bool(seen.all()):
            raise NobodySeenError(
                f"sequence {int((~seen).nonzero()[0])} has no keypoint in any camera and frame"
            )
        begun = first_frames(frames, self.fps).tolist()
        n_frames = frames.pixels.shape[1]
        if n_frames in begun:
            where = "" if len(self.rig) == 1 else " in two cameras, nor in one for half a second"
            raise NobodySeenError(
                f"sequence {begun.index(n_frames)} has no frame with keypoints of {LEAST_JOINTS} "
                f"joints or more{where}; check the keypoints and their names"
            )
        return begun

    # --- cameras ----------------------------------------------------------------------------------

    def check_cameras(self, frames: KeypointFrame) -> None:
        """Raise `CameraError` for cameras of another convention or unit.

        Args:
            frames: keypoints [B, T, C, J].
        """
        check_conventions(self.rig, self.tracker.filter, frames)
        check_units(self.tracker.filter, frames)

    def _check_refine(self, refine: str, keypoints: Tensor) -> None:
        """Refuse to refine what one camera or several recordings do not tell."""
        check_choice("refine", refine, REFINED)
        if refine == "none":
            return
        if len(self.rig) == 1:
            raise InputError(
                f"refine={refine!r} compares cameras and needs two or more, got one; leave it out"
            )
        if keypoints.ndim != 4:
            raise ShapeError(
                "refine is for one recording, keypoints of shape [T, C, J, 2], got "
                f"{list(keypoints.shape)}; track recordings one after the other"
            )

    def _refined_track(
        self,
        frames: KeypointFrame,
        feet: KeypointFrame | None,
        refine: str,
        smoothing: bool,
        progress: bool,
        first_frame: int,
    ) -> BodyTrack:
        """Return the track with cameras without the errors that keypoints tell of."""
        former = self.tracker.filter

        def track(rig: CameraRig, moved: KeypointFrame, smooth: bool) -> KeypointPoses:
            tracker = KeypointTracker(
                rig, self.fps, former.motion, up=former.up, lone=self.tracker.lone
            )
            # the frames are those from the first one on that may begin: it has waited already
            moved = moved.map(lambda value: value[None])
            return tracker(moved, smooth, progress, waited=math.inf, watch=False)

        used, off, turn = self._of_right_cameras(frames, late=refine in ("delays", "both"))
        single = used.map(lambda value: value[0])
        found = refine_cameras(
            self.rig, single, track, self.fps, refine, former.exchange, smoothing, turn
        )
        found = found._replace(poses=found.poses._replace(off=off))
        standing = self._refined_feet(feet, found, smoothing)
        result = self.builder.track(
            taken(found.poses, 0), found.frames, refined=found, first_frame=first_frame,
            feet=taken(standing, 0),
        )  # fmt: skip
        late = late_note(result.first_frame, TOO_FEW)
        given = frames.map(lambda value: value[0])
        still = notes_on_still_cameras(self.rig.names, given.pixels, given.there, first_frame)
        notes = (*notes_on_refined(self.rig.names, found), *still, *result.notes, *late)
        details = details_of_cameras(found, len(result))
        return replace(result, notes=notes, details={**result.details, **details})

    def _of_right_cameras(
        self, frames: KeypointFrame, late: bool
    ) -> tuple[KeypointFrame, Bool[Tensor, "1 T C"], Float[Tensor, "C 3 3"] | None]:
        """Return keypoints [1, T, C, J] of cameras that see the person, which do not, and their turns.

        Small errors of cameras are estimated from all keypoints, so a video that stands still, or of
        something else, would move the cameras that are right. So would one that is turned by much. A camera
        that is late looks like these, so delays are tried first where they are looked for.
        """
        single = without_still_frames(frames.map(lambda value: value[0]))
        used = single.map(lambda value: value[None])
        if len(self.rig) < LEAST_CAMERAS:
            return used, torch.zeros_like(used.inlier[..., 0], dtype=torch.bool), None
        poses = self.tracker(frames, waited=math.inf)
        off, turn = poses.off[0], poses.turn[0, -1]
        if late and bool(off.any() | is_turned(turn).any()):
            delays = whole_delays(self.rig, single, self.fps)
            moved = shifted(single, delays)[0].map(lambda value: value[None])
            again = self.tracker(moved, waited=math.inf)
            off_again = shifted_flags(again.off[0], -delays)
            if _n_wrong(off_again, again.turn[0, -1]) < _n_wrong(off, turn):
                off, turn = off_again, again.turn[0, -1]
        used = used._replace(inlier=used.inlier.masked_fill(off[None, ..., None], 0.0))
        return used, off[None], turn

    def _refined_feet(
        self, feet: KeypointFrame | None, found: RefinedCameras, smoothing: bool
    ) -> FootPoses | None:
        """Return feet by corrected cameras; between frames they move as their ankles."""
        if feet is None:
            return None
        ankles = [ankle for ankle in ANKLES for _ in range(len(FEET) // len(ANKLES))]
        single = feet.map(lambda value: value[0])
        moved = in_time(self.rig, single, found.errors.values, found.poses.joints[0][:, ankles])
        frames = moved.map(lambda value: value[None])
        return track_feet(self.feet, RigMaps.of(found.rig), found.poses, frames, smoothing)


def _until(frames: KeypointFrame, lengths: Int[Tensor, " B"]) -> KeypointFrame:
    """Return frames [B, T, ...] to the end of the longest sequence, without keypoints past each one's own."""
    frames = part_of(frames, slice(0, int(lengths.max())))
    inside = inside_lengths(lengths, frames.inlier.shape[1])
    return frames._replace(inlier=frames.inlier * inside[:, :, None, None])


def _n_wrong(off: Bool[Tensor, "T C"], turn: Float[Tensor, "C 3 3"]) -> float:
    """Return how many cameras are left out, of all frames on average, or turned at the end."""
    return float((off | is_turned(turn)).double().mean(0).sum())


def _check_camera_height(height: float | None, rig: CameraRig, up: str | None) -> None:
    """Raise `InputError` unless a height of the camera, if there is one, can tell the size of a person."""
    if height is None:
        return
    if not 0 < number_of(height) <= _HIGHEST_CAMERA:
        raise InputError(
            f"camera_height must lie between 0 and {_HIGHEST_CAMERA:g} m, got {height!r}; it is in metres "
            "above the floor"
        )
    if len(rig) > 1:
        raise InputError(
            f"camera_height tells the size of a person whom one camera sees, and there are {len(rig)} "
            "cameras, which tell it themselves; leave it out"
        )
    if up is None:
        raise InputError(
            "camera_height is measured along the vertical, which is not known; "
            'give up as well, "y" or "z", the axis of the cameras\' world that points up (without a file of '
            "the camera, --tilt or --up y)"
        )
