"""Tables, findings and picture of the protocol across data sets."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from torchpose.evaluation.person_tables import SHORT_NAMES, add_pose_classes, mean_error, pooled
from torchpose.evaluation.persons import spread
from torchpose.evaluation.report import Report
from torchpose.evaluation.unseen import Scored

__all__ = ["add_added", "add_cross", "plot_cross"]

_SETS = ("UTD", "MHAD")


def add_cross(
    report: Report,
    found: Mapping[str, Mapping[str, Scored]],
    tested: Mapping[str, Sequence[str]],
) -> None:
    """Error by training set and test set, on the same test persons, and on all unseen ones.

    Args:
        found: by training set, then by test person ("UTD s7"). tested: persons of each set that no
            prior saw.
    """
    table = report.table(
        "cross",
        "3D error after Procrustes (cm), wrists as hands, head neither measured nor counted",
        ["persons", "frames", "filtered", "± persons", "smoothed", *SHORT_NAMES],
        digits=(0, 0, 2, 2, 2, *[1] * 8),
        note="Joints: filtered. Aligned on neck and shoulders. The neck of MHAD is put where UTD's "
        "training persons have theirs.",
    )
    groups = {}
    for trained, scores in found.items():
        for target in _SETS:
            chosen = {n: s for n, s in scores.items() if n.startswith(f"{target} ")}
            held = {n: s for n, s in chosen.items() if n.split()[-1] in tested[target]}
            name = f"{trained} → {target}"
            groups[name] = pooled(list(held.values()))
            table.add(f"{name} ({', '.join(n.split()[-1] for n in held)})", _row(held))
            if len(chosen) > len(held):
                table.add(f"{name}, all persons", _row(chosen))
    add_pose_classes(report, groups)
    error = {name: mean_error(scored) for name, scored in groups.items()}
    for target in _SETS:
        other = next(name for name in _SETS if name != target)
        near, far = error[f"{target} → {target}"], error[f"{other} → {target}"]
        report.findings.append(
            f"On {target}, a prior of {other} has {far:.2f} cm where one of {target} itself has "
            f"{near:.2f} cm ({far - near:+.2f})."
        )


def _row(persons: Mapping[str, Scored]) -> list[float | int]:
    whole = pooled(list(persons.values()))
    wide = spread([mean_error(s) for s in persons.values()])[1]
    joints = (100 * whole.filtered.double().nanmean(0)).tolist()
    errors = [mean_error(whole), wide, mean_error(whole, smoothed=True)]
    return [len(persons), len(whole.filtered), *errors, *joints]


def add_added(
    report: Report,
    found: Mapping[tuple[str, str], Mapping[str, Scored]],
    frames: Mapping[tuple[str, str], int],
) -> None:
    """Error on a data set that was left out, with and without motion capture in training.

    Args:
        found: scores by person, for what was left out and what was trained on. frames: of training.
    """
    table = report.table(
        "added",
        "Motion capture with made-up heads and hands added to the training: 3D error (cm) on what "
        "was left out",
        ["training frames", "frames", "filtered", "± persons", "smoothed", "log-lik."],
        digits=(0, 0, 2, 2, 2, 2),
    )
    groups: dict[str, Scored] = {}
    for (held, label), persons in found.items():
        whole = groups[f"{held}, {label}"] = pooled(list(persons.values()))
        row = _row(persons)
        table.add(f"{held}: {label}", [
            frames[held, label], *row[1:5], float(whole.log_likelihood.mean()),
        ])  # fmt: skip
    add_pose_classes(report, groups, "added_pose_classes")
    held_out = list(dict.fromkeys(held for held, _ in found))
    labels = list(dict.fromkeys(label for _, label in found))
    for label in labels[1:]:
        changes = [
            (
                mean_error(groups[f"{held}, {label}"], late)
                - mean_error(groups[f"{held}, {labels[0]}"], late)
            )
            for held in held_out
            for late in (False, True)
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


def plot_cross(report: Report) -> Any:
    """Bars of the error on the test persons of each set, by training set."""
    from matplotlib.patches import Patch

    from torchpose.viz._style import add_legend, method_styles, new_figure, style_axes

    table = report["cross"]
    rows = {name.split(" (")[0]: name for name in table.rows if "all persons" not in name}
    figure = new_figure(6.4, 3.9, "Across data sets: persons that no prior saw")
    ax = style_axes(figure.add_subplot(), y="mean 3D error (cm)")
    ax.grid(False, axis="x")
    styles = method_styles([f"trained on {name}" for name in _SETS])
    entries: list[Any] = []
    for i, (trained, (label, style)) in enumerate(zip(_SETS, styles.items(), strict=True)):
        for j, stage in enumerate(("filtered", "smoothed")):
            values = [float(table[rows[f"{trained} → {target}"], stage]) for target in _SETS]
            place = torch.arange(2).double().numpy() - 0.3 + 0.4 * i + 0.19 * j
            color, pale = style["color"], 0.85 - 0.4 * j
            ax.bar(place, values, 0.18, color=color, alpha=pale)
            for x, value in zip(place, values, strict=True):
                ax.annotate(f"{value:.1f}", (x, value), (0, 2), textcoords="offset points",
                            ha="center", fontsize=8.5)  # fmt: skip
            entries.append(Patch(color=color, alpha=pale, label=f"{label}, {stage}"))
    ax.set_xticks(range(2), [f"tracked: {name}" for name in _SETS])
    ax.set_ylim(bottom=0)
    add_legend(figure, entries)
    return figure
