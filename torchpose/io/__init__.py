"""Read and write files: recordings of 3D joints, 2D keypoints, results."""

from torchpose._core.facade import set_up_facade
from torchpose.io._keypoints import Keypoints, read_keypoints, write_keypoints
from torchpose.io._mocap import read_mocap
from torchpose.io._recordings import Recording, read_recording, read_recordings

__all__ = [
    "Keypoints",
    "Recording",
    "read_keypoints",
    "read_mocap",
    "read_recording",
    "read_recordings",
    "write_keypoints",
]

set_up_facade(__name__)
