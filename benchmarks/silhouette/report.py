"""Reports of the protocol Silhouette: of one condition with all its tables, or of several in a row."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from benchmarks.bodies.clips import Split
from benchmarks.bodies.pictures import plot_errors_by_part, plot_errors_by_time, plot_silhouettes
from benchmarks.bodies.tracking import PARTS, PUBLISHED_SURVIVAL, csv_columns, drift, part_error
from benchmarks.bodies.views import SEEN, Subject, subjects_of
from benchmarks.engine import (
    Results,
    Setting,
    Tuning,
    bootstrap,
    describe,
    mean,
    mean_of,
    pivot,
    plot_by_condition,
    pooled_std,
    spread,
    write_csv,
)
from benchmarks.engine.statistics import Cell
from benchmarks.silhouette.filters import SilhouettePerson, label_of
from torchpose.evaluation import Report
from torchpose.evaluation._trials import add_picture

_WHOLE, _ARMS = part_error(), part_error("arms")


class Case(NamedTuple):
    """One number of particles and one size of silhouettes.

    Attributes:
        n_particles: likelihoods a frame. size: of the silhouettes, such as 160x120.
        tracked_persons: who is tracked. tunings: by method.
    """

    n_particles: int
    size: str
    tracked_persons: Sequence[SilhouettePerson]
    tunings: Mapping[str, Tuning]


def fill_one(report: Report, case: Case, runs: Results, out: Path, fps: float) -> None:
    """Add all tables, findings and pictures of one condition, and write runs.csv."""
    _add_errors(report, runs)
    _add_parts(report, runs)
    _add_pooled(report, runs, fps)
    if _comparable(runs):
        _add_differences(report, runs)
        report.findings += _order(runs)
    _add_tuning(report, case.tunings)
    _add_sequences(report, case.tracked_persons)
    write_csv(out / "runs.csv", runs, csv_columns(fps))
    add_picture(report, out, "error-over-time.png", plot_errors_by_time(runs, fps, label=label_of))
    add_picture(report, out, "error-by-part.png", plot_errors_by_part(runs, label_of))
    name, subject = next(iter(subjects_of(case.tracked_persons).items()))
    last = runs.names("method")[-1]
    shown = [(label_of(last), runs.where(subject=name, method=last).runs[0])]
    title = f"{name}: silhouettes and estimates"
    figure = plot_silhouettes(subject, shown, n_frames=6, title=title)
    add_picture(report, out, "silhouettes.png", figure)


def fill_several(
    report: Report, cases: Mapping[str, Case], runs: Results, out: Path, fps: float
) -> None:
    """Add errors over particles or sizes, and the tables of each; write a runs-....csv for each.

    Args:
        cases: by the names of the conditions of `runs`.
    """
    texts = {"{}": mean(_WHOLE), "± {}": spread(_WHOLE), "arms {}": mean(_ARMS)}
    pivot(
        report, "conditions", "Error (mm) over all sequences by condition", runs, ["condition"],
        {**texts, "ms {}": _milliseconds}, columns="method", label=label_of,
        note="±: standard deviation over seeds, pooled over sequences. Arms: error of elbows and "
        "wrists (mm). ms: of a frame of one run of a batch of seeds.",
    )  # fmt: skip
    given = not any(t.tried for case in cases.values() for t in case.tunings.values())
    for name, case in cases.items():
        own = runs.where(condition=name)
        if _comparable(own):
            _add_differences(report, own, name)
            report.findings += [f"{name}: {text}" for text in _order(own)]
        if not given:
            _add_tuning(report, case.tunings, name)
        write_csv(out / f"runs-{case.n_particles}-{case.size}.csv", own, csv_columns(fps))
    if given:  # the same everywhere
        _add_tuning(report, next(iter(cases.values())).tunings)
    for name in cases:
        _add_errors(report, runs.where(condition=name), name)
    for size, case in {case.size: case for case in cases.values()}.items():
        _add_sequences(report, case.tracked_persons, size)
    figure = plot_by_condition(runs, {"error (mm)": _WHOLE}, "Error by condition", label=label_of)
    add_picture(report, out, "error-by-condition.png", figure)


# --- tables ---------------------------------------------------------------------------------------


def _milliseconds(runs: Results) -> float:
    return 1000 * float(torch.cat([run.seconds for run in runs.runs]).mean())


def _add_errors(report: Report, runs: Results, condition: str = "") -> None:
    """Add the mean error of every sequence, and its standard deviation over seeds."""
    title = "Error (mm) of the joints, mean over joints, frames and seeds"
    pivot(
        report, f"errors, {condition}" if condition else "errors",
        f"{condition}: {title[0].lower()}{title[1:]}" if condition else title,
        runs, ["subject"], {"{}": mean(_WHOLE), "± {}": spread(_WHOLE)}, columns="method",
        total="all", label=label_of,
        note="±: standard deviation over seeds; in the last row pooled over sequences.",
    )  # fmt: skip


def _add_parts(report: Report, runs: Results) -> None:
    """Add the same by part of the body."""
    cells: dict[str, Cell] = {}
    for part in PARTS:
        cells |= {part: mean(part_error(part)), f"± {part}": spread(part_error(part))}
    pivot(
        report, "parts", "Error (mm) by part of the body, mean over frames and seeds", runs,
        ["subject", "method"], cells, total="all", label=label_of,
        note="; ".join(f"{part}: {_text(names)}" for part, names in PARTS.items()),
    )  # fmt: skip


def _text(names: Sequence[str]) -> str:
    return ", ".join(dict.fromkeys(n.replace("left_", "").replace("right_", "") for n in names))


def _add_pooled(report: Report, runs: Results, fps: float) -> None:
    """Add a row for each method: spread, drift, how often it had nothing to go by, time."""

    slopes = {
        method: bootstrap(mean_of, own.values(drift(fps)))
        for (method,), own in runs.by("method").items()
    }

    def share(flag: str) -> Cell:
        return lambda own: (
            100 * float(torch.cat([getattr(run, flag) for run in own.runs]).double().mean())
        )

    def slope(part: int) -> Cell:
        return lambda own: slopes[own.names("method")[0]][part]

    cells = {
        "error (mm)": mean(_WHOLE), "± seeds": spread(_WHOLE),
        "drift (mm/s)": slope(0), "from": slope(1), "to": slope(2),
        "coasting (%)": share("coasting"), "respread (%)": share("respread"),
        "ms per frame": _milliseconds,
    }  # fmt: skip
    table = pivot(
        report, "pooled", "Methods over all sequences", runs, ["method"], cells, label=label_of,
        digits=(1, 1, 2, 2, 2, 1, 1, 1),
        note="Drift: slope of the error over time, without the first half second, since runs start at "
        "the true pose; with the 95 % interval of a bootstrap over sequences and seeds. Time: of one "
        "run of a batch of seeds.",
    )  # fmt: skip
    for method, (middle, low, high) in slopes.items():
        label = label_of(method)
        deviation = f"standard deviation over seeds {table[label, '± seeds']:.1f} mm"
        if len(runs.names("seed")) == 1:
            deviation = "one seed"
        report.findings.append(
            f"{label}: {table[label, 'error (mm)']:.1f} mm, {deviation}; the error changes by "
            f"{middle:+.1f} mm per second ({low:+.1f} to {high:+.1f})."
        )


def _comparable(runs: Results) -> bool:
    """Return whether there is a method with a manifold and one without."""
    names = runs.names("method")
    return any(name.startswith("mrpf") for name in names) and bool({"sir", "apf"} & {*names})


def _add_differences(report: Report, runs: Results, condition: str = "") -> None:
    """Add the differences of the manifold's methods from the others, with intervals.

    Args:
        condition: of the runs, where a report has several; before the names of the rows.
    """
    table = report.get("differences") or report.table(
        "differences", "Differences (mm) with the 95 % intervals of a bootstrap",
        ["mean", "from", "to", "arms", "from ", "to ", "± seeds", "from  ", "to  "],
        note="Below zero is for the first. Drawn again are sequences and seeds.",
    )  # fmt: skip
    methods = {method: own for (method,), own in runs.by("method").items()}
    for method in [m for m in methods if m.startswith("mrpf")]:
        for other in [m for m in ("sir", "apf") if m in methods]:
            one, two = methods[method], methods[other]
            whole = one.values(_WHOLE), two.values(_WHOLE)
            arms = one.values(_ARMS), two.values(_ARMS)
            nothing = (float("nan"),) * 3
            stds = bootstrap(pooled_std, *whole) if whole[0].shape[1] > 1 else nothing
            cells = [*bootstrap(mean_of, *whole), *bootstrap(mean_of, *arms), *stds]
            name = f"{label_of(method)} - {label_of(other)}"
            table.add(f"{condition}: {name}" if condition else name, cells)


def _order(runs: Results) -> list[str]:
    """Return sentences on whether the order of the paper's tables appears."""
    if not {"sir", "apf", "mrpf"} <= {*runs.names("method")}:
        return []
    found = []
    for measure, what in ((_WHOLE, "the whole body"), (_ARMS, "arms")):
        error = {name: mean(measure)(runs.where(method=name)) for name in ("sir", "apf", "mrpf")}
        best = error["mrpf"] < min(error["sir"], error["apf"])
        found.append(
            f"The paper's order {'appears' if best else 'does NOT appear'} for {what}: MRPF "
            f"{error['mrpf']:.1f} mm, SIR {error['sir']:.1f} mm, APF {error['apf']:.1f} mm."
        )
    return found


def _add_tuning(report: Report, tunings: Mapping[str, Tuning], condition: str = "") -> None:
    """Add the settings of every method, chosen by validation or given.

    Args:
        condition: of the runs, where a report has several; before the names of the rows.
    """
    given = not any(found.tried for found in tunings.values())
    title = "What validation clips chose: the setting with the smallest error"
    table = report.get("tuning") or report.table(
        "tuning", "Settings as given, without validation" if given else title,
        ["chosen", "diffusion", "error (mm)", "as published (mm)", "tried: value x diffusion, error"],
        digits=(2, 1, 1, 1, 0),
        note="Chosen: the sharpness of the likelihood for SIR and MRPF, 1 as published; the survival "
        "rate of a layer for APF, 0.5 as published, since its sharpness would cancel. Diffusion: "
        "factor of sigma x->x, 1 being the motion of the validation clips. First the diffusion is "
        "chosen, then the other; the same number of settings, clips and seeds for all. As "
        "published: the published value at the chosen diffusion.",
    )  # fmt: skip
    for method, found in tunings.items():
        published = Setting(PUBLISHED_SURVIVAL if method == "apf" else 1.0, found.setting.scale)
        label = label_of(method)
        table.add(
            f"{condition}: {label}" if condition else label,
            [*found.setting, found.error, found.error_of(published), found.text()],
        )


def _add_sequences(
    report: Report, tracked_persons: Sequence[SilhouettePerson], condition: str = ""
) -> None:
    """Add the sequences, and how near the tracker's body can come to what the cameras see.

    Args:
        condition: of the silhouettes, where a report has several; a part of the table's name.
    """
    name = f"sequences, {condition}" if condition else "sequences"

    def frames(part: str) -> Callable[[Subject[SilhouettePerson]], int]:
        return lambda subject: sum(map(len, getattr(subject.person.split, part)))

    describe(
        report, name, name.capitalize(), subjects_of(tracked_persons),
        {
            "frames": lambda subject: len(subject.view.clip),
            "manifold frames": frames("manifold"), "validation frames": frames("validation"),
            "own manifold": lambda subject: _manifold_of(subject.person.split), **SEEN,
        },
        digits=(0, 0, 0, 0, 1, 2, 1),
        note="Nearest state: error of the tracker's body fitted to the true joints, below which no "
        "tracker comes but by chance. Overlap: intersection over union of that body's silhouettes "
        "with those that are tracked. In view: joints within the image of the worst camera.",
    )  # fmt: skip


def _manifold_of(split: Split) -> str:
    """Return "yes" if the manifold is the person's own, else "no", and its action if that is another one."""
    actions = " ".join(dict.fromkeys(clip.action for clip in split.manifold))
    other = actions not in {clip.action for clip in split.test}
    return ("yes" if split.seen else "no") + (f", of {actions}" if other else "")
