"""Splines against SciPy, the matching against all possibilities, cutting against known repetitions."""

import itertools
import math

import pytest
import torch

from tests.priors.performances import performances
from torchpose.errors import InputError, ShapeError
from torchpose.learning._performances import (
    find_key_frames,
    match_key_frames,
    natural_spline,
    repetition_axis,
    split_repetitions,
    synchronise,
)


@pytest.mark.parametrize("frames", [2, 3, 4, 30])
def test_spline_is_that_of_scipy(frames):
    interpolate = pytest.importorskip("scipy.interpolate")
    values = torch.randn(frames, 3, dtype=torch.float64)
    times = torch.linspace(0, frames - 1, 77, dtype=torch.float64)
    expected = torch.from_numpy(
        interpolate.CubicSpline(range(frames), values.numpy(), bc_type="natural")(times.numpy())
        if frames > 2
        else interpolate.interp1d(range(frames), values.numpy(), axis=0)(times.numpy())
    )
    torch.testing.assert_close(natural_spline(values, times), expected, atol=1e-12, rtol=0)


@pytest.mark.parametrize("seed", range(5))
def test_matching_is_the_best_of_all(seed):
    generator = torch.Generator().manual_seed(seed)
    frames, keys = torch.randn(9, 2, generator=generator), torch.randn(5, 2, generator=generator)
    cost = torch.cdist(keys, frames).square()
    every = [(0, *inner, 8) for inner in itertools.combinations(range(1, 8), 3)]
    best = min(every, key=lambda at: float(sum(cost[i, t] for i, t in enumerate(at))))
    assert tuple(match_key_frames(frames, keys)) == best


def test_key_frames_are_the_extrema_that_stand_out():
    t = torch.linspace(0, 4 * math.pi, 401)
    assert find_key_frames(t.sin()) == (0, 50, 150, 250, 350, 400)
    assert find_key_frames(t.sin() + 0.02 * (40 * t).sin()).__len__() == 6
    assert find_key_frames(torch.arange(9.0)) == (0, 8)
    assert find_key_frames(torch.zeros(9)) == (0, 8)
    assert find_key_frames(torch.tensor([0.0, 1, 0, 1, 0]), prominence=0) == (0, 1, 2, 3, 4)
    assert find_key_frames(torch.tensor([0.0, 1, 1, 1, 0, 0, 1])) == (0, 3, 5, 6)  # it rests there


def test_the_same_motion_at_other_speeds_comes_into_step():
    t = torch.linspace(0, 1, 60, dtype=torch.float64)
    shift = torch.tensor([1.0, 0.7, 1.4, 0.8, 1.2])
    early = [t**s for s in shift.tolist()]
    moves = [torch.stack([(2 * math.pi * u).sin(), 3 * (math.pi * u).sin(), u], 1) for u in early]
    moves = [torch.cat([m, 0.5 * m]) if i % 2 else m for i, m in enumerate(moves)][:1] + moves[1:]
    found = synchronise(moves, 50, prominence=0.05)
    before, after = (x.std(0).square().sum(-1).mean().sqrt() for x in found[:2])
    assert len(found.key_frames) > 3 and after < 0.5 * before
    assert (found.times.diff(dim=1) > 0).all()
    assert (found.times[:, 0] == 0).all() and (found.times[:, -1] == 59).all()
    # at the key frames every performance is at the frame that was matched
    keys = list(found.key_frames)
    torch.testing.assert_close(found.times[:, keys], found.times[:, keys].round())


def test_performances_of_one_speed_stay_as_they_are():
    t = torch.linspace(0, 1, 41, dtype=torch.float64)[:, None]
    one = torch.cat([(2 * math.pi * t).cos(), (math.pi * t).sin(), t], 1)
    found = synchronise([one, one + 0.01, one - 0.01], 41)
    torch.testing.assert_close(found.after, found.before, atol=1e-9, rtol=0)


@pytest.mark.parametrize("fps", [15.0, 30.0, 60.0])
def test_repetitions_are_cut_apart(fps):
    seconds = torch.arange(round(12 * fps), dtype=torch.float64) / fps
    phase = (seconds - 1).clamp(0, 10) / 2  # five cycles of two seconds, a second of rest around
    moves = torch.stack([1 - (2 * math.pi * phase).cos(), (2 * math.pi * phase).sin()], 1)
    generator = torch.Generator().manual_seed(0)
    moves = moves + 0.03 * torch.randn(moves.shape, generator=generator, dtype=torch.float64)
    parts = split_repetitions(moves, fps)
    assert len(parts) == 5
    for i, part in enumerate(parts):
        assert abs(part.start / fps - (1 + 2 * i)) < 0.3
        assert abs((part.stop - 1) / fps - (3 + 2 * i)) < 0.3
    assert all(a.stop - 1 == b.start for a, b in itertools.pairwise(parts))


def test_one_axis_cuts_recordings_alike():
    start = torch.randn(6, dtype=torch.float64)
    wave = torch.linspace(0, 10 * math.pi, 200, dtype=torch.float64).cos()[:, None]
    one, other = -wave * start, wave * start  # the second begins at the other end
    axis = repetition_axis([one, one, other])
    assert float((one[0] - one[100]) @ axis) < 0
    first, second = split_repetitions(one, 30.0, axis), split_repetitions(other, 30.0, axis)
    assert float(((one[first[1]] @ axis)[0] - (other[second[1]] @ axis)[0]).abs()) < 0.2
    assert split_repetitions(one[:30], 30.0) == [slice(0, 30)]


def test_bad_input():
    good = performances(4)
    for bad, message in (
        ([], "got none"),
        ([good[0], good[1][:3]], "performance 1 has 3 frames, and key frames need at least 8"),
        ([good[0], good[1] * torch.nan], "performance 1 must be finite"),
    ):
        with pytest.raises(InputError, match=message):
            synchronise(bad)
    for axis, message in (
        (torch.zeros(36), "axis must be a direction, got zero"),
        (torch.zeros(5), r"axis must have shape \[36\], got \[5\]"),
        (good[0][0].numpy(), "axis must be a tensor, got ndarray"),
    ):
        with pytest.raises((InputError, ShapeError), match=message):
            split_repetitions(good[0], 30.0, axis)
    with pytest.raises(InputError, match="recording 0 must be a tensor, got ndarray"):
        repetition_axis([good[0].numpy()])
    with pytest.raises(ShapeError, match="recording 0 must have shape"):
        repetition_axis(good[0])
    with pytest.raises(ShapeError, match="performance 1"):
        synchronise([good[0], good[1][:, :5]])
    with pytest.raises(InputError, match="n_postures must be at least 8, got 3"):
        synchronise(good, 3)
    with pytest.raises(InputError, match="prominence"):
        synchronise(good, 40, prominence=2.0)
    wild = [torch.randn(40, 3, dtype=torch.float64) for _ in range(3)] + [
        torch.randn(8, 3).double()
    ]
    with pytest.raises(InputError, match="performance 3 has 8 frames; with"):
        synchronise(wild, 40, prominence=0.0)
    with pytest.raises(InputError, match="two frames"):
        natural_spline(torch.zeros(1, 2), torch.zeros(1))
    with pytest.raises(InputError, match="from 2 to 4 key postures"):
        match_key_frames(torch.zeros(4, 2), torch.zeros(5, 2))
    with pytest.raises(InputError, match="positive rate"):
        split_repetitions(good[0], 0.0)
    with pytest.raises(InputError, match="finite"):
        split_repetitions(good[0] * torch.nan, 30.0)
    for none in ([], [good[0], good[1][:0]]):
        with pytest.raises(InputError, match="at least one frame each"):
            repetition_axis(none)
    with pytest.raises(ShapeError, match="recording 1"):
        repetition_axis([good[0], good[1][:, :5]])
