"""The prior over arms is a density over pairs of directions, and survives its file."""

import math

import pytest
import torch

from torchpose._core.tensor_file import read_tensors, write_tensors
from torchpose.errors import FileFormatError, InputError, PriorError, ShapeError
from torchpose.priors import GaussianMixture
from torchpose.priors._arms import _KIND, LENGTHS, ArmPrior, shipped_arm_prior
from torchpose.priors._gaussian_mixture import component_log_density
from torchpose.upper_body._arm_chain import ArmChain, Arms
from torchpose.upper_body._direction_density import DirectionDensity
from torchpose.upper_body._limb_nodes import nodes_on_ray, sphere_points

DOUBLE = torch.float64


def pairs(n, seed=0):
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(n, 2, 3, generator=generator, dtype=DOUBLE)
    return torch.nn.functional.normalize(points, dim=-1).flatten(1)


@pytest.fixture(scope="module")
def prior():
    return shipped_arm_prior()


def test_it_integrates_to_one_over_both_spheres(prior):
    density = prior.log_prob(pairs(200_000, seed=5)).exp()
    assert float(density.mean() * (4 * math.pi) ** 2) == pytest.approx(1.0, abs=0.05)


def test_the_broad_part_keeps_it_above_its_share(prior):
    least = math.log(prior.broad) - 2 * math.log(4 * math.pi)
    assert float(prior.log_prob(pairs(2000)).min()) >= least - 1e-9


def test_the_filters_density_is_the_priors(prior):
    points = pairs(500)
    torch.testing.assert_close(
        DirectionDensity(prior)(points), prior.log_prob(points), rtol=0, atol=2e-4
    )


@pytest.mark.parametrize("n_axes", [2, 3])
def test_forearms_of_few_axes_have_the_density_of_their_directions(prior, n_axes):
    """Of more upper arms than are computed at a time, with axes of their own or the same for all."""
    generator = torch.Generator().manual_seed(4)
    upper = pairs(2 * 120, seed=3)[:, :3].view(2, 120, 3)
    axes = torch.linalg.qr(torch.randn(2, 120, 3, 3, generator=generator, dtype=DOUBLE)).Q
    axes = axes[..., :n_axes, :]
    turns = torch.randn(17, n_axes, generator=generator, dtype=DOUBLE)
    turns = torch.nn.functional.normalize(turns, dim=-1)
    density = DirectionDensity(prior)
    for given in (axes, axes[:, :1]):
        lower = (turns @ given).expand(2, 120, 17, 3)
        both = torch.cat([upper[:, :, None].expand_as(lower), lower], -1)
        found = density.of_arms(upper, given, turns)
        torch.testing.assert_close(found, density(both), rtol=1e-10, atol=1e-10)


def test_it_is_read_as_it_was_written(prior, tmp_path):
    prior.save(tmp_path / "arms.safetensors")
    again = ArmPrior.load(tmp_path / "arms.safetensors")
    assert again.info == prior.info and again.broad == prior.broad
    points = pairs(50)
    torch.testing.assert_close(again.log_prob(points), prior.log_prob(points), rtol=0, atol=0)
    torch.testing.assert_close(again.lengths, prior.lengths, rtol=0, atol=0)
    torch.testing.assert_close(again.together, prior.together, rtol=0, atol=0)
    (tmp_path / "cut.safetensors").write_bytes((tmp_path / "arms.safetensors").read_bytes()[:-100])
    with pytest.raises(FileFormatError):
        ArmPrior.load(tmp_path / "cut.safetensors")


def test_what_cannot_be_is_refused(prior):
    other = GaussianMixture(torch.ones(1), torch.zeros(1, 3), torch.eye(3)[None])
    with pytest.raises(PriorError, match="6 dimensions"):
        ArmPrior(other, prior.lengths, prior.spread)
    with pytest.raises(PriorError, match="lengths must be positive"):
        ArmPrior(prior.directions, -prior.lengths, prior.spread)
    with pytest.raises(ShapeError):
        ArmPrior(prior.directions, prior.lengths[:2], prior.spread)
    with pytest.raises(InputError, match="broad"):
        ArmPrior(prior.directions, prior.lengths, prior.spread, broad=0.0)
    weights = prior.directions.weights
    uneven = torch.diag(weights).roll(1, 0)
    for together in (uneven, torch.diag(2 * weights), 2 * torch.diag(weights) - prior.together):
        with pytest.raises(PriorError, match="together must be symmetric"):
            ArmPrior(prior.directions, prior.lengths, prior.spread, together=together)
    with pytest.raises(ShapeError):
        ArmPrior(prior.directions, prior.lengths, prior.spread, together=torch.eye(3))
    with pytest.raises(ShapeError):
        prior.log_prob(torch.zeros(3, 5))
    assert len(prior.lengths) == len(LENGTHS)


def test_files_of_arms_apart_are_read(prior, tmp_path):
    """Files that were written before components were tied have no shares of pairs."""
    path = tmp_path / "arms.safetensors"
    prior.save(path)
    info, tensors = read_tensors(path, _KIND)
    del tensors["together"]
    write_tensors(path, _KIND, info, tensors)
    found = ArmPrior.load(path)
    weights = found.directions.weights
    torch.testing.assert_close(found.together, weights[:, None] * weights)


def test_the_evidence_of_both_arms_is_the_sum_over_all_pairs(prior):
    """Of hypotheses of left and right arm, with the components of each, the broad one apart."""
    n = 6
    generator = torch.Generator().manual_seed(1)
    mixture = prior.directions
    near = mixture.means[torch.randint(mixture.n_components, (2 * n,), generator=generator)]
    directions = torch.nn.functional.normalize(near.unflatten(-1, (2, 3)), dim=-1).view(
        1, 2, 1, n, 6
    )
    weight = torch.rand(1, 2, 1, n, generator=generator, dtype=DOUBLE)
    arms = Arms(directions, weight.log(), prior.log_prob(directions))
    chain = ArmChain(DirectionDensity(prior), 30.0)
    parts = component_log_density(
        directions, mixture.means, torch.linalg.cholesky(mixture.covariances)
    )
    parts = (parts - prior.log_mass).exp() * (1 - prior.broad)
    broad = torch.full_like(parts[..., :1], 1 / (4 * math.pi) ** 2)
    left, right = (weight[..., None, :] @ torch.cat([parts, broad], -1))[0, :, 0, 0]
    pairs = torch.zeros(len(left), len(left), dtype=DOUBLE)
    pairs[:-1, :-1] = prior.together
    pairs[-1, :-1] = pairs[:-1, -1] = prior.broad * mixture.weights
    pairs[-1, -1] = prior.broad**2
    found = chain.evidence_of_both(arms)
    assert float(found) == pytest.approx(float((left @ pairs @ right).log()), abs=1e-3)
    assert abs(float(found - arms.log_evidence.sum())) > 0.05  # it differs from arms apart


def test_nodes_integrate_a_pixels_likelihood_over_the_sphere():
    """The sum over nodes is the integral over all directions, by many points on the sphere."""
    start = torch.tensor([0.1, -0.2, 2.0], dtype=DOUBLE)
    length, std = torch.tensor(0.3, dtype=DOUBLE), torch.tensor(0.03, dtype=DOUBLE)
    directions = sphere_points(200_000)
    for end in ([0.3, -0.1, 2.15], [0.1, 0.08, 1.95], [0.27, -0.4, 1.9]):
        along = torch.nn.functional.normalize(torch.tensor(end, dtype=DOUBLE), dim=0)
        off = start + length * directions
        off = off - (off @ along)[:, None] * along
        density = torch.exp(-0.5 * (off.norm(dim=-1) / std) ** 2) / (2 * math.pi * std**2)
        facing = directions @ along  # nodes stop 10 degrees before the ray
        density = density * (facing.abs() < math.sin(math.radians(80)))
        wanted = float(density.mean() * 4 * math.pi)
        nodes = nodes_on_ray(start, along, length, std, 81)
        assert float(nodes.log_weight.exp().sum()) == pytest.approx(wanted, rel=0.05)
        apart = torch.linalg.vector_norm(nodes.ends - start, dim=-1)
        torch.testing.assert_close(apart, length.expand(81))
