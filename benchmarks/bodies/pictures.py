"""Pictures of bodies that were tracked: errors over time and by part, silhouettes with estimates."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from benchmarks.bodies.tracking import PARTS, Run, part_error
from benchmarks.bodies.views import Subject
from benchmarks.engine import Results, pooled_std
from benchmarks.engine.pictures import draw_band
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

_SEEN, _BOTH, _MODEL = (0.62, 0.72, 0.83), (0.16, 0.20, 0.28), (0.90, 0.45, 0.10)


def plot_errors_by_time(
    runs: Results,
    fps: float,
    title: str = "Error over time",
    label: Callable[[str], str] = str,
) -> Figure:
    """Draw the error of every sequence over time (MR, Figure 6): mean over joints and seeds.

    There is one line a method. The band is one standard deviation over seeds.

    Args:
        runs: of one condition. fps: frames per second. title: above. label: what a method is called.
    """
    require_matplotlib()
    from matplotlib.lines import Line2D

    styles = method_styles([label(method) for method in runs.names("method")])
    names = runs.names("subject")
    columns = min(2, len(names))
    rows = math.ceil(len(names) / columns)
    figure = new_figure(5.2 * columns + 0.6, 2.5 * rows + 0.9, title)
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
    for ax, name in zip(grid.flat, names, strict=False):
        style_axes(ax, title=name)
        for (method,), own in runs.where(subject=name).by("method").items():
            style = styles[label(method)]
            errors = torch.stack([run.errors.double().nanmean(1) for run in own.runs])
            time = torch.arange(errors.shape[1]).numpy() / fps
            if len(errors) > 1:
                draw_band(ax, time, errors.mean(0), errors.std(0), style)
            ax.plot(time, to_numpy(errors.mean(0)), linewidth=1.6, **style)
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


def plot_errors_by_part(runs: Results, label: Callable[[str], str] = str) -> Figure:
    """Draw the mean error of the whole body and of every part, one bar a method, with its spread.

    Args:
        runs: of one condition. label: what a method is called.
    """
    require_matplotlib()
    from matplotlib.patches import Patch

    styles = method_styles([label(method) for method in runs.names("method")])
    parts = ("", *PARTS)
    figure = new_figure(7.6, 3.8, "Error by part of the body")
    ax = style_axes(figure.add_subplot(), y="error (mm)")
    ax.grid(False, axis="x")
    width = 0.8 / len(styles)
    for i, ((method,), own) in enumerate(runs.by("method").items()):
        found = [own.values(part_error(part)) for part in parts]
        place = [p - 0.4 + (i + 0.5) * width for p in range(len(parts))]
        means = [float(f.mean()) for f in found]
        ax.bar(place, means, 0.9 * width, color=styles[label(method)]["color"], alpha=0.85)
        if found[0].shape[1] > 1:
            spreads = [float(pooled_std(f)) for f in found]
            ax.errorbar(place, means, spreads, fmt="none", ecolor=INK, elinewidth=1.1)
    ax.set_xticks(range(len(parts)), ["whole body", *PARTS])
    ax.tick_params(axis="x", length=0, labelsize=NORMAL, labelcolor=INK)
    add_legend(figure, [Patch(color=s["color"], alpha=0.85, label=n) for n, s in styles.items()])
    return figure


def plot_silhouettes(
    subject: Subject[Any],
    runs: Sequence[tuple[str, Run]],
    n_frames: int,
    title: str,
) -> Figure:
    """Draw the observed silhouettes, and the estimated bodies over them.

    Both: dark; seen, but not in the model: blue; in the model only: orange.

    Args:
        subject: who and where. runs: one (label, run) for each block of rows.
        n_frames: from the first to the last. title: above.
    """
    require_matplotlib()
    from matplotlib.patches import Patch

    view = subject.view
    frames = torch.linspace(0, len(view.clip) - 1, n_frames).round().long()
    n_cameras = view.silhouettes.shape[1]
    rows = len(runs) * n_cameras
    figure = new_figure(1.9 * n_frames + 0.9, 2.2 * rows + 0.8, title)
    grid = figure.subplots(rows, n_frames, squeeze=False)
    for block, (label, run) in enumerate(runs):
        height, width = view.silhouettes.shape[-2:]
        model = render(subject.body, run.mean[frames].double(), view.rig, height, width)
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
    """Return rows and columns about the model of every frame and camera [T, C, H, W], all of one size."""
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
