"""Hypotheses about limbs: on the ray of what is measured, and chosen ones without all the others."""

import pytest
import torch
from torch.nn.functional import normalize

from torchpose.priors._arms import shipped_arm_prior
from torchpose.upper_body import _arm_chain
from torchpose.upper_body._arm_chain import ArmChain
from torchpose.upper_body._direction_density import DirectionDensity
from torchpose.upper_body._limb_nodes import flat_rows, nodes_anywhere, nodes_on_ray

N_NEAR, N_FAR, LENGTH = 7, 5, 0.3


def random_axes(*shape):
    generator = torch.Generator().manual_seed(3)
    return normalize(torch.randn(*shape, 3, generator=generator, dtype=torch.float64), dim=-1)


def forearms(kind):
    """Return upper arms [2, 4, G0, 3], and the forearms from their ends, on rays or anywhere."""
    near = random_axes(2, 4, N_NEAR)
    start = 0.3 * near + torch.tensor([0.0, 0.0, 2.0])
    length = torch.full((2, 4, 1), LENGTH, dtype=torch.float64)
    if kind == "anywhere":
        turns = torch.linalg.qr(random_axes(2, 4, 3)).Q
        return near, nodes_anywhere(start, length, turns[:, :, None], N_FAR)
    ray = normalize(torch.tensor([0.1, 0.05, 1.0]).double().expand(2, 4, 1, 3), dim=-1)
    return near, nodes_on_ray(start, ray, length, torch.full_like(length, 0.02), N_FAR)


@pytest.mark.parametrize("kind", ["on-ray", "anywhere"])
def test_chosen_pairs_are_those_of_all_pairs(kind):
    near, far = forearms(kind)
    shape = 2, 4, N_NEAR, N_FAR, 3
    pairs = (near[..., None, :].expand(shape), far.directions.expand(shape))
    every = torch.cat(pairs, -1).flatten(2, 3)
    rows = torch.randint(N_NEAR * N_FAR, (2, 4, 9), generator=torch.Generator().manual_seed(1))
    expected = every.gather(2, rows[..., None].expand(-1, -1, -1, 6))
    torch.testing.assert_close(
        far.chosen(near, flat_rows(rows, N_NEAR * N_FAR)), expected, rtol=0, atol=1e-15
    )


@pytest.mark.parametrize("kind", ["on-ray", "anywhere"])
def test_limbs_have_their_length(kind):
    _, far = forearms(kind)
    lengths = torch.linalg.vector_norm(far.ends - far.start[..., None, :], dim=-1)
    torch.testing.assert_close(lengths, torch.full_like(lengths, LENGTH), rtol=0, atol=1e-14)


def test_pairs_whose_density_is_left_out_are_none_of_the_likeliest(monkeypatch):
    chain = ArmChain(DirectionDensity(shipped_arm_prior()), 30.0)
    near = random_axes(2, 1, 60)
    start = 0.3 * near + torch.tensor([0.0, 0.0, 2.0])
    ray = normalize(torch.tensor([0.1, 0.05, 1.0]).double().expand(2, 1, 1, 3), dim=-1)
    length = torch.full((2, 1, 1), LENGTH, dtype=torch.float64)
    far = nodes_on_ray(start, ray, length, torch.full_like(length, 0.01), 9)
    weight, count = far.log_weight.flatten(-2), 30
    some = chain._prior(near, far, weight, count)
    assert 0.5 < some.isinf().double().mean() < 1
    monkeypatch.setattr(_arm_chain, "_MANY", 1000)
    every = chain._prior(near, far, weight, count)
    left = some.isfinite()
    torch.testing.assert_close(some[left], every[left], rtol=0, atol=1e-10)
    best = (weight + every).topk(count, -1).indices
    assert left.gather(-1, best).all()
    assert every.amax() - every.amin() <= chain.density.log_ratio
