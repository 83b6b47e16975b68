"""Arms do not go where shoulders and elbows do not bend."""

import math

import pytest
import torch

from torchpose import PinholeCamera, UpperBodyTracker, load_prior
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body._arm_reach import loss_beyond_reach
from torchpose.upper_body._limb_nodes import LimbNodes

HANGING, AHEAD, BACK, OUT = (0.0, 1.0, 0.0), (0.0, 0.0, -1.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)


def _node(direction, *batch):
    """The only node of a limb, as if its axes were the direction alone."""
    axes = torch.tensor(direction, dtype=torch.float64).expand(*batch, 1, 3)
    turns = torch.ones(1, 1, dtype=torch.float64)
    none = torch.zeros(*batch, 1, dtype=torch.float64)
    return LimbNodes(none.expand(*batch, 3), none[..., 0], axes, turns, none)


def _loss(upper, lower):
    return float(loss_beyond_reach(_node(upper, 1), _node(lower, 1, 1)))


@pytest.mark.parametrize(
    ("upper", "lower"),
    [
        (HANGING, HANGING),
        (HANGING, AHEAD),
        (AHEAD, AHEAD),
        (OUT, OUT),
        (OUT, (0.0, -1.0, 0.0)),
        ((0.0, 0.5, math.sqrt(0.75)), (0.0, 0.5, math.sqrt(0.75))),  # swung back by 60 degrees
        (HANGING, (-0.98, 0.0, 0.19)),  # a hand behind the hip
    ],
)
def test_poses_that_people_have_lose_nothing(upper, lower):
    assert _loss(upper, lower) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("upper", "lower"), [(BACK, BACK), (HANGING, BACK), ((0.6, 0.0, 0.8), OUT), (BACK, AHEAD)]
)
def test_poses_that_nobody_has_lose_much_and_not_all(upper, lower):
    assert 3.0 < _loss(upper, lower) <= 16.0


def test_each_node_of_a_forearm_is_weighed_with_its_own_upper_arm():
    generator = torch.Generator().manual_seed(0)
    axes = torch.randn(2, 4, 2, 3, generator=generator).double()
    turns = torch.randn(5, 2, generator=generator).double()
    upper = LimbNodes(
        torch.zeros(2, 3).double(), torch.ones(2), axes[:, 0], turns[:4], torch.zeros(2, 4)
    )
    lower = LimbNodes(
        torch.zeros(2, 4, 3).double(), torch.ones(2, 4), axes, turns, torch.zeros(2, 4, 5)
    )
    found = loss_beyond_reach(upper, lower)
    for i in range(2):
        for u in range(4):
            for g in range(5):
                one = _loss(upper.directions[i, u].tolist(), lower.directions[i, u, g].tolist())
                assert float(found[i, u, g]) == pytest.approx(one, abs=1e-9)


def test_gradients_are_those_of_finite_differences():
    axes = torch.tensor([[[[0.3, 0.6, 0.74]]]], dtype=torch.float64, requires_grad=True)
    hanging = _node((0.1, 0.4, 0.9), 1)

    def loss(forearm):
        none = torch.zeros(1, 1, 1).double()
        turns = torch.tensor([[1.0], [0.9]], dtype=torch.float64)
        return loss_beyond_reach(hanging, LimbNodes(none, none[0], forearm, turns, none))

    assert float(loss(axes.detach()).min()) > 0.1
    assert torch.autograd.gradcheck(loss, (axes,))


def test_arms_that_are_raised_towards_the_camera_do_not_go_behind_the_back():
    """Arms and neck alone are measured: nothing but what arms can do tells front from back."""
    n, upper, lower, wide = 60, 0.28, 0.25, 0.36
    angle = torch.linspace(0.0, math.radians(180.0), n, dtype=torch.float64)
    angle = angle.clamp_max(math.radians(88.0))  # they stay there for a second
    way = torch.stack([0.1 * torch.ones(n).double(), angle.cos(), -angle.sin()], -1)
    way = way / way.norm(dim=-1, keepdim=True)
    joints = {"neck": torch.zeros(n, 3).double()}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        own = way * torch.tensor([sign, 1.0, 1.0])
        joints[f"shoulder_{side}"] = torch.tensor([sign * wide / 2, 0.0, 0.0]).double().expand(n, 3)
        joints[f"elbow_{side}"] = joints[f"shoulder_{side}"] + upper * own
        joints[f"wrist_{side}"] = joints[f"elbow_{side}"] + lower * own
    camera = PinholeCamera(1050.0, 1050.0, 959.5, 539.5)
    places = torch.stack([*joints.values()], 1) + torch.tensor([0.0, 0.0, 3.0])
    pixels = 1050.0 * places[..., :2] / places[..., 2:] + torch.tensor([959.5, 539.5])
    noise = torch.randn(4, *pixels.shape, generator=torch.Generator().manual_seed(0)).double()
    tracker = UpperBodyTracker(load_prior("kinect-upper-body"), camera, "articulated")
    with torch.inference_mode():
        track = tracker(pixels + 4.0 * noise, names=[*joints])
    row = UPPER_BODY.index
    for side in ("left", "right"):
        found = (
            track.joints3d[:, :, row(f"elbow_{side}")]
            - track.joints3d[:, :, row(f"shoulder_{side}")]
        )
        assert float((found[:, 40:, 2] < 0).double().mean()) > 0.9
