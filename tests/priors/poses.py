"""Poses and recordings that the tests of the upper-body prior share."""

import torch

from torchpose.io import Recording
from torchpose.skeleton import UPPER_BODY

# one upright person facing the camera, camera axes, metres, centred on the neck
REST = torch.tensor(
    [[0.30, 0.45, -0.1], [0.24, 0.28, 0.0], [0.18, 0.08, 0.0], [0.0, -0.2, -0.01],
     [0.0, 0.0, 0.0], [-0.18, 0.08, 0.0], [-0.24, 0.28, 0.0], [-0.30, 0.45, -0.1]],
    dtype=torch.float64,
)  # fmt: skip


def poses(n: int = 300, seed: int = 0, offset=(0.0, 0.0, 2.0)) -> torch.Tensor:
    """Poses around the one at rest, arms moving more than the trunk."""
    g = torch.Generator().manual_seed(seed)
    spread = torch.tensor([0.15, 0.08, 0.02, 0.01, 0.0, 0.02, 0.08, 0.15], dtype=torch.float64)
    noise = torch.randn(n, 8, 3, generator=g, dtype=torch.float64) * spread[:, None]
    return REST + noise + torch.tensor(offset, dtype=torch.float64)


def recording(joints=None, person="p1", names=UPPER_BODY, source="site:set@1:file", fps=30.0):
    joints = poses() if joints is None else joints
    return Recording(joints, tuple(names), fps, person, "wave", source)


def lowered_neck(joints: torch.Tensor) -> torch.Tensor:
    """The same poses with the neck in the middle of the shoulders."""
    lowered = joints.clone()
    lowered[:, 4] = (joints[:, 2] + joints[:, 5]) / 2
    return lowered
