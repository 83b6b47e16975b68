"""Which process noise a filter gets: what the prior learnt, at its frame rate, for its method."""

import pytest
import torch

from torchpose.priors import UpperBodyPrior, load_prior
from torchpose.priors._upper_body_prior import released_process_cov
from torchpose.upper_body import METHODS, PoseFilter, UpperBodyTracker
from torchpose.upper_body._estimator_table import process_cov

FACTORS = {
    name: method.noise.factor for name, method in METHODS.items() if isinstance(method, PoseFilter)
}
WALKS = ("pf-walk", "pf-walk-unscaled")
KALMAN = ("mkf-fixed", "mkf-sampled", "mkf-split")


@pytest.fixture(scope="module")
def mixtures():
    return load_prior("kinect-upper-body-small")


def with_noise(mixtures, **noise):
    return UpperBodyPrior(mixtures.left, mixtures.right, mixtures.info, noise)


def steps(seed=0):
    factor = torch.randn(21, 40, generator=torch.Generator().manual_seed(seed)).double()
    return factor @ factor.mT


@pytest.mark.parametrize("method", FACTORS)
def test_recorded_steps_make_the_noise_of_every_method(mixtures, method):
    left, right = steps(0), steps(1)
    prior = with_noise(mixtures, increment_cov_left=left, increment_cov_right=right)
    whole = method in WALKS
    for side, cov in (("left", left), ("right", right)):
        expected = FACTORS[method] * (cov if whole else cov.diagonal())
        torch.testing.assert_close(process_cov(prior, side, method), expected)


@pytest.mark.parametrize("method", FACTORS)
def test_noise_is_proportional_to_the_interval_between_frames(mixtures, method):
    prior = with_noise(mixtures, increment_cov_left=steps(0), increment_cov_right=steps(1))
    trackers = [UpperBodyTracker(prior, prior.camera, method, fps=fps) for fps in (30.0, 10.0)]
    own, slow = (
        t.estimator.filter("right", ("hand", "head", "neck")).process_cov for t in trackers
    )
    torch.testing.assert_close(slow, 3 * own)


def test_a_walk_never_gets_noise_that_was_set_for_kalman_filters(mixtures):
    prior = with_noise(mixtures, process_cov=released_process_cov())
    for method in WALKS:
        cov = process_cov(prior, "left", method)
        within = sum(
            w * c for w, c in zip(mixtures.left.weights, mixtures.left.covariances, strict=True)
        )
        torch.testing.assert_close(cov, 0.9 / 30 * within)
    for method in KALMAN:
        torch.testing.assert_close(process_cov(prior, "left", method), released_process_cov())
    both = with_noise(
        mixtures, process_cov=released_process_cov(), increment_cov_left=steps(0),
        increment_cov_right=steps(1),
    )  # fmt: skip
    for method in KALMAN:  # that were fine-tuned
        torch.testing.assert_close(process_cov(both, "left", method), released_process_cov())
    torch.testing.assert_close(process_cov(both, "left", "pf-walk"), steps(0))


def test_noise_of_the_mirrored_prior_is_mirrored(mixtures):
    prior = with_noise(mixtures, increment_cov_left=steps(0), increment_cov_right=steps(1))
    mirrored = prior.mirrored().noise
    sign = torch.ones(21, dtype=torch.float64)
    sign[[0, 3, 6, 9, 12, 15, 17, 18]] = -1
    torch.testing.assert_close(mirrored["increment_cov_left"], steps(1) * sign * sign[:, None])
    torch.testing.assert_close(prior.mirrored().mirrored().noise["increment_cov_left"], steps(0))
