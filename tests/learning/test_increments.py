"""Second moments of recorded steps against the Jacobian of the projection, worked out by hand."""

import numpy as np
import torch

from torchpose.camera import ViewRange
from torchpose.io import Recording
from torchpose.learning._training import collect_poses
from torchpose.learning._upper_body_prior_fit import increment_covs
from torchpose.skeleton import UPPER_BODY

F, CX, CY, DEPTH = 500.0, 320.0, 240.0, 2.0
MATRIX = torch.tensor([[F, 0.0, CX], [0.0, F, CY], [0.0, 0.0, 1.0]], dtype=torch.float64)
FRONT = ViewRange(0.0, 0.0, 0.0, (0.0, 0.0), (0.0, 0.0), (DEPTH, DEPTH))
ANGLE = 0.03**2  # what is added for the camera's angles at 30 frames per second
HAND, NECK = UPPER_BODY.index("hand_left"), UPPER_BODY.index("neck")
BODY = torch.tensor(
    [
        [0.4, 0.3, -0.2], [0.3, 0.2, -0.1], [0.2, 0.05, 0.0], [0.0, -0.2, 0.0],
        [0.0, 0.0, 0.0], [-0.2, 0.05, 0.0], [-0.3, 0.2, 0.1], [-0.4, 0.3, 0.1],
    ],
    dtype=torch.float64,
)  # fmt: skip


def pairs(moves, fps=30.0):
    """A recording of the body and the body with some joints moved, a gap, and so on."""
    gap = torch.full_like(moves, torch.nan)
    joints = torch.stack([BODY.expand_as(moves), BODY + moves, gap], 1).flatten(0, 1)
    return [Recording(joints, UPPER_BODY, fps, "p1", source="x@0:a")]


def covs(recordings, mirror=False, matrix=MATRIX):
    poses = collect_poses(recordings, None, "sequence")
    return increment_covs(poses, matrix, FRONT, "zxy", mirror, 0)


def slope(point, f=F):
    """d(u, v, lambda) / d(x, y, z) of a point in camera axes, by hand."""
    x, y, z = point
    return np.array([[f / z, 0, -f * x / z**2], [0, f / z, -f * y / z**2], [0, 0, 1.0]])


def steps(n, cov, joints, seed=0):
    """[n, 8, 3], Gaussian steps of some joints, the same for all of them."""
    drawn = np.random.default_rng(seed).multivariate_normal(np.zeros(3), cov, n)
    moves = torch.zeros(n, 8, 3, dtype=torch.float64)
    moves[:, joints] = torch.from_numpy(drawn)[:, None]
    return moves


def test_a_walk_of_the_hand_gives_its_own_covariance():
    cov = 1e-6 * np.array([[4.0, 1.0, 0.0], [1.0, 3.0, -1.0], [0.0, -1.0, 2.0]])  # millimetres
    found = covs(pairs(steps(4000, cov, [HAND])))
    jacobian = slope(BODY[HAND].numpy() + np.array([0, 0, DEPTH]))
    expected = torch.zeros(21, 21, dtype=torch.float64)
    expected[:3, :3] = torch.from_numpy(jacobian @ cov @ jacobian.T)
    expected[15:18, 15:18] = ANGLE * torch.eye(3)
    scale = expected.diagonal().sqrt().clamp_min(1e-3)
    error = (found["left"] - expected) / (scale * scale[:, None])
    assert error.abs().max() < 0.1
    assert found["right"][:15, :15].abs().max() < 1e-20  # that arm rests


def test_steps_of_the_whole_body_move_the_camera_and_every_joint_with_it():
    cov = 1e-6 * np.diag([9.0, 4.0, 1.0])
    found = covs(pairs(steps(4000, cov, list(range(8)))))["left"]
    place = found[18:, 18:].numpy()
    np.testing.assert_allclose(place, cov, atol=0.1 * 9e-6)
    np.testing.assert_allclose(found[12, 18], F / DEPTH * cov[0, 0], rtol=0.1)  # u of the neck
    np.testing.assert_allclose(found[14, 20], cov[2, 2], rtol=0.1)  # lambda of the neck is tz


def test_pixels_grow_with_the_focal_length_and_shrink_with_the_distance():
    moves = pairs(steps(50, 1e-6 * np.eye(3), [HAND]))
    wide = MATRIX.clone()
    wide[0, 0] = wide[1, 1] = 2 * F
    near, tele = covs(moves)["left"], covs(moves, matrix=wide)["left"]
    torch.testing.assert_close(tele[:2, :2], 4 * near[:2, :2])
    torch.testing.assert_close(tele[2, 2], near[2, 2])


def test_a_step_counts_in_proportion_to_its_interval():
    moves = steps(40, 1e-6 * np.eye(3), [HAND])
    slow, fast = covs(pairs(moves, 15.0))["left"], covs(pairs(moves, 60.0))["left"]
    torch.testing.assert_close(slow[:3, :3], fast[:3, :3])  # each per frame at its own rate
    torch.testing.assert_close(slow[15, 15], 4 * fast[15, 15])
    both = covs(pairs(moves.repeat(2, 1, 1), 30.0) + pairs(moves, 60.0))["left"]
    torch.testing.assert_close(both[:3, :3], (2 + 2) / 3 * slow[:3, :3])


def test_steps_lead_neither_across_gaps_nor_from_one_recording_to_the_next():
    far = torch.zeros(8, 3, dtype=torch.float64)
    far[HAND] = 0.3
    gap = torch.stack([BODY, torch.full_like(BODY, torch.nan), BODY + far, BODY + far])
    first = Recording(gap, UPPER_BODY, 30.0, "p1", source="x@0:a")
    second = Recording(torch.stack([BODY, BODY]), UPPER_BODY, 30.0, "p1", source="x@0:b")
    assert covs([first, second])["left"][:15, :15].abs().max() < 1e-20
    assert covs([Recording(BODY[None], UPPER_BODY, 30.0, "p1", source="x@0:c")]) == {}


def test_mirrored_arms_pool_both_and_are_mirror_images():
    cov = 1e-6 * np.array([[4.0, 1.0, 0.0], [1.0, 3.0, -1.0], [0.0, -1.0, 2.0]])
    found = covs(pairs(steps(200, cov, [HAND])), mirror=True)
    one_arm = covs(pairs(steps(200, cov, [HAND])))["left"]
    torch.testing.assert_close(found["left"][:3, :3], one_arm[:3, :3] / 2)  # the right one rests
    sign = torch.ones(21, dtype=torch.float64)
    sign[[0, 3, 6, 9, 12, 15, 17, 18]] = -1
    torch.testing.assert_close(found["right"], found["left"] * sign * sign[:, None])
    for other in (HAND, UPPER_BODY.index("hand_right")):  # a hand that was never recorded
        recordings = pairs(steps(200, cov, [HAND, UPPER_BODY.index("hand_right")]))
        recordings[0].joints[:, other] = torch.nan
        alone, one_arm = covs(recordings, mirror=True), covs(recordings)
        ((side, own),) = one_arm.items()
        torch.testing.assert_close(alone[side], own)
        torch.testing.assert_close(alone["right"], alone["left"] * sign * sign[:, None])
