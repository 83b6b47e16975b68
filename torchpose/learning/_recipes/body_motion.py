"""Fit how bodies move, their poses and proportions to recordings of whole bodies.

The accelerations, shifts and proportions are in closed form, poses by EM. Held-out persons then show how far
others are from it.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple, Self

import torch
from tqdm.auto import tqdm

from torchpose._core.checks import check_rate
from torchpose._core.wording import counted
from torchpose.body._articulation import Articulation
from torchpose.io._formats.axes import Axes
from torchpose.io._recordings import Recording
from torchpose.learning._body_motion_fit import (
    BodyMotionRecipe,
    acceleration_ratio,
    fit_body_motion,
    pose_log_density,
)
from torchpose.learning._motion_sequences import MotionSequence, motion_sequence
from torchpose.learning._recipes.choosing import (
    body_of_each,
    choose_recordings,
    fingerprint,
    origin_of,
    recorded_joints,
    state_of,
)
from torchpose.learning._recipes.gaps import notes_on_motion, whole_pieces
from torchpose.math._rotations import matrix_to_quaternion_vector
from torchpose.priors._body_motion import BodyMotion, BodyMotionInfo
from torchpose.skeleton._joint_sets import canonical_names


@dataclass(frozen=True)
class RecordedMotion:
    """Holds the motion of all persons on the articulation that is tracked.

    Attributes:
        fps: most frames per second of the sequences. train, watched: of each recording, `watched` those of
            persons who are held out. fitted, held_out: the recordings, cut at long gaps.
        notes: on these, and on files not read.
    """

    fps: float
    train: list[MotionSequence]
    watched: list[MotionSequence]
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
        fps: float = 30.0,
        axes: Axes | None = None,
        progress: bool = False,
    ) -> Self:
        """Read recordings, fit everybody's body, and turn joints into motion.

        Args:
            paths, persons, held_out, actions, without, axes: see `choose_recordings`.
            fps: frame rate at which motion is looked at; slower recordings keep their own.
            progress: show a bar over recordings.

        Raises:
            InputError: as `choose_recordings` and `recorded_joints`, or a rate that is not positive.
        """
        check_rate("fps", fps)
        learnt, watched, unread = choose_recordings(
            paths, persons=persons, held_out=held_out, actions=actions, without=without, axes=axes
        )
        learnt, left_out = whole_pieces(learnt)
        watched, more = whole_pieces(watched)
        both, n = [*learnt, *watched], len(learnt)
        rates = [min(fps, r.fps or fps) for r in both]
        joints = [recorded_joints(r, rate) for r, rate in zip(both, rates, strict=True)]
        articulation = Articulation()
        centres = matrix_to_quaternion_vector(articulation.centres)
        bodies = {
            person: body.altered(centres=centres)
            for person, body in body_of_each(both, joints).items()
        }
        found = []
        every = zip(both, joints, rates, strict=True)
        for recording, points, rate in tqdm(
            every, total=len(both), disable=not progress, unit="recording"
        ):
            body = bodies[recording.person_id]
            states = state_of(body, recording, points)
            found.append(
                motion_sequence(
                    articulation, body, states, points, rate, recording.person_id,
                    _set_of(recording),
                )
            )  # fmt: skip
        notes = (*unread, *notes_on_motion(both, still=False), *left_out, *more)
        return cls(fps, found[:n], found[n:], learnt, watched, notes)

    def identity(self) -> dict[str, Any]:
        """Return frame rate and digests of the recordings, equal for equal fits."""
        return {
            "fps": self.fps,
            "recordings": fingerprint(self.fitted),
            "held-out recordings": fingerprint(self.held_out),
        }


def _set_of(recording: Recording) -> str:
    """Return the set that a recording is of: its origin, or its joint set if it states no source.

    A folder may hold one person only, and what differs between sets is how they define joints.
    """
    if recording.source:
        return recording.person_id.partition("#")[0]
    return recording.skeleton or " ".join(sorted(canonical_names(recording.names)))


class MotionSpread(NamedTuple):
    """Holds how held-out persons move and stand, relative to the persons fitted to.

    Attributes:
        acceleration: of theirs, in deviations of the prior. log_density, fitted_log_density: mean of their
            poses and of those fitted to, per angle. frames: how many there were.
    """

    acceleration: float
    log_density: float
    fitted_log_density: float
    frames: int


def fit_motion(
    recorded: RecordedMotion, recipe: BodyMotionRecipe, **facts: str
) -> tuple[BodyMotion, MotionSpread | None]:
    """Fit a `BodyMotion` to recorded motion, and compare held-out persons with it, if any.

    Args:
        recorded: to fit to. recipe: settings.
        **facts: name, licence, command; those that are empty are left out.

    Returns:
        The prior, and the spread of held-out persons, None without any.

    Raises:
        InputError: as `fit_body_motion`.
    """
    given: dict[str, Any] = {name: value for name, value in facts.items() if value}
    with torch.no_grad():
        found = fit_body_motion(recorded.train, recipe)
        held_out = _held_out_spread(found, recorded) if recorded.watched else None
    extra: dict[str, Any] = {"settings": asdict(recipe)}
    if held_out is not None:
        extra["held_out"] = held_out._asdict()
    found.info = BodyMotionInfo(
        fps=recorded.fps,
        n_frames=sum(len(s.residual) for s in recorded.train),
        **origin_of(recorded.fitted),
        **given,
        extra=extra,
    )
    return found, held_out


def _held_out_spread(motion: BodyMotion, recorded: RecordedMotion) -> MotionSpread:
    return MotionSpread(
        acceleration_ratio(motion, recorded.watched),
        pose_log_density(motion, recorded.watched),
        pose_log_density(motion, recorded.train),
        sum(len(s.residual) for s in recorded.watched),
    )


def motion_summary(motion: BodyMotion, held_out: MotionSpread | None) -> str:
    """Return a one-sentence summary of the fit."""
    info = motion.info
    text = (
        f"{info.name}: motion of {motion.articulation.n_pose} columns and {len(motion.poses.weights)} "
        f"kinds of poses from {info.n_frames} frames of {counted(len(info.persons), 'person')}"
    )
    if held_out is None:
        return text
    return (
        f"{text}; persons held out accelerate {held_out.acceleration:.2f} times as much, and their poses "
        f"have a log density of {held_out.log_density:.2f} an angle, those fitted to "
        f"{held_out.fitted_log_density:.2f}"
    )
