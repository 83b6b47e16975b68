"""Fit limb conditionals and the diffusion of limbs to recordings of whole bodies.

The fit is in closed form. Held-out persons then show how far others are from it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_rate
from torchpose._core.wording import counted
from torchpose.body._kinematics import Body, centres_of
from torchpose.errors import InputError
from torchpose.io._formats.axes import Axes
from torchpose.io._recordings import Recording
from torchpose.learning._limb_conditionals_fit import (
    edge_rotations,
    fit_limb_conditionals,
    frame_rotations,
    part_rotations,
)
from torchpose.learning._recipes.choosing import (
    body_of_each,
    choose_recordings,
    fingerprint,
    origin_of,
    recorded_joints,
    state_of,
)
from torchpose.learning._recipes.gaps import notes_on_motion, whole_pieces
from torchpose.math._rotations import compose, conjugate
from torchpose.priors._limb_conditionals import LimbConditionals


@dataclass(frozen=True)
class LimbStates:
    """Holds the recorded states of all persons, on one body with safe centres (DX 1), at one frame rate.

    Attributes:
        body: whose frame and centres the states have. fps: the frame rate of the states.
        train, watched: [T, D] for each recording, `watched` those of persons who are held out.
        fitted, held_out: the recordings, cut at long gaps. notes: on these, and on files not read.
    """

    body: Body
    fps: float
    train: list[Tensor]
    watched: list[Tensor]
    fitted: list[Recording]
    held_out: list[Recording]
    notes: tuple[str, ...] = ()

    @classmethod
    def gather(
        cls,
        paths: Sequence[str],
        *,
        persons: Sequence[str] | None = None,
        held_out: Sequence[str] | None = None,
        actions: Sequence[str] | None = None,
        without: Sequence[str] | None = None,
        fps: float = 60.0,
        axes: Axes | None = None,
    ) -> Self:
        """Read recordings, fit everybody's body, and turn joints into states.

        Args:
            paths, persons, held_out, actions, without, axes: see `choose_recordings`.
            fps: frame rate of what is fitted, best that of the videos.

        Raises:
            InputError: as `choose_recordings` and `recorded_joints`, or a rate that is not positive.
        """
        check_rate("fps", fps)
        learnt, watched, unread = choose_recordings(
            paths, persons=persons, held_out=held_out, actions=actions, without=without, axes=axes
        )
        learnt, left_out = whole_pieces(learnt)
        watched, more = whole_pieces(watched)
        both = [*learnt, *watched]
        joints, n = [recorded_joints(r, fps) for r in both], len(learnt)
        bodies = body_of_each(both, joints, frame="body")
        first = both[0].person_id
        learnt_states = [
            state_of(bodies[r.person_id], r, j) for r, j in zip(learnt, joints[:n], strict=True)
        ]
        centres = centres_of(bodies[first], torch.cat(learnt_states))
        centred = {person: body.altered(centres=centres) for person, body in bodies.items()}
        # fitted again, since the twist that joints do not tell is zero about the centres
        states = [state_of(centred[r.person_id], r, j) for r, j in zip(both, joints, strict=True)]
        notes = (*unread, *notes_on_motion(both), *left_out, *more)
        return cls(centred[first], fps, states[:n], states[n:], learnt, watched, notes)

    def identity(self) -> dict[str, Any]:
        """Return frame rate and digests of the recordings, equal for equal fits."""
        return {
            "fps": self.fps,
            "recordings": fingerprint(self.fitted),
            "held-out recordings": fingerprint(self.held_out),
        }


class LimbSpread(NamedTuple):
    """Holds the deviation and speed of held-out persons, relative to those of the persons fitted to.

    Attributes:
        deviation: of their limbs, in standard deviations of the conditionals; 1 if they are alike.
        speed: of their limbs, in deviations of the diffusion. frames: how many there were.
    """

    deviation: float
    speed: float
    frames: int


def fit_limbs(
    states: LimbStates, least_std: float = 0.01, **facts: str
) -> tuple[LimbConditionals, LimbSpread | None]:
    """Fit limb conditionals to recorded states, and compare held-out persons with them, if any.

    Args:
        states: to fit to.
        least_std: least deviation of a limb in any direction, sine of half an angle
            (`fit_limb_conditionals`).
        **facts: name, licence, command; those that are empty are left out.

    Returns:
        The limb conditionals, and the spread of held-out persons, None without any.

    Raises:
        InputError: `least_std` is negative, and as `fit_limb_conditionals`.
    """
    check_least_std(least_std)
    given: dict[str, Any] = {name: value for name, value in facts.items() if value}
    found = fit_limb_conditionals(
        states.body, states.train, states.fps, least_std=least_std, **origin_of(states.fitted)
    )
    held_out = None
    extra: dict[str, Any] = {"settings": {"least_std": least_std}}
    if states.watched:
        held_out = held_out_spread(found, states.body, states.watched)
        extra["held_out"] = held_out._asdict()
    found.info = replace(found.info, **given, extra=extra)
    return found, held_out


def check_least_std(least_std: float) -> None:
    """Raise `InputError` unless it is zero or more and finite."""
    if not 0 <= least_std < float("inf"):
        raise InputError(f"least_std must be zero or more and finite, got {least_std:g}")


def held_out_spread(
    conditionals: LimbConditionals, body: Body, sequences: Sequence[Float[Tensor, "_ D"]]
) -> LimbSpread:
    """Return the spread of held-out states relative to limb conditionals.

    deviation^2 = sum_ij E|x_ij - mu_ij|^2 / sum_ij tr Sigma_ij,
    speed^2 = sum_j E|q'_j|^2 / sum_j tr Sigma'_j,

    with the means E over their frames.

    Args:
        body: whose states they are, of the conditionals' centres. sequences: [T, D] each, at their
            frame rate.
    """
    turns = [part_rotations(body, s) for s in sequences]
    every = torch.cat(turns)
    between = edge_rotations(every, conditionals.edges.long())
    away = compose(conjugate(conditionals.edge_centres), between) - conditionals.mean
    steps = frame_rotations(turns)
    return LimbSpread(
        _ratio(away, conditionals.covariance), _ratio(steps, conditionals.diffusion), len(every)
    )


def limb_summary(conditionals: LimbConditionals, held_out: LimbSpread | None) -> str:
    """Return a one-sentence summary of the fit."""
    info = conditionals.info
    text = (
        f"{info.name}: {len(conditionals.edges)} limbs from {info.n_frames} frames of "
        f"{counted(len(info.persons), 'person')} at {info.fps:g} frames per second"
    )
    if held_out is None:
        return text
    return (
        f"{text}; those of the persons held out deviate {held_out.deviation:.2f} times as much and "
        f"turn {held_out.speed:.2f} times as fast"
    )


def _ratio(vectors: Float[Tensor, "N M 3"], covariance: Float[Tensor, "M 3 3"]) -> float:
    learnt = covariance.diagonal(dim1=-2, dim2=-1).sum()
    return float((vectors.square().sum((-2, -1)).mean() / learnt).sqrt())
