"""Every tracker with its defaults and the recipes of the shipped priors, on persons never seen.

UB-people (prior of s1 to s6, every n-th sequence of s7 and s8) and UB-one (prior of the first 60 % of
one recording, the first frames of the rest), each with the number of components of kinect-upper-body
and of kinect-upper-body-small. Every method of `torchpose.upper_body.METHODS` runs with its defaults,
beside the mean pose of the training persons. What was fitted and tracked is kept in the folder, so that
a run that was stopped goes on.

    python -m benchmarks.all_trackers --data DIR --out DIR
    python -m benchmarks.all_trackers --data DIR --out DIR --every 12 --frames 300 --windows false
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor

from benchmarks._command import OneOf, run_command
from benchmarks._upper_body import (
    MADE_WITH,
    Tracker,
    generators_of,
    projected_training_poses,
    score,
    tracker_facts,
    trials_of,
    with_bones,
)
from benchmarks.engine import Experiment, Grid
from benchmarks.ub_one import split_recording
from benchmarks.ub_people import TEST_PERSONS, mean_pose, people
from torchpose._core.files import check_output_folder
from torchpose.evaluation import Report
from torchpose.evaluation._trials import CAMERA, MEASURED, Estimate, Trials, cached_prior
from torchpose.io import Recording
from torchpose.io._recordings import cut_recording
from torchpose.learning import fit_kinect_prior
from torchpose.priors import UpperBodyPrior
from torchpose.upper_body import METHODS, UpperBodyTracker, method_options

RECIPES: dict[str, dict[str, Any]] = {
    "kinect-upper-body": {"n_components": 30},
    "kinect-upper-body-small": {"n_components": 10, "window_components": 48},
}
WINDOWS = "window-mixture"
UB_PEOPLE, UB_ONE = "UB-people", "UB-one"


class Options(NamedTuple):
    """What is compared.

    Attributes:
        data: folder of the recordings.
        out: folder for what is kept, and the report.
        every: take every n-th sequence of UB-people.
        frames: frames of UB-one (0: all).
        particles: of each particle filter.
        windows: fit windows as well.
        folds: of the calibration (default the recipe's).
        recipes: of the priors that are fitted.
        protocols: which test sets.
        progress: show bars.
    """

    data: Path
    out: Path
    every: int = 1
    frames: int = 0
    particles: int = 10_000
    windows: bool = True
    folds: int | None = None
    recipes: Annotated[Sequence[str], OneOf(RECIPES)] = tuple(RECIPES)
    protocols: Annotated[Sequence[str], OneOf((UB_PEOPLE, UB_ONE))] = (UB_PEOPLE, UB_ONE)
    progress: bool = False


class Run(NamedTuple):
    """Poses and sample sizes of a method: as `Estimate`, and [B, T, 2]."""

    joints2d: Tensor
    joints3d: Tensor
    covariance3d: Tensor
    effective_sample_size: Tensor


def track(test: Trials, tracker: Tracker, seeds: Sequence[int]) -> list[Run]:
    """Track a test set once for every seed."""
    prior, options = tracker
    model = UpperBodyTracker(
        prior, CAMERA, fps=test.fps, neck=prior.info.neck, max_gap=None, **options
    )
    found = []
    for seed in seeds:
        with torch.inference_mode():
            poses = model(
                test.keypoints, names=MEASURED, lengths=test.lengths,
                generator=generators_of(test, seed),
            )  # fmt: skip
        found.append(Run(*(getattr(poses, name) for name in Run._fields)))
    return found


TRACKING = Experiment(
    Run,
    track,
    tracker_facts,
    (*MADE_WITH, "benchmarks/_upper_body.py", "benchmarks/all_trackers.py"),
)


def can_run(method: str, prior: UpperBodyPrior, bones: dict[str, Any] | None) -> bool:
    """Return whether a method finds all that it needs: windows of the prior, a prior over arms."""
    of_windows = method in (WINDOWS, "multiple-model")
    return (bool(prior.windows) or not of_windows) and (
        bones is not None or "arms" not in method_options(method)
    )


def options_of(method: str, particles: int, bones: dict[str, Any] | None) -> dict[str, Any]:
    """Return the options of a method, with the particles if it draws any, and its prior over arms.

    Args:
        method: whose. particles: number of them. bones: of `with_bones`.
    """
    known = method_options(method)
    given = (bones or {}) | {"n_particles": particles}
    return {name: value for name, value in given.items() if name in known} | {"method": method}


def ub_people(options: Options) -> tuple[list[Recording], Trials]:
    """Return training recordings and test set: some sequences of persons never seen."""
    train, tested = people(options.data)
    tested = tested[:: options.every]
    return train, trials_of(tested)


def ub_one(options: Options) -> tuple[list[Recording], Trials]:
    """Return the first part of the authors' own recording, and frames of the rest."""
    first, rest = split_recording(options.data)
    return [first], trials_of([cut_recording(rest, 0, options.frames or None)])


PROTOCOLS: dict[str, Callable[[Options], tuple[list[Recording], Trials]]] = {
    UB_PEOPLE: ub_people,
    UB_ONE: ub_one,
}


def compare(
    name: str, recordings: list[Recording], test: Trials, report: Report, options: Options
) -> None:
    """Add a table for each recipe: error, coverage and sample size of every method."""
    unseen = TEST_PERSONS if name == UB_PEOPLE else [r.person for r in recordings]
    bones = with_bones(options.data, unseen)
    still = mean_pose(test, *projected_training_poses(recordings, CAMERA, 20_000))
    for recipe in options.recipes:
        settings = RECIPES[recipe]
        if options.folds is not None:
            settings = settings | {"calibration_folds": options.folds}
        if not options.windows:
            settings = settings | {"window_components": 0}
        prior = cached_prior(
            options.out,
            recordings,
            fit_kinect_prior,
            options.progress,
            seed=0,
            name=name,
            **settings,
        )
        table = report.table(
            f"{name} {recipe}",
            f"{name}, recipe of {recipe}: {len(test.lengths)} sequences, {int(test.lengths.sum())} frames",
            ["3D (cm)", "2D (pixels)", "inside 50 %", "inside 90 %", "sample size, median", "below 2 (%)",
             "lost frames"],
            digits=(2, 1, 0, 0, 1, 0, 0),
        )  # fmt: skip
        methods = [m for m in METHODS if can_run(m, prior, bones)]
        trackers = {m: Tracker(prior, options_of(m, options.particles, bones)) for m in methods}
        grid = Grid({name: test}, trackers)
        runs = TRACKING.run(
            {recipe: grid}, (0,), options.out, progress=options.progress, title=name
        )
        for (method,), own in runs.by("method").items():
            table.add(method, row(own.runs[0], test))
        found = score(still, test)
        nothing = [None] * 5
        table.add(
            "mean pose",
            [found.mean_error, float(found.errors2d.nanmean()), *nothing],
        )
        add_finding(report, f"{name} {recipe}")


def row(run: Run, test: Trials) -> list[float | None]:
    """Return the numbers of a method."""
    found = score(Estimate(*run[:3]), test)
    if found.coverage is None:
        raise RuntimeError("a track has covariances")
    inside = [100 * float(x) for x in found.coverage.overall]
    size = run.effective_sample_size[test.inside]
    lost = float(run.joints3d[test.inside].isnan().flatten(1).any(1).sum())
    return [
        found.mean_error, float(found.errors2d.nanmean()), *inside,
        float(size.nanmedian()), 100 * float((size < 2).double().mean()), lost,
    ]  # fmt: skip


def add_finding(report: Report, key: str) -> None:
    """Add a finding: the methods that are no better than the mean pose."""
    table = report[key]
    still = float(table["mean pose", "3D (cm)"])
    behind = [m for m in METHODS if m in table.rows and not float(table[m, "3D (cm)"]) < still]
    said = f"behind it: {', '.join(behind)}" if behind else "every tracker is ahead of it"
    report.findings.append(f"{table.title.partition(':')[0]}: mean pose {still:.2f} cm, {said}.")


def main(options: Options) -> None:
    """Fit, track and write the report."""
    options = options._replace(out=check_output_folder(options.out))
    shown = ("every", "frames", "particles", "windows", "folds", "recipes", "protocols")
    report = Report("All trackers", {name: getattr(options, name) for name in shown})
    for name in options.protocols:
        compare(name, *PROTOCOLS[name](options), report, options)
    report.save(options.out)
    print((options.out / "report.md").read_text())


if __name__ == "__main__":
    run_command(main)
