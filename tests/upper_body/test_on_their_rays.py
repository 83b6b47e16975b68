import torch

from torchpose.camera import project
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body._estimator import SeenPoses
from torchpose.upper_body._fusion import on_their_rays

K = torch.tensor([[525.0, 0, 320], [0, 525, 240], [0, 0, 1]], dtype=torch.float64)
HAND, ELBOW, HEAD = (UPPER_BODY.index(n) for n in ("hand_left", "elbow_right", "head"))


def poses(seed=0):
    """Poses of two sequences of three frames whose pixels are some way off their joints."""
    g = torch.Generator().manual_seed(seed)
    kind = {"generator": g, "dtype": torch.float64}
    place = torch.tensor([0.1, -0.2, 2.0], dtype=torch.float64) + 0.1 * torch.randn(2, 3, 3, **kind)
    joints = place[:, :, None] + 0.3 * torch.randn(2, 3, 8, 3, **kind)
    exact = seen(joints)[..., :2]
    uv = exact + 20 * torch.randn(2, 3, 8, 2, **kind)
    covs = torch.eye(3, dtype=torch.float64).expand(2, 3, 8, 3, 3)
    shares = torch.ones(2, 3, 1, dtype=torch.float64)
    return SeenPoses(joints, covs, covs[:, :, :1], shares, place, uv, covs[..., :2, :2]), exact


def seen(joints):
    """Pixels and depth of joints in camera axes."""
    return project(joints, K, torch.eye(3).double(), torch.zeros(3).double())


def test_what_was_measured_is_where_it_was_seen_and_what_was_not_is_seen_where_it_is():
    before, exact = poses()
    observed = torch.zeros(2, 3, 8, dtype=torch.bool)
    observed[:, :, [HAND, HEAD]] = True
    observed[1, 2, ELBOW] = True
    after = on_their_rays(before, K, observed)
    torch.testing.assert_close(after.uv[observed], before.uv[observed])
    left = torch.tensor([not name.endswith("right") for name in UPPER_BODY])
    inferred = ~observed & left
    torch.testing.assert_close(after.uv[inferred], exact[inferred])
    untouched = ~observed & ~left
    torch.testing.assert_close(after.uv[untouched], before.uv[untouched], rtol=0, atol=0)
    found = seen(after.joints)
    moved = observed.clone()
    moved[..., HEAD] = False
    torch.testing.assert_close(found[moved][:, :2], before.uv[moved])
    torch.testing.assert_close(found[..., 2], before.joints[..., 2])
    torch.testing.assert_close(after.joints[~moved], before.joints[~moved], rtol=0, atol=0)


def test_joints_behind_the_camera_stay():
    before, _ = poses()
    before = before._replace(joints=before.joints * torch.tensor([1.0, 1, -1]))
    observed = torch.ones(2, 3, 8, dtype=torch.bool)
    after = on_their_rays(before, K, observed)
    assert torch.equal(after.joints, before.joints)
    assert torch.equal(after.uv, before.uv)
