"""Leave one person out: each person of some recordings, tracked by a prior of all the others.

Camera, noise, measured joints and error are those of UB-people. The recipe is refitted for every
person, with its calibration, so that the mean over persons says what to expect of the next one.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from torchpose._core.checks import check_count
from torchpose._core.files import check_output_folder
from torchpose._core.wording import counted
from torchpose.errors import InputError
from torchpose.evaluation._person_recordings import (
    POSE_CLASSES,
    by_person,
    read_known_persons,
    spread,
)
from torchpose.evaluation._person_tables import (
    add_persons,
    add_pose_classes,
    class_error,
    plot_persons,
)
from torchpose.evaluation._report import Report
from torchpose.evaluation._trials import Recipe, draw_picture
from torchpose.evaluation._unseen import Job, Scored, ScoreSettings, fit_settings, pooled, run_jobs
from torchpose.learning._curation.splits import check_kinds, refuse_shared_between_persons
from torchpose.learning._recipes.upper_body import fit_kinect_prior


def run(
    data: Sequence[str | Path] | str | Path,
    out: str | Path,
    *,
    seed: int = 0,
    progress: bool = True,
    quick: bool = False,
    n_components: int | None = None,
    window_components: int | None = None,
    window_samples: int | None = None,
    calibration_folds: int = 6,
    every: int = 1,
    curate: bool = True,
    workers: int = 1,
    fits: str | None = None,
    recipe: Recipe = fit_kinect_prior,
) -> Report:
    """Run the protocol; writes report.json, report.md and a picture to `out`.

    Args:
        data: folders or files with recordings of two persons or more. out: folder for the results.
        seed: the seed of priors and noise. progress: whether to show bars.
        quick: small priors and a tenth of the sequences, to see that all of it works.
        n_components: the number of Gaussians per arm over poses; by default that of the recipe.
        window_components: the number of Gaussians per arm over windows; by default that of the recipe.
        window_samples: the number of training windows; by default that of the recipe.
        calibration_folds: the number of folds of the calibration; 0 leaves covariances uncalibrated.
        every: track only each n-th sequence of a person.
        curate: leave out of recordings what jumps or is no body, as `torchpose fit` does, and say so.
        workers: the number of processes.
        fits: the folder of fitted priors, to share them with other protocols; by default that of
            the results.
        recipe: fits the priors.

    Raises:
        InputError: no such data, one person alone, or settings out of range. OverlapError: one
            recording under two persons. PriorError: hands beside wrists. OutputError: `out` cannot be
            written.
    """
    check_count("every", every)
    check_count("workers", workers)
    out = check_output_folder(out)
    recordings, notes = read_known_persons(data, curate)
    persons = by_person(recordings)
    if len(persons) < 2:
        raise InputError(
            f"expected recordings of two persons or more, got {len(recordings)} of "
            f"{', '.join(persons)}; add a folder with those of others"
        )
    refuse_shared_between_persons(recordings)
    check_kinds(recordings)
    settings = fit_settings(
        "leave-one-person-out", seed, quick, n_components, window_components, window_samples,
        calibration_folds,
    )  # fmt: skip
    scoring = ScoreSettings(seed=seed, every=max(every, 10) if quick else every)
    thin = 5 if quick else 1
    others = {
        name: [r for other, group in persons.items() if other != name for r in group[::thin]]
        for name in persons
    }
    jobs = [
        Job(name, others[name], {name: group}, settings, recipe, scoring)
        for name, group in persons.items()
    ]
    found = run_jobs(jobs, check_output_folder(fits or out), workers, progress)
    scored = {name: result[name] for name, result in zip(persons, found, strict=True)}
    report = Report("Leave one person out", settings | {
        "quick": quick, "every": scoring.every, "curate": curate, "recipe": recipe.__qualname__,
        "persons": {name: counted(len(group), "recording") for name, group in persons.items()},
        "threads": torch.get_num_threads(), "workers": workers,
    })  # fmt: skip
    table = add_persons(report, scored)
    if settings["calibration_folds"] < 2:
        table.note += " The covariances are not calibrated."
    add_pose_classes(report, {"all": pooled(list(scored.values()))})
    _add_findings(report, scored)
    report.findings += notes
    title = "3D error of each person under a prior of the others"
    draw_picture(report, out, "persons.png", lambda: plot_persons(scored, title))
    report.save(out)
    return report


def _add_findings(report: Report, scored: dict[str, Scored]) -> None:
    table: Any = report["persons"]
    names = list(scored)

    def numbers(column: str) -> list[float]:
        return [float(table[name, column]) for name in names]

    (mean, wide), (late, late_wide) = spread(numbers("filtered")), spread(numbers("smoothed"))
    worst = max(names, key=lambda name: float(table[name, "filtered"]))
    best = min(names, key=lambda name: float(table[name, "filtered"]))
    report.findings.append(
        f"Over {len(names)} persons: {mean:.2f} ± {wide:.2f} cm filtered, {late:.2f} ± "
        f"{late_wide:.2f} cm smoothed (standard deviation over persons; that of the mean is "
        f"{wide / len(names) ** 0.5:.2f}). Best {best} with {table[best, 'filtered']:.2f}, worst "
        f"{worst} with {table[worst, 'filtered']:.2f}. The mean poses of the priors are "
        f"{spread(numbers('mean pose'))[0]:.2f} cm off."
    )
    parts = [
        f"{column[3:]}: {spread(numbers(column))[0]:.0f} ± {spread(numbers(column))[1]:.0f} %"
        for column in ("in 50 %", "in 90 %")
    ]
    report.findings.append(f"Inside the ellipsoids, mean and spread over persons: {parts[0]}, "
                           f"{parts[1]}.")  # fmt: skip
    everybody = pooled(list(scored.values()))
    errors = {name: class_error(everybody, name) for name in POSE_CLASSES}
    costs = ", ".join(f"{name} {error:.1f}" for name, error in errors.items() if error == error)
    report.findings.append(f"Hand and elbow, in cm by what the arm does: {costs}.")
