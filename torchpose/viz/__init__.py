"""Draw poses, priors and errors, each picture a matplotlib `Figure`.

matplotlib is imported when a picture is made, and the names below when they are first used. Of matplotlib
only the object interface is used: no pyplot, no global settings. In all pictures the person's left is blue,
the right is orange and the middle is grey. A filled joint was measured, a hollow one was inferred. The
colours are the palette of Okabe & Ito, which colour-blind readers can distinguish; lines differ in their
dashes as well.
"""

from typing import TYPE_CHECKING

from torchpose._core.facade import set_up_facade

if TYPE_CHECKING:
    from torchpose.viz._charts import (
        plot_error_bars,
        plot_errors_over_time,
        plot_joint_curves,
        plot_pcp,
        plot_reliability,
    )
    from torchpose.viz._model_pictures import plot_action_space, plot_manifold
    from torchpose.viz._report.page import write_report
    from torchpose.viz._rotation_picture import plot_rotations
    from torchpose.viz._skeletons import (
        draw_skeleton,
        plot_pose,
        plot_pose_3d,
        plot_pose_strip,
        plot_prior_means,
    )
    from torchpose.viz._style import save_figure

__all__ = [
    "draw_skeleton",
    "plot_action_space",
    "plot_error_bars",
    "plot_errors_over_time",
    "plot_joint_curves",
    "plot_manifold",
    "plot_pcp",
    "plot_pose",
    "plot_pose_3d",
    "plot_pose_strip",
    "plot_prior_means",
    "plot_reliability",
    "plot_rotations",
    "save_figure",
    "write_report",
]

set_up_facade(
    __name__,
    {  # so that a process that draws imports no more than it needs
        "_charts": "plot_error_bars plot_errors_over_time plot_joint_curves plot_pcp plot_reliability",
        "_model_pictures": "plot_action_space plot_manifold",
        "_report.page": "write_report",
        "_rotation_picture": "plot_rotations",
        "_skeletons": "draw_skeleton plot_pose plot_pose_3d plot_pose_strip plot_prior_means",
        "_style": "save_figure",
    },
)
