"""Bayesian human-pose tracking: from video or 2D keypoints to 3D poses with covariances.

The names below are imported when they are first used, so `import torchpose` itself is quick and
needs neither matplotlib nor Lightning nor OpenCV, and never a network.
"""

from importlib import import_module as _import_module
from typing import TYPE_CHECKING

from torchpose._core import moved as _moved
from torchpose._core.facade import package_version as _package_version

if TYPE_CHECKING:
    from torchpose import body as body
    from torchpose import camera as camera
    from torchpose import demo as demo
    from torchpose import errors as errors
    from torchpose import evaluation as evaluation
    from torchpose import filters as filters
    from torchpose import io as io
    from torchpose import learning as learning
    from torchpose import math as math
    from torchpose import measure as measure
    from torchpose import metrics as metrics
    from torchpose import priors as priors
    from torchpose import skeleton as skeleton
    from torchpose import upper_body as upper_body
    from torchpose import video as video
    from torchpose import viz as viz
    from torchpose import whole_body as whole_body
    from torchpose._core.value_checks import without_value_checks as without_value_checks
    from torchpose.camera._pinhole import PinholeCamera as PinholeCamera
    from torchpose.errors import TorchposeError as TorchposeError
    from torchpose.priors._gaussian_mixture import GaussianMixture as GaussianMixture
    from torchpose.priors._shipped import load_action as load_action
    from torchpose.priors._shipped import load_limb_conditionals as load_limb_conditionals
    from torchpose.priors._shipped import load_manifold as load_manifold
    from torchpose.priors._upper_body_prior import UpperBodyPrior as UpperBodyPrior
    from torchpose.priors._upper_body_prior import load_prior as load_prior
    from torchpose.upper_body._pose_track import PoseTrack as PoseTrack
    from torchpose.upper_body._upper_body_tracker import UpperBodyTracker as UpperBodyTracker
    from torchpose.video._video_tracker import VideoTracker as VideoTracker
    from torchpose.whole_body._body_track import BodyTrack as BodyTrack
    from torchpose.whole_body._body_tracker import BodyTracker as BodyTracker

    __version__: str

_PACKAGES = frozenset(
    [
        "body",
        "camera",
        "demo",
        "errors",
        "evaluation",
        "filters",
        "io",
        "learning",
        "math",
        "measure",
        "metrics",
        "priors",
        "skeleton",
        "upper_body",
        "video",
        "viz",
        "whole_body",
    ]
)
_HOMES = {
    "BodyTrack": "whole_body._body_track",
    "BodyTracker": "whole_body._body_tracker",
    "GaussianMixture": "priors._gaussian_mixture",
    "PinholeCamera": "camera._pinhole",
    "PoseTrack": "upper_body._pose_track",
    "TorchposeError": "errors",
    "UpperBodyPrior": "priors._upper_body_prior",
    "UpperBodyTracker": "upper_body._upper_body_tracker",
    "VideoTracker": "video._video_tracker",
    "load_action": "priors._shipped",
    "load_limb_conditionals": "priors._shipped",
    "load_manifold": "priors._shipped",
    "load_prior": "priors._upper_body_prior",
    "without_value_checks": "_core.value_checks",
}

__all__ = [
    "BodyTrack",
    "BodyTracker",
    "GaussianMixture",
    "PinholeCamera",
    "PoseTrack",
    "TorchposeError",
    "UpperBodyPrior",
    "UpperBodyTracker",
    "VideoTracker",
    "load_action",
    "load_limb_conditionals",
    "load_manifold",
    "load_prior",
    "without_value_checks",
]

_moved.install()


if not TYPE_CHECKING:  # which would take every name for an object

    def __getattr__(name: str) -> object:
        value: object
        if name == "__version__":
            value = _package_version()
        elif name in _HOMES:
            value = getattr(_import_module(f"torchpose.{_HOMES[name]}"), name)
        elif name in _PACKAGES or _moved.present_module(f"torchpose.{name}"):
            value = _import_module(f"torchpose.{name}")
        else:
            return _moved.moved_names("torchpose")(name)  # or raises
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*__all__, *_PACKAGES, "__version__", "__doc__", "__file__", "__name__"})
