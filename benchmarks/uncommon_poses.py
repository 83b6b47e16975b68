"""Errors on uncommon poses: UB-people, with training recordings of raised arms left out.

Three priors of the training persons of UB-people: one of all their recordings, one without those in
which an arm is raised for long, and one without as many frames of recordings drawn at random, so
that what is missing can be told from how much is missing. All of them track the test persons.
"""

import random
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from benchmarks.ub_people import people
from torchpose._core.files import check_output_folder
from torchpose.errors import InputError
from torchpose.evaluation import Report
from torchpose.evaluation._person_recordings import POSE_CLASSES, by_person, pose_classes
from torchpose.evaluation._person_tables import (
    add_pose_classes,
    class_error,
    mean_error,
)
from torchpose.evaluation._trials import Recipe, add_picture
from torchpose.evaluation._unseen import Job, Scored, ScoreSettings, fit_settings, pooled, run_jobs
from torchpose.io import Recording
from torchpose.learning import fit_kinect_prior


def run(
    data: str | Path,
    out: str | Path,
    *,
    seed: int = 0,
    progress: bool = True,
    quick: bool = False,
    raised: float = 0.1,
    n_components: int | None = None,
    window_components: int | None = None,
    window_samples: int | None = None,
    every: int = 1,
    workers: int = 1,
    fits: str | None = None,
    recipe: Recipe = fit_kinect_prior,
) -> Report:
    """Run the protocol; writes report.json, report.md and a picture to `out`.

    Args:
        data: folder kinect_utd_mhad, or the one it is in. out: folder for the results.
        seed: of priors, noise and the recordings that are left out at random.
        progress: whether to show bars. quick: small priors and few sequences.
        raised: recordings with a hand above its shoulder in more than this share of their frames are
            left out.
        n_components: Gaussians per arm over poses; this and the next two as the recipe has them if
            None.
        window_components: Gaussians per arm over windows. window_samples: training windows.
        every: only each n-th sequence of a person is tracked. workers: processes.
        fits: folder of fitted priors, to share them with other protocols; `out` if None.
        recipe: fits the priors.

    Raises:
        InputError: no such data, or nothing left to train on. OutputError: `out` cannot be written.
    """
    out = check_output_folder(out)
    train, tested = people(data, quick)
    persons = by_person(tested)
    settings = fit_settings(
        "uncommon-poses", seed, quick, n_components, window_components, window_samples, 0
    )
    sets = {"all recordings": train} | without_raised(train, raised, seed)
    scoring = ScoreSettings(seed=seed, every=every)
    jobs = [Job(name, part, persons, settings, recipe, scoring) for name, part in sets.items()]
    found = run_jobs(jobs, check_output_folder(fits or out), workers, progress)
    scored = {name: pooled(list(result.values())) for name, result in zip(sets, found, strict=True)}
    report = Report("What uncommon poses cost", settings | {
        "quick": quick, "every": every, "recipe": recipe.__qualname__, "raised": raised,
        "training": {name: f"{len(part)} recordings, {sum(map(len, part))} frames"
                     for name, part in sets.items()},
        "test": f"{', '.join(persons)}, {len(scored['all recordings'].filtered)} frames",
        "threads": torch.get_num_threads(),
    })  # fmt: skip
    table = report.table(
        "errors", "3D error after Procrustes (cm), by training recordings",
        ["recordings", "frames", "filtered", "smoothed", "log-lik."], digits=(0, 0, 2, 2, 2),
    )  # fmt: skip
    for name, part in sets.items():
        s = scored[name]
        errors = mean_error(s), mean_error(s, "smoothed")
        table.add(name, [len(part), sum(map(len, part)), *errors, float(s.log_likelihood.mean())])
    add_pose_classes(report, scored)
    whole, without, control = (class_error(s, "raised") for s in scored.values())
    report.findings.append(
        f"Raised arms: {whole:.1f} cm at hand and elbow with all recordings, {without:.1f} cm when "
        f"none in training are raised for long, {control:.1f} cm when as many other frames are "
        "missing."
    )
    title = "Hands and elbows, by what the arm does and what the prior was fitted to"
    add_picture(report, out, "uncommon-poses.png", plot_pose_classes(scored, title))
    report.save(out)
    return report


def plot_pose_classes(groups: Mapping[str, Scored], title: str) -> Any:
    """Draw the error of hands and elbows by what the arm does, a bar for each group."""
    from matplotlib.patches import Patch

    from torchpose.viz._style import add_legend, method_styles, new_figure, style_axes

    figure = new_figure(7.6, 3.9, title)
    ax = style_axes(figure.add_subplot(), y="mean error of hand and elbow (cm)")
    ax.grid(False, axis="x")
    styles = method_styles(list(groups))
    width = 0.8 / len(groups)
    entries = []
    for i, (group, scored) in enumerate(groups.items()):
        values = [class_error(scored, name) for name in POSE_CLASSES]
        place = torch.arange(len(values)).double().numpy() - 0.4 + (i + 0.5) * width
        ax.bar(place, values, 0.9 * width, color=styles[group]["color"], alpha=0.85)
        entries.append(Patch(color=styles[group]["color"], alpha=0.85, label=group))
    shares = [
        100 * float((next(iter(groups.values())).classes == i).double().mean())
        for i in range(len(POSE_CLASSES))
    ]
    labels = [f"{name}\n{share:.0f} %" for name, share in zip(POSE_CLASSES, shares, strict=True)]
    ax.set_xticks(range(len(POSE_CLASSES)), labels)
    ax.set_ylim(bottom=0)
    add_legend(figure, entries)
    return figure


def raised_share(recording: Recording) -> float:
    """Return the share of the frames in which a hand is above its shoulder."""
    classes = pose_classes(recording.upper_body().joints.double())
    return float((classes == POSE_CLASSES.index("raised")).any(1).double().mean())


def without_raised(
    recordings: Sequence[Recording], share: float = 0.1, seed: int = 0
) -> dict[str, list[Recording]]:
    """Return recordings without those of raised arms, and without as many frames drawn at random.

    Args:
        recordings: to train on. share: of frames with a hand above its shoulder, above which a
            recording is left out. seed: of the draw.

    Raises:
        InputError: nothing is left, or nothing was left out.
    """
    kept = [r for r in recordings if raised_share(r) <= share]
    if len(kept) in (0, len(recordings)):
        raise InputError(
            f"{len(recordings) - len(kept)} of {len(recordings)} recordings have raised arms in more "
            f"than {share:.0%} of their frames; expected some, and others: choose another --raised"
        )
    order = list(range(len(recordings)))
    random.Random(seed).shuffle(order)
    wanted, chosen = sum(map(len, kept)), []
    for index in order:
        if wanted <= 0:
            break
        chosen.append(index)
        wanted -= len(recordings[index])
    control = [recordings[index] for index in sorted(chosen)]
    return {"no raised arms": kept, "as many at random": control}


if __name__ == "__main__":
    from benchmarks._protocols import run_protocol

    run_protocol("uncommon_poses")
