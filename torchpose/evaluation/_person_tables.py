"""Tables and pictures of the protocols over persons."""

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from torchpose.evaluation._person_recordings import POSE_CLASSES, spread
from torchpose.evaluation._report import Report, Table
from torchpose.evaluation._unseen import Scored, pooled
from torchpose.skeleton._joint_sets import UPPER_BODY

SHORT_NAMES = tuple(name.replace("_left", " L").replace("_right", " R") for name in UPPER_BODY)
"""Names of the joints at the heads of columns."""

Stage = Literal["still", "filtered", "smoothed"]
TRACKED: tuple[Stage, ...] = ("filtered", "smoothed")
"""Errors of `Scored` in tracking, without and with later frames."""

STAGES: tuple[Stage, ...] = ("still", *TRACKED)
"""The same, after those of the mean pose."""

_COLUMNS = ("filtered", "smoothed", "in 50 %", "in 90 %", "log-lik.")
_HANDS, _ELBOWS = (0, 7), (1, 6)


def mean_error(scored: Scored, stage: Stage = "filtered") -> float:
    """Return the mean over all joints and frames of tracking, or of the mean pose, centimetres."""
    errors: Tensor = getattr(scored, stage)
    return 100 * float(errors.double().nanmean())


def add_persons(report: Report, persons: Mapping[str, Scored]) -> Table:
    """Add one row for each person, then mean and spread over persons, and all frames pooled."""
    table = report.table(
        "persons",
        "3D error after Procrustes (cm), true joints inside the ellipsoids (%), log-likelihood of "
        "the pose (nats)",
        ["frames", "mean pose", *_COLUMNS, *SHORT_NAMES],
        digits=(0, 2, 2, 2, 0, 0, 2, *[1] * 8),
        note="The mean pose is that of the prior. Joints: filtered. Ellipsoids: of the filter. Mean and "
        "standard deviation are over persons, each counting once; 'all frames' counts every frame once.",
    )
    rows = {name: _row(scored) for name, scored in persons.items()}
    for name, row in rows.items():
        table.add(name, row)
    columns = list(zip(*rows.values(), strict=True))
    for i, name in enumerate(("mean", "standard deviation")):
        table.add(name, [round(spread(columns[0])[i]) if len(rows) > i else None,
                         *(spread(column)[i] for column in columns[1:])])  # fmt: skip
    table.add("all frames", _row(pooled(list(persons.values()))))
    return table


def _row(scored: Scored) -> list[float | int]:
    low, high = (100 * scored.inside.double().nanmean((0, 2))).tolist()
    joints = (100 * scored.filtered.double().nanmean(0)).tolist()
    likelihood = float(scored.log_likelihood.nanmean())
    errors = [mean_error(scored, stage) for stage in STAGES]
    return [len(scored.filtered), *errors, low, high, likelihood, *joints]


def add_pose_classes(
    report: Report, groups: Mapping[str, Scored], key: str = "pose_classes"
) -> Table:
    """Add the error of hand and elbow by what the arm does, for each group of scored frames."""
    table = report.table(
        key,
        "What uncommon poses cost: error of the arm (cm) by what it does",
        ["arm-frames (%)", "hand", "elbow", "hand, smoothed", "elbow, smoothed"],
        digits=1,
        note="Raised: the hand above its shoulder; crossed: on the other side of the middle of the "
        "shoulders; near the body: within 20 cm of its shoulder, horizontally.",
    )
    for group, scored in groups.items():
        for number, name in enumerate(POSE_CLASSES):
            chosen = scored.classes == number
            row = [
                100 * float(errors[:, list(joints)][chosen].double().nanmean())
                for errors in (scored.filtered, scored.smoothed)
                for joints in (_HANDS, _ELBOWS)
            ]
            share = 100 * float(chosen.double().mean())
            table.add(f"{group}, {name}" if len(groups) > 1 else name, [share, *row])
    return table


def class_error(scored: Scored, name: str) -> float:
    """Return the mean filtered error of hands and elbows (cm) of arms that do this."""
    errors = scored.filtered
    chosen = scored.classes == POSE_CLASSES.index(name)
    arm = (errors[:, list(_HANDS)] + errors[:, list(_ELBOWS)]) / 2
    return 100 * float(arm[chosen].double().nanmean())


# --- pictures -------------------------------------------------------------------------------------


def plot_persons(persons: Mapping[str, Scored], title: str) -> Any:
    """Draw the error of each person, filtered and smoothed, then the mean and its spread over persons."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    from torchpose.viz._style import INK, add_legend, method_styles, new_figure, style_axes

    figure = new_figure(max(6.4, 0.62 * len(persons) + 2.8), 3.9, title)
    ax = style_axes(figure.add_subplot(), y="mean 3D error (cm)")
    ax.grid(False, axis="x")
    styles = method_styles(list(TRACKED))
    entries: list[Any] = []
    for i, stage in enumerate(TRACKED):
        style = styles[stage]
        values = [mean_error(scored, stage) for scored in persons.values()]
        middle, wide = spread(values)
        place = torch.arange(len(values)).double().numpy() - 0.2 + 0.4 * i
        ax.bar(place, values, 0.36, color=style["color"], alpha=0.85)
        last = len(values) + 0.3 + 0.4 * i
        ax.bar(last, middle, 0.36, color=style["color"], alpha=0.85, edgecolor=INK)
        ax.vlines(last, middle - wide, middle + wide, color=INK, linewidth=1.1)
        label = f"{stage}: {middle:.2f} ± {wide:.2f} cm"
        entries.append(Patch(color=style["color"], alpha=0.85, label=label))
    entries.append(Line2D([], [], color=INK, linewidth=1.1, label="± SD over persons"))
    names = [name.replace("_", "\n").replace(" ", "\n") for name in persons]
    ax.set_xticks([*range(len(persons)), len(persons) + 0.5], [*names, "mean"])
    ax.set_ylim(bottom=0)
    add_legend(figure, entries)
    return figure


class Curve(NamedTuple):
    """Holds the mean error (cm) by number of persons, with its spread over draws and over test persons."""

    counts: list[int]
    mean: list[float]
    drawn: list[float]
    tested: list[float]


def plot_curves(curves: Mapping[str, Mapping[str, Curve]], title: str) -> Any:
    """Draw learning curves: a panel for each stage (filtered, smoothed), a line for each recipe.

    The band is one standard deviation over the persons that were tracked. A whisker is one over
    which persons were drawn to train on; there is none where each person is tracked by one fit only.

    Args:
        curves: the curves by stage and recipe. title: above the picture.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    from torchpose.viz._style import INK, PALE, add_legend, method_styles, new_figure, style_axes

    figure = new_figure(4.6 * len(curves), 4.3, title)
    panels = figure.subplots(1, len(curves), sharey=True, squeeze=False)[0]
    styles = method_styles(list(next(iter(curves.values()))))
    for ax, (stage, by_recipe) in zip(panels, curves.items(), strict=True):
        style_axes(ax, "training persons", "mean 3D error (cm)" if ax is panels[0] else "", stage)
        means = torch.tensor([curve.mean for curve in by_recipe.values()])
        for i, (recipe, curve) in enumerate(by_recipe.items()):
            color, half = styles[recipe]["color"], torch.tensor(curve.tested).nan_to_num()
            low, high = means[i] - half, means[i] + half
            ax.fill_between(curve.counts, low.numpy(), high.numpy(), color=color, alpha=0.13,
                            linewidth=0)  # fmt: skip
            place = [count - 0.07 + 0.14 * i for count in curve.counts]
            drawn = torch.tensor(curve.drawn)
            ax.vlines(place, (means[i] - drawn).numpy(), (means[i] + drawn).numpy(), color=color,
                      linewidth=1.4)  # fmt: skip
            ax.plot(curve.counts, curve.mean, marker="o", markersize=4.5, linewidth=1.9,
                    **styles[recipe])  # fmt: skip
            lowest = len(means) > 1 and means.mean(1).argmin() == i
            for count, value in zip(curve.counts, curve.mean, strict=True):
                ax.annotate(f"{value:.2f}", (count, value), (4, -12 if lowest else 5), color=color,
                            fontsize=8, textcoords="offset points")  # fmt: skip
        ax.set_xticks(next(iter(by_recipe.values())).counts)
    entries: list[Any] = [
        Line2D([], [], linewidth=1.9, marker="o", markersize=4.5, label=name, **style)
        for name, style in styles.items()
    ]
    entries.append(Line2D([], [], color=INK, linewidth=1.4, label="± SD over who was trained on"))
    entries.append(Patch(color=PALE, alpha=0.5, label="± SD over who was tracked"))
    add_legend(figure, entries)
    return figure
