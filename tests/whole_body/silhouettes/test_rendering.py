"""Silhouettes: rendering and counting against every pixel's distance to the limb, as defined."""

import itertools

import numpy as np
import pytest
import torch

from torchpose.body import Limbs
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.errors import CameraError, InputError, ShapeError
from torchpose.whole_body import count_pixels, render
from torchpose.whole_body._silhouettes.rendering import prepare_silhouettes, render_limbs

HEIGHT, WIDTH = 34, 45
NEAR = 0.1


class Rods:
    """A body of two limbs whose state is their four ends."""

    radii = torch.tensor([[0.2, 0.1], [0.12, 0.05]], dtype=torch.float64)

    def limbs(self, state):
        ends = state.unflatten(-1, (2, 2, 3))
        return Limbs(ends[..., 0, :], ends[..., 1, :], self.radii.to(state))


def make_rig(n=3, height=HEIGHT, width=WIDTH, focal=40.0):
    """Cameras 2 m from the origin, one turned, one with skew and unequal focal lengths."""
    middle = ((width - 1) / 2, (height - 1) / 2)
    poses = [
        ((0.0, 0.0, 0.0), (0.0, 0.0, 2.0), {}),
        ((0.3, -0.8, 0.2), (0.1, 0.0, 2.2), {"skew": 1.5}),
        ((0.0, 3.0, 0.4), (0.0, 0.2, 1.8), {}),
        ((1.2, 0.1, 0.0), (0.0, 0.0, 2.5), {}),
    ]
    cameras = [
        PinholeCamera(focal, focal * (1 + 0.1 * (i == 1)), *middle, width, height, f"c{i}",
                      rotation=r, translation=t, **more)
        for i, (r, t, more) in enumerate(poses[:n])
    ]  # fmt: skip
    return CameraRig(cameras)


def random_limbs(*batch, n_limbs=4, seed=0, spread=0.5, dtype=torch.float64, own_radii=False):
    g = torch.Generator().manual_seed(seed)
    start = spread * torch.randn(*batch, n_limbs, 3, generator=g, dtype=torch.float64)
    end = start + 0.4 * torch.randn(*batch, n_limbs, 3, generator=g, dtype=torch.float64)
    size = (*batch, n_limbs, 2) if own_radii else (n_limbs, 2)
    radii = 0.01 + 0.15 * torch.rand(size, generator=g, dtype=torch.float64)
    return Limbs(start.to(dtype), end.to(dtype), radii.to(dtype))


def slow_silhouette(start, end, radii, K, R, t, height, width, near=NEAR):
    """Pixels [H, W] of one limb by the definition: the union over s in [0, 1] of discs with the
    centre (1 - s) a + s b and the radius (1 - s) r_a + s r_b, the convex hull of the two end discs.

    A point p is in it iff min_s |p - c(s)| - r(s) <= 0. The function is convex in s, and its minimum
    is at an end or where (c(s) - p) is at the tangents' angle to the axis.
    """
    ends = [(R @ X + t, float(r)) for X, r in zip((start, end), radii, strict=True)]
    (A, ra), (B, rb) = ends
    if max(A[2], B[2]) < near:
        return np.zeros((height, width), bool)
    if min(A[2], B[2]) < near:
        s = (near - A[2]) / (B[2] - A[2])
        cut, cut_radius = A + s * (B - A), ra + s * (rb - ra)
        (A, ra), (B, rb) = [((X, r) if X[2] >= near else (cut, cut_radius)) for X, r in ends]
    focal = np.sqrt(K[0, 0] * K[1, 1])
    a, b = (K @ A)[:2] / A[2], (K @ B)[:2] / B[2]
    ra, rb = ra * focal / A[2], rb * focal / B[2]
    p = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(float)
    best = np.minimum(np.linalg.norm(p - a, axis=-1) - ra, np.linalg.norm(p - b, axis=-1) - rb)
    length, taper = np.linalg.norm(b - a), ra - rb
    if length > abs(taper):
        axis = (b - a) / length
        along, across = (p - a) @ axis, np.abs((p - a) @ np.array([-axis[1], axis[0]]))
        # d/ds (|p - c(s)| - r(s)) = 0: the foot lies across / tan(angle) before p's projection
        foot = (along - across * taper / np.sqrt(length**2 - taper**2)) / length
        s = np.clip(foot, 0, 1)[..., None]
        distance = np.linalg.norm(p - (1 - s) * a - s * b, axis=-1)
        best = np.minimum(best, distance - (ra + s[..., 0] * (rb - ra)))
    assert np.abs(best).min() > 1e-9, "a tie: take another seed"
    return best <= 0


def slow_render(limbs, rig, height, width, near=NEAR):
    """[..., C, H, W]: a loop over everything."""
    batch, n_limbs = limbs.start.shape[:-2], limbs.start.shape[-2]
    radii = limbs.radii.expand(*batch, n_limbs, 2)
    out = np.zeros((*batch, len(rig), height, width), bool)
    cameras = [tuple(x.numpy() for x in c) for c in zip(rig.matrix, rig.rotation, rig.translation,
               strict=True)]  # fmt: skip
    for item in itertools.product(*map(range, batch)):
        for c, camera in enumerate(cameras):
            for n in range(n_limbs):
                parts = (x[item][n].double().numpy() for x in (limbs.start, limbs.end, radii))
                out[(*item, c)] |= slow_silhouette(*parts, *camera, height, width, near)
    return torch.from_numpy(out)


def test_the_slow_reference_is_the_union_of_discs_between_the_ends():
    """Many discs between both ends: each lies in the hull, and they fill it up to a thin rim."""
    rng = np.random.default_rng(1)
    K, R = np.array([[40.0, 0, 22], [0, 40, 17], [0, 0, 1]]), np.eye(3)
    p = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), -1)
    for _ in range(10):
        start, end = rng.normal(0, 0.4, 3), rng.normal(0, 0.4, 3)
        end[2] = start[2]  # equal depth, so that discs between the ends are those of the image
        t, radii = np.array([0, 0, 2.0]), rng.uniform(0.01, 0.5, 2)
        hull = slow_silhouette(start, end, radii, K, R, t, HEIGHT, WIDTH)
        s = np.linspace(0, 1, 801)[:, None]
        ends = [(K @ (X + t))[:2] / (X + t)[2] for X in (start, end)]
        centre, depth = (1 - s) * ends[0] + s * ends[1], (start + t)[2]
        radius = 40 / depth * ((1 - s) * radii[0] + s * radii[1])[:, 0]
        union = np.zeros((HEIGHT, WIDTH), bool)
        for c, r in zip(centre, radius, strict=True):
            union |= np.linalg.norm(p - c, axis=-1) <= r
        assert not (union & ~hull).any()
        assert (hull & ~union).sum() <= 2


@pytest.mark.parametrize("seed", range(6))
def test_render_is_exact(seed):
    limbs = random_limbs(5, seed=seed)
    rig = make_rig(3)
    image = render_limbs(limbs, rig, HEIGHT, WIDTH)
    assert image.dtype == torch.bool and image.shape == (5, 3, HEIGHT, WIDTH)
    assert torch.equal(image, slow_render(limbs, rig, HEIGHT, WIDTH))
    assert 0.02 < image.double().mean() < 0.9


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("chunk", [None, 1, 3])
def test_counts_are_those_of_the_images(seed, chunk):
    limbs, rig = random_limbs(7, seed=seed), make_rig(3)
    silhouettes = torch.rand(3, HEIGHT, WIDTH) < torch.tensor([0.5, 0.1, 0.9])[:, None, None]
    counts = count_pixels(limbs, None, rig, silhouettes, chunk=chunk)
    image = slow_render(limbs, rig, HEIGHT, WIDTH)
    assert torch.equal(counts.model, image.sum((-2, -1)))
    assert torch.equal(counts.overlap, (image & silhouettes).sum((-2, -1)))
    assert torch.equal(counts.image, silhouettes.sum((-2, -1)).expand(7, 3))


def test_body_and_leading_dimensions():
    """States [B, N, D] with silhouettes [B, C, H, W], and with one silhouette for all."""
    g = torch.Generator().manual_seed(3)
    state = 0.4 * torch.randn(2, 3, 12, generator=g, dtype=torch.float64)
    body, rig = Rods(), make_rig(2)
    silhouettes = torch.rand(2, 2, HEIGHT, WIDTH, generator=g) < 0.5
    image = slow_render(body.limbs(state), rig, HEIGHT, WIDTH)
    assert torch.equal(render(body, state, rig, HEIGHT, WIDTH), image)
    for observed in (silhouettes, prepare_silhouettes(silhouettes), silhouettes.byte()):
        counts = count_pixels(body, state, rig, observed, chunk=2)
        assert torch.equal(counts.model, image.sum((-2, -1)))
        assert torch.equal(counts.overlap, (image & silhouettes[:, None]).sum((-2, -1)))
        assert torch.equal(counts.image, silhouettes.sum((-2, -1))[:, None].expand(2, 3, 2))
    counts = count_pixels(body, state, rig, silhouettes[0])
    assert torch.equal(counts.overlap, (image & silhouettes[0]).sum((-2, -1)))
    one = count_pixels(body, state[1, 2], rig, silhouettes[1])
    assert torch.equal(one.overlap, (image[1, 2] & silhouettes[1]).sum((-2, -1)))
    none = count_pixels(body, state[:, :0], rig, silhouettes)
    assert none.model.shape == none.image.shape == (2, 0, 2)


def test_radii_of_each_particle():
    limbs, rig = random_limbs(2, 3, seed=5, own_radii=True), make_rig(2)
    image = render_limbs(limbs, rig, HEIGHT, WIDTH)
    assert torch.equal(image, slow_render(limbs, rig, HEIGHT, WIDTH))
    counts = count_pixels(limbs, None, rig, torch.ones(2, HEIGHT, WIDTH, dtype=torch.bool), chunk=2)
    assert torch.equal(counts.model, image.sum((-2, -1)))
    shared = Limbs(limbs.start, limbs.end, limbs.radii[:, :1])  # of one person each
    expected = slow_render(shared, rig, HEIGHT, WIDTH)
    assert torch.equal(render_limbs(shared, rig, HEIGHT, WIDTH), expected)


@pytest.mark.parametrize("threads", [1, 3])
def test_threads_change_nothing(threads):
    limbs, rig = random_limbs(40, seed=6), make_rig(3)
    silhouettes = torch.rand(3, HEIGHT, WIDTH) < 0.5
    expected = count_pixels(limbs, None, rig, silhouettes, chunk=40)
    torch.set_num_threads(threads)
    try:
        counts = count_pixels(limbs, None, rig, silhouettes, chunk=3)
    finally:
        torch.set_num_threads(1)
    assert all(torch.equal(a, b) for a, b in zip(counts, expected, strict=True))


def test_without_numpy_as_on_other_devices(monkeypatch):
    monkeypatch.setattr(
        "torchpose.whole_body._silhouettes.row_intervals._by_numpy", lambda x: False
    )
    limbs, rig = random_limbs(7, seed=11), make_rig(3)
    assert torch.equal(
        render_limbs(limbs, rig, HEIGHT, WIDTH), slow_render(limbs, rig, HEIGHT, WIDTH)
    )
    silhouettes = torch.rand(3, HEIGHT, WIDTH) < 0.5
    counts = count_pixels(limbs, None, rig, silhouettes)
    monkeypatch.undo()
    expected = count_pixels(limbs, None, rig, silhouettes)
    assert all(torch.equal(a, b) for a, b in zip(counts, expected, strict=True))


def test_float32_differs_only_at_the_border():
    limbs, rig = random_limbs(20, seed=7), make_rig(3, 120, 160, 140.0)
    image = render_limbs(limbs, rig, 120, 160)
    single = render_limbs(Limbs(*(x.float() for x in limbs)), rig, 120, 160)
    assert (image != single).sum() <= 4
    sil = image[0]
    counts = count_pixels(Limbs(*(x.float() for x in limbs)), None, rig, sil)
    assert torch.equal(counts.model, single.sum((-2, -1)))
    assert torch.equal(counts.overlap, (single & sil).sum((-2, -1)))


@pytest.mark.parametrize(("height", "width"), [(3, 5), (1, 50), (40, 1), (9, 3000)])
def test_odd_sizes(height, width):
    """Fewer rows than are computed at once, one column, and keys of 64 bits."""
    limbs, rig = random_limbs(6, seed=8), make_rig(3, height, width, 30.0)
    image = render_limbs(limbs, rig, height, width)
    assert torch.equal(image, slow_render(limbs, rig, height, width))
    silhouettes = torch.rand(3, height, width) < 0.5
    counts = count_pixels(limbs, None, rig, silhouettes)
    assert torch.equal(counts.model, image.sum((-2, -1)))
    assert torch.equal(counts.overlap, (image & silhouettes).sum((-2, -1)))


def one_camera():
    return PinholeCamera(40.0, 40.0, 22.03, 17.01, WIDTH, HEIGHT, translation=(0, 0, 2))


def rods(*rows):
    """Limbs (ax, ay, az, ra, bx, by, bz, rb)."""
    x = torch.tensor(rows, dtype=torch.float64)
    return Limbs(x[:, :3], x[:, 4:7], x[:, [3, 7]])


@pytest.mark.parametrize(
    "limb",
    [
        (0, 0, 0, 0.2, 0, 0, 0, 0.2),  # no length
        (0, 0, 0, 0.2, 0, 0, 0, 0.1),  # no length, two radii
        (0, 0, 0, 0.3, 0.1, 0, 0, 0.1),  # one disc within the other
        (0, 0, 0, 0.1, 0, 0, 1.0, 0.1),  # along the optical axis
        (-0.3, 0, 0, 0.1, 0.3, 0, 0, 0.1),  # level, both tangents without rise
        (-0.3, 0, 0, 0.2, 0.3, 1e-12, 0, 0.2),  # nearly level
        (-0.3, 1e-5, 0, 0.05, 0.3, 0, 0, 0.25),  # level and tapered: both tangents on one side
        (0, -0.3, 0, 0.1, 0, 0.3, 0, 0.1),  # upright
        (-3, 0.1, 0, 0.1, 3, 0.3, 0, 0.2),  # beyond both sides
        (0.2, -3, 0, 0.1, 0, 3, 0, 0.3),  # beyond top and bottom
        (0, 0.8, 0, 0.2, 0.3, 0.9, 0, 0.2),  # below the lower border, in part
        (0, 0, 0, 5.0, 0.3, 0, 0, 4.0),  # the whole image
        (0.1, 0.1, 0, 0.0, 0.3, 0.37, 0, 0.3),  # a pointed end
        (0, 0, 0, 0.1, 0.2, 0.1, -2.5, 0.2),  # one end behind the camera
        (0.3, 0.2, -2.05, 0.1, 0, 0.1, 0, 0.2),  # one end nearer than `near`
    ],
)
def test_special_limbs(limb):
    limbs, rig = rods(limb), CameraRig([one_camera()])
    image = render_limbs(limbs, rig, HEIGHT, WIDTH)
    assert torch.equal(image, slow_render(limbs, rig, HEIGHT, WIDTH))
    assert image.any()
    counts = count_pixels(limbs, None, rig, image)
    assert counts.model.tolist() == counts.overlap.tolist() == counts.image.tolist()


@pytest.mark.parametrize(
    "limb",
    [
        (0, 0, -3, 0.1, 0, 0.1, -2.5, 0.2),  # behind the camera
        (0, 0, -1.95, 0.1, 0.1, 0, -1.93, 0.1),  # in front, nearer than `near`
        (5, 0, 0, 0.1, 6, 0, 0, 0.1),  # beside the image
        (0, -4, 0, 0.1, 0, -5, 0, 0.1),  # above it
        (0, 0, np.nan, 0.1, 0, 0, 0, 0.1),  # not a number
        (0, 0, 0, 0.0, 0, 0, 0, 0.0),  # nothing, between pixel centres
    ],
)
def test_limbs_out_of_sight_are_empty_models(limb):
    limbs = rods(limb)
    silhouettes = torch.ones(1, HEIGHT, WIDTH, dtype=torch.bool)
    counts = count_pixels(limbs, None, one_camera(), silhouettes)
    assert counts.model.tolist() == counts.overlap.tolist() == [0]
    assert counts.image.tolist() == [HEIGHT * WIDTH]
    assert not render_limbs(limbs, [one_camera()], HEIGHT, WIDTH).any()
    with_ball = rods(limb, (0, 0, 0, 0.2, 0, 0, 0, 0.2))
    alone = render_limbs(rods((0, 0, 0, 0.2, 0, 0, 0, 0.2)), one_camera(), HEIGHT, WIDTH)
    assert torch.equal(render_limbs(with_ball, one_camera(), HEIGHT, WIDTH), alone)


def test_near_is_the_callers():
    limbs = rods((0.1, 0, -1.95, 0.01, 0.2, 0, 0, 0.01))  # ends 0.05 and 2 m in front
    areas = [
        int(render_limbs(limbs, one_camera(), HEIGHT, WIDTH, near=near).sum())
        for near in (0.03, 0.5, 1.0, 2.5)
    ]
    assert areas == sorted(areas, reverse=True) and areas[0] > areas[1] > areas[2] > areas[3] == 0


def test_empty_silhouettes_and_no_limbs():
    limbs, rig = random_limbs(3, seed=9), make_rig(2)
    counts = count_pixels(limbs, None, rig, torch.zeros(2, HEIGHT, WIDTH, dtype=torch.bool))
    assert not counts.overlap.any() and not counts.image.any() and counts.model.any()
    bare = Limbs(limbs.start[:, :0], limbs.end[:, :0], limbs.radii[:0])
    counts = count_pixels(bare, None, rig, torch.ones(2, HEIGHT, WIDTH, dtype=torch.bool))
    assert not counts.model.any() and not counts.overlap.any()
    assert not render_limbs(bare, rig, HEIGHT, WIDTH).any()


def test_gradients_are_cut():
    limbs = Limbs(*(x.requires_grad_() for x in random_limbs(3, seed=10)))
    counts = count_pixels(limbs, None, make_rig(1), torch.ones(1, HEIGHT, WIDTH).bool())
    assert not counts.model.requires_grad and not counts.model.is_inference()
    assert not render_limbs(limbs, make_rig(1), HEIGHT, WIDTH).is_inference()


def test_cameras_that_do_not_fit():
    limbs, rig = random_limbs(3), make_rig(3)
    wrong_number = torch.zeros(2, HEIGHT, WIDTH, dtype=torch.bool)
    with pytest.raises(CameraError, match=r"of 3 cameras \(c0, c1, c2\), got 2"):
        count_pixels(limbs, None, rig, wrong_number)
    with pytest.raises(CameraError, match=r"34 x 45.*got 17 x 22; rig.scaled\(17, 22\)"):
        count_pixels(limbs, None, rig, torch.zeros(3, 17, 22, dtype=torch.bool))
    with pytest.raises(CameraError, match=r"rig.scaled\(17, 22\)"):
        render_limbs(limbs, rig, 17, 22)
    half = rig.scaled(17, 22)
    assert count_pixels(limbs, None, half, torch.ones(3, 17, 22).bool()).model.shape == (3, 3)


def test_bad_input():
    limbs, rig = random_limbs(3), make_rig(3)
    silhouettes = torch.zeros(3, HEIGHT, WIDTH, dtype=torch.bool)
    with pytest.raises(InputError, match="state must be given"):
        count_pixels(Rods(), None, rig, silhouettes)
    with pytest.raises(InputError, match="None with Limbs"):
        count_pixels(limbs, torch.zeros(3, 12), rig, silhouettes)
    with pytest.raises(ShapeError, match="leading dimensions"):
        count_pixels(limbs, None, rig, silhouettes.expand(2, 3, HEIGHT, WIDTH))
    with pytest.raises(InputError, match="silhouettes must be a tensor, got ndarray"):
        count_pixels(limbs, None, rig, silhouettes.numpy())
    with pytest.raises(InputError, match="silhouettes must be finite, got nan"):
        count_pixels(limbs, None, rig, silhouettes * torch.nan)
    with pytest.raises(ShapeError, match=r"\[\.\.\., C, H, W\]"):
        count_pixels(limbs, None, rig, silhouettes[0])
    with pytest.raises(ShapeError, match="both ends"):
        render_limbs(limbs._replace(end=limbs.end[:, :2]), rig, HEIGHT, WIDTH)
    with pytest.raises(ShapeError, match="radii"):
        render_limbs(limbs._replace(radii=limbs.radii[:2]), rig, HEIGHT, WIDTH)
    with pytest.raises(InputError, match="radii"):
        render_limbs(limbs._replace(radii=-limbs.radii), rig, HEIGHT, WIDTH)
    with pytest.raises(InputError, match="chunk"):
        count_pixels(limbs, None, rig, silhouettes, chunk=0)
    with pytest.raises(InputError, match="near"):
        count_pixels(limbs, None, rig, silhouettes, near=0.0)
    with pytest.raises(InputError, match="sides"):
        render_limbs(limbs, rig, 0, WIDTH)
