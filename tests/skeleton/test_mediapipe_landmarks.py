"""Head, neck and hands from MediaPipe's landmarks."""

import math

import numpy as np
import pytest
import torch

from tests.data import data_dir_or_skip
from torchpose.errors import ShapeError, SkeletonError
from torchpose.io import read_keypoints, write_keypoints
from torchpose.skeleton import upper_body_indices
from torchpose.skeleton._joint_sets import canonical_names
from torchpose.skeleton._mediapipe_landmarks import (
    DERIVED_JOINTS,
    LANDMARKS,
    derive_joints,
    lacks_joints,
)

SEEN = ["leftEar", "rightEar", "LShoulder", "RShoulder", "LWrist", "RWrist", "LIndex", "RIndex"]
POINTS = torch.tensor(
    [
        [340.0, 100],
        [300, 100],
        [400, 180],
        [240, 180],
        [420, 400],
        [220, 400],
        [430, 440],
        [210, 440],
    ]
).double()


def rotation(angle):
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s], [s, c]]).double()


def test_every_landmark_has_a_known_name_of_its_own():
    assert len(set(canonical_names(LANDMARKS))) == 33


@pytest.mark.parametrize("angle", [0.0, 0.4, -1.0])
@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_joints_turn_and_grow_with_the_body(angle, scale):
    turn = scale * rotation(angle)
    points, none, names = derive_joints(POINTS @ turn.T + 7, None, SEEN)
    assert none is None
    assert names == (*SEEN, *DERIVED_JOINTS)
    made = (points[8:] - 7) @ turn.inverse().T
    expected = [[320.0, 180 - 160], [320, 180 - 0.27 * 160], [427, 428], [213, 428]]
    assert made == pytest.approx(torch.tensor(expected).double())


def test_shoulders_that_come_close_do_not_lower_the_head():
    aside = POINTS.clone()
    aside[2:4, 0] = torch.tensor([340.0, 300.0])
    points, _, _ = derive_joints(aside, None, SEEN)
    assert points[8].tolist() == pytest.approx([320, 180 - 1.45 * 80])


def test_what_is_missing_stays_missing():
    gone = POINTS.expand(3, 8, 2).clone()
    gone[0, 0], gone[1, 6], gone[2, 3] = torch.nan, torch.nan, torch.nan
    points, visibility, _ = derive_joints(gone, torch.linspace(0.1, 0.8, 8).expand(3, 8), SEEN)
    missing = points[:, 8:].isnan().all(-1).tolist()
    assert missing == [[True, True, False, False], [False, False, True, False],
                       [True, True, False, False]]  # fmt: skip
    assert visibility is not None
    assert visibility[0, 8:].tolist() == pytest.approx([0.1, 0.1, 0.5, 0.6])


def test_who_has_joints_needs_none():
    assert lacks_joints(LANDMARKS)
    assert not lacks_joints(LANDMARKS[:17])
    assert not lacks_joints([*LANDMARKS, "head"])
    with pytest.raises(SkeletonError, match="without head, neck and hands"):
        derive_joints(torch.zeros(1, 3, 2), None, ["head", "left_hand", "right_hand"])
    with pytest.raises(ShapeError):
        derive_joints(torch.zeros(1, 5, 2), None, LANDMARKS)


def landmark_file(path, **more):
    points = torch.cat([POINTS, POINTS.new_full((1, 2), 50.0)]).expand(4, 9, 2).clone()
    points[1, 6] = torch.nan
    np.savez(
        path,
        joints2d=points.numpy().astype(np.float32),
        visibility=np.full((4, 9), 0.75, np.float32),
        names=np.array([*SEEN, "nose"]),
        fps=30.0,
        image_size=[640, 480],
        **more,
    )
    return path


def test_a_file_is_read_with_joints(tmp_path):
    read = read_keypoints(landmark_file(tmp_path / "a.npz", joints3d=np.zeros((4, 9, 3))))
    assert read.names == (*SEEN, "nose", *DERIVED_JOINTS)
    assert read.neck == "neck"
    assert "where the prior's are" in read.notes[0]
    found = upper_body_indices(read.names)
    assert (found.hand, found.head) == ("hand", "head")
    assert found.missing == ("elbow_left", "elbow_right")
    assert read.keypoints[1, 11].isnan().all()
    assert read.confidence is not None
    assert read.confidence[:, 11].tolist() == [0.75, 0, 0.75, 0.75]


def test_written_and_read_again_it_is_the_same(tmp_path):
    read = read_keypoints(landmark_file(tmp_path / "a.npz"))
    write_keypoints(tmp_path / "b.npz", read)
    again = read_keypoints(tmp_path / "b.npz")
    assert again.names == read.names
    assert again.neck == "neck"
    torch.testing.assert_close(again.keypoints, read.keypoints, equal_nan=True)


@pytest.mark.data
def test_proportions_on_a_clip():
    read = read_keypoints(data_dir_or_skip("video_asl") / "again_mediapipe_pose1.npz")
    head, neck, nose = (read.keypoints[:, read.names.index(n), 1] for n in ("head", "neck", "nose"))
    assert (head < nose).all()
    assert (nose < neck).all()
