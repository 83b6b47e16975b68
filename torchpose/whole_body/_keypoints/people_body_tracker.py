"""Track all persons whom calibrated cameras show, to a `BodyTrack` for each of them."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from torchpose._core.checks import check_choice, check_shape
from torchpose._core.rows import joined
from torchpose.errors import InputError, NobodySeenError
from torchpose.whole_body._body_track import BodyTrack
from torchpose.whole_body._keypoints.camera_conventions import check_conventions
from torchpose.whole_body._keypoints.camera_units import check_units
from torchpose.whole_body._keypoints.foot_filter import FootGaussian, FootPoses
from torchpose.whole_body._keypoints.foot_tracker import continued, step_feet
from torchpose.whole_body._keypoints.joint_triangulation import triangulate
from torchpose.whole_body._keypoints.keypoint_body_tracker import SMOOTHING, KeypointBodyTracker
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame
from torchpose.whole_body._keypoints.keypoint_notes import notes_on_strays
from torchpose.whole_body._keypoints.keypoint_poses import KeypointPoses
from torchpose.whole_body._keypoints.keypoint_tracker import to_be_smoothed
from torchpose.whole_body._keypoints.nested import FrameCollector, one_of, stacked, taken
from torchpose.whole_body._keypoints.people_association import pairs_of_detections, taken_detections
from torchpose.whole_body._keypoints.people_cameras import strays_of
from torchpose.whole_body._keypoints.people_tracker import PeopleFrame, PeopleStream, PeopleTracker

ALL_PERSONS = "all"
_FRAMES = 20  # that are looked at, at most, where nobody is found
_AGREED = 0.7  # share of the joints of two detections, from which on they are of one person


class _Row(NamedTuple):
    """Holds where a person is: the frame, and the row of its `PeopleFrame`."""

    time: int
    row: int
    frame: PeopleFrame


class LivePeople(NamedTuple):
    """Holds the state of tracking persons live.

    Attributes:
        people: their bodies. feet: of the persons of the frame before, None if keypoints have none.
        numbers: of these persons.
    """

    people: PeopleStream
    feet: FootGaussian | None
    numbers: Tensor | None


class PeopleBodyTracker:
    """Tracks several persons; see `BodyTracker.forward` with `persons`.

    Args:
        single: tracker of one person in the same cameras. persons: "all", or how many there are at most at a
            time.

    Raises:
        InputError: another number of persons.
    """

    def __init__(self, single: KeypointBodyTracker, persons: str | int) -> None:
        whole = isinstance(persons, int) and not isinstance(persons, bool) and persons >= 1
        if not whole and persons != ALL_PERSONS:
            raise InputError(
                f'persons must be "{ALL_PERSONS}" or a whole number of 1 or more, got {persons!r}'
            )
        self.single = single
        self.people = PeopleTracker(single.tracker, persons if isinstance(persons, int) else None)

    @torch.no_grad()
    def forward(
        self,
        keypoints: Float[Tensor, "T C D J 2"],
        confidence: Float[Tensor, "T C D J"] | None = None,
        names: Sequence[str] | None = None,
        *,
        covariance: Float[Tensor, "T C D J"] | None = None,
        smoothing: str = "none",
        progress: bool = False,
    ) -> list[BodyTrack]:
        """Return a track of each person, in the order in which they appear."""
        check_choice("smoothing", smoothing, SMOOTHING)
        check_shape("keypoints", keypoints, ["T", len(self.single.rig), "D", None, 2])
        frames, feet = self._frames(keypoints, confidence, names, covariance)
        if not bool(frames.there.any()):
            raise NobodySeenError("the detections have no keypoint in any camera and frame")
        stream, rows = None, defaultdict[int, list[_Row]](list)
        strays = torch.zeros(frames.inlier.shape[0], frames.inlier.shape[2], dtype=torch.bool)
        for t in tqdm(range(len(keypoints)), disable=not progress, unit="frame"):
            frame: KeypointFrame = taken(frames, t)
            stream, found = self.people.advance(stream, frame)
            if found is None:
                continue
            strays[t] = strays_of(frame, found.detection)
            for row, number in enumerate(found.number.tolist()):
                rows[number].append(_Row(t, row, found))
        persons = [_until_last_seen(of_one) for of_one in rows.values()]
        identities = [int(one[-1].frame.identity[one[-1].row]) for one in persons]
        named = sorted((who, i) for i, who in enumerate(identities) if who > 0)
        self._check_cameras([row for _, i in named for row in persons[i]])
        if not named:
            self._check_cameras_of_pairs(frames)
        there = frames.there.any(-1).any(1).cpu()
        notes = notes_on_strays(self.single.rig.names, strays, there)
        tracks = [self._track(persons[i], who, feet, smoothing == "full") for who, i in named]
        return [replace(track, notes=track.notes + notes) for track in tracks]

    @torch.no_grad()
    def step(
        self,
        stream: LivePeople | None,
        keypoints: Float[Tensor, "C D J 2"],
        confidence: Float[Tensor, "C D J"] | None = None,
        names: Sequence[str] | None = None,
        *,
        covariance: Float[Tensor, "C D J"] | None = None,
    ) -> tuple[LivePeople, list[BodyTrack]]:
        """Track one more frame; return the poses of those who are confirmed persons by now."""
        check_shape("keypoints", keypoints, [len(self.single.rig), "D", None, 2])
        known = stream is not None and stream.people.n_confirmed > 0
        frame, seen = self._frames(keypoints, confidence, names, covariance, known)
        after, found = self.people.advance(None if stream is None else stream.people, frame)
        if found is None:
            return LivePeople(after, None, None), []
        state, feet = self._feet_of_all(stream, found, seen)
        former = set() if stream is None or stream.numbers is None else set(stream.numbers.tolist())
        tracks = []
        for row in (found.identity > 0).nonzero().flatten().tolist():
            who, followed = int(found.identity[row]), int(found.number[row]) in former
            one, own = [_Row(0, row, found)], one_of(feet, row)
            tracks.append(self._track_of(one, who, own, summed_up=False, followed=followed))
        return LivePeople(after, state, found.number), tracks

    def _feet_of_all(
        self, stream: LivePeople | None, found: PeopleFrame, seen: KeypointFrame | None
    ) -> tuple[FootGaussian | None, FootPoses | None]:
        """Return the feet of all persons of a frame, and the state from which they go on."""
        if seen is None:
            return None, None
        former = (None, None) if stream is None else (stream.feet, stream.numbers)
        before, new = continued(*former, found.number)
        keypoints = taken_detections(seen, found.detection)
        maps = self.single.tracker.filter.maps
        fresh = new | found.poses.started
        return step_feet(self.single.feet, before, maps, found.poses, keypoints, fresh)

    # --- one person -------------------------------------------------------------------------------

    def _frames(
        self,
        keypoints: Tensor,
        confidence: Tensor | None,
        names: Sequence[str] | None,
        covariance: Tensor | None,
        fitting: bool = False,
    ) -> tuple[KeypointFrame, KeypointFrame | None]:
        """Return the detections of bodies and of feet as frames [..., D, C, J]."""
        trust, cov = (None if v is None else v.transpose(-3, -2) for v in (confidence, covariance))
        points = keypoints.transpose(-4, -3)
        both = self.single.reader.frames_and_feet(points, trust, names, cov, fitting)
        body, feet = (
            one if one is None or one.inlier.shape[-3] else _with_an_empty_one(one) for one in both
        )
        assert body is not None
        return body, feet

    def _check_cameras(self, rows: Sequence[_Row]) -> None:
        """Raise `CameraError` for cameras of another convention or unit, by the keypoints of all persons."""
        if rows:
            seen = [one_of(one.frame.keypoints, one.row) for one in rows]
            self.single.check_cameras(stacked(seen))

    def _check_cameras_of_pairs(self, frames: KeypointFrame) -> None:
        """Raise `CameraError` where nobody is found since cameras are of another convention or unit.

        Conventions are told where no camera has more than one detection. Any two detections of two cameras
        that agree on joints are taken for a person's, whose bones tell the unit.

        Args:
            frames: [T, D, C, J].
        """
        filter = self.single.tracker.filter
        if len(filter.maps.shift) == 1:
            return
        there = frames.there.any(-1)
        single = (there.sum(1) <= 1).all(-1)
        cameras = torch.arange(there.shape[2])
        first = there[single].int().argmax(1)
        rows = torch.arange(len(first))[:, None]
        of_one = frames.map(lambda value: value[single][rows, first, cameras][None])
        check_conventions(self.single.rig, filter, of_one)
        stride = max(1, len(frames.pixels) // _FRAMES)
        pairs = [
            pairs_of_detections(taken(frames, t)) for t in range(0, len(frames.pixels), stride)
        ]
        found: KeypointFrame = joined(pairs)
        agreed = triangulate(filter.maps, found).isfinite().all(-1).sum(-1)
        both = (found.there.sum(1) >= 2).sum(-1)
        rows = (agreed > _AGREED * both).nonzero().squeeze(-1)
        check_units(filter, found.take(rows).map(lambda value: value[:, None]))

    def _track(
        self, rows: Sequence[_Row], person: int, feet: KeypointFrame | None, smoothing: bool
    ) -> BodyTrack:
        """Return the track of one person with the feet, of detections [T, D, C, 6]."""
        every = FrameCollector(len(rows))
        for row in rows:
            pose: Any = row.frame.poses
            pose = to_be_smoothed(pose, row.frame.corrected) if smoothing else pose
            every.add(one_of(pose, row.row))
        poses = self.single.tracker.smoothed(*every.sequence) if smoothing else every.sequence
        standing = None
        if feet is not None:
            seen = [
                taken_detections(taken(feet, row.time), row.frame.detection[[row.row]])
                for row in rows
            ]
            standing = self.single.feet_of(poses, stacked(seen), smoothing)
        return self._track_of(rows, person, taken(standing, 0), taken(poses, 0))

    def _track_of(
        self,
        rows: Sequence[_Row],
        person: int,
        feet: FootPoses | None,
        poses: KeypointPoses | None = None,
        summed_up: bool = True,
        followed: bool = False,
    ) -> BodyTrack:
        """Return the track of one person; by default of the poses as they were filtered."""
        if poses is None:
            poses = joined([one_of(row.frame.poses, row.row) for row in rows])
        keypoints: KeypointFrame = joined([one_of(row.frame.keypoints, row.row) for row in rows])
        track = self.single.builder.track(
            poses, keypoints, summed_up, first_frame=rows[0].time, feet=feet, followed=followed
        )
        track.details["detection"] = joined([one_of(x.frame.detection, x.row) for x in rows])
        track.details["person"] = track.details["detection"].new_full((len(rows),), person)
        return track


def _with_an_empty_one(frames: KeypointFrame) -> KeypointFrame:
    """Return frames without any detection as frames of one detection that has no keypoint."""
    *lead, _, cameras, joints = frames.inlier.shape
    one = frames.map(
        lambda value: value.new_ones(*lead, 1, cameras, joints, *value.shape[len(lead) + 3 :])
    )
    return one._replace(inlier=torch.zeros_like(one.inlier))


def _until_last_seen(rows: list[_Row]) -> list[_Row]:
    """Return the frames of a person without the predictions after the last keypoint."""
    seen = [bool((one.frame.detection[one.row] >= 0).any()) for one in rows]
    return rows[: len(rows) - seen[::-1].index(True)]
