"""Arm states against a camera written out by hand, and the mirror against a mirrored body."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.priors.poses import REST, poses
from torchpose.camera import sample_viewpoints
from torchpose.camera._viewpoints import Viewpoints
from torchpose.errors import InputError, PriorError, ShapeError
from torchpose.learning import TRAINING_VIEWS
from torchpose.priors import GaussianMixture
from torchpose.priors._arm_state import arm_state, arm_states, mirror_arm_state, mirror_mixture

MATRIX = torch.tensor([[525.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]], dtype=torch.float64)
LEFT, RIGHT = [0, 1, 2, 3, 4], [7, 6, 5, 3, 4]
FLIP = torch.tensor([-1.0, 1, 1], dtype=torch.float64)


def centred(n):
    joints = poses(n)
    return joints - joints[:, 4:5]


def views(n, seed=0):
    return sample_viewpoints(n, TRAINING_VIEWS, torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("order", ["zxy", "zyx"])
def test_states_are_scipys_rotations_and_a_pinhole(order):
    joints, seen = centred(20), views(20)
    left, right = arm_states(joints, seen, MATRIX, order)
    roll, pitch, yaw = seen.angles.numpy().T
    turns = np.stack([roll, pitch, yaw] if order == "zxy" else [roll, yaw, pitch], 1)
    rotation = Rotation.from_euler(order.upper(), turns).as_matrix()
    camera = np.einsum("nij,nkj->nki", rotation, joints) + seen.translation.numpy()[:, None]
    pixels = camera @ MATRIX.numpy().T
    uvl = np.concatenate([pixels[..., :2] / pixels[..., 2:], pixels[..., 2:]], -1)
    for state, arm in ((left, LEFT), (right, RIGHT)):
        np.testing.assert_allclose(state[:, :15], uvl[:, arm].reshape(20, 15), rtol=1e-12)
        assert torch.equal(state[:, 15:18], seen.angles)
        assert torch.equal(state[:, 18:], seen.translation)


@pytest.mark.parametrize("order", ["zxy", "zyx"])
def test_mirrored_state_is_the_mirrored_body_from_the_mirrored_view(order):
    joints, seen = centred(20), views(20)
    state = arm_state(joints[:, LEFT], seen, MATRIX, order)
    sign = torch.tensor([-1.0, 1, -1], dtype=torch.float64)  # roll, pitch, yaw
    other = Viewpoints(seen.angles * sign, seen.translation * FLIP)
    expected = arm_state(joints[:, LEFT] * FLIP, other, MATRIX, order)
    torch.testing.assert_close(mirror_arm_state(state, 319.5), expected)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.floats(-1000, 1000))
def test_mirror_undoes_itself(seed, cx):
    state = torch.randn(3, 21, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    torch.testing.assert_close(mirror_arm_state(mirror_arm_state(state, cx), cx), state)


def test_mirrored_mixture_has_the_density_of_mirrored_states():
    states = arm_states(centred(400), views(400), MATRIX)[0]
    mixture = GaussianMixture.fit(states, 3)
    mirrored = mirror_mixture(mixture, 319.5)
    torch.testing.assert_close(
        mirrored.log_prob(mirror_arm_state(states, 319.5)), mixture.log_prob(states)
    )
    twice = mirror_mixture(mirrored, 319.5)
    torch.testing.assert_close(twice.means, mixture.means)
    assert torch.equal(twice.covariances, mixture.covariances)


def test_bad_input_is_refused():
    seen = views(1)
    with pytest.raises(PriorError, match="zxy, zyx, got 'xyz'"):
        arm_states(REST[None], seen, MATRIX, "xyz")
    with pytest.raises(ShapeError):
        arm_states(REST, seen, MATRIX)
    with pytest.raises(InputError, match="in front of the camera"):
        arm_states(REST[None], seen._replace(translation=seen.translation * 0), MATRIX)
    with pytest.raises(InputError, match="missing joints"):
        arm_states(REST[None] * torch.nan, seen, MATRIX)
    with pytest.raises(ShapeError):
        mirror_arm_state(torch.zeros(20), 0.0)
