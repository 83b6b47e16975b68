"""ONNX models of every known layout, tiny ones that are made here, by both runtimes."""

import sys

import numpy as np
import pytest
import torch

from torchpose.errors import FileFormatError, InputError, MissingDependencyError
from torchpose.measure._detectors import networks
from torchpose.measure._detectors.load import load_detector
from torchpose.measure._detectors.networks import image_input, open_network
from torchpose.measure._detectors.onnx_header import read_inputs
from torchpose.measure._detectors.onnx_model import CroppingOnnxModel, load_onnx
from torchpose.skeleton._joint_sets import COCO

pytest.importorskip("onnx", reason="onnx makes the models of these tests; see the extra dev")
from tests.measure.detectors import tiny_networks as tiny


@pytest.fixture(params=["onnxruntime", "opencv"])
def runtime(request, monkeypatch):
    """Both runtimes, one after the other."""
    if request.param == "opencv":
        monkeypatch.setitem(sys.modules, "onnxruntime", None)
    else:
        pytest.importorskip(
            "onnxruntime", reason="ONNX Runtime is not installed; see the extra onnx"
        )
    return request.param


def dotted(u, v):
    image = np.zeros((240, 320, 3), np.uint8)
    image[v - 14 : v + 15, u - 14 : u + 15] = 255
    return image


@pytest.mark.parametrize("make", [tiny.heatmaps, tiny.simcc])
@pytest.mark.parametrize(("n_joints", "n_taken"), [(17, 17), (26, 23)])
def test_a_model_of_crops_finds_the_bright_dot(make, n_joints, n_taken, runtime, tmp_path):
    model = load_onnx(make(tmp_path / "m.onnx", n_joints))
    assert isinstance(model, CroppingOnnxModel) and model.names[:17] == COCO
    dot = torch.tensor([100.0, 150.0])
    points, confidence = model(dotted(100, 150))
    assert points.shape == (1, n_taken, 2) and confidence.shape == (1, n_taken)
    assert float((points - dot).norm(dim=-1).max()) < 28  # the dot, and a cell of 27 pixels
    assert 0.1 < float(confidence.min()) <= 1.0
    boxes = torch.tensor([[40.0, 70, 160, 230], [60, 70, 180, 230]])
    close = model.detect_in(dotted(100, 150), boxes).keypoints
    assert close.shape == (2, n_taken, 2)
    assert float((close - dot).norm(dim=-1).max()) < 21  # in cells of 10


def people(n, seed=0):
    """Rows (box by its corners, score, keypoints) of persons apart from each other."""
    rng = np.random.default_rng(seed)
    corner = np.stack([60.0 * np.arange(n) + 5, np.full(n, 8.0)], 1)
    points = corner[:, None] + rng.uniform(size=(n, 17, 2)) * [40, 90]
    scored = np.concatenate([points, rng.uniform(0.5, 1, (n, 17, 1))], -1)
    return (
        np.concatenate([corner, corner + np.array([40, 90])], 1),
        np.linspace(0.9, 0.6, n),
        scored,
    )


def test_rtmo(runtime, tmp_path):
    boxes, scores, points = people(3)
    dets = np.concatenate([boxes, scores[:, None]], 1)
    model = load_onnx(tiny.constant(
        tmp_path / "m.onnx", [1, 3, 320, 320], {"dets": dets[None], "keypoints": points[None]}
    ))  # fmt: skip
    found, confidence = model(np.zeros((160, 640, 3), np.uint8))
    expected = torch.from_numpy(points[..., :2]) * 2  # the image is put into the upper left corner
    torch.testing.assert_close(found, expected, atol=1e-3, rtol=0)
    torch.testing.assert_close(confidence, torch.from_numpy(points[..., 2]), atol=1e-6, rtol=0)


@pytest.mark.parametrize("columns", [True, False])
def test_yolo(columns, runtime, tmp_path):
    boxes, scores, points = people(3)
    rows = np.zeros((90, 56))
    rows[:3, :2], rows[:3, 2:4] = (boxes[:, :2] + boxes[:, 2:]) / 2, [40, 90]
    rows[:3, 4], rows[:3, 5:] = scores, points.reshape(3, -1)
    given = rows.T if columns else rows
    path = tiny.constant(tmp_path / "m.onnx", [1, 3, 320, 320], {"output0": given[None]})
    found, _ = load_onnx(path)(np.zeros((160, 640, 3), np.uint8))
    expected = (torch.from_numpy(points[..., :2]) - torch.tensor([0.0, 120.0])) * 2  # in the middle
    torch.testing.assert_close(found, expected, atol=1e-3, rtol=0)


@pytest.mark.parametrize("kind", ["int32", "uint8", "float32"])
def test_movenet(kind, tmp_path):
    pytest.importorskip("onnxruntime", reason="ONNX Runtime is not installed; see the extra onnx")
    _, scores, points = people(2)
    shares = points[..., [1, 0, 2]] / [192, 192, 1]
    single = tiny.constant(
        tmp_path / "s.onnx", [1, 192, 192, 3], {"output_0": shares[:1, None]}, kind
    )
    model = load_onnx(single)
    assert isinstance(model, CroppingOnnxModel)
    found, confidence = model(np.zeros((384, 192, 3), np.uint8))
    expected = (torch.from_numpy(points[:1, :, :2]) - torch.tensor([48.0, 0.0])) * 2
    torch.testing.assert_close(found, expected, atol=1e-3, rtol=0)
    torch.testing.assert_close(confidence, torch.from_numpy(points[:1, :, 2]), atol=1e-6, rtol=0)
    rows = np.zeros((6, 56))
    rows[:2, :51], rows[:2, 55] = shares.reshape(2, -1), scores
    rows[:2, 51:55] = [[0.0, 0.0, 0.4, 0.2], [0.0, 0.5, 0.4, 0.7]]
    multi = tiny.constant(tmp_path / "m.onnx", [1, None, None, 3], {"output_0": rows[None]}, kind)
    found, _ = load_onnx(multi)(np.zeros((256, 256, 3), np.uint8))
    torch.testing.assert_close(
        found, torch.from_numpy(points[..., :2]) * 256 / 192, atol=1e-3, rtol=0
    )


def test_a_model_of_any_size_is_run_at_640_pixels(tmp_path):
    pytest.importorskip("onnxruntime", reason="ONNX Runtime is not installed; see the extra onnx")
    path = tiny.constant(tmp_path / "m.onnx", ["N", 3, "H", "W"], {"out": np.zeros((1, 56, 90))})
    assert image_input(open_network(path), "m").size == (640, 640)
    assert len(load_onnx(path)(np.zeros((20, 30, 3), np.uint8))[0]) == 0


@pytest.mark.parametrize("shape", [[1, 3, 64, 48], ["N", 3, "H", "W"], [1, 48, 64, 3]])
@pytest.mark.parametrize("kind", ["float32", "uint8", "int32"])
def test_the_header_says_what_the_package_onnx_says(shape, kind, tmp_path):
    path = tiny.constant(tmp_path / "m.onnx", shape, {"out": np.zeros((1, 56, 90))}, kind)
    (found,) = read_inputs(path.read_bytes(), "m")
    assert found.name == "image" and found.dtype == kind
    given = tiny.onnx.load(path).graph.input[0].type.tensor_type.shape.dim
    assert found.shape == tuple(d.dim_value or None for d in given)


def test_a_damaged_header_is_refused_as_such(tmp_path):
    path = tiny.constant(tmp_path / "m.onnx", [1, 3, 8, 8], {"out": np.zeros((1, 6))})
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    for _ in range(300):
        data = bytearray(whole[: rng.integers(1, len(whole) + 1)])
        for place in rng.integers(0, len(data), 3):
            data[place] = rng.integers(256)
        try:
            read_inputs(bytes(data), "m")
        except FileFormatError as error:
            assert "expected an ONNX model" in str(error)


def test_damaged_and_other_files_are_refused(runtime, tmp_path):
    path = tmp_path / "m.onnx"
    whole = tiny.heatmaps(path).read_bytes()
    for data in (b"", b"some text that is no model", whole[: len(whole) // 2]):
        path.write_bytes(data)
        with pytest.raises((FileFormatError, MissingDependencyError), match=r"m\.onnx"):
            load_onnx(path)


def test_other_inputs_and_outputs_are_named(runtime, tmp_path):
    path = tiny.constant(tmp_path / "m.onnx", [1, 3, 32, 32], {"classes": np.zeros((1, 10))})
    with pytest.raises(InputError, match=r"m\.onnx: its outputs \[1, 10\].*no known layout"):
        load_detector(path)
    path = tiny.save(
        path, [1, 1, 32, 32], [tiny.helper.make_node("Relu", ["image"], ["out"])],
        {"out": [1, 1, 32, 32]},
    )  # fmt: skip
    with pytest.raises(
        InputError, match=r"expected one input, an image .* got image \[1, 1, 32, 32\]"
    ):
        load_detector(path)


def test_what_opencv_cannot_run_says_how_to_get_the_runtime(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    path = tiny.heatmaps(tmp_path / "m.onnx")
    model = tiny.onnx.load(path)
    model.graph.node[0].op_type = "NoSuchLayer"
    path.write_bytes(model.SerializeToString())
    with pytest.raises(MissingDependencyError, match=r"pip install 'torchpose\[onnx\]'"):
        load_onnx(path)


def test_images_of_another_kind_are_refused(tmp_path, runtime):
    model = load_onnx(tiny.heatmaps(tmp_path / "m.onnx"))
    with pytest.raises(InputError, match="image must be RGB"):
        model(np.zeros((20, 20), np.uint8))
    assert networks.image_input(model._network, "m").size == (48, 64)
