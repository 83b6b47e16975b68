"""Pictures of the protocol Bend: error over particles, predictions over a frame, a hidden arm."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from benchmarks.bend.report import JOINT_ERROR, root_error
from benchmarks.bend.tracking import mean_squared
from benchmarks.bodies.views import View
from benchmarks.engine import Results, plot_by_condition
from torchpose.body import BODY_15
from torchpose.errors import DegenerateFilterWarning
from torchpose.viz._style import (
    INK,
    LEFT,
    MUTED,
    NORMAL,
    RIGHT,
    add_legend,
    method_styles,
    new_figure,
    require_matplotlib,
    style_axes,
    to_numpy,
)
from torchpose.whole_body import SilhouetteParticleFilter

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:
    Axes = Figure = Any

_SEEN = (0.80, 0.84, 0.89)
_BONES = [(i, parent) for i, parent in enumerate(BODY_15.parents) if parent >= 0]


def plot_particles(runs: Results) -> Figure:
    """Draw Figure 3 in kind: mean squared error of the angles, then root and joints, over N.

    Args:
        runs: by number of particles, such as "1,000".
    """
    return plot_by_condition(
        runs,
        {
            "MSE of the angles (degrees²)": mean_squared,
            "error of the root (mm)": root_error,
            "error of the joints (mm)": JOINT_ERROR,
        },
        "Error over the number of particles",
        places=[int(name.replace(",", "")) for name in runs.names("condition")],
        axis="particles",
    )


@torch.no_grad()
def predictions(tracker: SilhouetteParticleFilter, view: View, frame: int, count: int) -> Tensor:
    """Return joints [count, 15, 3] of randomly chosen particles as predicted for a frame, before weighting.

    Args:
        tracker: run up to the frame. view: what it sees. frame: counted from 0. count: how many.
    """
    generator = torch.Generator().manual_seed(0)
    state = tracker.init(view.initial_state[None], generator=generator)
    with warnings.catch_warnings():  # of frames in which every particle was clamped
        warnings.simplefilter("ignore", DegenerateFilterWarning)
        for t in range(frame + 1):
            state, _ = tracker.step(state, view.silhouettes[t][None], view.rig, generator=generator)
    chosen = torch.randperm(tracker.n_particles, generator=generator)[:count]
    body: Any = tracker.body
    joints: Tensor = body.joints(state.particles[0, chosen]).double()
    return joints


def plot_predictions(
    view: View,
    frames: Sequence[int],
    drawn: Mapping[str, Sequence[Tensor]],
    title: str = "Predictions before they are weighed",
    *,
    arms: bool = False,
) -> Figure:
    """Draw Figure 4 in kind: predicted postures over the silhouette, a row for each tracker.

    Args:
        view: who and where. frames: one for each column.
        drawn: joints [K, 15, 3] for each frame, by tracker. title: above.
        arms: draw single estimates, with the left arm blue and the right one orange.
    """
    require_matplotlib()
    from matplotlib.lines import Line2D

    styles = method_styles(list(drawn))
    colours: dict[str, Any] = {f"predicted, {n}": s["color"] for n, s in styles.items()}
    if arms:
        colours = {"left arm": LEFT, "right arm": RIGHT, "estimate": MUTED}
    figure = new_figure(3.1 * len(frames) + 0.4, 3.5 * len(drawn) + 0.7, title)
    grid = figure.subplots(len(drawn), len(frames), squeeze=False)
    points = [view.rig(j).pixels[:, 0] for row in drawn.values() for j in row]
    low, high = torch.cat(points).flatten(0, -2).aminmax(dim=0)
    for row, (label, joints) in zip(grid, drawn.items(), strict=True):
        for ax, t, predicted in zip(row, frames, joints, strict=True):
            _background(ax, view.silhouettes[t, 0])
            _sticks(ax, view, view.clip.joints[t][None], _BONES, INK, 1.0, 1.0 if arms else 1.8)
            if arms:
                _sticks(ax, view, predicted, _BONES, MUTED, 1.0, 1.6)
                _sticks(ax, view, predicted, _bones("left"), LEFT, 1.0, 2.2)
                _sticks(ax, view, predicted, _bones("right"), RIGHT, 1.0, 2.2)
            else:
                _sticks(ax, view, predicted, _BONES, styles[label]["color"], 0.18, 0.9)
            ax.set_xlim(float(low[0]) - 4, float(high[0]) + 4)
            ax.set_ylim(float(high[1]) + 4, float(low[1]) - 4)
        row[0].set_ylabel(label, fontsize=NORMAL, color=INK)
    for ax, t in zip(grid[0], frames, strict=True):
        ax.set_title(f"frame {t + 1}", fontsize=NORMAL, color=INK)
    add_legend(figure, [
        *(Line2D([], [], color=c, label=n) for n, c in colours.items()),
        Line2D([], [], color=INK, linewidth=1.0 if arms else 1.8, label="recorded"),
    ])  # fmt: skip
    return figure


def _background(ax: Axes, silhouette: Tensor) -> None:
    image = torch.ones(*silhouette.shape, 3)
    image[silhouette] = torch.tensor(_SEEN)
    ax.imshow(image.numpy(), interpolation="nearest")
    ax.set_xticks([])
    ax.set_yticks([])
    for spine in ax.spines.values():
        spine.set_visible(False)


def _bones(side: str) -> list[tuple[int, int]]:
    """Return the two bones of an arm."""
    names = [f"{side}_{joint}" for joint in ("shoulder", "elbow", "wrist")]
    return [(BODY_15.joint(a), BODY_15.joint(b)) for a, b in pairwise(names)]


def _sticks(
    ax: Axes, view: View, joints: Tensor, bones: Sequence[tuple[int, int]], color: Any,
    alpha: float, width: float,
) -> None:  # fmt: skip
    from matplotlib.collections import LineCollection

    pixels = view.rig(joints).pixels[:, 0]
    lines = pixels[:, torch.tensor(bones)].flatten(0, 1)
    lines = lines[torch.isfinite(lines).flatten(1).all(1)]
    ax.add_collection(
        LineCollection(to_numpy(lines), colors=[color], alpha=alpha, linewidths=width)
    )


def plot_hidden_arm(
    panels: Sequence[tuple[str, Tensor, Mapping[str, tuple[Tensor, Tensor]]]],
    fps: float,
    title: str = "The arm that the other one hides",
) -> Figure:
    """Draw the error of the hidden arm over time, with the share of it that the silhouette shows.

    Args:
        panels: for each sequence its name, the visible share [T], and by tracker the errors of the
            hidden and of the near arm [S, T], mm.
        fps: frames per second. title: above.
    """
    require_matplotlib()
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    styles = method_styles(list(panels[0][2]))
    figure = new_figure(4.3 * len(panels) + 0.6, 3.6, title)
    for ax, (name, visible, arms) in zip(
        figure.subplots(1, len(panels), sharey=True, squeeze=False)[0], panels, strict=True
    ):
        style_axes(ax, "time (s)", "error of the arm (mm)" if ax.get_subplotspec().is_first_col()
                   else "", name)  # fmt: skip
        time = torch.arange(len(visible)).numpy() / fps
        for label, (hidden, near) in arms.items():
            colour = styles[label]["color"]
            ax.plot(time, to_numpy(hidden.mean(0)), color=colour, linewidth=1.8)
            ax.plot(time, to_numpy(near.mean(0)), color=colour, linewidth=1.0, linestyle=":")
        ax.set_ylim(bottom=0)
        ax.margins(x=0)
        share = ax.twinx()
        share.fill_between(time, 0, to_numpy(visible), color=MUTED, alpha=0.15, linewidth=0)
        share.set_ylim(0, 1)
        share.set_yticks([])
        for spine in share.spines.values():
            spine.set_visible(False)
    add_legend(figure, [
        *(Line2D([], [], color=s["color"], label=f"hidden arm, {n}") for n, s in styles.items()),
        *(Line2D([], [], color=s["color"], linestyle=":", label=f"near arm, {n}")
          for n, s in styles.items()),
        Patch(color=MUTED, alpha=0.15, label="share of the hidden arm outside of the rest (0 to 1)"),
    ])  # fmt: skip
    return figure
