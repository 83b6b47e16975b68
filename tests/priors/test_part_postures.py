"""Postures from the rotations of parts against those of the joints."""

import pytest
import torch

from torchpose.body import BODY_15, Body
from torchpose.errors import ShapeError
from torchpose.priors._actions.part_postures import PartPostures
from torchpose.priors._actions.postures import posture_angles

G = torch.Generator().manual_seed(0)


def bodies():
    plain = Body.of_height(BODY_15, 1.75)
    lengths = BODY_15.standard_lengths(1.6)
    turned = torch.tensor(BODY_15.directions).double()
    turned = turned + 0.1 * torch.randn(15, 3, generator=G, dtype=torch.float64)
    other = Body(BODY_15, lengths, BODY_15.standard_radii(1.6), directions=turned)
    centres = 0.3 * torch.randn(11, 3, generator=G, dtype=torch.float64)
    centres[0] = 0
    for body in (plain, other):
        for frame in ("parent", "body"):
            yield body.altered(frame=frame)
            yield body.altered(frame=frame, centres=centres)


@pytest.mark.parametrize("body", list(bodies()), ids=str)
def test_angles_are_those_of_the_joints(body):
    states = 0.25 * torch.randn(300, 36, generator=G, dtype=torch.float64)
    expected = posture_angles(body.joints(states))
    found = PartPostures(body, torch.float64)(states)
    assert (found - expected).abs().max() < 1e-6
    single = PartPostures(body)(states)
    assert single.dtype == torch.float32 and (single - expected).abs().max() < 0.1


def test_gradients_are_finite_at_right_angles_and_half_turns():
    """Where those of arcsin and of the quaternion's scalar part are infinite they are 0, as of joints."""
    body = Body.of_height(BODY_15, 1.75)
    states = torch.zeros(3, 36, dtype=torch.float64)  # at rest legs hang at right angles
    states[1, 6:9] = torch.tensor([0.0, 1.0, 0.0])
    states[2] = 0.1 * torch.randn(36, generator=torch.Generator().manual_seed(0)).double()
    slopes = []
    for postures in (PartPostures(body, torch.float64), lambda x: posture_angles(body.joints(x))):
        given = states.clone().requires_grad_()
        angles = postures(given)
        assert angles[0].abs().max() == 90
        (slope,) = torch.autograd.grad(angles.sum(), given)
        assert slope.isfinite().all() and slope[[0, 2]].abs().amax(1).min() > 1
        slopes.append(slope)
    torch.testing.assert_close(slopes[0][[0, 2]], slopes[1][[0, 2]], rtol=1e-7, atol=1e-7)


def test_many_states_in_chunks_and_few(monkeypatch):
    postures = PartPostures(Body.of_height(BODY_15, 1.75))
    states = 0.2 * torch.randn(50, 36, generator=G)
    whole = postures(states)
    monkeypatch.setattr("torchpose.priors._actions.part_postures._CHUNK", 7)
    assert torch.equal(postures(states), whole)
    assert torch.equal(postures.of_relative(states[:, 6:]), whole)
    assert postures(states[:0]).shape == (0, 36)
    with pytest.raises(ShapeError, match="states must have shape"):
        postures(states[:, :30])
