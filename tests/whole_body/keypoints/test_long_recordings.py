"""Long recordings: worked on in parts, with the same numbers, and with each state held once."""

import weakref
from typing import NamedTuple

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from tests.whole_body.keypoints.scenes import NAMES, kalman, scene
from torchpose.whole_body._keypoints import body_smoothing, foot_tracker, nested
from torchpose.whole_body._keypoints.nested import FrameCollector, by_parts, stacked

_N_FRAMES = 34  # whose states are larger than the matrices of the network that lifts
_FEW_FRAMES = 10


def in_parts_of(count, monkeypatch):
    for module in (body_smoothing, foot_tracker, nested):
        monkeypatch.setattr(module, "PART", count)


def tracked(n_cameras, smoothing, feet=False, n_frames=_FEW_FRAMES):
    """Return the track of a body, in one camera at a size that its height tells."""
    seen = scene(n_cameras, n_frames=n_frames)
    keypoints, names = seen.keypoints, NAMES
    if feet:
        toes = keypoints[:, :, [NAMES.index("left_ankle"), NAMES.index("right_ankle")]] + 15.0
        keypoints = torch.cat([keypoints, toes], 2)
        names = (*NAMES, "left_big_toe", "right_big_toe")
    floor = {"up": "z", "camera_height": 1.4} if n_cameras == 1 else {}
    tracker = kalman(seen.rig, **floor)
    return tracker(keypoints=keypoints, names=names, smoothing=smoothing)


@pytest.mark.slow
@pytest.mark.parametrize("smoothing", ["none", "full"])
@pytest.mark.parametrize(("n_cameras", "feet"), [(3, True), (1, False)])
def test_parts_give_the_numbers_of_all_frames(monkeypatch, n_cameras, feet, smoothing):
    whole = tracked(n_cameras, smoothing, feet)
    in_parts_of(4, monkeypatch)
    parts = tracked(n_cameras, smoothing, feet)
    names = ("state", "state_std", "joints3d", "covariance3d", "log_evidence")
    pairs = [(getattr(parts, name), getattr(whole, name)) for name in names]
    assert parts.details.keys() == whole.details.keys()
    for one, other in [*pairs, *zip(parts.details.values(), whole.details.values(), strict=True)]:
        torch.testing.assert_close(one, other, rtol=0, atol=1e-11, equal_nan=True)


class Largest(TorchDispatchMode):
    """Keeps the number of elements of the largest tensor that is made."""

    def __init__(self):
        super().__init__()
        self.size = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        made = func(*args, **(kwargs or {}))
        views = {
            leaf.untyped_storage().data_ptr() for leaf in tree_leaves(args) if torch.is_tensor(leaf)
        }
        for leaf in tree_leaves(made):
            if torch.is_tensor(leaf) and leaf.untyped_storage().data_ptr() not in views:
                self.size = max(self.size, leaf.numel())
        return made


@pytest.mark.slow
def test_no_tensor_is_larger_than_the_states(monkeypatch):
    """Products of Jacobians and states were fifteen times as large, 0.7 MB a frame."""
    in_parts_of(1, monkeypatch)
    with Largest() as largest:
        tracked(1, "full", n_frames=_N_FRAMES)
    assert largest.size <= _N_FRAMES * 77 * 77


class Frame(NamedTuple):
    value: torch.Tensor
    inner: tuple[torch.Tensor, ...]


def frames_of(count):
    for t in range(count):
        yield Frame(torch.full((2, 3), t), (torch.tensor([t > 1, True]),))


@pytest.mark.parametrize("count", [1, 4, 9])
def test_collected_frames_are_those_that_were_added(monkeypatch, count):
    in_parts_of(4, monkeypatch)
    collector = FrameCollector(count)
    for frame in frames_of(count):
        collector.add(frame)
    found, expected = collector.sequence, stacked([*frames_of(count)])
    assert isinstance(found, Frame)
    assert torch.equal(found.value, expected.value)
    assert torch.equal(found.inner[0], expected.inner[0])


def test_frames_that_were_collected_are_not_held(monkeypatch):
    in_parts_of(4, monkeypatch)
    collector, held = FrameCollector(10), []
    for frame in frames_of(10):
        collector.add(frame)
        held.append(weakref.ref(frame.value))
        del frame
        assert sum(one() is not None for one in held) < 4


def test_functions_are_computed_by_parts(monkeypatch):
    in_parts_of(4, monkeypatch)
    sizes = []

    def doubled(first, second):
        sizes.append(len(first.value))
        return Frame(2 * first.value, (second,))

    frames = Frame(torch.arange(10.0), (torch.arange(10),))
    found = by_parts(doubled, frames, frames.inner[0], dim=0)
    assert sizes == [4, 4, 2]
    assert torch.equal(found.value, 2 * frames.value) and torch.equal(
        found.inner[0], frames.inner[0]
    )
