"""Fit action spaces, or a bank of several actions, to recordings of whole bodies.

The fit is in closed form. The gate is then tested on held-out persons.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, Self

import torch
from torch import Tensor

from torchpose._core.checks import check_rate
from torchpose._core.wording import counted
from torchpose.body._kinematics import Body
from torchpose.body._skeleton import BODY_15
from torchpose.errors import InputError
from torchpose.io._formats.axes import Axes
from torchpose.io._recordings import Recording
from torchpose.learning._action_spaces import Performed, fit_synchronised
from torchpose.learning._performances import LEAST_FRAMES, repetition_axis, split_repetitions
from torchpose.learning._recipes.choosing import (
    body_of_each,
    choose_recordings,
    fingerprint,
    origin_of,
    recorded_joints,
    recording_name,
    state_of,
)
from torchpose.learning._recipes.gaps import notes_on_motion
from torchpose.priors._actions.action_file import ActionInfo, BankInfo, Synchronised
from torchpose.priors._actions.bank import ActionBank
from torchpose.priors._actions.postures import posture_angles, state_postures
from torchpose.priors._actions.space import ActionSpace

COMMON_HEIGHT = 1.75
"""Height in metres of the body that everybody's postures are transferred to."""


@dataclass(frozen=True)
class ActionRecipe:
    """Holds the settings of the fit of an action space, or of a bank.

    Args:
        n_dimensions: D, of the principal axes of the postures.
        n_postures: K, of the mean performance; by default the median length.
        prominence: of a key frame, share of the range of distances to the mean.
        stay: of a bank: probability that somebody does the same thing a second later.
        spread: of a bank: factor on the deviations, for persons it has not seen.
        background: of a bank: factor on the deviation of everything, for none of its actions.
        evidence_rate: of a bank: frames per second that count as independent.
        gate_dimensions: of a bank: how many of the dimensions its gates look at, by default all; 25
            dimensions and 13 here tell actions apart best.
        seed: the seed of the trial of the gate, the matching that the share of accepted postures rests on.
    """

    n_dimensions: int = 13
    n_postures: int | None = None
    prominence: float = 0.15
    stay: float = BankInfo.stay
    spread: float = BankInfo.spread
    background: float = BankInfo.background
    evidence_rate: float = BankInfo.evidence_rate
    gate_dimensions: int | None = None
    seed: int = 0


@dataclass(frozen=True)
class Performances:
    """Holds the performances of one action or several, and those of held-out persons.

    Attributes:
        actions: in the order asked for. fps: the frame rate of the postures. postures: "joints" or "body".
        train, watched: single performances. left_out: repetitions that are too short.
        recordings: the recordings of both. notes: on these, and on files not read.
    """

    actions: tuple[str, ...]
    fps: float
    postures: str
    train: list[Performed]
    watched: list[Performed]
    left_out: int
    recordings: list[Recording]
    repeated: bool
    notes: tuple[str, ...] = ()

    @classmethod
    def gather(
        cls,
        paths: Sequence[str],
        actions: Sequence[str],
        *,
        persons: Sequence[str] | None = None,
        held_out: Sequence[str] | None = None,
        without: Sequence[str] | None = None,
        fps: float = 30.0,
        axes: Axes | None = None,
        repeated: bool = True,
        postures: Literal["joints", "body"] = "joints",
    ) -> Self:
        """Read recordings, turn joints into postures, and cut recordings into performances.

        Args:
            paths, persons, without, axes: see `choose_recordings`.
            actions: names of actions, as the files give them; several give a bank.
            held_out: persons who are not fitted to: the gate is tried on them.
            fps: frame rate of what is fitted, best that of the videos.
            repeated: cut recordings into repetitions; false if each is a single performance.
            postures: "joints", angles between the recorded joints; "body", of a body of average
                proportions that is turned as a body fitted to each person, so that it makes no
                difference where shoulders and hips are.

        Raises:
            InputError: as `choose_recordings` and `recorded_joints`, no action or one twice, or an
                action without a performance to learn from.
        """
        check_actions(actions, fps)
        chosen = choose_recordings(
            paths, persons=persons, held_out=held_out, actions=actions, without=without, axes=axes
        )
        recordings = [*chosen.train, *chosen.watched]
        angles = _postures(recordings, [recorded_joints(r, fps) for r in recordings], postures)
        found, left_out = _performed(recordings, angles, actions, fps, repeated, len(chosen.train))
        out = {r.person_id for r in chosen.watched}
        train = [p for p in found if p.person not in out]
        for action in actions:
            if not any(p.action == action for p in train):
                raise InputError(
                    f"{action}: there is no performance to learn from; everybody who did it is held "
                    f"out or not among the persons, or no repetition lasts {LEAST_FRAMES} frames"
                )
        watched = [p for p in found if p.person in out]
        notes = (*chosen.unread, *notes_on_motion(recordings))
        return cls(
            tuple(actions), fps, postures, train, watched, left_out, recordings, repeated, notes
        )  # fmt: skip

    def identity(self) -> dict[str, Any]:
        """Return settings and a digest of the recordings, equal for equal fits."""
        return {
            "fps": self.fps, "actions": list(self.actions), "repeated": self.repeated,
            "held out": sorted({p.person for p in self.watched}), "postures": self.postures,
            "recordings": fingerprint(self.recordings),
        }  # fmt: skip

    def facts(self, action: str) -> ActionInfo:
        """Return the facts about an action that are known before it is fitted."""
        learnt = {p.person for p in self.train if p.action == action}
        mine = [r for r in self.recordings if r.action == action and r.person_id in learnt]
        return ActionInfo(
            name=action,
            fps=self.fps,
            persons=tuple(sorted(learnt)),
            sources=origin_of(mine)["sources"],
            extra={"postures": self.postures},
        )


@dataclass(frozen=True)
class FittedActions:
    """Holds action spaces by name, the synchronised performances, and the acceptance of their gates.

    Attributes:
        spaces: by action. accepted: share of the held-out postures that pass the gate when j is drawn
            (AS 6), by action. performances, recipe: what they were fitted to, and how.
    """

    spaces: dict[str, tuple[ActionSpace, Synchronised]]
    accepted: dict[str, float]
    performances: Performances
    recipe: ActionRecipe

    def result(self, **facts: str) -> ActionSpace | ActionBank:
        """Return the action space, or the bank of all actions.

        Args:
            facts: name, licence, command; in a bank the actions keep their own names.
        """
        given: dict[str, Any] = {k: v for k, v in facts.items() if v and k != "name"}
        spaces = []
        for action, (space, _) in self.spaces.items():
            extra = {
                **space.info.extra, "settings": asdict(self.recipe), "file": facts.get("name", "")
            }  # fmt: skip
            if action in self.accepted:
                extra["accepted"] = self.accepted[action]
            space.info = replace(space.info, **given, extra=extra)
            spaces.append(space)
        if len(spaces) == 1:
            return spaces[0]
        s = self.recipe
        bank = ActionBank(
            spaces, stay=s.stay, spread=s.spread, background=s.background,
            evidence_rate=s.evidence_rate, gate_dimensions=s.gate_dimensions,
        )  # fmt: skip
        sources = {source for space in spaces for source in space.info.sources}
        bank.info = replace(
            bank.info, name=facts.get("name", ""), sources=tuple(sorted(sources)), **given,
            extra={
                "settings": asdict(s), "postures": self.performances.postures,
                "accepted": self.accepted,
            },
        )  # fmt: skip
        return bank

    def summary(self) -> str:
        """Return a summary of the fit, a line for each action."""
        lines = []
        for action, (space, _) in self.spaces.items():
            line = (
                f"{action}: {counted(space.info.performances, 'performance')} of "
                f"{counted(len(space.info.persons), 'person')}, "
                f"{space.n_postures} postures, {len(space.info.key_frames)} key frames, "
                f"{counted(space.n_dimensions, 'dimension')} with "
                f"{100 * (space.info.explained or 0):.1f} % of the variance"
            )
            if action in self.accepted:
                passed = 100 * self.accepted[action]
                line += f"; {passed:.0f} % of held-out postures pass the gate"
            lines.append(line)
        left_out = self.performances.left_out
        if left_out:
            lines.append(
                f"left out {counted(left_out, 'repetition')} shorter than {LEAST_FRAMES} frames"
            )
        return "\n".join(lines)


def fit_actions(performances: Performances, recipe: ActionRecipe) -> FittedActions:
    """Fit every action, and test its gate on held-out persons.

    Args:
        performances: the performances of each action, and of held-out persons.
        recipe: settings of the fits.

    Returns:
        `FittedActions` with an action space for each action, in degrees.

    Raises:
        InputError: as `fit_action_space`.
    """
    spaces, accepted = {}, {}
    for action in performances.actions:
        spaces[action] = fit_synchronised(
            [p.postures for p in performances.train if p.action == action], recipe.n_dimensions,
            name=action, fps=performances.fps, n_postures=recipe.n_postures,
            prominence=recipe.prominence, info=performances.facts(action),
        )  # fmt: skip
        watched = [p.postures for p in performances.watched if p.action == action]
        if watched:
            space, generator = spaces[action][0], torch.Generator().manual_seed(recipe.seed)
            d = recipe.gate_dimensions or space.n_dimensions
            gated = space.with_dimensions(min(d, space.n_dimensions))
            accepted[action] = gated.acceptance(torch.cat(watched), generator=generator).drawn
    return FittedActions(spaces, accepted, performances, recipe)


def check_actions(actions: Sequence[str], fps: float) -> None:
    """Raise `InputError` unless there are actions, each once, and the rate is positive."""
    if not actions or len(set(actions)) < len(actions):
        raise InputError(f"actions must be names, each once, got {', '.join(actions) or 'none'}")
    check_rate("fps", fps)


def _performed(
    recordings: Sequence[Recording],
    angles: Sequence[Tensor],
    actions: Sequence[str],
    fps: float,
    repeated: bool,
    n_train: int,
) -> tuple[list[Performed], int]:
    """Return single performances, and how many repetitions are too short and left out.

    Recordings are cut along an axis of the first `n_train` of them.
    """
    found = []
    for action in actions:
        mine = [i for i, r in enumerate(recordings) if r.action == action]
        learnt = [angles[i] for i in mine if i < n_train]
        parts_of_mine = _single_performances([angles[i] for i in mine], learnt, fps, repeated)
        for i, parts in zip(mine, parts_of_mine, strict=True):
            person = recordings[i].person_id
            found += [Performed(person, action, angles[i][part]) for part in parts]
    if not repeated:  # then every recording counts, and a short one is refused
        return found, 0
    kept = [p for p in found if len(p.postures) >= LEAST_FRAMES]
    return kept, len(found) - len(kept)


def _single_performances(
    angles: Sequence[Tensor], learnt: Sequence[Tensor], fps: float, repeated: bool
) -> list[list[slice]]:
    """Return the frames of the single performances in each recording of an action."""
    if not learnt or not repeated:
        return [[slice(0, len(postures))] for postures in angles]
    axis = repetition_axis(learnt)
    return [split_repetitions(postures, fps, axis) for postures in angles]


def _postures(
    recordings: Sequence[Recording], joints: Sequence[Tensor], postures: str
) -> list[Tensor]:
    """Return the postures [T, 36] of every recording."""
    found = []
    for recording, points in zip(recordings, joints, strict=True):
        try:
            found.append(posture_angles(points))
        except InputError as error:
            raise InputError(f"{recording_name(recording)}: {error}") from error
    if postures != "body":
        return found
    bodies, common = body_of_each(recordings, joints), Body.of_height(BODY_15, COMMON_HEIGHT)
    return [
        state_postures(common, state_of(bodies[r.person_id], r, points))
        for r, points in zip(recordings, joints, strict=True)
    ]
