"""Draw the poses of a whole body as a strip of frames."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.checks import check_shape
from torchpose.body._feet import FEET, FOOT_BONES
from torchpose.body._skeleton import BODY_15, BodySkeleton
from torchpose.viz._pose_drawing import measured_entries
from torchpose.viz._skeletons import (
    _choose_frames,
    _limits,
    _set_view,
    draw_skeleton,
)
from torchpose.viz._style import (
    INK,
    LEFT,
    RIGHT,
    SMALL,
    add_legend,
    joint_colors,
    label_row,
    legend_line,
    new_figure,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure
else:
    Figure = Any

_VIEWS = {"camera": (0, 1), "side": (2, 1)}


def plot_body_strip(
    joints: Float[Tensor, "T J 3"],
    skeleton: BodySkeleton = BODY_15,
    *,
    n_frames: int = 6,
    fps: float = 30.0,
    first_frame: int = 0,
    observed: Bool[Tensor, "T J"] | None = None,
    feet: Float[Tensor, "T 6 3"] | None = None,
) -> Figure:
    """Return some frames of a body at one scale, as a camera sees it and from the side.

    Each pose is centred on its root.

    Args:
        joints: camera axes, metres. skeleton: whose joints they are.
        n_frames: number of frames to draw, spread over all. fps: frames per second, for the times above.
        first_frame: number of the first frame. feet: heels and toes of a body of fifteen joints, in the same
            axes, if they were tracked. observed: True = measured, of joints and feet; others are hollow.

    Raises:
        ShapeError: joints of another shape. InputError: no frame.
            MissingDependencyError: matplotlib is missing.
    """
    check_shape("joints", joints, [None, len(skeleton.names), 3])
    names = skeleton.names
    limbs = [(parent, joint) for joint, parent in enumerate(skeleton.parents) if parent >= 0]
    if feet is not None:
        joints, names = torch.cat([joints, feet.to(joints)], 1), (*names, *FEET)
        limbs += FOOT_BONES
    frames = _choose_frames(None, n_frames, len(joints))
    centred = joints - joints[:, :1]
    low, high = _limits(centred[frames], margin=0.06)
    wide = float(torch.maximum((high - low)[0], (high - low)[2]))
    middle = float(low[0] + high[0]) / 2
    low[0], high[0] = middle - wide / 2, middle + wide / 2
    tall = 1.6 * float(high[1] - low[1]) / wide
    figure = new_figure(1.6 * len(frames), 2 * tall + 1.0)
    grid = figure.subplots(2, len(frames), squeeze=False)
    for column, frame in enumerate(frames):
        for row, (name, pick) in enumerate(_VIEWS.items()):
            ax = grid[row, column]
            ax.set_axis_off()
            draw_skeleton(
                ax, centred[frame][:, pick], observed=None if observed is None else observed[frame],
                colors=joint_colors(names), limbs=limbs, linewidth=2.2,
            )  # fmt: skip
            _set_view(ax, low, high, pick)
            if column == 0:
                label_row(ax, name)
        title = f"{(frame + first_frame) / fps:.1f} s"
        grid[0, column].set_title(title, fontsize=SMALL, color=INK)
    entries = [
        legend_line(f"person's {side}", color, linewidth=3)
        for side, color in (("left", LEFT), ("right", RIGHT))
    ]
    add_legend(figure, entries + ([] if observed is None else measured_entries()))
    return figure
