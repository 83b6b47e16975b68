"""Values with tensors that go through a pipe."""

import os
from collections import namedtuple

import numpy as np
import pytest
import torch

from torchpose._core.pipe import WAITING, PipeReader, PipeWriter, shared_memory

Pair = namedtuple("Pair", "first second")


@pytest.fixture
def ends():
    """A writer and a reader in one process, with memory for arrays of up to 4 kB."""
    memory = shared_memory(1 << 16)
    out, into = os.pipe()
    with open(out, "rb") as reading, open(into, "wb") as writing:
        yield PipeWriter(writing, memory), PipeReader(reading, memory)
    os.close(memory)


@pytest.mark.parametrize(
    "value",
    [
        torch.arange(24).view(2, 3, 4),
        torch.randn(2, 3, 4, 5).contiguous(memory_format=torch.channels_last),
        torch.randn(6, 4).T,
        torch.randn(1, 5).expand(3, 5),
        torch.tensor(2.5, dtype=torch.float64),
        torch.zeros(0, 3),
        torch.tensor([True, False]),
        np.arange(6, dtype=np.uint8).reshape(2, 3),
        torch.randn(3000),  # too large for the memory
    ],
    ids=["rows", "channels", "turned", "repeated", "scalar", "empty", "bool", "array", "large"],
)
def test_arrays_arrive_as_they_were(ends, value):
    writer, reader = ends
    writer.write(value)
    found = reader.read()
    assert type(found) is type(value) and found.dtype == value.dtype
    np.testing.assert_array_equal(np.asarray(found), np.asarray(value))
    if isinstance(value, torch.Tensor) and 0 not in value.stride():
        assert found.stride() == value.stride()


def test_whatever_can_be_pickled_arrives_around_them(ends):
    writer, reader = ends
    shared = torch.ones(3)
    writer.write(Pair({"a": [shared, None]}, (shared, "text")))
    found = reader.read()
    assert isinstance(found, Pair) and found.second[1] == "text" and found.first["a"][1] is None
    assert found.first["a"][0] is found.second[0]


def test_what_stays_is_sent_once(ends):
    writer, reader = ends
    stays = torch.randn(200)
    found = []
    for number in range(3):
        writer.write((stays, torch.tensor(number)))
        found.append(reader.read())
    assert found[0][0] is found[1][0] is found[2][0]
    assert [int(number) for _, number in found] == [0, 1, 2]


def test_values_may_wait_and_last_when_the_memory_is_used_again(ends):
    writer, reader = ends
    kept = []
    for start in range(0, 5 * WAITING, WAITING):
        for number in range(start, start + WAITING):
            writer.write(torch.full((1000,), float(number)))
        kept += [reader.read() for _ in range(WAITING)]
    assert [value.unique().tolist() for value in kept] == [[n] for n in range(5 * WAITING)]


def test_the_end_is_told(ends):
    writer, reader = ends
    writer._file.close()
    with pytest.raises(EOFError):
        reader.read()
