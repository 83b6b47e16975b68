import math

import numpy as np
import pytest
import torch

from torchpose.body import BODY_15, Body, render
from torchpose.body_tracking import joint_covariance, track_body
from torchpose.camera import PinholeCamera
from torchpose.camera_rig import CameraRig
from torchpose.errors import InputError
from torchpose.filters import AnnealedParticleFilter, SIRParticleFilter
from torchpose.filters.silhouette_filter import BodyFilterState


@pytest.fixture(scope="module")
def scene():
    """A body that moves aside before two cameras, seen in five frames; nobody in the third."""
    body = Body.of_height(BODY_15, 1.75)
    front = PinholeCamera(80, 80, 39.5, 29.5, 80, 60, "front", rotation=(math.pi, 0, 0),
                          translation=(0, 0, 3))  # fmt: skip
    half = math.pi / math.sqrt(2)
    side = PinholeCamera(80, 80, 39.5, 29.5, 80, 60, "side", rotation=(half, 0, half),
                         translation=(0, 0, 3.2))  # fmt: skip
    rig = CameraRig([front, side])
    states = torch.zeros(5, body.dim, dtype=torch.float64)
    states[:, 0] = torch.linspace(0, 0.08, 5)
    silhouettes = render(body, states, rig, 60, 80)
    silhouettes[2] = False
    return body, rig, states, silhouettes


@pytest.mark.parametrize("kind", [SIRParticleFilter, AnnealedParticleFilter])
def test_frame_by_frame_gives_what_all_frames_give(scene, kind):
    body, rig, states, silhouettes = scene
    model = kind(body, 60)
    together = model(silhouettes, rig, states[0], torch.Generator().manual_seed(3))
    found = track_body(
        model, iter(silhouettes), rig, states[0], torch.Generator().manual_seed(3), fps=60.0
    )
    assert torch.equal(found.state, together.mean)
    assert torch.equal(found.state_std, together.std)
    assert torch.equal(found.coasting, together.coasting)
    assert found.coasting.tolist() == [False, False, True, False, False]
    torch.testing.assert_close(found.log_evidence, together.log_evidence, equal_nan=True)
    torch.testing.assert_close(found.joints3d, body.joints(together.mean))
    assert found.fps == 60
    assert float((found.joints3d - body.joints(states)).norm(dim=-1).mean()) < 0.1


def test_covariance_of_joints_is_that_of_the_particles(scene):
    body = scene[0]
    g = torch.Generator().manual_seed(0)
    particles = 0.1 * torch.randn(2, 30, body.dim, generator=g, dtype=torch.float64)
    log_weights = torch.randn(2, 30, generator=g, dtype=torch.float64).log_softmax(-1)
    mean = body.mean(particles, log_weights)
    state = BodyFilterState(particles, log_weights, mean, torch.zeros(2, dtype=torch.long))
    found = joint_covariance(body, state, mean).numpy()
    for b, j in ((0, 3), (1, 11)):
        expected = np.zeros((3, 3))
        centre = body.joints(mean[b])[j].numpy()
        for n in range(30):
            away = body.joints(particles[b, n])[j].numpy() - centre
            expected += math.exp(float(log_weights[b, n])) * np.outer(away, away)
        np.testing.assert_allclose(found[b, j], expected, atol=1e-12)


def test_bad_input_is_refused(scene):
    body, rig, states, _ = scene
    with pytest.raises(InputError, match="at least one frame"):
        track_body(SIRParticleFilter(body, 10), iter(()), rig, states[0])
