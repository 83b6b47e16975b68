"""Limbs as rectangles against every pixel's place along and across the limb's axis."""

import itertools
import math

import numpy as np
import pytest
import torch

from tests.whole_body.silhouettes.test_rendering import (
    HEIGHT,
    NEAR,
    WIDTH,
    make_rig,
    one_camera,
    random_limbs,
    rods,
)
from torchpose.body import BODY_15, Body, Limbs
from torchpose.camera import CameraRig
from torchpose.errors import InputError
from torchpose.whole_body import count_pixels, render
from torchpose.whole_body._silhouettes.rendering import render_limbs


def slow_rectangle(start, end, radii, K, R, t):
    """Pixels [H, W] within the rectangle of one limb, one after the other."""
    ends = [(R @ X + t, float(r)) for X, r in zip((start, end), radii, strict=True)]
    (A, ra), (B, rb) = ends
    image = np.zeros((HEIGHT, WIDTH), bool)
    if max(A[2], B[2]) < NEAR:
        return image
    if min(A[2], B[2]) < NEAR:
        s = (NEAR - A[2]) / (B[2] - A[2])
        cut = A + s * (B - A), ra + s * (rb - ra)
        (A, ra), (B, rb) = [(X, r) if X[2] >= NEAR else cut for X, r in ends]
    focal = math.sqrt(K[0, 0] * K[1, 1])
    a, b = (K @ A)[:2] / A[2], (K @ B)[:2] / B[2]
    half = focal * (ra / A[2] + rb / B[2]) / 2
    length = math.hypot(*(b - a))
    axis = (b - a) / length if length > 1e-9 else np.array([0.0, 1.0])
    for i, j in itertools.product(range(HEIGHT), range(WIDTH)):
        p = np.array([j, i]) - (a + b) / 2
        along, across = abs(p @ axis), abs(p[0] * axis[1] - p[1] * axis[0])
        image[i, j] = along <= length / 2 + math.pi / 4 * half and across <= half
    return image


def slow_render(limbs, rig):
    n, n_limbs = limbs.start.shape[:2]
    radii = limbs.radii.expand(n, n_limbs, 2)
    out = np.zeros((n, len(rig), HEIGHT, WIDTH), bool)
    for item, c, k in itertools.product(range(n), range(len(rig)), range(n_limbs)):
        camera = (x[c].numpy() for x in (rig.matrix, rig.rotation, rig.translation))
        parts = (x[item, k].numpy() for x in (limbs.start, limbs.end, radii))
        out[item, c] |= slow_rectangle(*parts, *camera)
    return torch.from_numpy(out)


@pytest.mark.parametrize("seed", range(3))
def test_rectangles_are_exact(seed):
    limbs, rig = random_limbs(3, seed=seed), make_rig(2)
    expected = slow_render(limbs, rig)
    image = render_limbs(limbs, rig, HEIGHT, WIDTH, limb_shape="rectangles")
    assert torch.equal(image, expected)
    silhouettes = torch.rand(2, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(seed)) < 0.5
    counts = count_pixels(limbs, None, rig, silhouettes, limb_shape="rectangles", chunk=2)
    assert torch.equal(counts.model, expected.sum((-2, -1)))
    assert torch.equal(counts.overlap, (expected & silhouettes).sum((-2, -1)))


@pytest.mark.parametrize(
    "limb",
    [
        (0, 0, 0, 0.2, 0, 0, 0, 0.1),  # no length
        (0, 0, 0, 0.1, 0, 0, 1.0, 0.1),  # along the optical axis
        (-0.3, 0, 0, 0.1, 0.3, 0, 0, 0.1),  # level: two sides without rise
        (-0.3, 0, 0, 0.2, 0.3, 1e-12, 0, 0.2),  # nearly level
        (0, -0.3, 0, 0.1, 0, 0.3, 0, 0.1),  # upright
        (-3, 0.1, 0, 0.1, 3, 0.3, 0, 0.2),  # beyond both sides
        (0.2, -3, 0, 0.1, 0, 3, 0, 0.3),  # beyond top and bottom
        (0, 0, 0, 5.0, 0.3, 0, 0, 4.0),  # the whole image
        (0, 0, 0, 0.1, 0.2, 0.1, -2.5, 0.2),  # one end behind the camera
    ],
)
def test_special_rectangles(limb):
    limbs, rig = rods(limb), CameraRig([one_camera()])
    image = render_limbs(limbs, rig, HEIGHT, WIDTH, limb_shape="rectangles")
    alone = Limbs(limbs.start, limbs.end, limbs.radii)
    batched = Limbs(alone.start[None], alone.end[None], alone.radii)
    assert torch.equal(image, slow_render(batched, rig)[0])
    assert image.any()


def test_limbs_out_of_sight_are_empty():
    behind = rods((0, 0, -3, 0.1, 0, 0.1, -2.5, 0.2), (0, 0, np.nan, 0.1, 0, 0, 0, 0.1))
    assert not render_limbs(behind, one_camera(), HEIGHT, WIDTH, limb_shape="rectangles").any()


def test_a_rectangle_covers_as_much_as_its_limb():
    """A limb at right angles to the view, and one along it, each with one radius."""
    for limb in ((-0.4, 0.05, 0, 0.12, 0.4, 0.02, 0, 0.12), (0, 0, 0, 0.3, 0.0, 0, 0.0, 0.3)):
        limbs, rig = rods(limb), make_rig(1, 240, 320, 300.0)
        areas = [
            int(render_limbs(limbs, rig, 240, 320, limb_shape=shape).sum())
            for shape in ("cylinders", "rectangles")
        ]
        assert abs(areas[0] - areas[1]) < 0.02 * areas[0]  # the pixels of an edge


def test_a_body_of_rectangles_is_nearly_that_of_cylinders():
    body, rig = Body.of_height(BODY_15, 1.75), make_rig(1, 240, 320, 220.0)
    state = torch.zeros(1, body.dim, dtype=torch.float64)
    image = render(body, state, rig, 240, 320, limb_shape="rectangles")
    round_ends = render(body, state, rig, 240, 320)
    both, either = (image & round_ends).sum(), (image | round_ends).sum()
    assert 0.9 < both / either < 1


def test_another_shape_is_refused():
    with pytest.raises(InputError, match="limb_shape must be one of cylinders, rectangles"):
        render_limbs(random_limbs(1), make_rig(1), HEIGHT, WIDTH, limb_shape="ellipses")
    with pytest.raises(InputError, match="limb_shape"):
        count_pixels(
            random_limbs(1), None, make_rig(1), torch.ones(1, HEIGHT, WIDTH).bool(), limb_shape=""
        )
