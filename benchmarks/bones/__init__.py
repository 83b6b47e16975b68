"""Arms of strangers, by trackers and by elementary geometry: `python -m benchmarks.bones`."""

from benchmarks.bones.fits import SETS, fit_without
from benchmarks.bones.scoring import (
    METHODS,
    Chains,
    errors,
    lifted,
    lifts,
    limbs,
    poses_of,
    tracked,
    trackers,
    true_lengths,
)
from benchmarks.bones.tables import FEW, FIT, FOUR
from benchmarks.bones.views import (
    ENDS,
    View,
    arm_rows,
    at_rate,
    begun,
    kinect_views,
    mhad_views,
    openpose_views,
    recordings,
    seen_by_camera,
    with_arms,
)

__all__ = [
    "ENDS",
    "FEW",
    "FIT",
    "FOUR",
    "METHODS",
    "SETS",
    "Chains",
    "View",
    "arm_rows",
    "at_rate",
    "begun",
    "errors",
    "fit_without",
    "kinect_views",
    "lifted",
    "lifts",
    "limbs",
    "mhad_views",
    "openpose_views",
    "poses_of",
    "recordings",
    "seen_by_camera",
    "tracked",
    "trackers",
    "true_lengths",
    "with_arms",
]
