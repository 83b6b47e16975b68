"""Part of the protocol Bend: which action somebody performs, from recorded and from tracked joints."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks.bend.data import first_bend, performances
from benchmarks.bend.runs import BendRun, kept_tracks, variant_facts
from benchmarks.bend.trackees import (
    DIMENSIONS,
    MOST_DIMENSIONS,
    BendTrackee,
    Performed,
    Variant,
    fit_space,
    make_filter,
    perform,
)
from benchmarks.silhouette.trackees import Conditions, Setting, view_of
from torchpose.body import fit_state
from torchpose.evaluation import Report
from torchpose.io._mocap import MocapClip
from torchpose.priors import ActionBank, ActionSpace
from torchpose.priors._actions.postures import state_postures
from torchpose.whole_body import constant_velocity_std

__all__ = [
    "BANK_SETTINGS",
    "KNOWN",
    "OTHERS",
    "BankSetting",
    "Recognised",
    "TrackedAction",
    "add_confusion",
    "add_release",
    "choose_bank",
    "make_bank",
    "make_spaces",
    "perform_actions",
    "postures_of",
    "recognise_recorded",
    "track_actions",
    "tracked_decisions",
]

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


class TrackedAction(NamedTuple):
    """One recording that was tracked, by tracker ("bank", "bend", "first order")."""

    person: str
    action: str
    runs: dict[str, list[BendRun]]


def perform_actions(
    library: Library, centres: Float[Tensor, "P 3"] | None, progress: bool
) -> dict[str, dict[str, Performed]]:
    """States of everybody's single performances of every action of the bank."""
    pairs = [(a, p) for a in KNOWN if a in library for p in library[a]]
    found: dict[str, dict[str, Performed]] = {a: {} for a, _ in pairs}
    for action, person in tqdm(pairs, disable=not progress, desc="performances"):
        parts = [part for clip in library[action][person] for part in performances(clip)]
        found[action][person] = perform(parts, centres)
    return found


def make_spaces(
    trackee: BendTrackee, performed: Mapping[str, Mapping[str, Performed]]
) -> list[ActionSpace]:
    """The actions of everybody else, put on the body that is tracked."""
    person, fps = trackee.split.person, trackee.split.test[0].fps
    return [
        fit_space(
            trackee.body, [one for name, one in persons.items() if name != person], action, fps
        )
        for action, persons in performed.items()
    ]


def make_bank(spaces: Sequence[ActionSpace], setting: BankSetting) -> ActionBank:
    """A bank whose gates look at no more dimensions than those of a single action."""
    cut = [s.with_dimensions(min(setting.dimensions, s.n_dimensions)) for s in spaces]
    return ActionBank(
        cut, spread=setting.spread, background=setting.background, gate_dimensions=DIMENSIONS
    )


def postures_of(trackee: BendTrackee, library: Library) -> list[tuple[str, Tensor]]:
    """Action and postures [T, 36] of each of the person's recordings, from true joints."""
    return [
        (action, state_postures(trackee.body, fit_state(trackee.body, clip.joints)))
        for action, persons in library.items()
        for clip in persons.get(trackee.split.person, ())
    ]


def recognise_recorded(
    person: str, bank: ActionBank, recordings: Sequence[tuple[str, Tensor]]
) -> list[Recognised]:
    """Decisions for the recordings of `postures_of`.

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
    trackees: Sequence[BendTrackee],
    performed: Mapping[str, Mapping[str, Performed]],
    library: Library,
) -> tuple[BankSetting, dict[BankSetting, float]]:
    """The settings that recognise most of other persons' frames, each kind of action alike.

    Returns:
        The settings, and the share of right frames of all that were tried.
    """
    people = [
        (t.split.person, make_spaces(t, performed), postures_of(t, library)) for t in trackees
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
    """Mean over the known actions and none of the share of right frames."""
    groups: dict[str, list[float]] = {}
    for one in found:
        groups.setdefault(one.action if one.action in KNOWN else "none", []).append(one.frames)
    return sum(sum(g) / len(g) for g in groups.values()) / len(groups)


# --- tracked silhouettes --------------------------------------------------------------------------


def track_actions(
    trackees: Sequence[BendTrackee], banks: Mapping[str, ActionBank],
    performed: Mapping[str, Mapping[str, Performed]], library: Library, conditions: Conditions,
    setting: Setting, plain: Setting, folder: Path, *, particles: int, frames: int, seeds: int,
    seed: int, progress: bool,
) -> list[TrackedAction]:  # fmt: skip
    """Track one recording of every action and person: with the bank, with the bend alone, and free.

    Args:
        trackees: whose bodies. banks: by person. performed: for the noise, which is that of all
            actions of the bank. library: what is tracked. conditions: of the silhouettes.
        setting: of the constrained trackers. plain: of the first-order one. folder: of kept runs.
        particles, frames, seeds, seed, progress: as elsewhere.
    """
    jobs = [(t, a) for t in trackees for a in library if t.split.person in library[a]]
    found = []
    for trackee, action in tqdm(jobs, disable=not progress, desc="actions"):
        person = trackee.split.person
        clip = first_bend(library[action][person][0], frames)
        moves = [
            states
            for persons in performed.values()
            for name, one in persons.items()
            if name != person
            for states in one
        ]
        other = seen_in(trackee, clip, conditions, constant_velocity_std(trackee.body, moves))
        bank = banks[person]
        runs = {}
        for label, constrained, chosen in (
            ("bank", True, setting), ("bend", True, setting), ("first order", False, plain)
        ):  # fmt: skip
            variant = Variant(constrained, particles)
            facts = variant_facts(other, other.tests[0], variant, chosen)
            model = bank if label == "bank" else None
            facts += list(bank.buffers()) if label == "bank" else []
            make = lambda v=variant, s=chosen, t=other, m=model: make_filter(v, t, s, m)  # noqa: E731
            runs[label] = kept_tracks(make, other, 0, facts, folder, range(seed, seed + seeds))
        found.append(TrackedAction(person, action, runs))
    return found


def seen_in(
    trackee: BendTrackee, clip: MocapClip, conditions: Conditions, step_std: Tensor
) -> BendTrackee:
    """The same person in another clip."""
    truth = state_postures(trackee.body, fit_state(trackee.body, clip.joints))
    view = view_of(trackee.body, clip, conditions)
    return replace(
        trackee, tests=(view,), truth=(truth,), recorded_gap=(float("nan"),), step_std=step_std
    )


# --- tables ---------------------------------------------------------------------------------------


def add_confusion(
    report: Report, key: str, title: str, found: Sequence[Recognised], names: Sequence[str]
) -> None:
    """Recordings by what they are (row) and what they were taken for (column)."""
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


def tracked_decisions(
    found: Sequence[TrackedAction], banks: Mapping[str, ActionBank]
) -> list[Recognised]:
    """Decisions of the bank's particles, mean over seeds."""
    decisions = []
    for one in found:
        posterior = torch.stack([run.actions for run in one.runs["bank"]]).double().mean(0)
        decisions.append(_decide(one.person, one.action, banks[one.person], posterior))
    return decisions


def add_release(report: Report, found: Sequence[TrackedAction]) -> None:
    """What a bank is worth: errors of the same silhouettes with the bank, the bend alone, and free."""
    labels = list(found[0].runs)
    table = report.table(
        "release", "Tracked actions: mean squared error of the angles (degrees^2)",
        [*labels, *(f"joints (mm), {label}" for label in labels), "released (%)"],
        note="Bank: all actions and none of them, which releases the constraint. Bend: the action "
        "space of bending, whatever is performed. Released: frames in which none of the actions is "
        "the most probable.",
    )  # fmt: skip
    for action in dict.fromkeys(one.action for one in found):
        own = [one for one in found if one.action == action]
        cells = [_over(own, label, "squared") for label in labels]
        cells += [_over(own, label, "errors") for label in labels]
        cells.append(100 * _over(own, labels[0], "released"))
        table.add(action, cells)


def _over(found: Sequence[TrackedAction], label: str, field: str) -> float:
    """Mean of what the runs of a tracker hold under this name."""
    values = [getattr(run, field).double().nanmean() for one in found for run in one.runs[label]]
    return float(torch.stack(values).mean())
