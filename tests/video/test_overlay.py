"""Persons drawn over a frame: the right pixels have the right colours, and nothing crashes."""

import math

import numpy as np
import pytest
import torch

from torchpose.errors import InputError, ShapeError
from torchpose.skeleton import UPPER_BODY
from torchpose.video._overlay import PERSON_TINTS, draw_overlay
from torchpose.viz._style import LEFT, RIGHT

GREY = 128
HAND_LEFT, ELBOW_LEFT, SHOULDER_LEFT, HEAD, NECK = range(5)
HAND_RIGHT = 7


def rgb(text: str) -> tuple[int, ...]:
    return tuple(int(text[i : i + 2], 16) for i in (1, 3, 5))


def frame(height: int = 480, width: int = 640) -> np.ndarray:
    return np.full((height, width, 3), GREY, dtype=np.uint8)


def one_person(shift: float = 0.0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Elbows and shoulders inferred."""
    points = [[420, 400], [410, 310], [370, 220], [320, 120], [320, 200], [270, 220], [230, 310],
              [220, 400]]  # fmt: skip
    poses = torch.tensor([points], dtype=torch.float64) + shift
    covariance = torch.diag(torch.tensor([900.0, 100.0])).double().expand(1, 8, 2, 2).clone()
    observed = torch.tensor([[True, False, False, True, True, False, False, True]])
    return poses, covariance, observed


def pixel(image: np.ndarray, point: torch.Tensor) -> tuple[int, ...]:
    u, v = (round(x) for x in point.tolist())
    return tuple(int(value) for value in image[v, u])


def close(a: tuple[int, ...], b: tuple[int, ...], tolerance: int = 12) -> bool:
    return all(abs(x - y) <= tolerance for x, y in zip(a, b, strict=True))


def test_measured_joints_are_filled_with_the_colour_of_their_side():
    poses, covariance, observed = one_person()
    image = draw_overlay(frame(), poses, covariance, observed)
    assert close(pixel(image, poses[0, HAND_LEFT]), rgb(LEFT))
    assert close(pixel(image, poses[0, HAND_RIGHT]), rgb(RIGHT))
    assert close(pixel(image, poses[0, HEAD]), rgb(PERSON_TINTS[0]))


def test_inferred_joints_are_rings_and_bones_have_the_colour_of_their_arm():
    poses, covariance, observed = one_person()
    image = draw_overlay(frame(), poses, covariance, observed)
    centre = poses[0, ELBOW_LEFT]
    assert close(pixel(image, centre), (255, 255, 255))
    ring = [pixel(image, centre + torch.tensor([r, 0.0])) for r in (3.0, 4.0, 5.0)]
    assert any(close(color, rgb(LEFT), tolerance=60) for color in ring)
    assert close(pixel(image, poses[0, HAND_LEFT] + torch.tensor([2.0, 0.0])), rgb(LEFT))
    forearm = (poses[0, HAND_LEFT] + poses[0, ELBOW_LEFT]) / 2
    assert close(pixel(image, forearm), rgb(LEFT))
    collar = (poses[0, NECK] + poses[0, SHOULDER_LEFT]) / 2
    assert close(pixel(image, collar), rgb(PERSON_TINTS[0]))


def test_the_ellipse_of_an_inferred_joint_has_the_half_axes_of_chi_square():
    poses, covariance, observed = one_person()
    poses[0, :, :] = torch.nan
    poses[0, ELBOW_LEFT] = torch.tensor([300.0, 200.0])
    image = draw_overlay(frame(), poses, covariance, observed)
    changed = (image != GREY).any(-1)
    rows, columns = np.nonzero(changed)
    radius = math.sqrt(-2 * math.log(1 - 0.9))  # of chi-square with two degrees of freedom
    assert (columns.max() - columns.min()) / 2 == pytest.approx(radius * 30, abs=1.5)
    assert (rows.max() - rows.min()) / 2 == pytest.approx(radius * 10, abs=1.5)
    turned = covariance.clone()
    angle = math.radians(30)
    R = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    turned[0, ELBOW_LEFT] = R.double() @ covariance[0, ELBOW_LEFT] @ R.double().T
    end = poses[0, ELBOW_LEFT] + radius * 30 * R[:, 0]
    assert pixel(draw_overlay(frame(), poses, turned, observed), end) != (GREY,) * 3
    measured = draw_overlay(frame(), poses, covariance, torch.ones_like(observed))
    assert (measured != GREY).any(-1).sum() < changed.sum()


def test_the_input_is_never_changed_and_can_be_a_view():
    poses, covariance, observed = one_person()
    image = frame(960, 1280)[::2, ::2]
    assert not image.flags.c_contiguous
    before = image.copy()
    drawn = draw_overlay(image, poses, covariance, observed)
    assert (image == before).all()
    assert drawn.flags.c_contiguous and drawn.shape == image.shape and drawn.dtype == np.uint8
    assert not np.shares_memory(drawn, image)


@pytest.mark.parametrize("joint", range(len(UPPER_BODY)))
def test_a_joint_that_is_nan_is_left_out_with_its_bones(joint):
    poses, _, observed = one_person()
    place = poses[0, joint].clone()
    poses[0, joint] = torch.nan
    image = draw_overlay(frame(), poses, None, observed)
    assert pixel(image, place) == (GREY,) * 3
    others = [j for j in range(len(UPPER_BODY)) if j != joint]
    assert all(pixel(image, poses[0, j]) != (GREY,) * 3 for j in others)


@pytest.mark.parametrize("value", [-50.0, 700.0, 5e3, -1e9, 1e300, math.inf])
def test_joints_outside_of_the_image_do_no_harm(value):
    poses, covariance, observed = one_person()
    poses[0, HAND_LEFT] = value
    poses[0, ELBOW_LEFT, 1] = value
    covariance[0, ELBOW_LEFT] *= 1e12
    covariance[0, SHOULDER_LEFT] = torch.nan
    hands = torch.full((1, 2, 2), value, dtype=torch.float64)
    faces = torch.full((1, 3), value, dtype=torch.float64)
    image = draw_overlay(
        frame(), poses, covariance, observed, faces=faces, hands=hands, labels=["a"],
        hand_covariance=covariance[:, :2],
    )  # fmt: skip
    assert close(pixel(image, poses[0, HAND_RIGHT]), rgb(RIGHT))


def test_a_bone_to_a_joint_outside_is_drawn_up_to_the_edge():
    poses, covariance, observed = one_person()
    poses[0, HAND_LEFT] = torch.tensor([410.0, 900.0])
    image = draw_overlay(frame(), poses, covariance, observed)
    assert close(pixel(image, torch.tensor([410.0, 479.0])), rgb(LEFT))


def test_persons_have_tints_that_come_round_again():
    poses, covariance, observed = (torch.cat([a] * 2) for a in one_person())
    poses[1, :, 0] -= 150
    image = draw_overlay(frame(), poses, covariance, observed)
    assert close(pixel(image, poses[1, HEAD]), rgb(PERSON_TINTS[1]))
    again = draw_overlay(frame(), poses, covariance, observed, tints=[2, len(PERSON_TINTS)])
    assert close(pixel(again, poses[0, HEAD]), rgb(PERSON_TINTS[2]))
    assert close(pixel(again, poses[1, HEAD]), rgb(PERSON_TINTS[0]))


def test_faces_have_the_tints_of_their_persons():
    nobody = torch.zeros(0, 8, 2), None, torch.zeros(0, 8, dtype=torch.bool)
    faces = torch.tensor([[300.0, 200.0, 80.0], [500.0, 200.0, 80.0]])
    image = draw_overlay(frame(), *nobody, faces=faces, face_tints=[3, 1])
    assert close(pixel(image, torch.tensor([260.0, 200.0])), rgb(PERSON_TINTS[3]), 40)
    assert close(pixel(image, torch.tensor([460.0, 200.0])), rgb(PERSON_TINTS[1]), 40)
    with pytest.raises(ShapeError, match="faces"):
        draw_overlay(frame(), *nobody, faces=faces, face_tints=[0])


def test_faces_hands_and_labels_are_drawn_where_they_are():
    nobody = torch.zeros(0, 8, 2), None, torch.zeros(0, 8, dtype=torch.bool)
    face = torch.tensor([[300.0, 200.0, 80.0]])
    image = draw_overlay(frame(), *nobody, faces=face)
    assert close(pixel(image, torch.tensor([260.0, 200.0])), rgb(PERSON_TINTS[0]), 40)
    assert pixel(image, torch.tensor([300.0, 200.0])) == (GREY,) * 3
    hands = torch.tensor([[[400.0, 300.0], [math.nan, math.nan]]])
    covariance = (25.0 * torch.eye(2)).expand(1, 2, 2, 2)
    image = draw_overlay(frame(), *nobody, hands=hands, hand_covariance=covariance)
    assert close(pixel(image, hands[0, 0]), rgb(LEFT), 40)
    poses, spread, observed = one_person()
    plain = draw_overlay(frame(), poses, spread, observed)
    named = draw_overlay(frame(), poses, spread, observed, labels=["Zoë <2>"])
    rows, columns = np.nonzero((plain != named).any(-1))
    assert rows.size and rows.max() < poses[0, HEAD, 1]
    assert columns.min() < poses[0, HEAD, 0] < columns.max()


def test_widths_grow_with_the_image():
    poses, _, observed = one_person()
    small = np.abs(draw_overlay(frame(), poses, None, observed) - float(GREY)).mean()
    large = np.abs(draw_overlay(frame(1920, 2560), 4 * poses, None, observed) - float(GREY)).mean()
    assert large == pytest.approx(small, rel=0.25)
    tiny = draw_overlay(frame(12, 16), poses / 40, None, observed)
    assert tiny.shape == (12, 16, 3)


def test_no_persons_is_a_copy():
    image = frame()
    nobody = torch.zeros(0, 8, 2), torch.zeros(0, 8, 2, 2), torch.zeros(0, 8, dtype=torch.bool)
    drawn = draw_overlay(image, *nobody, labels=[])
    assert (drawn == image).all() and not np.shares_memory(drawn, image)


def test_wrong_input_is_refused():
    poses, covariance, observed = one_person()
    with pytest.raises(InputError, match="RGB"):
        draw_overlay(frame()[..., 0], poses, covariance, observed)
    with pytest.raises(InputError, match="RGB"):
        draw_overlay(frame().astype(np.float32), poses, covariance, observed)
    with pytest.raises(ShapeError, match="poses2d"):
        draw_overlay(frame(), poses[0], covariance, observed)
    with pytest.raises(ShapeError, match="covariance2d"):
        draw_overlay(frame(), poses, covariance[..., 0], observed)
    with pytest.raises(InputError, match="labels"):
        draw_overlay(frame(), poses, covariance, observed, labels=["a", "b"])
    with pytest.raises(InputError, match="level"):
        draw_overlay(frame(), poses, covariance, observed, level=1.0)
