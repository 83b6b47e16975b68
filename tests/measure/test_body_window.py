"""Windows about persons: places, cuts, borders and moves, against plain arithmetic."""

import numpy as np
import pytest
import torch

from torchpose.errors import InputError
from torchpose.measure._body_window import (
    CELL,
    CELLS,
    COLOURS,
    cell_centres,
    cells_to_pixels,
    cut_windows,
    follow_faces,
    inside_image,
    move_maps,
    pixels_to_cells,
    place_windows,
)
from torchpose.measure._grid_filter import gaussian_matrix

pytest.importorskip("cv2")
FACES = torch.tensor([[317.3, 118.9, 77.4], [60.0, 400.0, 31.0], [900.0, 300.0, 410.0]])


def ramp(height, width):
    """An image whose red grows with x, green with y."""
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 255 // width, y * 255 // height, 0 * x], -1).astype(np.uint8)


def test_windows_are_near_their_faces():
    anchors = place_windows(FACES)
    faces = FACES.double()
    assert ((anchors[:, :2] - faces[:, :2]).abs() < 0.06 * faces[:, 2:]).all()
    assert ((anchors[:, 2] / faces[:, 2]).log().abs() < 0.05).all()


def test_a_window_shows_the_image_where_its_cells_say():
    image = ramp(480, 640)
    anchors = place_windows(FACES[:1])
    window = cut_windows(image, anchors)[0]
    assert window.shape == (CELLS[0] * COLOURS, CELLS[1] * COLOURS, 3)
    at = (cell_centres(COLOURS).double() * anchors[0, 2] + anchors[0, :2])[None].flatten(1, 2)
    x, y = at[0].T.view(2, *window.shape[:2])
    inside = (x > 2) & (x < 637) & (y > 2) & (y < 477)
    assert (torch.from_numpy(window[..., 0]) - x * 255 / 640).abs()[inside].max() < 2
    assert (torch.from_numpy(window[..., 1]) - y * 255 / 480).abs()[inside].max() < 2


def test_large_images_are_cut_like_small_ones():
    rng = np.random.default_rng(0)
    import cv2

    image = cv2.GaussianBlur(rng.integers(0, 256, (480, 640, 3), dtype=np.uint8), (0, 0), 4)
    face = torch.tensor([[320.0, 150.0, 76.0]])
    small = cut_windows(image, place_windows(face))[0]
    large = cv2.resize(image, None, fx=6, fy=6, interpolation=cv2.INTER_LINEAR)
    anchors = place_windows(torch.tensor([[6 * 320.5 - 0.5, 6 * 150.5 - 0.5, 6 * 76.0]]))
    other = cut_windows(large, anchors)[0]
    assert np.abs(small.astype(int) - other).mean() < 4  # they differ by their anchors' rounding


def test_the_border_of_the_image():
    anchors = place_windows(FACES[1:2])
    inside = inside_image(anchors, 640, 480, per_cell=2)
    at = cell_centres(2).double() * anchors[0, 2] + anchors[0, :2]
    whole = CELL / 2 * anchors[0, 2]
    for axis, size in ((0, 640), (1, 480)):
        far_out = (at[..., axis] < -0.5 - whole) | (at[..., axis] > size - 0.5 + whole)
        assert (inside[0][far_out] == 0).all()
    within = ((at > whole) & (at < torch.tensor([640.0, 480.0]) - whole)).all(-1)
    assert (inside[0][within] > 0.999).all()
    area = float(inside.double().sum()) * float(whole) ** 2
    window = anchors[0, :2] - anchors[0, 2] * torch.tensor([4.8, 3.2])
    size = anchors[0, 2] * torch.tensor([9.6, 8.8])
    low, high = (window + 0.5).clamp_min(0), (window + size + 0.5).minimum(torch.tensor([640, 480]))
    assert area == pytest.approx(float((high - low).prod()), rel=1e-5)


def test_a_window_beside_the_image_is_no_error():
    anchors = place_windows(torch.tensor([[5000.0, -3000.0, 40.0]]))
    assert cut_windows(ramp(48, 64), anchors)[0].shape == (352, 384, 3)
    assert inside_image(anchors, 64, 48).sum() == 0


def test_windows_stay_while_the_face_is_near():
    anchors = place_windows(FACES)
    near = FACES.double() + torch.tensor([0.3, -0.3, 0.1]) * FACES[:, 2:]
    assert torch.equal(follow_faces(anchors, near)[0], anchors)
    far = near.clone()
    far[1, 0] += 0.6 * 31
    far[2, 2] *= 1.3
    after, moved = follow_faces(anchors, far)
    assert moved.tolist() == [False, True, True]
    torch.testing.assert_close(after[1:], place_windows(far[1:]))


def test_pixels_and_cells_are_inverse():
    anchors = place_windows(FACES)
    points = torch.rand(3, 5, 2, dtype=torch.float64) * 500
    cells = pixels_to_cells(points, anchors)
    torch.testing.assert_close(cells_to_pixels(cells, anchors), points)
    first = cell_centres()[0, 0].double() * anchors[:, 2:] + anchors[:, :2]
    assert pixels_to_cells(first[:, None], anchors).abs().max() < 1e-5


def test_what_is_in_the_image_stays_there_when_a_window_moves():
    old = place_windows(torch.tensor([[320.0, 150.0, 76.0]]))
    new = place_windows(torch.tensor([[362.0, 120.0, 83.0]]))
    spot = torch.tensor([[[250.0, 330.0]]], dtype=torch.float64)

    def bump(anchors):
        at = cell_centres().double() - (pixels_to_cells(spot, anchors)[0, 0] + 0.5) * CELL
        at = at - torch.tensor([-4.8, -3.2])
        return (-0.5 * (at * anchors[0, 2] / 20).square().sum(-1)).exp()[None, None].float()

    torch.testing.assert_close(move_maps(bump(old), old, new), bump(new), atol=0.03, rtol=0)
    assert move_maps(torch.ones_like(bump(old)), old, new).min() == 0


def test_gaussian_matrices_blur_and_move():
    row = torch.zeros(21)
    row[8] = 1.0
    out = gaussian_matrix(21, 1.3, torch.tensor(2.4)) @ row
    place = torch.arange(21.0)
    expected = (-0.5 * ((place - 10.4) / 1.3) ** 2).exp()
    torch.testing.assert_close(out, expected / expected.sum(), atol=1e-5, rtol=0)
    assert gaussian_matrix(21, 2.5).sum(0) == pytest.approx(1.0)


def test_faces_without_a_size_are_refused():
    with pytest.raises(InputError, match="positive size"):
        place_windows(torch.tensor([[1.0, 2.0, 0.0]]))
