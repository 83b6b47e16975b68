"""Hands that were taken for each other, on drawn arms."""

import math

import numpy as np
import pytest
import torch

from tests.measure.drawn_arms import drawing, pose
from torchpose.errors import InputError, ShapeError
from torchpose.measure._association import HandAssociation
from torchpose.measure._edges import limb_votes, segments_of_arms
from torchpose.skeleton import UPPER_BODY

pytest.importorskip("cv2")


def swapped_pose():
    """Elbows as a tracker infers them from hands that were exchanged."""
    return pose(
        hand_left=(70, 150), hand_right=(200, 150), elbow_left=(150, 130), elbow_right=(150, 150)
    )


def test_votes_of_a_hypothesis_are_those_of_its_limbs_by_their_length():
    joints, size = torch.stack([pose(), swapped_pose()])[None], torch.tensor([40.0])
    found, model = segments_of_arms(drawing(pose()), joints, 40.0), HandAssociation()
    votes = model.votes(found, joints, size)
    for h in range(2):
        count, length = 0.0, 0.0
        for side in ("left", "right"):
            for names in ((f"shoulder_{side}", f"elbow_{side}"), (f"elbow_{side}", f"hand_{side}")):
                a, b = (joints[0, h, UPPER_BODY.index(name)] for name in names)
                count += float(limb_votes(found, a, b, 0.4 * 40, 0.4, 0.3))
                length += math.dist(a.tolist(), b.tolist()) / 40
        assert float(votes[0, h]) == pytest.approx(count / length, rel=1e-5)
    unknown = model.votes(found, torch.full_like(joints, math.nan), size)
    assert unknown.tolist() == [[0, 0]]


def test_hands_that_were_taken_for_each_other_are_found_and_put_right():
    image, model = drawing(pose()), HandAssociation()
    right_way = torch.stack([pose(), swapped_pose()])
    both = torch.stack([right_way, right_way.flip(0)])  # the second person's hands are exchanged
    size, identity = torch.tensor([40.0, 40.0]), torch.tensor([4, 9])
    state = model.init()
    for _ in range(5):
        state = model.step(state, image, both, size, identity)
    assert state.swapped.tolist() == [False, True]
    for _ in range(5):
        state = model.step(state, image, torch.stack([right_way] * 2), size, identity)
    assert not state.swapped.any()


def test_one_odd_frame_does_not_swap_and_persons_keep_their_votes():
    image, model = drawing(pose()), HandAssociation(decay=0.9)
    right_way = torch.stack([pose(), swapped_pose()])[None]
    state, size = model.init(), torch.tensor([40.0])
    for _ in range(10):
        state = model.step(state, image, right_way, size, torch.tensor([4]))
    once = model.step(state, image, right_way.flip(1), size, torch.tensor([4]))
    assert not once.swapped.any()
    two = model.step(
        state, image, right_way.repeat(2, 1, 1, 1), size.repeat(2), torch.tensor([7, 4])
    )
    assert two.votes[1, 0] > 3 * two.votes[0, 0] > 0
    near = pose(hand_left=(150, 150), hand_right=(140, 150))
    joints = torch.stack([near, near])[None]
    touching = model.step(
        two, image, joints.repeat(2, 1, 1, 1), size.repeat(2), torch.tensor([7, 4])
    )
    assert torch.equal(touching.votes, two.votes)
    none = model.step(two, image, right_way[:0], size[:0], torch.zeros(0, dtype=torch.long))
    assert len(none.votes) == 0


def test_bad_input_is_refused():
    with pytest.raises(InputError, match="decay"):
        HandAssociation(decay=1.0)
    model = HandAssociation()
    with pytest.raises(ShapeError, match="joints"):
        model.step(
            model.init(),
            np.zeros((9, 9), np.uint8),
            torch.zeros(1, 8, 2),
            torch.ones(1),
            torch.ones(1).long(),
        )
