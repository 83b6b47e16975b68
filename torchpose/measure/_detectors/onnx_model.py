"""Detect keypoints by an ONNX model."""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_rgb
from torchpose._core.images import Image
from torchpose._core.rows import joined
from torchpose.measure._detectors.joint_sets import select_joints
from torchpose.measure._detectors.layouts import Layout, as_tensors, find_layout
from torchpose.measure._detectors.networks import Network, image_input, open_network
from torchpose.measure._detectors.protocol import Detections
from torchpose.measure._detectors.views import view, whole


class OnnxModel:
    """Detects the keypoints of all persons by a model that sees the whole image.

    Args:
        network: of the model. layout: of its outputs. model: its name in messages.

    Attributes:
        names: of the keypoints.
    """

    def __init__(self, network: Network, layout: Layout, model: str) -> None:
        self._network, self.layout = network, layout
        self._input = image_input(network, model)
        self.names = layout.joints.names

    def __call__(self, image: Image) -> tuple[Tensor, Tensor]:
        """Return keypoints [N, J, 2], pixels, and confidence [N, J].

        Raises:
            InputError: another kind of image.
        """
        return self._detect(image, whole(image))

    def _detect(self, image: Image, box: Float[Tensor, " 4"]) -> Detections:
        """Return the persons in a box of an image."""
        check_rgb("image", image, empty=False)
        layout, size = self.layout, self._input.size
        seen = view(image, box, size, layout.fill, layout.centred)
        values = self._input.arrange(layout.normalise(seen.pixels))
        found = layout.decode(as_tensors(self._network.run(values)), size)
        found = select_joints(found, layout.joints)
        return Detections(seen.to_image(found.keypoints), found.confidence)


class CroppingOnnxModel(OnnxModel):
    """Detects the keypoints of the person in a box by a model that wants one person."""

    def detect_in(self, image: Image, boxes: Float[Tensor, "N 4"] | None) -> Detections:
        """Return the keypoints of one person for each box; None is the whole image."""
        if boxes is None:
            boxes = whole(image)[None]
        found = [self._detect(image, box) for box in boxes]
        return joined(found)


def load_onnx(path: Path) -> OnnxModel:
    """Return the detector of an ONNX file; its outputs for an empty image determine the layout.

    Args:
        path: of the model.

    Raises:
        FileFormatError: not an ONNX model. InputError: other inputs or outputs than of a known layout.
        MissingDependencyError: OpenCV cannot run it, and ONNX Runtime is not installed.
    """
    network = open_network(path)
    given = image_input(network, str(path))
    nothing = torch.zeros(given.size[1], given.size[0], 3).numpy()
    shapes = [array.shape for array in network.run(given.arrange(nothing))]
    layout = find_layout(shapes, given.size, given.channels_last, str(path), network.output_names)
    return (CroppingOnnxModel if layout.crops else OnnxModel)(network, layout, str(path))
