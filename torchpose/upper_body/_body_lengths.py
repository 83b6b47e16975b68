"""Learn the lengths of a person's bones while they are tracked, from a prior over persons or a tape."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_choice, check_height, number_of
from torchpose.errors import FileFormatError, InputError
from torchpose.io._results import holds_arrays
from torchpose.priors._arms import LENGTHS, ArmPrior
from torchpose.upper_body._estimator import Bones
from torchpose.upper_body._pose_track import PoseTrack
from torchpose.upper_body._torso_likelihood import (
    NECK_HEIGHT,
    Root,
    Torso,
    TorsoLengths,
    inward_shares,
)

BODY_LENGTHS = ("upper_arm", "forearm", "shoulder_width", "head_height")
"""Lengths that may be given: shoulder to elbow, elbow to the measured hand or wrist, between the
shoulders, and from Kinect's neck, 10.5 cm above the middle of the shoulders, up to the head, whatever neck
is measured."""

_NUDGE = 0.03  # step of the finite differences in log-length
_MOST_CHANGE = 0.1  # largest change of a log-length by one frame
_POWER = 0.1  # exponent of a frame's likelihood of the lengths: frames of one pose are alike
_WIDTH_STD, _HEIGHT_STD = 0.05, 0.05  # metres: shoulders and heads move in their torsos
_GIVEN_STD = 0.02  # standard deviation of the log of a length that was measured on the person
_SHORTEST, _LONGEST = 0.05, 1.0  # metres
_HEIGHT = 1.70  # metres, height of the person whose lengths the prior's are taken to be
_STD_OF_HEIGHT = 0.055  # standard deviation of the log of a length by the heights of grown-ups
_LEAST_OWN_STD = 0.01  # least standard deviation of the log of a length relative to others
_SHARE_OF_SIZE = 0.72  # of the variance of a torso's lengths relative to arms: one size explains it
_LEAST_STD = 0.04  # least standard deviation of the log of a length known in proportion only


class KnownBody(NamedTuple):
    """Facts about the subject that are known beforehand, all of them optional.

    Attributes:
        lengths: metres by name of `BODY_LENGTHS`, as measured on the subject. height: the height of the
            subject, metres. person: poses of the same subject, or their file.
    """

    lengths: Mapping[str, float] | None = None
    height: float | None = None
    person: PoseTrack | str | Path | None = None

    @property
    def key(self) -> str:
        """Return a key that differs between subjects, as long as the poses exist."""
        person = id(self.person) if isinstance(self.person, PoseTrack) else self.person
        return str((self.lengths, self.height, person))


class Lengths(NamedTuple):
    """Gaussian over the logs of `BODY_LENGTHS` of a person, relative to what is usual.

    Attributes:
        mean: [B, 4]. precision: [B, 4]; of the common scale for the surest of them.
    """

    mean: Tensor
    precision: Tensor


class Sizes(NamedTuple):
    """Lengths of a body, metres at the size of the prior's persons (`BodyLengths.unit`).

    Attributes:
        metres: of `BODY_LENGTHS`, [B, 4]. slack: the standard deviations of both bones of an arm, [B, 2];
            0 of the surest length. torso: the lengths of the torso with their standard deviations.
    """

    metres: Tensor
    slack: Tensor
    torso: TorsoLengths


class BodyLengths:
    """Assumed-density filter of the lengths of a body.

    One camera does not tell a large body that is far from a small one that is near. So of all lengths
    the surest stays as the prior, or who measured it, has it, and the others are learnt relative to it.
    Whoever is known to be larger or smaller is followed at the size of the prior's persons, on whom all
    constants in metres were chosen, and enlarged by `unit` at the end.

    Args:
        prior: the prior over persons. hand: the kind of the measured hands, "hand" or "wrist".
        neck: the kind of the neck. known: facts about the subject; other lengths are expected in
            proportion.
        like: a tensor of the dtype and on the device to work in.

    Attributes:
        names: the names of the lengths, as `LENGTHS` has them.
        unit: how many times as large the subject is known to be as the prior's persons.

    Raises:
        InputError: an unknown name, a length or a height that nobody has, poses without lengths, or several
            facts, each of which tells the size.
    """

    def __init__(
        self, prior: ArmPrior, hand: str | None, neck: str | None, known: KnownBody, like: Tensor
    ) -> None:
        forearm = "forearm" if hand == "wrist" else "forearm_to_hand"
        self.names = ("upper_arm", forearm, *BODY_LENGTHS[2:])
        rows = [LENGTHS.index(name) for name in self.names]
        self.neck = 0.0 if neck == "mid-shoulder" else NECK_HEIGHT
        self.lower = like.new_tensor([0.0, 0.0, 0.0, NECK_HEIGHT - self.neck])
        self.usual = prior.lengths[rows].to(like) + self.lower
        self.spread = prior.spread[rows].to(like)
        self.unit = 1.0
        _check_one_size(known)
        if known.height is not None:
            self._grow(known.height)
        if known.person is not None:
            self._recognise(known.person)
        if known.lengths is not None:
            self._measure(known.lengths)
        self.surest = int(self.spread.argmin())
        # the surest length is that of the common scale, which moves no pixel
        self._own = like.new_tensor([float(i != self.surest) for i in range(4)])
        self._unsure = self._own[:2]
        torso = like.new_tensor([0.0, 0.0, 1.0, 1.0])
        self._torso = torso[:, None] * torso  # which pairs of lengths are both of the torso
        steps = torch.eye(2, 4, dtype=like.dtype, device=like.device) * _NUDGE
        self._nudges = torch.cat([torch.zeros_like(steps[:1]), steps, -steps])

    def _grow(self, height: float) -> None:
        """Expect the lengths of a person of this height."""
        self.unit = check_height(height) / _HEIGHT
        left = (self.spread.square() - _STD_OF_HEIGHT**2).clamp_min(_LEAST_STD**2)
        self.spread = left.sqrt().minimum(self.spread)

    def _recognise(self, person: PoseTrack | str | Path) -> None:
        """Expect the lengths of poses of the same person."""
        if not isinstance(person, PoseTrack | str | Path):
            raise InputError(
                f"person must be a PoseTrack or the path of its file, got {type(person).__name__}"
            )
        track = person if isinstance(person, PoseTrack) else _poses_of(person)
        if len(track) != 1:
            raise InputError(
                f"person must be poses of one sequence, got {len(track)}; see PoseTrack.sequence"
            )
        found = track.bone_lengths[0, int(track.lengths[0]) - 1].to(self.usual)
        covs = track.bone_covariance[0, int(track.lengths[0]) - 1].to(self.usual)
        rows = [i for i, name in enumerate(self.names) if track.bone_names[i] == name]
        if not bool(found[rows].isfinite().all()):
            raise InputError(
                "person must be poses with lengths of bones, which method 'articulated' gives, got "
                f"{track.method!r}"
            )
        metres = found + self.lower
        self._expect(rows, metres[rows], covs.diagonal()[rows].sqrt() / metres[rows])

    def _measure(self, given: Mapping[str, float]) -> None:
        """Expect lengths that were measured on the person."""
        if not isinstance(given, Mapping):
            raise InputError(
                f"bone_lengths must be a mapping of {', '.join(BODY_LENGTHS)} to metres, got "
                f"{type(given).__name__}"
            )
        if not given:
            raise InputError("bone_lengths must hold at least one length, got none; leave it out")
        for name, metres in given.items():
            check_choice("bone_lengths", name, BODY_LENGTHS)
            if not _SHORTEST <= number_of(metres) <= _LONGEST:
                raise InputError(
                    f"bone_lengths must lie between {_SHORTEST} and {_LONGEST} m, got {name} = {metres!r}"
                )
        rows = [BODY_LENGTHS.index(name) for name in given]
        values = self.usual.new_tensor([number_of(metres) for metres in given.values()])
        lengths = values + self.lower[rows]
        self._expect(rows, lengths, _GIVEN_STD * (values / lengths))

    def _expect(self, rows: list[int], metres: Tensor, spread: Tensor) -> None:
        """Expect these lengths, and the others in proportion."""
        factors = metres / self.usual[rows]
        self.unit = float(factors.log().mean().exp())
        self.usual = self.usual.clone()
        self.usual[rows] *= factors / self.unit
        self.spread = self.spread.clone()
        self.spread[rows] = self.spread[rows].minimum(spread)

    @property
    def scale(self) -> Tensor:
        """Return the standard deviation of the log of the common scale."""
        return self.spread[self.surest]

    @property
    def size_spread(self) -> Tensor:
        """Return the standard deviation of the log of a torso's size relative to arms (`RootGrid`)."""
        own = self.spread.square() - self.scale.square()
        return (_SHARE_OF_SIZE * own[2:].amin()).clamp_min(0.0).sqrt()

    def init(self, batch_size: int, of_size: Float[Tensor, " B"]) -> Lengths:
        """Return the prior over the lengths before the first frame, given the size of the torso.

        Args:
            batch_size: B. of_size: the variance of the log of that size.
        """
        own = (self.spread.square() - self.scale.square()).repeat(batch_size, 1)
        own[:, 2:] -= of_size[:, None]
        own = own.clamp_min(_LEAST_OWN_STD**2)
        own[:, self.surest] = self.scale.square()
        precision = own.reciprocal()
        return Lengths(torch.zeros_like(precision), precision)

    def metres(self, lengths: Lengths) -> Float[Tensor, "B 4"]:
        """Return the lengths, metres at the size of the prior's persons."""
        return self.usual * lengths.mean.exp()

    def shown(
        self, lengths: Lengths, size: Float[Tensor, " B"], unsure: Float[Tensor, " B"]
    ) -> Bones:
        """Return the lengths as they are reported, of the subject's own size, heads above Kinect's neck.

        Their covariances are those of a common scale, of the size of the torso, and of each length by
        itself.

        Args:
            lengths: the belief given the size. size: the size of the torso. unsure: the variance of its
                log.
        """
        own = torch.diag_embed(lengths.precision.reciprocal() * self._own)
        logs = torch.addcmul(own + self.scale.square(), unsure[:, None, None], self._torso)
        metres = self.metres(lengths) * size[:, None] ** self._torso[-1]
        if self.unit != 1.0:
            metres = self.unit * metres
        return Bones(self.names, metres - self.lower, metres[:, :, None] * logs * metres[:, None])

    def sizes(self, lengths: Lengths) -> Sizes:
        """Return the lengths as other filters take them."""
        metres = self.metres(lengths)
        std = metres * lengths.precision.rsqrt()
        torso = TorsoLengths.of(metres[:, 2], metres[:, 3], std[:, 2], std[:, 3], self.neck)
        return Sizes(metres, std[:, :2] * self._unsure, torso)

    def learn(
        self,
        lengths: Lengths,
        torso: Torso,
        root: Root,
        evidence: Callable[[Float[Tensor, "B N 4"]], Float[Tensor, "B N"]],
    ) -> Lengths:
        """Return the lengths after a frame: one Newton step on their log-evidence.

        Args:
            lengths: the belief before the frame. torso: the measured torso. root: one hypothesis about it.
            evidence: maps some lengths, metres, to the log-evidence of the arms under each.
        """
        slope, bend = self._slopes_of_arms(lengths, evidence)
        width, height = self._slopes_of_torso(lengths, torso, root)
        slope = _POWER * torch.cat([slope, width[0], height[0]], 1)
        bend = _POWER * torch.cat([bend, width[1], height[1]], 1).clamp_min(0.0)
        precision = lengths.precision + bend
        mean = lengths.mean + (slope / precision).clamp(-_MOST_CHANGE, _MOST_CHANGE)
        mean = mean - mean[:, [self.surest]]
        limit = 3.0 * self.spread
        return Lengths(mean.clamp(-limit, limit), precision)

    def _slopes_of_arms(
        self, lengths: Lengths, evidence: Callable[[Tensor], Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Return slope and curvature of the arms' log-evidence over the log-lengths of both bones, [B, 2].

        The curvature is the negative second derivative; both are central differences.
        """
        found = evidence(self.usual * (lengths.mean[:, None] + self._nudges).exp())
        at, more, less = found[:, :1], found[:, 1:3], found[:, 3:]
        return (more - less) / (2 * _NUDGE), (2 * at - more - less) / _NUDGE**2

    def _slopes_of_torso(
        self, lengths: Lengths, torso: Torso, root: Root
    ) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
        """Return slope and curvature of the log-evidence over log-width and log-height, [B, 1] each."""
        size = self.metres(lengths) * root.size
        inward, wavering = (x[:, None] for x in inward_shares(torso, root.depth[:, 0]))
        width, height = size[:, 2:3], size[:, 3:]
        across = width * (1.0 - inward) * root.turn.cos()
        free = _WIDTH_STD**2 + (width * wavering).square()
        pairs = ((0, 1, 0, across, free), (2, 3, 1, height, _HEIGHT_STD**2))
        found = []
        for a, b, axis, expected, variance in pairs:
            seen = (torso.rays[:, a, axis] - torso.rays[:, b, axis])[:, None] * root.depth
            both = (torso.known[:, a] & torso.known[:, b])[:, None].to(seen)
            slope = both * expected * (seen - expected) / variance
            found.append((slope, both * expected.square() / variance))
        return found[0], found[1]


def _poses_of(path: str | Path) -> PoseTrack:
    """Return the poses in a file; errors say what to give instead of a file of another kind."""
    try:
        return PoseTrack.load(path)
    except FileFormatError as error:
        if holds_arrays(path, ["keypoints"]):
            raise FileFormatError(
                f"{path}: expected poses of the person, got keypoints; track them with method 'articulated', "
                "and give the poses.npz of that"
            ) from error
        raise FileFormatError(f"{error}; give the poses.npz of an earlier recording") from error


def _check_one_size(known: KnownBody) -> None:
    """Raise `InputError` where several facts tell the size of the subject."""
    facts = {"person": known.person, "bone_lengths": known.lengths, "height": known.height}
    given = [name for name, value in facts.items() if value is not None]
    if len(given) > 1:
        raise InputError(
            f"{' and '.join(given)} each tell how large the person is, got {len(given)} of them; leave all "
            "but one out"
        )
