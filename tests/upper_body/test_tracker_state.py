"""The state of the upper-body tracker: whole before the first forward, and all that counts."""

import copy
import io
import pickle
import warnings
from dataclasses import replace

import pytest
import torch
from safetensors.torch import save
from torch import nn

from torchpose import GaussianMixture, UpperBodyPrior, UpperBodyTracker, load_prior
from torchpose.errors import InputError, PriorError
from torchpose.priors._window import WindowPrior

NAMES = ["head", "neck", "hand_left", "hand_right"]
METHODS = {
    "windows": {"method": "window-mixture"},
    "poses": {"method": "mkf-fixed"},
    "sampled": {"method": "mkf-sampled"},
    "particles": {"method": "pf-mixture", "n_particles": 100},
}


def widened(mixture, factor):
    return GaussianMixture(mixture.weights, mixture.means, factor * mixture.covariances)


@pytest.fixture(scope="module")
def prior():
    return load_prior("kinect-upper-body-small")


@pytest.fixture(scope="module")
def other(prior):
    """A prior of the same kind with other mixtures, noise, camera and window settings."""
    windows = {
        name: WindowPrior(
            widened(w.left, 1.5), widened(w.right, 1.5), w.layout,
            dict(w.settings) | {"hand_std": 9.0, "likelihood_power": 0.5},
        )
        for name, w in prior.windows.items()
    }  # fmt: skip
    noise = {name: 2 * value for name, value in prior.noise.items()}
    arms = widened(prior.left, 1.5), widened(prior.right, 1.5)
    return UpperBodyPrior(*arms, replace(prior.info, name="other", cx=300.0), noise, windows)


@pytest.fixture
def always_warn():
    """Warnings of PyTorch, of which most come once in a process, every time and as errors."""
    before = torch.is_warn_always_enabled()
    torch.set_warn_always(True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield
    torch.set_warn_always(before)


def keypoints(frames=12):
    at = torch.tensor([[320.0, 130.0], [322.0, 190.0], [420.0, 260.0], [220.0, 250.0]])
    shake = torch.randn(1, frames, 4, 2, generator=torch.Generator().manual_seed(3))
    return at + 4 * shake


def run(tracker, z=None):
    z = keypoints() if z is None else z
    return tracker(z, names=NAMES, generator=torch.Generator().manual_seed(1))


def assert_same(a, b):
    for name in ("joints3d", "covariance3d", "joints2d", "log_evidence"):
        torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=0, atol=0)


def make(prior, kind, **options):
    return UpperBodyTracker(prior, prior.camera, **(METHODS[kind] | options))


@pytest.mark.parametrize("kind", METHODS)
def test_a_loaded_state_replaces_the_whole_tracker(prior, other, kind):
    source, target = make(copy.deepcopy(other), kind), make(copy.deepcopy(prior), kind)
    run(source), run(target)
    expected = run(make(other, kind))
    target.load_state_dict(source.state_dict())
    assert target.prior.info.name == "other" and target.prior.info.cx == other.info.cx
    assert_same(run(target), expected)


@pytest.mark.parametrize("kind", METHODS)
def test_the_state_is_complete_before_the_first_forward_and_stays_small(prior, kind):
    tracker = make(prior, kind)
    entries, size = list(tracker.state_dict()), len(pickle.dumps(tracker))
    run(tracker), tracker(keypoints().repeat(1, 1, 2, 1)[:, :, :8])  # with all joints
    assert list(tracker.state_dict()) == entries
    assert len(pickle.dumps(tracker)) == size
    save(dict(tracker.state_dict()))


@pytest.mark.parametrize("kind", METHODS)
def test_copies_and_checkpoints_track_alike(prior, kind):
    tracker = make(prior, kind)
    expected = run(tracker)
    file = io.BytesIO()
    torch.save(tracker.state_dict(), file)
    file.seek(0)
    loaded = make(copy.deepcopy(prior), kind)
    loaded.load_state_dict(torch.load(file, weights_only=True))
    for again in (copy.deepcopy(tracker), pickle.loads(pickle.dumps(tracker)), loaded):
        assert_same(run(again), expected)


def test_editing_a_mixture_in_place_takes_effect(prior, other):
    own = copy.deepcopy(prior)
    tracker = make(own, "poses")
    run(tracker)
    with torch.no_grad():
        for side in ("left", "right"):
            getattr(own, side).covariances.mul_(1.5)
    wide = UpperBodyPrior(
        widened(prior.left, 1.5), widened(prior.right, 1.5), prior.info, prior.noise
    )
    assert_same(run(tracker), run(make(wide, "poses")))


def test_given_noise_is_learnt_as_a_parameter(prior):
    process = nn.Parameter(torch.full((21,), 0.1, dtype=torch.float64))
    std = nn.Parameter(torch.tensor(3.0))
    tracker = make(prior, "poses", process_cov=process, measurement_std=std)
    assert {id(p) for p in tracker.parameters()} == {id(process), id(std)}
    values = []
    for _ in range(2):
        tracker.zero_grad()
        loss = -run(tracker).log_evidence.mean()
        loss.backward()
        values.append(float(loss.detach()))
        assert process.grad.abs().sum() > 0 and std.grad.abs() > 0
        with torch.no_grad():
            std -= 0.1 * std.grad.sign()
    assert values[1] < values[0]


def test_noise_that_became_negative_is_named(prior):
    std = nn.Parameter(torch.tensor(3.0))
    tracker = make(prior, "windows", measurement_std=std)
    with torch.no_grad():
        std.fill_(-0.5)
    with pytest.raises(InputError, match=r"got -0\.5; .*exponential of a parameter"):
        run(tracker)


def test_learning_the_prior_warns_of_nothing(prior, always_warn):
    own, camera = copy.deepcopy(prior), copy.deepcopy(prior.camera)
    for tensor in (*own.buffers(), camera.matrix):
        tensor.requires_grad_(tensor.is_floating_point())
    run(UpperBodyTracker(own, camera, "mkf-fixed")).joints3d.sum().backward()
    assert own.left.means.grad.abs().sum() > 0


@pytest.mark.parametrize("kind", METHODS)
def test_single_precision_is_that_of_the_results(prior, kind):
    tracker = make(prior, kind)
    expected = run(tracker)
    narrow = run(tracker.float())
    assert narrow.joints3d.dtype == narrow.covariance2d.dtype == torch.float32
    torch.testing.assert_close(narrow.joints3d, expected.joints3d.float())
    assert_same(run(tracker.double()), expected)
    built = run(make(prior, kind, dtype=torch.float32))
    assert built.joints3d.dtype == torch.float32
    if kind in ("windows", "poses"):  # the others draw other numbers
        torch.testing.assert_close(built.joints3d, narrow.joints3d, atol=2e-3, rtol=0)
    with pytest.raises(InputError, match="half precision"):
        tracker.half()


def test_autocast_changes_nothing(prior):
    tracker = make(prior, "windows", dtype=torch.float32)
    expected = run(tracker)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert_same(run(tracker), expected)


def test_a_prior_of_another_kind_is_not_loaded(prior):
    bare = UpperBodyPrior(prior.left, prior.right, prior.info)
    state = bare.state_dict() | {"_extra_state": prior.get_extra_state()}
    with pytest.raises(PriorError, match="windows"):
        bare.load_state_dict(state)


def test_a_narrow_state_loads_into_wide_tensors(prior):
    copied, assigned = (make(copy.deepcopy(prior), "poses") for _ in range(2))
    narrow = {
        name: value.float() if getattr(value, "is_floating_point", bool)() else value
        for name, value in copied.state_dict().items()
    }
    copied.load_state_dict(narrow)
    assigned.load_state_dict(narrow, assign=True)
    assert_same(run(assigned), run(copied))
    assert assigned.measurement_cov.dtype == torch.float64
