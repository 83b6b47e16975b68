"""Likelihoods of silhouettes against their definitions, pixel by pixel."""

import pytest
import torch

from torchpose.whole_body import bidirectional
from torchpose.whole_body._silhouettes.likelihood import LIKELIHOODS, intersection_over_union
from torchpose.whole_body._silhouettes.rendering import SilhouetteCounts


def images(seed=0, n=6, cameras=3):
    """Model [N, C, H, W] and silhouette [C, H, W]; some of both are empty."""
    g = torch.Generator().manual_seed(seed)
    model = torch.rand(n, cameras, 9, 11, generator=g) < 0.3
    observed = torch.rand(cameras, 9, 11, generator=g) < 0.4
    model[1, 0] = False
    model[2] = False
    model[3] = observed
    observed[2] = False
    return model, observed


def counts_of(model, observed):
    overlap = (model & observed).sum((-2, -1))
    return SilhouetteCounts(model.sum((-2, -1)), overlap, observed.sum((-2, -1)).expand_as(overlap))


def test_bidirectional_is_the_sum_over_pixels():
    """(MR 12): the mean of 1 - S over pixels of S(x), and of 1 - S(x) over those of S."""
    model, observed = images()
    result = bidirectional(counts_of(model, observed))
    for n in range(len(model)):
        total = 0.0
        for S, Sx in zip(observed, model[n], strict=True):
            outside = 1 - S[Sx].double()
            missed = 1 - Sx[S].double()
            total += float(outside.mean()) if len(outside) else 1.0
            total += float(missed.mean()) if len(missed) else 1.0
        assert float(result[n]) == pytest.approx(-total / 3, abs=1e-12)
    assert result.dtype == torch.float64 and bool((result >= -2).all())


def test_intersection_over_union_is_the_ratio_of_areas():
    model, observed = images(1)
    result = intersection_over_union(counts_of(model, observed))
    for n in range(len(model)):
        ratios = [
            float((S & Sx).sum()) / float((S | Sx).sum()) if bool((S | Sx).any()) else 0.0
            for S, Sx in zip(observed, model[n], strict=True)
        ]
        assert float(result[n]) == pytest.approx(sum(ratios) / 3, abs=1e-12)


def test_best_and_worst():
    same = torch.rand(2, 5, 5) < 0.5
    counts = counts_of(same[None], same)
    assert bidirectional(counts).tolist() == [0.0]
    assert intersection_over_union(counts).tolist() == [1.0]
    nothing = counts_of(torch.zeros(1, 2, 5, 5, dtype=torch.bool), torch.zeros(2, 5, 5).bool())
    assert bidirectional(nothing).tolist() == [-2.0]
    assert intersection_over_union(nothing).tolist() == [0.0]


def test_overlap_is_a_log_likelihood():
    counts = counts_of(*images(2))
    overlap = LIKELIHOODS["overlap"](counts)
    torch.testing.assert_close(overlap.exp(), intersection_over_union(counts))
    assert float(overlap[2]) == -torch.inf
