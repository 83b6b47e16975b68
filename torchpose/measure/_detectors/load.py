"""Load a detector of keypoints: from a model file, or from a Python object by its name."""

import importlib
import sys
from pathlib import Path
from typing import Any

from torchpose.errors import InputError, SkeletonError, TorchposeError
from torchpose.measure._detectors.mediapipe import MediaPipeDetector
from torchpose.measure._detectors.onnx_model import load_onnx
from torchpose.measure._detectors.protocol import KeypointDetector
from torchpose.skeleton._upper_body import upper_body_indices

_KINDS = (
    "an ONNX model (.onnx), a pose landmarker of MediaPipe (.task), or package:factory, a callable "
    "without arguments in a Python module that returns a detector"
)


def load_detector(
    where: str | Path, fps: float = 30.0, max_persons: int | None = None
) -> KeypointDetector:
    """Return a detector of keypoints.

    Args:
        where: file of a model (.onnx or .task), or ``package.module:factory``. A module in the working
            directory is found, too.
        fps: frames per second of the video. max_persons: most that MediaPipe looks for (default 1).

    Raises:
        InputError: no such file, another kind of file or of object. FileFormatError: a damaged file.
        MissingDependencyError: a package that the model needs.
    """
    path = Path(where)
    suffix = path.suffix.lower()
    if suffix in (".onnx", ".task"):
        if not path.is_file():
            raise InputError(f"{path}: expected a model file, there is no such file")
        if suffix == ".onnx":
            return load_onnx(path)
        return MediaPipeDetector(path, fps, max_persons or 1)
    if ":" in str(where) and not path.exists():
        return _from_factory(str(where))
    what = f"a {suffix or 'nameless'} file" if path.exists() else "neither"
    raise InputError(f"{where}: a detector must be {_KINDS}; this is {what}")


def _from_factory(where: str) -> KeypointDetector:
    """Return the detector that a callable in a module returns."""
    module_name, _, name = where.partition(":")
    try:
        factory: Any = _import(module_name)
        for part in name.split("."):
            factory = getattr(factory, part)
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        raise InputError(
            f"{where}: expected package:factory, a callable in a Python module that can be imported from "
            f"here; got {type(error).__name__}: {error}"
        ) from error
    if not callable(factory):
        raise InputError(
            f"{where}: expected a callable that returns a detector, got {type(factory).__name__}"
        )
    try:
        detector = factory()
    except TorchposeError:
        raise
    except Exception as error:
        raise InputError(
            f"{where}: the factory must return a detector when called without arguments, got "
            f"{type(error).__name__}: {error}"
        ) from error
    return check_detector(detector, where)


def _import(name: str) -> Any:
    """Import a module; one in the working directory is found as well."""
    before = list(sys.path)
    sys.path.append(str(Path.cwd()))
    try:
        return importlib.import_module(name)
    finally:
        sys.path[:] = before


def check_detector(detector: Any, where: str) -> KeypointDetector:
    """Return a detector, or raise unless it can be called and names its keypoints.

    Args:
        where: its name in messages.

    Raises:
        InputError: another kind of object, or names that torchpose does not know.
    """
    names = getattr(detector, "names", None)
    if not callable(detector) or isinstance(names, str) or not hasattr(names, "__len__"):
        raise InputError(
            f"{where}: expected a detector, an object with the attribute names that is called with an "
            "RGB image [H, W, 3] and returns keypoints [N, J, 2] and confidence [N, J]; got "
            f"{type(detector).__name__}{'' if names is None else f' with names {names!r:.60}'}"
        )
    try:
        upper_body_indices([str(name) for name in detector.names])
    except SkeletonError as error:
        raise InputError(f"{where}: the detector's names do not suit: {error}") from error
    return detector  # type: ignore[no-any-return]
