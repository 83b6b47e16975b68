"""Radii fitted to silhouettes of a body of known shape."""

import numpy as np
import pytest
import torch

from tests.body.test_kinematics import random_states
from torchpose.body import BODY_15, Body
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.errors import InputError, ShapeError
from torchpose.whole_body import count_pixels, render
from torchpose.whole_body._silhouettes.likelihood import intersection_over_union
from torchpose.whole_body._silhouettes.shape import fit_radii

FACTORS = {
    "thigh": 1.3,
    "shank": 1.2,
    "upper_arm": 0.8,
    "forearm": 1.25,
    "spine": 1.1,
    "head": 1.15,
}


def front_and_side():
    """Cameras 3 m before and beside the origin of y-up axes, 160 x 120."""
    front = PinholeCamera(130, 130, 79.5, 59.5, 160, 120, "front",
                          rotation=(np.pi, 0, 0), translation=(0, 0, 3))  # fmt: skip
    side = PinholeCamera(130, 130, 79.5, 59.5, 160, 120, "side",
                         rotation=tuple(np.pi / np.sqrt(2) * np.array([1, 0, -1])),
                         translation=(0, 0, 3))  # fmt: skip
    return CameraRig([front, side])


def scene(n_frames=6):
    """A body, its states, and silhouettes of another shape of it."""
    body = Body.of_height(BODY_15, 1.75)
    states = random_states(body, n_frames, scale=0.15)
    states[:, :3] *= 0.3
    kinds = [limb.name.removeprefix("left_").removeprefix("right_") for limb in BODY_15.limbs]
    factors = torch.tensor([FACTORS.get(kind, 1.0) for kind in kinds], dtype=torch.float64)
    truth = body.altered(radii=body.radii * factors[:, None])
    return body, states, truth, render(truth, states, front_and_side(), 120, 160)


def overlap(body, states, silhouettes):
    counts = count_pixels(body, states, front_and_side(), silhouettes)
    return float(intersection_over_union(counts).mean())


def test_the_shape_comes_back():
    body, states, truth, silhouettes = scene()
    found = fit_radii(body, states, silhouettes, front_and_side(), seed=1)
    before, after = overlap(body, states, silhouettes), overlap(found, states, silhouettes)
    assert before < 0.92 and after > 0.97
    for kind in ("thigh", "shank", "upper_arm", "head"):
        limb = [limb.name.removeprefix("left_") for limb in BODY_15.limbs].index(kind)
        ratio = float(found.radii[limb, 0] / truth.radii[limb, 0])
        assert ratio == pytest.approx(1.0, abs=0.15), kind
    sides = list(BODY_15.mirrored_limbs)
    assert torch.equal(found.radii[sides], found.radii)
    assert torch.equal(found.joint_weights, body.joint_weights)


def test_seeds_and_a_body_that_fits_already():
    body, states, truth, silhouettes = scene(2)
    few = {"n_candidates": 12, "n_rounds": 2}
    same = [fit_radii(body, states, silhouettes, front_and_side(), 3, **few) for _ in range(2)]
    assert torch.equal(same[0].radii, same[1].radii)
    kept = fit_radii(truth, states, silhouettes, front_and_side(), 0, **few)
    assert overlap(kept, states, silhouettes) == 1.0


def test_bad_input():
    body, states, _, silhouettes = scene(2)
    rig = front_and_side()
    with pytest.raises(ShapeError, match="as many states as silhouettes"):
        fit_radii(body, states[:1], silhouettes, rig)
    with pytest.raises(InputError, match="all silhouettes are empty"):
        fit_radii(body, states, torch.zeros_like(silhouettes), rig)
    with pytest.raises(InputError, match="n_candidates >= 4"):
        fit_radii(body, states, silhouettes, rig, n_candidates=1)
    batched = body.altered(radii=body.radii.expand(3, -1, -1))
    with pytest.raises(ShapeError, match="radii"):
        fit_radii(batched, states, silhouettes, rig)
