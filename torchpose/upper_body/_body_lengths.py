"""Learn the lengths of a person's bones while they are tracked, from a prior over persons or a tape."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_choice
from torchpose.errors import InputError
from torchpose.priors._arms import LENGTHS, ArmPrior
from torchpose.upper_body._root_grid import NECK_HEIGHT, Root, Torso, TorsoLengths, inward_shares

__all__ = ["BODY_LENGTHS", "BodyLengths", "Lengths"]

BODY_LENGTHS = ("upper_arm", "forearm", "shoulder_width", "head_height")
"""Lengths that may be given: shoulder to elbow, elbow to the measured hand or wrist, between the
shoulders, and from the neck up to the head."""

_NUDGE = 0.03  # of a log-length, to see what a frame says about it
_MOST = 0.1  # of a log-length that one frame may change it by
_POWER = 0.1  # of what arms say about their lengths: frames of one pose are alike
_WIDTH_STD, _HEIGHT_STD = 0.05, 0.05  # metres: shoulders and heads move in their torsos
_GIVEN = 0.02  # of the log of a length that was measured on the person
_SHORTEST, _LONGEST = 0.05, 1.0  # metres


class Lengths(NamedTuple):
    """Gaussian over the logs of `BODY_LENGTHS` of a person, relative to what is usual.

    Attributes:
        mean: [B, 4]. precision: [B, 4].
    """

    mean: Tensor
    precision: Tensor


class BodyLengths:
    """Assumed-density filter of the lengths of a body.

    One camera does not tell a large body that is far from a small one that is near. So of all lengths
    the surest stays as the prior, or who measured it, has it, and the others are learnt relative to it.

    Args:
        prior: over persons. hand: kind of the measured hands, "hand" or "wrist".
        neck: kind of the neck. given: metres by name of `BODY_LENGTHS`, as measured on the person; the
            others are then expected in the same proportion. like: tells dtype and device.

    Raises:
        InputError: an unknown name, or a length that nobody has.
    """

    def __init__(
        self,
        prior: ArmPrior,
        hand: str | None,
        neck: str | None,
        given: Mapping[str, float] | None,
        like: Tensor,
    ) -> None:
        forearm = "forearm" if hand == "wrist" else "forearm_to_hand"
        rows = [LENGTHS.index(n) for n in ("upper_arm", forearm, *BODY_LENGTHS[2:])]
        self.neck = 0.0 if neck == "mid-shoulder" else NECK_HEIGHT
        lower = like.new_tensor([0.0, 0.0, 0.0, NECK_HEIGHT - self.neck])
        self.usual = prior.lengths[rows].to(like) + lower
        self.spread = prior.spread[rows].to(like)
        if given is not None:
            self._measure(given)
        self.surest = int(self.spread.argmin())

    def _measure(self, given: Mapping[str, float]) -> None:
        """Expect these lengths, and the others in proportion."""
        if not isinstance(given, Mapping):
            raise InputError(
                f"bone_lengths must be a mapping of {', '.join(BODY_LENGTHS)} to metres, got "
                f"{type(given).__name__}"
            )
        if not given:
            raise InputError("bone_lengths must hold at least one length, got none; leave it out")
        for name, metres in given.items():
            check_choice("bone_lengths", name, BODY_LENGTHS)
            if not _SHORTEST <= metres <= _LONGEST:
                raise InputError(
                    f"bone_lengths must lie between {_SHORTEST} and {_LONGEST} m, got {name} = {metres!r}"
                )
        rows = [BODY_LENGTHS.index(name) for name in given]
        values = self.usual.new_tensor(list(given.values()))
        self.usual = self.usual * (values / self.usual[rows]).log().mean().exp()
        self.usual[rows] = values
        self.spread[rows] = self.spread[rows].clamp_max(_GIVEN)

    def init(self, batch_size: int) -> Lengths:
        """Return what is believed before the first frame."""
        precision = self.spread.square().reciprocal().expand(batch_size, -1)
        return Lengths(torch.zeros_like(precision), precision)

    def metres(self, lengths: Lengths) -> Float[Tensor, "B 4"]:
        """Return the lengths."""
        return self.usual * lengths.mean.exp()

    def slack(self, lengths: Lengths) -> Float[Tensor, "B 2"]:
        """Return the deviations of both bones of an arm, metres; none of the surest: it moves no pixel."""
        std = self.metres(lengths) * lengths.precision.rsqrt()
        rows = torch.arange(len(BODY_LENGTHS), device=std.device)
        return torch.where(rows == self.surest, 0.0, std)[:, :2]

    def torso(self, lengths: Lengths) -> TorsoLengths:
        """Return the lengths of the torso with their deviations."""
        metres = self.metres(lengths)[:, 2:]
        std = metres * lengths.precision[:, 2:].rsqrt()
        (width, height), (width_std, height_std) = metres.unbind(1), std.unbind(1)
        return TorsoLengths(width, height, width_std, height_std, self.neck)

    def learn(
        self,
        lengths: Lengths,
        torso: Torso,
        root: Root,
        evidence: Callable[[Float[Tensor, "B 4"]], Float[Tensor, " B"]],
    ) -> Lengths:
        """Return the lengths after a frame: one Newton step on their log-evidence.

        Args:
            torso: what is seen of it. root: where it is, one hypothesis. evidence: of the arms, given
                lengths in metres.
        """
        slope, bend = self._slopes_of_arms(lengths, evidence)
        width, height = self._slopes_of_torso(lengths, torso, root)
        slope = torch.cat([slope, width[0], height[0]], 1)
        bend = torch.cat([bend, width[1], height[1]], 1).clamp_min(0.0)
        precision = lengths.precision + bend
        mean = lengths.mean + (slope / precision).clamp(-_MOST, _MOST)
        mean = mean - mean[:, [self.surest]]
        limit = 3 * self.spread
        return Lengths(mean.clamp(-limit, limit), precision)

    def _slopes_of_arms(
        self, lengths: Lengths, evidence: Callable[[Tensor], Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Return what arms say about the log-lengths of upper arm and forearm: slope and bend, [B, 2]."""
        nudges = lengths.mean.new_tensor(
            [[0, 0, 0, 0], [1, 0, 0, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, -1, 0, 0]]
        )
        at, *pairs = (
            evidence(self.metres(lengths._replace(mean=lengths.mean + nudge)))
            for nudge in nudges * _NUDGE
        )
        slope = [(pairs[i] - pairs[i + 1]) / (2 * _NUDGE) for i in (0, 2)]
        bend = [(2 * at - pairs[i] - pairs[i + 1]) / _NUDGE**2 for i in (0, 2)]
        return _POWER * torch.stack(slope, 1), _POWER * torch.stack(bend, 1)

    def _slopes_of_torso(
        self, lengths: Lengths, torso: Torso, root: Root
    ) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
        """Return slope and bend of the evidence over the log-width and the log-height, [B, 1] each."""
        size = self.metres(lengths)
        inward, wavering = (x[:, None] for x in inward_shares(torso, root.depth[:, 0]))
        width, height = size[:, 2:3], size[:, 3:]
        across = width * (1 - inward) * root.turn.cos()
        free = _WIDTH_STD**2 + (width * wavering).square()
        pairs = ((0, 1, 0, across, free), (2, 3, 1, height, _HEIGHT_STD**2))
        found = []
        for a, b, axis, expected, variance in pairs:
            seen = (torso.rays[:, a, axis] - torso.rays[:, b, axis])[:, None] * root.depth
            both = (torso.known[:, a] & torso.known[:, b])[:, None].to(seen)
            slope = both * expected * (seen - expected) / variance
            found.append((slope, both * expected.square() / variance))
        return found[0], found[1]
