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
