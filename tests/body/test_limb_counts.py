"""Weights of single limbs against images of them."""

import pytest
import torch

from tests.body.test_silhouette import HEIGHT, WIDTH, make_rig, random_limbs
from torchpose.body.limb_counts import count_limbs
from torchpose.body.limbs import Limbs
from torchpose.body.silhouette import render_limbs
from torchpose.errors import ShapeError


def weight_by_pixels(limbs, opposing, rig, silhouettes):
    """(DX 4): a copy of the silhouette that is 1/2 under the opposing limb, summed under each limb."""
    image = silhouettes.double().expand(*limbs.start.shape[:-2], -1, -1, -1)
    if opposing is not None:
        union = render_limbs(opposing, rig, HEIGHT, WIDTH)
        image = image * torch.where(union, 0.5, 1.0)
    single = Limbs(*(x.unsqueeze(-2) for x in limbs))
    covered = render_limbs(single, rig, HEIGHT, WIDTH)
    return (covered * image.unsqueeze(-4)).sum((-2, -1))


@pytest.mark.parametrize("own_radii", [False, True])
@pytest.mark.parametrize("chunk", [None, 2])
def test_weights_are_sums_over_the_halved_silhouette(own_radii, chunk):
    rig = make_rig(2)
    limbs = random_limbs(3, 2, n_limbs=7, seed=1, spread=0.3, own_radii=own_radii)
    opposing = random_limbs(3, 2, n_limbs=5, seed=2, spread=0.3)
    silhouettes = torch.rand(2, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0)) < 0.6
    result = count_limbs(limbs, opposing, rig, silhouettes, chunk=chunk)
    expected = weight_by_pixels(limbs, opposing, rig, silhouettes)
    assert result.shape == (3, 2, 7, 2)
    assert torch.equal(result, expected)
    assert bool((result < count_limbs(limbs, None, rig, silhouettes)).any())


def test_without_an_opposing_limb_and_with_a_silhouette_for_each():
    rig = make_rig(2)
    limbs = random_limbs(3, n_limbs=4, seed=3)
    silhouettes = torch.rand(3, 2, HEIGHT, WIDTH) < 0.5
    result = count_limbs(limbs, None, rig, silhouettes)
    assert torch.equal(result, weight_by_pixels(limbs, None, rig, silhouettes))


def test_shapes_must_fit():
    with pytest.raises(ShapeError, match="leading dimensions"):
        count_limbs(
            random_limbs(3), random_limbs(2), make_rig(1), torch.ones(1, HEIGHT, WIDTH).bool()
        )
