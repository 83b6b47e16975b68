"""Rotations of SciPy from quaternion vectors, and back."""

import numpy as np
from scipy.spatial.transform import Rotation


def scipy(vectors):
    """SciPy's rotations of quaternion vectors [..., 3]."""
    vectors = np.asarray(vectors)
    w = np.sqrt((1 - (vectors**2).sum(-1, keepdims=True)).clip(0))
    return Rotation.from_quat(np.concatenate([vectors, w], -1))


def local(rotations, centre):
    """Vectors of SciPy's rotations in the space around a centre."""
    quaternion = (scipy(centre).inv() * rotations).as_quat()
    return quaternion[:, :3] * np.where(quaternion[:, 3:] < 0, -1, 1)
