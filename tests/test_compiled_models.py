"""Trackers within models that `torch.compile` compiles: the same numbers, live and with gradients."""

import pytest

from tests.compiled_models import CASES
from tests.without_shape_checks import differences_of


@pytest.fixture(scope="module")
def differences():
    return differences_of("tests.compiled_models")


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_compiled_model_gives_the_numbers_of_the_plain_one(differences, case):
    assert differences[case] == 0
