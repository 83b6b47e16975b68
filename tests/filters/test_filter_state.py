"""The state of filters: what is loaded, edited or learnt counts, and nothing else stays behind."""

import copy
import pickle

import pytest
import torch
from safetensors.torch import save
from torch import nn

from tests.filters.oracles import tensor
from tests.filters.small_problem import Problem
from torchpose.errors import CovarianceError, InputError
from torchpose.filters import BootstrapParticleFilter, MixtureKalmanFilter
from torchpose.filters._gain_graph import GainGraph
from torchpose.priors import GaussianMixture

DIM = 4
KINDS = {
    "fixed": {"tracks": "fixed"},
    "fixed, burn-in": {"tracks": "fixed", "burn_in": 3},
    "fixed, initial_cov": {"tracks": "fixed", "initial_cov": torch.ones(DIM)},
    "sampled": {"tracks": "sampled"},
    "split": {"tracks": "split"},
    "ou": {"transition": "ou", "gamma": 0.7},
    "by frame": {"transition": "ou", "gamma": 0.0, "weighting": "frame", "medians": [1]},
    "pf mixture": {"proposal": "mixture"},
    "pf walk": {"proposal": "random-walk"},
    "pf unscaled": {"proposal": "random-walk-unscaled"},
}


def mixture(seed, dtype=torch.float64):
    g = torch.Generator().manual_seed(seed)
    means = 2 * torch.randn(3, DIM, generator=g, dtype=dtype)
    root = torch.randn(3, DIM, DIM, generator=g, dtype=dtype)
    weights = torch.rand(3, generator=g, dtype=dtype) + 0.2
    return GaussianMixture(weights / weights.sum(), means, root @ root.mT + torch.eye(DIM))


def make(kind, seed, **changes):
    """A filter all of whose numbers follow from the seed."""
    options = {
        "process_cov": torch.full((DIM,), 0.1 + 0.3 * seed),
        "measurement_cov": torch.full((2,), 0.5 + 0.2 * seed),
    }
    options |= KINDS[kind] | changes
    if options.get("gamma"):
        options["gamma"] = options["gamma"] + 0.05 * seed
    if "proposal" in options:
        options["n_particles"] = 50
        return BootstrapParticleFilter(mixture(seed), observed=[0, 2], **options)
    return MixtureKalmanFilter(mixture(seed), observed=[0, 2], **options)


def measurements(frames=5):
    return torch.randn(
        2, frames, 2, generator=torch.Generator().manual_seed(9), dtype=torch.float64
    )


def run(model, z=None):
    z = measurements() if z is None else z
    g = torch.Generator().manual_seed(0)
    return model(z, generator=g, return_cov=True)


def assert_same(a, b, **tolerance):
    for name in ("mean", "cov", "log_weights", "log_evidence"):
        torch.testing.assert_close(
            getattr(a, name),
            getattr(b, name),
            equal_nan=True,
            **({"rtol": 0, "atol": 0} | tolerance),
        )


@pytest.mark.parametrize("used", [False, True], ids=["fresh", "used"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_loaded_state_replaces_the_whole_model(kind, used):
    source, target = make(kind, 1), make(kind, 2)
    if used:
        run(source), run(target)
    assert not target.load_state_dict(source.state_dict()).missing_keys
    assert_same(run(target), run(make(kind, 1)))


@pytest.mark.parametrize("kind", KINDS)
def test_running_leaves_the_state_as_it_was_and_shares_no_memory(kind):
    model = make(kind, 1)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    run(model), model.step(model.init(2), measurements()[:, 0])
    after = model.state_dict()
    assert list(after) == list(before)
    assert all(torch.equal(after[name], value) for name, value in before.items())
    save(dict(after))  # safetensors refuses memory that two entries share
    prior = mixture(1)
    sharing = nn.ModuleDict({"prior": prior, "filter": MixtureKalmanFilter(
        prior, torch.ones(DIM), torch.ones(2), [0, 2])})  # fmt: skip
    save(dict(sharing.state_dict()))


@pytest.mark.parametrize("kind", KINDS)
def test_outputs_and_first_states_are_the_callers_to_write_to(kind):
    model, z = make(kind, 1), measurements()
    expected = [out.mean for out in steps(model, z)]
    found = []
    for out in steps(model, z):
        found.append(out.mean.clone())
        overwrite(out)
    assert all(map(torch.equal, found, expected))
    overwrite(model.init(2, generator=torch.Generator().manual_seed(0)))
    assert all(map(torch.equal, (out.mean for out in steps(model, z)), expected))


def steps(model, z):
    """Yields the output of each frame."""
    g = torch.Generator().manual_seed(0)
    state = model.init(len(z), generator=g)
    for frame in z.unbind(1):
        state, out = model.step(state, frame, generator=g, return_cov=True)
        yield out


def overwrite(values):
    for value in values:
        if isinstance(value, torch.Tensor):
            value.fill_(1)


@pytest.mark.parametrize("kind", KINDS)
def test_what_was_used_is_pickled_and_copied_as_small_as_what_was_not(kind):
    model, fresh = make(kind, 1), make(kind, 1)
    expected = run(model)
    assert len(pickle.dumps(model)) == len(pickle.dumps(fresh))
    for again in (pickle.loads(pickle.dumps(model)), copy.deepcopy(model)):
        assert_same(run(again), expected)


@pytest.mark.parametrize("kind", [k for k in KINDS if k not in ("ou", "by frame")])
def test_editing_noise_in_place_takes_effect(kind):
    model, wider = make(kind, 1), make(kind, 1, process_cov=torch.full((DIM,), 1.6))
    before = run(model)
    with torch.no_grad():
        model.process_cov.mul_(4.0)
    assert_same(run(model), run(wider), rtol=1e-6, atol=1e-6)
    assert not torch.equal(run(model).mean, before.mean)


@pytest.mark.parametrize("kind", KINDS)
def test_a_functional_call_uses_the_tensors_of_that_call_only(kind):
    model, other = make(kind, 1), make(kind, 2)
    expected = run(model)
    g = torch.Generator().manual_seed(0)
    options = {"generator": g, "return_cov": True}
    out = torch.func.functional_call(model, dict(other.named_buffers()), measurements(), options)
    assert_same(out, run(other))
    assert_same(run(model), expected)


@pytest.mark.parametrize("kind", [k for k in KINDS if "pf" not in k and k != "by frame"])
def test_parameters_stay_parameters_and_learn_twice_in_a_row(kind):
    noise = nn.Parameter(torch.full((2,), 0.7))
    process = nn.Parameter(torch.full((DIM,), 0.4, dtype=torch.float64))
    gamma = nn.Parameter(torch.tensor(0.6)) if kind == "ou" else None
    changes = {} if gamma is None else {"gamma": gamma}
    options = KINDS[kind] | changes
    model = MixtureKalmanFilter(mixture(1), process, noise, [0, 2], **options)
    learnt = [p for p in (process, noise, gamma) if p is not None]
    assert {id(p) for p in model.parameters()} == {id(p) for p in learnt}
    used = [noise, process if gamma is None else gamma]
    optimiser = torch.optim.SGD(model.parameters(), lr=1e-4)
    values = []
    for _ in range(2):
        optimiser.zero_grad()
        loss = -run(model).log_evidence.sum()
        loss.backward()
        values.append(float(loss.detach()))
        assert all(p.grad is not None and bool(p.grad.abs().sum() > 0) for p in used)
        optimiser.step()
    assert values[0] != values[1]


def test_a_learnt_noise_that_leaves_the_cone_is_named():
    process = nn.Parameter(torch.full((DIM,), 0.4, dtype=torch.float64))
    model = MixtureKalmanFilter(mixture(1), process, torch.ones(2), [0, 2])
    with torch.no_grad():
        process[1] = -0.1
    with pytest.raises(CovarianceError, match="process_cov"):
        run(model)


def test_a_filter_made_in_inference_mode_keeps_its_gains(monkeypatch):
    made, make = [], GainGraph._make
    monkeypatch.setattr(GainGraph, "_make", lambda *given: made.append(1) or make(*given))
    problem = Problem(batch=2, n_frames=9)
    z = tensor(problem.z)
    with torch.inference_mode():
        model = problem.filter()
        first = model(z)
        count = len(made)
        assert torch.equal(model(z).mean, first.mean) and 0 < count == len(made)
        model.process_cov.mul_(2.0)
        assert not torch.equal(model(z).mean, first.mean) and len(made) > count
    assert torch.equal(problem.filter()(z).mean, first.mean)


def test_running_in_inference_mode_first_does_not_spoil_gradients():
    model, z = make("fixed", 1), measurements()
    with torch.inference_mode():
        run(model)
    z.requires_grad_()
    run(model, z).mean.sum().backward()
    assert bool(z.grad.abs().sum() > 0)


@pytest.mark.parametrize("kind", KINDS)
def test_single_precision_keeps_the_model_and_its_covariances(kind):
    model, narrow = make(kind, 1, dtype=torch.float64), make(kind, 1, dtype=torch.float64).float()
    assert narrow.covariances.dtype == torch.float64
    out = run(narrow)
    assert out.mean.dtype == (torch.float64 if "pf" in kind else torch.float32)
    if "pf" not in kind and "sampled" not in kind:  # those draw other numbers
        torch.testing.assert_close(out.mean.double(), run(model).mean, rtol=1e-4, atol=1e-4)
    assert_same(run(narrow.double()), run(model))
    built = make(kind, 1, dtype=torch.float32)
    assert_same(run(built), out)


@pytest.mark.parametrize("kind", ["fixed", "pf mixture"])
def test_half_precision_is_refused(kind):
    with pytest.raises(InputError, match=r"float32 or torch\.float64"):
        make(kind, 1).half()
    with pytest.raises(InputError, match=r"float32 or torch\.float64"):
        make(kind, 1, dtype=torch.bfloat16)


@pytest.mark.parametrize("kind", KINDS)
def test_autocast_does_not_reach_into_the_filter(kind):
    model = make(kind, 1, dtype=torch.float32)
    expected = run(model)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert_same(run(model), expected)
