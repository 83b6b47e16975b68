"""Pictures of the protocol Silhouette: errors over time and by part, silhouettes with estimates."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from benchmarks.silhouette.runs import Run, Runs
from benchmarks.silhouette.tables import PARTS, part_errors, pooled_std
from benchmarks.silhouette.trackees import Tracked, View, label_of
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
from torchpose.whole_body import render

if TYPE_CHECKING:
    from matplotlib.figure import Figure
else:
    Figure = Any

__all__ = [
    "plot_errors_by_condition",
    "plot_errors_by_part",
    "plot_errors_by_time",
    "plot_silhouettes",
]

_SEEN, _BOTH, _MODEL = (0.62, 0.72, 0.83), (0.16, 0.20, 0.28), (0.90, 0.45, 0.10)


def plot_errors_by_time(runs: Runs, fps: float, title: str = "Error over time") -> Figure:
    """Error of every sequence over time (MR, Figure 6): mean over joints and seeds, one line a method.

    The band is one standard deviation over seeds.
    """
    require_matplotlib()
    from matplotlib.lines import Line2D

    labels = {method: label_of(method) for method in runs}
    styles = method_styles(list(labels.values()))
    names = list(next(iter(runs.values())))
    columns = min(2, len(names))
    rows = math.ceil(len(names) / columns)
    figure = new_figure(5.2 * columns + 0.6, 2.5 * rows + 0.9, title)
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
    for ax, name in zip(grid.flat, names, strict=False):
        style_axes(ax, title=name)
        for method, label in labels.items():
            errors = torch.stack([r.errors.double().nanmean(1) for r in runs[method][name]])
            time = torch.arange(errors.shape[1]).numpy() / fps
            middle = errors.mean(0)
            if len(errors) > 1:
                spread = errors.std(0)
                ax.fill_between(
                    time, to_numpy(middle - spread), to_numpy(middle + spread),
                    color=styles[label]["color"], alpha=0.15, linewidth=0,
                )  # fmt: skip
            ax.plot(time, to_numpy(middle), linewidth=1.6, **styles[label])
        ax.set_ylim(bottom=0)
        ax.margins(x=0)
    for ax in list(grid.flat)[len(names) :]:
        ax.set_visible(False)
    for ax in grid[-1]:
        ax.set_xlabel("time (s)", fontsize=NORMAL, color=INK)
    for ax in grid[:, 0]:
        ax.set_ylabel("error (mm)", fontsize=NORMAL, color=INK)
    add_legend(figure, [Line2D([], [], linewidth=1.8, label=n, **s) for n, s in styles.items()])
    return figure


def plot_errors_by_part(runs: Runs, title: str = "Error by part of the body") -> Figure:
    """Mean error of the whole body and of every part, one bar a method, with the spread over seeds."""
    require_matplotlib()
    from matplotlib.patches import Patch

    labels = {method: label_of(method) for method in runs}
    styles = method_styles(list(labels.values()))
    parts = ("", *PARTS)
    figure = new_figure(7.6, 3.8, title)
    ax = style_axes(figure.add_subplot(), y="error (mm)")
    ax.grid(False, axis="x")
    width = 0.8 / len(labels)
    for i, (method, label) in enumerate(labels.items()):
        found = [part_errors(runs, method, part) for part in parts]
        place = [p - 0.4 + (i + 0.5) * width for p in range(len(parts))]
        means = [float(f.mean()) for f in found]
        ax.bar(place, means, 0.9 * width, color=styles[label]["color"], alpha=0.85)
        if found[0].shape[1] > 1:
            spreads = [float(pooled_std(f)) for f in found]
            ax.errorbar(place, means, spreads, fmt="none", ecolor=INK, elinewidth=1.1)
    ax.set_xticks(range(len(parts)), ["whole body", *PARTS])
    ax.tick_params(axis="x", length=0, labelsize=NORMAL, labelcolor=INK)
    add_legend(figure, [Patch(color=s["color"], alpha=0.85, label=n) for n, s in styles.items()])
    return figure


def plot_errors_by_condition(
    conditions: Mapping[str, Runs], title: str = "Error by condition"
) -> Figure:
    """Mean error under each condition, in their order, one line a method, with the spread over seeds.

    Args:
        conditions: runs of the same methods by what they differ in, such as the number of particles.
        title: above.
    """
    require_matplotlib()
    from matplotlib.lines import Line2D

    first = next(iter(conditions.values()))
    labels = {method: label_of(method) for method in first}
    styles = method_styles(list(labels.values()))
    figure = new_figure(7.6, 3.8, title)
    ax = style_axes(figure.add_subplot(), y="error (mm)")
    for method, label in labels.items():
        found = [part_errors(runs, method) for runs in conditions.values()]
        middle = torch.stack([f.mean() for f in found])
        place = torch.arange(len(found)).numpy()
        if found[0].shape[1] > 1:
            spread = torch.stack([pooled_std(f) for f in found])
            ax.fill_between(
                place, to_numpy(middle - spread), to_numpy(middle + spread),
                color=styles[label]["color"], alpha=0.15, linewidth=0,
            )  # fmt: skip
        ax.plot(place, to_numpy(middle), linewidth=1.6, marker="o", markersize=4, **styles[label])
    ax.set_ylim(bottom=0)
    ax.set_xticks(range(len(conditions)), [name.replace(", ", "\n") for name in conditions])
    ax.tick_params(axis="x", length=0, labelsize=NORMAL, labelcolor=INK)
    add_legend(figure, [Line2D([], [], linewidth=1.8, label=n, **s) for n, s in styles.items()])
    return figure


def plot_silhouettes(
    trackee: Tracked,
    view: View,
    runs: Sequence[tuple[str, Run]],
    n_frames: int = 4,
    title: str | None = None,
) -> Figure:
    """What the cameras see, and the estimated bodies over it.

    Both: dark; seen, but not in the model: blue; in the model only: orange.

    Args:
        trackee, view: who and where. runs: one (label, run) for each block of rows.
        n_frames: from the first to the last. title: above.
    """
    require_matplotlib()
    from matplotlib.patches import Patch

    frames = torch.linspace(0, len(view.clip) - 1, n_frames).round().long()
    n_cameras = view.silhouettes.shape[1]
    rows = len(runs) * n_cameras
    figure = new_figure(1.9 * n_frames + 0.9, 2.2 * rows + 0.8, title)
    grid = figure.subplots(rows, n_frames, squeeze=False)
    for block, (label, run) in enumerate(runs):
        height, width = view.silhouettes.shape[-2:]
        model = render(trackee.body, run.mean[frames].double(), view.rig, height, width)
        windows = _windows(model)
        for c in range(n_cameras):
            for i, t in enumerate(frames.tolist()):
                ax = grid[block * n_cameras + c, i]
                rows_shown, columns_shown = windows[i][c]
                image = _coloured(view.silhouettes[t, c], model[i, c])
                ax.imshow(image[rows_shown, columns_shown], interpolation="nearest")
                ax.set_xticks([])
                ax.set_yticks([])
                if c == 0 and block == 0:
                    ax.set_title(f"{t / view.clip.fps:.2f} s", fontsize=NORMAL, color=INK)
                if i == 0:
                    text = f"{label}\n{view.rig.names[c]}"
                    ax.set_ylabel(text, fontsize=NORMAL, color=INK)
    add_legend(figure, [
        Patch(color=_BOTH, label="both"), Patch(color=_SEEN, label="silhouette alone"),
        Patch(color=_MODEL, label="model alone"),
    ])  # fmt: skip
    return figure


def _windows(model: Tensor, margin: float = 0.35) -> list[list[tuple[slice, slice]]]:
    """Rows and columns about the model of every frame and camera [T, C, H, W], all of one size."""
    places = [[torch.nonzero(image) for image in frame] for frame in model]
    spans = [p.amax(0) - p.amin(0) + 1 for frame in places for p in frame if len(p)]
    full = torch.tensor(model.shape[-2:])
    size = torch.stack(spans).amax(0) if spans else full
    size = torch.minimum(size + int(margin * int(size.max())), full)
    windows = []
    for frame in places:
        row = []
        for place in frame:
            middle = (place.amin(0) + place.amax(0)) // 2 if len(place) else full // 2
            first = torch.minimum((middle - size // 2).clamp_min(0), full - size)
            y, x = (slice(int(a), int(a + n)) for a, n in zip(first, size, strict=True))
            row.append((y, x))
        windows.append(row)
    return windows


def _coloured(seen: Tensor, model: Tensor) -> Any:
    image = torch.ones(*seen.shape, 3)
    for mask, colour in ((seen & ~model, _SEEN), (seen & model, _BOTH), (model & ~seen, _MODEL)):
        image[mask] = torch.tensor(colour)
    return image.numpy()
