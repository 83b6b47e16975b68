"""Results of functions that run in inference mode, which gradients may still use."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchpose._core.inference import in_inference_mode, usable_anywhere


@dataclass
class Poses:
    joints: Tensor
    notes: tuple[str, ...] = ()


class Found(NamedTuple):
    poses: Poses
    numbers: list[Tensor]
    by_name: dict[str, Tensor]
    missing: None = None


@in_inference_mode
def doubled(values):
    """Return twice the values."""
    assert torch.is_inference_mode_enabled()
    return Found(Poses(2 * values, ("a note",)), [2 * values], {"twice": 2 * values})


def tensors_of(found):
    return [found.poses.joints, *found.numbers, *found.by_name.values()]


def test_tensors_of_any_result_may_enter_a_graph():
    found = doubled(torch.ones(3))
    assert found.poses.notes == ("a note",) and found.missing is None
    for value in tensors_of(found):
        scale = torch.ones((), requires_grad=True)
        (value * scale).square().sum().backward()
        assert float(scale.grad) == 24.0


def test_inside_inference_mode_nothing_is_copied():
    with torch.inference_mode():
        found = doubled(torch.ones(3))
    assert all(value.is_inference() for value in tensors_of(found))


def test_what_is_of_no_inference_mode_stays_the_same_tensor():
    value = torch.ones(2)
    copied = usable_anywhere([value, (value, "text")])
    assert copied[0] is value and copied[1][0] is value and copied[1][1] == "text"
    poses = Poses(value)
    assert usable_anywhere(poses).joints is value
    with torch.inference_mode():
        poses.joints = 2 * value
    assert not usable_anywhere(poses).joints.is_inference() and poses.joints.is_inference()
