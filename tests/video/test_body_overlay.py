import numpy as np
import pytest
import torch

from torchpose.body import BODY_15
from torchpose.errors import InputError, ShapeError
from torchpose.video._overlay import PERSON_TINTS, draw_body, rgb


def joints():
    """A body that stands in the middle of 160 x 120 pixels."""
    x = {"left": 100.0, "right": 60.0}
    y = {"shoulder": 40, "elbow": 55, "wrist": 70, "hip": 70, "knee": 90, "ankle": 110}
    middle = {"pelvis": (80, 70), "neck": (80, 35), "head": (80, 20)}
    points = [
        middle[n] if n in middle else (x[n.split("_")[0]], y[n.split("_")[1]])
        for n in BODY_15.names
    ]
    return torch.tensor(points, dtype=torch.float64)


def test_sides_have_their_colours_and_the_frame_stays():
    frame = np.full((120, 160, 3), 90, np.uint8)
    drawn = draw_body(frame, joints(), label="one")
    assert (frame == 90).all()
    left, right = drawn[100, 100].astype(int), drawn[100, 60].astype(int)
    assert left[2] > left[0] + 80  # blue
    assert right[0] > right[2] + 80  # orange


def test_trunk_and_head_have_the_tint_of_the_person():
    frame = np.full((120, 160, 3), 90, np.uint8)
    heads = [draw_body(frame, joints(), tint=tint)[20, 80].tolist() for tint in (0, 1, 6)]
    assert heads == [list(rgb(PERSON_TINTS[0])), *[list(rgb(PERSON_TINTS[1]))] * 2]
    assert (
        draw_body(frame, joints(), tint=1)[100, 100] == draw_body(frame, joints())[100, 100]
    ).all()


def test_silhouettes_of_another_scale_cover_their_place():
    frame = np.full((120, 160, 3), 90, np.uint8)
    mask = torch.zeros(60, 80, dtype=torch.bool)
    mask[40:50, 50:60] = True  # pixels 80..100, 100..120 of the frame
    nobody = torch.full((15, 2), torch.nan, dtype=torch.float64)
    tinted = draw_body(frame, nobody, model=mask)
    changed = (tinted != frame).any(-1)
    assert changed[80:100, 100:120].all()
    assert changed.sum() == 400
    outlined = (draw_body(frame, nobody, silhouette=mask) != frame).any(-1)
    assert outlined[80, 110]
    assert not outlined[90, 110]


def test_feet_are_drawn_below_the_ankles_in_the_colours_of_their_sides():
    frame = np.full((120, 160, 3), 90, np.uint8)
    left = torch.tensor([[96.0, 114.0], [130.0, 116.0], [126.0, 112.0]])
    feet = torch.cat([left, torch.full((3, 2), torch.nan)])
    drawn = draw_body(frame, joints(), feet=feet)
    toe = drawn[116, 130].astype(int)
    assert toe[2] > toe[0] + 80  # blue
    assert (drawn == draw_body(frame, joints())).all(-1)[:, :60].all()  # the right one is not known


def test_keypoints_are_yellow_crosses():
    frame = np.full((120, 160, 3), 90, np.uint8)
    nobody = torch.full((15, 2), torch.nan, dtype=torch.float64)
    seen = torch.tensor([[40.0, 60.0], [torch.nan, torch.nan]])
    drawn = draw_body(frame, nobody, keypoints=seen)
    red, green, blue = drawn[60, 40].astype(int)
    assert min(red, green) > blue + 80
    assert not (drawn[:, 80:] != frame[:, 80:]).any()


def test_bad_input_is_refused():
    with pytest.raises(InputError):
        draw_body(np.zeros((4, 4), np.uint8), joints())
    with pytest.raises(ShapeError, match="joints2d"):
        draw_body(np.zeros((4, 4, 3), np.uint8), joints()[:3])
