"""Steps that have no values to look at: exported, compiled, vectorised; the numbers of plain steps."""

import pytest
import torch
from torch.utils import _pytree as pytree

import torchpose
from tests.filters.traced_steps import (
    KALMAN,
    PARTICLES,
    Run,
    Smoothing,
    Step,
    begun,
    frames,
    largest_difference,
    make,
    seeded,
    sequences,
)
from tests.without_shape_checks import differences_of
from torchpose._core.checks import check_covariance
from torchpose._core.value_checks import values_visible
from torchpose.errors import CovarianceError, InputError, ShapeError
from torchpose.math._gaussian import mended_cholesky

FILTERS = (*KALMAN, *PARTICLES)
# The two random walks differ by one term of the weights: one of them is compiled, the other exported.
# What aot_eager compiles, it traces as eager does. A run that is compiled has the steps in it.
TRACED = (
    *(f"eager/step/{name}" for name in ("medians", "mixture", "random-walk-unscaled")),
    *(f"export/step/{name}" for name in ("fixed", "split", "sampled", "random-walk")),
    "aot_eager/step/fixed",
    "export/run/fixed",
    *(f"eager/run/{name}" for name in ("split", "sampled")),
    "export/smoothing/fixed",
    "eager/smoothing/fixed",
    "eager/smoothing/medians",
)


@pytest.fixture(scope="module")
def differences():
    """Of every traced step."""
    return differences_of("tests.filters.traced_steps", *TRACED)


@pytest.mark.slow
@pytest.mark.parametrize("case", TRACED)
def test_what_is_traced_has_no_break_and_gives_the_numbers_of_the_plain_one(differences, case):
    assert differences[case] <= 1e-12


@pytest.mark.parametrize("name", FILTERS)
def test_without_value_checks_steps_give_the_same_numbers(name):
    model, (z, mask) = make(name), frames()
    state = unseen = seeded(model.init, 3)
    for now in zip(z, mask, strict=True):
        state, out = seeded(Step(model), state, *now)
        with torchpose.without_value_checks():
            unseen, found = seeded(Step(model), unseen, *now)
        assert largest_difference(found, out) <= 1e-12


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("with_states", [False, True])
def test_vmap_of_two_steps_is_a_loop(name, with_states):
    model, (z, mask) = make(name), frames()
    leaves, spec = pytree.tree_flatten(begun(model))
    start = [leaf for leaf in leaves if isinstance(leaf, torch.Tensor)]

    def estimates(z, mask, *tensors):
        rest = iter(tensors)
        whole = [next(rest) if isinstance(leaf, torch.Tensor) else leaf for leaf in leaves]
        state = pytree.tree_unflatten(whole, spec)
        for _ in range(2):
            state, out = Step(model)(state, z, mask)
        return tuple(out)

    def moved(tensor, k):
        return tensor + k * 0.01 if tensor.is_floating_point() and tensor.ndim == 3 else tensor

    many = [[moved(x, k) if with_states else x for x in start] for k in range(3)]
    looped = [seeded(estimates, z[k], mask[k], *many[k]) for k in range(3)]
    states = [torch.stack(x) for x in zip(*many, strict=True)] if with_states else start
    dims = (0, 0, *(0 if with_states else None for _ in start))
    with torchpose.without_value_checks():
        vectorised = torch.func.vmap(estimates, dims, randomness="same")
        found = seeded(vectorised, z[:3], mask[:3], *states)
    expected = [torch.stack(x) for x in zip(*looped, strict=True)]
    assert largest_difference(found, expected) <= 1e-12


@pytest.mark.parametrize("name", ["fixed", "memoryless", "sampled", "mixture"])
def test_vmap_of_a_run_is_a_loop(name):
    run, (z, mask) = Run(make(name)), (x.transpose(0, 1) for x in frames())
    many = torch.stack([z, z + 0.5]), torch.stack([mask, ~mask])
    expected = [
        torch.stack(x)
        for x in zip(*(seeded(run, *x) for x in zip(*many, strict=True)), strict=True)
    ]
    with torchpose.without_value_checks():
        found = seeded(torch.func.vmap(run, randomness="same"), *many)
    assert largest_difference(found, expected) <= 1e-12


@pytest.mark.parametrize("lag", [None, 1])
@pytest.mark.parametrize(
    "name", [n for n in KALMAN if make(n).tracks == "fixed" and "reset" not in n]
)
def test_unseen_and_vectorised_smoothing_give_the_same_numbers(name, lag):
    smoothing, (z, mask) = Smoothing(make(name), lag), sequences()
    lengths = torch.tensor([[3, 2, 3], [1, 3, 2]])
    many = torch.stack([z, z + 0.5]), torch.stack([mask, ~mask]), lengths
    looped = [smoothing(*each) for each in zip(*many, strict=True)]
    expected = [torch.stack(x) for x in zip(*looped, strict=True)]
    with torchpose.without_value_checks():
        unseen = smoothing(z, mask, lengths[0])
        vectorised = torch.func.vmap(smoothing)(*many)
    assert largest_difference(unseen, looped[0]) <= 1e-12
    assert largest_difference(vectorised, expected) <= 1e-12


def test_values_are_seen_again_after_the_context_and_after_an_error_in_it():
    bad = -torch.eye(2)
    with pytest.raises(CovarianceError):
        check_covariance("R", bad)
    with pytest.raises(KeyError), torchpose.without_value_checks():
        check_covariance("R", bad)
        with torchpose.without_value_checks():
            assert not values_visible()
        assert not values_visible()
        with pytest.raises(ShapeError):
            check_covariance("R", bad[0])
        raise KeyError
    assert values_visible()
    with pytest.raises(CovarianceError):
        check_covariance("R", bad)


def test_what_was_made_without_checks_is_checked_by_those_who_see():
    model, (z, mask) = make("fixed"), frames()
    model.measurement_cov.neg_()
    with torchpose.without_value_checks():
        _, out = model.step(model.init(3), z[0], mask[0])
    assert torch.isnan(out.mean).any()
    with pytest.raises(CovarianceError):
        model.step(model.init(3), z[0], mask[0])


def test_unseen_matrices_are_mended_alike():
    thin = torch.outer(*2 * (torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64),))
    good = thin + torch.eye(3, dtype=torch.float64)
    matrices = torch.stack([good, thin, -good, torch.zeros_like(thin)])
    seen = mended_cholesky(matrices)
    with torchpose.without_value_checks():
        unseen = mended_cholesky(matrices)
        each = torch.func.vmap(mended_cholesky)(matrices)
        assert mended_cholesky(good)[1].item() == 0.0
    assert largest_difference(unseen, seen) == 0.0
    assert largest_difference(each, seen) == 0.0


@pytest.mark.parametrize("name", ["fixed", "mixture"])
def test_values_that_cannot_be_looked_at_are_refused(name):
    model, z = make(name), frames()[0]
    with pytest.raises(InputError, match=r"torch\.func\.vmap.*without_value_checks"):
        torch.func.vmap(lambda z: model(z).mean, randomness="same")(z[:, :, None])
    with pytest.raises(InputError, match="z must hold numbers"):
        model(z.transpose(0, 1).to("meta"))
    with pytest.raises(InputError, match='nothing runs on the device "meta"'):
        model.to("meta")(z.transpose(0, 1))


def test_densities_are_exported_saved_and_vectorised(tmp_path):
    class Density(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.mixture = torchpose.load_prior("kinect-upper-body-small").left

        def forward(self, x):
            return self.mixture.log_prob(x)

    density = Density()
    x = density.mixture.means[:5] + 0.01
    count = {0: torch.export.Dim("count", min=2, max=400)}
    torch.export.save(
        torch.export.export(density, (x,), dynamic_shapes=(count,)), tmp_path / "p.pt2"
    )
    loaded = torch.export.load(tmp_path / "p.pt2").module()
    assert largest_difference(loaded(x[:3]), density(x[:3])) <= 1e-12
    assert largest_difference(torch.func.vmap(density)(x), density(x)) <= 1e-12


def test_a_tracker_inside_vmap_asks_for_the_whole_batch():
    prior = torchpose.load_prior("kinect-upper-body-small")
    tracker = torchpose.UpperBodyTracker(prior, camera=prior.camera)
    keypoints = torch.full((2, 1, 3, 2, 2), 240.0)
    with pytest.raises(InputError, match="trackers take the whole batch"):
        torch.func.vmap(lambda k: tracker(k, names=["head", "neck"]).joints3d)(keypoints)
    with pytest.raises(InputError, match="device meta"):
        torchpose.UpperBodyTracker(prior.to("meta"), camera=prior.camera)


def test_a_tracker_that_chooses_by_what_it_measured_says_that_it_cannot_be_exported():
    prior = torchpose.load_prior("kinect-upper-body")
    tracker = torchpose.UpperBodyTracker(prior, camera=prior.camera)
    keypoints = torch.full((1, 2, 3, 2), 240.0)

    class Poses(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.tracker = tracker

        def forward(self, keypoints):
            return self.tracker(keypoints, names=["head", "hand_left", "hand_right"]).joints3d

    with pytest.raises(InputError, match=r"UpperBodyTracker.*cannot be exported"):
        torch.export.export(Poses(), (keypoints,))
