"""Performances of an action in its space, before and after they were put in step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torch import Tensor

from torchpose.errors import InputError, ShapeError
from torchpose.viz.style import (
    INK,
    LEFT,
    MUTED,
    PALE,
    RIGHT,
    SMALL,
    add_legend,
    new_figure,
    style_axes,
    to_numpy,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from torchpose.priors.actions.file import Synchronised
    from torchpose.priors.actions.space import ActionSpace
else:
    Axes = Figure = ActionSpace = Synchronised = Any

__all__ = ["plot_action_space"]

_MOST_LINES = 60


def plot_action_space(
    space: ActionSpace,
    synchronised: Synchronised,
    n_dimensions: int = 4,
    deviations: float = 3.0,
    title: str | None = None,
) -> Figure:
    """Return the first dimensions over time: above with lengths normalised only, below synchronised.

    Thin lines are performances, the thick one is their mean, dashed lines are so many deviations to
    either side of it; upright lines stand at the key frames.

    Args:
        space: the fitted action. synchronised: its performances, of `fit_synchronised`.
        n_dimensions: that are shown, as many as there are at most. deviations: of the dashed lines.
        title: above the picture; by default the action's name and size.

    Raises:
        InputError: no dimension is asked for. ShapeError: performances of another action space.

    Reference: Rius, Varona, Roca & Gonzalez, 2006, Figure 1.
    """
    if n_dimensions < 1:
        raise InputError(f"n_dimensions must be at least 1, got {n_dimensions}")
    if synchronised.after.shape[1:] != space.performance.shape:
        raise ShapeError(
            f"the performances have {list(synchronised.after.shape[1:])} postures and dimensions, the "
            f"action space has {list(space.performance.shape)}"
        )
    shown = min(n_dimensions, space.n_dimensions)
    figure = new_figure(2.4 * shown + 0.6, 5.2, title or _title(space))
    axes = figure.subplots(2, shown, sharex=True, sharey="col", squeeze=False)
    stages = (synchronised.before, synchronised.after)
    for row, (stage, name) in enumerate(
        zip(stages, ("length normalised", "synchronised"), strict=True)
    ):
        mean, std = stage.mean(0), stage.std(0)
        if row == 1:
            mean, std = space.performance, space.std
        for d in range(shown):
            ax = style_axes(
                axes[row, d], "posture k" if row else "", f"{name}\ndegrees" if d == 0 else "",
                "" if row else f"dimension {d + 1}",
            )  # fmt: skip
            _draw(ax, stage[..., d], mean[:, d], deviations * std[:, d])
            if row == 1:
                for key in synchronised.key_frames[1:-1]:
                    ax.axvline(key, color=MUTED, linewidth=0.8, linestyle=":")
    add_legend(figure, _legend(deviations))
    return figure


def _draw(ax: Axes, lines: Tensor, mean: Tensor, reach: Tensor) -> None:
    every = max(1, len(lines) // _MOST_LINES)
    ax.plot(to_numpy(lines[::every].mT), color=LEFT, linewidth=0.5, alpha=0.45)
    for edge in (mean - reach, mean + reach):
        ax.plot(to_numpy(edge), color=INK, linewidth=1.1, linestyle=(0, (4, 2)))
    ax.plot(to_numpy(mean), color=RIGHT, linewidth=2.4)
    ax.set_xlim(0, len(mean) - 1)
    ax.tick_params(labelsize=SMALL)
    ax.spines["left"].set_color(PALE)


def _legend(deviations: float) -> list[Any]:
    from matplotlib.lines import Line2D

    return [
        Line2D([], [], color=LEFT, linewidth=0.8, alpha=0.7, label="performances"),
        Line2D([], [], color=RIGHT, linewidth=2.4, label="mean performance"),
        Line2D([], [], color=INK, linewidth=1.1, linestyle=(0, (4, 2)),
               label=f"{deviations:g} standard deviations"),
        Line2D([], [], color=MUTED, linewidth=0.8, linestyle=":", label="key frames"),
    ]  # fmt: skip


def _title(space: ActionSpace) -> str:
    name = space.info.name or "action"
    return f"{name}: {space.info.performances} performances in {space.n_dimensions} dimensions"
