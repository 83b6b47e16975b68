"""Several actions at once: against the single spaces, against enumeration over paths, and recognition."""

import copy
import itertools
import math
from dataclasses import replace

import pytest
import torch

from tests.priors.performances import performances
from torchpose.errors import FileFormatError, InputError, ShapeError
from torchpose.learning import fit_action_space
from torchpose.priors import ActionBank, ActionSpace
from torchpose.priors._actions.gate import match_postures

SIZES = (6, 4, 5)


@pytest.fixture(scope="module")
def spaces() -> list[ActionSpace]:
    return [
        fit_action_space(performances(15, i, 30 + 8 * i, seed=i), d, name=f"action {i}", fps=30.0)
        for i, d in enumerate(SIZES)
    ]


@pytest.fixture(scope="module")
def bank(spaces) -> ActionBank:
    return ActionBank(spaces, spread=1.3, background=1.5)


def some_postures(count: int = 60, seed: int = 3) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    mixed = torch.cat([performances(1, i, seed=9)[0] for i in range(3)])
    rows = torch.randint(len(mixed), (count,), generator=generator)
    return mixed[rows] + 5 * torch.randn(count, 36, generator=generator, dtype=torch.float64)


def test_padding_changes_nothing(bank, spaces):
    postures, uniform = some_postures(), torch.rand(60, dtype=torch.float64)
    assert bank.names == ("action 0", "action 1", "action 2", "none") and bank.none == 3
    z = bank.project(postures)
    assert z.shape == (60, 3, 6)
    for i, space in enumerate(spaces):
        torch.testing.assert_close(z[:, i, : SIZES[i]], space.project(postures))
        assert not z[:, i, SIZES[i] :].any()
        own = torch.full((60,), i)
        j = bank.match(postures, own, uniform=uniform)
        mine = space.project(postures)
        assert torch.equal(j, match_postures(space.log_match(mine), uniform))
        for width in (2.0, 6.0):
            assert torch.equal(bank.inside(postures, own, j, width), space.inside(mine, j, width))
        torch.testing.assert_close(
            bank.clamp_postures(postures, own, j), space.clamp_postures(postures, j)
        )


def test_postures_of_another_precision_are_those_of_the_bank(bank, spaces):
    postures = some_postures().float()
    both = postures.double()
    assert torch.equal(bank.recognise(postures), bank.recognise(both))
    own, j = torch.zeros(60, dtype=torch.long), torch.zeros(60, dtype=torch.long)
    assert torch.equal(bank.inside(postures, own, j), bank.inside(both, own, j))
    z = spaces[0].project(both)
    assert torch.equal(spaces[0].project(postures), z)
    assert spaces[0].reconstruct(z.float()).dtype == torch.float64
    assert copy.deepcopy(bank).float().log_likelihood(both).dtype == torch.float32
    for model in (bank, spaces[0]):
        with pytest.raises(InputError, match="half precision"):
            model.half()


def test_a_space_of_fewer_dimensions_has_tensors_of_its_own(spaces):
    before = {name: value.clone() for name, value in spaces[0].state_dict().items()}
    fewer = spaces[0].with_dimensions(2)
    fewer.load_state_dict({name: value + 1 for name, value in fewer.state_dict().items()})
    assert all(torch.equal(v, before[name]) for name, v in spaces[0].state_dict().items())


def test_every_particle_has_an_action_of_its_own(bank):
    postures, actions = some_postures(), torch.arange(60) % 4
    uniform = torch.rand(60, dtype=torch.float64)
    j = bank.match(postures, actions, uniform=uniform)
    inside = bank.inside(postures, actions, j)
    moved = bank.clamp_postures(postures, actions, j)
    for i in range(4):
        rows = actions == i
        own = torch.full((15,), i)
        one = bank.match(postures[rows], own, uniform=uniform[rows])
        assert torch.equal(j[rows], one)
        assert torch.equal(inside[rows], bank.inside(postures[rows], own, one))
        torch.testing.assert_close(moved[rows], bank.clamp_postures(postures[rows], own, one))
    free = actions == bank.none
    assert inside[free].all() and torch.equal(moved[free], postures[free])
    once = bank.clamp_postures(postures, actions, j, rounds=0)
    assert bank.inside(once, actions, j).all()
    assert int(bank.match(postures, actions, torch.Generator().manual_seed(0)).max()) < 60


def test_gates_of_the_first_dimensions_only(spaces):
    bank = ActionBank(spaces, gate_dimensions=2)
    small = ActionBank([s.with_dimensions(2) for s in spaces])
    postures, actions = some_postures(), torch.arange(60) % 4
    uniform = torch.rand(60, dtype=torch.float64)
    j = bank.match(postures, actions, uniform=uniform)
    assert torch.equal(j[actions < 3], small.match(postures, actions, uniform=uniform)[actions < 3])
    assert torch.equal(bank.inside(postures, actions, j), small.inside(postures, actions, j))
    torch.testing.assert_close(
        bank.clamp_postures(postures, actions, j), small.clamp_postures(postures, actions, j)
    )


def test_likelihoods_are_densities_of_all_angles(bank, spaces):
    postures = some_postures(20)
    found = bank.log_likelihood(postures)
    normal = torch.distributions.MultivariateNormal
    eye = torch.eye(36, dtype=torch.float64)
    left = (
        torch.stack([s.lost_variance / (36 - s.n_dimensions) for s in spaces]).mean().clamp_min(4.0)
    )
    for i, space in enumerate(spaces):
        outside = left * (eye - space.basis @ space.basis.mT)
        parts = []
        for g, sigma in zip(space.performance, space.std, strict=True):
            covariance = (space.basis * (1.3 * sigma).square()) @ space.basis.mT + outside
            parts.append(normal(space.reconstruct(g), covariance).log_prob(postures))
        expected = torch.stack(parts).logsumexp(0) - math.log(space.n_postures)
        torch.testing.assert_close(found[:, i], expected, rtol=1e-8, atol=1e-8)
    means = torch.stack([s.mean for s in spaces])
    pooled = torch.stack([(s.basis * s.variances) @ s.basis.mT for s in spaces]).mean(0)
    pooled = pooled + (means - means.mean(0)).mT @ (means - means.mean(0)) / 3
    variances, axes = torch.linalg.eigh(pooled)
    wide = (axes * torch.maximum(1.5**2 * variances, left)) @ axes.mT
    expected = normal(means.mean(0), (wide + wide.mT) / 2).log_prob(postures)
    torch.testing.assert_close(found[:, 3], expected, rtol=1e-8, atol=1e-8)


def test_transitions_do_not_depend_on_the_frame_rate(bank):
    at_15, at_60 = bank.transition(15.0), bank.transition(60.0)
    torch.testing.assert_close(torch.linalg.matrix_power(at_60, 4), at_15)
    torch.testing.assert_close(bank.transition(1.0).diagonal(), torch.full((4,), 0.8).double())
    torch.testing.assert_close(at_15.sum(-1), torch.ones(4).double())
    assert torch.equal(bank.transition(), bank.transition(30.0))


def test_the_recursion_sums_over_all_paths(bank):
    postures = some_postures(4)
    log = bank.log_likelihood(postures) * min(1.0, bank.info.evidence_rate / 10.0)
    log = log - log.amax(-1, keepdim=True)
    transition = bank.transition(10.0)
    expected = []
    for t in range(1, 5):
        share = torch.zeros(4).double()
        for path in itertools.product(range(4), repeat=t):
            before = sum(transition[:, path[0]].tolist()) / 4
            weight = before * math.exp(sum(float(log[i, a]) for i, a in enumerate(path)))
            for a, b in itertools.pairwise(path):
                weight *= float(transition[a, b])
            share[path[-1]] += weight
        expected.append(share / share.sum())
    torch.testing.assert_close(bank.recognise(postures, 10.0), torch.stack(expected))
    # a batch, and frame by frame
    both = bank.recognise(postures.expand(3, 4, 36), 10.0)
    torch.testing.assert_close(both, torch.stack(expected).expand(3, 4, 4))
    state = bank.start()
    for t in range(4):
        state = bank.update(state, postures[t], 10.0)
        torch.testing.assert_close(state.exp(), expected[t])


def test_actions_are_recognised_in_turn(bank):
    sequence = torch.cat([performances(3, i, seed=77 + i)[k] for i in (1, 0) for k in range(3)])
    sequence = torch.cat([sequence, torch.cat(performances(3, 8, seed=1))])  # unknown to the bank
    found = bank.recognise(sequence)
    told = found.argmax(-1)
    third = len(sequence) // 3
    torch.testing.assert_close(found.sum(-1), torch.ones(len(sequence)).double())
    for i, action in enumerate((1, 0, bank.none)):
        part = told[i * third + 30 : (i + 1) * third - 10]
        assert float((part == action).double().mean()) > 0.8, action


def test_files(bank, spaces, tmp_path):
    path = tmp_path / "bank.safetensors"
    bank.save(path)
    back = ActionBank.load(path)
    postures = some_postures(10)
    assert back.info == bank.info and back.names == bank.names
    assert torch.equal(back.recognise(postures), bank.recognise(postures))
    bank = ActionBank(spaces)
    for change, message in (({"names": ("one",)}, "a name for each of 3"), ({"stay": 0.1}, "stay")):
        bank.info = replace(back.info, **change)
        bank.save(path)
        with pytest.raises((FileFormatError, InputError), match=message):
            ActionBank.load(path)
    spaces[0].save(path)
    with pytest.raises(FileFormatError, match="torchpose-action-bank"):
        ActionBank.load(path)


def test_float32(spaces):
    single = ActionBank(spaces).float()
    postures = some_postures(40)
    expected = ActionBank(spaces).log_likelihood(postures)
    found = single.log_likelihood(postures.float())
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.double(), expected, rtol=1e-3, atol=0.1)


def test_bad_input(bank, spaces):
    other = fit_action_space(performances(5), 4, name="slow", fps=15.0)
    unnamed = fit_action_space(performances(5), 4, fps=30.0)
    for bad, message in (
        ([], "got none"),
        ([spaces[0], spaces[0]], "names of their own"),
        ([unnamed], "names of their own"),
        ([spaces[0], bank], "a list of ActionSpace, got ActionBank"),
        ([spaces[0], other], "one frame rate, got 15, 30"),
    ):
        with pytest.raises(InputError, match=message):
            ActionBank(bad)
    for name, value in (("stay", 0.2), ("stay", 1.0), ("spread", 0.0), ("background", -1.0),
                        ("evidence_rate", math.inf), ("gate_dimensions", 0)):  # fmt: skip
        with pytest.raises(InputError, match=name):
            ActionBank(spaces, **{name: value})
    with pytest.raises(InputError, match="width must be positive"):
        bank.inside(torch.zeros(36).double(), torch.tensor(0), torch.tensor(0), width=0.0)
    with pytest.raises(ShapeError, match="36"):
        bank.recognise(torch.zeros(3, 35).double())
    with pytest.raises(InputError, match="at least one frame"):
        bank.recognise(torch.zeros(0, 36).double())
    with pytest.raises(InputError, match="finite"):
        bank.recognise(torch.full((2, 36), torch.nan).double())
    with pytest.raises(InputError, match="fps must be positive"):
        bank.recognise(torch.zeros(2, 36).double(), fps=0.0)
    named = fit_action_space(performances(5), 4, name="bend")
    with pytest.raises(InputError, match="without a frame rate"):
        ActionBank([named]).recognise(torch.zeros(2, 36).double())


def test_files_of_single_precision_are_read_in_double(bank, tmp_path):
    narrow = copy.deepcopy(bank).float()
    narrow.save(tmp_path / "bank.safetensors")
    back = ActionBank.load(tmp_path / "bank.safetensors")
    assert {value.dtype for value in back.buffers() if value.is_floating_point()} == {torch.float64}
    torch.testing.assert_close(back.std, narrow.std.double(), rtol=0, atol=0)
