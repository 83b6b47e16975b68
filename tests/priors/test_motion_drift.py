"""Mean accelerations by pose and velocity: their derivatives, axes, and that bodies come to rest."""

import torch

from tests.body.test_articulation import zero_point
from tests.priors.motions import some_body_motion
from torchpose.body._articulation import Articulation
from torchpose.math._rotations import cross_matrix, exponential
from torchpose.priors._motion_drift import drift_at
from torchpose.priors._shipped import load_body_motion
from torchpose.whole_body._keypoints.body_transition import coasting_transition, transition


def moving_body(articulation: Articulation, n: int = 2):
    """Bodies at the centres of their limbs, turned and moving."""
    g = torch.Generator().manual_seed(1)
    point = zero_point(articulation, n)
    velocity = torch.randn(n, articulation.n_pose, generator=g, dtype=torch.float64)
    rotations = point.rotations.clone()
    rotations[:, 0] = exponential(cross_matrix(torch.randn(n, 3, generator=g).double()))
    return point._replace(velocity=velocity, rotations=rotations)


def some_drift(articulation: Articulation) -> torch.Tensor:
    g = torch.Generator().manual_seed(2)
    return torch.randn(articulation.n_pose, 49, generator=g, dtype=torch.float64)


def test_its_derivative_is_that_of_differences():
    body = Articulation()
    point, drift = moving_body(body), some_drift(body)
    found, small = drift_at(body, drift, point), 1e-6
    for column, step in enumerate(small * torch.eye(body.dim, dtype=torch.float64)):
        later, sooner = (
            drift_at(body, drift, body.moved(point, sign * step.expand(2, -1))).acceleration
            for sign in (1, -1)
        )
        slope = (later - sooner) / (2 * small)
        torch.testing.assert_close(found.jacobian[..., column], slope, atol=1e-6, rtol=1e-6)


def test_it_turns_with_the_root():
    """A body that is turned as a whole accelerates in the same way, in axes that are turned."""
    body = Articulation()
    point, drift = moving_body(body), some_drift(body)
    turn = exponential(cross_matrix(torch.tensor([0.3, -1.1, 0.6], dtype=torch.float64)))
    rotations, velocity = point.rotations.clone(), point.velocity.clone()
    rotations[:, 0] = turn @ rotations[:, 0]
    velocity[:, :3] = velocity[:, :3] @ turn.mT
    turned = point._replace(rotations=rotations, velocity=velocity)
    one, other = (drift_at(body, drift, p).acceleration for p in (point, turned))
    torch.testing.assert_close(other[:, :3], one[:, :3] @ turn.mT)
    torch.testing.assert_close(other[:, 3:], one[:, 3:])


def test_a_frame_follows_it():
    """Velocities of a short frame change by the mean acceleration, beside their decay."""
    body = Articulation()
    motion, point = some_body_motion(drift=some_drift(body)), moving_body(body)
    dt = 1e-4
    ahead = transition(motion, dt).ahead(motion, point)
    slope = (ahead.mean.velocity - point.velocity) / dt
    expected = drift_at(body, motion.drift, point).acceleration - motion.decay * point.velocity
    torch.testing.assert_close(slope, expected, rtol=1e-3, atol=1e-2)
    assert ahead.matrix.shape == (2, body.dim, body.dim)


def test_whom_nobody_sees_comes_to_rest():
    """Nothing drives whom nobody sees; of others no motion becomes three times as large in half a minute.

    That is without the pull of poses.
    """
    motion = load_body_motion("whole-body")
    body, up = motion.articulation, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    rest = zero_point(body, 1)
    moving = torch.arange(body.n_pose, 2 * body.n_pose)
    angles = torch.arange(6, body.n_pose)
    rows = torch.cat([angles, moving])
    growth = {}
    for name, model in (
        ("seen", transition(motion, 0.02)),
        ("unseen", coasting_transition(motion, 0.02, up)),
    ):
        matrix = model.ahead(motion, rest).matrix[..., rows, :][..., rows]
        growth[name] = float(torch.linalg.eigvals(matrix).abs().max().log()) / 0.02
    assert growth["unseen"] < 1e-9
    assert growth["seen"] < 1 / 30
