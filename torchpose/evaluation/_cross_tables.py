"""Tables, findings and picture of the protocol across data sets."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch

from torchpose.evaluation._person_recordings import spread
from torchpose.evaluation._person_tables import (
    SHORT_NAMES,
    TRACKED,
    add_pose_classes,
    mean_error,
)
from torchpose.evaluation._report import Report
from torchpose.evaluation._unseen import Scored, pooled


class Crossed(NamedTuple):
    """Holds the settings of the comparison of data sets.

    Attributes:
        persons: the persons of each data set. tested: those that no prior saw.
        wrists: whether wrists stand for hands. completed: data sets whose heads are made up.
        donors: those that heads and necks were learnt on.
    """

    persons: Mapping[str, Sequence[str]]
    tested: Mapping[str, Sequence[str]]
    wrists: bool
    completed: Sequence[str]
    donors: Sequence[str]

    def label(self, name: str, person: str) -> str:
        """Return the label of a person of a data set in the tables."""
        return f"{name} {person}"


def add_cross(report: Report, found: Mapping[str, Mapping[str, Scored]], how: Crossed) -> None:
    """Add the error by training set and test set, on the same test persons, and on all unseen ones.

    Args:
        report: gets the tables. found: by training set, then by the label of a person.
        how: the data sets were made alike.
    """
    title = "3D error after Procrustes (cm)"
    note = "The mean pose is that of the prior. Joints: filtered."
    if how.wrists:
        title += ", wrists as hands"
    if how.completed:
        title += ", head neither measured nor counted"
        note += (
            f" Aligned on neck and shoulders. The neck of {' and '.join(how.completed)} is put where "
            f"{' and '.join(how.donors)}'s training persons have theirs."
        )
    table = report.table(
        "cross", title, ["persons", "frames", "mean pose", "filtered", "± persons", "smoothed", *SHORT_NAMES],
        digits=(0, 0, 2, 2, 2, 2, *[1] * 8), note=note,
    )  # fmt: skip
    groups = {}
    for trained, scores in found.items():
        for target in found:
            labels = {how.label(target, person): person for person in how.persons[target]}
            chosen = {labels[n]: s for n, s in scores.items() if n in labels}
            held = {person: s for person, s in chosen.items() if person in how.tested[target]}
            name = f"{trained} → {target}"
            groups[name] = pooled(list(held.values()))
            table.add(f"{name} ({', '.join(held)})", _row(held))
            if len(chosen) > len(held):
                table.add(f"{name}, all persons", _row(chosen))
    add_pose_classes(report, groups)
    error = {name: mean_error(scored) for name, scored in groups.items()}
    for target in found:
        near = error[f"{target} → {target}"]
        still = mean_error(groups[f"{target} → {target}"], "still")
        for other in [name for name in found if name != target]:
            far = error[f"{other} → {target}"]
            report.findings.append(
                f"On {target}, a prior of {other} has {far:.2f} cm where one of {target} itself has "
                f"{near:.2f} cm ({far - near:+.2f}). The mean pose of the latter is {still:.2f} cm off."
            )


def _row(persons: Mapping[str, Scored]) -> list[float | int]:
    whole = pooled(list(persons.values()))
    wide = spread([mean_error(s) for s in persons.values()])[1]
    joints = (100 * whole.filtered.double().nanmean(0)).tolist()
    errors = [mean_error(whole, "still"), mean_error(whole), wide, mean_error(whole, "smoothed")]
    return [len(persons), len(whole.filtered), *errors, *joints]


def add_added(
    report: Report,
    found: Mapping[tuple[str, str], Mapping[str, Scored]],
    frames: Mapping[tuple[str, str], int],
) -> None:
    """Add the error on a data set that was left out, with and without motion capture in training.

    Args:
        found: scores by person, for what was left out and what was trained on. frames: of training.
    """
    table = report.table(
        "added",
        "Motion capture with made-up heads and hands added to the training: 3D error (cm) on what "
        "was left out",
        ["training frames", "frames", "mean pose", "filtered", "± persons", "smoothed", "log-lik."],
        digits=(0, 0, 2, 2, 2, 2, 2),
        note="The mean pose is that of the prior.",
    )
    groups: dict[str, Scored] = {}
    for (held, label), persons in found.items():
        whole = groups[f"{held}, {label}"] = pooled(list(persons.values()))
        row = _row(persons)
        table.add(f"{held}: {label}", [
            frames[held, label], *row[1:6], float(whole.log_likelihood.mean()),
        ])  # fmt: skip
    add_pose_classes(report, groups, "added_pose_classes")
    held_out = list(dict.fromkeys(held for held, _ in found))
    labels = list(dict.fromkeys(label for _, label in found))
    for label in labels[1:]:
        changes = [
            (
                mean_error(groups[f"{held}, {label}"], stage)
                - mean_error(groups[f"{held}, {labels[0]}"], stage)
            )
            for held in held_out
            for stage in TRACKED
        ]
        each = "; ".join(
            f"{held} {changes[2 * i]:+.2f} filtered, {changes[2 * i + 1]:+.2f} smoothed"
            for i, held in enumerate(held_out)
        )
        better = sum(change < 0 for change in changes[::2])
        report.findings.append(
            f"{label[0].upper()}{label[1:]}, against {labels[0]}, in cm: {each}. The filtered error "
            f"falls for {better} of {len(held_out)}."
        )


def plot_cross(report: Report, names: Sequence[str]) -> Any:
    """Draw bars of the error on the test persons of each data set, by training set.

    Args:
        report: with the table of `add_cross`. names: the names of the data sets.
    """
    from matplotlib.patches import Patch

    from torchpose.viz._style import add_legend, method_styles, new_figure, style_axes

    table = report["cross"]
    rows = {name.split(" (")[0]: name for name in table.rows if "all persons" not in name}
    figure = new_figure(
        max(6.4, 2.6 * len(names)), 3.9, "Across data sets: persons that no prior saw"
    )
    ax = style_axes(figure.add_subplot(), y="mean 3D error (cm)")
    ax.grid(False, axis="x")
    styles = method_styles([f"trained on {name}" for name in names])
    entries: list[Any] = []
    width = 0.38 / len(names)  # of a bar; there are two for each training set
    for i, (trained, (label, style)) in enumerate(zip(names, styles.items(), strict=True)):
        for j, stage in enumerate(("filtered", "smoothed")):
            values = [float(table[rows[f"{trained} → {target}"], stage]) for target in names]
            start = (2 * i + j - len(names) + 0.5) * width * 1.05
            place = torch.arange(len(names)).double().numpy() + start
            color, pale = style["color"], 0.85 - 0.4 * j
            ax.bar(place, values, 0.95 * width, color=color, alpha=pale)
            for x, value in zip(place, values, strict=True):
                ax.annotate(f"{value:.1f}", (x, value), (0, 2), textcoords="offset points",
                            ha="center", fontsize=8.5)  # fmt: skip
            entries.append(Patch(color=color, alpha=pale, label=f"{label}, {stage}"))
    ax.set_xticks(range(len(names)), [f"tracked: {name}" for name in names])
    ax.set_ylim(bottom=0)
    add_legend(figure, entries)
    return figure
