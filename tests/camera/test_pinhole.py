"""Camera: explicit products, round trips, finite differences, files, OpenCV."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.data import data_dir_or_skip
from torchpose.camera import (
    CameraRig,
    PinholeCamera,
    ViewRange,
    lift,
    load_cameras,
    map_pixels,
    project,
    sample_viewpoints,
    save_cameras,
)
from torchpose.camera._pinhole import read_cameras
from torchpose.camera._projection import backproject, check_intrinsics, map_pixel_covariance
from torchpose.camera._viewpoints import PAPER_VIEWS
from torchpose.errors import CameraError, FileFormatError, InputError, OutputError, ShapeError
from torchpose.math import euler_to_matrix

K = torch.tensor([[525.0, 0, 319.5], [0, 510.0, 239.5], [0, 0, 1]], dtype=torch.float64)
K_SKEWED = torch.tensor([[700.0, 3.0, 400], [0, 650.0, 300], [0, 0, 1]], dtype=torch.float64)


def scene(*batch: int, joints: int = 5, seed: int = 0, dtype=torch.float64):
    """Points within half a metre, seen from about 2 m."""
    g = torch.Generator().manual_seed(seed)
    draw = lambda *s: torch.rand(*s, generator=g, dtype=torch.float64) - 0.5  # noqa: E731
    R = euler_to_matrix(draw(*batch, 3))
    t = draw(*batch, 3) + torch.tensor([0, 0, 2.0], dtype=torch.float64)
    return draw(*batch, joints, 3).to(dtype), R.to(dtype), t.to(dtype)


def test_project_is_the_explicit_product():
    """(BL 3) joint by joint with a 3 x 4 matrix, as the released code writes it."""
    points, R, t = scene(6)
    uvl = project(points, K, R, t)
    for b in range(6):
        P = K @ torch.cat([R[b], t[b, :, None]], 1)
        for j in range(5):
            u, v, depth = P @ torch.cat([points[b, j], torch.ones(1, dtype=torch.float64)])
            expected = torch.stack([u / depth, v / depth, depth])
            torch.testing.assert_close(uvl[b, j], expected, rtol=1e-13, atol=1e-12)


@pytest.mark.parametrize("order", ["zxy", "zyx"])
def test_lift_is_the_papers_inverse(order):
    """(BL 5) with the columns of P, solved."""
    points, _, t = scene(4)
    R = euler_to_matrix(torch.rand(4, 3, dtype=torch.float64), order)
    uvl = project(points, K_SKEWED, R, t)
    P = K_SKEWED @ torch.cat([R, t[..., None]], -1)
    homogeneous = torch.cat([uvl[..., :2] * uvl[..., 2:], uvl[..., 2:]], -1)
    expected = torch.linalg.solve(P[..., :3], (homogeneous - P[..., None, :, 3]).mT).mT
    lifted = lift(uvl, K_SKEWED, R, t)
    torch.testing.assert_close(lifted, expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(lifted, points, rtol=0, atol=1e-12)


@settings(max_examples=50, deadline=None)
@given(
    st.integers(0, 10_000),
    st.floats(100, 3000),
    st.floats(100, 3000),
    st.floats(-500, 2000),
    st.floats(-5, 5),
)
def test_round_trip(seed, fx, fy, cx, skew):
    points, R, t = scene(3, seed=seed)
    matrix = torch.tensor([[fx, skew, cx], [0, fy, 240], [0, 0, 1]], dtype=torch.float64)
    back = lift(project(points, matrix, R, t), matrix, R, t)
    torch.testing.assert_close(back, points, rtol=0, atol=1e-10)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.bfloat16, 0.5)])
def test_other_dtypes(dtype, tolerance):
    points, R, t = scene(2, 3, dtype=dtype)
    back = lift(project(points, K.to(dtype), R, t), K.to(dtype), R, t)
    assert back.dtype == dtype
    torch.testing.assert_close(back, points, rtol=0, atol=tolerance)


def test_points_and_cameras_of_both_precisions():
    points, R, t = scene(2, 3, dtype=torch.float32)
    wide = project(points.double(), K, R.double(), t.double())
    torch.testing.assert_close(project(points, K, R, t), wide, rtol=0, atol=0)
    back = lift(wide.float(), K, R, t)
    assert back.dtype == torch.float64
    torch.testing.assert_close(back, points.double(), rtol=0, atol=1e-5)


def test_leading_dimensions_broadcast():
    points, R, t = scene(4)
    many = project(points[0], K, R, t)  # one body, four views
    assert many.shape == (4, 5, 3)
    cameras = torch.stack([K, K_SKEWED])[:, None]
    both = project(points, cameras, R, t)
    torch.testing.assert_close(both[1], project(points, K_SKEWED, R, t))
    torch.testing.assert_close(lift(both, cameras, R, t), points.expand(2, 4, 5, 3))


def test_backproject_is_the_inverse_matrix():
    uvl = torch.tensor([[[100.0, 50.0, 2.0]]], dtype=torch.float64)
    expected = torch.linalg.inv(K_SKEWED) @ torch.tensor([200.0, 100.0, 2.0]).double()
    torch.testing.assert_close(backproject(uvl, K_SKEWED)[0, 0], expected)


def test_gradients():
    points, R, t = (x.requires_grad_() for x in scene(2, joints=2))
    matrix = K_SKEWED.clone().requires_grad_()
    assert torch.autograd.gradcheck(project, (points, matrix, R, t))
    uvl = project(points, K, R, t).detach().requires_grad_()
    assert torch.autograd.gradcheck(lift, (uvl, matrix, R, t))


def test_map_pixels_sees_the_same_ray():
    points, *_ = scene(3)
    eye, ahead = torch.eye(3, dtype=torch.float64), torch.tensor([0.0, 0, 2]).double()
    first = project(points, K, eye, ahead)
    second = project(points, K_SKEWED, eye, ahead)
    torch.testing.assert_close(map_pixels(first[..., :2], K, K_SKEWED), second[..., :2])
    torch.testing.assert_close(map_pixels(second[..., :2], K_SKEWED, K), first[..., :2])


def test_map_pixels_keeps_missing_ones_missing():
    uv = torch.tensor([[math.nan, math.nan], [3.0, 4.0]], dtype=torch.float64)
    mapped = map_pixels(uv, K, K_SKEWED)
    assert mapped.isnan().tolist() == [[True, True], [False, False]]


def test_pixel_covariance_by_finite_differences():
    uv = torch.tensor([200.0, 100.0], dtype=torch.float64)
    step = 1e-3 * torch.eye(2, dtype=torch.float64)
    for K_from, K_to in ((K, K_SKEWED), (K_SKEWED, K)):
        slope = torch.stack(
            [(map_pixels(uv + s, K_from, K_to) - map_pixels(uv - s, K_from, K_to)) / 2e-3
             for s in step], -1)  # fmt: skip
        C = torch.tensor([[4.0, 1.0], [1.0, 9.0]], dtype=torch.float64).expand(3, 2, 2)
        expected = slope @ C @ slope.mT
        torch.testing.assert_close(map_pixel_covariance(C, K_from, K_to), expected)


def test_pixel_covariance_by_samples():
    g = torch.Generator().manual_seed(0)
    C = torch.tensor([[4.0, 1.0], [1.0, 9.0]], dtype=torch.float64)
    noise = torch.randn(200_000, 2, generator=g, dtype=torch.float64) @ torch.linalg.cholesky(C).mT
    sampled = map_pixels(noise, K, K_SKEWED).T.cov()
    torch.testing.assert_close(map_pixel_covariance(C, K, K_SKEWED), sampled, rtol=0.02, atol=0.05)


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_on_cuda():
    views = sample_viewpoints(4, generator=torch.Generator("cuda").manual_seed(0))
    points, matrix = (x.cuda() for x in (scene(4)[0], K))
    R = euler_to_matrix(views.angles)
    uvl = project(points, matrix, R, views.translation)
    torch.testing.assert_close(lift(uvl, matrix, R, views.translation), points)
    # a matrix that is still on the CPU follows the pixels
    assert map_pixels(uvl[..., :2], K, K_SKEWED).is_cuda
    assert PinholeCamera(500, 500, 320, 240).cuda()(points).is_cuda


def test_shapes_are_checked():
    points, R, t = scene(2)
    with pytest.raises(ShapeError, match="points"):
        project(points[..., :2], K, R, t)
    with pytest.raises(ShapeError, match="K must"):
        lift(points, K[:2], R, t)
    with pytest.raises(ShapeError, match="R must"):
        project(points, K, R[..., :2], t)
    with pytest.raises(ShapeError, match="uv must"):
        map_pixels(points, K, K)
    with pytest.raises(ShapeError, match="covariance"):
        map_pixel_covariance(K, K, K)


@pytest.mark.parametrize(
    ("bad", "word"),
    [
        (torch.zeros(3, 3), "positive focal"),
        (torch.diag(torch.tensor([-500.0, 500, 1])), "positive focal"),
        (torch.diag(torch.tensor([math.nan, 500, 1])), "finite"),
        (torch.diag(torch.tensor([math.inf, 500, 1])), "finite"),
        (torch.diag(torch.tensor([500.0, 500, 2])), r"\[0, 0, 1\]"),
        (torch.tensor([[500.0, 0, 0], [1, 500, 0], [0, 0, 1]]), r"\[0, 0, 1\]"),
        (torch.eye(2), "shape"),
        (torch.ones(3), "shape"),
    ],
)
def test_what_is_no_camera_matrix(bad, word):
    with pytest.raises(CameraError, match=word):
        check_intrinsics("K", bad)


# --- viewpoints -----------------------------------------------------------------------------------


def test_viewpoints_fill_their_range_and_nothing_else():
    views = ViewRange(roll=0.1, pitch=0.2, yaw=0, tx=(-0.2, 0.4), ty=(-0.45, -0.05), tz=(1.5, 2.5))
    angles, translation = sample_viewpoints(5000, views, torch.Generator().manual_seed(0))
    assert angles.dtype == torch.float64
    drawn = torch.cat([angles, translation], 1)
    low = torch.tensor([-0.1, -0.2, 0, -0.2, -0.45, 1.5], dtype=torch.float64)
    high = torch.tensor([0.1, 0.2, 0, 0.4, -0.05, 2.5], dtype=torch.float64)
    assert bool(((drawn >= low) & (drawn <= high)).all())
    # mean of a uniform variable, within four standard errors
    error = (high - low) / math.sqrt(12 * 5000)
    assert bool(((drawn.mean(0) - (low + high) / 2).abs() <= 4 * error + 1e-12).all())


def test_viewpoints_repeat_with_their_generator():
    first, second = (sample_viewpoints(3, generator=torch.Generator().manual_seed(1)) for _ in "ab")
    assert torch.equal(first.angles, second.angles)
    assert sample_viewpoints(0).translation.shape == (0, 3)
    assert sample_viewpoints(2, dtype=torch.float32).angles.dtype == torch.float32
    assert PAPER_VIEWS.pitch == pytest.approx(math.radians(30))


@pytest.mark.parametrize("wrong", [{"roll": -0.1}, {"tz": (2.0, 1.0)}, {"tx": (math.nan, 1.0)}])
def test_wrong_view_range(wrong):
    with pytest.raises(InputError, match=f"ViewRange.{next(iter(wrong))}"):
        ViewRange(**wrong)


def test_wrong_number_of_viewpoints():
    with pytest.raises(InputError, match="negative"):
        sample_viewpoints(-1)


# --- the module and its file ----------------------------------------------------------------------


def test_camera_keeps_its_matrix():
    camera = PinholeCamera(525, 520, 319.5, 239.5, 640, 480, "kinect")
    assert camera.matrix.dtype == torch.float64
    assert camera.matrix.tolist() == [[525, 0, 319.5], [0, 520, 239.5], [0, 0, 1]]
    assert camera.image_size == (640, 480)
    assert "kinect" in repr(camera)
    assert set(camera.state_dict()) == {"matrix", "distortions", "rotation", "translation"}


def test_camera_of_an_image_size():
    camera = PinholeCamera.from_image_size(1280, 720)
    assert camera.matrix.tolist() == [[1050, 0, 639.5], [0, 1050, 359.5], [0, 0, 1]]


@pytest.mark.parametrize("kind", [torch.tensor, np.array, list])
def test_camera_of_a_matrix(kind):
    camera = PinholeCamera.from_matrix(
        kind([[1000.0, 6, 800], [0, 1000, 600], [0, 0, 2]]), 640, 480
    )
    assert camera.matrix.tolist() == [[500, 3, 400], [0, 500, 300], [0, 0, 1]]


def test_forward_is_opencvs_projection():
    cv2 = pytest.importorskip("cv2")
    camera = PinholeCamera(
        500, 510, 320, 240, rotation=(0.2, -0.3, 0.1), translation=(0.1, 0.2, 3.0)
    )
    points = scene(1)[0][0]
    expected, _ = cv2.projectPoints(
        points.numpy(), camera.rotation.numpy(), camera.translation.numpy(),
        camera.matrix.numpy(), None,
    )  # fmt: skip
    torch.testing.assert_close(camera(points)[:, :2], torch.from_numpy(expected[:, 0]))
    assert camera(points.float()).dtype == torch.float32


@pytest.mark.parametrize("focal", [0.0, -525.0, math.nan, math.inf])
def test_camera_without_focal_length(focal):
    with pytest.raises(CameraError, match=r"focal|finite"):
        PinholeCamera(focal, 525, 320, 240)
    with pytest.raises(CameraError, match=r"focal|finite"):
        PinholeCamera(525, focal, 320, 240)


@pytest.mark.parametrize(
    "matrix",
    [np.zeros((3, 3)), np.eye(2), np.ones((3, 3)), "K", [[1], [2, 3]], np.eye(3) + 0j,
     torch.eye(3, dtype=torch.complex64)],
)  # fmt: skip
def test_camera_of_something_else(matrix):
    with pytest.raises(CameraError):
        PinholeCamera.from_matrix(matrix)


@pytest.mark.parametrize(
    "wrong",
    [{"width": 0}, {"width": 640.5}, {"height": "tall"}, {"rotation": (0, 0)},
     {"translation": (0, 0, math.nan)}, {"distortions": "none"}],
)  # fmt: skip
def test_camera_with_a_wrong_extra(wrong):
    with pytest.raises(CameraError, match=next(iter(wrong))):
        PinholeCamera(525, 525, 320, 240, **wrong)


def test_camera_of_a_wrong_image_size():
    for size in ((0, 480), (640, -1), (None, 480)):
        with pytest.raises(CameraError):
            PinholeCamera.from_image_size(*size)


def test_file_round_trip(tmp_path):
    cameras = [
        PinholeCamera(1 / 3, 500, 320.1, 240, 640, 480, 'left "wide"', skew=0.5,
                      distortions=(0.1, 1e-17), rotation=(1.0, 2.0, 3.0),
                      translation=(0.1, 0.2, 0.3), fisheye=True),
        PinholeCamera(525, 525, 320, 240, name="cam.2"),
    ]  # fmt: skip
    path = tmp_path / "cameras.toml"
    save_cameras(cameras, path)
    back = load_cameras(path)
    assert list(back) == ['left "wide"', "cam.2"]
    for camera, other in zip(cameras, back.values(), strict=True):
        for key, value in camera.state_dict().items():
            assert torch.equal(value, other.state_dict()[key]), key
        assert (other.image_size, other.fisheye) == (camera.image_size, camera.fisheye)
    assert torch.equal(PinholeCamera.load(path, "cam.2").matrix, cameras[1].matrix)
    assert list(tmp_path.iterdir()) == [path]


def test_what_was_read_can_be_written(tmp_path):
    save_cameras([PinholeCamera(1, 1, 0, 0, name=name) for name in "ab"], tmp_path / "read.toml")
    cameras = load_cameras(tmp_path / "read.toml")
    save_cameras(cameras, tmp_path / "written.toml")
    assert list(load_cameras(tmp_path / "written.toml")) == ["a", "b"]
    for wrong in (CameraRig(list(cameras.values())), ["a"], None):
        with pytest.raises(InputError, match="cameras must be PinholeCameras"):
            save_cameras(wrong, tmp_path / "written.toml")


def test_one_camera_needs_no_name(tmp_path):
    PinholeCamera(525, 525, 320, 240).save(tmp_path / "one.toml")
    assert PinholeCamera.load(tmp_path / "one.toml").matrix[0, 0] == 525


@pytest.mark.parametrize(
    ("text", "error", "word"),
    [
        ("not = [toml", FileFormatError, "TOML"),
        ("", FileFormatError, "none"),
        ("[metadata]\nerror = 0.0", FileFormatError, "none"),
        ("[cam]\nsize = [640, 480]", CameraError, r"\[cam\].*needs `matrix`"),
        (
            "[a]\nmatrix = [[500, 0, 320], [0, 500, 240], [0, 0, 1]]\nrotation = [0, 0, 0]\n"
            "[b]\nmatrix = [[500, 0, 320], [0, 500, 240], [0, 0, 1]]",
            CameraError,
            "a pose is `rotation` and `translation`, and translation is not there",
        ),
        ("[cam]\nmatrix = [[0, 0, 1], [0, 1, 1], [0, 0, 1]]", CameraError, r"\[cam\].*focal"),
        ("[cam]\nmatrix = [[1, 0, 1], [0, 1, 1]]", CameraError, "shape"),
        ("[cam]\nmatrix = 'K'", CameraError, "3 x 3"),
        ("[cam]\nmatrix = [[1,0,1],[0,1,1],[0,0,1]]\nsize = 3", CameraError, "size"),
        (
            "[cam]\nmatrix = [[1,0,1],[0,1,1],[0,0,1]]\ndistortion = [0.1]",
            CameraError,
            "expected `distortions`, got `distortion`",
        ),
        (
            "[cam]\nmatrix = [[1,0,1],[0,1,1],[0,0,1]]\nsise = [640, 480]",
            CameraError,
            "expected `size`, got `sise`",
        ),
        (
            "[cam]\nmatrix = [[1,0,1],[0,1,1],[0,0,1]]\ndist = [0.1, 0, 0, 0]",
            CameraError,
            "expected `distortions`, got `dist`",
        ),
        ("[cam]\nmatrix = [[1,0,1],[0,1,1],[0,0,1]]\nrotation = [1]", CameraError, "rotation"),
    ],
)
def test_foreign_files(tmp_path, text, error, word):
    path = tmp_path / "camera.toml"
    path.write_text(text)
    with pytest.raises(error, match=word) as caught:
        load_cameras(path)
    assert "camera.toml" in str(caught.value)


def test_files_that_are_not_there(tmp_path):
    with pytest.raises(InputError, match="no such"):
        load_cameras(tmp_path / "none.toml")
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FileFormatError):
        load_cameras(tmp_path / "bytes.toml")
    with pytest.raises(OutputError):
        PinholeCamera(525, 525, 320, 240).save(tmp_path / "no folder" / "camera.toml")


def test_which_of_several_cameras(tmp_path):
    camera = PinholeCamera(525, 525, 320, 240)
    save_cameras([camera, camera], tmp_path / "two.toml")
    for name in (None, "cam_03"):
        with pytest.raises(CameraError, match="cam_01, cam_02"):
            PinholeCamera.load(tmp_path / "two.toml", name)
    with pytest.raises(InputError, match="names of their own"):
        save_cameras([PinholeCamera(1, 1, 0, 0, name="a")] * 2, tmp_path / "same.toml")


MATRIX = "matrix = [[500, 0, 320], [0, 500, 240], [0, 0, 1]]"


def test_cameras_are_found_by_their_names_too(tmp_path):
    """Anipose numbers its tables, and `name` says what the user called the camera."""
    path = tmp_path / "anipose.toml"
    path.write_text(
        f'[cam_0]\nname = "left"\n{MATRIX}\n[cam_1]\nname = "right"\n{MATRIX}\n'
        f'[cam_2]\nname = "right"\n{MATRIX}\n[cam_3]\nname = ""\n{MATRIX}\n'
    )
    assert PinholeCamera.load(path, "left").name == PinholeCamera.load(path, "cam_0").name == "left"
    assert PinholeCamera.load(path, "cam_3").name == "cam_3"
    with pytest.raises(CameraError, match=r"no 'right'; it holds cam_0 \(left\), cam_1 \(right\),"):
        PinholeCamera.load(path, "right")


def test_files_that_editors_of_windows_wrote(tmp_path):
    path = tmp_path / "camera.toml"
    path.write_bytes(f"\ufeff[cam]\r\n{MATRIX}\r\n".encode())
    assert PinholeCamera.load(path).matrix[0, 0] == 500


@pytest.mark.parametrize("name", ["metadata", "\U000e0001 tag", "tab\t"])
def test_odd_names_come_back(tmp_path, name):
    PinholeCamera(525, 525, 320, 240, name=name).save(tmp_path / "camera.toml")
    assert list(load_cameras(tmp_path / "camera.toml")) == [name]


@pytest.mark.data
def test_the_pose2sim_calibration():
    """The file's cameras are those of the recording made with them."""
    folder = data_dir_or_skip("multicam_pose2sim")
    cameras = load_cameras(folder / "raw" / "Calib_qualisys.toml")
    recording = np.load(folder / "balancing_4cam.npz")
    assert list(cameras) == ["cam_01", "cam_02", "cam_03", "cam_04"]
    for i, camera in enumerate(cameras.values()):
        for ours, theirs in ((camera.matrix, "K"), (camera.rotation_matrix, "R"),
                             (camera.translation, "t")):  # fmt: skip
            expected = torch.from_numpy(recording[theirs][i]).double()
            torch.testing.assert_close(ours, expected, rtol=1e-6, atol=1e-5)
    points = torch.from_numpy(recording["joints"]).double()
    names, detected_names = list(recording["names"]), list(recording["openpose_names"])
    for i, camera in enumerate(cameras.values()):
        uv = camera(points)[:, names.index("Neck"), :2]
        detected = torch.from_numpy(recording["openpose_2d"][i]).double()
        detected = detected[:, detected_names.index("Neck")]
        seen = detected[:, 2] > 0.3
        assert float((uv - detected[:, :2]).norm(dim=-1)[seen].median()) < 20  # of 1920


def test_scaled_views_keep_their_middle() -> None:
    views = ViewRange(roll=0.2, pitch=0.1, yaw=0.4, tx=(-0.2, 0.4), ty=(0.1, 0.1), tz=(1.0, 3.0))
    narrow = views.scaled(0.5)
    assert (narrow.roll, narrow.pitch, narrow.yaw) == (0.1, 0.05, 0.2)
    assert narrow.tx == pytest.approx((-0.05, 0.25)) and narrow.ty == pytest.approx((0.1, 0.1))
    assert narrow.tz == pytest.approx((1.5, 2.5))
    assert views.scaled(1.0).tx == pytest.approx(views.tx)


CALISCOPE = """
CreationDate = 2023-05-06T11:12:27.631355
fps_recording = 24

[cam_0]
port = 0
size = [ 1280, 720,]
rotation_count = -1
matrix = [ [ 894.5, 0.0, 624.0,], [ 0.0, 896.9, 361.3,], [ 0.0, 0.0, 1.0,],]
distortions = [ -0.3, 0.1, -0.001, 0.003, -0.004,]
translation = [ -0.64, 0.26, 1.45,]
rotation = [ [ 0.0, -1.0, 0.0,], [ 0.6, 0.0, -0.8,], [ 0.8, 0.0, 0.6,],]
ignore = false

[cam_4]
port = 4
size = [ 1280, 720,]
ignore = true

[capture_volume]
stage = 2

[charuco]
columns = 4
units = "inch"
"""


def test_the_configuration_of_caliscope(tmp_path):
    """Its rotations are matrices, and tables of other things stand beside those of cameras."""
    path = tmp_path / "config.toml"
    path.write_text(CALISCOPE)
    cameras, (note,) = read_cameras(path)
    assert list(cameras) == list(load_cameras(path)) == ["cam_0"]
    assert "[cam_4], [capture_volume], [charuco] are passed over" in note
    expected = torch.tensor([[0, -1, 0], [0.6, 0, -0.8], [0.8, 0, 0.6]]).double()
    torch.testing.assert_close(cameras["cam_0"].rotation_matrix, expected)
    path.write_text(CALISCOPE.replace("ignore = true", "ignore = false"))
    with pytest.raises(CameraError, match=r"\[cam_4\]: a camera needs `matrix`"):
        load_cameras(path)


def test_cameras_below_one_table(tmp_path):
    path = tmp_path / "camera_array.toml"
    path.write_text(f"[cameras.0]\ncam_id = 0\n{MATRIX}\n[cameras.side]\n{MATRIX}\n")
    cameras, notes = read_cameras(path)
    assert [camera.name for camera in cameras.values()] == list(cameras) == ["cam_0", "side"]
    assert notes == ()


def test_poses_as_opencv_returns_them():
    rotation, translation = np.array([[0.2], [-0.3], [0.1]]), np.array([[0.1, 0.2, 3.0]])
    camera = PinholeCamera(500, 500, 320, 240, rotation=rotation, translation=translation)
    assert camera.rotation.tolist() == [0.2, -0.3, 0.1]
    assert camera.translation.tolist() == [0.1, 0.2, 3.0]
    again = PinholeCamera(500, 500, 320, 240, rotation=camera.rotation_matrix)
    torch.testing.assert_close(again.rotation, camera.rotation)
    for wrong in (2 * camera.rotation_matrix, -camera.rotation_matrix):
        with pytest.raises(CameraError, match="must be a rotation"):
            PinholeCamera(500, 500, 320, 240, rotation=wrong)
