"""Joints that are made up, where the truth is a linear function of the others."""

from dataclasses import replace

import pytest
import torch

from tests.data import data_dir_or_skip
from tests.evaluation.recordings import write_people
from torchpose.errors import PriorError, SkeletonError
from torchpose.evaluation._completion import complete, facing_pieces, learn_completion, with_wrists
from torchpose.io import read_recordings
from torchpose.math import euler_to_matrix


@pytest.fixture(scope="module")
def people(tmp_path_factory):
    folder = write_people(tmp_path_factory.mktemp("data") / "set", ("s1", "s2", "s3"), 120)
    return read_recordings(folder)


def test_hands_on_the_line_of_the_forearm_are_found(people):
    # in these recordings the wrist is 0.8 of the hand and 0.2 of the elbow
    completion = learn_completion(people)
    assert completion.spread["hand_left"] < 1e-3
    made = complete(people[2], completion)
    body, truth = made.upper_body(), people[2].upper_body()
    assert (body.hand, body.neck, body.head) == ("hand", "neck", "head")
    torch.testing.assert_close(body.joints[:, [0, 7]], truth.joints[:, [0, 7]], atol=5e-3, rtol=0)
    torch.testing.assert_close(body.joints[:, [1, 2, 5, 6]], truth.joints[:, [1, 2, 5, 6]])
    assert float((body.joints - truth.joints).norm(dim=-1).max()) < 0.1
    assert made.person_id == people[2].person_id


def test_a_body_that_turns_takes_its_head_along(people):
    completion = learn_completion(people)
    turn = euler_to_matrix(torch.tensor([0.1, -0.2, 0.7], dtype=torch.float64), "zxy")
    turned = replace(people[0], joints=people[0].joints @ turn.mT)
    straight = complete(people[0], completion).joints @ turn.mT
    torch.testing.assert_close(complete(turned, completion).joints, straight)


def test_residuals_are_drawn_once_for_a_recording(people):
    completion = learn_completion(people, ("head",))
    wide = completion._replace(covariance=0.01 * torch.eye(3, dtype=torch.float64))
    mean = complete(people[0], wide).upper_body()
    assert mean.hand == "wrist"
    drawn = complete(people[0], wide, torch.Generator().manual_seed(0)).upper_body()
    offset = (drawn.joints - mean.joints)[:, 3].norm(dim=-1)
    assert float(offset.std()) < 1e-9 < float(offset.mean())
    torch.testing.assert_close(drawn.joints[:, 5:], mean.joints[:, 5:])


def test_wrists_in_place_of_hands(people):
    body = with_wrists(people[0]).upper_body()
    truth = people[0].upper_body().joints
    assert (body.hand, body.neck) == ("wrist", "neck")
    torch.testing.assert_close(body.joints[:, 0], 0.8 * truth[:, 0] + 0.2 * truth[:, 1])
    torch.testing.assert_close(body.joints[:, 1:7], truth[:, 1:7])


def test_only_parts_that_face_the_camera_are_kept(people):
    joints = people[0].joints.clone()
    joints[40:60, :, 0] *= -1  # seen from behind
    pieces = facing_pieces(replace(people[0], joints=joints))
    assert [len(p) for p in pieces] == [40, 60]
    torch.testing.assert_close(pieces[1].joints, people[0].joints[60:])


def test_what_cannot_be_completed(people):
    with pytest.raises(PriorError, match="100 frames"):
        learn_completion([replace(people[0], joints=people[0].joints[:50])])
    with pytest.raises(SkeletonError, match="hip_center"):
        complete(with_wrists(people[0]), learn_completion(people))
    with pytest.raises(SkeletonError, match="wrists"):
        with_wrists(complete(people[0], learn_completion(people)))


@pytest.mark.data
@pytest.mark.slow
def test_heads_and_hands_of_persons_left_out():
    recordings = read_recordings(data_dir_or_skip("kinect_utd_mhad"))[::6]
    train = [r for r in recordings if r.person not in ("s7", "s8")]
    completion = learn_completion(train)
    tested = [r for r in recordings if r.person in ("s7", "s8")]
    made = torch.cat([complete(r, completion).joints for r in tested])
    truth = torch.cat([r.upper_body().joints for r in tested])
    errors = (made - truth).norm(dim=-1).mean(0)
    assert float(errors[3]) < 0.06 and float(errors[[0, 7]].max()) < 0.06
    assert float(errors[4]) < 0.04
