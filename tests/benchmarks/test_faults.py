"""Faults of silhouettes: what each kind may change, how much, and for how long."""

import pytest
import torch
from torch.nn.functional import max_pool2d

from benchmarks.bodies.faults import FAULTS, add_faults
from torchpose.body import Limbs
from torchpose.camera import PinholeCamera
from torchpose.errors import InputError, ShapeError
from torchpose.whole_body._silhouettes.rendering import render_limbs


@pytest.fixture(scope="module")
def clean():
    """A figure of five limbs that walks sideways, [40, 2, 120, 160]."""
    points = [
        ((0, -0.75, 0), (0, -0.65, 0), 0.1),  # head
        ((0, -0.4, 0), (0, 0, 0), 0.15),
        ((0.2, -0.45, 0), (0.35, 0.1, 0), 0.05),
        ((0.1, 0, 0), (0.15, 0.8, 0), 0.07),
        ((-0.1, 0, 0), (-0.15, 0.8, 0), 0.07),
    ]
    start, end = (torch.tensor([p[i] for p in points], dtype=torch.float64) for i in (0, 1))
    radii = torch.tensor([[p[2]] * 2 for p in points], dtype=torch.float64)
    walk = torch.zeros(40, 1, 3, dtype=torch.float64)
    walk[:, 0, 0] = torch.linspace(-0.4, 0.4, 40)
    cameras = [
        PinholeCamera(130, 130, 79.5, 59.5, name=n, translation=t)
        for n, t in (("a", (0, 0, 3.0)), ("b", (0.2, 0, 2.6)))
    ]
    return render_limbs(Limbs(start + walk, end + walk, radii), cameras, 120, 160)


def faulty(clean, severity=1.0, kinds=FAULTS, seed=0):
    return add_faults(clean, severity, torch.Generator().manual_seed(seed), kinds)


def agreement(a, b):
    """Intersection over union of everything."""
    return float((a & b).sum() / (a | b).sum())


def test_none_and_typical(clean):
    assert torch.equal(faulty(clean, 0.0), clean)
    values = [agreement(faulty(clean, severity), clean) for severity in (0.25, 0.5, 1.0, 2.0)]
    assert values == sorted(values, reverse=True)
    assert values[0] > 0.85 and 0.65 < values[2] < 0.9 and values[3] > 0.35


def test_the_seed_decides(clean):
    few = clean[:4]
    one = faulty(few, seed=3)
    assert one.shape == few.shape and one.dtype == torch.bool
    assert torch.equal(one, faulty(few, seed=3))
    assert not torch.equal(one, faulty(few, seed=4))
    assert torch.equal(add_faults(few), add_faults(few))


def test_holes_lie_in_the_body_and_last(clean):
    result = faulty(clean, kinds=["holes"])
    lost = clean & ~result
    assert not (result & ~clean).any()
    assert 0.02 < float(lost.sum() / clean.sum()) < 0.15
    both = (lost[1:] & lost[:-1]).sum() / (lost[1:] | lost[:-1]).sum()
    assert float(both) > 0.4  # by chance it would be about the share of what is lost
    far = (lost[20:] & lost[:-20]).sum() / (lost[20:] | lost[:-20]).sum()
    assert float(far) < float(both) / 2


def test_missing_regions_come_and_go(clean):
    result = torch.cat([faulty(clean, kinds=["missing"], seed=s) for s in range(8)])
    lost = (clean.repeat(8, 1, 1, 1) & ~result).sum((-2, -1)) > 10
    assert not (result & ~clean.repeat(8, 1, 1, 1)).any()
    assert 0.08 < float(lost.double().mean()) < 0.4
    changes = (lost[1:] != lost[:-1]).sum()
    assert float(lost.sum() / changes.clamp_min(1)) > 2  # spells of several frames


def test_a_shadow_lies_at_the_feet(clean):
    result = faulty(clean, kinds=["shadow"], severity=1.5)
    added = result & ~clean
    assert not (clean & ~result).any()
    assert added.flatten(2).any(-1).double().mean() > 0.5
    rows = torch.arange(120.0).view(1, 1, -1)
    filled = clean.any(-1)
    feet = (rows * filled).amax(-1)
    height = filled.sum(-1)
    above_feet = (feet[..., None] - rows)[added.any(-1)]
    assert bool((above_feet.abs() < 0.35 * height.max()).all())


def test_ragged_borders_are_borders(clean):
    result = faulty(clean, kinds=["edges"])
    changed = result ^ clean
    near = max_pool2d(clean.double(), 7, 1, 3) > 0
    inside = max_pool2d((~clean).double(), 7, 1, 3) == 0
    assert not (changed & ~near).any() and not (changed & inside).any()
    share = changed.sum() / clean.sum()
    assert 0.02 < float(share) < 0.35
    assert not torch.equal(changed[0], changed[1])


def test_noise_is_mostly_filtered_away(clean):
    result = faulty(clean, kinds=["noise"])
    assert 0 < float((result ^ clean).double().mean()) < 0.01
    background = torch.zeros(3, 1, 60, 80, dtype=torch.bool)
    assert float(faulty(background).double().mean()) < 0.01


def test_flicker_makes_some_frames_worse(clean):
    long = clean[20:21, :1].expand(200, -1, -1, -1)
    kinds = ["holes", "edges", "flicker"]
    loss = (long ^ faulty(long, kinds=kinds)).double().mean((-2, -1)).mean(-1)
    calm = (long ^ faulty(long, kinds=kinds[:2])).double().mean((-2, -1)).mean(-1)
    worse = loss > 1.2 * calm
    assert 2 <= int(worse.sum()) <= 25
    assert torch.equal(loss[~worse], calm[~worse])


def test_odd_input(clean):
    assert add_faults(clean[:0]).shape == (0, 2, 120, 160)
    assert add_faults(torch.ones(2, 1, 3, 4).bool(), 3.0).shape == (2, 1, 3, 4)
    with pytest.raises(InputError, match="severity"):
        add_faults(clean, -1.0)
    with pytest.raises(InputError, match="holes, missing"):
        add_faults(clean, kinds=["fog"])
    with pytest.raises(ShapeError, match="T, C, H, W"):
        add_faults(clean[0])
