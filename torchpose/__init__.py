"""Bayesian human-pose tracking: from video or 2D keypoints to 3D poses with covariances.

The names below are imported when they are first used, so `import torchpose` itself is quick and
needs neither matplotlib nor Lightning nor OpenCV, and never a network.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchpose.camera import PinholeCamera as PinholeCamera
    from torchpose.errors import TorchposeError as TorchposeError
    from torchpose.pose_track import PoseTrack as PoseTrack
    from torchpose.priors.gmm import GaussianMixture as GaussianMixture
    from torchpose.priors.shipped import load_action as load_action
    from torchpose.priors.shipped import load_limb_conditionals as load_limb_conditionals
    from torchpose.priors.shipped import load_manifold as load_manifold
    from torchpose.priors.upper_body import UpperBodyPrior as UpperBodyPrior
    from torchpose.priors.upper_body import load_prior as load_prior
    from torchpose.tracking import UpperBodyTracker as UpperBodyTracker
    from torchpose.value_checks import without_value_checks as without_value_checks
    from torchpose.video_tracker import VideoTracker as VideoTracker

    __version__: str

_SUBMODULES = frozenset(
    {
        "body",
        "calibration",
        "camera",
        "camera_rig",
        "demo",
        "errors",
        "filters",
        "gaussian",
        "io",
        "joint_sets",
        "lifting",
        "mannequin",
        "measure",
        "measurements",
        "metrics",
        "pose_track",
        "priors",
        "projection",
        "protocols",
        "recipes",
        "recording",
        "rendering",
        "report",
        "rotation_gaussians",
        "rotations",
        "skeleton",
        "torchmetrics_adapters",
        "tracking",
        "unscented",
        "value_checks",
        "video",
        "video_tracker",
        "viz",
    }
)
_HOME = {
    "GaussianMixture": "torchpose.priors.gmm",
    "PinholeCamera": "torchpose.camera",
    "PoseTrack": "torchpose.pose_track",
    "TorchposeError": "torchpose.errors",
    "UpperBodyPrior": "torchpose.priors.upper_body",
    "UpperBodyTracker": "torchpose.tracking",
    "VideoTracker": "torchpose.video_tracker",
    "load_action": "torchpose.priors.shipped",
    "load_limb_conditionals": "torchpose.priors.shipped",
    "load_manifold": "torchpose.priors.shipped",
    "load_prior": "torchpose.priors.upper_body",
    "without_value_checks": "torchpose.value_checks",
}

__all__ = [
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


def __getattr__(name: str) -> Any:
    if name == "__version__":
        value: Any = _version()
    elif name in _SUBMODULES:
        value = import_module(f"torchpose.{name}")
    elif name in _HOME:
        value = getattr(import_module(_HOME[name]), name)
    else:
        raise AttributeError(f"module 'torchpose' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_SUBMODULES, *_HOME, "__version__"})


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("torchpose")
    except PackageNotFoundError:  # run from a source tree that is not installed
        return "0+unknown"
