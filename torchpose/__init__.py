"""Bayesian human-pose tracking: from video or 2D keypoints to 3D poses with covariances.

The names below are imported when they are first used, so `import torchpose` itself is quick and
needs neither matplotlib nor Lightning nor OpenCV, and never a network.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchpose._core.value_checks import without_value_checks
    from torchpose.camera.pinhole import PinholeCamera
    from torchpose.errors import TorchposeError
    from torchpose.priors.gaussian_mixture import GaussianMixture
    from torchpose.priors.shipped import load_action, load_limb_conditionals, load_manifold
    from torchpose.priors.upper_body import UpperBodyPrior, load_prior
    from torchpose.upper_body.pose_track import PoseTrack
    from torchpose.upper_body.tracker import UpperBodyTracker
    from torchpose.video.tracker import VideoTracker

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
    "GaussianMixture": "torchpose.priors.gaussian_mixture",
    "PinholeCamera": "torchpose.camera",
    "PoseTrack": "torchpose.upper_body.pose_track",
    "TorchposeError": "torchpose.errors",
    "UpperBodyPrior": "torchpose.priors.upper_body",
    "UpperBodyTracker": "torchpose.upper_body.tracker",
    "VideoTracker": "torchpose.video.tracker",
    "load_action": "torchpose.priors.shipped",
    "load_limb_conditionals": "torchpose.priors.shipped",
    "load_manifold": "torchpose.priors.shipped",
    "load_prior": "torchpose.priors.upper_body",
    "without_value_checks": "torchpose._core.value_checks",
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
