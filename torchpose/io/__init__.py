"""Files in and out: recordings of 3D joints, 2D keypoints, and safe writing."""

from torchpose._core.files import (
    atomic_path,
    check_output_folder,
    read_npz,
    require_file,
    write_npz,
)
from torchpose.io.formats.axes import AXES
from torchpose.io.keypoints import Keypoints, read_keypoints, write_keypoints
from torchpose.io.recordings import Recording, find_recordings, read_recording, read_recordings
from torchpose.io.results import ResultsFolder

__all__ = [
    "AXES",
    "Keypoints",
    "Recording",
    "ResultsFolder",
    "atomic_path",
    "check_output_folder",
    "find_recordings",
    "read_keypoints",
    "read_npz",
    "read_recording",
    "read_recordings",
    "require_file",
    "write_keypoints",
    "write_npz",
]
