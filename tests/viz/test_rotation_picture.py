"""The picture of Gaussians over rotations: points on a sphere, where rotations put them."""

import math

import numpy as np
import pytest
import torch

pytest.importorskip("matplotlib", reason="matplotlib is not installed")

from torchpose.errors import InputError, ShapeError
from torchpose.viz import save_figure
from torchpose.viz._rotation_picture import plot_rotations

COVARIANCE = torch.diag(torch.tensor([0.2, 0.05, 0.0]).double() ** 2)


def test_a_quarter_turn_about_the_view_moves_the_mean_from_below_to_the_right(tmp_path):
    quarter = torch.tensor([0.0, 0.0, math.sin(math.pi / 4)]).double()
    still = torch.zeros(3).double()
    figure = plot_rotations(
        {"rest": (still, COVARIANCE, None), "turned": (still, COVARIANCE, quarter)}, view=(0, 0)
    )
    assert [ax.texts[0].get_text() for ax in figure.axes] == ["rest", "turned"]
    for ax, expected in zip(figure.axes, ((0, -1), (1, 0)), strict=True):
        mean = ax.lines[-1].get_xydata()
        np.testing.assert_allclose(mean, [expected], atol=1e-6)
        clouds = np.concatenate([dots.get_offsets() for dots in ax.collections])
        assert len(clouds) == 1500 and (np.linalg.norm(clouds, axis=1) < 1 + 1e-6).all()
    assert save_figure(figure, tmp_path / "rotations.png").stat().st_size > 10_000


def test_bad_input():
    gaussian = (torch.zeros(3), torch.eye(3), None)
    with pytest.raises(InputError, match="at least one Gaussian"):
        plot_rotations({})
    with pytest.raises(InputError, match="gaussians must go by names"):
        plot_rotations(gaussian)
    with pytest.raises(InputError, match="direction must have a length"):
        plot_rotations({"a": gaussian}, direction=(0.0, 0.0, 0.0))
    for bad, said in (
        (gaussian[:2], r"gaussians\['a'\] must be a mean, a covariance and a centre or None"),
        ((torch.zeros(3), -torch.eye(3), None), "covariance must be positive definite"),
        ((torch.zeros(3) * torch.nan, torch.eye(3), None), "mean must be finite"),
        ((np.zeros(3), torch.eye(3), None), "mean must be a tensor, got ndarray"),
    ):
        with pytest.raises(InputError, match=said):
            plot_rotations({"a": bad})
    with pytest.raises(InputError, match="draws must be a whole number of 0 or more, got -5"):
        plot_rotations({"a": gaussian}, draws=-5)
    with pytest.raises(ShapeError, match="covariance must have shape"):
        plot_rotations({"a": (torch.zeros(3), torch.eye(2), None)})
