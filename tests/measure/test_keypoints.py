"""Persons in the keypoints of a detector: who is who from frame to frame, and who counts."""

import numpy as np
import pytest
import torch

from torchpose.errors import InputError
from torchpose.measure._detectors.protocol import Detections
from torchpose.measure._keypoint_measurer import KeypointMeasurer
from torchpose.skeleton._joint_sets import COCO
from torchpose.skeleton._mediapipe_landmarks import LANDMARKS

SIZE = (640, 480)
_BODY = {
    "nose": (0, -50), "left_eye": (8, -58), "right_eye": (-8, -58), "left_ear": (16, -55),
    "right_ear": (-16, -55), "left_shoulder": (40, 0), "right_shoulder": (-40, 0),
    "left_elbow": (55, 60), "right_elbow": (-55, 60), "left_wrist": (60, 110),
    "right_wrist": (-60, 110), "left_hip": (25, 130), "right_hip": (-25, 130),
    "left_knee": (25, 220), "right_knee": (-25, 220), "left_ankle": (25, 300),
    "right_ankle": (-25, 300),
}  # fmt: skip
BODY = torch.tensor([_BODY[name] for name in COCO]).double()


def at(u, v=150.0, scale=1.0):
    return scale * BODY + torch.tensor([u, v]).double()


class Scripted:
    """A detector that gives what a test says, frame by frame."""

    names = COCO

    def __init__(self, frames, confidence=0.9):
        self.frames, self.confidence, self.resets = frames, confidence, 0

    def reset(self):
        self.resets, self.at = self.resets + 1, 0

    def __call__(self, image):
        people = self.frames[self.at]
        self.at += 1
        points = torch.stack(people) if people else torch.zeros(0, 17, 2)
        return points.numpy(), np.full(points.shape[:2], self.confidence)


def run(detector, n, images=None, **options):
    measurer = KeypointMeasurer(detector, **options)
    state, found = measurer.init(), []
    blank = np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)
    for t in range(n):
        state, measured = measurer.step(state, blank if images is None else images[t])
        found.append(measured)
    return found


def test_one_person_counts_from_the_third_frame():
    found = run(Scripted([[at(200.0 + t)] for t in range(10)]), 10)
    assert [f.person.tolist() for f in found] == [[], [], *[[0]] * 8]
    torch.testing.assert_close(found[5].keypoints[0], at(205.0))
    assert found[5].confidence.unique().tolist() == [0.9]
    assert found[5].sizes.tolist() == pytest.approx([80.0])
    assert found[5].faces is None


def test_two_persons_in_any_order_stay_who_they_are():
    rng = np.random.default_rng(0)
    left = [200.0 + 4 * t for t in range(60)]
    right = [440.0 - 4 * t for t in range(60)]  # they cross, one nearer to the camera
    frames = []
    for u, v in zip(left, right, strict=True):
        pair = [at(u, 150.0), at(v, 190.0, 1.5)]
        frames.append([pair[k] for k in rng.permutation(2)])
    found = run(Scripted(frames), 60)[2:]
    sizes = [dict(zip(f.person.tolist(), f.sizes.tolist(), strict=True)) for f in found]
    assert sorted(sizes[0].values()) == pytest.approx([80.0, 120.0])
    assert all(one == pytest.approx(sizes[0]) for one in sizes)


def test_somebody_found_twice_is_one_person():
    frames = [[at(200.0), at(202.0, 151.0), at(420.0)] for _ in range(6)]
    assert [f.person.tolist() for f in run(Scripted(frames), 6)][-1] == [0, 1]


def test_who_is_missed_for_a_while_is_known_again_and_ghosts_do_not_count():
    frames = [[at(200.0)]] * 8 + [[]] * 6 + [[at(215.0)]] * 5
    frames[4] = [at(200.0), at(500.0)]
    people = [f.person.tolist() for f in run(Scripted(frames), len(frames))]
    assert people == [[], [], *[[0]] * 6, *[[]] * 6, *[[0]] * 5]


def test_who_returns_is_known_by_the_clothes():
    images = []
    for t in range(120):
        image = np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)
        image[130:300, 120:280] = [200, 30, 30] if t < 60 else [30, 30, 200]
        image[130:300, 360:520] = [200, 30, 30] if t >= 60 else 90
        images.append(image)
    frames = [[at(200.0)]] * 15 + [[]] * 95 + [[at(200.0), at(440.0)]] * 10
    found = run(Scripted(frames), 120, images)
    assert found[10].person.tolist() == [0]
    assert found[-1].person.tolist() == [1, 0]  # the red clothes are on the right now


def test_what_is_unsure_or_outside_of_the_image_is_missing():
    detector = Scripted([[at(20.0)]] * 5, confidence=0.4)
    (person,) = run(detector, 5)[-1].keypoints
    outside = (at(20.0)[:, 0] < 0).tolist()
    assert person.isnan().any(-1).tolist() == outside and any(outside)
    assert run(detector, 5, min_confidence=0.5)[-1].person.tolist() == []


def test_what_has_no_confidence_is_not_outside_of_the_image():
    class Placed(Scripted):
        def reset(self):
            pass

        def __call__(self, image):
            points, confidence = at(300.0)[None].clone(), torch.full((1, 17), 0.9)
            points[0, 9:11] = torch.tensor([[-1.0, -1.0], [-20.0, 200.0]])
            confidence[0, 9:11] = torch.tensor([0.0, 0.1])
            return points, confidence

    (absent,) = run(Placed([]), 4)[-1].absent
    assert float(absent[10]) == pytest.approx(
        0.95
    )  # where the wrist is, is said, though not surely
    assert absent.isnan().tolist() == [k != 10 for k in range(17)]


def test_a_head_may_be_above_the_image():
    class Heads(Scripted):
        def reset(self):
            pass

        names = ("head", "neck", "left_shoulder", "right_shoulder", "left_wrist")

        def __call__(self, image):
            return np.array([[[300, -20], [300, -2], [250, 30], [350, 30], [360, -5]]]), np.ones(
                (1, 5)
            )

    (person,) = run(Heads([]), 4)[-1].keypoints
    assert person.isnan().any(-1).tolist() == [False, False, False, False, True]


def test_the_largest_are_taken():
    frames = [[at(120.0), at(320.0, scale=1.3), at(520.0)]] * 5
    (measured,) = run(Scripted(frames), 5, max_persons=1)[-1:]
    assert measured.person.tolist() == [1] and measured.sizes.tolist() == pytest.approx([104.0])


def test_somebody_smaller_does_not_take_the_place_of_who_is_missed_for_a_moment():
    pair = [at(150.0), at(450.0, scale=1.3)]
    frames = [pair[:1] if t % 10 == 9 else pair for t in range(40)]
    people = [f.person.tolist() for f in run(Scripted(frames), 40, max_persons=1)]
    assert people[2:] == [[] if t % 10 == 9 else [1] for t in range(2, 40)]
    left = run(Scripted([pair] * 10 + [pair[:1]] * 40), 50, max_persons=1)
    assert left[-1].person.tolist() == [0]


def test_a_detector_is_reset_before_a_video():
    detector = Scripted([[at(200.0)]] * 5)
    first, second = run(detector, 5), run(detector, 5)
    assert detector.resets == 2
    assert torch.equal(first[-1].keypoints, second[-1].keypoints)


def test_landmarks_of_mediapipe_get_head_neck_and_hands():
    class Landmarks:
        names = LANDMARKS

        def __call__(self, image):
            points = torch.rand(1, 33, 2, generator=torch.Generator().manual_seed(0))
            return 100 + 200 * points, torch.full((1, 33), 0.8)

    measurer = KeypointMeasurer(Landmarks())
    assert measurer.names[-4:] == ("head", "neck", "hand_left", "hand_right")
    assert measurer.neck == "neck"
    assert run(Landmarks(), 4)[-1].keypoints.shape == (1, 37, 2)


class Cropping:
    """A detector of one person in a box, who is at the box's middle in the image."""

    names = COCO

    def __init__(self, u):
        self.u, self.boxes = u, []

    def __call__(self, image):
        raise AssertionError("is asked for boxes")

    def detect_in(self, image, boxes):
        self.boxes.append(boxes)
        sure = 0.9 if len(self.boxes) <= 8 else 0.0
        return Detections(at(self.u)[None], torch.full((1, 17), sure).double())


def test_crops_are_about_the_last_pose_and_end_with_it():
    detector = Cropping(300.0)
    run(detector, 20)
    assert detector.boxes[0] is None
    (box,) = detector.boxes[3].tolist()
    low, high = at(300.0).amin(0), at(300.0).amax(0)
    assert box[0] < low[0] - 40 and box[2] > high[0] + 40
    assert box[1] < low[1] - 20 and box[3] > high[1] + 20
    assert detector.boxes[12] is not None  # a few frames without a detection
    assert detector.boxes[19] is None


def test_bad_settings_and_detectors_are_refused():
    with pytest.raises(InputError, match="min_confidence must be in 0 to 1"):
        KeypointMeasurer(Scripted([]), min_confidence=1.5)
    with pytest.raises(InputError, match="max_persons must be at least 1"):
        KeypointMeasurer(Scripted([]), max_persons=0)

    class Wrong(Scripted):
        def __call__(self, image):
            return np.zeros((1, 3, 2)), np.zeros((1, 3))

    with pytest.raises(
        InputError, match=r"mine must return keypoints \[N, 17, 2\].*got \[1, 3, 2\]"
    ):
        run(Wrong([]), 1, name="mine")
    with pytest.raises(InputError, match=r"mine failed on an image \[480, 640, 3\]: IndexError"):
        run(Scripted([]), 1, name="mine")
    with pytest.raises(InputError, match="a frame must be RGB"):
        run(Scripted([[]]), 1, [np.zeros((4, 4), np.uint8)])
