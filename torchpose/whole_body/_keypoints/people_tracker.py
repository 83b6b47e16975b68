"""Track several persons through detections of keypoints: whose are whose, who enters, who leaves."""

import math
from typing import NamedTuple, Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.rows import joined
from torchpose.whole_body._keypoints.body_kalman import BodyGaussian, CorrectedBody
from torchpose.whole_body._keypoints.faulty_cameras import CameraFaults
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame
from torchpose.whole_body._keypoints.keypoint_poses import KeypointPoses, KeypointStream
from torchpose.whole_body._keypoints.keypoint_tracker import KeypointTracker
from torchpose.whole_body._keypoints.nested import taken
from torchpose.whole_body._keypoints.people_association import (
    assign,
    detection_gains,
    group_detections,
    left_over,
    owned_detections,
    returned,
    taken_detections,
)
from torchpose.whole_body._keypoints.people_cameras import (
    explained,
    righted,
    strays_of,
    watched_cameras,
)

_CONFIRM_TIME, _CONFIRM_FRAMES = 0.1, 3  # seconds, and frames at least, that confirm a person
_TENTATIVE_TIME = 0.1  # seconds without agreeing cameras after which somebody unconfirmed is nobody
_GONE_TIME = 1.0  # seconds without keypoints after which a person has left
_ALONE_TIME = 0.25  # seconds with one camera, after which its keypoints may begin somebody else
_SAME = 0.15  # metres between joints, on average, below which two persons are one
_SAME_TIME = 0.2  # seconds for which they have to be that near
_DOUBT = 25.0  # factor of the variance of keypoints of a camera that nobody's body explains
_LEAST_INLIERS = 0.5  # share of the keypoints of a start that must be those of a body
_AS_WELL = 0.95  # the same of who begins anew, relative to the share of the body as it was followed


class TrackedPeople(NamedTuple):
    """Holds P persons between two frames.

    Attributes:
        bodies: of their filters, None if there is nobody. number: [P], unlike all others before.
        identity: [P], from 1 on in the order in which they were confirmed, 0 of those who are tentative.
        hits: [P], frames in which cameras agreed. missed: [P], frames in a row in which they did not.
        unseen: [P], frames in a row without keypoints. doubled: [P], frames in a row at another's place.
        away: [P], who was not seen for so long since cameras agreed that somebody else may have come.
    """

    bodies: KeypointStream | None
    number: Tensor
    identity: Tensor
    hits: Tensor
    missed: Tensor
    unseen: Tensor
    doubled: Tensor
    away: Tensor

    @classmethod
    def begun(
        cls, bodies: KeypointStream | None, number: Tensor, identity: Tensor, like: Tensor
    ) -> Self:
        """Return persons who begin, with counts of the dtype of a tensor."""
        zero = like.new_zeros(len(number))
        return cls(bodies, number, identity, zero, zero, zero, zero, zero > 0)


class PeopleStream(NamedTuple):
    """Holds the state of tracking persons between two frames.

    Attributes:
        persons: who are there. n_begun, n_confirmed: of numbers and identities that were given.
        faults: what is believed of the cameras, of one element; None before somebody was there.
    """

    persons: TrackedPeople
    n_begun: int = 0
    n_confirmed: int = 0
    faults: CameraFaults | None = None


class PeopleFrame(NamedTuple):
    """Holds what a frame says of P persons.

    Attributes:
        number: [P]. identity: [P]. detection: [P, C], which detection of a camera is a person's, -1 if none.
        keypoints: of these, [P, C, J]. poses: [P]. corrected: what their correction gave.
    """

    number: Tensor
    identity: Tensor
    detection: Tensor
    keypoints: KeypointFrame
    poses: KeypointPoses
    corrected: CorrectedBody


class PeopleTracker:
    """Tracks the persons of frames of detections, all in one batch.

    Args:
        tracker: of single persons. most: persons at a time, None for any number.
    """

    def __init__(self, tracker: KeypointTracker, most: int | None) -> None:
        self.tracker, self.most = tracker, most
        self.n_cameras = len(tracker.filter.maps.shift)
        self.agreeing = min(2, self.n_cameras)

    def advance(
        self, stream: PeopleStream | None, frame: KeypointFrame
    ) -> tuple[PeopleStream, PeopleFrame | None]:
        """Track one more frame.

        Args:
            stream: of the frame before, None before the first. frame: [D, C, J], detections in any order.

        Returns:
            The next stream, and the persons of the frame, None if there is nobody.
        """
        stream = _nobody(frame) if stream is None else stream
        detected, frame = frame, righted(self.tracker, frame, stream.faults)
        there = frame.there.any(-1).mT  # [C, D]
        found, free, predicted = None, there, None
        if stream.persons.bodies is not None:
            stream, found, free, predicted = self._followed(stream, frame, there)
        stream, found = self._with_new(stream, found, frame, free, predicted)
        if found is None:
            return stream, None
        stream, found = self._watched(stream, found, detected)
        if found is None:
            return stream, None
        stream = self._counted(stream, found)
        return self._without_gone(stream), found._replace(identity=stream.persons.identity)

    def _watched(
        self, stream: PeopleStream, found: PeopleFrame, detected: KeypointFrame
    ) -> tuple[PeopleStream, PeopleFrame | None]:
        """Return the stream and the frame, with keypoints as they were detected, by cameras as they are."""
        assert stream.persons.bodies is not None
        keypoints = taken_detections(detected, found.detection)
        tracked = stream.persons.bodies, found.poses, found.corrected
        strays = strays_of(detected, found.detection)
        faults, due = watched_cameras(self.tracker, stream.faults, tracked, keypoints, strays)
        if due:
            faults, better = explained(self.tracker, faults, detected)
            if better:
                stream, after = self._begun_anew(stream._replace(faults=faults), found, detected)
                if after is None:
                    return stream, None
                found, keypoints = after, taken_detections(detected, after.detection)
        turn = faults.turn.expand_as(found.poses.turn)
        poses = found.poses._replace(turn=turn)
        return stream._replace(faults=faults), found._replace(keypoints=keypoints, poses=poses)

    # --- persons who are there --------------------------------------------------------------------

    def _followed(
        self, stream: PeopleStream, frame: KeypointFrame, there: Bool[Tensor, "C D"]
    ) -> tuple[PeopleStream, PeopleFrame, Bool[Tensor, "C D"], BodyGaussian]:
        """Return persons one frame later, detections that begin others, and where persons were expected."""
        people, bodies = stream.persons, stream.persons.bodies
        assert bodies is not None
        predicted = self.tracker.filter.predict(bodies.state, bodies.coasting)
        gains = detection_gains(self.tracker.filter, predicted, frame)
        chosen = self._chosen(gains, predicted, frame, there, people.away)
        keypoints = taken_detections(frame, chosen)
        after, poses, corrected = self.tracker.advance(bodies, keypoints, predicted, watch=False)
        found = PeopleFrame(people.number, people.identity, chosen, keypoints, poses, corrected)
        weak = self._weak(people)
        explained = (gains > 0.0).masked_fill(weak[:, None, None], False).any(0)
        owned = owned_detections(chosen[~weak], there.shape[1])
        free = there & ~explained & ~owned
        return stream._replace(persons=people._replace(bodies=after)), found, free, predicted

    def _weak(self, people: TrackedPeople) -> Bool[Tensor, " P"]:
        """Return who may give their detections up: on whom no cameras have agreed for a while."""
        return people.missed > _ALONE_TIME * self.tracker.filter.fps

    def _chosen(
        self,
        gains: Float[Tensor, "P C D"],
        predicted: BodyGaussian,
        frame: KeypointFrame,
        there: Bool[Tensor, "C D"],
        away: Bool[Tensor, " P"],
    ) -> Int[Tensor, "P C"]:
        """Return the detection of every person in every camera, -1 if none.

        Whom nobody has seen for a while may be anywhere about, and would take the detection that another
        person was missing in a camera for a moment. So they get what is left.

        A camera whose calibration is off sees people elsewhere. How far is learnt from their detections, so
        one that nobody wants is also theirs who are near it by a noise that is larger.
        """
        absent = away[:, None, None]
        near = gains.masked_fill(absent, -math.inf)
        chosen, wanted = assign(near), (near > 0.0).any(0)
        if bool(((chosen < 0).any(0)[:, None] & there & ~wanted).any()):
            wide = detection_gains(self.tracker.filter, predicted, frame, _DOUBT)
            chosen = left_over(wide.masked_fill(wanted | absent, -math.inf), chosen)
        return left_over(gains.masked_fill(~absent, -math.inf), chosen) if away.any() else chosen

    # --- persons who enter ------------------------------------------------------------------------

    def _with_new(
        self,
        stream: PeopleStream,
        found: PeopleFrame | None,
        frame: KeypointFrame,
        free: Bool[Tensor, "C D"],
        predicted: BodyGaussian | None,
    ) -> tuple[PeopleStream, PeopleFrame | None]:
        """Return the stream and the frame with persons who begin in it.

        One whom a single camera saw, and whose keypoints there agree with others that nobody explains, begins
        anew with them and stays the same person, if one body explains all of them as well. Two such persons
        whose keypoints seem to agree stay where they are.
        """
        people = stream.persons
        groups = group_detections(self.tracker.filter.maps, frame, free)
        owner = _owners(groups, found, self._weak(people) & ~people.away)
        if predicted is not None and len(groups) and bool(people.away.any()):
            keypoints = taken_detections(frame, groups)
            owner = self._with_returned(owner, people, found, groups, keypoints, predicted)
        again = (owner & (owner.cumsum(1) > 1)).any(0)  # a second group of the same person
        chosen = (owner.sum(0) <= 1) & ~again & self._has_room(~owner.any(0), len(people.number))
        return self._begun(stream, found, frame, groups[chosen], owner[:, chosen])

    def _with_returned(
        self,
        owner: Bool[Tensor, "P G"],
        people: TrackedPeople,
        found: PeopleFrame | None,
        groups: Int[Tensor, "G C"],
        keypoints: KeypointFrame,
        predicted: BodyGaussian,
    ) -> Bool[Tensor, "P G"]:
        """Return who begins anew with which groups, with those who had not been seen for a while.

        They do with a group that is where they are expected, or that has detections of theirs: of one camera
        if it has seen them since, else of as many as must agree.
        """
        if self.n_cameras > 1:
            expected = returned(self.tracker.filter, predicted, people.away, owner, keypoints)
            owner = owner | expected
        shared = _owners(groups, found, people.away & (people.unseen == 0))
        shared |= _owners(groups, found, people.away, self.agreeing)
        return owner | (shared & ~owner.any(0) & ~owner.any(1, keepdim=True))

    def _begun_anew(
        self, stream: PeopleStream, found: PeopleFrame, detected: KeypointFrame
    ) -> tuple[PeopleStream, PeopleFrame | None]:
        """Return the stream and the frame with all persons begun by cameras that are turned otherwise.

        A person whose detections are in a group stays the same. Another with detections in it was nobody.
        """
        frame = righted(self.tracker, detected, stream.faults)
        groups = group_detections(self.tracker.filter.maps, frame, frame.there.any(-1).mT)
        shares = _owners(groups, found, torch.ones_like(found.number, dtype=torch.bool))
        owner = shares & (shares.cumsum(0) == 1)
        owner = owner & (owner.cumsum(1) == 1)
        rows = (owner.any(1) | ~shares.any(1)).nonzero().squeeze(-1)
        rest = taken(found, rows) if len(rows) else None
        stream, owner = stream._replace(persons=_kept(stream.persons, rows)), owner[rows]
        chosen = self._has_room(~owner.any(0), len(rows))
        return self._begun(stream, rest, frame, groups[chosen], owner[:, chosen])

    def _begun(
        self,
        stream: PeopleStream,
        found: PeopleFrame | None,
        frame: KeypointFrame,
        groups: Int[Tensor, "G C"],
        owner: Bool[Tensor, "P G"],
    ) -> tuple[PeopleStream, PeopleFrame | None]:
        """Return the stream and the frame with persons who begin with groups, or their owners begun anew."""
        if not len(groups):
            return stream, found
        keypoints = taken_detections(frame, groups)
        bodies, poses, corrected = self.tracker.advance(None, keypoints, watch=False)
        sure = _explained(poses, keypoints) >= _needed(owner, found)
        people = stream.persons
        former, identity = _owned_by(people.number, owner, -1), _owned_by(people.identity, owner, 0)
        number = torch.arange(len(groups), device=groups.device) + stream.n_begun
        number = torch.where(former >= 0, former, number)
        begun = PeopleFrame(number, identity, groups, keypoints, poses, corrected)
        beginners = TrackedPeople.begun(bodies, number, identity, poses.log_evidence)
        rows, keep = (flags.nonzero().squeeze(-1) for flags in (sure, ~owner[:, sure].any(-1)))
        people = _kept(people, keep)
        if len(rows):
            beginners, begun = taken((beginners, begun), rows)
            there = people.bodies is not None and found is not None
            people = joined([people, beginners]) if there else beginners
            found = joined([taken(found, keep), begun]) if there else begun
        return stream._replace(persons=people, n_begun=stream.n_begun + len(groups)), found

    def _has_room(self, new: Bool[Tensor, " G"], count: int) -> Bool[Tensor, " G"]:
        """Return which groups may begin: persons who are there already, and others up to the most."""
        if self.most is None:
            return torch.ones_like(new)
        return ~new | (new.cumsum(0) <= self.most - count)

    # --- who is confirmed, who has left -----------------------------------------------------------

    def _counted(self, stream: PeopleStream, found: PeopleFrame) -> PeopleStream:
        """Return the stream with the frame counted."""
        fps, people = self.tracker.filter.fps, stream.persons
        n_seen = (found.detection >= 0).sum(-1)
        agreed = n_seen >= self.agreeing
        hits = people.hits + agreed.to(people.hits)
        doubled = _doubled(found.poses.joints)
        confirmed = hits >= max(_CONFIRM_FRAMES, _CONFIRM_TIME * fps)
        new = (people.identity == 0) & ~doubled & confirmed
        unseen = torch.where(n_seen > 0, 0.0, people.unseen + 1.0)
        people = people._replace(
            identity=torch.where(new, stream.n_confirmed + new.cumsum(0), people.identity),
            hits=hits,
            missed=torch.where(agreed, 0.0, people.missed + 1.0),
            unseen=unseen,
            doubled=torch.where(doubled, people.doubled + 1.0, 0.0),
            away=~agreed & (people.away | (unseen > _ALONE_TIME * fps)),
        )
        return stream._replace(persons=people, n_confirmed=stream.n_confirmed + int(new.sum()))

    def _without_gone(self, stream: PeopleStream) -> PeopleStream:
        """Return the stream without those who left, were never confirmed, or are somebody else."""
        fps, people = self.tracker.filter.fps, stream.persons
        gone = people.unseen > _GONE_TIME * fps
        gone |= (people.identity == 0) & (people.missed > _TENTATIVE_TIME * fps)
        gone |= people.doubled > _SAME_TIME * fps
        return stream._replace(persons=_kept(people, (~gone).nonzero().squeeze(-1)))


def _nobody(frame: KeypointFrame) -> PeopleStream:
    none = frame.inlier.new_zeros(0, dtype=torch.long)
    return PeopleStream(TrackedPeople.begun(None, none, none, frame.inlier))


def _kept(people: TrackedPeople, rows: Int[Tensor, " n"]) -> TrackedPeople:
    """Return some of the persons."""
    if len(rows) == len(people.number):
        return people
    rest: TrackedPeople = taken(people, rows)
    return rest if len(rows) else rest._replace(bodies=None)


def _owners(
    groups: Int[Tensor, "G C"], found: PeopleFrame | None, weak: Bool[Tensor, " P"], least: int = 1
) -> Bool[Tensor, "P G"]:
    """Return whose detections, so many at least of persons who may give theirs up, are in which groups."""
    if found is None:
        return weak[:, None].expand(-1, len(groups))
    shared = (found.detection[:, None] == groups) & (groups >= 0)
    return (shared.sum(-1) >= least) & weak[:, None]


def _owned_by(
    values: Int[Tensor, " P"], owner: Bool[Tensor, "P G"], nobody: int
) -> Int[Tensor, " G"]:
    """Return a value of the only owner of each group."""
    own = (values[:, None] * owner).sum(0)
    return torch.where(owner.any(0), own, nobody)


def _explained(poses: KeypointPoses, keypoints: KeypointFrame) -> Float[Tensor, " P"]:
    """Return the share of persons' keypoints that are those of their bodies."""
    count = keypoints.there.sum((-2, -1)).clamp_min(1)
    return poses.inlier.sum((-2, -1)) / count


def _needed(owner: Bool[Tensor, "P G"], found: PeopleFrame | None) -> Float[Tensor, " G"] | float:
    """Return the share of the keypoints of starts that must be those of a body."""
    if found is None:
        return _LEAST_INLIERS
    followed = _AS_WELL * _explained(found.poses, found.keypoints)
    return (followed[:, None] * owner).sum(0).clamp_min(_LEAST_INLIERS)


def _doubled(joints: Float[Tensor, "P J 3"]) -> Bool[Tensor, " P"]:
    """Return who is at the place of somebody who began before."""
    apart = (joints[:, None] - joints).norm(dim=-1).mean(-1)
    earlier = torch.ones_like(apart).tril(-1) > 0.0
    return (torch.where(earlier, apart, math.inf) < _SAME).any(-1)
