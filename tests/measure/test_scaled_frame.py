"""The frame in which a face has some 19 pixels, on drawn faces."""

import numpy as np
import pytest
import torch

from torchpose.measure._body_window import scale_frame, scales_of_faces
from torchpose.measure._skin import SkinModel

pytest.importorskip("cv2")

FACES = torch.tensor([[90.0, 60.0, 20.0], [250.0, 80.0, 62.0]])


@pytest.mark.parametrize(
    ("size", "width", "divisor"),
    [(9, 320, 1), (19, 320, 1), (62, 320, 3), (95, 320, 5), (19, 1280, 2)],
)
def test_a_face_has_some_19_pixels_and_no_side_more_than_640(size, width, divisor):
    face = torch.tensor([[100.0, 100.0, size]])
    assert scales_of_faces(face, np.zeros((240, width, 3), np.uint8)).tolist() == [divisor]


@pytest.mark.parametrize("divisor", [1, 3, 7])
def test_blocks_of_pixels_become_one_and_points_follow(divisor):
    image = np.random.default_rng(0).integers(0, 256, (210, 336, 3), np.uint8)
    view = scale_frame(image, None, FACES, divisor, SkinModel())
    assert view.bins.shape == (210 // divisor, 336 // divisor)
    middle = torch.tensor([(divisor - 1) / 2, (divisor - 1) / 2])  # of the first block
    torch.testing.assert_close(view.from_frame(middle), torch.zeros(2))
    points = torch.tensor([[[3.0, 9.0], [250.0, 11.0]]])
    torch.testing.assert_close(view.to_frame(view.from_frame(points)), points)
    torch.testing.assert_close(view.faces[:, 2], FACES[:, 2] / divisor)
    torch.testing.assert_close(view.faces[:, :2], view.from_frame(FACES[:, :2]))


def test_heads_of_all_and_background_are_not_usable():
    image, foreground = np.zeros((240, 360, 3), np.uint8), np.full((240, 360), 255, np.uint8)
    foreground[:, :30] = 0
    view = scale_frame(image, foreground, FACES, 3, SkinModel())
    x, y = view.faces[:, :2].round().long().unbind(1)
    assert not view.usable[y, x].any()
    assert not view.usable[:, :10].any() and view.usable[:, 10:20].all()
    # the neck is 0.4 faces to either side and ends 1.1 below
    big = view.faces[1]
    column = view.usable[:, int(big[0])]
    assert not column[int(big[1] + 1.0 * big[2])] and column[int(big[1] + 1.2 * big[2])]
    assert view.usable[int(big[1]), int(big[0] + 0.75 * big[2])]
