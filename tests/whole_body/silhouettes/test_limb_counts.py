"""Weights of parts of the body against images of them."""

import pytest
import torch

from tests.whole_body.silhouettes.test_rendering import HEIGHT, WIDTH, make_rig, random_limbs
from torchpose.body import Limbs
from torchpose.errors import ShapeError
from torchpose.whole_body._silhouettes.limb_counts import PartCounts, count_parts
from torchpose.whole_body._silhouettes.rendering import render_limbs


def parts_of(*shape, seed, own_radii=True):
    """Random parts [*shape[:-1], K] of several limbs, none far from the middle of the view."""
    return random_limbs(*shape[:-1], n_limbs=shape[-1], seed=seed, spread=0.3, own_radii=own_radii)


def counts_by_pixels(parts, opposing, rig, silhouettes):
    """(DX 4) and the area, part by part and pixel by pixel in plain loops."""
    found = render_limbs(parts, rig, HEIGHT, WIDTH)  # the union of K limbs
    weight = torch.zeros(found.shape[:-2], dtype=torch.float64)
    area = torch.zeros(found.shape[:-2], dtype=torch.int64)
    shape = found.shape[:-4]
    for index in torch.cartesian_prod(*(torch.arange(n) for n in shape)).reshape(-1, len(shape)):
        item = tuple(index.tolist())
        image = silhouettes[item[: silhouettes.ndim - 3]].double().clone()
        if opposing is not None:
            taken = [x[item].flatten(0, 1) for x in opposing]
            image[render_limbs(Limbs(*taken), rig, HEIGHT, WIDTH)] *= 0.5
        for position in range(found.shape[-4]):
            for camera in range(found.shape[-3]):
                covered = found[(*item, position, camera)]
                weight[(*item, position, camera)] = image[camera][covered].sum()
                area[(*item, position, camera)] = covered.sum()
    return PartCounts(weight, area)


@pytest.mark.parametrize("chunk", [None, 1])
@pytest.mark.parametrize("batch_of_silhouettes", [False, True])
@pytest.mark.parametrize(("n_limbs", "own_radii"), [(2, True), (1, False)])
def test_parts_weigh_as_the_union_of_their_limbs(chunk, batch_of_silhouettes, n_limbs, own_radii):
    rig, generator = make_rig(2), torch.Generator().manual_seed(4)
    parts = parts_of(2, 3, 7, n_limbs, seed=5, own_radii=own_radii)
    opposing = parts_of(2, 3, 4, 3, seed=6)
    shape = (2, 2, HEIGHT, WIDTH) if batch_of_silhouettes else (2, HEIGHT, WIDTH)
    silhouettes = torch.rand(shape, generator=generator) < 0.6
    result = count_parts(parts, opposing, rig, silhouettes, chunk=chunk)
    expected = counts_by_pixels(parts, opposing, rig, silhouettes)
    assert torch.equal(result.weight, expected.weight)
    assert torch.equal(result.area, expected.area)
    plain = count_parts(parts, None, rig, silhouettes)
    assert torch.equal(plain.weight, counts_by_pixels(parts, None, rig, silhouettes).weight)
    assert bool((result.weight < plain.weight).any())


def test_pixels_count_within_the_image():
    rig = make_rig(1)
    parts = parts_of(1, 3, 2, seed=7)
    everywhere = torch.ones(1, HEIGHT, WIDTH, dtype=torch.bool)
    counts = count_parts(parts, None, rig, everywhere)
    assert torch.equal(counts.weight, counts.area.double())
    behind = Limbs(parts.start - 100 * rig.rotation[0, 2], parts.end - 100 * rig.rotation[0, 2],
                   parts.radii)  # fmt: skip
    unseen = count_parts(behind, None, rig, everywhere)
    assert not bool(unseen.area.any()) and not bool(unseen.weight.any())


def test_shapes_must_fit():
    rig, silhouettes = make_rig(1), torch.ones(1, HEIGHT, WIDTH, dtype=torch.bool)
    with pytest.raises(ShapeError, match=r"\[..., S, K, 3\]"):
        count_parts(random_limbs(3), None, rig, silhouettes)
    with pytest.raises(ShapeError, match="or the first of them"):
        count_parts(parts_of(2, 7, 1, seed=1), None, rig, silhouettes.expand(3, 1, -1, -1))
    with pytest.raises(ShapeError, match="leading dimensions"):
        count_parts(parts_of(3, 4, 1, seed=1), parts_of(2, 4, 1, seed=2), rig, silhouettes)
