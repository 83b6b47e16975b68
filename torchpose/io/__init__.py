"""Files in and out: recordings of 3D joints, 2D keypoints, and safe writing."""

from torchpose._core.facade import set_up_facade
from torchpose.io.keypoints import (
    Keypoints,
    read_keypoints,
    write_keypoints,
)
from torchpose.io.recordings import (
    Recording,
    find_recordings,
    read_recording,
    read_recordings,
)
from torchpose.io.results import ResultsFolder

__all__ = [
    "Keypoints",
    "Recording",
    "ResultsFolder",
    "find_recordings",
    "read_keypoints",
    "read_recording",
    "read_recordings",
    "write_keypoints",
]

set_up_facade(__name__)
