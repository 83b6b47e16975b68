"""The network that lifts arms: what it is shown, and what its file holds."""

import math

import pytest
import torch
from torch.nn.functional import pad

from torchpose.errors import FileFormatError, InputError
from torchpose.math import euler_to_matrix
from torchpose.priors._arm_lifter import (
    INPUTS,
    JOINTS,
    ArmLifter,
    ArmLifterInfo,
    arm_features,
    farthest_so_far,
    from_neck,
    shipped_arm_lifter,
)
from torchpose.priors._arms import shipped_arm_prior

HEAD = JOINTS.index("head")


def rays(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    drawn = 0.15 * torch.randn(*shape, len(JOINTS), 2, generator=generator, dtype=torch.float64)
    return pad(drawn, (0, 1), value=1.0)


def features(given, seen, wrists=False):
    zeros = torch.zeros(len(seen), len(JOINTS), dtype=torch.float64)
    return arm_features(seen, given, farthest_so_far(seen, given, zeros, 30.0), wrists)


def test_a_camera_that_turns_to_a_side_sees_the_same_from_the_neck():
    ways = rays(4, 3)
    neck = pad(torch.full((4, 3, 2), 0.1, dtype=torch.float64), (0, 1), value=1.0)
    angles = torch.tensor([0.0, 0.0, 0.3], dtype=torch.float64)
    turn = euler_to_matrix(angles, "zxy")
    seen, axes = from_neck(ways, neck)
    again, turned = from_neck(ways @ turn.mT, neck @ turn.mT)
    torch.testing.assert_close(again, seen)
    torch.testing.assert_close(turned, turn @ axes)
    assert not torch.allclose(seen, ways[..., :2], atol=0.01)


def test_the_neck_is_in_the_middle_of_that_camera():
    neck = rays(5)[:, 0]
    middle, axes = from_neck(neck[:, None], neck)
    torch.testing.assert_close(middle, torch.zeros_like(middle))
    torch.testing.assert_close(axes.mT @ axes, torch.eye(3, dtype=torch.float64).expand(5, 3, 3))


def test_what_is_not_measured_is_not_shown():
    seen, given = rays(2, 6)[..., :2], torch.ones(2, 6, len(JOINTS), dtype=torch.bool)
    given[:, :, [1, HEAD]] = False
    changed = seen.clone()
    changed[:, :, [1, HEAD]] += 3.0
    torch.testing.assert_close(features(given, seen), features(given, changed))
    changed[:, :, 0] += 0.1
    assert not torch.allclose(features(given, seen), features(given, changed))


def test_wrists_and_hands_are_told_apart():
    seen, given = rays(1, 2)[..., :2], torch.ones(1, 2, len(JOINTS), dtype=torch.bool)
    both = [features(given, seen, wrists) for wrists in (False, True)]
    assert both[0].shape[-1] == INPUTS
    assert float((both[1] - both[0]).abs().sum(-1).min()) == 1.0


@pytest.mark.parametrize("size", [1, 3])
def test_extents_follow_from_frame_to_frame(size):
    seen = rays(2, 12)[..., :2]
    given = torch.rand(2, 12, len(JOINTS), generator=torch.Generator().manual_seed(1)) > 0.4
    zeros = torch.zeros(2, len(JOINTS), dtype=torch.float64)
    whole, before, parts = farthest_so_far(seen, given, zeros, 25.0), zeros, []
    for part, known in zip(seen.split(size, 1), given.split(size, 1), strict=True):
        parts.append(farthest_so_far(part, known, before, 25.0))
        before = parts[-1][:, -1]
    torch.testing.assert_close(torch.cat(parts, 1), whole)


def test_extents_of_long_ago_fade():
    seen = torch.full((1, 901, len(JOINTS), 2), 0.1, dtype=torch.float64)
    seen[:, 0] = 1.0
    given = torch.ones(1, 901, len(JOINTS), dtype=torch.bool)
    zeros = torch.zeros(1, len(JOINTS), dtype=torch.float64)
    extent = farthest_so_far(seen, given, zeros, 30.0)[0, :, 0]
    assert float(extent[0]) == pytest.approx(math.sqrt(2))
    assert float(extent[900]) == pytest.approx(math.sqrt(2) / math.e)
    late = farthest_so_far(seen[:, 1:].expand(1, 900, -1, -1), given[:, 1:], zeros, 1e-3)
    assert bool(late.isfinite().all())


def test_deviations_do_not_move_what_they_share_with_arms():
    network = ArmLifter()
    network(torch.randn(5, INPUTS)).std.sum().backward()
    assert network.hidden[0].weight.grad is None
    assert float(network.spread.weight.grad.abs().sum()) > 0
    seen = torch.randn(5, INPUTS, requires_grad=True)
    for training, moves in ((True, False), (False, True)):
        std = network.train(training)(seen).std.sum()
        (slope,) = torch.autograd.grad(std, seen, materialize_grads=True, allow_unused=True)
        assert bool(slope.any()) is moves


def test_a_network_is_read_as_it_was_written(tmp_path):
    info = ArmLifterInfo("mine", ("a",), ("a s1",), "MIT", "fit")
    network = ArmLifter(info)
    network.save(tmp_path / "mine.safetensors")
    read = ArmLifter.load(tmp_path / "mine.safetensors")
    assert read.info == info
    seen = torch.randn(3, INPUTS)
    torch.testing.assert_close(read(seen).ends, network(seen).ends, atol=2e-3, rtol=2e-2)
    with pytest.raises(InputError):
        ArmLifter.load(tmp_path / "none.safetensors")
    (tmp_path / "text.safetensors").write_text("no network")
    with pytest.raises(FileFormatError):
        ArmLifter.load(tmp_path / "text.safetensors")


def test_the_shipped_network_says_to_whom_it_was_fitted():
    info = shipped_arm_lifter().info
    assert "kinect_utd_mhad s7" in info.left_out and "kinect_laban" in info.recordings
    assert info.command.startswith("python -m benchmarks.arm_lifter")


def test_the_shipped_network_lifts_arms_that_hang_and_arms_that_are_held_up():
    """A person in front of the camera, of the lengths of the prior over persons."""
    upper, _, forearm, width, head = shipped_arm_prior().lengths.tolist()
    for way in (1.0, -1.0):
        down = torch.tensor([0.0, way, 0.0], dtype=torch.float64)
        neck = torch.tensor([0.0, -0.1, 2.0], dtype=torch.float64)
        shoulders = neck + torch.tensor([[width / 2, 0.1, 0.0], [-width / 2, 0.1, 0.0]]).double()
        ends = torch.stack([upper * down, (upper + forearm) * down])
        arms = torch.cat([shoulders[:, None], shoulders[:, None] + ends], 1)
        points = torch.cat([arms.flatten(0, 1), neck[None] - head * torch.tensor([[0, 1.0, 0]])])
        seen, axes = from_neck(points / points[:, 2:], neck / neck[2])
        given = torch.ones(1, 1, len(JOINTS), dtype=torch.bool)
        shown = features(given, seen[None, None]).float()
        found = shipped_arm_lifter()(shown)
        lifted = found.ends[0, 0].double() @ axes.mT
        assert float((lifted - ends).norm(dim=-1).max()) < 0.32
        assert float(found.std.min()) > 0.02 and float(found.std.max()) < 0.25
