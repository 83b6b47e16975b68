"""Which process takes which block: each exactly once, whatever the numbers."""

import pytest
import torch

from torchpose.errors import InputError
from torchpose.learning._samplers import BLOCK, PRODUCT, TensorSource
from train.blocks import Key, ShareSampler, Sweep, SweepLoader, list_blocks

POSE, WINDOW, WATCHED = Key("pose"), Key("causal.left"), Key("pose", held_out=True)


def sources(n_pose=3 * BLOCK - 7, n_window=PRODUCT + BLOCK + 1):
    values = torch.arange(float(n_pose)), torch.arange(float(n_window)), torch.arange(10.0)
    pose, window, watched = (TensorSource(v[:, None].double()) for v in values)
    return {POSE: pose, WINDOW: window, WATCHED: watched}


@pytest.mark.parametrize("world", [1, 2, 3, 5, 40])
def test_every_block_once(world):
    blocks = list_blocks(sources())
    shares = [list(ShareSampler(blocks, rank, world)) for rank in range(world)]
    assert sorted(b for share in shares for b in share) == sorted(blocks)
    assert max(map(len, shares)) - min(map(len, shares)) <= 1
    assert (world == 40) == any(not share for share in shares)


@pytest.mark.parametrize(("world", "num_workers"), [(1, 0), (2, 0), (2, 1), (4, 0)])
def test_sums_do_not_depend_on_processes(world, num_workers):
    found = dict.fromkeys(sources(), 0.0)
    seen = 0
    for rank in range(world):
        (sweep,) = SweepLoader(sources(), rank, world, num_workers=num_workers)
        counted = []
        sweep.watchers.append(lambda counted=counted: counted.append(1))
        for key, samples in sweep:
            found[key] += float(samples.states.sum())
            seen += len(samples.states)
        assert len(counted) == len(sweep)
    assert found == {k: float(sum(range(s.n_samples))) for k, s in sources().items()}
    assert seen == sum(s.n_samples for s in sources().values())


def test_sources_that_are_done_are_left_out_in_the_next_sweep():
    epochs = {POSE: 4, WINDOW: 0, WATCHED: None}
    sampler = ShareSampler(list_blocks(sources()), epochs=epochs.get)
    assert {(b.key, b.epoch) for b in sampler} == {(POSE, 4), (WINDOW, 0)}
    epochs[POSE] = None
    assert {b.key for b in sampler} == {WINDOW} and len(sampler) == PRODUCT // BLOCK + 2


def test_products_hold_one_source_and_bounded_memory():
    (sweep,) = SweepLoader(sources())
    assert isinstance(sweep, Sweep)
    parts = [(key, len(samples.states)) for key, samples in sweep]
    assert parts == [
        (POSE, 3 * BLOCK - 7), (WINDOW, PRODUCT), (WINDOW, BLOCK + 1), (WATCHED, 10)
    ]  # fmt: skip


def test_states_that_are_not_finite_are_named():
    states = torch.zeros(BLOCK + 5, 2).double()
    states[BLOCK + 2, 1] = torch.nan
    (sweep,) = SweepLoader({WINDOW: TensorSource(states)})
    with pytest.raises(InputError, match=r"mixture 'causal\.left', block 1 of 2: .* row 2"):
        list(sweep)
    weight = torch.ones(len(states)).double()
    weight[BLOCK + 2] = 0
    (sweep,) = SweepLoader({WINDOW: TensorSource(states, weight)})
    assert len(list(sweep)) == 1
