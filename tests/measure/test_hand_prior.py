"""Tables of where hands are, against samples of the prior."""

import copy

import numpy as np
import pytest
import torch

import torchpose
from torchpose.errors import InputError, PriorError
from torchpose.measure import HandTracker, MeanShiftHandTracker
from torchpose.measure._hand_prior import FACE_HEIGHT, HandPrior
from torchpose.priors import GaussianMixture, UpperBodyPrior
from torchpose.priors._prior_file import PriorInfo


@pytest.fixture(scope="module")
def prior():
    return torchpose.load_prior("kinect-upper-body")


def sampled(mixture, fx, fy, n=80_000):
    """Hand and elbow relative to the head, in face heights."""
    generator = torch.Generator().manual_seed(0)
    part = torch.multinomial(mixture.weights, n, True, generator=generator)
    noise = torch.randn(n, 21, 1, generator=generator, dtype=torch.float64)
    factor = torch.linalg.cholesky(mixture.covariances)
    state = mixture.means[part] + (factor[part] @ noise)[..., 0]
    size = FACE_HEIGHT * torch.tensor([fx, fy], dtype=torch.float64) / state[:, 11:12]
    return (state[:, 0:2] - state[:, 9:11]) / size, (state[:, 3:5] - state[:, 9:11]) / size


def test_density_and_elbow_are_those_of_samples(prior):
    table = HandPrior.from_prior(prior)
    generator = torch.Generator().manual_seed(1)
    for side, mixture in enumerate((prior.left, prior.right)):
        hand, elbow = sampled(mixture, prior.info.fx, prior.info.fy)
        hand = hand + 0.2 * torch.randn(hand.shape, generator=generator, dtype=torch.float64)
        edges = (np.arange(-4.5, 4.6, 0.5), np.arange(-2, 5.1, 0.5))
        counts, *_ = np.histogram2d(*hand.T.numpy(), edges)
        x, y = ((e[:-1] + e[1:]) / 2 for e in edges)
        fine = torch.linspace(-0.2, 0.2, 5)
        shift = torch.stack(torch.meshgrid(fine, fine, indexing="ij"), -1).view(-1, 2)
        centre = torch.stack(torch.meshgrid(torch.tensor(x), torch.tensor(y), indexing="ij"), -1)
        log_density, found = table((centre.float()[..., None, :] + shift).float())
        density = log_density[side].exp().mean(-1).numpy()
        expected = 0.95 * counts / len(hand) / 0.25 + 0.05 / 91.91
        assert np.abs(density - expected).max() < 0.02 * expected.max() + 0.002
        for i, j in np.argwhere(counts > 1600)[:20]:
            here = (hand[:, 0] > edges[0][i]) & (hand[:, 0] < edges[0][i + 1])
            here &= (hand[:, 1] > edges[1][j]) & (hand[:, 1] < edges[1][j + 1])
            mean = elbow[here].mean(0).float()
            torch.testing.assert_close(found[side, :, i, j].mean(-1), mean, atol=0.12, rtol=0)


def test_another_camera_gives_the_same_tables(prior):
    scale = torch.ones(21, dtype=torch.float64)
    scale[[0, 1, 3, 4, 6, 7, 9, 10, 12, 13]] = 2.0
    arms = [
        GaussianMixture(m.weights, m.means * scale, m.covariances * scale * scale[:, None])
        for m in (prior.left, prior.right)
    ]
    other = UpperBodyPrior(*arms, PriorInfo(fx=1050.0, fy=1050.0, cx=639.0, cy=479.0))
    torch.testing.assert_close(
        HandPrior.from_prior(other).table, HandPrior.from_prior(prior).table, atol=1e-3, rtol=0
    )


def test_mirrored_arms_have_mirrored_tables(prior):
    table = HandPrior.from_prior(prior).table
    mirrored = HandPrior.from_prior(prior.mirrored()).table
    flipped = table.flip(0).flip(-1) * torch.tensor([1.0, -1.0, 1.0])[:, None, None]
    torch.testing.assert_close(mirrored, flipped, atol=1e-3, rtol=1e-3)


def test_tables_follow_changes_of_the_prior(prior):
    changed = copy.deepcopy(prior)
    before = HandPrior.from_prior(changed)
    changed.left.means[:, :2] += 20.0
    after = HandPrior.from_prior(changed).table
    assert not torch.equal(after[0], before.table[0]) and torch.equal(after[1], before.table[1])


def test_tables_are_looked_up_between_places(prior):
    table = HandPrior.from_prior(prior)
    log_density, elbow = table(torch.tensor([[0.0, 0.0], [0.05, 0.0], [0.1, 0.0], [99.0, 0.0]]))
    torch.testing.assert_close(log_density[:, 1], log_density[:, [0, 2]].mean(1))
    assert torch.equal(log_density[:, 0], table.table[:, 0, 25, 50])
    assert torch.equal(log_density[:, 3], table.table[:, 0, 25, 100])
    assert elbow.shape == (2, 2, 4)


def test_a_prior_behind_the_camera_is_refused(prior):
    means = prior.left.means.clone()
    means[:, 11] = -2.0
    arm = GaussianMixture(prior.left.weights, means, prior.left.covariances)
    with pytest.raises(InputError, match="depths above"):
        HandPrior.from_prior(UpperBodyPrior(arm, arm))


@pytest.mark.parametrize("tracker", [HandTracker, lambda prior: MeanShiftHandTracker(prior=prior)])
def test_trackers_of_hands_take_the_prior_over_poses(prior, tracker):
    table = HandPrior.from_prior(prior)
    assert torch.equal(tracker(prior).prior.table, table.table)
    assert tracker(table).prior is table
    with pytest.raises(PriorError, match="prior must be an UpperBodyPrior, got str"):
        tracker("kinect-upper-body")
