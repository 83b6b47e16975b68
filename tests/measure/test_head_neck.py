"""Head and neck beside the face."""

import numpy as np
import pytest
import torch

from torchpose import load_prior
from torchpose.errors import InputError
from torchpose.measure import HeadNeck, UpperBodyMeasurer
from torchpose.measure._head import FACE_OFFSETS


def test_offsets_and_covariances_are_those_of_drawn_faces():
    generator = torch.Generator().manual_seed(0)
    face = torch.tensor([[300.0, 100.0, 80.0]], dtype=torch.float64)
    root = torch.tensor([[2.0, 0, 0], [0.5, 3, 0], [1.0, -1, 4]], dtype=torch.float64)
    points, cov = HeadNeck()(face, (root @ root.T)[None])
    n = 200_000
    drawn = face + torch.randn(n, 3, generator=generator, dtype=torch.float64) @ root.T
    for joint, (down, std) in enumerate(
        [(FACE_OFFSETS.head, FACE_OFFSETS.head_std), (FACE_OFFSETS.neck, FACE_OFFSETS.neck_std)]
    ):
        noise = torch.randn(n, 2, generator=generator, dtype=torch.float64)
        place = drawn[:, :2] + 80 * torch.tensor(std) * noise
        place[:, 1] += down * drawn[:, 2]
        torch.testing.assert_close(points[0, joint], place.mean(0), rtol=0, atol=0.1)
        torch.testing.assert_close(cov[0, joint], place.T.cov(), rtol=0.02, atol=0.6)


def test_everything_scales_with_the_face():
    faces = torch.tensor([[300.0, 100.0, 80.0], [300.0, 100.0, 160.0]])
    points, cov = HeadNeck()(faces)
    centre = faces[:, None, :2].double()
    torch.testing.assert_close(2 * (points[:1] - centre[:1]), points[1:] - centre[1:])
    torch.testing.assert_close(4 * cov[0], cov[1])
    assert HeadNeck()(faces[:0])[0].shape == (0, 2, 2)


@pytest.mark.parametrize(
    ("options", "neck"),
    [
        ({}, 0.95),
        ({"elbows": False}, 1.0),
        ({"hands": "grid"}, 1.0),
        ({"hands": "mean-shift"}, 1.0),
    ],
)
def test_neck_is_farther_down_where_no_network_measures_elbows(options, neck):
    measurer = UpperBodyMeasurer(load_prior("kinect-upper-body-small"), **options)
    assert float(measurer.head_neck.offset[1, 1]) == pytest.approx(neck)


def test_bad_offsets_are_refused():
    with pytest.raises(InputError, match="positive"):
        HeadNeck(FACE_OFFSETS._replace(head_std=(0.0, 0.1)))


def test_bad_use_of_a_measurer_is_refused():
    prior = load_prior("kinect-upper-body-small")
    with pytest.raises(InputError, match="head_neck must be a HeadNeck, got int"):
        UpperBodyMeasurer(prior, head_neck=3)
    measurer, image = UpperBodyMeasurer(prior, hands="mean-shift"), np.zeros((48, 64, 3), np.uint8)
    with pytest.raises(InputError, match=r"a frame must be RGB.*, got \[0, 64, 3\]"):
        measurer.step(measurer.init(), image[:0])
    with pytest.raises(InputError, match="state must be a MeasurerState, got NoneType; begin with"):
        measurer.step(None, image)
