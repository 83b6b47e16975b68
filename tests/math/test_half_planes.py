"""Gaussians times the likelihood of being outside of a region, against integrals over a grid."""

import pytest
import torch
from torch import Tensor

from torchpose.math._half_planes import log_outside, outside_moments

MEAN = torch.tensor([[300.0, 430.0], [20.0, 440.0], [320.0, 240.0]], dtype=torch.float64)
COV = torch.tensor([[900.0, 300.0], [300.0, 1600.0]], dtype=torch.float64)
SOFT = 10.0
BELOW = [0.0, 1.0, -480.0]
BESIDE = [-1.0, 0.0, 0.0]


def borders(*rows) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64) / SOFT


def integrated(mean, planes, log_inside):
    """Return mass, mean and covariance by sums over a fine grid."""
    axis = torch.linspace(-8, 8, 801, dtype=torch.float64)
    white = torch.cartesian_prod(axis, axis)
    points = mean + white @ torch.linalg.cholesky(COV).mT
    distance = points @ planes[:, :2].mT + planes[:, 2]
    share = (log_outside(distance, log_inside) - 0.5 * white.square().sum(-1)).exp()
    mass = share.sum() * (axis[1] - axis[0]) ** 2 / (2 * torch.pi)
    share = share / share.sum()
    centre = share @ points
    apart = points - centre
    return mass, centre, (share[:, None] * apart).mT @ apart


@pytest.mark.parametrize("log_inside", [-0.1, -1.0, -5.0])
@pytest.mark.parametrize("planes, tolerance", [([BELOW], 1e-8), ([BELOW, BESIDE], 0.06)])
def test_moments_are_the_integrals(planes, tolerance, log_inside):
    """Exact for one border, and close for two that cut the same Gaussian."""
    lines, log_inside = borders(*planes), torch.tensor(log_inside, dtype=torch.float64)
    found = outside_moments(MEAN, COV.expand(3, 2, 2), lines, log_inside)
    for row, mean in enumerate(MEAN):
        mass, centre, cov = integrated(mean, lines, log_inside)
        torch.testing.assert_close(found.log_mass[row].exp(), mass, rtol=tolerance, atol=1e-9)
        scale = float(COV[1, 1])
        assert float((found.mean[row] - centre).norm()) < tolerance * scale**0.5
        assert float((found.cov[row] - cov).abs().max()) < tolerance * scale


def test_evidence_of_nothing_changes_nothing():
    found = outside_moments(
        MEAN, COV.expand(3, 2, 2), borders(BELOW, BESIDE), torch.zeros(3).double()
    )
    torch.testing.assert_close(found.log_mass, torch.zeros(3).double(), rtol=0, atol=1e-12)
    torch.testing.assert_close(found.mean[2], MEAN[2], rtol=0, atol=1e-9)
    torch.testing.assert_close(found.cov[2], COV, rtol=0, atol=1e-6)
    assert float(log_outside(torch.tensor([[-3.0], [3.0]]), torch.zeros(2)).abs().max()) == 0


def test_the_mass_outside_is_the_one_by_logarithms():
    distance = torch.linspace(-45.0, 45.0, 400, dtype=torch.float64).view(4, -1).mT
    log_inside = torch.linspace(-8.0, 0.0, len(distance), dtype=torch.float64)
    inside = torch.special.log_ndtr(-distance).sum(-1) + torch.log(-torch.expm1(log_inside))
    expected = torch.log1p(-inside.exp())
    torch.testing.assert_close(log_outside(distance, log_inside), expected, rtol=1e-12, atol=1e-15)


def test_far_points_stay_finite_and_as_they_are():
    """Of what is far inside the likelihood is that of the region, of what is far outside it is one."""
    mean = torch.tensor([[300.0, -1e5], [300.0, 1e5]], dtype=torch.float64)
    found = outside_moments(mean, COV.expand(2, 2, 2), borders(BELOW), torch.tensor(-2.0).double())
    torch.testing.assert_close(found.log_mass, torch.tensor([-2.0, 0.0]).double())
    torch.testing.assert_close(found.mean, mean)
    torch.testing.assert_close(found.cov, COV.expand(2, 2, 2))
