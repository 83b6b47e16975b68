"""Tracks that are stepped in place: the choice of split tracks, and operations for each frame."""

import pytest
import torch
from torch.distributions import MultivariateNormal

from benchmarks.speed._timing import OperationCounter
from tests.filters.oracles import tensor
from tests.filters.small_problem import Problem
from torchpose.filters._joint_tracks import JointTracks, joint_problems
from torchpose.filters._split_candidates import CandidateRoom
from torchpose.filters._split_tracks import SplitTrackFilter, _first_of_largest
from torchpose.math._gaussian import mended_update
from torchpose.priors import GaussianMixture


@pytest.mark.parametrize("count", [1, 4, 12, 20])
@pytest.mark.parametrize("values", ["distinct", "equal", "infinite", "lost"])
def test_the_largest_are_the_first_of_a_stable_sort(values, count):
    ranks = torch.randperm(60, generator=torch.Generator().manual_seed(0)).double().view(3, 20)
    if values == "equal":
        ranks = (ranks / 8).floor()
    elif values == "infinite":
        ranks[1, ::2] = -torch.inf
    elif values == "lost":
        ranks[2, 7] = torch.nan
    expected = ranks.sort(dim=1, descending=True, stable=True).indices[:, :count]
    largest, places = _first_of_largest(ranks, count)
    assert torch.equal(places, expected)
    assert torch.equal(largest.nan_to_num(), ranks.gather(1, expected).nan_to_num())


def test_of_log_weights_that_only_rounding_tells_apart_the_first_is_taken():
    log_weights = torch.tensor([[-3.0, -1.0, -1.0 + 1e-11, -2.0]], dtype=torch.float64)
    assert _first_of_largest(log_weights, 3)[1].tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("n_observed", [1, 2, 5])
@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("unit", [1.0, 1e-50])
def test_candidates_of_split_tracks_have_the_density_of_their_measurement(n_observed, gaps, unit):
    """In tiny units the product of five variances is beyond the smallest number."""
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(3, 6, 6, generator=generator, dtype=torch.float64)
    means = unit * torch.randn(3, 6, generator=generator, dtype=torch.float64)
    prior = GaussianMixture(torch.full((3,), 1 / 3).double(), means, unit**2 * (root @ root.mT))
    noise = unit**2 * torch.linspace(0.5, 1.5, n_observed, dtype=torch.float64)
    process = torch.full((6,), unit**2, dtype=torch.float64)
    model = SplitTrackFilter(prior, process, noise, torch.arange(6)[-n_observed:])
    z = unit * torch.randn(2, 1, n_observed, generator=generator, dtype=torch.float64)
    mask = torch.ones(z.shape, dtype=torch.bool)
    mask[0, 0, 0] = not gaps
    frames = model.check(z, mask, None, None, None)
    state = model.init(2)
    (frame,) = model._frames(frames, 0)
    tracks = JointTracks(model, state.mean, state.cov[state.group])
    found = CandidateRoom().log_likelihood(frame.shared, tracks, frame.own)

    move = model.transition(0)
    for element in range(2):
        seen = model.observed[mask[element, 0]]
        measured, own = z[element, 0][mask[element, 0]], torch.diag(noise[mask[element, 0]])
        for track in range(3):
            for component in range(3):
                step = move.matrix[component]
                mean = (step @ state.mean[element, track] + move.offset[component])[seen]
                cov = step @ state.cov[0, track] @ step.mT + move.noise[component]
                cov = cov[seen][:, seen] + own
                expected = MultivariateNormal(mean, cov).log_prob(measured) if len(seen) else 0.0
                assert float(found[component, element, track]) == pytest.approx(float(expected))


@pytest.mark.parametrize("definite", [True, False])
def test_tracks_are_corrected_as_single_kalman_filters_are_mended_ones_too(definite):
    generator = torch.Generator().manual_seed(1)
    root = torch.randn(2, 3, 6, 6, generator=generator, dtype=torch.float64)
    mean = torch.randn(2, 3, 6, generator=generator, dtype=torch.float64)
    cov, observed = root @ root.mT, [4, 1, 2]
    if not definite:
        line = root[1, 2, :, :1]
        cov[1, 2] = line @ line.mT - 1e-13 * torch.eye(6)  # of rank 1, off by rounding
        cov[0, 1] = -cov[0, 1]  # lost
    prior = GaussianMixture(torch.ones(1).double(), mean[0, :1], cov[0, :1])
    noise = torch.full((3,), 1e-20, dtype=torch.float64)
    model = SplitTrackFilter(prior, torch.ones(6), noise, observed)
    z = torch.randn(2, 1, 3, generator=generator, dtype=torch.float64)
    frames = model.check(z, None, None, None, None)
    (problem,) = joint_problems(frames)
    tracks = JointTracks(model, mean, cov)
    log_likelihood, jitter = tracks.weigh(problem)
    expected = mended_update(mean, cov, z, torch.diag(noise), model.observed)
    assert (jitter is None) == (expected[3] is None) == definite
    torch.testing.assert_close(tracks.mean, expected[0], equal_nan=True)
    torch.testing.assert_close(tracks.cov, expected[1], equal_nan=True)
    torch.testing.assert_close(log_likelihood, expected[2], equal_nan=True)


@pytest.mark.parametrize(("tracks", "most"), [("sampled", 46), ("split", 76)])
def test_a_frame_is_a_bounded_number_of_operations(tracks, most):
    """A frame of one sequence takes as long as its small operations."""
    p = Problem(n_frames=60)
    model, z = p.filter(tracks=tracks), tensor(p.z)
    counts = []
    for n_frames in (20, 20, 60):  # the first run makes what is kept
        with OperationCounter() as counter, torch.no_grad():
            model(z[:, :n_frames], generator=torch.Generator().manual_seed(0))
        counts.append(counter.count)
    assert (counts[2] - counts[1]) / 40 < most
