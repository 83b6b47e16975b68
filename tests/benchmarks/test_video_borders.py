"""Scores of hands outside of the image, on hands that are made up."""

import numpy as np
import torch

from benchmarks.hand_network.clips import BURN_IN, Labels
from benchmarks.video_borders import Drawn, Landmarks, last_places, score

N, SIZE = 60, (640, 480)


def hands(place, n_frames=N):
    return torch.tensor(place, dtype=torch.float64).expand(n_frames, 2, 2).clone()


def test_hands_drawn_in_view_are_counted_beside_the_last_place():
    """The left hand is below the image throughout, the right one visible, and missed in ten frames."""
    truth = hands([[300.0, 560.0], [500.0, 300.0]])
    seen = torch.tensor([0, 1]).expand(N, 2)
    measured = torch.zeros(N, 2, dtype=torch.bool)
    measured[:, 1] = True
    measured[0, 0] = True
    measured[-10:, 1] = False
    missing, absent = (
        hands([[300.0, 400.0], [500.0, 300.0]]),
        hands([[300.0, 540.0], [500.0, 700.0]]),
    )
    labels = Labels(torch.cat([truth, truth], 1), torch.cat([seen, seen], 1), truth[:, 0], 100.0)
    row = score(labels, Drawn(missing, absent, measured, SIZE))
    outside = N - BURN_IN - 1
    assert row == [outside, 0.0, 100.0, 100.0, 0.0, 1.6, 0.2, 10, 0.0, 100.0]
    nobody = labels._replace(seen=torch.ones_like(labels.seen))
    assert score(nobody, Drawn(missing, absent, measured, SIZE)) is None


def test_last_places_are_held_from_the_first_measurement_on():
    points = torch.arange(5.0)[:, None, None].expand(5, 2, 2)
    measured = torch.tensor([False, True, False, True, False])[:, None].expand(5, 2)
    held = last_places(points, measured)[:, 0, 0]
    assert bool(held[0].isnan()) and held[1:].tolist() == [1, 1, 3, 3]


def test_landmarks_of_a_file_are_detections_of_one_person_or_nobody(tmp_path):
    joints = np.ones((2, 3, 2), np.float32)
    joints[1, 0] = np.nan
    names = np.array(["nose", "left_wrist", "right_wrist"])
    np.savez(tmp_path / "a.npz", joints2d=joints, visibility=np.full((2, 3), 1.0001), names=names)
    detector = Landmarks(tmp_path / "a.npz")
    first, second = detector(None), detector(None)
    assert first[0].shape == (1, 3, 2) and float(first[1].max()) == 1 and len(second[0]) == 0
    detector.reset()
    assert len(detector(None)[0]) == 1
