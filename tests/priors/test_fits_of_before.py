"""The classmethods `fit` of before give what the functions of `torchpose.learning` give, and warn."""

import copy

import pytest
import torch

from tests.priors.motions import motion
from tests.priors.performances import performances
from tests.whole_body.filters.walking_body import walk, walker
from torchpose.learning import fit_action_space, fit_gplvm, fit_gplvm_noise, fit_limb_conditionals
from torchpose.learning._action_spaces import fit_synchronised
from torchpose.priors import ActionSpace, BackConstrainedGPLVM
from torchpose.priors._limb_conditionals import LimbConditionals, in_body_frame


def _same(one: torch.nn.Module, other: torch.nn.Module) -> None:
    theirs = other.state_dict()
    assert one.state_dict().keys() == theirs.keys()
    for name, value in one.state_dict().items():
        torch.testing.assert_close(value, theirs[name], rtol=0, atol=0, equal_nan=True)


def test_manifold() -> None:
    wanted = fit_gplvm(motion(40), steps=2)
    with pytest.warns(DeprecationWarning, match=r"torchpose\.learning\.fit_gplvm"):
        found = BackConstrainedGPLVM.fit(motion(40), steps=2)
    _same(found, wanted)
    fit_gplvm_noise(wanted, motion(30, seed=3), 60.0)
    with pytest.warns(DeprecationWarning, match=r"torchpose\.learning\.fit_gplvm_noise"):
        assert found.fit_noise(motion(30, seed=3), fps=60.0) is found
    _same(found, wanted)


def test_action_space() -> None:
    wanted, steps = fit_synchronised(performances(8), 4, name="bend", fps=30.0)
    _same(fit_action_space(performances(8), 4, name="bend", fps=30.0), wanted)
    with pytest.warns(DeprecationWarning, match=r"torchpose\.learning\.fit_action_space"):
        found = ActionSpace.fit(performances(8), 4, name="bend", fps=30.0)
    _same(found, wanted)
    assert found.info == wanted.info
    with pytest.warns(DeprecationWarning, match="fit_synchronised"):
        _, others = ActionSpace.fit_synchronised(performances(8), 4, name="bend", fps=30.0)
    torch.testing.assert_close(others.after, steps.after, rtol=0, atol=0)


def test_limb_conditionals() -> None:
    upright = walker()
    body, states = in_body_frame([(upright, [walk(upright, 40)])])
    wanted = fit_limb_conditionals(body, copy.deepcopy(states), 60.0, name="walk")
    with pytest.warns(DeprecationWarning, match=r"torchpose\.learning\.fit_limb_conditionals"):
        found = LimbConditionals.fit(body, states, 60.0, name="walk")
    _same(found, wanted)
    assert found.info == wanted.info
