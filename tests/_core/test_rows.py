"""Choices between two values of the same kind, row by row."""

from typing import NamedTuple

import torch

from torchpose._core.rows import where_rows


class Pair(NamedTuple):
    numbers: torch.Tensor
    more: object


def test_rows_of_nested_tuples_are_chosen():
    rows = torch.tensor([[True, False], [False, True]])
    new = Pair(torch.ones(2, 2), Pair(torch.ones(2, 2, 3), torch.ones(2, 2, 1, 4)))
    old = Pair(torch.zeros(2, 2), Pair(torch.zeros(2, 2, 3), torch.zeros(2, 2, 1, 4)))
    found = where_rows(rows, new, old)
    for values in (found.numbers, *found.more):
        expected = rows.double().view(2, 2, *[1] * (values.ndim - 2)).expand_as(values)
        assert torch.equal(values.double(), expected)
    assert isinstance(found, Pair) and isinstance(found.more, Pair)


def test_one_tensor_is_chosen_by_its_first_dimension():
    found = where_rows(torch.tensor([True, False]), torch.ones(2, 3), torch.zeros(2, 3))
    assert found.sum(1).tolist() == [3.0, 0.0]
