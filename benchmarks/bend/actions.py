"""Part of the protocol Bend: recognise actions, from recorded and from tracked joints."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks.bend.clips import first_bend, performances
from benchmarks.bend.tracking import TRACKING, BendRun, Filter
from benchmarks.bend.variants import (
    DIMENSIONS,
    MOST_DIMENSIONS,
    BendPerson,
    Performed,
    Variant,
    fit_space,
    perform,
    true_postures,
)
from benchmarks.bodies.views import Conditions, Subject, view_of
from benchmarks.engine import Grid, Results, Setting, mean, pivot
from benchmarks.engine.experiment import Measure
from benchmarks.engine.statistics import Cell
from torchpose.evaluation import Report
from torchpose.io._mocap import MocapClip
from torchpose.priors import ActionBank, ActionSpace
from torchpose.whole_body import constant_velocity_std

KNOWN = ("bend", "wave_right_hand", "throw", "punch")
OTHERS = ("jumping_jacks", "clap", "sit_down")
"""Actions of the bank, and others, which are to be recognised as none of them."""


class BankSetting(NamedTuple):
    """What other persons' recordings choose for a bank.

    Attributes:
        dimensions: of each action's subspace; the gates look at the first 13 alone.
        spread: factor on the deviations of the training persons. background: on those of none.
    """

    dimensions: int
    spread: float
    background: float


BANK_SETTINGS = tuple(
    BankSetting(d, spread, background)
    for d in (DIMENSIONS, MOST_DIMENSIONS)
    for spread in (1.0, 1.5, 2.0, 3.0)
    for background in (1.0, 2.0, 4.0)
)
"""What is tried."""

Library = Mapping[str, Mapping[str, Sequence[MocapClip]]]
"""Recordings by action and person."""


class Recognised(NamedTuple):
    """One recording: its action, the decision for all of it, and the share of its frames that agree."""

    person: str
    action: str
    decision: str
    frames: float


def perform_actions(
    library: Library, centres: Float[Tensor, "P 3"] | None, progress: bool
) -> dict[str, dict[str, Performed]]:
    """Return states of everybody's single performances of every action of the bank."""
    pairs = [(a, p) for a in KNOWN if a in library for p in library[a]]
    found: dict[str, dict[str, Performed]] = {a: {} for a, _ in pairs}
    for action, person in tqdm(pairs, disable=not progress, desc="performances"):
        parts = [part for clip in library[action][person] for part in performances(clip)]
        found[action][person] = perform(parts, centres)
    return found


def make_spaces(
    tracked: BendPerson, performed: Mapping[str, Mapping[str, Performed]]
) -> list[ActionSpace]:
    """Return the actions of everybody else, put on the body that is tracked."""
    person, fps = tracked.split.person, tracked.split.test[0].fps
    return [
        fit_space(
            tracked.body, [one for name, one in persons.items() if name != person], action, fps
        )
        for action, persons in performed.items()
    ]


def make_bank(spaces: Sequence[ActionSpace], setting: BankSetting) -> ActionBank:
    """Return a bank whose gates look at no more dimensions than those of a single action."""
    cut = [s.with_dimensions(min(setting.dimensions, s.n_dimensions)) for s in spaces]
    return ActionBank(
        cut, spread=setting.spread, background=setting.background, gate_dimensions=DIMENSIONS
    )


def postures_of(tracked: BendPerson, library: Library) -> list[tuple[str, Tensor]]:
    """Return action and postures [T, 36] of each of the person's recordings, from true joints."""
    return [
        (action, true_postures(tracked.body, clip))
        for action, persons in library.items()
        for clip in persons.get(tracked.split.person, ())
    ]


def recognise_recorded(
    person: str, bank: ActionBank, recordings: Sequence[tuple[str, Tensor]]
) -> list[Recognised]:
    """Return decisions for the recordings of `postures_of`.

    The decision is the action, or none, of the largest probability on average over the frames.
    """
    return [
        _decide(person, action, bank, bank.recognise(postures)) for action, postures in recordings
    ]


def _decide(
    person: str, action: str, bank: ActionBank, posterior: Float[Tensor, "T S"]
) -> Recognised:
    names = bank.names
    target = names.index(action) if action in names else bank.none
    agree = float((posterior.argmax(-1) == target).double().mean())
    return Recognised(person, action, names[int(posterior.mean(0).argmax())], agree)


def choose_bank(
    tracked_persons: Sequence[BendPerson],
    performed: Mapping[str, Mapping[str, Performed]],
    library: Library,
) -> tuple[BankSetting, dict[BankSetting, float]]:
    """Return the settings that recognise most of other persons' frames, each kind of action alike.

    Returns:
        The settings, and the share of right frames of all that were tried.
    """
    people = [
        (t.split.person, make_spaces(t, performed), postures_of(t, library))
        for t in tracked_persons
    ]
    shares = {}
    for setting in BANK_SETTINGS:
        found = [
            one
            for person, spaces, recordings in people
            for one in recognise_recorded(person, make_bank(spaces, setting), recordings)
        ]
        shares[setting] = _balanced(found)
    return max(shares, key=lambda s: shares[s]), shares


def _balanced(found: Sequence[Recognised]) -> float:
    """Return the mean over the known actions and none of the share of right frames."""
    groups: dict[str, list[float]] = {}
    for one in found:
        groups.setdefault(one.action if one.action in KNOWN else "none", []).append(one.frames)
    return sum(sum(g) / len(g) for g in groups.values()) / len(groups)


# --- tracked silhouettes --------------------------------------------------------------------------


def track_actions(
    tracked_persons: Sequence[BendPerson], banks: Mapping[str, ActionBank],
    performed: Mapping[str, Mapping[str, Performed]], library: Library, conditions: Conditions,
    setting: Setting, plain: Setting, folder: Path, *, particles: int, frames: int,
    seeds: Sequence[int], progress: bool,
) -> Results:  # fmt: skip
    """Track one recording of every action and person: with the bank, with the bend alone, and free.

    Args:
        tracked_persons: whose bodies. banks: by person. performed: for the noise, which is that of all
            actions of the bank. library: what is tracked. conditions: of the silhouettes.
        setting: of the constrained trackers. plain: of the first-order one. folder: of kept runs.
        particles: of each tracker. frames: of each recording. seeds: of the runs.
        progress: whether to show bars.

    Returns:
        Runs by action (condition), person and tracker ("bank", "bend", "first order").
    """
    methods = {
        "bank": Filter(Variant(True, particles), setting, bank=True),
        "bend": Filter(Variant(True, particles), setting),
        "first order": Filter(Variant(False, particles), plain),
    }
    subjects: dict[str, dict[str, Subject[BendPerson]]] = {}
    jobs = [(a, t) for a in library for t in tracked_persons if t.split.person in library[a]]
    for action, tracked in tqdm(jobs, disable=not progress, desc="actions"):
        person = tracked.split.person
        moves = [
            states
            for persons in performed.values()
            for name, one in persons.items()
            if name != person
            for states in one
        ]
        other = replace(
            tracked, step_std=constant_velocity_std(tracked.body, moves), bank=banks[person]
        )
        view = view_of(other.body, first_bend(library[action][person][0], frames), conditions)
        subjects.setdefault(action, {})[person] = Subject(other, other.body, view)
    grids = {action: Grid(own, methods) for action, own in subjects.items()}
    return TRACKING.run(grids, seeds, folder, progress=progress, title="tracked actions")


# --- tables ---------------------------------------------------------------------------------------


def add_confusion(
    report: Report, key: str, title: str, found: Sequence[Recognised], names: Sequence[str]
) -> None:
    """Add recordings by what they are (row) and what they were taken for (column)."""
    table = report.table(
        key, title, [*names, "right frames (%)"],
        note="Numbers of recordings; the decision is the action of the largest probability on average "
        "over the frames. Right frames: those whose most probable action is the true one, or none.",
    )  # fmt: skip
    for action in dict.fromkeys(one.action for one in found):
        own = [one for one in found if one.action == action]
        counts = [sum(one.decision == name for one in own) for name in names]
        label = action if action in names else f"{action} (none of them)"
        table.add(label, [*counts, 100 * sum(one.frames for one in own) / len(own)])
    right = [one.decision == (one.action if one.action in names else names[-1]) for one in found]
    known = [r for r, one in zip(right, found, strict=True) if one.action in names]
    other = [r for r, one in zip(right, found, strict=True) if one.action not in names]
    report.findings.append(
        f"{title}: {sum(known)} of {len(known)} recordings of the known actions are recognised"
        + (f", and {sum(other)} of {len(other)} others as none of them." if other else ".")
    )


def tracked_decisions(runs: Results, banks: Mapping[str, ActionBank]) -> list[Recognised]:
    """Return decisions of the bank's particles, mean over seeds."""
    return [
        _decide(person, action, banks[person], torch.stack([r.actions for r in own.runs]).double().mean(0))
        for (person, action), own in runs.where(method="bank").by("subject", "condition").items()
    ]  # fmt: skip


def add_release(report: Report, runs: Results) -> None:
    """Add the errors with a bank of actions, with the bend alone, and without constraint.

    Args:
        report: gets the table. runs: of `track_actions`.
    """

    def of(label: str, measure: Measure) -> Cell:
        return lambda own: mean(measure)(own.where(method=label))

    def known(field: str) -> Callable[[BendRun], Tensor]:
        return lambda run: getattr(run, field).double().nanmean()

    labels = runs.names("method")
    released = mean(known("released"), 100)
    pivot(
        report, "release", "Tracked actions: mean squared error of the angles (degrees^2)", runs,
        ["condition"],
        {label: of(label, known("squared")) for label in labels}
        | {f"joints (mm), {label}": of(label, known("errors")) for label in labels}
        | {"released (%)": lambda own: released(own.where(method="bank"))},
        note="Bank: all actions and none of them, which releases the constraint. Bend: the action "
        "space of bending, whatever is performed. Released: frames in which none of the actions is "
        "the most probable.",
    )  # fmt: skip
