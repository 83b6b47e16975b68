"""Recordings of whole bodies as files, as the fits of models for body trackers read them."""

from pathlib import Path

import numpy as np
from torch import Tensor

from torchpose.body import BODY_15


def write_body(path: Path, joints: Tensor, fps: float, person: str, action: str) -> Path:
    """Joints [T, 15, 3] of a body as one recording of the data set "set", with y up."""
    np.savez(
        path, joints=joints.numpy(), names=np.array(BODY_15.names), fps=fps, subject=person, action=action,
        source="set", axes="y-up",
    )  # fmt: skip
    return path
