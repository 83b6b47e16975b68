"""Ways to use two measurements of a hand, on hands that are made up."""

import torch

from benchmarks.detector_fusion import Hands, score, together
from benchmarks.hand_network.clips import BURN_IN

N = BURN_IN + 11
TRUTH = torch.tensor([[100.0, 100.0], [300.0, 100.0]], dtype=torch.float64).expand(N, 2, 2)


def hands(offset, variance, missing=()):
    points = TRUTH + torch.tensor(offset, dtype=torch.float64)
    points[list(missing)] = torch.nan
    return Hands(points, torch.full((N, 2), float(variance), dtype=torch.float64))


def test_each_way_takes_what_it_says():
    own, found = hands([8.0, 0.0], 1.0, [3]), hands([-8.0, 0.0], 3.0, [4])
    ways = together(own, found)
    off = {way: (value.points - TRUTH)[:, 0, 0].tolist() for way, value in ways.items()}
    assert off["detector, else own"][3:6] == [-8, 8, -8]
    assert off["mean"][3:6] == [-8, 8, 4]
    assert off["smaller variance"][3:6] == [-8, 8, 8]
    assert float(ways["mean"].variance[0, 0]) == 0.75


def test_lost_hands_are_counted_after_the_first_frames():
    own, found = hands([0.0, 0.0], 1.0), hands([50.0, 0.0], 1.0, [0, N - 1, N - 2])
    truth = TRUTH.clone()
    truth[-1, 1] = torch.nan
    row = score(together(own, found), truth, 100.0)
    assert row[:3] == [19, 100.0, 0.0]
    assert row[-3:] == [3, 3, 1]
    assert score(together(own, found), torch.full_like(truth, torch.nan), 100.0) is None
