"""Parts of images in the input of a model."""

import numpy as np
import pytest
import torch

from torchpose.measure._detectors.views import view, whole


def dotted(u, v, size=(200, 120)):
    image = np.zeros((size[1], size[0], 3), np.uint8)
    image[v - 2 : v + 3, u - 2 : u + 3] = 255
    return image


@pytest.mark.parametrize("centred", [True, False])
@pytest.mark.parametrize("box", [(0, 0, 200, 120), (40, 10, 110, 110), (-30, 20, 90, 150)])
@pytest.mark.parametrize("size", [(64, 64), (48, 64), (320, 160)])
def test_a_dot_is_where_the_view_says(centred, box, size):
    image = dotted(70, 60)
    seen = view(image, torch.tensor(box).double(), size, 114, centred)
    assert seen.pixels.shape == (size[1], size[0], 3)
    bright = np.argwhere(seen.pixels[..., 0] > 200)
    found = torch.from_numpy(bright.mean(0)[::-1].copy())
    expected = torch.tensor([70.0, 60.0]).double() * seen.scale + torch.tensor(seen.offset).double()
    torch.testing.assert_close(found, expected, atol=1.0, rtol=0)
    torch.testing.assert_close(seen.to_image(expected), torch.tensor([70.0, 60.0]).double())


def test_what_is_outside_is_filled():
    image = np.full((50, 100, 3), 200, np.uint8)
    middle = view(image, whole(image), (64, 64), 114).pixels
    assert middle[0, 32].tolist() == [114] * 3 and middle[32, 32].tolist() == [200] * 3
    corner = view(image, whole(image), (64, 64), 114, centred=False).pixels
    assert corner[0, 0].tolist() == [200] * 3 and corner[63, 32].tolist() == [114] * 3
