"""Arguments and methods that have changed are still taken for one release, with a warning."""

import inspect
import warnings

import pytest
import torch

from torchpose._core import moved
from torchpose._core.former_arguments import rename_former_hook, takes_former_arguments


@pytest.fixture
def method(monkeypatch):
    """A function that took `b`, `c` and `a_std` by position, and `d` by name."""
    monkeypatch.setitem(moved.ARGUMENTS, "ours", "b c a_std=a_cov +d=e")

    def ours(x, *, a_cov=None, c=0, b=0, e=0):
        return x, b, c, a_cov, e

    ours.__qualname__ = "ours"
    return takes_former_arguments(ours)


def test_the_present_way_is_silent_and_shown(method):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert method(1, b=2, c=3, a_cov=4.0, e=5) == (1, 2, 3, 4.0, 5)
    assert list(inspect.signature(method).parameters) == ["x", "a_cov", "c", "b", "e"]


def test_positions_go_to_their_names_with_a_warning_of_the_caller(method):
    with pytest.warns(DeprecationWarning, match="ours takes b, c by name now") as said:
        assert method(1, 2, 3) == (1, 2, 3, None, 0)
    assert "torchpose/_core" not in said[0].filename and len(said) == 1


def test_standard_deviations_become_variances(method):
    with pytest.warns(DeprecationWarning, match="a_std of ours is a_cov now"):
        assert method(1, a_std=3.0)[3] == 9
    with pytest.warns(DeprecationWarning):
        found = method(1, 2, 3, torch.tensor([2.0, 3.0]))[3]
    assert found.tolist() == [4, 9]
    with pytest.warns(DeprecationWarning):
        assert method(1, a_std=None)[3] is None


def test_other_names_keep_their_values(method):
    with pytest.warns(DeprecationWarning, match="d of ours is e now"):
        assert method(1, d=7)[4] == 7


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ((1, 2, 3, 4, 5), {}),
        ((1, 2), {"b": 3}),
        ((1,), {"none": 3}),
        ((1,), {"a_std": 2, "a_cov": 4}),
    ],
)
def test_what_was_wrong_before_still_is(method, given, named):
    with pytest.raises(TypeError):
        method(*given, **named)


def test_a_hook_by_its_former_name_is_renamed():
    class Before:
        def advance(self):
            return "one frame"

    with pytest.warns(DeprecationWarning, match=r"Before\.advance is to be called filter_frame"):
        rename_former_hook(Before, "advance", "filter_frame")
    assert Before().filter_frame() == "one frame" and not hasattr(Before, "advance")


def test_every_function_of_the_table_takes_what_it_took():
    """The table names functions that there are, and arguments that they have."""
    from torchpose.filters import (
        BootstrapParticleFilter,
        MixtureKalmanFilter,
        RecursiveFilter,
        SampledTrackFilter,
    )
    from torchpose.filters._constant_velocity import ConstantVelocityFilter
    from torchpose.whole_body import BodyTracker, SilhouetteParticleFilter, track_body

    homes = (BootstrapParticleFilter, MixtureKalmanFilter, RecursiveFilter, SampledTrackFilter,
             ConstantVelocityFilter, BodyTracker, SilhouetteParticleFilter)  # fmt: skip
    known = {home.__name__: home for home in homes}
    for name, former in moved.ARGUMENTS.items():
        home, _, method = name.rpartition(".")
        function = vars(known[home])[method] if home else track_body
        assert hasattr(function, "__wrapped__")
        parameters = inspect.signature(function).parameters
        for entry in former.split():
            present = entry.rpartition("=")[2].removeprefix("+")
            assert parameters[present].kind is inspect.Parameter.KEYWORD_ONLY
