"""Draw uncertain rotations on a sphere, as the directions to which they turn one direction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchpose._core.checks import (
    check_finite,
    check_flat_covariance,
    check_shape,
    check_tensors,
)
from torchpose.errors import InputError
from torchpose.math._rotations import compose, quaternion_vector_to_matrix
from torchpose.math._unscented import sigma_points
from torchpose.viz._style import (
    GRID,
    INK,
    LEFT,
    NORMAL,
    PALE,
    RIGHT,
    add_legend,
    check_named,
    legend_line,
    new_figure,
    to_numpy,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:
    Axes = Figure = Any

_WIDTH, _COLUMNS = 3.3, 4
_STEPS = 24  # of an arc from the mean to a sigma point


def plot_rotations(
    gaussians: Mapping[str, tuple[Tensor, Tensor, Tensor | None]],
    direction: Tensor | Sequence[float] = (0.0, -1.0, 0.0),
    *,
    view: tuple[float, float] = (35.0, 15.0),
    draws: int = 1500,
    generator: torch.Generator | None = None,
    title: str | None = None,
) -> Figure:
    """Return Gaussians over rotations as clouds of a rotated direction, with their sigma points.

    Each panel is a unit sphere. Pale points are draws; arcs lead from the mean to the six sigma points
    (DX 2). Points on the far side are fainter.

    Args:
        gaussians: the Gaussians by name, mean [3], covariance [3, 3] and centre [3] (or None) of each.
        direction: that is rotated, [3]; by default that of a hanging limb in its part's axes.
        view: the view of the virtual camera, degrees: from the front to the person's left, and upwards.
        draws: points of each cloud. generator: the generator of the draws. title: above the panels.

    Returns:
        matplotlib `Figure`, a panel for each Gaussian.

    Raises:
        InputError: nothing to draw, something without a name or that is no Gaussian, or no direction.
            ShapeError: sizes other than these.

    Reference: Daubney & Xie, Figure 3.
    """
    check_named("gaussians", gaussians, '{"upper arm": (mean, covariance, None)}')
    if not gaussians:
        raise InputError("a picture of rotations needs at least one Gaussian, got none")
    axis = torch.as_tensor(direction, dtype=torch.float64)
    check_shape("direction", axis, [3])
    if not bool(axis.norm() > 0):
        raise InputError("direction must have a length, got zeros")
    if not isinstance(draws, int) or draws < 0:
        raise InputError(f"draws must be a whole number of 0 or more, got {draws!r:.60}")
    checked = {name: _checked(name, gaussian) for name, gaussian in gaussians.items()}
    columns = min(len(gaussians), _COLUMNS)
    rows = -(-len(gaussians) // columns)
    figure = new_figure(_WIDTH * columns, _WIDTH * rows + 0.6 + 0.4 * (title is not None), title)
    camera = _camera(*view)
    for index, (name, gaussian) in enumerate(checked.items()):
        ax = figure.add_subplot(rows, columns, index + 1)
        _sphere(ax, camera)
        _cloud(ax, camera, gaussian, axis / axis.norm(), draws, generator)
        ax.set_ylim(-1.08, 1.3)
        ax.text(0, 1.13, name, fontsize=NORMAL, color=INK, ha="center")
    add_legend(figure, _legend())
    return figure


def _checked(name: str, gaussian: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Return mean, covariance and centre in double precision, or raise for what is no Gaussian."""
    if not isinstance(gaussian, tuple | list) or len(gaussian) != 3:
        raise InputError(
            f"gaussians[{name!r}] must be a mean, a covariance and a centre or None, got "
            f"{type(gaussian).__name__}"
        )
    mean, covariance, centre = gaussian
    centre = torch.zeros(3) if centre is None else centre
    values = {"mean": (mean, [3]), "covariance": (covariance, [3, 3]), "centre": (centre, [3])}
    for what, (value, sizes) in values.items():
        check_tensors(**{what: value})
        check_shape(what, value, sizes)
        check_finite(what, value)
    check_flat_covariance("covariance", covariance)
    mean, covariance, centre = (v.detach().cpu().double() for v in (mean, covariance, centre))
    return mean, covariance, centre


def _camera(across: float, above: float) -> Tensor:
    """Return the rows: right, up and towards the viewer, in axes whose y points up and z to the front."""
    a, b = torch.tensor([across, above], dtype=torch.float64).deg2rad()
    right = torch.stack([a.cos(), torch.zeros_like(a), -a.sin()])
    near = torch.stack([b.cos() * a.sin(), b.sin(), b.cos() * a.cos()])
    return torch.stack([right, torch.linalg.cross(near, right), near])


def _sphere(ax: Axes, camera: Tensor) -> None:
    """Draw the outline, and the near half of meridians and circles of latitude every 30 degrees."""
    turn = torch.linspace(0, 2 * torch.pi, 181, dtype=torch.float64)
    zero = torch.zeros_like(turn)
    ax.plot(turn.cos().numpy(), turn.sin().numpy(), color=PALE, linewidth=1.2)
    for degrees in range(0, 180, 30):
        angle = torch.tensor(float(degrees)).double().deg2rad()
        meridian = torch.stack([turn.cos() * angle.cos(), turn.sin(), turn.cos() * angle.sin()])
        height = (angle - torch.pi / 2).sin() + zero
        circle = torch.stack([angle.sin() * turn.cos(), height, angle.sin() * turn.sin()])
        for line in (meridian, circle):
            x, y, near = to_numpy(camera @ line)
            x[near < 0] = float("nan")
            ax.plot(x, y, color=GRID, linewidth=0.8, zorder=0)
    ax.set_aspect("equal")
    ax.set_xlim(-1.08, 1.08)
    ax.axis("off")


def _cloud(
    ax: Axes,
    camera: Tensor,
    gaussian: tuple[Tensor, Tensor, Tensor],
    direction: Tensor,
    count: int,
    generator: torch.Generator | None,
) -> None:
    mean, covariance, centre = gaussian

    def seen(x: Tensor) -> Any:
        """Return the rotated direction: right, up and towards the viewer, [3, ...]."""
        turned = quaternion_vector_to_matrix(compose(centre, x)) @ direction
        return to_numpy((turned @ camera.mT).movedim(-1, 0))

    values, axes = torch.linalg.eigh(covariance)
    noise = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    draws = mean + (noise * values.clamp_min(0).sqrt()) @ axes.mT
    x, y, near = seen(draws)
    for part, alpha in ((near >= 0, 0.35), (near < 0, 0.1)):
        ax.scatter(x[part], y[part], s=4, color=LEFT, alpha=alpha, linewidths=0)
    points = sigma_points(mean, covariance)
    share = torch.linspace(0, 1, _STEPS, dtype=torch.float64)[:, None, None]
    x, y, near = seen(mean + share * (points - mean))  # [steps, 6]
    for k in range(points.shape[0]):
        faint = 0.35 if near[-1, k] < 0 else 1.0
        ax.plot(x[:, k], y[:, k], color=RIGHT, linewidth=1.4, alpha=faint)
        ax.plot(x[-1, k], y[-1, k], "o", color=RIGHT, markersize=6, alpha=faint)
    ax.plot(x[0, 0], y[0, 0], "o", color=INK, markersize=7)


def _legend() -> list[Any]:
    kinds = (("draws", LEFT, 3), ("sigma points", RIGHT, 6), ("mean", INK, 7))
    return [
        legend_line(label, color, marker="o", markersize=size, linestyle="")
        for label, color, size in kinds
    ]
