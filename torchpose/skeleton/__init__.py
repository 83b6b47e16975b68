"""Name joint sets and their trees, and find the eight joints of the upper body in them."""

from torchpose._core.facade import set_up_facade
from torchpose.skeleton._joint_sets import SKELETONS, UPPER_BODY, Skeleton, canonical_name
from torchpose.skeleton._upper_body import LEFT_ARM, RIGHT_ARM, to_upper_body, upper_body_indices

__all__ = [
    "LEFT_ARM",
    "RIGHT_ARM",
    "SKELETONS",
    "UPPER_BODY",
    "Skeleton",
    "canonical_name",
    "to_upper_body",
    "upper_body_indices",
]

set_up_facade(__name__)
