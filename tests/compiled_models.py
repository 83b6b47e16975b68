"""Trackers within models that `torch.compile` compiles, against the plain models; run without shape checks.

`python -m tests.compiled_models` prints a line for each case: its name and the largest difference.
"""

import json
import math
import warnings
from collections.abc import Callable

import torch
from torch import Tensor, nn

import torchpose
from torchpose.body import BODY_15, Body
from torchpose.camera import CameraRig, PinholeCamera

NAMES = ("head", "neck", "hand_left", "hand_right")


def waving_keypoints() -> Tensor:
    """Return keypoints [1, 4, 4, 2] of a hand that moves."""
    still = torch.tensor([[320.0, 120.0], [320.0, 165.0], [420.0, 240.0], [220.0, 240.0]])
    moves = torch.zeros(4, 4, 2)
    moves[:, 2, 1] = torch.linspace(0, 20, 4)
    return (still + moves)[None].double()


def upper_body_tracker(method: str | None = None) -> torchpose.UpperBodyTracker:
    """Return a tracker with the small prior."""
    prior = torchpose.load_prior("kinect-upper-body-small")
    return torchpose.UpperBodyTracker(prior, prior.camera, method)


class Shifted(nn.Module):
    """A model with a parameter in front of a tracker, and more behind it."""

    def __init__(self, tracker: nn.Module, names: tuple[str, ...] = NAMES) -> None:
        super().__init__()
        self.tracker, self.names = tracker, names
        self.shift = nn.Parameter(torch.zeros(2, dtype=torch.float64))

    def forward(self, keypoints: Tensor) -> Tensor:
        return 2 * self.tracker(keypoints=keypoints + self.shift, names=self.names).joints3d


class Live(nn.Module):
    """A model that makes one step of a stream."""

    def __init__(self, tracker: torchpose.UpperBodyTracker) -> None:
        super().__init__()
        self.tracker = tracker

    def forward(self, state: object, frame: Tensor) -> tuple[object, Tensor]:
        state, pose = self.tracker.step(state, 1.0 * frame)
        return state, 2 * pose.joints3d


def compiled(model: nn.Module) -> Callable[..., Tensor]:
    """Return the compiled model, after a reset of the compiler."""
    torch.compiler.reset()
    return torch.compile(model, backend="eager")


def largest(one: Tensor, other: Tensor) -> float:
    return float((one - other).abs().amax())


def upper_body() -> float:
    model = Shifted(upper_body_tracker())
    return largest(compiled(model)(waving_keypoints()), model(waving_keypoints()))


def gradient() -> float:
    model, keypoints = Shifted(upper_body_tracker("window-mixture")), waving_keypoints()
    found, expected = (
        torch.autograd.grad(fn(keypoints).sum(), model.shift)[0] for fn in (compiled(model), model)
    )
    assert bool((expected != 0).any())
    return largest(found, expected)


def stream() -> float:
    model = Live(upper_body_tracker())
    fast, differences = compiled(model), []
    state = other = model.tracker.init(1, NAMES)
    for frame in waving_keypoints().unbind(1):
        state, plain = model(state, frame)
        other, pose = fast(other, frame)
        differences.append(largest(pose, plain))
    return max(differences)


def whole_body() -> float:
    rig = CameraRig([
        PinholeCamera(900, 900, 639.5, 359.5, 1280, 720, name, rotation=(0, turn, 0), translation=(0, 0, 3))
        for name, turn in (("front", math.pi), ("side", math.pi / 2))
    ])  # fmt: skip
    states = torch.zeros(4, 36, dtype=torch.float64)
    states[:, 3] = math.pi
    keypoints = rig(Body.of_height(BODY_15, 1.75).joints(states)).pixels
    model = Shifted(torchpose.BodyTracker(rig, "kalman", fps=30), BODY_15.names)
    return largest(compiled(model)(keypoints), model(keypoints))


CASES = {case.__name__: case for case in (upper_body, gradient, stream, whole_body)}

if __name__ == "__main__":
    # The compiler looks at the gradients of all tensors at a break, and warns of itself.
    warnings.filterwarnings("ignore", message="The .grad attribute")
    for name, case in CASES.items():
        print(json.dumps([name, case()]))
