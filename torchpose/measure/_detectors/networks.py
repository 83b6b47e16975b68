"""Run ONNX models by ONNX Runtime, or where that is not installed, by OpenCV."""

import importlib
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from torchpose.errors import FileFormatError, InputError, MissingDependencyError
from torchpose.measure._detectors.onnx_header import TensorInfo, read_inputs

_FREE = {
    True: 256,
    False: 640,
}  # sides that a model with channels last or first is run with if it takes any
_EXTRA = "pip install 'torchpose[onnx]'"


@runtime_checkable
class Network(Protocol):
    """Runs a model: an array in, arrays out.

    Attributes:
        inputs: of the model. output_names: of the model, in their order.
    """

    inputs: list[TensorInfo]
    output_names: list[str]

    def run(self, values: np.ndarray) -> list[np.ndarray]:
        """Return the outputs for the values of the only input."""
        ...


class ImageInput(NamedTuple):
    """Holds the input of a model: (w, h), whether channels are the last dimension, type of the elements."""

    size: tuple[int, int]
    channels_last: bool
    dtype: np.dtype[Any]

    def arrange(self, pixels: np.ndarray) -> np.ndarray:
        """Return values [h, w, 3] as a batch of one, in the order and type of the input."""
        values = pixels if self.channels_last else pixels.transpose(2, 0, 1)
        return np.ascontiguousarray(values[None], dtype=self.dtype)


def image_input(network: Network, model: str) -> ImageInput:
    """Return the input of a network that takes one image.

    Args:
        model: its name in messages.

    Raises:
        InputError: other inputs.
    """
    wanted = f"{model}: expected one input, an image [1, 3, h, w] or [1, h, w, 3]"
    if len(network.inputs) != 1:
        names = ", ".join(f"{one.name} {list(one.shape)}" for one in network.inputs) or "none"
        raise InputError(f"{wanted}, got {names}")
    one = network.inputs[0]
    shape = one.shape
    if len(shape) != 4 or shape[0] not in (1, None) or 3 not in (shape[1], shape[3]):
        raise InputError(f"{wanted}, got {one.name} {list(shape)}")
    if one.dtype not in ("float32", "float16", "uint8", "int32"):
        raise InputError(f"{wanted} of float32, float16, uint8 or int32, got {one.dtype}")
    last = shape[1] != 3
    height, width = (side or _FREE[last] for side in (shape[1:3] if last else shape[2:4]))
    return ImageInput((width, height), last, np.dtype(one.dtype))


def open_network(path: Path) -> Network:
    """Return the network of an ONNX file.

    Raises:
        FileFormatError: not an ONNX model, or one that the runtime cannot read.
        MissingDependencyError: OpenCV cannot run it, and ONNX Runtime is not installed.
    """
    try:
        runtime = importlib.import_module("onnxruntime")
    except ImportError:
        return _OpenCV(path)
    return _Runtime(path, runtime)


class _Runtime:
    """Runs a model by ONNX Runtime, on a GPU if it has been built for one."""

    def __init__(self, path: Path, runtime: ModuleType) -> None:
        available = runtime.get_available_providers()
        wanted = ("CUDAExecutionProvider", "CPUExecutionProvider")
        providers = [name for name in wanted if name in available]
        options = runtime.SessionOptions()
        options.log_severity_level = 3  # errors, which are raised as well
        try:
            session = runtime.InferenceSession(str(path), options, providers=providers)
        except Exception as error:  # of many types, none of which the package names
            raise FileFormatError(
                f"{path}: expected an ONNX model that ONNX Runtime reads; it says: {_first_line(error)}"
            ) from error
        self._session = session
        self.inputs = [
            TensorInfo(one.name, tuple(_fixed(side) for side in one.shape), _dtype(one.type))
            for one in session.get_inputs()
        ]
        self.output_names = [one.name for one in session.get_outputs()]
        self._path = path

    def run(self, values: np.ndarray) -> list[np.ndarray]:
        """Return the outputs for the values of the only input."""
        try:
            found = self._session.run(None, {self.inputs[0].name: values})
        except Exception as error:
            raise InputError(
                f"{self._path}: the model does not run on an input {list(values.shape)}; ONNX Runtime says: "
                f"{_first_line(error)}"
            ) from error
        return [np.asarray(array) for array in found]


class _OpenCV:
    """Runs a model by OpenCV."""

    def __init__(self, path: Path) -> None:
        import cv2

        data = path.read_bytes()
        self.inputs = read_inputs(data, str(path))
        self._path = path
        try:
            self._net = cv2.dnn.readNetFromONNX(np.frombuffer(data, np.uint8))
        except cv2.error as error:
            raise self._cannot(error) from error
        self.output_names = list(self._net.getUnconnectedOutLayersNames())

    def run(self, values: np.ndarray) -> list[np.ndarray]:
        """Return the outputs for the values of the only input."""
        import cv2

        try:
            self._net.setInput(values)
            return [np.asarray(array) for array in self._net.forward(self.output_names)]
        except cv2.error as error:
            raise self._cannot(error) from error

    def _cannot(self, error: Exception) -> MissingDependencyError:
        return MissingDependencyError(
            f"{self._path}: OpenCV cannot run this model ({_first_line(error)}); run `{_EXTRA}`, which "
            "brings ONNX Runtime"
        )


def _fixed(side: Any) -> int | None:
    return side if isinstance(side, int) and side > 0 else None


def _dtype(kind: str) -> str:
    """Return the type of NumPy for one of ONNX Runtime, such as tensor(float)."""
    inner = kind.removeprefix("tensor(").removesuffix(")")
    return {"float": "float32"}.get(inner, inner)


def _first_line(error: Exception) -> str:
    lines: Sequence[str] = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__
