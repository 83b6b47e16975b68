"""Persons are numbered as they come, and known again by their clothes."""

import numpy as np
import pytest
import torch

from torchpose.errors import InputError
from torchpose.measure._persons import PersonRegister, clothes_colours

RED, BLUE, GREEN = (200, 30, 40), (20, 40, 180), (40, 160, 60)


def scene(*people):
    """An image with a block of clothes below each face (x, colour), and the faces."""
    image = np.full((240, 640, 3), 128, np.uint8)
    for x, colour in people:
        image[90:200, x - 35 : x + 35] = colour
    return image, torch.tensor([[x, 50.0, 30.0] for x, _ in people]).reshape(-1, 3)


def follow(register, frames):
    """Numbers of the faces of each frame; a frame is (time, [(identity, x, colour), ...])."""
    state, numbers = register.init(), []
    for time, people in frames:
        image, faces = scene(*((x, colour) for _, x, colour in people))
        identity = torch.tensor([who for who, _, _ in people], dtype=torch.long)
        state, owner = register.step(state, image, faces, identity, time)
        numbers.append(owner.tolist())
    return numbers


def test_who_comes_back_in_the_same_clothes_keeps_the_number():
    numbers = follow(
        PersonRegister(within=100),
        [
            (0, [(0, 100, RED), (1, 400, BLUE)]),
            (1, [(1, 400, BLUE)]),
            (50, [(1, 380, BLUE), (2, 150, RED)]),
            (51, [(2, 150, RED), (1, 380, BLUE)]),
        ],
    )
    assert numbers == [[0, 1], [1], [1, 0], [0, 1]]


def test_another_person_gets_a_number_of_their_own():
    numbers = follow(PersonRegister(), [(0, [(0, 100, RED)]), (20, [(1, 120, GREEN)])])
    assert numbers == [[0], [1]]


def test_after_too_long_nobody_is_expected_back():
    numbers = follow(PersonRegister(within=30), [(0, [(0, 100, RED)]), (31, [(1, 120, RED)])])
    assert numbers == [[0], [1]]


def test_somebody_who_is_still_there_is_not_mistaken_for_one_who_left():
    numbers = follow(PersonRegister(), [(0, [(0, 100, RED)]), (1, [(0, 100, RED), (1, 400, RED)])])
    assert numbers == [[0], [0, 1]]


def test_two_newcomers_do_not_share_a_number():
    numbers = follow(PersonRegister(), [(0, [(0, 100, RED)]), (9, [(1, 90, RED), (2, 300, RED)])])
    assert sorted(numbers[1]) == [0, 1]


def test_colours_are_shares():
    image, faces = scene((100, RED), (400, BLUE))
    colours = clothes_colours(image, faces)
    assert torch.allclose(colours.sum(1), torch.ones(2, dtype=torch.float64))
    assert float((colours[0] * colours[1]).sqrt().sum()) < 0.5
    assert clothes_colours(image, torch.tensor([[100.0, 900.0, 30.0]])).sum() == 0


def test_what_is_below_a_face_that_is_followed_blindly_is_not_learnt():
    register = PersonRegister()
    state = register.init()
    worn, faces = scene((100, RED))
    wall, _ = scene((100, GREEN))
    who = torch.tensor([0])
    state, _ = register.step(state, worn, faces, who, 0)
    for time in range(1, 40):
        state, _ = register.step(state, wall, faces, who, time, torch.tensor([False]))
    state, number = register.step(state, worn, faces, torch.tensor([1]), 100)
    assert number.tolist() == [0]


def test_bad_settings_are_refused():
    with pytest.raises(InputError, match="likeness"):
        PersonRegister(likeness=0.0)
