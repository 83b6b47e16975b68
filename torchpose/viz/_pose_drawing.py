"""Draw poses from arrays of NumPy, so that a process that draws them needs no PyTorch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from torchpose.viz._style import (
    INK,
    LEFT,
    MIDDLE,
    MUTED,
    NORMAL,
    PALE,
    RIGHT,
    SMALL,
    add_legend,
    label_row,
    legend_line,
    new_figure,
    require_matplotlib,
    style_axes,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:
    Axes = Figure = Any

Limbs = Sequence[tuple[int, int]]

_GAP = "#F1E9D2"
_DASHED = (0, (3, 1.5))
_MOST_COLUMNS = 10


def draw_bones(
    ax: Axes,
    points: Any,
    filled: Sequence[bool],
    colors: Sequence[str],
    limbs: Limbs,
    linewidth: float,
    alpha: float = 1.0,
) -> None:
    """Draw limbs and joints.

    Args:
        ax: matplotlib axes. points: [J, 2], float64. filled: whether each marker is. colors: of the joints.
        limbs: pairs of indices. linewidth: of the limbs, points. alpha: opacity.
    """
    from matplotlib.collections import LineCollection

    if len(limbs):
        strokes = [colors[a] if colors[a] == colors[b] else MIDDLE for a, b in limbs]
        lines = LineCollection(
            points[list(limbs)], colors=strokes, linewidths=linewidth, alpha=alpha,
            capstyle="round", zorder=3,
        )  # fmt: skip
        ax.add_collection(lines)
    faces = [c if f else "white" for c, f in zip(colors, filled, strict=True)]
    ax.scatter(
        points[:, 0], points[:, 1], s=(2.4 * linewidth) ** 2, c=faces, edgecolors=colors,
        linewidths=0.55 * linewidth, alpha=alpha, zorder=4,
    )  # fmt: skip


def arm_entries(measured: bool, ellipse: float | None, truth: bool) -> list[Any]:
    """Return the entries of a legend for arms.

    Args:
        measured: whether joints are filled where they were measured. ellipse: probability of those that are
            drawn, if any. truth: whether it is drawn.
    """
    from matplotlib.patches import Patch

    entries = [
        legend_line("person's left arm", LEFT, linewidth=3),
        legend_line("person's right arm", RIGHT, linewidth=3),
    ]
    if measured:
        entries += measured_entries()
    if ellipse is not None:
        label = f"{100 * ellipse:.0f} % ellipse"
        entries.append(Patch(facecolor="#DDDDDD", edgecolor=MUTED, label=label))
    if truth:
        entries.append(legend_line("truth", PALE, linewidth=2.5))
    return entries


def measured_entries() -> list[Any]:
    """Return what a legend says of filled and of hollow joints."""
    return [
        legend_line(name, MIDDLE, marker="o", linestyle="", markerfacecolor=face)
        for name, face in (("measured", MIDDLE), ("inferred", "white"))
    ]


def draw_strip(
    poses: np.ndarray,
    observed: np.ndarray | None,
    truth: np.ndarray | None,
    limits: tuple[np.ndarray, np.ndarray],
    words: Sequence[str],
    colors: Sequence[str],
    limbs: Limbs,
    title: str | None,
) -> Figure:
    """Return poses side by side, at one scale; 3D poses get a second row, seen from the side.

    Args:
        poses: [N, J, D], float64. observed: [N, J]. truth: [N, J, D]. limits: lowest and highest coordinates.
        words: above each pose, of equal numbers of lines. colors: of the joints. limbs: pairs of indices.
        title: above the picture.
    """
    columns = min(len(poses), _MOST_COLUMNS)
    lines = math.ceil(len(poses) / columns)
    views = ((0, 1),) if poses.shape[-1] == 2 else ((0, 1), (2, 1))
    low, high = limits
    size = (high - low).tolist()
    wide = max(size[across] for across, _ in views)
    height = lines * (len(views) * 1.6 * size[1] / wide + 0.3 + 0.15 * ("\n" in words[0])) + 0.7
    figure = new_figure(columns * 1.6, height, title)
    rows = figure.subplots(lines * len(views), 1, squeeze=False)[:, 0]
    for row, ax in enumerate(rows):  # few axes with all frames side by side: each one costs time
        ax.set_axis_off()
        ax.set_aspect("equal")
        ax.set(xlim=(0, columns * wide), ylim=(float(high[1]), float(low[1])))
        if len(views) == 2:
            label_row(ax, ("front", "side")[row % 2])
    everything, grey = [True] * len(colors), [PALE] * len(colors)
    for place, pose in enumerate(poses):
        line, column = divmod(place, columns)
        middle = (column + 0.5) * wide
        for row, pick in enumerate(views, line * len(views)):
            shift = np.array([middle - float(low[pick[0]] + high[pick[0]]) / 2, 0.0])
            if truth is not None:
                draw_bones(rows[row], truth[place][:, pick] + shift, everything, grey, limbs, 1.5)
            seen = everything if observed is None else observed[place].tolist()
            draw_bones(rows[row], pose[:, pick] + shift, seen, colors, limbs, 2.2)
        top = rows[line * len(views)]
        top.text(
            middle, 1.0, words[place], fontsize=SMALL, color=INK,
            ha="center", va="bottom", transform=top.get_xaxis_transform(),
        )  # fmt: skip
    add_legend(figure, arm_entries(observed is not None, None, truth is not None))
    return figure


def draw_curves(
    time: np.ndarray,
    curves: np.ndarray,
    spread: np.ndarray | None,
    truth: np.ndarray | None,
    gaps: Sequence[Sequence[tuple[float, float]]] | None,
    labels: Sequence[str],
    colors: Sequence[str],
    level: float,
    title: str | None,
) -> Figure:
    """Return coordinates over time: a row for each joint, and a column for each coordinate.

    Args:
        time: [T], seconds. curves: [T, N, D], float64. spread: half widths of bands, of the same shape.
        truth: [T, N, D]. gaps: of each joint, from when to when it was not measured.
        labels: of the joints. colors: of the joints. level: probability of the bands.
        title: above the picture.
    """
    require_matplotlib()
    from matplotlib.patches import Patch

    _, n_rows, dims = curves.shape
    axes_names = (
        ("x, right (m)", "y, down (m)", "z, away (m)") if dims == 3 else ("u (px)", "v (px)")
    )
    figure = new_figure(4.0 * dims, 1.65 * n_rows + 0.9, title)
    grid: Any = figure.subplots(n_rows, dims, sharex=True, squeeze=False)
    for row, d in np.ndindex(n_rows, dims):
        ax = style_axes(grid[row, d], "time (s)" if row == n_rows - 1 else "")
        if row == 0:
            ax.set_title(axes_names[d], fontsize=NORMAL, color=INK)
        for gap in () if gaps is None else gaps[row]:
            ax.axvspan(*gap, color=_GAP, linewidth=0, zorder=0)
        _draw_curve(
            ax, time, curves[:, row, d], colors[row],
            None if spread is None else spread[:, row, d],
            None if truth is None else truth[:, row, d],
        )  # fmt: skip
        if dims == 2 and d == 1:
            ax.invert_yaxis()
    for row, label in enumerate(labels):
        grid[row, 0].set_ylabel(label, fontsize=NORMAL, color=INK)
    entries = [legend_line("estimate", MUTED, linewidth=1.5)]
    if spread is not None:
        entries.append(Patch(color=PALE, label=f"{100 * level:.0f} % band"))
    if truth is not None:
        entries.append(legend_line("truth", linewidth=1.1, linestyle=_DASHED))
    if gaps is not None:
        entries.append(Patch(color=_GAP, label="not measured here: inferred"))
    figure.align_ylabels(grid[:, 0])
    add_legend(figure, entries)
    return figure


def _draw_curve(
    ax: Axes,
    time: np.ndarray,
    middle: np.ndarray,
    color: str,
    spread: np.ndarray | None,
    truth: np.ndarray | None,
) -> None:
    """Draw one coordinate over time, a band of this half width about it, and the true one."""
    if spread is not None:
        ax.fill_between(time, middle - spread, middle + spread, color=color, alpha=0.2, linewidth=0)
    if truth is not None:
        ax.plot(time, truth, color=INK, linewidth=1.1, linestyle=_DASHED)
    ax.plot(time, middle, color=color, linewidth=1.5)
    ax.margins(x=0)
