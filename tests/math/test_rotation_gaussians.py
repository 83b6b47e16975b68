"""Gaussians over rotations against SciPy's rotations and Monte Carlo."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.math.scipy_rotations import local, scipy
from torchpose.errors import InputError, ShapeError
from torchpose.math import (
    angle_to_edge,
    compose,
    conjugate,
    fit_gaussian,
    gaussian_rotate,
    rotate_gaussian,
    safe_centre,
)
from torchpose.math._rotation_gaussians import turn_gaussian


def rotation(degrees):
    """Quaternion vector of a rotation vector in degrees."""
    quaternion = Rotation.from_rotvec(np.asarray(degrees), degrees=True).as_quat()
    quaternion *= np.where(quaternion[..., 3:] < 0, -1, 1)
    return torch.as_tensor(quaternion[..., :3])


def covariance(seed, std=0.08, batch=()):
    g = torch.Generator().manual_seed(seed)
    a = torch.randn(*batch, 3, 3, generator=g, dtype=torch.float64)
    return std**2 / 3 * a @ a.mT


def drawn(mean, cov, count=200_000, seed=0):
    x = np.random.default_rng(seed).multivariate_normal(mean.numpy(), cov.numpy(), count)
    return scipy(torch.as_tensor(x))


MEAN = torch.tensor([0.1, -0.15, 0.05]).double()
CENTRE, NEW_CENTRE = rotation([40.0, -20.0, 60.0]), rotation([90.0, 50.0, -10.0])
TURN = rotation([30.0, 80.0, -70.0])


def test_safe_centre_is_the_training_rotation_of_the_paper():
    g = torch.Generator().manual_seed(0)
    vectors = compose(rotation([150.0, 0, 0]), 0.2 * torch.randn(2, 40, 3, generator=g).double())
    q = scipy(vectors.reshape(-1, 3)).as_quat().reshape(2, 40, 4)
    for i in range(2):
        scores = [np.mean([abs(a @ b) for b in q[i]]) for a in q[i]]
        torch.testing.assert_close(safe_centre(vectors[i]), vectors[i, int(np.argmax(scores))])
    torch.testing.assert_close(safe_centre(vectors)[1], safe_centre(vectors[1]))


def test_a_safe_space_keeps_training_rotations_from_the_edge():
    spread = torch.linspace(-60, 60, 41).double()
    about_half_a_turn = rotation(np.stack([170 + spread, 0 * spread, 0 * spread], -1))
    assert float(angle_to_edge(about_half_a_turn)) < math.radians(1.5)
    centre = safe_centre(about_half_a_turn)
    assert math.degrees(angle_to_edge(about_half_a_turn, centre)) == pytest.approx(120, abs=1e-4)
    mean, cov = fit_gaussian(about_half_a_turn, centre)
    assert float(cov[0, 0]) == pytest.approx(float((spread / 2).deg2rad().sin().var(correction=0)))
    assert abs(float(mean[0])) < 1e-12


def test_the_angle_to_the_edge():
    assert math.degrees(angle_to_edge(rotation([[0, 0, 10.0], [0, -130, 0]]))) == pytest.approx(50)
    assert float(angle_to_edge(rotation([[0, 0, 0.0]]))) == pytest.approx(math.pi)


def test_both_directions_are_within_monte_carlo_error():
    cov = covariance(1)
    draws = scipy(CENTRE) * drawn(MEAN, cov)
    spaces = {"centre": CENTRE, "new_centre": NEW_CENTRE}
    for ours, theirs in (
        (rotate_gaussian(TURN, MEAN, cov, **spaces), scipy(TURN) * draws),
        (gaussian_rotate(MEAN, cov, TURN, **spaces), draws * scipy(TURN)),
    ):
        x = local(theirs, NEW_CENTRE)
        np.testing.assert_allclose(ours[0], x.mean(0), atol=1e-3)
        np.testing.assert_allclose(ours[1], np.cov(x.T), atol=2e-4)  # deviations of 0.08


def test_there_and_back_again():
    cov = covariance(2, 0.03)
    mean, new = turn_gaussian(MEAN, cov, left=TURN, right=CENTRE)
    mean, new = turn_gaussian(mean, new, left=conjugate(TURN), right=conjugate(CENTRE))
    torch.testing.assert_close(mean, MEAN, atol=1e-4, rtol=0)
    torch.testing.assert_close(new, cov, atol=1e-5, rtol=0)


def test_certain_rotations_are_composed_exactly():
    mean, cov = rotate_gaussian(
        TURN, MEAN, torch.zeros(3, 3).double(), centre=CENTRE, new_centre=NEW_CENTRE
    )
    expected = local(scipy(TURN) * scipy(CENTRE) * scipy(MEAN[None]), NEW_CENTRE)[0]
    np.testing.assert_allclose(mean, expected, atol=1e-12)
    assert float(cov.abs().max()) < 1e-30


def test_a_rotation_about_the_centre_turns_the_covariance():
    """C R(x) q in the space of C' = C q is q^-1 R(x) q: the vector itself turned, exactly."""
    cov = covariance(3, 0.2)
    mean, new = gaussian_rotate(MEAN, cov, TURN, centre=CENTRE, new_centre=compose(CENTRE, TURN))
    matrix = scipy(TURN).inv().as_matrix()
    np.testing.assert_allclose(mean, matrix @ MEAN.numpy(), atol=1e-9)
    np.testing.assert_allclose(new, matrix @ cov.numpy() @ matrix.T, atol=1e-9)


def test_points_come_to_the_hemisphere_of_the_mean():
    """Turned by 175 degrees, half of the points have a negative scalar part; none may jump."""
    cov = torch.diag(torch.tensor([0.1, 0.01, 0.01]).double() ** 2)
    mean, new = turn_gaussian(torch.zeros(3).double(), cov, left=rotation([175.0, 0, 0]))
    assert 0.9 < float(mean[0]) < 1 and float(new.diagonal().sum()) < 2 * 0.1**2


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("directions", ["eigen", "cholesky"])
def test_any_batch_equals_one_at_a_time(dtype, directions):
    covs = covariance(4, batch=(4, 1, 5)).to(dtype)
    g = torch.Generator().manual_seed(5)
    turns = 0.4 * torch.randn(2, 5, 3, generator=g).to(dtype)
    options = {"directions": directions, "centre": CENTRE.to(dtype), "new_centre": turns}
    mean, cov = rotate_gaussian(turns, MEAN.to(dtype), covs, **options)
    assert mean.shape == (4, 2, 5, 3) and mean.dtype == cov.dtype == dtype
    assert torch.equal(cov, cov.mT)
    options["new_centre"] = turns[1, 3]
    one = rotate_gaussian(turns[1, 3], MEAN.to(dtype), covs[2, 0, 3], **options)
    torch.testing.assert_close((mean[2, 1, 3], cov[2, 1, 3]), one)


def test_both_kinds_of_directions_agree_where_the_covariance_is_small():
    for std, tolerance in ((0.01, 1e-8), (0.1, 1e-4)):
        args = (TURN, MEAN, covariance(6, std))
        eigen, cholesky = (rotate_gaussian(*args, directions=d) for d in ("eigen", "cholesky"))
        torch.testing.assert_close(eigen, cholesky, atol=10 * tolerance, rtol=0)


def test_bad_input():
    with pytest.raises(InputError, match="at least one rotation"):
        safe_centre(torch.zeros(2, 0, 3))
    with pytest.raises(InputError, match="vectors must be finite"):
        safe_centre(torch.full((4, 3), math.nan))


@pytest.mark.parametrize("function", [fit_gaussian, angle_to_edge])
def test_quaternions_and_nothing_are_no_rotations(function):
    with pytest.raises(
        ShapeError, match=r"vectors must have shape \[\.\.\., any, 3\], got \[5, 4\]"
    ):
        function(torch.zeros(5, 4))
    with pytest.raises(InputError, match="expected at least one rotation, got none"):
        function(torch.zeros(0, 3))


def test_a_turn_by_a_quaternion_is_refused():
    none, eye = torch.zeros(3), 0.01 * torch.eye(3)
    with pytest.raises(ShapeError, match=r"rotation must have shape \[\.\.\., 3\], got \[4\]"):
        rotate_gaussian(torch.zeros(4), none, eye)
    with pytest.raises(ShapeError, match=r"mean must have shape \[\.\.\., 3\], got \[4\]"):
        gaussian_rotate(torch.zeros(4), torch.eye(4), none)


def test_turns_of_another_precision_are_taken():
    turn, mean, cov = torch.tensor([0.5, -0.2, 0.3]), torch.full((3,), 0.1), 0.01 * torch.eye(3)
    want = rotate_gaussian(turn.double(), mean.double(), cov.double())
    torch.testing.assert_close(rotate_gaussian(turn, mean.double(), cov.double()), want)
    want = gaussian_rotate(mean.double(), cov.double(), turn.double(), centre=turn.double())
    found = gaussian_rotate(mean.double(), cov.double(), turn, centre=turn)
    torch.testing.assert_close(found, want)
