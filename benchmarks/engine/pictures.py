"""Pictures of the rows of an experiment."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from benchmarks.engine.experiment import Measure, Results
from benchmarks.engine.statistics import pooled_std
from torchpose.viz._style import (
    INK,
    NORMAL,
    add_legend,
    method_styles,
    new_figure,
    require_matplotlib,
    style_axes,
    to_numpy,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:
    Axes = Figure = Any


def plot_by_condition(
    results: Results,
    measures: Mapping[str, Measure],
    title: str,
    *,
    label: Callable[[str], str] = str,
    places: Sequence[float] | None = None,
    axis: str = "",
) -> Figure:
    """Draw a measure over the conditions, in their order: a panel each, one line a method.

    The band is one standard deviation over seeds, pooled over subjects.

    Args:
        results: of the same methods under several conditions. measures: by the text beside the axis.
        title: above. label: what a method is called.
        places: of the conditions on a logarithmic axis; evenly spaced if None. axis: text below it.
    """
    require_matplotlib()
    from matplotlib.lines import Line2D

    styles = method_styles([label(method) for method in results.names("method")])
    figure = new_figure(7.6 if len(measures) == 1 else 3.83 * len(measures), 3.8, title)
    for ax, (text, measure) in zip(
        figure.subplots(1, len(measures), squeeze=False)[0], measures.items(), strict=True
    ):
        style_axes(ax, axis, text)
        at = list(range(len(results.names("condition")))) if places is None else list(places)
        for (method,), own in results.by("method").items():
            style = styles[label(method)]
            found = [group.values(measure) for group in own.by("condition").values()]
            middle = torch.stack([values.mean() for values in found])
            if found[0].shape[1] > 1:
                draw_band(ax, at, middle, torch.stack([pooled_std(v) for v in found]), style)
            ax.plot(at, to_numpy(middle), linewidth=1.6, marker="o", markersize=4, **style)
        _mark_conditions(ax, at, results.names("condition"), places is not None)
        ax.set_ylim(bottom=0)
    add_legend(figure, [Line2D([], [], linewidth=1.8, label=n, **s) for n, s in styles.items()])
    return figure


def _mark_conditions(
    ax: Axes, at: Sequence[float], names: Sequence[str], logarithmic: bool
) -> None:
    if logarithmic:
        ax.set_xscale("log")
        ax.set_xticks(at, names, rotation=45)
        ax.minorticks_off()
        return
    ax.set_xticks(at, [name.replace(", ", "\n") for name in names])
    ax.tick_params(axis="x", length=0, labelsize=NORMAL, labelcolor=INK)


def draw_band(ax: Axes, at: Any, middle: Tensor, half: Tensor, style: Mapping[str, Any]) -> None:
    """Fill what lies within half a band's width of a line.

    Args:
        ax: to draw on. at: places [N]. middle, half: the line and half of the width [N].
        style: of the line, whose colour it has.
    """
    low, high = to_numpy(middle - half), to_numpy(middle + half)
    ax.fill_between(at, low, high, color=style["color"], alpha=0.15, linewidth=0)
