"""Protocol Bend: one camera, one action, and predictions that its action model lets through (aSpace).

Everybody is left out in turn. The others' bends make an action space; the person is rendered as
silhouettes of another body than the tracker's, seen by one camera beside them, and tracked by
first-order motion with and without the gates of the action, with the same noise and the same budget
of tuning on other persons. Errors are mean squared errors of relative angles.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks.bend import actions as bend_actions
from benchmarks.bend.clips import action_clips, leave_one_out, performances
from benchmarks.bend.occlusion import SIDE, add_occlusion, hidden_arms, with_lost_arm
from benchmarks.bend.report import (
    CONSTRAINED,
    FIRST_ORDER,
    add_dimensions,
    add_limb_shapes,
    add_particles,
    add_sequences,
    add_tuning,
    csv_columns,
)
from benchmarks.bend.tracking import TRACKING, Filter, grid_of, tune_variant
from benchmarks.bend.variants import (
    DIMENSIONS,
    REDRAWS,
    SHARPNESS,
    BendPerson,
    Performed,
    Variant,
    arm_centres,
    make_filter,
    perform,
    prepare,
    synchronised_space,
)
from benchmarks.bodies.clips import select_persons
from benchmarks.bodies.views import Conditions, Subject, image_size, view_of
from benchmarks.engine import Grid, Results, Setting, Tuning, write_csv
from benchmarks.engine.tuning import SCALES
from torchpose._core.files import check_output_folder
from torchpose.errors import InputError
from torchpose.evaluation import Report
from torchpose.evaluation._trials import add_picture
from torchpose.io import read_mocap
from torchpose.io._mocap import MocapClip

FPS = 30.0
PARTS = ("particles", "dimensions", "limbs", "occlusion", "actions")
"""What can be run apart; runs are kept, so that all of them afterwards cost nothing."""

SPACED = ("test_persons", "validation_persons", "particles", "dimensions")
"""Options that a command line takes as words with blanks between them."""

_SHOWN = (0.3, 0.5, 0.7)  # of a clip: the frames in which predictions are drawn
_DRAWN = 40  # predictions
_TRACKED = 4  # persons whose other actions are tracked: seven recordings and three trackers each


@dataclass(frozen=True)
class _Stage:
    """What all parts work with."""

    tracked_persons: list[BendPerson]
    judges: list[BendPerson]
    performed: dict[str, Performed]
    clips: list[MocapClip]
    centres: Float[Tensor, "P 3"]
    conditions: Conditions
    out: Path
    seeds: Sequence[int]
    at: int
    gate_dimensions: int
    numbers: list[int]
    dimensions: list[int]
    progress: bool
    quick: bool

    def variant(self, constrained: bool, particles: int, limb_shape: str = "cylinders") -> Variant:
        """Return a tracker whose gate, if it has one, has the dimensions that were asked for."""
        dimensions = self.gate_dimensions if constrained else DIMENSIONS
        return Variant(constrained, particles, dimensions, limb_shape)

    def both(self, tunings: Mapping[str, Tuning], *numbers: int) -> dict[Variant, Setting]:
        """Return both trackers with so many particles, and what was chosen for them."""
        variants = [self.variant(c, n) for n in numbers for c in (True, False)]
        return {variant: tunings[variant.label].setting for variant in variants}

    def grid(self, settings: Mapping[Variant, Setting]) -> Grid[Subject[BendPerson], Filter]:
        """Return everybody, and trackers of different labels."""
        return grid_of(self.tracked_persons, settings)

    def run(
        self, grids: Mapping[str, Grid[Subject[BendPerson], Filter]], title: str = "tracking"
    ) -> Results:
        """Make the runs that are not kept yet, and return all."""
        return TRACKING.run(grids, self.seeds, self.out, progress=self.progress, title=title)

    def settings(self, variants: Mapping[str, Variant]) -> dict[str, Tuning]:
        """Return the settings that the judges' clips choose for every tracker."""
        scales, values = ((1.0,), SHARPNESS[:2]) if self.quick else (SCALES, SHARPNESS)
        return {
            name: tune_variant(self.judges, variant, self.out, scales=scales, values=values)
            for name, variant in tqdm(variants.items(), disable=not self.progress, desc="exponents")
        }


def run(
    data: str | Path,
    out: str | Path,
    *,
    seed: int = 0,
    progress: bool = True,
    quick: bool = False,
    part: str = "all",
    action: str = "bend",
    test_persons: tuple[str, ...] = (),
    validation_persons: tuple[str, ...] = (),
    seeds: int = 2,
    clips: int = 1,
    frames: int = 86,
    particles: tuple[int, ...] = (100, 300, 1000, 2000, 5000, 10000),
    dimensions: tuple[int, ...] = (1, 2, 3, 5, 8, 13, 18, 25),
    at: int = 1000,
    gate_dimensions: int = DIMENSIONS,
    azimuth: float = 70.0,
    faults: float = 0.5,
    size: str = "160x120",
) -> Report:
    """Run the protocol; writes report.json, report.md, runs.csv and pictures to `out`.

    Runs are kept in `out`, one file each, so that a killed run goes on where it stopped, and parts that
    were run apart are put together by a last run of all of them.

    Args:
        data: folder or file of motion capture. out: folder for the results.
        seed: of shapes, faults and the first run. progress: whether to show bars.
        quick: few frames and particles, one person, to see that all of it works.
        part: particles, dimensions, limbs, occlusion, actions, or all of them.
        action: that is tracked.
        test_persons: who is tracked; all but those of the validation if nobody is named.
        validation_persons: whose clips choose noise and exponents; the last two if nobody is named.
        seeds: runs of every tracker on every clip.
        clips: recordings tracked of each person. frames: of each, from its first repetition.
        particles: how many of them, one number or more. dimensions: of the action space, likewise.
        at: particles of all parts but the first, and of the validation.
        gate_dimensions: of the action space, 13 as published, in all parts but those of the dimensions
            and the actions.
        azimuth: where the camera stands, degrees from ahead, to the person's left.
        faults: severity of holes, ragged edges, shadows and missing limbs; 0 for none.
        size: of the silhouettes, width x height.

    Raises:
        InputError: an unknown part, person or action, too few persons or recordings.
        OutputError: `out` cannot be written.
    """
    out = check_output_folder(out)
    chosen = _parts(part)
    if seeds < 1 or clips < 1 or frames < 3:
        raise InputError(
            f"expected --seeds and --clips of 1 or more and --frames of 3 or more, got {seeds}, "
            f"{clips} and {frames}"
        )
    numbers, wanted = _numbers("particles", particles), _numbers("dimensions", dimensions)
    _numbers("gate-dimensions", [gate_dimensions])
    if quick:
        frames, seeds, at = min(frames, 8), 1, min(at, 30)
        numbers, wanted = sorted({min(n, 40) for n in numbers}), wanted[:1]
    everything = read_mocap(data, FPS, () if "actions" in chosen else (action,))
    moved = [clip for clip in everything if clip.action == action]
    testers, judges = _persons(moved, test_persons, validation_persons, quick)
    conditions = Conditions(image_size(size), faults, 1, None, seed, (azimuth,))
    parts = {
        person: [one for clip in group for one in performances(clip)]
        for person, group in select_persons(moved, ()).items()
    }
    centres = arm_centres([one for person in judges for one in parts[person]])
    performed = {
        person: perform(group, centres)
        for person, group in tqdm(parts.items(), disable=not progress, desc="performances")
    }
    splits = leave_one_out(moved, (*testers, *judges), n_clips=clips, n_frames=frames)
    fitted = [
        prepare(split, performed, conditions, action, centres)
        for split in tqdm(splits, disable=not progress, desc="bodies and action spaces")
    ]
    stage = _Stage(
        fitted[: len(testers)], fitted[len(testers) :], performed, everything, centres, conditions, out,
        range(seed, seed + seeds), at, gate_dimensions, numbers, wanted, progress, quick,
    )  # fmt: skip
    tunings = stage.settings({
        "constrained": stage.variant(True, at), "first order": stage.variant(False, at)
    })  # fmt: skip
    report = Report("Bend: predictions within an action, from one camera", {
        "quick": quick, "seed": seed, "seeds": seeds, "parts": chosen, "action": action,
        "persons": testers, "validation persons": judges, "frames": frames, "fps": FPS,
        "particles": numbers, "dimensions": wanted, "particles of the other parts": at,
        "dimensions of the gates": gate_dimensions,
        "camera": f"one, 3.8 m away at {azimuth:g} degrees from ahead, to the person's left; "
        f"{SIDE:g} degrees for the hidden arm", "faults": faults, "size": size,
        "likelihood": "overlap", "redraws": REDRAWS, "precision": "float32",
        "threads": torch.get_num_threads(),
        "settings": {name: tuning.setting._asdict() for name, tuning in tunings.items()},
    })  # fmt: skip
    for name in chosen:
        _RUNNERS[name](report, stage, tunings)
    add_tuning(report, tunings)
    add_sequences(report, stage.tracked_persons)
    report.save(out)
    return report


# --- parts ----------------------------------------------------------------------------------------


def _particles(report: Report, stage: _Stage, tunings: dict[str, Tuning]) -> None:
    """Add Figures 1, 3 and 4."""
    from benchmarks.bend.pictures import plot_particles, plot_predictions, predictions
    from torchpose.viz import plot_action_space

    grids = {f"{n:,}": stage.grid(stage.both(tunings, n)) for n in stage.numbers}
    runs = stage.run(grids)
    add_particles(report, runs)
    write_csv(stage.out / "runs.csv", runs, csv_columns(grids))
    add_picture(report, stage.out, "error-over-particles.png", plot_particles(runs))
    tracked = stage.tracked_persons[0]
    view = tracked.tests[0]
    shown = [int(share * (len(view.clip) - 1)) for share in _SHOWN]
    drawn = {
        variant.label: [
            predictions(
                make_filter(variant, tracked, tunings[variant.label].setting), view, t, _DRAWN
            )
            for t in shown
        ]
        for variant in stage.both(tunings, stage.at)
    }
    figure = plot_predictions(view, shown, drawn)
    add_picture(report, stage.out, "predictions.png", figure)
    others = [one for name, one in stage.performed.items() if name != tracked.split.person]
    figure = plot_action_space(*synchronised_space(tracked.body, others, tracked.space.info))
    add_picture(report, stage.out, "action-space.png", figure)


def _dimensions(report: Report, stage: _Stage, tunings: dict[str, Tuning]) -> None:
    most = min(t.space.n_dimensions for t in stage.tracked_persons)
    wanted = list(dict.fromkeys(min(d, most) for d in stage.dimensions))
    free, gated = (tunings[label].setting for label in (FIRST_ORDER, CONSTRAINED))
    grids = {"0": stage.grid({Variant(False, stage.at): free})}
    grids |= {str(d): stage.grid({Variant(True, stage.at, d): gated}) for d in wanted}
    add_dimensions(report, stage.run(grids, "dimensions"), stage.tracked_persons)


def _limbs(report: Report, stage: _Stage, tunings: dict[str, Tuning]) -> None:
    """Compare kinds of limbs, each with settings of its own, chosen as those of the others were."""
    rectangles = {
        f"{v.label}, rectangles": v
        for v in (stage.variant(c, stage.at, "rectangles") for c in (True, False))
    }
    found = stage.settings(rectangles)
    grids = {
        "cylinders": stage.grid(stage.both(tunings, stage.at)),
        "rectangles": stage.grid({v: found[name].setting for name, v in rectangles.items()}),
    }
    add_limb_shapes(report, stage.run(grids, "limbs"))
    tunings |= found


def _occlusion(report: Report, stage: _Stage, tunings: dict[str, Tuning]) -> None:
    """Add Figure 5: the same persons from the side."""
    from benchmarks.bend.pictures import plot_hidden_arm, plot_predictions

    side = replace(stage.conditions, azimuths=(SIDE,))
    seen = [
        replace(t, tests=(view_of(t.body, t.split.test[0], side),)) for t in stage.tracked_persons
    ]
    settings = stage.both(tunings, stage.at)
    common = (settings, stage.out, stage.seeds, stage.progress)
    given, runs = hidden_arms(seen, *common)
    lost, _ = hidden_arms([with_lost_arm(t) for t in seen], *common)
    add_occlusion(report, given, lost, FPS)
    panels = [(arm.name, arm.visible, _both(arm.far, arm.near)) for arm in given[:3]]
    add_picture(report, stage.out, "hidden-arm.png", plot_hidden_arm(panels, FPS))
    panels = [(arm.name, arm.visible, _both(arm.far, arm.near)) for arm in lost[:3]]
    figure = plot_hidden_arm(panels, FPS, "An arm that is lost at first")
    add_picture(report, stage.out, "lost-arm.png", figure)
    view = seen[0].tests[0]
    shown = [int(s * (len(view.clip) - 1)) for s in (0.1, 0.3, 0.5, 0.7, 0.9)]
    drawn = {
        label: [seen[0].body.joints(own.runs[0].mean[t].double())[None] for t in shown]
        for (label,), own in runs.where(subject=given[0].name).by("method").items()
    }
    title = "Estimates from the side: left arm blue, right arm orange"
    figure = plot_predictions(view, shown, drawn, title, arms=True)
    add_picture(report, stage.out, "estimates.png", figure)


def _actions(report: Report, stage: _Stage, tunings: dict[str, Tuning]) -> None:
    """Add the recognition of actions, from recorded joints and from silhouettes."""
    there = {clip.action for clip in stage.clips}
    names = [n for n in (*bend_actions.KNOWN, *bend_actions.OTHERS) if n in there]
    library = action_clips(stage.clips, names)
    performed = bend_actions.perform_actions(library, stage.centres, stage.progress)
    setting, shares = bend_actions.choose_bank(stage.judges, performed, library)
    banks, found = {}, []
    for tracked in tqdm(stage.tracked_persons, disable=not stage.progress, desc="recognition"):
        person = tracked.split.person
        spaces = bend_actions.make_spaces(tracked, performed)
        banks[person] = bend_actions.make_bank(spaces, setting)
        recordings = bend_actions.postures_of(tracked, library)
        found += bend_actions.recognise_recorded(person, banks[person], recordings)
    columns = next(iter(banks.values())).names
    bend_actions.add_confusion(report, "actions", "Actions from recorded joints", found, columns)
    report.settings["bank"] = setting._asdict()
    report.settings["persons of the tracked actions"] = list(banks)[:_TRACKED]
    report.settings["right frames on the validation, by dimensions, spread and background"] = {
        ", ".join(f"{x:g}" for x in one): round(share, 3) for one, share in shares.items()
    }
    frames = 8 if stage.quick else len(stage.tracked_persons[0].tests[0].clip)
    runs = bend_actions.track_actions(
        stage.tracked_persons[:_TRACKED], banks, performed, library, stage.conditions,
        tunings[CONSTRAINED].setting, tunings[FIRST_ORDER].setting, stage.out,
        particles=stage.at, frames=frames, seeds=stage.seeds[:1], progress=stage.progress,
    )  # fmt: skip
    decisions = bend_actions.tracked_decisions(runs, banks)
    title = "Actions from one camera's silhouettes"
    bend_actions.add_confusion(report, "tracked_actions", title, decisions, columns)
    bend_actions.add_release(report, runs)


_RUNNERS: dict[str, Callable[[Report, _Stage, dict[str, Tuning]], None]] = {
    "particles": _particles,
    "dimensions": _dimensions,
    "limbs": _limbs,
    "occlusion": _occlusion,
    "actions": _actions,
}


def _both(
    far: Mapping[str, Tensor], near: Mapping[str, Tensor]
) -> dict[str, tuple[Tensor, Tensor]]:
    return {label: (far[label], near[label]) for label in far}


# --- what the arguments mean ----------------------------------------------------------------------


def _parts(part: str) -> tuple[str, ...]:
    if part == "all":
        return PARTS
    if part not in PARTS:
        raise InputError(f"--part takes {', '.join(PARTS)} or all; got {part!r}")
    return (part,)


def _numbers(name: str, given: Sequence[int]) -> list[int]:
    found = sorted(set(given))
    if not found or found[0] < 1:
        raise InputError(f"--{name} must be one whole number or more, got {list(given)}")
    return found


def _persons(
    clips: Sequence[MocapClip], testers: Sequence[str], judges: Sequence[str], quick: bool
) -> tuple[list[str], list[str]]:
    """Return the tracked persons, and those whose clips choose the settings."""
    everybody = list(select_persons(clips, ()))
    if len(everybody) < 3:
        raise InputError(
            "somebody is tracked, somebody chooses the settings, and others train: expected three "
            f"persons or more, got {', '.join(everybody)}"
        )
    chosen = (
        list(select_persons(clips, judges)) if judges else everybody[max(1, len(everybody) - 2) :]
    )
    if testers:
        tracked = list(select_persons(clips, testers))
    else:
        tracked = [person for person in everybody if person not in chosen]
    both = [person for person in tracked if person in chosen]
    if both or not tracked:
        raise InputError(
            f"persons are tracked or choose the settings, not both: {', '.join(both) or 'nobody left'}; "
            "name others with --validation-persons"
        )
    return (tracked[:1], chosen[:1]) if quick else (tracked, chosen)
