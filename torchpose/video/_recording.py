"""Keep the poses of the persons of a recording in files, block by block, until it has ended."""

import shutil
import tempfile
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpose._core.facade import set_up_facade
from torchpose._core.wording import numbered_frames
from torchpose.errors import InputError, OutputError
from torchpose.upper_body._estimator import joined_notes
from torchpose.upper_body._outlier_notes import (
    exchanged_frames,
    outlier_notes,
    without_outliers,
)
from torchpose.upper_body._pose_track import FRAME_FIELDS, PoseTrack
from torchpose.upper_body._reading import note_collapse
from torchpose.upper_body._upper_body_tracker import UpperBodyTracker
from torchpose.video._person_stream import (
    Measured,
    TrackedBlock,
    absent_for,
    unmeasured,
    without_long_gaps,
)

LEAST_SECONDS = 0.5  # for which a person has to be seen to be reported
# Poses that are written together, since opening the files takes longer than writing a pose; and parts of
# measurements that are joined.
_WRITTEN = 32


class PoseSpool:
    """Appends blocks of poses of one sequence to files, and reads them as one `PoseTrack`.

    The files are deleted with the spool; poses that were read from it remain readable.

    Args:
        folder: the folder of the files; None is the system's folder for temporary files.

    Raises:
        OutputError: the folder cannot be written to.
    """

    def __init__(self, folder: str | Path | None = None) -> None:
        try:
            self._folder = Path(tempfile.mkdtemp(prefix=".poses-", dir=folder))
        except OSError as error:
            raise OutputError(
                f"{folder}: poses cannot be kept here ({error.strerror or error})"
            ) from error
        weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        self._like: PoseTrack | None = None
        self._waiting: list[PoseTrack] = []
        self._n_frames = self._n_written = 0
        self._exchanged = 0
        self._notes: tuple[str, ...] = ()
        self.failed_at = -1

    def __len__(self) -> int:
        return self._n_frames

    def append(self, block: PoseTrack) -> None:
        """Add the frames of one sequence.

        Raises:
            InputError: not one sequence. OutputError: the disk is full.
        """
        if len(block) != 1:
            raise InputError(f"a spool holds one sequence, got a block of {len(block)}")
        if self.failed_at < 0 <= int(block.failed_at[0]):
            self.failed_at = self._n_frames + int(block.failed_at[0])
        self._exchanged += exchanged_frames(block.notes)
        self._notes = joined_notes((*self._notes, *without_outliers(block.notes)))
        self._like = block if self._like is None else self._like
        self._n_frames += block.joints3d.shape[1]
        self._waiting.append(block)
        if self._n_frames - self._n_written >= _WRITTEN:
            self._write()

    def _write(self) -> None:
        """Write the frames that wait for it; after an error they wait on."""
        if not self._waiting:
            return
        try:
            for name in FRAME_FIELDS:
                arrays = [_array(getattr(block, name)) for block in self._waiting]
                with self._path(name).open("ab") as file:
                    file.truncate(self._n_written * arrays[0][0].nbytes)  # what an error left
                    file.writelines(array.data for array in arrays)
        except OSError as error:
            raise OutputError(
                f"{self._folder}: poses cannot be kept here ({error.strerror or error})"
            ) from error
        self._waiting, self._n_written = [], self._n_frames

    def track(self, n_frames: int | None = None) -> PoseTrack:
        """Return the poses so far, or the first of them, read from the files as they are used.

        Raises:
            InputError: there are none. OutputError: the disk is full.
        """
        self._write()
        like, count = self._like, self._n_frames if n_frames is None else n_frames
        if like is None or not 0 < count <= self._n_frames:
            raise InputError(f"expected 1 to {self._n_frames} poses, got {count}")
        fields: dict[str, Any] = {}
        for name in FRAME_FIELDS:
            sample = _array(getattr(like, name))
            shape = (self._n_frames, *sample.shape[1:])
            stored = np.memmap(self._path(name), sample.dtype, mode="c", shape=shape)
            fields[name] = torch.from_numpy(stored[:count])[None]
        fields["lengths"] = torch.tensor([count])
        fields["failed_at"] = torch.tensor([self.failed_at])
        found = outlier_notes(fields["inlier_probability"], self._exchanged)
        fields["notes"] = (*self._notes, *found)
        return note_collapse(replace(like, **fields))

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}.bin"


def _array(values: Tensor) -> np.ndarray:
    return values[0].detach().cpu().contiguous().numpy()


@dataclass
class TrackedPerson:
    """Holds the poses of one person of a video.

    Attributes:
        number: the number of the person, in the order of appearance.
        first_frame: the frame of the video that has the first pose.
        track: the poses as a batch of one; NaN where the person was absent for longer than `max_gap`.
        keypoints: [T, J, 2], the measurements, pixels, NaN where missing, in the order of the measurer's
            `names`.
        covariance: [T, J, 2, 2], the covariances of the keypoints, pixels squared; None with a detector.
        confidence: [T, J], the confidences of a detector, 0 to 1; None without one.
        absent: [T, J], the probability that a joint cannot be seen, hidden or outside of the image; NaN
            where nothing is known. None is nowhere.
    """

    number: int
    first_frame: int
    track: PoseTrack
    keypoints: Tensor
    covariance: Tensor | None
    confidence: Tensor | None = None
    absent: Tensor | None = None

    def __len__(self) -> int:
        return len(self.keypoints)


@dataclass
class _Person:
    """Holds one person while a recording is tracked; `last_seen` counts from `first_frame`."""

    number: int
    first_frame: int
    poses: PoseSpool
    last_seen: int = 0
    n_seen: int = 0
    _parts: list[Measured] = field(default_factory=list)
    _n_single: int = 0  # the last parts, which are not joined yet

    def keep(self, measured: Measured) -> None:
        """Keep the measurements in the next frames, in few tensors: one of a single frame takes kilobytes."""
        self._parts.append(measured)
        self._n_single += 1
        if self._n_single == _WRITTEN:
            joined = _joined(self._parts[-_WRITTEN:])
            self._parts[-_WRITTEN:], self._n_single = [joined], 0

    def measured(self, count: int) -> Measured:
        """Return the measurements in the first frames."""
        return _joined(self._parts).frames(slice(count))


class TrackedRecording:
    """Collects the tracked blocks of all persons (`PersonStream.advance_all`), and joins them at the end.

    Args:
        tracker: the tracker of the poses. names: the names of the measured joints.
        gap: the number of frames without measurements after which a person has no pose.
        folder: the folder of temporary files; None is the system's.
    """

    def __init__(
        self,
        tracker: UpperBodyTracker,
        names: Sequence[str],
        gap: int,
        folder: str | Path | None = None,
    ) -> None:
        self.tracker, self.names, self.gap, self.folder = tracker, tuple(names), gap, folder
        self.n_frames, self._cuts = 0, tuple[int, ...]()
        self._people: dict[int, _Person] = {}

    def append(
        self,
        tracked: Mapping[int, Sequence[TrackedBlock]],
        n_frames: int,
        cuts: tuple[int, ...] = (),
    ) -> None:
        """Keep the poses of the next block.

        Args:
            tracked: the parts of the block with poses, by person. n_frames: the length of the block.
            cuts: the frames so far that begin another scene.

        Raises:
            OutputError: the disk is full.
        """
        self._cuts = cuts
        for number, parts in tracked.items():
            for part in parts:
                self._keep(number, part)
        self.n_frames += n_frames

    def _keep(self, number: int, part: TrackedBlock) -> None:
        """Append a person's part of a block, after NaN for the frames of an absence."""
        frame = self.n_frames + part.start
        if number not in self._people:
            self._people[number] = _Person(number, frame, PoseSpool(self.folder))
        person = self._people[number]
        place = frame - person.first_frame
        absent = place - len(person.poses)
        if absent:
            detected = part.measured.confidence is not None
            person.keep(unmeasured(absent, len(self.names), detected))
            person.poses.append(_nobody(absent, self.tracker))
        person.keep(part.measured)
        seen = torch.nonzero(part.measured.seen).flatten()
        if len(seen):
            person.last_seen = place + int(seen[-1])
            person.n_seen += len(seen)
        person.poses.append(part.poses)  # last, since the poses are kept where writing them fails

    def finish(self, smoother: UpperBodyTracker | None = None) -> list[TrackedPerson]:
        """Return the persons who were seen for half a second or longer, the longest seen first.

        Args:
            smoother: the smoother of whole recordings; None keeps the filtered poses.
        """
        least = LEAST_SECONDS * (self.tracker.fps or 30.0)
        lasting = [person for person in self._people.values() if person.n_seen >= least]
        lasting.sort(key=lambda person: -person.n_seen)
        return [self._finish(person, smoother) for person in lasting]

    def _finish(self, person: _Person, smoother: UpperBodyTracker | None) -> TrackedPerson:
        """Return the poses until the person was last seen."""
        count = person.last_seen + 1
        measured = person.measured(count)
        found = TrackedPerson(
            person.number, person.first_frame, person.poses.track(count), measured.keypoints,
            measured.covariance, measured.confidence, measured.absent,
        )  # fmt: skip
        track = (
            found.track
            if smoother is None
            else self._smoothed(
                measured, smoother, [cut - person.first_frame for cut in self._cuts]
            )
        )
        track = with_note_on_cuts(track, self._cuts)
        return replace(found, track=replace(track, first_frame=person.first_frame))

    def _smoothed(
        self, measured: Measured, smoother: UpperBodyTracker, cuts: Sequence[int]
    ) -> PoseTrack:
        """Return the smoothed poses of a person: of each scene from the measurements in it."""
        seen, end = measured.seen, len(measured.keypoints)
        bounds = [0, *(cut for cut in cuts if 0 < cut < end), end]
        poses = PoseSpool(self.folder)
        for start, stop in pairwise(bounds):
            there = torch.nonzero(seen[start:stop]).flatten().tolist()
            first = start + there[0] if there else stop
            if first > start:
                poses.append(_nobody(first - start, self.tracker))
            if first < stop:
                part = measured.frames(slice(first, stop))
                poses.append(smoothed(part, smoother, self.names, self.gap))
        return poses.track()


def smoothed(
    measured: Measured | TrackedPerson,
    smoother: UpperBodyTracker,
    names: Sequence[str],
    gap: int,
) -> PoseTrack:
    """Return the smoothed poses of a person, from all measurements.

    Args:
        measured: the measurements. smoother: the smoother of whole recordings.
        names: the names of the measured joints. gap: the number of frames without measurements after
            which there is no pose.
    """
    with torch.no_grad():
        confidence, cov = (
            None if values is None else values[None]
            for values in (measured.confidence, measured.covariance)
        )
        absent = None if measured.absent is None else absent_for(smoother, measured.absent)
        track = smoother(measured.keypoints[None], confidence, names, covariance=cov, absent=absent)
    seen = measured.keypoints.isfinite().flatten(1).any(1)
    return without_long_gaps(track, seen, 0, gap)


def with_note_on_cuts(track: PoseTrack, cuts: Sequence[int]) -> PoseTrack:
    """Return the track with a note on the frames at which the video cuts to another scene, if any."""
    if not cuts:
        return track
    note = (
        f"the video cuts to another scene at {numbered_frames(cuts)}: everybody is found anew there, and "
        "recognised by the clothes"
    )
    return replace(track, notes=(*track.notes, note))


def _joined(parts: Sequence[Measured]) -> Measured:
    """Return the measurements in all frames of some parts; None of what none of them has."""
    fields = ([one for one in values if one is not None] for values in zip(*parts, strict=True))
    return Measured(*(torch.cat(there) if there else None for there in fields))  # type: ignore[arg-type]


def _nobody(n_frames: int, tracker: UpperBodyTracker) -> PoseTrack:
    """Return frames without poses."""

    def nothing(*shape: int) -> Tensor:
        return torch.full((1, n_frames, *shape), torch.nan, dtype=torch.float64)

    return PoseTrack(
        joints2d=nothing(8, 2),
        joints3d=nothing(8, 3),
        covariance2d=nothing(8, 2, 2),
        covariance3d=nothing(8, 3, 3),
        observed=torch.zeros(1, n_frames, 8, dtype=torch.bool),
        log_evidence=torch.zeros(1, n_frames, 2, dtype=torch.float64),
        lengths=torch.tensor([n_frames]),
        matrix=tracker.camera.matrix,
        up=tracker.camera.up,
        failed_at=torch.tensor([-1]),
        fps=tracker.fps,
        frame=tracker.frame,
        notes=tracker.notes,
        method=tracker.method,
    )


set_up_facade(__name__)
