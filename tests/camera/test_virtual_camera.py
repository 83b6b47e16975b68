"""The virtual camera follows the body, and the path says where head and neck are."""

import math

import pytest
import torch

from tests.priors.poses import poses
from torchpose.camera import _virtual_camera as body_view
from torchpose.camera import project
from torchpose.camera._virtual_camera import (
    MEMORY,
    PathModel,
    body_path,
    from_view,
    memory_frames,
    to_view,
    view_body,
)
from torchpose.math import euler_to_matrix, kalman_predict, kalman_update

MATRIX = torch.tensor([[525.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]], dtype=torch.float64)
NECK, HEIGHT = torch.tensor([319.5, 174.0]).double(), torch.tensor([0.0, -50.0]).double()
MODEL = PathModel(NECK, HEIGHT, torch.tensor([9.0, 4.0]).double(), 260.0)
EYE = torch.eye(3, dtype=torch.float64)


def scene(n=50, batch=2, seed=0):
    g = torch.Generator().manual_seed(seed)
    uv = torch.zeros(batch, n, 8, 2, dtype=torch.float64)
    walk = torch.randn(batch, n, 2, generator=g).double().cumsum(1)
    uv[:, :, 4] = NECK + walk
    uv[:, :, 3] = NECK + walk + HEIGHT + torch.randn(batch, n, 2, generator=g)
    mask = torch.rand(batch, n, 8, generator=g) < 0.8
    mask[1, 20:30] = False
    return uv, mask


def as_kalman_smoother(uv, mask, t, lags, ahead, fps):
    """The same model by the library's Kalman steps over one second, the places at the lags kept."""
    past = memory_frames(lags, fps)
    frames = [k for k in range(-past, ahead + 1)]
    n_kept, step = len(lags), 1 / fps
    dim = 4 + 2 * n_kept  # n, its velocity, h, its velocity; then copies of n and h at the lags
    mean, cov = torch.zeros(dim).double(), torch.zeros(dim, dim).double()
    scale = MODEL.scale
    for i, value in enumerate((1.0, 1.0, 0.05, 0.01)):
        cov[i, i] = (value * scale) ** 2
    move, noise = torch.eye(dim).double(), torch.zeros(dim, dim).double()
    for i, acceleration in ((0, 0.5), (2, 0.002)):
        move[i, i + 1] = step
        block = torch.tensor([[step**3 / 3, step**2 / 2], [step**2 / 2, step]]).double()
        noise[i : i + 2, i : i + 2] = (acceleration * scale) ** 2 * block
    means = mean.expand(2, dim)  # u and v
    prior = torch.stack([NECK + HEIGHT, NECK])
    variance = MODEL.variance + torch.tensor([(0.046 * scale) ** 2, 0.0]).double()
    sums = torch.eye(dim).double()
    for k in frames:
        if k > -past:
            means, cov = kalman_predict(means, cov, move, torch.zeros(dim).double(), noise)
        for i, lag in enumerate(lags):
            if k == -lag:
                copy = torch.eye(dim).double()
                for row, source in ((4 + 2 * i, 0), (5 + 2 * i, 2)):
                    copy[row] = 0
                    copy[row, source] = 1
                means, cov = means @ copy.T, copy @ cov @ copy.T
        if not 0 <= t + k < uv.shape[0]:
            continue
        for j, joint in enumerate((3, 4)):
            if mask[t + k, joint]:
                # The head is n + h: swap in the sum as a state of its own.
                swap = sums.clone()
                swap[0, 2] = 1.0 if joint == 3 else 0.0
                z = (uv[t + k, joint] - prior[j])[:, None]
                means, cov, _ = kalman_update(
                    means @ swap.T,
                    swap @ cov @ swap.T,
                    z,
                    variance[j].view(1, 1),
                    torch.tensor([0]),
                )
                back = torch.linalg.inv(swap)
                means, cov = means @ back.T, back @ cov @ back.T
    kept = means[:, 4:].T.view(n_kept, 2, 2)
    return kept[:, 0] + NECK, kept[:, 1] + HEIGHT


@pytest.mark.parametrize(("lags", "ahead"), [((0, 4, 20), 0), ((-3, 0, 4), 3)])
def test_the_path_is_that_of_a_kalman_smoother_over_the_last_second(lags, ahead):
    uv, mask = scene()
    path = body_path(uv, mask, lags, ahead, 30.0, MODEL)
    for b, t in ((0, 0), (0, 7), (0, 40), (1, 29), (1, 49)):
        neck, height = as_kalman_smoother(uv[b], mask[b], t, lags, ahead, 30.0)
        torch.testing.assert_close(path.neck[b, t], neck, rtol=0, atol=1e-6)
        torch.testing.assert_close(path.height[b, t], height, rtol=0, atol=1e-6)


def test_the_last_frame_needs_only_the_last_second():
    uv, mask = scene()
    whole = body_path(uv, mask, (0, 4), 0, 30.0, MODEL)
    recent = memory_frames((0, 4), 30.0) + 1
    assert recent == 31 and MEMORY == 1.0
    last = body_path(uv[:, -recent:], mask[:, -recent:], (0, 4), 0, 30.0, MODEL, recent - 1)
    torch.testing.assert_close(last.neck[:, 0], whole.neck[:, -1])
    torch.testing.assert_close(last.at(4)[1][:, 0], whole.at(4)[1][:, -1])


def test_weights_that_a_regression_keeps_are_those_of_its_frames():
    """Live frames ask again for the weights of the same pattern, which a gap changes and changes back."""
    uv, mask = scene()
    known = body_view.path_regression((0, 4), 0, 30.0, MODEL, uv)
    complete, gap = torch.ones_like(mask), torch.ones_like(mask)
    gap[:, -3, 3:5] = False
    for patterns in (complete, gap, gap, complete):
        given = uv[:, -31:], patterns[:, -31:], (0, 4), 0, 30.0, MODEL, 30
        kept, anew = body_path(*given, regression=known), body_path(*given)
        torch.testing.assert_close(kept.neck, anew.neck, rtol=0, atol=0)
        torch.testing.assert_close(kept.height, anew.height, rtol=0, atol=0)


def test_without_head_and_neck_the_path_is_the_usual_place():
    uv, mask = scene()
    path = body_path(uv, torch.zeros_like(mask), (0, 4), 0, 30.0, MODEL)
    assert (path.neck == NECK).all() and (path.height == HEIGHT).all()
    view = view_body(*path.at(0), MODEL, MATRIX)
    torch.testing.assert_close(view.rotation, EYE.expand_as(view.rotation))
    torch.testing.assert_close(to_view(uv, view, MATRIX)[0], uv)


def test_the_turned_camera_sees_the_same_body_from_the_same_place():
    body = poses(4, seed=2, offset=(0, 0, 0)) - poses(4, seed=2, offset=(0, 0, 0))[:, 4:5]
    place = torch.tensor([0.9, -0.3, 2.0]).double()
    uv = project(body, MATRIX, EYE, place)[None, ..., :2]
    view = view_body(uv[:, :, 4], HEIGHT.expand(1, 4, 2), MODEL, MATRIX)
    turned = (view.rotation[0] @ (body + place).mT).mT
    expected = project(turned, MATRIX, EYE, torch.zeros(3).double())[..., :2]
    torch.testing.assert_close(to_view(uv, view, MATRIX)[0][0], expected)
    assert float((expected[:, 4] - NECK).norm(dim=-1).max()) < 0.06 * 525
    torch.testing.assert_close(view.rotation @ view.rotation.mT, EYE.expand(1, 4, 3, 3))


def test_far_bodies_are_zoomed_and_near_enough_ones_are_not():
    places = NECK.expand(6, 2)
    farther = torch.tensor([1.0, 1.08, 0.78, 1.5, 2.0, 0.5]).double()
    view = view_body(places, HEIGHT / farther[:, None], MODEL, MATRIX)
    expected = torch.tensor([1.0, 1.0, 1.0, 1.5, 2.0, 0.5]).double()
    torch.testing.assert_close(view.zoom, expected)
    reach = torch.tensor([0.0, 0.0, 0.0, 300.0, 0.8 * 260.0 / 1.6, 300.0]).double()
    held = view_body(places, HEIGHT / farther[:, None], MODEL, MATRIX, reach)
    expected = torch.tensor([1.0, 1.0, 1.0, 1.0, 1.6, 0.5]).double()
    torch.testing.assert_close(held.zoom, expected)
    steps = torch.linspace(-1.0, 1.0, 401).double().exp()
    zooms = view_body(NECK.expand(401, 2), HEIGHT / steps[:, None], MODEL, MATRIX).zoom.log()
    assert (zooms.diff() >= -1e-9).all() and zooms.diff().max() < 0.03


def test_pixels_go_to_the_view_and_back_and_covariances_follow():
    g = torch.Generator().manual_seed(0)
    uv = torch.tensor([320.0, 240.0]) + 80 * torch.randn(2, 3, 8, 2, generator=g).double()
    view = view_body(uv[:, :, 4], HEIGHT.expand(2, 3, 2) / 1.7, MODEL, MATRIX)
    seen, scale = to_view(uv, view, MATRIX)
    back, slopes = from_view(seen, view, MATRIX)
    torch.testing.assert_close(back, uv)
    numeric = torch.autograd.functional.jacobian(
        lambda x: from_view(x, view, MATRIX)[0].sum((0, 1, 2)), seen
    )
    torch.testing.assert_close(slopes, numeric.permute(1, 2, 3, 0, 4))
    torch.testing.assert_close(scale, -slopes.det().abs().log())


def test_a_hand_of_before_is_carried_along_with_the_body():
    """A walk to the side and towards the camera: at every time the same pose about the neck."""
    t = torch.arange(60).double() / 30
    places = torch.stack([0.3 * t, torch.zeros_like(t), 2.5 - 0.3 * t], 1)
    body = poses(1, seed=3, offset=(0, 0, 0))[0]
    body = body - body[4]
    uv = project(
        body.expand(60, 8, 3), MATRIX, euler_to_matrix(torch.zeros(3).double(), "zxy"), places
    )
    uv = uv[None, ..., :2]
    model = MODEL._replace(
        neck=uv[0, 0, 4], height=uv[0, 0, 3] - uv[0, 0, 4], variance=torch.full((2,), 0.01).double()
    )
    path = body_path(uv, torch.ones(1, 60, 8, dtype=torch.bool), (0, 10), 0, 30.0, model)
    carried = path.carried(uv[:, :, :1].roll(10, 1), [10])[0, 40:, 0]
    left = uv[0, 30:50, 0] - uv[0, 40:60, 0]
    assert (carried - uv[0, 40:, 0]).norm(dim=-1).max() < 0.25 * left.norm(dim=-1).min()
    assert math.isclose(float(path.carried(uv[:, :, :1], [0])[0, 5, 0, 0]), float(uv[0, 5, 0, 0]))


@pytest.mark.parametrize("variance", [False, True])
def test_patterns_at_a_time_are_bounded_and_change_nothing(monkeypatch, variance):
    """At 1,000 frames per second the covariance of a second's pixels has four million numbers."""
    uv, mask = scene(40)
    own = 4 + uv[..., 3, :].abs() / 100 if variance else None
    before = body_path(uv, mask, (0, 4), 2, 30.0, MODEL, variance=own)
    seen = []
    weights = body_view.Regression.weights

    def counted(self, known, more):
        seen.append(len(known) * len(self.measured) ** 2)
        return weights(self, known, more)

    monkeypatch.setattr(body_view.Regression, "weights", counted)
    monkeypatch.setattr(body_view, "_NUMBERS_AT_A_TIME", 50_000)
    after = body_path(uv, mask, (0, 4), 2, 30.0, MODEL, variance=own)
    torch.testing.assert_close(after.neck, before.neck)
    torch.testing.assert_close(after.height, before.height)
    assert len(seen) > 5 and max(seen) <= 50_000
