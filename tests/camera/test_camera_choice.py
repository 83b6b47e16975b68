"""Cameras for images of another size than the calibration's."""

import re

import pytest
import torch

from torchpose.camera import CameraRig, PinholeCamera
from torchpose.camera._choice import fit_to_size, held_camera, is_padded, resolve_camera
from torchpose.errors import CameraError, InputError

CAMERA = PinholeCamera(800, 810, 310, 250, 640, 480, "front", distortions=(0.1, -0.02),
                       rotation=(0.1, 0.2, 0.3), translation=(0, 0, 3))  # fmt: skip


def test_a_camera_is_scaled_as_a_rig_is():
    fitted, notes = fit_to_size(CAMERA, (320, 240), "a.npz")
    expected = CameraRig([CAMERA]).scaled(240, 320)
    assert torch.allclose(fitted.matrix, expected.matrix[0])
    assert fitted.image_size == (320, 240)
    for name in ("distortions", "rotation", "translation", "name", "fisheye"):
        before, after = getattr(CAMERA, name), getattr(fitted, name)
        assert torch.equal(before, after) if isinstance(before, torch.Tensor) else before == after
    assert notes == (
        "camera front is scaled from 640 x 480 pixels to the 320 x 240 pixels of a.npz",
    )


@pytest.mark.parametrize("size", [None, (640, 480), (632, 470)])
def test_the_same_size_and_that_of_a_codec_change_nothing(size):
    assert fit_to_size(CAMERA, size, "a.npz") == (CAMERA, ())


@pytest.mark.parametrize("size", [None, (640, 480)])
def test_four_numbers_are_of_the_inputs_images(size):
    camera, notes = resolve_camera("525,526,319.5,239.5", None, size, None, "clip.mp4")
    assert camera.image_size == size and notes == ()
    expected = PinholeCamera(525, 526, 319.5, 239.5)
    assert torch.equal(camera.matrix, expected.matrix)


def test_padding_is_less_than_a_block():
    assert is_padded((1088, 1920), (1080, 1920))
    assert not is_padded((1088, 1920), (1072, 1920))
    assert not is_padded((1080, 1920), (1088, 1920))


def test_images_of_another_shape_are_refused():
    with pytest.raises(CameraError, match=r"a\.npz: is of 640 x 360 pixels, and camera 'front'"):
        fit_to_size(CAMERA, (640, 360), "a.npz")


def test_images_that_are_turned_are_called_so():
    with pytest.raises(CameraError, match="turned by 90 degrees, so the calibration must be of"):
        fit_to_size(CAMERA, (480, 640), "a.npz")


def test_a_camera_of_one_person_fits_the_images_too(tmp_path):
    CAMERA.save(tmp_path / "c.toml")
    given = str(tmp_path / "c.toml")
    camera, notes = resolve_camera(given, None, (320, 240), None, "clip.mp4")
    expected = CameraRig([CAMERA]).scaled(240, 320)
    torch.testing.assert_close(camera.matrix, expected.matrix[0])
    assert camera.image_size == (320, 240)
    assert "scaled from 640 x 480" in notes[0] and len(notes) == 1
    torch.testing.assert_close(camera.distortions, CAMERA.distortions)
    camera, notes = resolve_camera(given, None, (632, 470), None, "clip.mp4")
    assert camera.image_size == (632, 470) and torch.equal(camera.matrix, CAMERA.matrix)
    with pytest.raises(CameraError, match="images of another shape are cut"):
        resolve_camera(given, None, (640, 360), None, "clip.mp4")


@pytest.mark.parametrize("given", [None, "525,525,319.5,239.5"])
def test_a_name_without_a_file_of_cameras_is_refused(given):
    with pytest.raises(InputError, match="--camera-name chooses"):
        resolve_camera(given, "left", (640, 480), None, "clip.mp4")


@pytest.mark.parametrize(("tilt", "roll"), [(None, 200.0), (-95.0, None), (0.0, -181.0)])
def test_angles_of_no_camera_are_named_in_degrees(tilt, roll):
    message = f"--tilt .*-90 and 90 degrees.*got {tilt or 0:g} and {roll or 0:g}"
    with pytest.raises(CameraError, match=message):
        held_camera(CAMERA, tilt, roll, None, None)


@pytest.mark.parametrize(
    ("numbers", "said"),
    [
        ("525,525,5000,239.5", r"\(5000, 239\.5\), lies outside of its images of 640 x 480 pixels"),
        ("525,319.5,525,239.5", "focal lengths 525 and 319.5 are far apart"),
        ("525,525,319.5,239.5", None),
        ("700,525,319.5,239.5", None),
    ],
)
def test_numbers_of_hardly_any_camera_are_noted(numbers, said):
    _, notes = resolve_camera(numbers, None, (640, 480), None, "clip.npz")
    fx, fy, cx, cy = map(float, numbers.split(","))
    matrix = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
    _, of_input = resolve_camera(None, None, (640, 480), matrix, "clip.npz")
    for found in (notes, of_input):
        assert found == () if said is None else re.search(said, " ".join(found))
