"""Rotations against explicit products of elementary ones, OpenCV, and their own inverses."""

import math

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from torchpose.errors import InputError, ShapeError
from torchpose.math import euler_to_matrix
from torchpose.math._rotations import ROTATION_ORDERS, matrix_to_euler, rotvec_to_matrix

ANGLE = st.floats(-3.1, 3.1)
MIDDLE = st.floats(-1.5, 1.5)


def elementary(axis: int, angle: float) -> torch.Tensor:
    """Right-handed rotation about one axis, from its definition."""
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    R = torch.eye(3, dtype=torch.float64)
    R[i, i] = R[j, j] = math.cos(angle)
    R[i, j], R[j, i] = -math.sin(angle), math.sin(angle)
    return R


@settings(deadline=None)
@given(ANGLE, ANGLE, ANGLE)
def test_both_orders_are_the_explicit_products(roll, pitch, yaw):
    Rx, Ry, Rz = elementary(0, pitch), elementary(1, yaw), elementary(2, roll)
    angles = torch.tensor([roll, pitch, yaw], dtype=torch.float64)
    paper, released = euler_to_matrix(angles, "zxy"), euler_to_matrix(angles, "zyx")
    torch.testing.assert_close(paper, Rz @ Rx @ Ry, rtol=0, atol=1e-14)
    torch.testing.assert_close(released, Rz @ Ry @ Rx, rtol=0, atol=1e-14)


def test_the_orders_differ_and_agree_where_they_must():
    angles = torch.tensor([0.3, 0.2, -0.4], dtype=torch.float64)
    assert not torch.allclose(euler_to_matrix(angles, "zxy"), euler_to_matrix(angles, "zyx"))
    for still in (1, 2):  # without pitch, or without yaw, there is one order
        some = angles.clone()
        some[still] = 0
        torch.testing.assert_close(euler_to_matrix(some, "zxy"), euler_to_matrix(some, "zyx"))


@pytest.mark.parametrize("order", ROTATION_ORDERS)
@settings(deadline=None)
@given(ANGLE, MIDDLE, ANGLE)
def test_angles_come_back(order, first, middle, last):
    given_angles = [first, middle, last] if order == "zxy" else [first, last, middle]
    angles = torch.tensor(given_angles, dtype=torch.float64)
    back = matrix_to_euler(euler_to_matrix(angles, order), order)
    torch.testing.assert_close(back, angles, rtol=0, atol=1e-9)


@pytest.mark.parametrize("order", ROTATION_ORDERS)
@pytest.mark.parametrize("right", [math.pi / 2, -math.pi / 2])
def test_a_locked_rotation_comes_back_as_a_matrix(order, right):
    angles = [0.4, right, -0.9] if order == "zxy" else [0.4, -0.9, right]
    R = euler_to_matrix(torch.tensor(angles, dtype=torch.float64), order)
    back = matrix_to_euler(R, order)
    torch.testing.assert_close(euler_to_matrix(back, order), R, rtol=0, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_batch_shape_and_dtype(dtype):
    angles = torch.zeros(4, 2, 3, dtype=dtype)
    for order in ROTATION_ORDERS:
        R = euler_to_matrix(angles, order)
        assert R.shape == (4, 2, 3, 3)
        assert R.dtype == dtype


@pytest.mark.parametrize("order", ROTATION_ORDERS)
def test_gradients(order):
    angles = torch.tensor([[0.3, -0.2, 0.5]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a: euler_to_matrix(a, order), angles)
    R = euler_to_matrix(angles.detach(), order).requires_grad_()
    assert torch.autograd.gradcheck(lambda m: matrix_to_euler(m, order), R)


@settings(max_examples=30, deadline=None)
@given(st.tuples(ANGLE, ANGLE, ANGLE))
@example((0.0, 0.0, 0.03125))  # where a Taylor series of low degree is off by 2e-11
@example((0.0, 1e-4, 0.0))
@example((0.0, 0.0, 0.0))
def test_rodrigues_is_opencvs(rotvec):
    cv2 = pytest.importorskip("cv2")
    ours = rotvec_to_matrix(torch.tensor(rotvec, dtype=torch.float64))
    theirs = cv2.Rodrigues(np.array(rotvec))[0]
    torch.testing.assert_close(ours, torch.from_numpy(theirs), rtol=0, atol=1e-12)


def test_rodrigues_has_a_gradient_at_zero():
    zero = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(rotvec_to_matrix, zero)


def test_bad_input():
    with pytest.raises(InputError, match="zxy, zyx"):
        euler_to_matrix(torch.zeros(3), "xyz")  # type: ignore[arg-type]
    with pytest.raises(
        InputError, match=r"angles must be a floating-point tensor, got torch\.int64"
    ):
        euler_to_matrix(torch.zeros(3, dtype=torch.int64))
    with pytest.raises(ShapeError, match="angles"):
        euler_to_matrix(torch.zeros(4))
    with pytest.raises(ShapeError, match="rotation"):
        matrix_to_euler(torch.zeros(3, 2))
    with pytest.raises(ShapeError, match="rotvec"):
        rotvec_to_matrix(torch.zeros(2))
