"""Protocol Body models: what fitted models bring to the trackers of `torchpose track-body`.

Persons whom the models do not know are rendered as silhouettes of another body than the tracker's, and
tracked with each model by the filter, and the settings, that the command has. Beside them are the filters
without a model, and two estimates that do not look: standing still, and the mean pose carried along at
the true place. Errors are distances of joints.
"""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.bodies.clips import Split, select_persons, take_frames
from benchmarks.bodies.tracking import (
    MADE_WITH,
    Run,
    csv_columns,
    generators_of,
    part_error,
    subject_facts,
    track_view,
    view_errors,
)
from benchmarks.bodies.views import (
    Conditions,
    Subject,
    Tracked,
    body_of,
    image_size,
    subjects_of,
    view_of,
)
from benchmarks.engine import Experiment, Grid, Results, Row, mean, pivot, spread, write_csv
from torchpose._core.files import check_output_folder
from torchpose.body import fit_state
from torchpose.errors import InputError, OverlapError
from torchpose.evaluation import Report
from torchpose.io import read_mocap
from torchpose.io._mocap import MocapClip
from torchpose.priors import load_action, load_limb_conditionals, load_manifold
from torchpose.whole_body import METHODS, BodyTracker

STILL, MEAN_POSE = "standing still", "mean pose at the true place"

SPACED = ("actions", "persons")
"""Options that a command line takes as words with blanks between them."""

_BODY_FRAMES = 350
_PLAIN = ("sir", "apf")


def run(
    data: str | Path,
    out: str | Path,
    *,
    seed: int = 0,
    progress: bool = True,
    quick: bool = False,
    manifold: str | None = None,
    conditionals: str | None = None,
    action: str | None = None,
    persons: tuple[str, ...] = (),
    actions: tuple[str, ...] = (),
    clips: int = 1,
    frames: int = 120,
    fps: float = 60.0,
    seeds: int = 2,
    particles: int = 500,
    cameras_used: int = 3,
    faults: float = 1.0,
    size: str = "160x120",
) -> Report:
    """Run the protocol; writes report.json, report.md and runs.csv to `out`.

    Runs are kept in `out`, one file each, so that a killed run goes on where it stopped.

    Args:
        data: folder or file of motion capture. out: folder for the results.
        seed: of shapes, faults and the first run. progress: whether to show a bar.
        quick: few frames and particles, one run, to see that all of it works.
        manifold: name or file of a manifold. conditionals: of limb conditionals. action: of an action
            space or bank.
        persons: who is tracked; everybody to whom no model was fitted if nobody is named.
        actions: only recordings of these; all if none is named.
        clips: recordings tracked of each person and action; others tell bone lengths and radii.
        frames: of each, from its first. fps: rate of the frames.
        seeds: runs of every tracker. particles: likelihoods a frame.
        cameras_used: the first 1, 2 or 3 of three cameras, 3.8 m around every clip.
        faults: severity of holes, ragged edges, shadows and missing limbs; 0 for none.
        size: of the silhouettes, width x height.

    Raises:
        OverlapError: a model was fitted on a person who is to be tracked. InputError: no model, unknown
            persons or actions, nobody whom the models do not know, one recording alone of a person.
            PriorError: unknown models. OutputError: `out` cannot be written.
    """
    out = check_output_folder(out)
    if min(clips, seeds, particles) < 1 or frames < 2 or not 1 <= cameras_used <= 3:
        raise InputError(
            "clips, seeds and particles must be at least 1, frames at least 2 and cameras_used from 1 "
            f"to 3, got {clips}, {seeds}, {particles}, {frames} and {cameras_used}"
        )
    models = _load(manifold, conditionals, action)
    if quick:
        frames, particles, seeds = min(frames, 6), min(particles, 35), 1
    recorded = read_mocap(data, fps, actions)
    chosen = _unseen(recorded, models, persons)
    conditions = Conditions(image_size(size), faults, cameras_used, None, seed)
    tracked = [
        _prepare(own, clips, frames, conditions)
        for person in chosen.values()
        for own in _by_action(person).values()
    ]
    subjects = subjects_of(tracked)
    filters = {name: _Filter(name, models.get(name), fps, particles) for name in (*_PLAIN, *models)}
    runs = _blind(subjects, seed) + _TRACKING.run(
        {"": Grid(subjects, filters)}, range(seed, seed + seeds), out, progress=progress,
        title="tracking",
    )  # fmt: skip
    names = {"manifold": manifold, "conditionals": conditionals, "action": action}
    report = Report("Body models: persons whom they do not know", {
        "quick": quick, "seed": seed, "seeds": seeds, "persons": list(chosen),
        "actions": sorted({clip.action for group in chosen.values() for clip in group}),
        **{name: value for name, value in names.items() if value},
        "frames": frames, "fps": fps, "particles": particles, "cameras used": cameras_used,
        "faults": faults, "size": size, "initial pose": "given",
    })  # fmt: skip
    _add_errors(report, runs)
    write_csv(out / "runs.csv", runs, csv_columns(fps))
    report.save(out)
    return report


# --- models and persons ---------------------------------------------------------------------------


def _load(manifold: str | None, conditionals: str | None, action: str | None) -> dict[str, Any]:
    """Return models by the method that tracks with them."""
    found: dict[str, Any] = {}
    if manifold is not None:
        found["mrpf"] = load_manifold(manifold)
    if conditionals is not None:
        found["root"] = load_limb_conditionals(conditionals)
    if action is not None:
        found["constrained"] = load_action(action)
    if not found:
        raise InputError("name a model: --manifold, --conditionals or --action, NAME or FILE")
    return found


def persons_of_model(model: Any) -> set[str]:
    """Return ids of all persons that a model was fitted to, or held out for a manifold's noise."""
    return {*model.info.persons, *model.info.extra.get("held_out_persons", ())}


def refuse_seen(model: Any, persons: Collection[str]) -> None:
    """Raise `OverlapError` if a model has anything of one of these persons.

    Args:
        model: any with `info`. persons: ids, as `Recording.person_id`.
    """
    seen = sorted(set(persons) & persons_of_model(model))
    if seen:
        raise OverlapError(
            f"the model {model.info.name!r} was fitted on {', '.join(seen)}; score it on other "
            "persons, or fit one without these"
        )


def _unseen(
    clips: Sequence[MocapClip], models: Mapping[str, Any], persons: Sequence[str]
) -> dict[str, list[MocapClip]]:
    """Return clips of who is tracked, by person; whoever is named must be unknown to all models."""
    everybody = select_persons(clips, persons)
    if persons:
        for model in models.values():
            refuse_seen(model, {clip.person_id for group in everybody.values() for clip in group})
        return everybody
    known = {p for model in models.values() for p in persons_of_model(model)}
    found = {
        name: group
        for name, group in everybody.items()
        if not known & {clip.person_id for clip in group}
    }
    if not found:
        raise InputError(
            f"all persons of the recordings are known to the models: {', '.join(everybody)}; a model is "
            "scored on others"
        )
    return found


def _by_action(clips: Sequence[MocapClip]) -> dict[str, list[MocapClip]]:
    found: dict[str, list[MocapClip]] = {}
    for clip in clips:
        found.setdefault(clip.action, []).append(clip)
    return found


def _prepare(
    own: Sequence[MocapClip], n_clips: int, n_frames: int, conditions: Conditions
) -> Tracked:
    """Return the body of a person's other recordings, and what cameras see of those that are tracked."""
    if len(own) <= n_clips:
        raise InputError(
            f"person {own[0].person}: expected more than {n_clips} recordings of {own[0].action}, of which "
            f"one tells the bone lengths, got {len(own)}; leave the person out, or track fewer"
        )
    others = take_frames(own[n_clips:], _BODY_FRAMES)
    body = body_of(others, conditions)
    tests = tuple(view_of(body, clip.cut(0, n_frames), conditions) for clip in own[:n_clips])
    split = Split(own[0].person, tuple(own[:n_clips]), (), (), others, seen=False)
    return Tracked(split, body, torch.zeros(body.dim, dtype=torch.float64), tests, ())


# --- runs -----------------------------------------------------------------------------------------


class _Filter(NamedTuple):
    """A method of `torchpose track-body`, with the model that it needs or None."""

    method: str
    model: Any
    fps: float
    particles: int


def _track(subject: Subject[Tracked], how: _Filter, seeds: Sequence[int]) -> list[Run]:
    view, needs = subject.view, METHODS[how.method].needs
    learnt = {} if needs is None else {needs: how.model}
    tracker = BodyTracker(
        view.rig, how.method, body=subject.body, n_particles=how.particles, fps=how.fps, **learnt
    )
    start = fit_state(tracker.body, view.clip.joints[:1]).expand(len(seeds), -1)
    return track_view(tracker.filter, tracker.body, view, start, generators_of(seeds))


def _facts(subject: Subject[Tracked], how: _Filter) -> list[Any]:
    model = [] if how.model is None else list(how.model.state_dict().values())
    return [how.method, how.fps, how.particles, *subject_facts(subject), *model]


_TRACKING = Experiment(
    Run, _track, _facts, (*MADE_WITH, "benchmarks/body_models.py"),
    lambda subject, how: len(subject.view.clip), "frame",
)  # fmt: skip


def _blind(subjects: Mapping[str, Subject[Tracked]], seed: int) -> Results:
    """Return estimates that do not look: the first pose held, and the mean pose at the true root.

    The mean is that of the person's other recordings.
    """
    rows = []
    for name, subject in subjects.items():
        body, split = subject.body, subject.person.split
        truth = fit_state(body, subject.view.clip.joints)
        others = fit_state(body, torch.cat([clip.joints for clip in split.body]))
        mean_pose = body.with_relative(truth, body.relative(others).mean(0))
        for method, states in ((STILL, truth[:1].expand_as(truth)), (MEAN_POSE, mean_pose)):
            rows.append(Row("", name, method, seed, _as_run(subject, states)))
    return Results(tuple(rows))


def _as_run(subject: Subject[Tracked], states: Float[Tensor, "T D"]) -> Run:
    never = torch.zeros(len(states), dtype=torch.bool)
    errors = view_errors(subject.body, subject.view, states).float()
    zero = torch.zeros(1, dtype=torch.float64)
    return Run(errors, states.float(), torch.zeros_like(states).float(), never, never, zero)


# --- tables ---------------------------------------------------------------------------------------


def _add_errors(report: Report, runs: Results) -> None:
    """Add mean errors of every tracker, by part of the body and by sequence."""
    parts = {part: mean(part_error(part)) for part in ("torso", "legs", "arms")}
    pivot(
        report, "errors", "Error (mm) of the joints, mean over joints, frames, sequences and runs",
        runs, ["method"], {"whole body": mean(part_error()), "± runs": spread(part_error()), **parts},
        note="± runs: standard deviation over runs, pooled over sequences.",
    )  # fmt: skip
    pivot(
        report, "sequences", "Error (mm) of the joints by sequence", runs, ["subject"],
        {"{}": mean(part_error())}, columns="method",
    )  # fmt: skip


if __name__ == "__main__":
    from benchmarks._protocols import run_protocol

    run_protocol("body_models")
