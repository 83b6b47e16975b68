"""The outputs of models, decoded apart from any runtime, against plain loops."""

import numpy as np
import pytest
import torch

from torchpose.measure._detectors.bottom_up import (
    decode_movenet_multi,
    decode_rtmo,
    decode_yolo,
    decode_yolo_suppressed,
    suppress_overlaps,
)
from torchpose.measure._detectors.joint_sets import joint_set, select_joints
from torchpose.measure._detectors.protocol import Detections
from torchpose.measure._detectors.top_down import (
    decode_heatmaps,
    decode_movenet_single,
    decode_simcc,
)

SIZE = (48, 64)


def test_classified_coordinates_are_the_best_bins():
    x, y = torch.rand(2, 17, 96) / 2, torch.rand(2, 17, 128) / 2
    for person, joint in np.ndindex(2, 17):
        x[person, joint, 3 * joint + person] = 0.7
        y[person, joint, 5 * joint + person] = 1.2 if joint else 0.8
    found = decode_simcc(x, y, SIZE)
    for person, joint in np.ndindex(2, 17):
        expected = [(3 * joint + person) / 2, (5 * joint + person) / 2]
        assert found.keypoints[person, joint].tolist() == expected
    torch.testing.assert_close(
        found.confidence, torch.full((2, 17), 0.7).double(), atol=1e-6, rtol=0
    )


def test_scores_above_one_are_sure():
    found = decode_simcc(torch.full((1, 17, 96), 1.3), torch.full((1, 17, 128), 1.1), SIZE)
    assert found.confidence.unique().tolist() == [1.0]


def test_heatmaps_are_read_at_their_highest_cell_a_quarter_towards_its_neighbour():
    maps = torch.zeros(1, 17, 16, 12)
    maps[0, :, 5, 7], maps[0, :, 5, 8], maps[0, :, 4, 7] = 0.9, 0.5, 0.2
    maps[0, 1] = 0.0
    maps[0, 1, 0, 11] = 0.6  # in a corner: no neighbours to compare
    found = decode_heatmaps(maps, SIZE)
    assert found.keypoints[0, 0].tolist() == pytest.approx([4 * 7.25, 4 * 4.75])
    assert found.keypoints[0, 1].tolist() == [44.0, 0.0]
    assert found.confidence[0, :2].tolist() == pytest.approx([0.9, 0.6])


def test_movenet_counts_in_shares_of_its_input_down_first():
    out = torch.rand(1, 1, 17, 3)
    found = decode_movenet_single(out, (192, 256))
    for joint, (v, u, score) in enumerate(out[0, 0].double().tolist()):
        assert found.keypoints[0, joint].tolist() == pytest.approx([192 * u, 256 * v])
        assert float(found.confidence[0, joint]) == pytest.approx(score)


def person(left, top, seed):
    """Keypoints [17, 3] within a box of 40 x 80."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(size=(17, 3)) * [40, 80, 1] + [left, top, 0]
    return torch.from_numpy(points)


def boxes(*corners):
    return torch.tensor([[u, v, u + 40, v + 80] for u, v in corners]).double()


def test_rtmo_gives_the_sure_persons_each_once():
    people = torch.stack([person(10, 5, 0), person(12, 5, 1), person(100, 5, 2), person(0, 0, 3)])
    scores = torch.tensor([0.6, 0.9, 0.5, 0.1]).double()
    dets = torch.cat([boxes((10, 5), (12, 5), (100, 5), (200, 0)), scores[:, None]], 1)
    found = decode_rtmo(dets[None], people[None])
    torch.testing.assert_close(found.keypoints, people[[1, 2], :, :2])
    torch.testing.assert_close(found.confidence, people[[1, 2], :, 2])


def test_yolo_gives_boxes_by_their_middle():
    people = torch.stack([person(10, 5, 0), person(100, 5, 2)])
    corners = boxes((10, 5), (100, 5))
    middle, sides = (corners[:, :2] + corners[:, 2:]) / 2, corners[:, 2:] - corners[:, :2]
    rows = torch.cat([middle, sides, torch.tensor([[0.4], [0.8]]), people.flatten(1)], 1)
    found = decode_yolo(rows.float())
    torch.testing.assert_close(found.keypoints, people[[1, 0], :, :2], atol=1e-4, rtol=0)
    of_corners = torch.cat([corners, rows[:, 4:5], torch.zeros(2, 1), people.flatten(1)], 1)
    again = decode_yolo_suppressed(of_corners)
    torch.testing.assert_close(again.keypoints, people[[1, 0], :, :2])


def test_movenet_multi_pose_has_boxes_behind_the_keypoints():
    people = torch.stack([person(10, 5, 0), person(100, 5, 2)])
    sides = torch.tensor([256.0, 128.0])
    shares = torch.cat([people[..., [1, 0]] / sides[[1, 0]], people[..., 2:]], -1).flatten(1)
    corners = boxes((10, 5), (100, 5))[:, [1, 0, 3, 2]] / sides[[1, 0, 1, 0]]
    out = torch.cat([shares, corners, torch.tensor([[0.9], [0.8]])], 1)
    found = decode_movenet_multi(out[None].float(), (256, 128))
    torch.testing.assert_close(found.keypoints, people[..., :2], atol=1e-4, rtol=0)


def test_nobody_is_an_empty_tensor():
    assert decode_rtmo(torch.zeros(1, 0, 5), torch.zeros(1, 0, 17, 3)).keypoints.shape == (0, 17, 2)
    assert decode_yolo(torch.zeros(40, 56)).confidence.shape == (0, 17)


def test_suppression_agrees_with_opencv():
    import cv2

    rng = np.random.default_rng(0)
    corner, sides = rng.uniform(0, 60, (40, 2)), rng.uniform(10, 40, (40, 2))
    scores = np.sort(rng.uniform(0.4, 1, 40))[::-1]
    given = torch.from_numpy(np.concatenate([corner, corner + sides], 1))
    expected = cv2.dnn.NMSBoxes(np.concatenate([corner, sides], 1), scores, 0.0, 0.5)
    assert suppress_overlaps(given, 0.5).tolist() == np.asarray(expected).flatten().tolist()


def test_hands_of_the_whole_body_are_beyond_the_wrists():
    points, confidence = torch.rand(2, 133, 2).double(), torch.rand(2, 133).double()
    joints = joint_set(133, "model")
    found = select_joints(Detections(points, confidence), joints)
    assert found.keypoints.shape == (2, 25, 2)
    assert joints.names[-2:] == ("hand_left", "hand_right")
    assert joints.names[19] == "left_heel" and torch.equal(found.keypoints[:, :23], points[:, :23])
    for hand, wrist, knuckle in ((23, 9, 100), (24, 10, 121)):
        expected = 0.3 * points[:, wrist] + 0.7 * points[:, knuckle]
        torch.testing.assert_close(found.keypoints[:, hand], expected)
        least = confidence[:, [wrist, knuckle]].amin(1)
        torch.testing.assert_close(found.confidence[:, hand], least)


def test_of_halpe_what_coco_has_is_taken_and_the_feet():
    points, confidence = torch.rand(1, 26, 2).double(), torch.rand(1, 26).double()
    joints = joint_set(26, "model")
    found = select_joints(Detections(points, confidence), joints)
    assert torch.equal(found.keypoints, torch.cat([points[:, :17], points[:, 20:]], 1))
    assert joints.names[17] == "left_big_toe" and joints.names[-1] == "right_heel"
