"""Camera rigs: the cameras one by one, sizes, and OpenCV's projection with distortion."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from torchpose.camera import CameraRig, PinholeCamera, save_cameras
from torchpose.camera._lens import undistortion_maps
from torchpose.camera._rig import as_rig
from torchpose.errors import CameraError, InputError

DISTORTIONS = (-0.25, 0.08, 0.002, -0.001)


def make_cameras(distortions=(), fisheye=False):
    return [
        PinholeCamera(
            400.0 + 20 * i, 410.0, 321.0, 238.5, 640, 480, name, skew=9.0 * i,
            rotation=(0.1 * i, -0.2, 0.3), translation=(0.1, 0.2 * i, 3.0),
            distortions=distortions, fisheye=fisheye,
        )
        for i, name in enumerate(("left", "front", "right"))
    ]  # fmt: skip


def test_forward_is_every_camera_by_itself():
    cameras = make_cameras()
    rig = CameraRig(cameras)
    points = torch.randn(2, 4, 5, 3, dtype=torch.float64)
    view = rig(points)
    assert view.pixels.shape == (2, 4, 3, 5, 2) and view.depth.shape == (2, 4, 3, 5)
    for c, camera in enumerate(cameras):
        uvl = camera(points)
        torch.testing.assert_close(view.pixels[..., c, :, :], uvl[..., :2], rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(view.depth[..., c, :], uvl[..., 2], rtol=1e-12, atol=1e-12)
    assert rig(points.float()).pixels.dtype == torch.float32


def test_select_and_len():
    rig = CameraRig(make_cameras())
    some = rig.select([2, 0])
    assert len(rig) == 3 and len(some) == 2
    assert some.names == ("right", "left") and rig.names == ("left", "front", "right")
    points = torch.randn(6, 3, dtype=torch.float64)
    assert torch.equal(some(points).depth, rig(points).depth[[2, 0]])
    assert torch.equal(rig.select([-1]).matrix[0], rig.matrix[2])
    with pytest.raises(CameraError, match="0 to 2"):
        rig.select([3])
    for wrong in ([], [True, False, True], torch.tensor([True, False, True])):
        with pytest.raises(CameraError, match="0 to 2"):
            rig.select(wrong)
    assert some.double().state_dict().keys() == rig.state_dict().keys()


def test_scaled_keeps_the_middles_of_pixels_in_place():
    """A pixel of the small image is the mean of a block of the large one: so are its centre's rays."""
    rig = CameraRig(make_cameras())
    small = rig.scaled(120, 160)
    assert small.size == (120, 160) and rig.size == (480, 640)
    points = torch.randn(9, 3, dtype=torch.float64)
    u, v = rig(points).pixels.unbind(-1)
    expected = torch.stack([(u + 0.5) / 4 - 0.5, (v + 0.5) / 4 - 0.5], -1)
    torch.testing.assert_close(small(points).pixels, expected, rtol=1e-12, atol=1e-10)
    torch.testing.assert_close(small.scaled(480, 640).matrix, rig.matrix, rtol=1e-12, atol=1e-10)
    torch.testing.assert_close(
        rig.scaled(120, 320)(points).pixels[..., 0], (u + 0.5) / 2 - 0.5, rtol=1e-12, atol=1e-10
    )


def test_rigs_of_a_rig_have_tensors_of_their_own():
    rig = CameraRig(make_cameras())
    before = {name: value.clone() for name, value in rig.state_dict().items()}
    for other in (rig.scaled(120, 160), rig.select([0, 1, 2])):
        other.load_state_dict({name: value + 1 for name, value in before.items()})
    assert all(torch.equal(value, before[name]) for name, value in rig.state_dict().items())
    with pytest.raises(InputError, match="precision of CameraRig"):
        rig.half()


@pytest.mark.parametrize("path", ["cameras.toml", Path("cameras.toml")])
def test_a_file_is_no_rig(path):
    with pytest.raises(CameraError, match=r"got 'cameras\.toml'; load_cameras reads them"):
        as_rig(path)


def test_scaled_needs_sizes():
    rig = CameraRig([PinholeCamera(400, 400, 320, 240, name="unsized")])
    assert rig.size is None and rig.sizes == (None,)
    rig.check_images("masks", (1, 7, 9))  # any size will do
    with pytest.raises(CameraError, match="'unsized' has no image size"):
        rig.scaled(120, 160)
    with pytest.raises(InputError, match="positive sides"):
        CameraRig(make_cameras()).scaled(0, 160)


@pytest.mark.parametrize("fisheye", [False, True])
@pytest.mark.parametrize("dtype", [np.uint8, bool, np.float32])
def test_undistort_moves_spots_to_where_forward_puts_them(fisheye, dtype):
    distortions = (0.05, -0.02, 0.01, 0.0) if fisheye else DISTORTIONS
    rig = CameraRig(make_cameras(distortions, fisheye))
    points = torch.tensor([[0.6, 0.4, 0.1], [-0.7, -0.3, 0.3], [0.1, 0.5, -0.2]]).double()
    images = np.zeros((2, 3, 480, 640), dtype)
    for c in range(3):
        pose = [cv2.Rodrigues(rig.rotation[c].numpy())[0], rig.translation[c].numpy()]
        K, d, X = rig.matrix[c].numpy().copy(), np.array(distortions), points.numpy()[:, None]
        skew, K[0, 1] = K[0, 1], 0.0  # OpenCV passes over it
        project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
        seen = project(X, *pose, K, d)[0]
        seen[..., 0] += skew * (seen[..., 1] - K[1, 2]) / K[1, 1]
        for u, v in seen[:, 0]:
            disc = np.hypot(*(np.mgrid[:480, :640] - np.array([v, u])[:, None, None])) < 4
            images[:, c][:, disc] = 1 if dtype is bool else 200
    straight = rig.undistort(images)
    assert straight.dtype == images.dtype and straight.shape == images.shape
    pixels = rig(points).pixels
    v, u = torch.meshgrid(torch.arange(480), torch.arange(640), indexing="ij")
    for c in range(3):
        moved = 0.0
        for p in pixels[c]:
            near = (u - p[0]) ** 2 + (v - p[1]) ** 2 < 8**2
            weight = torch.from_numpy(straight[1, c].astype(float)) * near
            centre = torch.stack([(weight * u).sum(), (weight * v).sum()]) / weight.sum()
            assert (centre - p).norm() < 0.4
            before = torch.from_numpy(images[1, c].astype(float)) * near
            moved = max(moved, float((before - weight).abs().sum() / weight.sum()))
        assert moved > 0.3  # without it the spots would be elsewhere
    tensor = rig.undistort(torch.from_numpy(images))
    assert isinstance(tensor, torch.Tensor) and np.array_equal(tensor.numpy(), straight)


@pytest.mark.parametrize(
    "distortions, fisheye",
    [
        ((-0.27, 0.09, 0, 0, -0.015), False),
        ((-0.35,), False),
        ((0.2, -0.05), True),
        ((), True),
        ((0.0, 0.0, 0.0, 0.0), True),
    ],
)
def test_undistort_points_is_the_inverse_of_opencv_out_to_the_corners(distortions, fisheye):
    camera = PinholeCamera(
        900, 900, 959.5, 539.5, 1920, 1080, distortions=distortions, fisheye=fisheye
    )
    sides = torch.linspace(-0.6, 0.6, 7).double(), torch.linspace(-0.4, 0.4, 5).double()
    rays = torch.cartesian_prod(*sides)
    points = torch.cat([rays, torch.ones_like(rays[:, :1])], -1).numpy()[:, None]
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    d = np.zeros(4)
    d[: len(distortions)] = distortions[:4]
    d = d if fisheye else np.append(d, distortions[4:] or 0.0)
    seen = project(points, np.zeros(3), np.zeros(3), camera.matrix.numpy(), d)[0]
    pixels = torch.from_numpy(seen).reshape(1, -1, 2)
    wanted = 900 * rays + torch.tensor([959.5, 539.5])
    found = CameraRig([camera]).undistort_points(pixels)[0]
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    "distortions", [(-0.3,), (-0.3, 0.1, 0.001), (-0.3, 0.1, 0, 0, 0.01, 0.02)]
)
def test_maps_take_any_number_of_distortions(distortions):
    camera = PinholeCamera(50, 50, 31.5, 23.5, 64, 48, distortions=distortions)
    found = undistortion_maps(camera.matrix, camera.distortions, False, (64, 48))
    d = np.zeros(8)
    d[: len(distortions)] = distortions
    K = camera.matrix.numpy()
    wanted = cv2.initUndistortRectifyMap(K, d, np.eye(3), K, (64, 48), cv2.CV_32FC1)
    np.testing.assert_allclose(found, wanted, atol=1e-5)


def test_cameras_without_distortion_take_one_reading_of_values():
    """Each waits for a GPU, in every live step."""

    class Count(TorchDispatchMode):
        readings = 0

        def __torch_dispatch__(self, function, types, args=(), kwargs=None):
            self.readings += function is torch.ops.aten._local_scalar_dense.default
            return function(*args, **(kwargs or {}))

    rig, points = CameraRig(make_cameras()), torch.zeros(3, 5, 2, dtype=torch.float64)
    with Count() as count:
        assert rig.undistort_points(points) is points
    assert count.readings == 1


def test_undistort_points_has_nothing_where_no_ray_ends():
    camera = PinholeCamera(900, 900, 959.5, 539.5, 1920, 1080, distortions=(-0.35,))
    pixels = torch.tensor([[[959.5, 539.5], [1900.0, 1000.0], [math.nan, 0.0]]]).double()
    found = CameraRig([camera]).undistort_points(pixels)[0]
    torch.testing.assert_close(found[0], pixels[0, 0])
    assert found[1].isnan().all() and found[2, 0].isnan()


def test_undistort_colour_and_nothing_to_do():
    rig = CameraRig(make_cameras())
    images = np.random.default_rng(0).integers(0, 255, (3, 480, 640, 3), dtype=np.uint8)
    assert np.array_equal(rig.undistort(images), images)
    bent = CameraRig(make_cameras(DISTORTIONS))
    grey = np.stack([bent.undistort(np.ascontiguousarray(images[..., i])) for i in range(3)], -1)
    assert np.array_equal(bent.undistort(images), grey)
    with pytest.raises(CameraError, match=r"rig.scaled\(240, 320\)"):
        rig.undistort(np.zeros((3, 240, 320), bool))
    with pytest.raises(CameraError, match="of 3 cameras"):
        rig.undistort(np.zeros((2, 480, 640), bool))
    with pytest.raises(InputError, match=r"images must be of bool, uint8, .* got int64"):
        bent.undistort(torch.zeros(3, 480, 640, dtype=torch.int64))
    for dtype in (torch.int64, torch.float16):
        with pytest.raises(InputError, match="points must be"):
            bent.undistort_points(torch.zeros(3, 5, 2, dtype=dtype))
    with pytest.raises(CameraError, match=r"\[\.\.\., C, H, W\]"):
        rig.undistort(np.zeros((480, 640), bool))


def test_load(tmp_path):
    cameras = make_cameras(DISTORTIONS)
    save_cameras(cameras, tmp_path / "rig.toml")
    rig = CameraRig.load(tmp_path / "rig.toml")
    assert rig.names == ("left", "front", "right") and rig.size == (480, 640)
    for name, buffer in CameraRig(cameras).state_dict().items():
        torch.testing.assert_close(rig.state_dict()[name], buffer, rtol=0, atol=0)


def test_as_rig():
    cameras = make_cameras()
    rig = CameraRig(cameras)
    assert as_rig(rig) is rig
    assert as_rig(cameras[1]).names == ("front",)
    assert as_rig(cameras).names == as_rig(iter(cameras)).names == rig.names
    by_name = as_rig({"a": cameras[0], "b": cameras[0]})
    assert by_name.names == ("a", "b") and cameras[0].name == "left"
    assert as_rig([PinholeCamera(1, 1, 0, 0), PinholeCamera(1, 1, 0, 0)]).names == (
        "cam_01",
        "cam_02",
    )
    for bad in (3, [], ["front"], None, {"a": 1}):
        with pytest.raises(CameraError):
            as_rig(bad)
    with pytest.raises(CameraError, match="names of their own"):
        CameraRig([cameras[0], cameras[0]])
    with pytest.raises(CameraError, match="at most 4 distortions"):
        CameraRig(make_cameras((0.1,) * 5, fisheye=True))
