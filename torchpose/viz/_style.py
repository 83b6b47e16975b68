"""Define the style of all pictures: colours, figures without global state, legends, saving."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchpose.errors import InputError, MissingDependencyError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:
    Axes = Figure = Any

INK, MUTED, PALE, GRID = "#222222", "#666666", "#B8B8B8", "#E4E4E4"
LEFT, RIGHT, MIDDLE = "#0072B2", "#D55E00", "#555555"
SIDE_COLORS = {"left": LEFT, "right": RIGHT, "middle": MIDDLE}
_METHODS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1.5, 1)), (0, (5, 1, 1, 1)), (0, (8, 2)),
                            (0, (3, 1, 1, 1, 1, 1)))  # fmt: skip
_HATCHES = ("", "///", "...", "xxx")
SMALL, NORMAL, LARGE = 9.0, 10.0, 11.5
_EDGE = 0.1  # inches to either side of a title
_DPI = 150  # of pictures in pixels


def require_matplotlib() -> None:
    """Raise `MissingDependencyError` if matplotlib is not installed."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError(
            "pictures need the package matplotlib, which is not installed; "
            "run `python -m pip install matplotlib`"
        ) from error


def new_figure(width: float, height: float, title: str | None = None) -> Figure:
    """Return an empty white figure of the given size in inches, laid out so that nothing overlaps.

    It is wider where its title needs that.
    """
    require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as MatplotlibFigure

    figure = MatplotlibFigure(figsize=(width, height), layout="constrained", facecolor="white")
    canvas = FigureCanvasAgg(figure)
    if title:
        text = figure.suptitle(title, fontsize=LARGE, color=INK, fontweight="bold")
        needed = text.get_window_extent(canvas.get_renderer()).width / figure.dpi + 2 * _EDGE
        figure.set_figwidth(max(width, needed))
    return figure


def style_axes(ax: Axes, x: str = "", y: str = "", title: str = "", grid: bool = True) -> Axes:
    """Return axes with a light grid, no box, labels of one size, and ticks at round numbers."""
    from matplotlib.ticker import MaxNLocator

    for axis in (ax.xaxis, ax.yaxis):
        locator = axis.get_major_locator()
        if isinstance(locator, MaxNLocator):
            locator.set_params(steps=[1, 2, 5, 10])
    ax.set_xlabel(x, fontsize=NORMAL, color=INK)
    ax.set_ylabel(y, fontsize=NORMAL, color=INK)
    ax.set_title(title, fontsize=NORMAL, color=INK)
    ax.tick_params(labelsize=SMALL, colors=MUTED, length=3)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        ax.spines[side].set_color(PALE)
    ax.set_axisbelow(True)
    if grid:
        ax.grid(color=GRID, linewidth=0.8)
    return ax


def add_legend(figure: Figure, handles: Iterable[Any]) -> None:
    """Add a legend below the panels, in as many columns as fit the width, which becomes that of one."""
    entries = list(handles)
    if not entries:
        return
    widest = max(0.075 * len(entry.get_label()) + 0.7 for entry in entries)  # inches
    figure.set_figwidth(max(figure.get_figwidth(), widest))
    fitting = min(len(entries), int(figure.get_figwidth() / widest))
    columns = math.ceil(len(entries) / math.ceil(len(entries) / fitting))
    figure.legend(
        handles=entries,
        loc="outside lower center",
        ncols=columns,
        frameon=False,
        fontsize=SMALL + 0.5,
        labelcolor=INK,
        handlelength=2.6,
    )


def legend_line(label: str, color: str = INK, **style: Any) -> Any:
    """Return the entry of a legend for a line or marker, with matplotlib's options of a `Line2D`."""
    from matplotlib.lines import Line2D

    return Line2D([], [], color=color, label=label, **style)


def weight_bar(ax: Axes, weight: float, share: float) -> None:
    """Draw a weight as the title of a panel, and its share of the largest one as a bar below."""
    ax.set_title(f"{100 * weight:.1f} %" if weight >= 5e-4 else "< 0.1 %",
                 fontsize=SMALL, color=INK, pad=7)  # fmt: skip
    for length, color in ((1.0, GRID), (share, INK)):
        ax.plot([0, length], [1.03, 1.03], transform=ax.transAxes, color=color, linewidth=3,
                clip_on=False, solid_capstyle="butt")  # fmt: skip


def label_row(ax: Axes, text: str) -> None:
    """Draw an upright label to the left of a panel without axes."""
    ax.text(0.0, 0.5, text, transform=ax.transAxes, rotation=90, va="center", ha="right",
            fontsize=SMALL, color=MUTED)  # fmt: skip


def check_named(name: str, values: Any, example: str) -> None:
    """Raise `InputError` unless what is drawn goes by names."""
    if not isinstance(values, Mapping):
        raise InputError(
            f"{name} must go by names, as in {example}, got {type(values).__name__}; give it a name"
        )


def method_styles(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return colour and dashes of each method, in their order; where colours come again, dashes differ."""
    if not names:
        raise InputError("expected at least one named curve, got none")
    styles = {}
    for i, name in enumerate(names):
        again, color = divmod(i, len(_METHODS))
        dashes = _DASHES[(i + again) % len(_DASHES)]
        styles[name] = {"color": _METHODS[color], "linestyle": dashes}
    return styles


def bar_style(i: int, color: str) -> dict[str, Any]:
    """Return how the bars of method i are filled; where colours come again, with another hatch."""
    hatch = _HATCHES[i // len(_METHODS) % len(_HATCHES)]
    return {
        "facecolor": color,
        "edgecolor": "white",
        "linewidth": 0.0,
        "hatch": hatch,
        "alpha": 0.85,
    }


def joint_colors(names: Sequence[str]) -> list[str]:
    """Return the colour of each joint: blue for the left, orange for the right, grey for the middle."""
    return [SIDE_COLORS[side_of(name)] for name in names]


def side_of(name: str) -> str:
    """Return "left", "right" or "middle", the side of a joint by its name.

    >>> side_of("hand_left"), side_of("right_knee"), side_of("neck")
    ('left', 'right', 'middle')
    """
    return next((side for side in ("left", "right") if side in name.split("_")), "middle")


def readable(name: str) -> str:
    """Return a joint's name in words, its side first: ``hand_left`` as ``left hand``.

    >>> readable("hand_left"), readable("left_wrist"), readable("right_upper_arm")
    ('left hand', 'left wrist', 'right upper arm')
    """
    side = side_of(name)
    return " ".join(sorted(name.split("_"), key=lambda word: word != side))


def join_unit(label: str, unit: str) -> str:
    """Return a label with its unit, such as ``error (cm)``."""
    return f"{label} ({unit})" if unit else label


def to_numpy(tensor: Any) -> Any:
    """Return a tensor as a NumPy array in float64 (bool stays), on the CPU and out of the graph."""
    import numpy as np

    array = tensor.detach().cpu().numpy() if hasattr(tensor, "detach") else np.asarray(tensor)
    return array if array.dtype == bool else array.astype(float)


def png_of(figure: Figure) -> bytes:
    """Return the file that `save_figure` would write."""
    file = io.BytesIO()
    figure.savefig(file, dpi=_DPI, format="png")
    return file.getvalue()


def save_figure(figure: Figure, path: str | Path, dpi: int = _DPI) -> Path:
    """Write a picture, atomically; the suffix gives the format (png, svg, pdf).

    Args:
        figure: from a function of `torchpose.viz`, or any other.
        path: the file, which is replaced.
        dpi: dots per inch, of pixel formats.

    Returns:
        The path.

    Raises:
        InputError: a suffix that matplotlib cannot write.
        OutputError: the folder is missing or not writable.
    """
    from torchpose._core.files import atomic_path

    path = Path(path)
    kinds = figure.canvas.get_supported_filetypes()
    if path.suffix[1:].lower() not in kinds:
        raise InputError(f"{path}: expected a suffix among {', '.join(kinds)}")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=dpi)
    return path
