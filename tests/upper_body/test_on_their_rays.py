import torch

from torchpose.camera import project
from torchpose.math import euler_to_matrix
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body._fusion import ReadOut, on_their_rays

K = torch.tensor([[525.0, 0, 320], [0, 525, 240], [0, 0, 1]], dtype=torch.float64)
HAND, ELBOW, HEAD = (UPPER_BODY.index(n) for n in ("hand_left", "elbow_right", "head"))


def reading(seed=0):
    """Poses of two sequences of three frames whose pixels are some way off their joints."""
    g = torch.Generator().manual_seed(seed)
    kind = {"generator": g, "dtype": torch.float64}
    joints = 0.3 * torch.randn(2, 3, 8, 3, **kind)
    angles = 0.2 * torch.randn(2, 3, 3, **kind)
    place = torch.tensor([0.1, -0.2, 2.0], dtype=torch.float64) + 0.1 * torch.randn(2, 3, 3, **kind)
    exact = project(joints, K, euler_to_matrix(angles, "zxy"), place)[..., :2]
    uv = exact + 20 * torch.randn(2, 3, 8, 2, **kind)
    covs = torch.eye(3, dtype=torch.float64).expand(2, 3, 8, 3, 3)
    return ReadOut(joints, covs, angles, place, uv, covs[..., :2, :2]), exact


def test_what_was_measured_is_where_it_was_seen_and_what_was_not_is_seen_where_it_is():
    before, exact = reading()
    observed = torch.zeros(2, 3, 8, dtype=torch.bool)
    observed[:, :, [HAND, HEAD]] = True
    observed[1, 2, ELBOW] = True
    after = on_their_rays(before, K, "zxy", observed)
    torch.testing.assert_close(after.uv[observed], before.uv[observed])
    left = torch.tensor([not name.endswith("right") for name in UPPER_BODY])
    inferred = ~observed & left
    torch.testing.assert_close(after.uv[inferred], exact[inferred])
    untouched = ~observed & ~left
    torch.testing.assert_close(after.uv[untouched], before.uv[untouched], rtol=0, atol=0)
    rotation = euler_to_matrix(before.angles, "zxy")
    seen = project(after.joints, K, rotation, before.place)
    moved = observed.clone()
    moved[..., HEAD] = False
    torch.testing.assert_close(seen[moved][:, :2], before.uv[moved])
    depth = project(before.joints, K, rotation, before.place)[..., 2]
    torch.testing.assert_close(seen[..., 2], depth)
    torch.testing.assert_close(after.joints[~moved], before.joints[~moved], rtol=0, atol=0)


def test_joints_behind_the_camera_stay():
    before, _ = reading()
    before = before._replace(place=before.place * torch.tensor([1.0, 1, -1]))
    observed = torch.ones(2, 3, 8, dtype=torch.bool)
    after = on_their_rays(before, K, "zxy", observed)
    assert torch.equal(after.joints, before.joints)
    assert torch.equal(after.uv, before.uv)
