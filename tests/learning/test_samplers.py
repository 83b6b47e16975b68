"""Sources of training states: the same blocks whoever asks, and every pose as often as any other."""

import pickle

import numpy as np
import pytest
import torch

from tests.priors.poses import poses, recording
from torchpose.camera import ViewRange
from torchpose.errors import InputError
from torchpose.learning import TRAINING_VIEWS
from torchpose.learning._samplers import (
    BLOCK,
    ArmSource,
    CachedSource,
    PoseFrames,
    SampleSource,
    TensorSource,
    WindowSource,
    all_samples,
    cached,
    derived_seed,
)
from torchpose.learning._training import arm_sources, collect_poses
from torchpose.priors._arm_state import mirror_arm_state
from torchpose.priors._window import WindowLayout

MATRIX = torch.tensor([[525.0, 0, 319.5], [0, 525.0, 239.5], [0, 0, 1]], dtype=torch.float64)
FRONT = ViewRange(roll=0, pitch=0, yaw=0, tx=(0, 0), ty=(0, 0), tz=(2, 2))
LAYOUT = WindowLayout(own=(2, -1), other=(0,))


def sequence(n=12, seed=1):
    moving = poses(n, seed=seed, offset=(0, 0, 0))
    return moving - moving[:, 4:5]


def arm_source(n_samples=10_000, n_poses=70, fresh=False, seed=0):
    arms = sequence(n_poses)[:, :5]
    trust = torch.linspace(0.1, 1, n_poses).double()
    return ArmSource(MATRIX, TRAINING_VIEWS, "zxy", n_samples, seed, fresh, arms, trust)


def window_source(side="left", n_samples=12, views=FRONT, sequences=None, rates=None, **bodies):
    frames = PoseFrames.join(sequences or [sequence()], rates or [30.0])
    centres = frames.complete(LAYOUT)
    return WindowSource(
        MATRIX, views, "zxy", n_samples, 0, False, frames, centres, LAYOUT, side, **bodies
    )


@pytest.mark.parametrize("n", [1, BLOCK - 1, BLOCK, BLOCK + 1, 10_000])
def test_blocks_hold_every_sample_once(n):
    source = arm_source(n)
    assert isinstance(source, SampleSource)
    sizes = [len(source.block(i).states) for i in range(source.n_blocks)]
    full, rest = divmod(n, BLOCK)
    assert sizes == [BLOCK] * full + ([rest] if rest else []) and source.n_samples == n
    with pytest.raises(InputError, match="block must lie in 0"):
        source.block(source.n_blocks)


def test_a_block_does_not_depend_on_what_was_drawn_before():
    once, again = arm_source(), arm_source()
    late = once.block(2)
    for index in (0, 1):
        once.block(index)
    torch.testing.assert_close(again.block(2).states, late.states, rtol=0, atol=0)
    assert not torch.equal(once.block(0).states, once.block(1).states)
    other = pickle.loads(pickle.dumps(once)).block(2)
    assert torch.equal(other.states, late.states)


def test_fresh_sources_draw_other_viewpoints_in_every_epoch():
    still, fresh = arm_source(), arm_source(fresh=True)
    assert torch.equal(still.block(0, 0).states, still.block(0, 5).states)
    assert torch.equal(fresh.block(0, 5).states, arm_source(fresh=True).block(0, 5).states)
    assert not torch.equal(fresh.block(0, 0).states[:, 15:], fresh.block(0, 5).states[:, 15:])
    assert torch.equal(fresh.block(0, 0).weight, fresh.block(0, 5).weight)


@pytest.mark.parametrize("n_poses", [1, 2, 7, 70, 1000])
def test_poses_are_used_evenly_and_come_from_everywhere(n_poses):
    source = arm_source(2 * n_poses + n_poses // 3 + 1, n_poses)
    order = torch.cat([source._poses(i, n_poses) for i in range(source.n_blocks)])
    counts = torch.bincount(order, minlength=n_poses)
    assert int(counts.max()) - int(counts.min()) <= 1
    if n_poses == 1000:  # any hundred in a row leave no hole of fifty poses
        first = order[:100].sort().values
        assert int(first.diff().max()) < 50


def test_seeds_of_purposes_differ_and_stay():
    assert derived_seed(0, "start") == derived_seed(0, "start")
    seeds = {derived_seed(seed, purpose) for seed in (0, 1) for purpose in ("start", "views", "")}
    assert len(seeds) == 6 and all(0 <= seed < 2**63 for seed in seeds)


def test_weights_follow_their_poses():
    source = arm_source(140)
    samples = all_samples(source)
    order = source._poses(0, 70)
    torch.testing.assert_close(samples.weight, torch.linspace(0.1, 1, 70).double()[order])


def test_tensor_source_reads_arrays_and_files(tmp_path):
    states = torch.randn(BLOCK + 5, 3, generator=torch.Generator().manual_seed(0)).double()
    np.save(tmp_path / "states.npy", states.numpy())
    mapped = np.load(tmp_path / "states.npy", mmap_mode="r")
    trust = torch.rand(len(states), generator=torch.Generator().manual_seed(1)).double()
    for source in (TensorSource(states, trust), TensorSource(mapped, trust)):
        assert isinstance(source, SampleSource) and source.dim == 3
        assert torch.equal(all_samples(source).states, states)
        assert torch.equal(source.block(1).weight, trust[BLOCK:])
    with pytest.raises(InputError, match=r"\[N, D\]"):
        TensorSource(states[0])


def test_cached_sources_draw_once_and_only_where_that_is_right():
    source = arm_source()
    kept = cached(source)
    assert isinstance(kept, CachedSource)
    assert kept.block(1) is kept.block(1)
    assert torch.equal(kept.block(1).states, source.block(1).states)
    assert not pickle.loads(pickle.dumps(kept))._kept
    assert cached(source, limit=1000) is source
    fresh = arm_source(fresh=True)
    assert cached(fresh) is fresh


def test_both_arms_of_a_window_are_seen_from_one_place():
    options = {"n_samples": 50, "views": TRAINING_VIEWS, "body_size": 0.1, "mirror_share": 0.5}
    left, right = (window_source(side, **options).block(0).states for side in ("left", "right"))
    torch.testing.assert_close(left[:, 9:21], right[:, 9:21])  # head, neck, camera


def test_mirrored_windows_are_the_other_arm_of_the_mirrored_person():
    plain, mirrored = (window_source("left", mirror_share=share) for share in (0.0, 1.0))
    other = window_source("right").block(0).states
    turned = mirror_arm_state(other[:, :21], 319.5)
    torch.testing.assert_close(mirrored.block(0).states[:, :21], turned)
    assert not torch.allclose(plain.block(0).states, mirrored.block(0).states)


def test_lags_follow_the_frame_rate_and_recordings_do_not_mix():
    sequences = [sequence(10, 1), sequence(20, 2)]
    frames = PoseFrames.join(sequences, [30.0, 60.0])
    taken = frames.at_lags(torch.arange(30), LAYOUT)  # lags -1, 0, 2 in order
    expected_first = (torch.arange(10)[:, None] - torch.tensor([-1, 0, 2])).clamp(0, 9)
    expected_second = (torch.arange(20)[:, None] - torch.tensor([-2, 0, 4])).clamp(0, 19) + 10
    assert torch.equal(taken, torch.cat([expected_first, expected_second]))


def test_windows_with_missing_joints_are_left_out():
    broken = sequence(20)
    broken[8, 1] = torch.nan
    frames = PoseFrames.join([broken], [30.0])
    # frame 8 itself, frame 7 that looks one ahead, frame 10 that looks two back
    assert sorted(set(range(20)) - set(frames.complete(LAYOUT).tolist())) == [7, 8, 10]
    with pytest.raises(InputError, match="at least one recording"):
        PoseFrames.join([], [])


def test_tracking_states_become_weights():
    part = recording(poses(40))
    part.weights = torch.ones(40, 8)
    part.weights[:10, 0] = 0.5  # left hand inferred
    part.weights[10:15, 7] = 0.0  # right hand not to be used
    found = collect_poses([part, recording(poses(20))])
    assert found.weight.shape == (60, 8) and bool((found.weight[40:] == 1).all())
    sources = arm_sources(found, MATRIX, mirror=False, views_per_pose=1)
    weights = all_samples(sources.left).weight
    assert int((weights == 0.5).sum()) == 10 and len(weights) == 60
    assert len(all_samples(sources.right).states) == 55
    assert sources.facts["extra"]["frames_left_out"] == {"left": 0, "right": 5}
