"""Name the keypoints of models by how many there are, and make those that the tracker takes of them."""

from collections.abc import Sequence
from typing import NamedTuple

import torch

from torchpose._core.rows import joined
from torchpose.errors import InputError
from torchpose.measure._detectors.protocol import Detections
from torchpose.skeleton._joint_sets import COCO, HALPE, WHOLE_BODY
from torchpose.skeleton._mediapipe_landmarks import LANDMARKS

_HAND = 0.7  # of the way from the wrist to the knuckle of the middle finger, as with MediaPipe's index finger
_WRISTS, _KNUCKLES = [9, 10], [100, 121]  # of COCO-WholeBody, left and right


class JointSet(NamedTuple):
    """Holds the selection among the keypoints of a model.

    Attributes:
        title: of the set. names: of what is taken.
        places: of these among the keypoints of the model, the first ones if None.
        hands: whether hands follow, made of wrists and knuckles.
    """

    title: str
    names: tuple[str, ...]
    places: Sequence[int] | None = None
    hands: bool = False


_SETS = {
    17: JointSet("COCO", COCO),
    26: JointSet("Halpe", tuple(HALPE), list(HALPE.values())),
    33: JointSet("MediaPipe", LANDMARKS),
    133: JointSet("COCO-WholeBody", (*WHOLE_BODY, "hand_left", "hand_right"), hands=True),
}
KNOWN = frozenset(_SETS)
"""Numbers of keypoints that tell a set."""
COUNTS = ", ".join(f"{count} ({joints.title})" for count, joints in _SETS.items())
"""The known sets, for messages."""


def joint_set(n_keypoints: int, model: str) -> JointSet:
    """Return the joint set with this many keypoints.

    Args:
        n_keypoints: J. model: its name in messages.

    Raises:
        InputError: no known set has as many.
    """
    if n_keypoints not in _SETS:
        raise InputError(
            f"{model}: expected as many keypoints as a known joint set has, {COUNTS}, got {n_keypoints}; "
            "wrap the model in Python (package:factory), where its keypoints can be named"
        )
    return _SETS[n_keypoints]


def select_joints(found: Detections, joints: JointSet) -> Detections:
    """Return the keypoints that are taken of those of a model.

        hand = wrist + 0.7 (knuckle of the middle finger - wrist)

    Args:
        found: all keypoints of the model.
    """
    points, confidence = found
    places = joints.places or list(range(len(joints.names) - 2 * joints.hands))
    taken = Detections(points[:, places], confidence[:, places])
    if not joints.hands:
        return taken
    wrists = points[:, _WRISTS]
    hands = wrists + _HAND * (points[:, _KNUCKLES] - wrists)
    sure = torch.minimum(confidence[:, _WRISTS], confidence[:, _KNUCKLES])
    return joined([taken, Detections(hands, sure)], 1)
