"""Track all persons whom calibrated cameras show, to a `BodyTrack` for each of them."""

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from torchpose._core.checks import check_choice, check_shape
from torchpose.errors import InputError, NobodySeenError
from torchpose.whole_body._body_track import BodyTrack
from torchpose.whole_body._keypoints.camera_units import check_units
from torchpose.whole_body._keypoints.joint_triangulation import triangulate
from torchpose.whole_body._keypoints.keypoint_body_tracker import SMOOTHING, KeypointBodyTracker
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame
from torchpose.whole_body._keypoints.keypoint_tracker import (
    KeypointPoses,
    stacked,
)
from torchpose.whole_body._keypoints.nested import taken
from torchpose.whole_body._keypoints.people_association import pairs_of_detections
from torchpose.whole_body._keypoints.people_tracker import (
    PeopleFrame,
    PeopleStream,
    PeopleTracker,
)

ALL_PERSONS = "all"
_FRAMES = 20  # that are looked at, at most, where nobody is found
_AGREED = 0.7  # share of the joints of two detections, from which on they are of one person


class _Row(NamedTuple):
    """Holds where a person is: the frame, and the row of its `PeopleFrame`."""

    time: int
    row: int
    frame: PeopleFrame


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
        frames = self._frames(keypoints, confidence, names, covariance)
        if not bool((frames.inlier > 0).any()):
            raise NobodySeenError("the detections have no keypoint in any camera and frame")
        stream, rows = None, defaultdict[int, list[_Row]](list)
        for t in tqdm(range(len(keypoints)), disable=not progress, unit="frame"):
            frame = frames.map(lambda value: value[t])  # noqa: B023
            stream, found = self.people.advance(stream, frame)
            numbers = [] if found is None else found.number.tolist()
            for row, number in enumerate(numbers):
                rows[number].append(_Row(t, row, found))  # type: ignore[arg-type]  # not None
        persons = [_until_last_seen(of_one) for of_one in rows.values()]
        identities = [int(one[-1].frame.identity[one[-1].row]) for one in persons]
        named = sorted((who, i) for i, who in enumerate(identities) if who > 0)
        self._check_units([row for _, i in named for row in persons[i]])
        if not named:
            self._check_units_of_pairs(frames)
        return [self._track(persons[i], who, smoothing == "full") for who, i in named]

    @torch.no_grad()
    def step(
        self,
        stream: PeopleStream | None,
        keypoints: Float[Tensor, "C D J 2"],
        confidence: Float[Tensor, "C D J"] | None = None,
        names: Sequence[str] | None = None,
        *,
        covariance: Float[Tensor, "C D J"] | None = None,
    ) -> tuple[PeopleStream, list[BodyTrack]]:
        """Track one more frame; return the poses of those who are confirmed persons by now."""
        check_shape("keypoints", keypoints, [len(self.single.rig), "D", None, 2])
        frame = self._frames(keypoints, confidence, names, covariance)
        after, found = self.people.advance(stream, frame)
        if found is None:
            return after, []
        return after, [
            self._track([_Row(0, row, found)], int(found.identity[row]), summed_up=False)
            for row in (found.identity > 0).nonzero().flatten().tolist()
        ]

    # --- one person -------------------------------------------------------------------------------

    def _frames(
        self,
        keypoints: Tensor,
        confidence: Tensor | None,
        names: Sequence[str] | None,
        covariance: Tensor | None,
    ) -> KeypointFrame:
        """Return the detections as frames [..., D, C, J]."""
        others = (None if v is None else v.transpose(-3, -2) for v in (confidence, covariance))
        found = self.single.frames(keypoints.transpose(-4, -3), next(others), names, next(others))
        return found if found.inlier.shape[-3] else _with_an_empty_one(found)

    def _check_units(self, rows: Sequence[_Row]) -> None:
        """Raise `CameraError` where cameras are not in metres, by the bones of all persons together."""
        if rows:
            seen = [taken(one.frame.keypoints, torch.tensor([one.row])) for one in rows]
            check_units(self.single.tracker.filter, stacked(seen))

    def _check_units_of_pairs(self, frames: KeypointFrame) -> None:
        """Raise `CameraError` where nobody is found since cameras are not in metres.

        Any two detections of two cameras that agree on joints are taken for a person's.

        Args:
            frames: [T, D, C, J].
        """
        filter = self.single.tracker.filter
        if len(filter.maps.shift) == 1:
            return
        stride = max(1, len(frames.pixels) // _FRAMES)
        pairs = [
            pairs_of_detections(frames.map(lambda value: value[t]))  # noqa: B023
            for t in range(0, len(frames.pixels), stride)
        ]
        found = KeypointFrame(*(torch.cat(values) for values in zip(*pairs, strict=True)))
        agreed = triangulate(filter.maps, found).isfinite().all(-1).sum(-1)
        both = ((found.inlier > 0).sum(1) >= 2).sum(-1)
        rows = (agreed > _AGREED * both).nonzero().squeeze(-1)
        check_units(filter, found.take(rows).map(lambda value: value[:, None]))

    def _track(
        self, rows: Sequence[_Row], person: int, smoothing: bool = False, summed_up: bool = True
    ) -> BodyTrack:
        """Return the track of one person."""
        found = [taken(row.frame, torch.tensor([row.row])) for row in rows]
        poses: KeypointPoses = stacked([one.poses for one in found])
        keypoints: KeypointFrame = stacked([one.keypoints for one in found])
        if smoothing:
            poses = self.single.tracker.smoothed(poses, [one.corrected for one in found])
        track = self.single.track(poses, keypoints, 0, summed_up, first_frame=rows[0].time)
        track.details["detection"] = torch.cat([one.detection for one in found])
        track.details["person"] = torch.full((len(rows),), person)
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
