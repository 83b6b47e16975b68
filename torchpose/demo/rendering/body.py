"""Where the parts of the performer are in space: from joints to limbs, outlines and planes.

Numbers of this file are metres of an adult. The torso's own axes are those of the body at rest
(`torchpose.demo.mannequin`): x to the person's left, y down, z to the back, from the neck.
"""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchpose.demo.performer import Performance
from torchpose.math.rotations import euler_to_matrix

__all__ = ["FACE_FROM_HEAD", "Bodies", "Pose", "bodies"]

Array = NDArray[np.float64]

FACE_FROM_HEAD = (0.0, 0.025, -0.04)
"""Middle of the face's box from the head joint, which is the middle of the head; head's axes."""


class Pose(NamedTuple):
    """One person at one time, camera axes, metres.

    Attributes:
        joints: [8, 3] in the order of `UPPER_BODY`. wrists: left and right [2, 3].
        torso, head: axes of the torso and the head as columns [3, 3].
        upright: the same of the body at rest, which the legs follow.
    """

    joints: Array
    wrists: Array
    torso: Array
    head: Array
    upright: Array

    @property
    def neck(self) -> Array:
        """The neck joint [3]."""
        return self.joints[4]

    def on_torso(self, points: Array) -> Array:
        """Return the points of the torso's axes [..., 3] in camera axes."""
        return self.neck + np.asarray(points, np.float64) @ self.torso.T

    def arm(self, side: int) -> Array:
        """Return the shoulder, elbow, wrist and hand [4, 3] of the left (0) or right (1) arm."""
        hand, elbow, shoulder = ((0, 1, 2), (7, 6, 5))[side]
        return np.stack(
            [self.joints[shoulder], self.joints[elbow], self.wrists[side], self.joints[hand]]
        )


class Bodies(NamedTuple):
    """One person over time: the fields of `Pose`, with frames as leading dimension."""

    joints: Array
    wrists: Array
    torso: Array
    head: Array
    upright: Array

    def at(self, frame: float) -> Pose:
        """Return the pose at a time in frames, interpolated; the ends stay."""
        last = len(self.joints) - 1
        time = min(max(frame, 0.0), float(last))
        before = min(int(time), max(last - 1, 0))
        after, share = min(before + 1, last), time - before
        if share == 0:
            return Pose(*(x[before] for x in self))
        # Between two frames axes turn so little that their mean is as good as a rotation.
        return Pose(*((1 - share) * x[before] + share * x[after] for x in self))


def bodies(performance: Performance) -> Bodies:
    """Return everything that the drawing needs of a performance."""
    upright = performance.rotation.double()
    torso = upright @ euler_to_matrix(performance.angles.torso.double())
    head = torso @ euler_to_matrix(performance.angles.head.double())
    parts = (performance.joints, performance.wrists, torso, head, upright.expand_as(torso))
    return Bodies(*(torch.as_tensor(x).double().numpy() for x in parts))
