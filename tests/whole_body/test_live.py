import math

import numpy as np
import pytest
import torch

from torchpose.body import BODY_15, Body
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.errors import InputError, ShapeError
from torchpose.learning import fit_limb_conditionals
from torchpose.priors._limb_conditionals import in_body_frame
from torchpose.whole_body import (
    AnnealedParticleFilter,
    RootUncertaintyTracker,
    SilhouetteParticleFilter,
    SIRParticleFilter,
    render,
    track_body,
)
from torchpose.whole_body._filters.body_particles import BodyFilterState, joint_covariance
from torchpose.whole_body._filters.root_uncertainty import joint_covariance_with_parts


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
    together = model(silhouettes, rig, states[0], generator=torch.Generator().manual_seed(3))
    found = track_body(
        model,
        iter(silhouettes),
        rig,
        states[0],
        generator=torch.Generator().manual_seed(3),
        fps=60.0,
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


def uncertain_parts():
    """Two persons' hypotheses with a Gaussian per part, in a body of odd centres."""
    g = torch.Generator().manual_seed(4)

    def normal(*shape):
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    centres = 0.3 * normal(11, 3)
    centres[0] = 0
    body = Body.of_height(BODY_15, 1.75).altered(frame="body", centres=centres)
    particles = 0.1 * normal(2, 4, body.dim)
    log_weights = normal(2, 4).log_softmax(-1)
    factor = 0.04 * normal(2, 4, 10, 3, 3)
    mean = particles[:, 1]
    state = BodyFilterState(
        particles, log_weights, mean, torch.zeros(2, dtype=torch.long), factor @ factor.mT
    )
    return body, state, factor, mean


def test_covariance_of_joints_has_that_within_hypotheses():
    body, state, factor, mean = uncertain_parts()
    found = joint_covariance_with_parts(body, state, state.memory, mean)
    assert torch.equal(found, found.mT)
    # by Monte Carlo: every part of every hypothesis drawn many times
    g, draws = torch.Generator().manual_seed(5), 6000
    noise = torch.randn(draws, 4, 10, 3, 1, generator=g, dtype=torch.float64)
    for b in range(2):
        drawn = state.particles[b].expand(draws, -1, -1).clone()
        drawn[..., 6:] += (factor[b] @ noise).flatten(-3)
        away = (body.joints(drawn) - body.joints(mean[b])).numpy()
        weights = state.log_weights[b].exp().numpy() / draws
        expected = np.einsum("n,snji,snjk->jik", weights, away, away)
        scale = np.trace(expected, axis1=1, axis2=2)[:, None, None]
        np.testing.assert_allclose(found[b].numpy() / scale, expected / scale, atol=0.03)
    between = joint_covariance(body, state, mean)
    more = (found - between).diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
    wrist = BODY_15.joint("left_wrist")
    assert bool((more[:, wrist] > 0.02).all())  # metres: limbs are as uncertain as that
    assert float(more[:, BODY_15.joint("pelvis")].max()) < 1e-9


def test_without_spread_within_they_are_the_particles_alone():
    body, state, _, mean = uncertain_parts()
    nothing = torch.zeros_like(state.memory)
    torch.testing.assert_close(
        joint_covariance_with_parts(body, state, nothing, mean), joint_covariance(body, state, mean)
    )
    upright = body.altered(frame="parent")
    with pytest.raises(InputError, match="frame='body', got 'parent'"):
        joint_covariance_with_parts(upright, state, nothing, mean)
    with pytest.raises(ShapeError, match="covariances"):
        joint_covariance_with_parts(body, state, nothing[:, :, :9], mean)


def test_the_root_tracker_tells_the_covariance_of_both(scene, monkeypatch):
    upright, rig, states, silhouettes = scene
    g = torch.Generator().manual_seed(0)
    moves = 0.1 * torch.randn(40, upright.dim, generator=g, dtype=torch.float64)
    body, recorded = in_body_frame([(upright, [moves])])
    model = RootUncertaintyTracker(body, fit_limb_conditionals(body, recorded, 60.0), 8, fps=60.0)
    start = upright.convert(states[0], body)

    def covariance():
        seed = torch.Generator().manual_seed(1)
        return track_body(model, iter(silhouettes[:2]), rig, start, generator=seed).covariance3d

    both = covariance()
    monkeypatch.setattr(
        RootUncertaintyTracker, "joint_covariance", SilhouetteParticleFilter.joint_covariance
    )
    more = (both - covariance()).diagonal(dim1=-2, dim2=-1).sum(-1)
    assert bool((more[:, BODY_15.joint("right_ankle")] > 1e-5).all())
    assert bool((torch.linalg.eigvalsh(both) > -1e-12).all())


def test_bad_input_is_refused(scene):
    body, rig, states, _ = scene
    with pytest.raises(InputError, match="at least one frame"):
        track_body(SIRParticleFilter(body, 10), iter(()), rig, states[0])
