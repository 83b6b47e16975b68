"""Recordings of a made-up person whose arms swing, for tests of curation."""

from pathlib import Path

import numpy as np
import torch

from torchpose.io import Recording
from torchpose.skeleton import SKELETONS, UPPER_BODY

# shoulder, upper arm and forearm in metres; heights from the neck
_WIDTH, _UPPER, _FORE, _HEAD = 0.36, 0.28, 0.26, 0.2


def moving(n_frames=200, seed=0, size=1.0, noise=0.003):
    """Eight joints [T, 8, 3] in camera axes, metres: arms that swing at up to about 2 m/s."""
    rng = np.random.default_rng(seed)
    time = np.arange(n_frames) / 30
    joints = np.zeros((n_frames, 8, 3))
    neck = np.array([0.0, -0.3, 2.0]) + 0.05 * np.sin(time * 0.7)[:, None] * rng.normal(size=3)
    joints[:, 4] = neck
    joints[:, 3] = neck + np.array([0, -_HEAD, 0])
    for sign, (hand, elbow, shoulder) in ((1, (0, 1, 2)), (-1, (7, 6, 5))):
        a, b = rng.uniform(0.3, 1.2, 2)
        up = 1.2 * np.sin(a * time + rng.uniform(0, 6)) - 0.3
        out = 0.8 * np.sin(b * time + rng.uniform(0, 6))
        ahead = np.stack(
            [sign * np.cos(up) * np.cos(out), -np.sin(up), -np.cos(up) * np.sin(out)], -1
        )
        joints[:, shoulder] = neck + np.array([sign * _WIDTH / 2, 0.1, 0])
        joints[:, elbow] = joints[:, shoulder] + _UPPER * ahead
        joints[:, hand] = joints[:, elbow] + _FORE * ahead
    joints = neck[:, None] + size * (joints - neck[:, None])
    return torch.from_numpy(joints + noise * rng.normal(size=joints.shape))


def recording(person="ann", name="a", joints=None, names=UPPER_BODY, **changes):
    """A `Recording` in memory, in a folder of its person's name."""
    joints = moving(seed=abs(hash((person, name))) % 1000) if joints is None else joints
    facts = {"fps": 30.0, "path": Path(f"/recordings/{person}/{name}.csv"),
             "skeleton": "upper-body-8"} | changes  # fmt: skip
    return Recording(joints, tuple(names), **facts)


def kinect_v1(joints):
    """The eight joints among the twenty of Kinect v1, the others at the neck."""
    names = SKELETONS["kinect-v1-20"].joints
    all_joints = joints[:, 4:5].repeat(1, 20, 1)
    for own, name in enumerate(UPPER_BODY):
        part, _, side = name.partition("_")
        spelled = f"{side}_{part}" if side else {"neck": "shoulder_center"}.get(part, part)
        all_joints[:, names.index(spelled)] = joints[:, own]
    return all_joints, names
