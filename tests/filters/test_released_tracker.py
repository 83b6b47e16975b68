"""Parity with the sign-language tracker that the paper's authors released."""

import numpy as np
import pytest
import torch

from tests.data import data_dir_or_skip
from tests.filters.oracles import tensor
from torchpose.filters import MixtureKalmanFilter
from torchpose.priors import GaussianMixture

PROCESS = [560, 560, 1, 56, 56, 1, 25, 25, 1, 25, 25, 1, 25, 25, 1, 0.5, 0.5, 0.5, 0.01, 0.01, 0.01]
MEASUREMENT = [1, 1, 1, 1, 124, 144, 124, 144]
OBSERVED = [9, 10, 0, 1, 12, 13, 3, 4]  # head, hand, neck, elbow


def released_filter(folder, side, **options):
    """The released tracker's settings."""
    prior = np.load(folder / "released_prior_Training20_02.npz")
    names = ("weights", "means", "covariances")
    mixture = GaussianMixture(*(tensor(prior[f"{side}_{name}"]) for name in names))
    return MixtureKalmanFilter(
        mixture,
        tensor(PROCESS),
        tensor(MEASUREMENT),
        OBSERVED,
        uniform_weight=0.0,
        initial_cov=5000 * torch.eye(21, dtype=torch.float64),
        **options,
    )


@pytest.mark.parametrize("online", [False, True])
@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("video", ["000", "076"])
def test_means_and_weights_are_those_of_the_released_code(video, side, online):
    folder = data_dir_or_skip("signer")
    reference = np.load(folder / f"reference_fixed_tracks_video_{video}.npz")
    model = released_filter(folder, side)
    z = tensor(reference[f"{side}_measurements"])[None]
    if online:
        state, steps = model.init(1), []
        for t in range(z.shape[1]):
            state, out = model.step(state, z[:, t])
            steps.append(out)
        mean = torch.cat([s.mean for s in steps])
        weights = torch.cat([s.log_weights for s in steps]).exp()
    else:
        out = model(z)
        mean, weights = out.mean[0], out.log_weights[0].exp()
    for ours, theirs in (
        (mean, reference[f"{side}_mean"]),
        (weights, reference[f"{side}_weights"]),
    ):
        error = np.abs(ours.numpy() - theirs) / np.maximum(np.abs(theirs), 1)
        assert error.max() < 1e-6


def test_weights_reset_to_the_prior_when_all_of_them_vanish():
    folder = data_dir_or_skip("signer")
    model = released_filter(folder, "left", reset_below=float(np.log(np.finfo(float).tiny)))
    z = tensor(np.load(folder / "reference_fixed_tracks_video_000.npz")["left_measurements"])[
        None, :9
    ]
    lost = z.clone()
    lost[:, 5] += 1e4  # no component explains this frame within double precision
    out = model(lost)
    expected = model.log_prior.exp()
    torch.testing.assert_close(out.log_weights[0, 5].exp(), expected, rtol=1e-12, atol=0)
    assert (out.log_weights[0, 4].exp() - expected).abs().max() > 0.1
    assert torch.isfinite(out.mean).all()
