"""The common form of a recording, .npz, and the authors' OpenCV matrix, .yaml."""

import math
from pathlib import Path

import numpy as np

from torchpose.errors import FileFormatError, MissingDependencyError
from torchpose.io.files import read_npz
from torchpose.io.raw_recording import RawRecording, numbers
from torchpose.joint_sets import UPPER_BODY

__all__ = ["read_npz_recording", "read_opencv_recording"]


def read_npz_recording(path: Path) -> list[RawRecording]:
    """Read `joints` [T, J, 3], `names` [J] and what else a common ``.npz`` may hold."""
    arrays = read_npz(
        path,
        required=("joints", "names"),
        optional=("fps", "subject", "action", "source", "axes", "weights"),
    )
    joints = numbers(f"{path}: joints", arrays["joints"])
    names = tuple(str(n) for n in np.atleast_1d(arrays["names"]).ravel())
    weights = arrays.get("weights")
    text = {key: str(arrays[key].item()) if key in arrays and arrays[key].size == 1 else ""
            for key in ("subject", "action", "source", "axes")}  # fmt: skip
    fps = None
    if "fps" in arrays:
        value = numbers(f"{path}: fps", arrays["fps"])
        if value.size != 1 or not 0 < float(value.item()) < math.inf:
            raise FileFormatError(f"{path}: fps must be one positive number, got {value.tolist()}")
        fps = float(value.item())
    return [
        RawRecording(
            path, joints, names, fps, text["axes"] or None, person=text["subject"],
            action=text["action"], source=text["source"],
            weights=None if weights is None else numbers(f"{path}: weights", weights),
        )
    ]  # fmt: skip


def read_opencv_recording(path: Path) -> list[RawRecording]:
    """Read the authors' matrix of T x 24: the eight joints of the upper body in their order.

    Raises:
        MissingDependencyError: OpenCV is not installed.
    """
    try:
        import cv2
    except ImportError as error:
        raise MissingDependencyError(
            f"{path}: reading OpenCV files needs OpenCV; install opencv-python-headless"
        ) from error
    expected = f"an OpenCV FileStorage with one matrix of T x {3 * len(UPPER_BODY)}"
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{path}: expected {expected}, got another kind of file") from error
    if "opencv-matrix" not in text:  # OpenCV prints its own complaint about foreign files
        raise FileFormatError(f"{path}: expected {expected}, found no matrix")
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        nodes = [storage.getNode(key) for key in storage.root().keys()]  # noqa: SIM118
        matrices = [node.mat() for node in nodes if node.isMap()]
        storage.release()
    except (cv2.error, SystemError) as error:
        raise FileFormatError(
            f"{path}: expected {expected}; it is truncated or damaged ({_first_line(error)})"
        ) from error
    if len(matrices) != 1 or matrices[0] is None or matrices[0].shape[1:] != (3 * len(UPPER_BODY),):
        shapes = [None if m is None else m.shape for m in matrices]
        raise FileFormatError(f"{path}: expected {expected}, got matrices of {shapes}")
    joints = matrices[0].reshape(-1, len(UPPER_BODY), 3)
    # the source states no rate; Kinect v1 records 30 frames per second
    return [RawRecording(path, joints, UPPER_BODY, 30.0, "camera")]


def _first_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__
