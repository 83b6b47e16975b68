"""`VideoTracker` on the keypoints of a detector: the numbers of the keypoint tracker, for everybody."""

import itertools
import threading

import numpy as np
import pytest
import torch

from torchpose import PinholeCamera, UpperBodyTracker, VideoTracker
from torchpose.demo import demo_camera, performer
from torchpose.errors import InputError
from torchpose.measure import HaarFaceDetector
from torchpose.skeleton import UPPER_BODY

N, FIRST = 40, 2  # frames, and the first one in which somebody counts
FRAMES = np.broadcast_to(np.uint8(90), (N, 480, 640, 3))
CAMERA = demo_camera()
FIELDS = ("joints2d", "joints3d", "covariance3d", "observed")


class Performers:
    """Detects performers in frames that show nothing, by counting these."""

    def __init__(self, *offsets, names=UPPER_BODY):
        joints = performer(N).joints
        self.names = names
        rows = [UPPER_BODY.index(name.replace("wrist", "hand")) for name in names]
        self.points = torch.stack(
            [CAMERA(joints + torch.tensor([u, 0.0, 0.0]))[:, rows, :2] for u in offsets], 1
        )
        noise = torch.Generator().manual_seed(0)
        self.sure = 0.5 + torch.rand(self.points.shape[:3], generator=noise) / 2

    def reset(self):
        self.at = 0

    def __call__(self, image):
        points, sure = self.points[self.at], self.sure[self.at]
        self.at += 1
        return points, sure


def whole(tracker, detector, person=0):
    """Track the keypoints of one performer, from the first frame that counts."""
    rows = slice(FIRST, None)
    return tracker(
        detector.points[None, rows, person], detector.sure[None, rows, person], detector.names
    )


def same(one, other):
    for name in FIELDS:
        torch.testing.assert_close(getattr(one, name), getattr(other, name), rtol=1e-9, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("smoothing", [None, "full"])
def test_poses_are_those_of_the_keypoint_tracker(prior, smoothing):
    detector = Performers(0.0)
    options = {"method": "articulated", "fps": 30.0, "smoothing": smoothing}
    tracker = VideoTracker(prior, CAMERA, detector=detector, **options)
    (person,) = tracker(FRAMES)
    assert (person.first_frame, len(person)) == (FIRST, N - FIRST)
    assert person.covariance is None
    torch.testing.assert_close(person.confidence, detector.sure[FIRST:, 0].double())
    same(person.track, whole(UpperBodyTracker(prior, CAMERA, **options), detector))


@pytest.mark.slow
@pytest.mark.parametrize("smoothing", [None, "full"])
def test_keypoints_are_tracked_anew_in_another_scene(prior, smoothing):
    frames, second = FRAMES.copy(), N // 2
    frames[:second, :, :100], frames[second:, :, 540:] = 200, 200
    detector = Performers(0.0)
    options = {"method": "articulated", "fps": 30.0, "smoothing": smoothing}
    (person,) = VideoTracker(prior, CAMERA, detector=detector, **options)(frames)
    start, tracker = second + FIRST, UpperBodyTracker(prior, CAMERA, **options)
    for first, last in ((FIRST, second), (start, N)):
        rows = slice(first, last)
        expected = tracker(
            detector.points[None, rows, 0], detector.sure[None, rows, 0], detector.names
        )
        found = person.track.joints3d[:, first - FIRST : last - FIRST]
        torch.testing.assert_close(found, expected.joints3d, rtol=1e-9, atol=1e-9)
    assert not bool(person.track.joints3d[:, second - FIRST : start - FIRST].isfinite().any())


def test_a_camera_gives_the_poses_of_a_recording(prior):
    tracker = VideoTracker(prior, CAMERA, detector=Performers(0.0))
    (person,) = tracker(FRAMES)
    state, live = tracker.init(), []
    for image in FRAMES:
        state, people = tracker.step(state, image)
        live += [found.pose.joints3d[0, 0] for found in people]
    torch.testing.assert_close(torch.stack(live), person.track.joints3d[0], rtol=1e-9, atol=1e-9)


def test_some_frames_at_a_time_give_the_poses_of_single_ones(prior):
    tracker = VideoTracker(prior, CAMERA, detector=Performers(-0.4, 0.45), method="mkf-fixed")
    state, live = tracker.init(), {0: [], 1: []}
    for image in FRAMES:
        state, people = tracker.step(state, image)
        for found in people:
            live[found.number].append(found.pose.joints3d)
    state, parts = tracker.init(), {0: [], 1: []}
    for first, last in ((0, 5), (5, N)):  # the second longer than a block
        state, tracked = tracker.advance(state, FRAMES[first:last])
        for number, some in tracked.items():
            parts[number] += some
            assert all(0 <= part.start < last - first for part in some)
    assert tracker.advance(state, [])[1] == {}
    for number in (0, 1):
        one_by_one = torch.cat(live[number], 1)
        together = torch.cat([part.poses.joints3d for part in parts[number]], 1)
        assert together.shape == (1, N - FIRST, 8, 3)
        torch.testing.assert_close(together, one_by_one, rtol=1e-9, atol=1e-9)
        start = parts[number][0].start
        assert start == FIRST
    with pytest.raises(InputError, match="another tracker"):
        tracker.advance(state._replace(measurer=None), FRAMES[:1])


@pytest.mark.parametrize("broken", ["detector", "watch"])
def test_no_thread_reads_on_after_an_error(prior, broken):
    """The caller closes the file, which a thread must not be reading then."""

    class Broken(Performers):
        def __call__(self, image):
            if broken == "detector" and self.at == 7:
                raise InputError("broken")
            return super().__call__(image)

    def watch(image, found, poses):
        if broken == "watch" and poses:
            raise InputError("broken")

    tracker = VideoTracker(prior, CAMERA, detector=Broken(0.0), method="mkf-fixed")
    with pytest.raises(InputError, match="broken") as held:  # with its traceback
        tracker(itertools.cycle(FRAMES), watch=watch)
    assert not [one for one in threading.enumerate() if one.name == "torchpose-prefetch"], held


def test_several_persons_have_poses_of_their_own(prior):
    detector = Performers(-0.4, 0.45)
    shown = []
    tracker = VideoTracker(prior, CAMERA, detector=detector, method="mkf-fixed")
    people = tracker(FRAMES, watch=lambda image, found, poses: shown.append((found, poses)))
    assert len(people) == 2
    reference = UpperBodyTracker(prior, CAMERA, method="mkf-fixed", fps=30.0)
    for person in people:
        same(person.track, whole(reference, detector, person.number))
    found, poses = shown[-1]
    assert found.person.tolist() == [0, 1] and sorted(poses) == [0, 1] and found.faces is None
    for person, again in zip(people, tracker(FRAMES), strict=True):
        assert torch.equal(again.track.joints3d, person.track.joints3d)


@pytest.mark.slow
@pytest.mark.parametrize("smoothing", [None, "full"])
def test_a_hand_outside_of_the_image_is_expected_there(prior, smoothing):
    """Poses are those of the keypoint tracker that is told so; a camera without a size is not told."""
    detector = Performers(0.0)
    hand = UPPER_BODY.index("hand_left")
    detector.points[10:, 0, hand, 1] = 600.0
    kept = slice(FIRST, None)
    keypoints = detector.points[None, kept, 0].clone()
    keypoints[0, 10 - FIRST :, hand] = torch.nan
    absent = torch.full_like(keypoints[..., 0], torch.nan)
    absent[0, 10 - FIRST :, hand] = float(np.float32(0.95))
    sure = torch.where(keypoints[..., 0].isfinite(), detector.sure[None, kept, 0], 0.0)
    sized = PinholeCamera(*CAMERA.matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), 640, 480)
    unsized = PinholeCamera(*CAMERA.matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist())
    options = {"method": "articulated", "fps": 30.0, "smoothing": smoothing}
    for camera, given in ((sized, absent), (unsized, None)):
        (person,) = VideoTracker(prior, camera, detector=detector, **options)(FRAMES)
        torch.testing.assert_close(person.absent, absent[0], equal_nan=True)
        told = UpperBodyTracker(prior, camera, **options)(
            keypoints, sure, detector.names, absent=given
        )
        same(person.track, told)


def test_wrists_choose_the_method_as_in_files(prior):
    names = ("head", "shoulder_left", "shoulder_right", "elbow_left", "elbow_right",
             "wrist_left", "wrist_right")  # fmt: skip
    (person,) = VideoTracker(prior, CAMERA, detector=Performers(0.0, names=names))(FRAMES)
    assert person.track.method == "articulated"
    assert person.keypoints.shape == (N - FIRST, 7, 2)


def test_what_a_detector_replaces_is_refused(prior):
    detector = Performers(0.0)
    for option in (
        {"hands": "mean-shift"}, {"background": True}, {"elbows": True}, {"elbows": False},
        {"edges": True}, {"candidates": True}, {"face_detector": HaarFaceDetector()},
    ):  # fmt: skip
        with pytest.raises(InputError, match=f"^{next(iter(option))} is of the measurer of faces"):
            VideoTracker(prior, CAMERA, detector=detector, **option)
    with pytest.raises(InputError, match="min_confidence must be in 0 to 1"):
        VideoTracker(prior, CAMERA, detector=detector, min_confidence=2.0)
    with pytest.raises(InputError, match="min_confidence is of keypoints"):
        VideoTracker(prior, CAMERA, min_confidence=0.5)
    with pytest.raises(InputError, match=r"expected a detector.*got object"):
        VideoTracker(prior, CAMERA, detector=object())
    with pytest.raises(InputError, match=r"model\.pt: a detector must be an ONNX model"):
        VideoTracker(prior, CAMERA, detector="model.pt")
    tracker = VideoTracker(prior, CAMERA, detector=detector)
    with pytest.raises(InputError, match="state of this tracker"):
        tracker.step(VideoTracker(prior, CAMERA).init(), FRAMES[0])
