"""Test trackers within models that `torch.compile` compiles."""

import math

import pytest
import torch
from torch import Tensor, nn

import torchpose
from torchpose.body import BODY_15, Body
from torchpose.camera import CameraRig, PinholeCamera

# The compiler looks at the gradients of all tensors at a break, and warns of itself.
pytestmark = pytest.mark.filterwarnings("ignore:The .grad attribute")

NAMES = ("head", "neck", "hand_left", "hand_right")


@pytest.fixture(scope="module")
def keypoints() -> Tensor:
    still = torch.tensor([[320.0, 120.0], [320.0, 165.0], [420.0, 240.0], [220.0, 240.0]])
    moves = torch.zeros(8, 4, 2)
    moves[:, 2, 1] = torch.linspace(0, 20, 8)
    return (still + moves)[None].double()


@pytest.fixture
def fresh_compiler():
    torch.compiler.reset()
    yield
    torch.compiler.reset()


class Shifted(nn.Module):
    """A model with a parameter in front of a tracker, and more behind it."""

    def __init__(self, tracker: nn.Module) -> None:
        super().__init__()
        self.tracker = tracker
        self.shift = nn.Parameter(torch.zeros(2, dtype=torch.float64))

    def forward(self, keypoints: Tensor) -> Tensor:
        return 2 * self.tracker(keypoints=keypoints + self.shift, names=self.names).joints3d

    names: tuple[str, ...] = NAMES


class Live(nn.Module):
    """A model that makes one step of a stream."""

    def __init__(self, tracker: torchpose.UpperBodyTracker) -> None:
        super().__init__()
        self.tracker = tracker

    def forward(self, state: object, frame: Tensor) -> tuple[object, Tensor]:
        state, pose = self.tracker.step(state, 1.0 * frame)
        return state, 2 * pose.joints3d


@pytest.mark.parametrize("method", ["window-mixture", None])
@pytest.mark.usefixtures("fresh_compiler")
def test_upper_bodies_are_the_same_in_a_compiled_model(keypoints, method):
    prior = torchpose.load_prior("kinect-upper-body-small")
    model = Shifted(torchpose.UpperBodyTracker(prior, prior.camera, method))
    plain = model(keypoints)
    compiled = torch.compile(model, backend="eager")(keypoints)
    torch.testing.assert_close(compiled, plain, rtol=0, atol=0)
    if method is not None:
        expected = torch.autograd.grad(plain.sum(), model.shift)
        torch.testing.assert_close(torch.autograd.grad(compiled.sum(), model.shift), expected)


@pytest.mark.usefixtures("fresh_compiler")
def test_a_compiled_model_tracks_a_stream(keypoints):
    prior = torchpose.load_prior("kinect-upper-body-small")
    model = Live(torchpose.UpperBodyTracker(prior, prior.camera))
    compiled = torch.compile(model, backend="eager")
    state = other = model.tracker.init(1, NAMES)
    for frame in keypoints.unbind(1):
        state, plain = model(state, frame)
        other, pose = compiled(other, frame)
        torch.testing.assert_close(pose, plain, rtol=0, atol=0)


@pytest.mark.usefixtures("fresh_compiler")
def test_whole_bodies_are_the_same_in_a_compiled_model():
    rig = CameraRig([
        PinholeCamera(900, 900, 639.5, 359.5, 1280, 720, name, rotation=(0, turn, 0), translation=(0, 0, 3))
        for name, turn in (("front", math.pi), ("side", math.pi / 2))
    ])  # fmt: skip
    states = torch.zeros(6, 36, dtype=torch.float64)
    states[:, 3] = math.pi
    keypoints = rig(Body.of_height(BODY_15, 1.75).joints(states)).pixels
    model = Shifted(torchpose.BodyTracker(rig, "kalman", fps=30))
    model.names = BODY_15.names
    compiled = torch.compile(model, backend="eager")(keypoints)
    torch.testing.assert_close(compiled, model(keypoints), rtol=0, atol=0)
