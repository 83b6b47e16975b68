"""Tracks that are stepped in place: the choice of split tracks, and operations for each frame."""

import pytest
import torch

from benchmarks.speed._timing import OperationCounter
from tests.filters.oracles import tensor
from tests.filters.small_problem import Problem
from torchpose.filters._split_tracks import _first_of_largest


@pytest.mark.parametrize("count", [1, 4, 12, 20])
@pytest.mark.parametrize("values", ["distinct", "equal", "infinite", "lost"])
def test_the_largest_ranks_are_the_first_of_a_stable_sort(values, count):
    ranks = torch.randperm(60, generator=torch.Generator().manual_seed(0)).double().view(3, 20)
    if values == "equal":
        ranks = (ranks / 8).floor()
    elif values == "infinite":
        ranks[1, ::2] = -torch.inf
    elif values == "lost":
        ranks[2, 7] = torch.nan
    expected = ranks.sort(dim=1, descending=True, stable=True).indices[:, :count]
    assert torch.equal(_first_of_largest(ranks, count), expected)


@pytest.mark.parametrize(("tracks", "most"), [("sampled", 50), ("split", 90)])
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
