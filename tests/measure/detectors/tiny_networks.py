"""Tiny ONNX models with the outputs of the known layouts, which the tests make themselves."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

onnx = pytest.importorskip("onnx", reason="onnx makes the models of these tests; see the extra dev")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

KINDS = {"float32": TensorProto.FLOAT, "uint8": TensorProto.UINT8, "int32": TensorProto.INT32}


def save(
    path: Path,
    shape: list[Any],
    nodes: list[Any],
    outputs: dict[str, list[Any]],
    weights: dict[str, np.ndarray] | None = None,
    kind: str = "float32",
) -> Path:
    """Write a model with one input, `image`."""
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info("image", KINDS[kind], shape)],
        [helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in outputs.items()],
        [
            numpy_helper.from_array(np.asarray(value), name)
            for name, value in (weights or {}).items()
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())
    return path


def heatmaps(path: Path, n_joints: int = 17, size: tuple[int, int] = (48, 64)) -> Path:
    """A model whose heatmaps are the brightness of the cells: all joints are at the brightest."""
    weight = np.full((n_joints, 3, 4, 4), 1 / 48 / 5, np.float32)
    bias = np.full(n_joints, 0.4, np.float32)
    return save(
        path,
        [1, 3, size[1], size[0]],
        [helper.make_node("Conv", ["image", "weight", "bias"], ["maps"], strides=[4, 4])],
        {"maps": [1, n_joints, size[1] // 4, size[0] // 4]},
        {"weight": weight, "bias": bias},
    )


def simcc(path: Path, n_joints: int = 17, size: tuple[int, int] = (48, 64)) -> Path:
    """A model whose scores are the greatest brightness of a column or row, in two bins each."""
    weights = {
        "weight": np.full((n_joints, 3, 1, 1), 1 / 3 / 5, np.float32),
        "bias": np.full(n_joints, 0.4, np.float32),
        "wide": np.kron(np.eye(size[0], dtype=np.float32), np.array([[1.0, 0.9]], np.float32)),
        "high": np.kron(np.eye(size[1], dtype=np.float32), np.array([[1.0, 0.9]], np.float32)),
    }
    nodes = [
        helper.make_node("Conv", ["image", "weight", "bias"], ["maps"]),
        helper.make_node("ReduceMax", ["maps"], ["columns"], axes=[2], keepdims=0),
        helper.make_node("ReduceMax", ["maps"], ["rows"], axes=[3], keepdims=0),
        helper.make_node("MatMul", ["columns", "wide"], ["simcc_x"]),
        helper.make_node("MatMul", ["rows", "high"], ["simcc_y"]),
    ]
    outputs = {"simcc_x": [1, n_joints, 2 * size[0]], "simcc_y": [1, n_joints, 2 * size[1]]}
    return save(path, [1, 3, size[1], size[0]], nodes, outputs, weights)


def constant(
    path: Path,
    shape: list[Any],
    outputs: dict[str, np.ndarray],
    kind: str = "float32",
) -> Path:
    """A model that says the same of every image: its outputs are biases of a convolution without weights."""
    nodes, source = [], "image"
    if kind != "float32":
        nodes, source = [helper.make_node("Cast", [source], ["real"], to=TensorProto.FLOAT)], "real"
    if shape[-1] == 3:
        nodes.append(helper.make_node("Transpose", [source], ["first"], perm=[0, 3, 1, 2]))
        source = "first"
    nodes.append(helper.make_node("GlobalAveragePool", [source], ["mean"]))
    weights, shapes = {}, {}
    for name, values in outputs.items():
        parts = [f"{name}_weight", f"{name}_bias", f"{name}_shape"]
        arrays = (
            np.zeros((values.size, 3, 1, 1), np.float32),
            values.astype(np.float32).flatten(),
            np.array(values.shape, np.int64),
        )
        weights.update(zip(parts, arrays, strict=True))
        nodes.append(helper.make_node("Conv", ["mean", *parts[:2]], [f"{name}_flat"]))
        nodes.append(helper.make_node("Reshape", [f"{name}_flat", parts[2]], [name]))
        shapes[name] = list(values.shape)
    return save(path, shape, nodes, shapes, weights, kind)
