"""Which layout the shapes of a model's outputs tell."""

import pytest

from torchpose.errors import InputError
from torchpose.measure._detectors.layouts import find_layout

FIRST, SQUARE = (192, 256), (640, 640)
KNOWN = {
    "RTMPose (SimCC)": [
        ([(1, 17, 384), (1, 17, 512)], FIRST),
        ([(1, 133, 512), (1, 133, 384)], FIRST),  # in the other order
        ([(1, 26, 512), (1, 26, 512)], (256, 256)),
    ],
    "heatmaps": [([(1, 17, 64, 48)], FIRST), ([(1, 133, 96, 72)], (288, 384))],
    "RTMO": [
        ([(1, 0, 5), (1, 0, 17, 3)], SQUARE),
        ([(1, 7, 17, 3), (1, 7, 5)], SQUARE),
    ],
    "YOLO-pose": [
        ([(1, 56, 8400)], SQUARE),
        ([(1, 8400, 56)], SQUARE),
        ([(1, 104, 2100)], (320, 320)),  # of 33 keypoints
        ([(1, 300, 57)], SQUARE),  # of its own suppression
    ],
}
CASES = [(title, *case) for title, cases in KNOWN.items() for case in cases]


@pytest.mark.parametrize(("title", "shapes", "size"), CASES, ids=str)
def test_a_known_layout_is_found(title, shapes, size):
    layout = find_layout(shapes, size, False, "m.onnx")
    assert layout.title == title
    assert layout.crops == (title in ("heatmaps", "RTMPose (SimCC)"))


@pytest.mark.parametrize(
    ("title", "shape"), [("MoveNet single pose", (1, 1, 17, 3)), ("MoveNet multi pose", (1, 6, 56))]
)
def test_movenet_has_its_channels_last(title, shape):
    assert find_layout([shape], (192, 192), True, "m.onnx").title == title


@pytest.mark.parametrize(
    ("shapes", "size", "last"),
    [
        ([(1, 1000)], (224, 224), False),
        ([(1, 17, 64, 50)], FIRST, False),
        ([(1, 17, 384), (1, 16, 512)], FIRST, False),
        ([(1, 84, 8400)], (640, 640), True),
        ([(1, 17, 64, 48), (1, 17, 64, 48), (1, 4)], FIRST, False),
        ([], FIRST, False),
    ],
    ids=str,
)
def test_another_layout_is_named_beside_those_that_are_known(shapes, size, last):
    with pytest.raises(
        InputError, match=r"m\.onnx: its outputs .*no known layout; expected simcc_x"
    ):
        find_layout(shapes, size, last, "m.onnx")


def test_another_number_of_keypoints_is_named():
    with pytest.raises(InputError, match=r"17 \(COCO\), 26 \(Halpe\).*got 21"):
        find_layout([(1, 21, 64, 48)], FIRST, False, "m.onnx")
