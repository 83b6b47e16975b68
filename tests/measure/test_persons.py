"""Persons are numbered as they come, and known again by their clothes."""

import numpy as np
import pytest
import torch

from torchpose import load_prior
from torchpose.errors import InputError
from torchpose.measure._persons import PersonRegister, clothes_colours, largest_persons
from torchpose.measure._upper_body_measurer import UpperBodyMeasurer

RED, BLUE, GREEN = (200, 30, 40), (20, 40, 180), (40, 160, 60)
DARK_RED = (150, 60, 70)  # too much like red for another scene


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


def test_who_left_too_long_ago_is_forgotten_and_numbers_go_on():
    """As before a public camera: one who stays, and others who pass by in five kinds of clothes."""
    kinds = [RED, GREEN, (250, 250, 250), (0, 0, 0), (250, 250, 0)]
    register, numbers = PersonRegister(within=30), []
    state = register.init()
    for who in range(60):
        image, faces = scene((400, BLUE), (100, kinds[who % 5]))
        identity = torch.tensor([0, who + 1])
        state, number = register.step(state, image, faces, identity, 10 * who)
        numbers.append(number.tolist())
    assert numbers == [[0, who + 1] for who in range(60)]
    assert len(state.number) == len(state.colours) <= 5


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
    outside = torch.tensor(
        [[x, y, 30.0] for x, y in ((100, 900), (100, -90), (-90, 50), (730, 50))]
    )
    assert clothes_colours(image, outside).sum() == 0


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


@pytest.mark.parametrize(
    ("sizes", "before", "chosen"),
    [
        ((30.0, 33.0, 25.0), (), [1]),
        ((30.0, 33.0, 25.0), (4,), [0]),  # somebody a little larger does not take the place
        ((30.0, 37.0, 25.0), (4,), [1]),
        ((30.0, 33.0, 28.0), (4, 9), [0, 2]),
        ((30.0, 30.0, 30.0), (), [0, 1, 2]),
    ],
)
def test_the_largest_are_followed_and_keep_their_places(sizes, before, chosen):
    number, before = torch.tensor([4, 6, 9]), torch.tensor(before, dtype=torch.long)
    rows = largest_persons(number, torch.tensor(sizes), before, len(chosen))
    assert rows.tolist() == chosen


def test_one_of_two_in_the_same_clothes_is_followed_and_is_one_person():
    """Faces at 100 and 400 that are about as large as each other, until the second one comes near."""
    pytest.importorskip("cv2")
    image, _ = scene((100, RED), (400, RED))
    sizes = [(72.0, 76.0) if t // 6 % 2 else (76.0, 72.0) for t in range(36)] + [(72.0, 96.0)] * 24
    found = torch.zeros(0, 3, dtype=torch.float64)

    def faces(grey, region=None):
        left, right = (0, 640) if region is None else (region.left, region.right)
        return found[(found[:, 0] >= left) & (found[:, 0] < right)]

    measurer = UpperBodyMeasurer(
        load_prior("kinect-upper-body-small"),
        hands="mean-shift",
        face_detector=faces,
        max_persons=1,
    )
    seen, followed = measurer.init().seen, []
    for first, second in sizes:
        found = torch.tensor([[100.0, 80.0, first], [400.0, 80.0, second]]).double()
        view = measurer.look(seen, image)
        seen = view.after
        right = view.faces[:, 0] > 250
        followed += zip(view.number.tolist(), right.tolist(), strict=True)
    assert len(followed) >= 56 and set(followed) == {(0, False), (1, True)}
    assert set(followed[:34]) == {(0, False)} and set(followed[-12:]) == {(1, True)}


def test_who_leaves_the_image_is_not_measured_beyond_its_border():
    pytest.importorskip("cv2")
    image, found = scene((300, RED))[0], torch.zeros(0, 3)
    measurer = UpperBodyMeasurer(
        load_prior("kinect-upper-body-small"), face_detector=lambda grey, region=None: found
    )
    seen, places = measurer.init().seen, []
    for x in range(300, 900, 12):
        inside = x < 600  # half a face is not found
        found = torch.tensor([[x, 50.0, 80.0]][:inside], dtype=torch.float64).reshape(-1, 3)
        view = measurer.look(seen, image)
        seen = view.after
        places += view.faces[:, 0].tolist()
    assert 600 < max(places) < 640, "it is measured until it has left, and not any longer"
    assert float(seen.faces.mean[0, 0]) > 640


@pytest.mark.parametrize(
    ("end", "clothed", "most"),
    [(320, True, 30), (320, False, 4), (605, True, 4)],
    ids=["turned away", "hidden", "at the border"],
)
def test_a_lost_face_counts_while_the_person_is_still_to_be_seen(end, clothed, most):
    """One who walks to x = `end`, whose face is not found from there on."""
    found = torch.zeros(0, 3, dtype=torch.float64)
    measurer = UpperBodyMeasurer(
        load_prior("kinect-upper-body-small"), hands="mean-shift", face_detector=lambda *_: found
    )
    seen, counts = measurer.init().seen, []
    for t in range(80):
        x, there = min(end, end - 3 * (40 - t)), t <= 40
        found = torch.tensor([[x, 50.0, 80.0]][:there], dtype=torch.float64).reshape(-1, 3)
        image = np.full((240, 640, 3), 128, np.uint8)
        image[120:, x - 80 : x + 80] = RED if there or clothed else DARK_RED
        view = measurer.look(seen, image)
        seen = view.after
        counts.append(len(view.number))
    assert all(counts[3:40]) and sum(counts[41:]) == most


def test_clothes_that_cannot_be_seen_are_no_reason_to_doubt():
    register = PersonRegister()
    image, faces = scene((100, RED), (400, BLUE))
    identity = torch.tensor([4, 7])
    persons, _ = register.step(register.init(), image, faces, identity, 0)
    assert register.recognises(persons, image, faces, identity).tolist() == [True, True]
    assert register.recognises(persons, image, faces.flip(0), identity).tolist() == [False, False]
    below = faces + torch.tensor([0.0, 180.0, 0.0])  # the border of the image cuts the clothes off
    assert register.recognises(persons, image, below, identity).tolist() == [True, True]
    nobody_yet = torch.tensor([8, 9])
    assert register.recognises(persons, image, faces, nobody_yet).tolist() == [False, False]


def test_who_is_found_elsewhere_while_the_face_is_lost_is_no_second_person():
    """One who is hidden by somebody in the same clothes, and comes out on the other side."""
    register, state = PersonRegister(), PersonRegister().init()
    image, faces = scene((100, RED), (300, RED), (500, RED))
    identity = torch.tensor([0, 1, 2])
    state, both = register.step(state, image, faces[:2], identity[:2], 0)
    detected = torch.tensor([False, True, True])
    state, number = register.step(state, image, faces, identity, 1, detected, ~detected)
    assert (both.tolist(), number.tolist(), state.face.tolist()) == ([0, 1], [0, 1, 0], [2, 1])
    assert register.recognises(state, image, faces, identity).tolist() == [False, True, True]


def test_bad_settings_are_refused():
    with pytest.raises(InputError, match="likeness"):
        PersonRegister(likeness=0.0)
