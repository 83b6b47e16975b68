"""Learned lifters of arms: what they are shown, and what they may not see."""

import pytest
import torch

from benchmarks._lifters import FEW, LIFTERS, fit_lifter
from tests.data import data_with
from tests.upper_body.test_articulated import body
from torchpose.priors._arms import shipped_arm_prior

WHOLE = torch.ones(3, dtype=torch.bool)


@pytest.fixture(scope="module")
def lifters():
    sets = [(0.7, [body(60), body(40, turn=0.3)]), (0.3, [body(50, depth=3.0)])]
    return {
        kind: fit_lifter(kind, sets, shipped_arm_prior(), "hand", quick=True) for kind in LIFTERS
    }


def rays(n_frames=20, seed=0):
    generator = torch.Generator().manual_seed(seed)
    seen = 0.1 * torch.randn(n_frames, 2, 3, 2, generator=generator, dtype=torch.float64)
    return seen, seen[:, :, 0].mean(1)


@pytest.mark.parametrize("kind", LIFTERS)
def test_bones_come_out_of_rays(lifters, kind):
    found = lifters[kind](*rays(), WHOLE)
    assert found.shape == (20, 2, 2, 3) and bool(found.isfinite().all())


@pytest.mark.parametrize("kind", LIFTERS)
def test_what_is_not_measured_is_not_seen(lifters, kind):
    seen, neck = rays()
    changed = seen.clone()
    changed[:, :, :2] += 0.05
    given = torch.tensor(FEW)
    torch.testing.assert_close(
        lifters[kind](seen, neck, given), lifters[kind](changed, neck, given)
    )
    assert not torch.allclose(lifters[kind](seen, neck, WHOLE), lifters[kind](changed, neck, WHOLE))


@pytest.mark.parametrize("kind", LIFTERS)
def test_later_frames_are_not_seen(lifters, kind):
    seen, neck = rays()
    changed = seen.clone()
    changed[12:] += 0.05
    found = [lifters[kind](x, neck, WHOLE)[:12] for x in (seen, changed)]
    torch.testing.assert_close(*found)


def test_the_nearest_neighbour_is_somebody(lifters):
    known, targets = lifters[LIFTERS[0]].known
    lengths = 0.2 * targets.unflatten(-1, (2, 2, 3)).norm(dim=-1)
    prior = shipped_arm_prior()
    usual = prior.lengths[[0, 2]].float()
    assert bool(((lengths / usual).log().abs() < 6 * prior.spread.max()).all())
    assert len(known) == len(targets)


def test_a_quick_run_prints_both_tables(run_here, tmp_path):
    data = data_with("mocap_berkeley_mhad")
    printed = run_here("unseen_sets", "--quick", "--data", str(data), "--out", str(tmp_path))
    for row in ("multiple-model", *LIFTERS, "hanging arms"):
        assert printed.count(f"| {row} |") == 2
    assert (tmp_path / "unseen_sets.md").read_text().split() == printed.split()
