"""Tracks that are stepped in place: the choice of split tracks, and operations for each frame."""

import pytest
import torch
from torch.distributions import MultivariateNormal

from benchmarks.speed._timing import OperationCounter
from tests.filters.oracles import tensor
from tests.filters.small_problem import Problem
from torchpose.filters._joint_tracks import JointTracks
from torchpose.filters._split_candidates import CandidateRoom
from torchpose.filters._split_tracks import SplitTrackFilter, _first_of_largest
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
    assert torch.equal(_first_of_largest(ranks, count), expected)


def test_of_log_weights_that_only_rounding_tells_apart_the_first_is_taken():
    log_weights = torch.tensor([[-3.0, -1.0, -1.0 + 1e-11, -2.0]], dtype=torch.float64)
    assert _first_of_largest(log_weights, 3).tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("n_observed", [1, 2, 5])
@pytest.mark.parametrize("gaps", [False, True])
def test_candidates_of_split_tracks_have_the_density_of_their_measurement(n_observed, gaps):
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(3, 6, 6, generator=generator, dtype=torch.float64)
    means = torch.randn(3, 6, generator=generator, dtype=torch.float64)
    prior = GaussianMixture(torch.full((3,), 1 / 3).double(), means, root @ root.mT)
    noise = torch.linspace(0.5, 1.5, n_observed, dtype=torch.float64)
    model = SplitTrackFilter(prior, torch.ones(6), noise, torch.arange(6)[-n_observed:])
    z = torch.randn(2, 1, n_observed, generator=generator, dtype=torch.float64)
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


@pytest.mark.parametrize(("tracks", "most"), [("sampled", 46), ("split", 68)])
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
