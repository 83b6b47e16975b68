"""Quaternion vectors against SciPy's rotations, and near the angles 0 and pi."""

import math

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchpose.body import BODY_15, Body
from torchpose.errors import InputError, ShapeError
from torchpose.math import compose, conjugate, mean_rotation, quaternion_vector_to_matrix
from torchpose.math._rotations import (
    matrix_to_quaternion_vector,
    minimal_rotation,
    quaternion_to_vector,
    vector_to_quaternion,
    within_unit_ball,
)

ANGLES = [0.0, 1e-12, 1e-8, 1e-4, 0.3, 2.0, math.pi - 1e-4, math.pi - 1e-8, math.pi]


def random_rotations(n, seed=0):
    return Rotation.random(n, random_state=np.random.RandomState(seed))


def vector_of(rotation):
    return quaternion_to_vector(torch.tensor(rotation.as_quat()))


def angle_between(a, b):
    """Angle of R_a^T R_b, radians, by its sine and cosine."""
    R = quaternion_vector_to_matrix(a).mT @ quaternion_vector_to_matrix(b)
    axis = torch.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0],
                        R[..., 1, 0] - R[..., 0, 1]], -1)  # fmt: skip
    trace = R.diagonal(dim1=-2, dim2=-1).sum(-1)
    return torch.atan2(axis.norm(dim=-1), trace - 1)


def test_matrices_are_those_of_scipy():
    rotations = random_rotations(200)
    expected = torch.tensor(rotations.as_matrix())
    torch.testing.assert_close(quaternion_vector_to_matrix(vector_of(rotations)), expected)


def test_products_are_those_of_scipy():
    first, second = random_rotations(100, 1), random_rotations(100, 2)
    expected = torch.tensor((first * second).as_matrix())
    product = compose(vector_of(first), vector_of(second))
    torch.testing.assert_close(quaternion_vector_to_matrix(product), expected)
    assert float(angle_between(conjugate(vector_of(first)), vector_of(first.inv())).max()) < 1e-12


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, -1, 0), (0.6, 0.0, 0.8), (1, 1, 1)])
def test_matrix_and_back_at_every_angle(angle, axis):
    unit = torch.tensor(axis, dtype=torch.float64) / math.hypot(*axis)
    vector = math.sin(angle / 2) * unit
    back = matrix_to_quaternion_vector(quaternion_vector_to_matrix(vector))
    torch.testing.assert_close(back.abs(), vector.abs(), rtol=1e-7, atol=1e-15)
    assert float(angle_between(back, vector)) < 2e-8


@settings(deadline=None, max_examples=50)
@given(st.lists(st.floats(-2, 2), min_size=3, max_size=3))
@example([1.0, 0.0, 0.0])
@example([0.6, 0.8, 0.0])
@example([0.0, 0.0, 0.0])
def test_every_vector_is_a_rotation_with_finite_gradients(entries):
    vector = torch.tensor(entries, dtype=torch.float64, requires_grad=True)
    R = quaternion_vector_to_matrix(vector)
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-14)
    assert float(torch.linalg.det(R.detach())) == pytest.approx(1.0)
    matrix_to_quaternion_vector(R).sum().backward()
    assert bool(torch.isfinite(vector.grad).all())


def test_gradients_inside_the_ball():
    vectors = torch.randn(6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    vectors = (0.2 * vectors).requires_grad_()
    assert torch.autograd.gradcheck(quaternion_vector_to_matrix, vectors)
    assert torch.autograd.gradcheck(compose, (vectors, vectors.detach().flip(0)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_longer_vectors_go_back_to_the_sphere(dtype):
    vectors = torch.tensor([[3.0, 0.0, 0.0], [0.1, 0.2, -0.3]], dtype=dtype)
    kept = within_unit_ball(vectors)
    assert kept.tolist() == [[1.0, 0.0, 0.0], vectors[1].tolist()]
    assert vector_to_quaternion(vectors)[0].tolist() == [1.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("angle", ANGLES)
def test_minimal_rotation_swings_by_the_angle_between(angle):
    start = torch.tensor([0.0, -2.0, 0.0], dtype=torch.float64)
    end = 3 * torch.tensor([0.0, -math.cos(angle), math.sin(angle)], dtype=torch.float64)
    swing = minimal_rotation(start, end)
    turned = quaternion_vector_to_matrix(swing) @ (start / 2)
    torch.testing.assert_close(turned, end / 3, rtol=0, atol=2e-8)
    assert float(swing.norm()) == pytest.approx(math.sin(angle / 2), abs=1e-12)


def test_minimal_rotation_has_no_twist_and_takes_batches():
    generator = torch.Generator().manual_seed(3)
    a, b = torch.randn(2, 40, 1, 3, generator=generator, dtype=torch.float64)
    swing = minimal_rotation(a, b.expand(40, 5, 3))
    assert swing.shape == (40, 5, 3)
    assert float((swing * a).sum(-1).abs().max()) < 1e-12  # the axis lies across the direction


def test_mean_is_that_of_scipy():
    rotations = random_rotations(30, 4)
    weights = np.random.RandomState(5).rand(30)
    expected = vector_of(rotations.mean(weights))
    mean = mean_rotation(vector_of(rotations), torch.tensor(weights))
    assert float(angle_between(mean, expected)) < 1e-7


def test_mean_of_both_signs_of_a_half_turn():
    vectors = torch.tensor([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
    mean = mean_rotation(vectors)
    assert mean.abs().tolist() == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)


@pytest.mark.parametrize(
    "vectors",
    [
        torch.zeros(3, 3),
        torch.tensor([[0.0, 0.1, 0.0], [0.0, -0.3, 0.0]]),
        torch.tensor([[0.1, 0.2, 0.3]]),
    ],
)
def test_means_of_equal_rotations_and_of_turns_about_one_axis_have_gradients(vectors):
    vectors = vectors.double().requires_grad_()
    weights = torch.linspace(0.5, 1, len(vectors)).double().requires_grad_()
    assert torch.autograd.gradcheck(mean_rotation, (vectors, weights))
    with torch.no_grad():
        expected = mean_rotation(vectors, weights)
    assert torch.equal(mean_rotation(vectors, weights), expected)


def test_a_mean_that_is_lost_stays_alone():
    vectors = torch.tensor([[0.1, 0.2, 0.3], [0.0, 0.5, 0.1]], dtype=torch.float64).repeat(3, 1, 1)
    weights = torch.tensor([[0.5, 0.5], [0.5, 0.5], [math.nan, 0.5]], dtype=torch.float64)
    expected = mean_rotation(vectors[0], weights[0])
    vectors[1, 0, 2] = math.nan
    mean = mean_rotation(vectors, weights)
    torch.testing.assert_close(mean[0], expected)
    assert bool(mean[1:].isnan().all())


def test_wrong_sizes_are_named():
    with pytest.raises(ShapeError, match=r"second must have shape \[\.\.\., 3\], got \[4\]"):
        compose(torch.zeros(3), torch.zeros(4))
    with pytest.raises(ShapeError, match="vector must have shape"):
        quaternion_vector_to_matrix(torch.zeros(4))
    with pytest.raises(ShapeError, match="rotation must have shape"):
        matrix_to_quaternion_vector(torch.zeros(3, 4))


def test_products_take_both_precisions():
    first, second = torch.tensor([0.3, 0.1, -0.2]), torch.tensor([0.1, 0.5, 0.2])
    want = compose(first.double(), second.double())
    torch.testing.assert_close(compose(first, second.double()), want, rtol=0, atol=0)
    body = Body.of_height(BODY_15, 1.7)
    state = torch.full((body.dim,), 0.1)
    assert body.perturb(state, 0.01 * state.double()).dtype == torch.float64


def test_weights_of_a_mean():
    vectors = torch.tensor([[0.3, 0.0, 0.0], [0.0, 0.2, 0.0]])
    weights = torch.tensor([[1.0, 0.0], [0.0, 0.0]]).double()
    mean = mean_rotation(vectors.expand(2, 2, 3), weights)
    torch.testing.assert_close(mean[0], vectors[0].double())
    assert bool(mean[1].isnan().all())
    with pytest.raises(InputError, match="weights must not be negative, got -2"):
        mean_rotation(vectors, torch.tensor([1.0, -2.0]))
    with pytest.raises(ShapeError, match=r"weights must have shape \[\.\.\., 2\], got \[1\]"):
        mean_rotation(vectors, torch.ones(1))
    with pytest.raises(InputError, match="at least one rotation, got none"):
        mean_rotation(vectors[:0])
