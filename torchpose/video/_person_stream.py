"""Track the poses of one person of a video, and decide whether left and right hand are swapped."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchpose._core.images import Image
from torchpose._core.inference import usable_anywhere
from torchpose.errors import InputError
from torchpose.measure._association import AssociationState, HandAssociation
from torchpose.measure._keypoint_measurer import FrameKeypoints
from torchpose.upper_body._live_pose import StreamState, frames_since
from torchpose.upper_body._pose_track import FRAME_FIELDS, PoseTrack
from torchpose.upper_body._upper_body_tracker import UpperBodyTracker
from torchpose.video._measurers import Found, MissedFrame


class Measured(NamedTuple):
    """Holds the measurements of one person in T frames.

    Attributes:
        keypoints: pixels, NaN where missing [T, J, 2].
        covariance: [T, J, 2, 2]; None of a detector of keypoints.
        size: the size of the face, by a detector about the width of the shoulders, pixels, NaN where there
            is none [T].
        confidence: 0 to 1 [T, J], 0 where missing, by a detector of keypoints; else None.
        absent: the probability that a joint cannot be seen, NaN where nothing is known [T, J].
    """

    keypoints: Float[Tensor, "T J 2"]
    covariance: Float[Tensor, "T J 2 2"] | None
    size: Float[Tensor, " T"]
    confidence: Float[Tensor, "T J"] | None
    absent: Float[Tensor, "T J"]

    @property
    def seen(self) -> Bool[Tensor, " T"]:
        """Return for each frame whether anything was measured in it."""
        return self.keypoints.isfinite().flatten(1).any(1)

    def frames(self, rows: slice) -> "Measured":
        """Return the measurements of some of the frames."""
        return Measured(*(None if x is None else x[rows] for x in self))  # type: ignore[arg-type]


def measured_of(block: Sequence[Found], number: int, n_joints: int) -> Measured:
    """Return the measurements of one person in each frame of a block, all of one kind or missed."""
    detected = any(isinstance(frame, FrameKeypoints) for frame in block)
    found = unmeasured(len(block), n_joints, detected)
    for t, frame in enumerate(block):
        if isinstance(frame, MissedFrame):
            continue
        for row in torch.nonzero(frame.person == number).flatten()[:1]:
            found.keypoints[t], found.absent[t] = frame.keypoints[row], frame.absent[row]
            if isinstance(frame, FrameKeypoints):
                _require_measured(found.confidence)[t], found.size[t] = (
                    frame.confidence[row],
                    frame.sizes[row],
                )
            else:
                _require_measured(found.covariance)[t] = frame.covariance[row]
                found.size[t] = frame.faces[row, 2]
    return found


def unmeasured(n_frames: int, n_joints: int, detected: bool = False) -> Measured:
    """Return frames without measurements.

    Args:
        n_frames: T. n_joints: J.
        detected: whether by a detector of keypoints, which gives confidences in place of covariances.
    """
    points = torch.full((n_frames, n_joints, 2), torch.nan, dtype=torch.float64)
    size = torch.full((n_frames,), torch.nan, dtype=torch.float64)
    unknown = torch.full_like(points[..., 0], torch.nan)
    if detected:
        return Measured(points, None, size, torch.zeros_like(unknown), unknown)
    eye = torch.eye(2, dtype=torch.float64)
    return Measured(points, eye.repeat(n_frames, n_joints, 1, 1), size, None, unknown)


def _require_measured(values: Tensor | None) -> Tensor:
    if values is None:
        raise InputError("expected measurements with covariances, got keypoints of a detector")
    return values


class PersonStreamState(NamedTuple):
    """Holds the states of the tracker (with `association`, of both hypotheses) and of the votes."""

    stream: StreamState
    votes: AssociationState | None

    @property
    def unseen(self) -> int:
        """Return the number of frames since the last measurement."""
        return int(self.stream.unseen[0])


class TrackedBlock(NamedTuple):
    """Holds the poses of one person in a part of a block of frames.

    Attributes:
        start: the first frame of the part, counted from that of the block.
        poses: the poses from that frame on; NaN in the last of them if it ends a long gap.
        measured: the measurements in these frames.
    """

    start: int
    poses: PoseTrack
    measured: Measured

    def last(self) -> "TrackedBlock":
        """Return the last frame alone."""
        before = len(self.measured.seen) - 1
        if not before:
            return self
        poses = _frames(self.poses, slice(before, None))
        return TrackedBlock(self.start + before, poses, self.measured.frames(slice(before, None)))


class PersonStream(nn.Module):
    """Tracks one person; with `association`, under two hypotheses: hands as measured and swapped.

    The edges of the arms select a hypothesis in every frame (BL 50). The poses and the measured hands are
    those of the selected one.

    Args:
        tracker: the tracker of poses. names: the names of the measured joints. seed: the seed of methods
            that draw. association: selects the hypothesis; None takes the hands as measured.

    Reference:
        Burke & Lasenby, section 5.3.
    """

    def __init__(
        self,
        tracker: UpperBodyTracker,
        names: Sequence[str],
        seed: int = 0,
        association: HandAssociation | None = None,
    ) -> None:
        super().__init__()
        self.tracker, self.association = tracker, association
        self.names, self.seed = tuple(names), seed
        self.hands, self.exchanged = [], []
        if association is not None:
            self.hands = [self.names.index(name) for name in ("hand_left", "hand_right")]
            self.exchanged = [self.names.index(_other_side(name)) for name in self.names]

    def init(self, number: int) -> PersonStreamState:
        """Return the state before the first frame of the person of this number."""
        device = self.tracker.measurement_cov.device
        generator = torch.Generator(device).manual_seed(self.seed + number)
        batch = 1 if self.association is None else 2
        stream = self.tracker.init(batch, self.names, generator)
        votes = None if self.association is None else self.association.init()
        return PersonStreamState(stream, votes)

    def advance(
        self, state: PersonStreamState, measured: Measured, images: Sequence[Image] = ()
    ) -> tuple[PersonStreamState, PoseTrack, Measured]:
        """Return the poses of the next frames.

        They are computed in inference mode. Only the state keeps tensors of it, which gradients cannot pass.

        Args:
            state: the state from `init` or the previous call. measured: the measurements in these frames.
            images: the frames, RGB; used with `association` only.

        Returns:
            The next state, the poses, and the measurements, in which hands are exchanged where they
            were swapped.
        """
        state, poses, chosen = self._advance(state, measured, images)
        return state, usable_anywhere(poses), usable_anywhere(chosen)

    @torch.inference_mode()
    def _advance(
        self, state: PersonStreamState, measured: Measured, images: Sequence[Image]
    ) -> tuple[PersonStreamState, PoseTrack, Measured]:
        """Return `advance` in tensors of inference mode."""
        if self.association is None or state.votes is None:
            stream, poses = self.tracker.advance(
                state.stream,
                measured.keypoints[None],
                _batch(measured.confidence),
                covariance=_batch(measured.covariance),
                absent=absent_for(self.tracker, measured.absent),
            )
            return state._replace(stream=stream), poses, measured
        given = (measured.keypoints, _require_measured(measured.covariance), measured.absent)
        both = [torch.stack([one, one[:, self.exchanged]]) for one in given]
        stream, poses = self.tracker.advance(
            state.stream, both[0], covariance=both[1],
            absent=both[2] if self.tracker.camera.image_size else None,
        )  # fmt: skip
        votes, which = _vote(self.association, state.votes, poses, measured, images, self.hands)
        keypoints, cov, absent = (
            hypotheses[which, torch.arange(len(which))] for hypotheses in both
        )
        chosen = Measured(keypoints, cov, measured.size, None, absent)
        return PersonStreamState(stream, votes), _choose(poses, which), chosen

    def advance_all(
        self,
        states: Mapping[int, PersonStreamState],
        block: Sequence[Found],
        images: Sequence[Image],
        gap: int,
    ) -> tuple[dict[int, PersonStreamState], dict[int, list[TrackedBlock]]]:
        """Return the next states and the poses of all persons in a block of frames, by number.

        The poses are the same however a recording is cut into blocks.

        Args:
            states: the states of the persons before the block. block: the measurements of each frame.
            images: the frames, RGB; used with `association` only.
            gap: the number of frames without measurements after which a person has neither pose nor
                state; a subject who returns is reinitialised.

        Returns:
            The states of those who were seen within the last `gap` frames, and for each person the
            parts of the block in which there is a state.
        """
        present = {number for frame in block for number in frame.person.tolist()}
        following, tracked = {}, {}
        for number in sorted(states.keys() | present):
            measured = measured_of(block, number, len(self.names))
            state, parts = self._advance_parts(number, states.get(number), measured, images, gap)
            if parts:
                tracked[number] = parts
            if state is not None:
                following[number] = state
        return following, tracked

    def _advance_parts(
        self,
        number: int,
        state: PersonStreamState | None,
        measured: Measured,
        images: Sequence[Image],
        gap: int,
    ) -> tuple[PersonStreamState | None, list[TrackedBlock]]:
        """Return the next state of one person, None after a long gap, and the parts before and after gaps."""
        parts: list[TrackedBlock] = []
        start, n_frames = 0, len(measured.seen)
        while start < n_frames:
            if state is None:
                seen = torch.nonzero(measured.seen[start:]).flatten()
                if not len(seen):
                    break
                state, start = self.init(number), start + int(seen[0])
            before, rows = state.unseen, slice(start, None)
            state, poses, chosen = self.advance(state, measured.frames(rows), images[rows])
            gone = torch.nonzero(_frames_unseen(poses, before) > gap).flatten()
            if len(gone):
                end = int(gone[0]) + 1
                state, poses, chosen = None, _frames(poses, slice(end)), chosen.frames(slice(end))
                if not measured.seen[start + end - 1]:
                    poses = _without_poses(poses, torch.arange(end) == end - 1)
            parts.append(TrackedBlock(start, poses, chosen))
            start += len(chosen.seen)
        return state, parts


def absent_for(
    tracker: UpperBodyTracker, absent: Float[Tensor, "T J"]
) -> Float[Tensor, "1 T J"] | None:
    """Return the probabilities as a batch of one for a tracker; None if it does not know the image's size."""
    return None if tracker.camera.image_size is None else absent[None]


def _batch(values: Tensor | None) -> Tensor | None:
    return None if values is None else values[None]


def _vote(
    association: HandAssociation,
    votes: AssociationState,
    poses: PoseTrack,
    measured: Measured,
    images: Sequence[Image],
    hands: list[int],
) -> tuple[AssociationState, Tensor]:
    """Return the next votes, and the selected hypothesis of each frame, 0 or 1 [T]."""
    import cv2

    number = torch.zeros(1, dtype=torch.long)
    tells = measured.keypoints[:, hands].isfinite().flatten(1).all(1).tolist()
    which = []
    for t, image in enumerate(images):
        if tells[t]:
            grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
            joints, size = poses.joints2d[None, :, t].cpu(), measured.size[t : t + 1]
            votes = association.step(votes, grey, joints, size, number)
        which.append(int(votes.swapped.any()))
    return votes, torch.tensor(which)


def _choose(poses: PoseTrack, which: Tensor) -> PoseTrack:
    """Return one sequence, selected from two frame by frame."""
    which = which.to(poses.joints2d.device)
    frames = torch.arange(len(which), device=which.device)
    fields = {name: getattr(poses, name)[which, frames][None] for name in FRAME_FIELDS}
    failed = poses.failed_at[which]
    lost = (failed >= 0) & (frames >= failed)
    first = int(lost.long().argmax()) if bool(lost.any()) else -1
    return replace(
        poses, **fields, lengths=poses.lengths[:1], failed_at=poses.failed_at.new_tensor([first])
    )


def without_long_gaps(
    poses: PoseTrack, seen: Bool[Tensor, " T"], unseen: int, gap: int
) -> PoseTrack:
    """Return the poses, NaN where nothing was seen for more than `gap` frames.

    Args:
        poses: the poses of one sequence. seen: whether anything was measured in each frame.
        unseen: the number of frames without measurements before these.
        gap: the largest number of frames without measurements that has poses.
    """
    away = frames_since(torch.tensor(unseen, device=seen.device), seen) > gap
    return _without_poses(poses, away) if bool(away.any()) else poses


def _frames_unseen(poses: PoseTrack, unseen: int) -> Int[Tensor, " T"]:
    """Return `PersonStreamState.unseen` after each frame: keypoints that are outliers do not count."""
    seen = poses.observed[0].any(-1)
    return frames_since(torch.tensor(unseen, device=seen.device), seen)


def _frames(poses: PoseTrack, rows: slice) -> PoseTrack:
    """Return some frames, one after the other, of one sequence."""
    cut = {name: getattr(poses, name)[:, rows] for name in FRAME_FIELDS}
    start, stop, _ = rows.indices(poses.joints3d.shape[1])
    failed_at = (poses.failed_at - start).clamp(min=0)
    failed_at = torch.where((poses.failed_at >= 0) & (poses.failed_at < stop), failed_at, -1)
    lengths = (poses.lengths.clamp(max=stop) - start).clamp(min=0)
    return replace(poses, **cut, lengths=lengths, failed_at=failed_at)


def _without_poses(poses: PoseTrack, away: Bool[Tensor, " T"]) -> PoseTrack:
    """Return the poses of one sequence, NaN in these frames."""
    changed = {}
    for name in ("joints2d", "joints3d", "covariance2d", "covariance3d"):
        value = getattr(poses, name).clone()
        value[:, away] = torch.nan
        changed[name] = value
    return replace(poses, **changed)


def _other_side(name: str) -> str:
    swap = {"left": "right", "right": "left"}
    joint, _, side = name.partition("_")
    return f"{joint}_{swap[side]}" if side in swap else name
