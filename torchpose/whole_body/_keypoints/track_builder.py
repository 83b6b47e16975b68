"""Make a `BodyTrack` of filtered poses: one person's, with a rigid body, details and notes."""

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.body._feet import ANKLES
from torchpose.body._kinematics import Body
from torchpose.body._skeleton import BODY_15
from torchpose.camera._rig import CameraRig
from torchpose.whole_body._body_feet import DETAILS_OF_FEET, FIELDS_OF_FEET
from torchpose.whole_body._body_track import BodyTrack
from torchpose.whole_body._keypoints.all_sides import notes_on_all_sides
from torchpose.whole_body._keypoints.camera_cause_notes import notes_on_causes
from torchpose.whole_body._keypoints.camera_notes import (
    doubt_cameras,
    notes_on_cameras,
    sure_delays,
)
from torchpose.whole_body._keypoints.camera_order import agree_as_given, notes_on_order
from torchpose.whole_body._keypoints.camera_readings import notes_on_one_camera
from torchpose.whole_body._keypoints.camera_refinement import RefinedCameras
from torchpose.whole_body._keypoints.faulty_cameras import without_still_frames
from torchpose.whole_body._keypoints.foot_filter import FootPoses
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame, RigMaps
from torchpose.whole_body._keypoints.keypoint_notes import (
    notes_of,
    notes_on_a_rolled_camera,
    notes_on_camera_height,
    notes_on_left_out_cameras,
    notes_on_size,
    notes_on_still_cameras,
    notes_on_turned_cameras,
    notes_on_unsure_keypoints,
    notes_on_up,
    notes_on_upside_down_cameras,
)
from torchpose.whole_body._keypoints.keypoint_poses import KeypointPoses
from torchpose.whole_body._keypoints.keypoint_tracker import KeypointTracker
from torchpose.whole_body._keypoints.nested import by_parts, mapped
from torchpose.whole_body._keypoints.turned_cameras import angles_of, is_turned
from torchpose.whole_body._keypoints.turned_cameras import turned as turned_back

_SEEN = 0.5  # probability that a keypoint is of its joint
KEYPOINT_METHOD = "kalman"
CAMERA_TURN = "camera_turn"
"""Name of the detail of cameras that are turned, there where any is."""
COVARIANCE_FROM_PELVIS = "covariance_from_pelvis"
"""Name of the detail of one camera, or of cameras side by side."""


class TrackBuilder:
    """Makes tracks of what a filter found.

    Args:
        tracker: that found the poses. rig: its cameras. fps: frames per second.
        sized: whether the size of the person, or the camera's height, was given.
        told: the height of the person, metres, if it was given.
    """

    def __init__(
        self, tracker: KeypointTracker, rig: CameraRig, fps: float, sized: bool, told: float | None
    ) -> None:
        self.tracker, self.rig, self.fps, self.sized, self.told = tracker, rig, fps, sized, told

    def track(
        self,
        poses: KeypointPoses,
        frames: KeypointFrame,
        summed_up: bool = True,
        cameras: bool = True,
        refined: RefinedCameras | None = None,
        first_frame: int = 0,
        feet: FootPoses | None = None,
        followed: bool = False,
    ) -> BodyTrack:
        """Return the track of one person, from the frame on in which it begins.

        Args:
            poses, frames: [T, ...], of T frames, or of one that a live stream got.
            summed_up: whether notes sum the recording up. cameras: whether they name cameras.
            refined: the cameras, if they were refined. first_frame: number of the first of these frames.
            feet: of the poses. followed: whether a live stream had found the person before this frame.
        """
        live = len(poses.started) == 1
        begun = 0 if live else int(poses.started.int().argmax())
        poses, frame, feet = mapped(lambda value: value[begun:], (poses, frames, feet))
        first_frame += begun
        body = self.tracker.filter.articulation
        bones = body.bones(poses.point)
        rigid = _rigid_body(bones, ~poses.coasting)
        state = rigid.state_of(poses.point.position, body.world_rotations(poses.point))
        notes: tuple[str, ...] = ()
        if summed_up:
            notes = self._notes(poses, frame, cameras, refined, first_frame)
            notes += notes_on_size(rigid.height, len(self.rig), self.told)
        return BodyTrack(
            rigid,
            state,
            self._state_std(poses.state_cov),
            poses.joints,
            poses.covariance,
            poses.log_evidence,
            torch.full_like(poses.log_evidence, torch.nan),
            poses.coasting,
            poses.started & (poses.started.cumsum(0) + followed > 1),
            self.fps,
            notes=notes,
            first_frame=first_frame,
            details=self._details(poses, bones, feet),
            method=KEYPOINT_METHOD,
        )

    def _details(
        self, poses: KeypointPoses, bones: Float[Tensor, "T J 3"], feet: FootPoses | None
    ) -> dict[str, Tensor]:
        """Return what the track of a person holds beside the poses."""
        details = {
            "inlier": poses.inlier,
            "exchanged": poses.exchanged,
            "bone_lengths": bones.norm(dim=-1),
        }
        of_depths = self.tracker.poses if self.tracker.poses.side_by_side else self.tracker.only
        if of_depths is not None:
            found = by_parts(of_depths.covariance_from_pelvis, poses, dim=0)
            details[COVARIANCE_FROM_PELVIS] = found
        if feet is not None:
            details |= dict(zip(DETAILS_OF_FEET, feet, strict=True))
        if bool(is_turned(poses.turn).any()):
            details[CAMERA_TURN] = poses.turn
        return details

    def _state_std(self, cov: Float[Tensor, "T N N"]) -> Float[Tensor, "T 36"]:
        """Return standard deviations in the units of a state: metres, and sines of half angles."""
        body = self.tracker.filter.articulation
        std = cov.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
        turns = std.new_zeros(len(std), len(BODY_15.parts), 3)
        turns[:, body.axis_part, body.axis] = std[:, body.columns["rotations"]] / 2
        return torch.cat([std[:, body.columns["position"]], turns.flatten(1)], -1)

    def _notes(
        self,
        poses: KeypointPoses,
        frame: KeypointFrame,
        cameras: bool,
        refined: RefinedCameras | None,
        first_frame: int,
    ) -> tuple[str, ...]:
        still = notes_on_still_cameras(self.rig.names, frame.pixels, frame.there, first_frame)
        frame = without_still_frames(frame)  # which did not count
        there = frame.there
        notes = notes_of(
            self.rig.names, there, poses.inlier, poses.exchanged, poses.coasting, poses.alone,
            poses.off, self.sized, first_frame,
        )  # fmt: skip
        notes += notes_on_unsure_keypoints(frame.inlier) + still
        notes += notes_on_upside_down_cameras(self.tracker.filter.up, self.rig.rotation)
        notes += notes_on_up(self.tracker.filter.up, poses.joints)
        floor = None if self.tracker.only is None else self.tracker.only.floor
        if floor is not None:
            seen = (poses.inlier[:, 0, ANKLES] > _SEEN).any(-1)
            notes += notes_on_camera_height(
                floor.above(poses.joints[:, ANKLES]), seen, floor.height
            )
        turned = notes_on_turned_cameras(self.rig.names, angles_of(poses.turn), first_frame)
        notes += notes_on_left_out_cameras(self.rig.names, poses.off, first_frame) + turned
        if len(self.rig) == 1 and self.tracker.filter.up is None:
            rolled = notes_on_a_rolled_camera(self.rig.names[0], frame.pixels[:, 0], there[:, 0])
            return notes + rolled
        if len(self.rig) == 1 or not cameras:
            return notes
        exchange = self.tracker.filter.exchange
        rig = self.rig if refined is None else refined.rig
        maps = self.tracker.filter.maps if refined is None else RigMaps.of(rig)
        notes = (*notes_on_all_sides(self.tracker.filter, frame), *notes)
        if not agree_as_given(maps, turned_back(frame, poses.turn, maps)):
            other = notes_on_order(self.rig.names, maps, frame)
            other = other or notes_on_one_camera(rig, maps, frame, exchange)
            if other:
                return (*other, *notes)
        # turned cameras are said already
        doubts = doubt_cameras(rig, frame, poses.joints, self.fps, exchange, turns=not turned)
        causes = notes_on_causes(rig, frame, sure_delays(doubts))
        asked = "none" if refined is None else refined.what
        wrong = notes_on_cameras(self.rig.names, doubts, bool(causes), asked)
        return (*causes, *notes, *wrong)


def without_poses(track: BodyTrack) -> BodyTrack:
    """Return a track without poses: NaN in place of what is not known before the first one."""
    names = ("state", "state_std", "joints3d", "covariance3d", "log_evidence")
    values: dict[str, Any] = {
        name: torch.full_like(getattr(track, name), torch.nan) for name in names
    }
    details = {
        name: torch.full_like(value, torch.nan)
        for name, value in track.details.items()
        if name in (*FIELDS_OF_FEET, COVARIANCE_FROM_PELVIS)
    }
    return replace(track, **values, details={**track.details, **details})


def _rigid_body(bones: Float[Tensor, "T J 3"], measured: Bool[Tensor, " T"]) -> Body:
    """Return the body of a track: the median bone of every joint in the axes of the part that carries it.

    Frames without a measurement count where there are no others.
    """
    if len(bones) > 1 and bool(measured.any()):
        bones = bones[measured]
    middle = bones.median(0).values
    middle[0] = 0
    lengths = middle.norm(dim=-1)
    height = BODY_15.height(lengths)
    radii = BODY_15.standard_radii(height).to(lengths)
    return Body(BODY_15, lengths, radii, directions=middle)
