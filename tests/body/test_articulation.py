"""The manifold of body states: derivatives of joints, steps and differences, limbs without twist."""

import pytest
import torch

from torchpose.body._articulation import Articulation, BodyPoint


@pytest.fixture(scope="module")
def articulation() -> Articulation:
    return Articulation()


def zero_point(articulation: Articulation, n: int) -> BodyPoint:
    """Bodies at the centres of their parts."""
    return BodyPoint(
        torch.zeros(n, 3).double(),
        torch.eye(3).double().expand(n, len(articulation.skeleton.parts), 3, 3),
        torch.zeros(n, articulation.n_pose).double(),
        torch.zeros(n, len(articulation.groups)).double(),
        torch.zeros(n, len(articulation.shifted), 3).double(),
    )


def some_point(articulation: Articulation, n: int = 4, size: float = 0.3) -> BodyPoint:
    g = torch.Generator().manual_seed(0)
    step = size * torch.randn(n, articulation.dim, generator=g, dtype=torch.float64)
    return articulation.moved(zero_point(articulation, n), step)


def test_the_jacobian_is_that_of_finite_differences(articulation):
    point = some_point(articulation)
    found = articulation.linearise(point)
    torch.testing.assert_close(found.joints, articulation.joints(point))
    every = 1e-6 * torch.eye(articulation.dim).double()
    for column, step in enumerate(every):
        ahead = articulation.joints(articulation.moved(point, step.expand(4, -1)))
        behind = articulation.joints(articulation.moved(point, -step.expand(4, -1)))
        slope = (ahead - behind) / 2e-6
        torch.testing.assert_close(found.jacobian[..., column], slope, atol=1e-8, rtol=1e-6)


def test_a_difference_is_the_step_that_was_taken(articulation):
    g = torch.Generator().manual_seed(1)
    point = some_point(articulation)
    step = 0.5 * torch.randn(4, articulation.dim, generator=g, dtype=torch.float64)
    moved = articulation.moved(point, step)
    torch.testing.assert_close(articulation.difference(moved, point), step)
    nothing = articulation.difference(point, point)
    torch.testing.assert_close(nothing, torch.zeros_like(nothing))


def test_limbs_without_twist_have_the_same_joints(articulation):
    point = some_point(articulation)
    for _ in range(3):  # steps about two axes leave a twist
        g = torch.Generator().manual_seed(2)
        step = 0.3 * torch.randn(4, articulation.dim, generator=g, dtype=torch.float64)
        point = articulation.moved(point, step)
    free = articulation.swung(point, articulation.joints(point))
    torch.testing.assert_close(articulation.joints(free), articulation.joints(point))
    twist = (free.rotations - free.rotations.mT)[:, list(articulation.limb_parts), 0, 2]
    torch.testing.assert_close(twist, torch.zeros_like(twist))
    again = articulation.swung(free, articulation.joints(free))
    torch.testing.assert_close(again.rotations, free.rotations)


def test_relative_angles_are_the_steps_from_the_centres(articulation):
    g = torch.Generator().manual_seed(3)
    step = 0.5 * torch.randn(4, articulation.dim, generator=g, dtype=torch.float64)
    point = articulation.moved(zero_point(articulation, 4), step)
    expected = step[:, articulation.relative_columns]
    torch.testing.assert_close(articulation.relative_angles(point), expected)


def test_scales_are_logarithms_of_lengths(articulation):
    lengths = articulation.offsets.norm(dim=-1)
    scales = articulation.scales_of(torch.stack([lengths, 1.2 * lengths]))
    torch.testing.assert_close(scales[0], torch.zeros_like(scales[0]))
    torch.testing.assert_close(scales[1].exp(), torch.full_like(scales[1], 1.2))
