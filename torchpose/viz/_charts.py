"""Plot joints and errors over time, errors per joint, PCP and calibration."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.checks import check_shape
from torchpose.errors import InputError
from torchpose.metrics._calibration import Coverage, chi2_quantile
from torchpose.metrics._pose_errors import PCP
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.viz._pose_drawing import draw_curves
from torchpose.viz._skeletons import as_drawn
from torchpose.viz._style import (
    INK,
    MUTED,
    NORMAL,
    PALE,
    add_legend,
    bar_style,
    check_named,
    join_unit,
    joint_colors,
    legend_line,
    method_styles,
    new_figure,
    readable,
    require_matplotlib,
    style_axes,
    to_numpy,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:
    Axes = Figure = Any

CURVE_JOINTS = ("hand_left", "elbow_left", "hand_right", "elbow_right")
ERROR_JOINTS = ("hand_left", "hand_right", "elbow_left", "elbow_right", "shoulder_left",
                "shoulder_right")  # fmt: skip
_BAND = "#EDEDED"


def plot_joint_curves(
    joints: Float[Tensor, "T 8 D"],
    covariance: Float[Tensor, "T 8 D D"] | None = None,
    observed: Bool[Tensor, "T 8"] | None = None,
    truth: Float[Tensor, "T 8 D"] | None = None,
    fps: float = 30.0,
    show: Sequence[str] = CURVE_JOINTS,
    level: float = 0.9,
    title: str | None = None,
    first_frame: int = 0,
) -> Figure:
    """Return coordinates of some joints over time, with bands, and with gaps of the measurements.

    Args:
        joints: [T, 8, 3], camera axes, metres, or [T, 8, 2], pixels.
        covariance: [T, 8, D, D]; the band holds each coordinate with probability `level`.
        observed: [T, 8], True = measured. Gaps of a joint that is measured in some frames are
            shaded; a joint without measurements is labelled as inferred.
        truth: [T, 8, D], drawn in dark grey.
        fps: frames per second. show: names of the joints, one row each.
        level: probability of the bands. title: above the picture.
        first_frame: number of the first pose's frame in the recording, whose times are shown.

    Returns:
        matplotlib `Figure`, a row for each joint and a column for each coordinate.

    Raises:
        ShapeError: other sizes. InputError: an unknown joint.
            MissingDependencyError: matplotlib is missing.
    """
    draw = prepare_joint_curves(
        joints, covariance, observed, truth, fps, show, level, title, first_frame
    )
    return draw()


def prepare_joint_curves(
    joints: Float[Tensor, "T 8 D"],
    covariance: Float[Tensor, "T 8 D D"] | None,
    observed: Bool[Tensor, "T 8"] | None,
    truth: Float[Tensor, "T 8 D"] | None,
    fps: float,
    show: Sequence[str] = CURVE_JOINTS,
    level: float = 0.9,
    title: str | None = None,
    first_frame: int = 0,
) -> Callable[[], Figure]:
    """Return what draws coordinates over time, which another process can do; see `plot_joint_curves`."""
    joints, covariance, observed, truth = as_drawn(None, joints, covariance, observed, truth)
    rows = _indices(show)
    spread = gaps = None
    labels = [readable(name) for name in show]
    if covariance is not None:
        half = float(chi2_quantile(torch.tensor(level, dtype=torch.float64), 1).sqrt())
        spread = half * to_numpy(covariance[:, rows].diagonal(dim1=-2, dim2=-1)) ** 0.5
    if observed is not None:
        seen = observed[:, rows].any(0).tolist()
        gaps = [
            [((first_frame + a) / fps, (first_frame + b) / fps) for a, b in _spans(~flag)] * ever
            for flag, ever in zip(observed[:, rows].unbind(1), seen, strict=True)
        ]
        notes = ["" if ever else "\n(inferred throughout)" for ever in seen]
        labels = [label + note for label, note in zip(labels, notes, strict=True)]
    colors = joint_colors(UPPER_BODY)
    return partial(
        draw_curves,
        (first_frame + torch.arange(joints.shape[0]).numpy()) / fps,
        to_numpy(joints[:, rows]),
        spread,
        None if truth is None else to_numpy(truth[:, rows]),
        gaps,
        labels,
        [colors[joint] for joint in rows],
        level,
        title,
    )


def _indices(names: Sequence[str]) -> list[int]:
    unknown = [name for name in names if name not in UPPER_BODY]
    if unknown or not names:
        raise InputError(f"expected names among {', '.join(UPPER_BODY)}, got {list(names)}")
    return [UPPER_BODY.index(name) for name in names]


def _spans(flag: Tensor) -> list[tuple[float, float]]:
    """Return runs of True as (start, stop) in frames, half a frame wider on each side."""
    padded = torch.nn.functional.pad(flag.detach().cpu().int(), (1, 1))
    edges = torch.nonzero(padded.diff()).flatten().tolist()
    return [(a - 0.5, b - 0.5) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def plot_errors_over_time(
    errors: Mapping[str, Float[Tensor, "T 8"]],
    fps: float = 30.0,
    show: Sequence[str] = ERROR_JOINTS,
    unit: str = "cm",
    scale: float = 100.0,
    bound: float | None = None,
    title: str | None = None,
) -> Figure:
    """Return the error of each joint over time, one line for each method (paper's Figures 5 and 11).

    Args:
        errors: the errors by method, [T, 8], from `torchpose.metrics.joint_errors`; NaN leaves a hole.
        fps: frames per second. show: names of the joints, one panel each; those in one row (the
            left and the right one, by default) share a scale.
        unit, scale: errors are multiplied by `scale` and called `unit`: ("cm", 100) for metres,
            ("px", 1) for pixels.
        bound: a thin line at this error, in `unit`, e.g. 20 for the paper's 20 cm.
        title: above the picture.

    Returns:
        matplotlib `Figure`, two panels in a row.

    Raises:
        ShapeError: errors of another shape. InputError: an unknown joint, or errors without names.
            MissingDependencyError: matplotlib is missing.
    """
    styles = _styles_of("errors", errors, "shape", "joint_errors")
    rows = _indices(show)
    columns = 2 if len(rows) > 1 else 1
    lines = math.ceil(len(rows) / columns)
    figure = new_figure(5.6 * columns, 1.75 * lines + 0.9, title)
    grid = figure.subplots(lines, columns, sharex=True, sharey="row", squeeze=False)
    for place, joint in enumerate(rows):
        ax = style_axes(grid.flat[place], title=readable(UPPER_BODY[joint]))
        for name, values in errors.items():
            check_shape(f"errors[{name!r}]", values, [None, 8])
            time = torch.arange(values.shape[0]).numpy() / fps
            ax.plot(time, scale * to_numpy(values[:, joint]), linewidth=1.3, **styles[name])
        ax.margins(x=0)
        ax.set_ylim(bottom=0)
    if bound is not None:
        for ax in grid.flat[: len(rows)]:
            ax.set_ylim(0, ax.get_ylim()[1])  # the line does not widen the scale
            ax.axhline(bound, color=MUTED, linewidth=0.9, zorder=1)
    for ax in grid[-1]:
        ax.set_xlabel("time (s)", fontsize=NORMAL, color=INK)
    for ax in grid[:, 0]:
        ax.set_ylabel(join_unit("error", unit), fontsize=NORMAL, color=INK)
    for ax in grid.flat[len(rows) :]:
        ax.set_visible(False)
    add_legend(figure, _line_entries(styles, f"{bound:g} {unit}" if bound is not None else None))
    return figure


def _styles_of(
    name: str, curves: Mapping[str, Any], field: str, source: str
) -> dict[str, dict[str, Any]]:
    """Return the style of each curve by its method.

    Args:
        name: of the curves, for messages. field: that each has. source: function of `torchpose.metrics` that
            returns them.

    Raises:
        InputError: curves without names, or something else.
    """
    check_named(name, curves, f'{{"tracker": torchpose.metrics.{source}(...)}}')
    for method, curve in curves.items():
        if not hasattr(curve, field):
            kind = type(curve).__name__
            raise InputError(
                f"{name}[{method!r}] must be the result of torchpose.metrics.{source}, got {kind}"
            )
    return method_styles(list(curves))


def _line_entries(styles: Mapping[str, Mapping[str, Any]], bound: str | None = None) -> list[Any]:
    entries = [legend_line(name, linewidth=1.8, **style) for name, style in styles.items()]
    if bound is not None:
        entries.append(legend_line(bound, MUTED, linewidth=0.9))
    return entries


def plot_error_bars(
    errors: Mapping[str, Float[Tensor, "... 8"]],
    unit: str = "cm",
    scale: float = 100.0,
    title: str | None = None,
) -> Figure:
    """Return the mean error of each joint, one bar for each method (paper's Figures 3 and 10).

    The thin line on a bar runs from the first to the third quartile.

    Args:
        errors: the errors by method, [..., 8], from `torchpose.metrics.joint_errors`; NaN are left out.
        unit, scale: as in `plot_errors_over_time`.
        title: above the picture.

    Returns:
        matplotlib `Figure`.

    Raises:
        ShapeError: errors of another number of joints. InputError: no frame, no method, or errors
            without names. MissingDependencyError: matplotlib is missing.
    """
    require_matplotlib()
    from matplotlib.patches import Patch

    styles = _styles_of("errors", errors, "shape", "joint_errors")
    figure = new_figure(9.2, 4.2, title)
    ax = style_axes(figure.add_subplot(), y=join_unit("mean error", unit))
    ax.grid(False, axis="x")
    width = 0.8 / len(errors)
    entries: list[Any] = []
    for i, (name, values) in enumerate(errors.items()):
        values = torch.as_tensor(values)
        check_shape(f"errors[{name!r}]", values, ["...", 8])
        if values.numel() == 0:
            raise InputError(f"errors[{name!r}] must hold at least one frame, got none")
        flat = scale * values.detach().cpu().double().reshape(-1, 8)
        mean = to_numpy(flat.nanmean(0))
        levels = torch.tensor([0.25, 0.75], dtype=torch.float64)
        low, high = to_numpy(torch.nanquantile(flat, levels, dim=0))
        place = torch.arange(8).numpy() - 0.4 + (i + 0.5) * width
        filled = bar_style(i, styles[name]["color"])
        ax.bar(place, mean, 0.9 * width, **filled)
        ax.vlines(place, low, high, color=INK, linewidth=1.1)
        average = float(flat.nanmean())
        label = f"{name} (mean {average:.1f} {unit})"
        entries.append(Patch(**filled, label=label))
    entries.append(legend_line("middle half of the errors", linewidth=1.1))
    ax.set_xticks(range(8), [readable(n).replace(" ", "\n") for n in UPPER_BODY])
    ax.tick_params(axis="x", length=0, labelsize=NORMAL, labelcolor=INK)
    ax.set_ylim(bottom=0)
    add_legend(figure, entries)
    return figure


def plot_pcp(curves: Mapping[str, PCP], by_limb: bool = False, title: str | None = None) -> Figure:
    """Return the percentage of correct parts over the threshold (paper's Figures 4 and 13).

    Args:
        curves: the curves by method, from `torchpose.metrics.pcp`.
        by_limb: panels for upper arms and forearms beside the one for all four; the curves must
            then have the limbs of `torchpose.metrics.ARM_LIMBS`.
        title: above the picture.

    Returns:
        matplotlib `Figure`.

    Raises:
        InputError: curves without names, or `by_limb` and curves of other limbs. MissingDependencyError:
            matplotlib is missing.
    """
    styles = _styles_of("curves", curves, "overall", "pcp")
    parts: dict[str, list[int] | None] = {"upper arms and forearms": None}
    if by_limb:
        parts |= {"upper arms": [0, 2], "forearms": [1, 3]}
    figure = new_figure(4.2 * len(parts) + 1.4 * (len(parts) == 1), 4.1, title)
    panels = figure.subplots(1, len(parts), sharey=True, squeeze=False)[0]
    for ax, (part, limbs) in zip(panels, parts.items(), strict=True):
        style_axes(ax, "threshold (fraction of the limb's true length)", title=part)
        for name, curve in curves.items():
            share = curve.overall if limbs is None else _share_of(curve, limbs)
            ax.plot(
                to_numpy(curve.thresholds), 100 * to_numpy(share), linewidth=1.9, **styles[name]
            )
        ax.set(ylim=(0, 101), xlim=(0, None))
        ax.axvline(0.5, color=PALE, linewidth=0.9, zorder=1)
    panels[0].set_ylabel("correct limbs (%)", fontsize=NORMAL, color=INK)
    add_legend(figure, _line_entries(styles))
    return figure


def _share_of(curve: PCP, limbs: list[int]) -> Tensor:
    """Return the share of correct parts among some of the four limbs of the arms."""
    if curve.per_limb.shape[0] != 4:
        raise InputError(
            f"by_limb needs the four limbs of ARM_LIMBS, got {curve.per_limb.shape[0]}"
        )
    n = curve.counts[limbs].to(curve.per_limb.dtype)
    return (curve.per_limb[limbs].nan_to_num() * n[:, None]).sum(0) / n.sum()


def plot_reliability(
    curves: Coverage | Mapping[str, Coverage],
    names: Sequence[str] = UPPER_BODY,
    tolerance: float = 0.05,
    title: str | None = None,
) -> Figure:
    """Return the reliability diagram of each joint: share inside the ellipsoid over its probability.

    A covariance is calibrated on the diagonal, too small (overconfident) below it, too large above it.

    Args:
        curves: the curves from `torchpose.metrics.reliability`, one or several by name.
        names: the names of the joints, one panel each.
        tolerance: half width of the grey band about the diagonal (0.05 = 5 points).
        title: above the picture.

    Returns:
        matplotlib `Figure`, a panel for each joint.

    Raises:
        ShapeError: a curve of another number of joints. InputError: curves without names.
            MissingDependencyError: matplotlib is missing.
    """
    require_matplotlib()
    from matplotlib.patches import Patch

    by_name = {"estimate": curves} if isinstance(curves, Coverage) else curves
    styles = _styles_of("curves", by_name, "per_joint", "reliability")
    columns = min(4, len(names))
    lines = math.ceil(len(names) / columns)
    figure = new_figure(2.5 * columns, 2.6 * lines + 0.8, title)
    grid = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
    for place, joint in enumerate(names):
        ax = style_axes(grid.flat[place], title=readable(joint))
        ax.fill_between(
            [0, 100], [-100 * tolerance, 100 - 100 * tolerance],
            [100 * tolerance, 100 + 100 * tolerance], color=_BAND, linewidth=0, zorder=0,
        )  # fmt: skip
        ax.plot([0, 100], [0, 100], color=MUTED, linewidth=0.9, zorder=1)
        for name, curve in by_name.items():
            check_shape(f"curves[{name!r}].per_joint", curve.per_joint, [None, len(names)])
            ax.plot(
                100 * to_numpy(curve.levels), 100 * to_numpy(curve.per_joint[:, place]),
                linewidth=1.9, **styles[name],
            )  # fmt: skip
        ax.set(xlim=(0, 100), ylim=(0, 100), xticks=[0, 50, 100], yticks=[0, 50, 100])
        ax.set_aspect("equal")
        if place % columns == 0:
            ax.set_ylabel("true joints\ninside (%)", fontsize=NORMAL, color=INK)
        if place // columns == lines - 1:
            ax.set_xlabel("nominal (%)", fontsize=NORMAL, color=INK)
    for ax in grid.flat[len(names) :]:
        ax.set_visible(False)
    band = Patch(color=_BAND, label=f"within {100 * tolerance:g} points")
    add_legend(figure, [*_line_entries(styles), band])
    return figure
