"""Hypotheses about limbs: on the ray of what is measured, and chosen ones without all the others."""

import pytest
import torch
from torch.nn.functional import normalize

from torchpose.upper_body._limb_nodes import nodes_anywhere, nodes_on_ray

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
    torch.testing.assert_close(far.chosen(near, rows), expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("kind", ["on-ray", "anywhere"])
def test_limbs_have_their_length(kind):
    _, far = forearms(kind)
    lengths = torch.linalg.vector_norm(far.ends - far.start[..., None, :], dim=-1)
    torch.testing.assert_close(lengths, torch.full_like(lengths, LENGTH), rtol=0, atol=1e-14)
