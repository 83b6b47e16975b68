"""Face tracks against single Kalman filters, and the detector on recordings of signers."""

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from tests.data import data_dir_or_skip
from torchpose.errors import InputError, ShapeError
from torchpose.measure import HaarFaceDetector, UpperBodyMeasurer
from torchpose.measure._face import FaceTracker
from torchpose.measure._face_detector import Region
from torchpose.measure._grey_frame import GreyFrame
from torchpose.priors import load_prior


def nobody(image, region=None):
    """A detector that finds nothing."""
    return torch.zeros(0, 3, dtype=torch.float64)


class Script:
    """A detector that says what it is told, frame by frame, and notes where it was asked to look."""

    def __init__(self, frames):
        self.frames, self.asked = [torch.tensor(f).double().reshape(-1, 3) for f in frames], []

    def __call__(self, image, region=None):
        found = self.frames[int(image[0, 0])]
        self.asked.append(region)
        if region is None:
            return found
        x, y = found[:, 0], found[:, 1]
        inside = (x >= region.left) & (x < region.right) & (y >= region.top) & (y < region.bottom)
        return found[inside]


def follow(frames, **options):
    """All tracks after each of the frames."""
    detector = Script(frames)
    tracker = FaceTracker(detector, **options)
    states = [tracker.init()]
    for t in range(len(frames)):
        image = np.full((480, 640), t, np.uint8)
        states.append(tracker.step(states[-1], image))
    return tracker, states[1:], detector


def test_a_track_is_the_kalman_filter_of_its_detections():
    rng = np.random.default_rng(0)
    moving = np.array([[200 + 3 * t, 150 - t, 80] for t in range(12)])
    frames = (moving + rng.normal(0, 2, moving.shape))[:, None]
    tracker, states, _ = follow(frames, every=1, whole_every=1)
    mean, cov = None, None
    matrix = tracker.matrix.numpy()
    for detection, state in zip(frames, states, strict=True):
        z = detection[0]
        if mean is None:
            mean = np.concatenate([z, np.zeros(3)])
            cov = np.diag(np.repeat([0.04, 0.08], 3) ** 2 * z[2] ** 2)
        else:
            noise = (tracker.acceleration * mean[2]) ** 2 * np.eye(6)
            mean, cov = matrix @ mean, matrix @ cov @ matrix.T + noise
            innovation = cov[:3, :3] + (tracker.std * mean[2]) ** 2 * np.eye(3)
            gain = np.linalg.solve(innovation, cov[:3]).T
            mean, cov = mean + gain @ (z - mean[:3]), cov - gain @ innovation @ gain.T
        np.testing.assert_allclose(state.mean[0], mean, rtol=1e-9)
        np.testing.assert_allclose(state.cov[0], cov, rtol=1e-7, atol=1e-9)


def test_a_face_is_used_after_three_hits_and_survives_gaps():
    face = [[300.0, 200.0, 90.0]]
    tracker, states, _ = follow([face] * 20 + [[]] * 15 + [face] * 3, every=1, whole_every=1)
    used = [bool(tracker.usable(s).any()) for s in states]
    assert used == [False, False] + [True] * 36
    assert states[34].unseen.tolist() == [15]
    assert states[-1].identity.tolist() == [0] and states[-1].age.tolist() == [37]


def test_sporadic_detections_are_never_used_and_die():
    frames = [[[100.0, 100.0, 60.0]] if t % 5 == 0 else [] for t in range(30)]
    tracker, states, _ = follow(frames, every=1, whole_every=1, detail=60.0)
    assert not any(bool(tracker.usable(s).any()) for s in states)
    assert len(states[4].mean) == 0 and states[-1].next_identity > 1


def test_two_faces_that_pass_keep_their_identities():
    frames = [[[100.0 + 20 * t, 150, 80], [500.0 - 20 * t, 210, 84]] for t in range(20)]
    _, states, _ = follow(frames, every=1, whole_every=1)
    final = dict(zip(states[-1].identity.tolist(), states[-1].mean[:, 0].tolist(), strict=True))
    assert final == pytest.approx({0: 480.0, 1: 120.0}, abs=12)


@pytest.mark.parametrize("rate", [1.0, 2.0, 6.0])
def test_faces_that_move_as_fast_are_followed_in_slower_videos(rate):
    step = 16 * rate  # pixels a frame, at 30 frames a second a fifth of the face
    frames = [[[80.0 + step * t, y, 80] for y in (150.0, 254.0)] for t in range(int(60 / rate))]
    frames = [faces for faces in frames if faces[0][0] < 560]
    _, states, _ = follow(frames, rate=rate)
    assert states[-1].identity.tolist() == [0, 1]
    assert states[-1].hits.tolist() == pytest.approx(
        2 * [min(len(frames), 30)], abs=len(frames) / 2
    )
    away = states[-1].mean[:, :2] - torch.tensor(frames[-1]).double()[:, :2]
    assert float(away.abs().max()) < 8


def test_frames_of_a_slow_video_are_searched_as_often_as_time_allows():
    face = [[300.0, 200.0, 90.0]]
    asked = []
    for rate in (1.0, 2.0):
        _, _, detector = follow([face] * int(60 / rate), every=2, whole_every=10, rate=rate)
        asked.append(sum(region is None for region in detector.asked))
    assert asked == [6, pytest.approx(6, abs=1)]


@pytest.mark.parametrize(("fps", "rate"), [(10, 3.0), (25, 1.2), (30, 1.0), (60, 1.0)])
def test_a_measurer_follows_faces_at_the_rate_of_its_video(fps, rate):
    measurer = UpperBodyMeasurer(load_prior("kinect-upper-body-small"), fps, hands="mean-shift")
    assert measurer.face_tracker.rate == pytest.approx(rate)


@pytest.mark.parametrize("n_black", [0, 1, 3])
def test_a_face_after_black_frames_is_used_from_the_third_on(n_black):
    def bright(image, region=None):
        return torch.tensor([[160.0, 60.0, 80.0]] * bool(image[60, 160])).double().reshape(-1, 3)

    prior = load_prior("kinect-upper-body-small")
    measurer = UpperBodyMeasurer(prior, hands="mean-shift", face_detector=bright)
    scene = (
        np.random.default_rng(0).integers(1, 255, (12, 16, 3), np.uint8).repeat(20, 0).repeat(20, 1)
    )
    images = [scene] * 8 + [np.zeros_like(scene)] * n_black + [scene] * 4
    state, found = measurer.init(), []
    for image in images:
        state, measured = measurer.step(state, image)
        found.append(len(measured.person))
    after = [0, 0, 1, 1] if n_black else [1] * 4
    assert found == [0, 0, *[1] * 6, *[0] * n_black, *after]


def test_known_faces_are_searched_where_they_are():
    face = [[300.0, 200.0, 90.0]]
    _, _, detector = follow([face] * 12, every=2, whole_every=10)
    # everywhere at first, then near it: in every frame until it may be used, then in every second
    later = detector.asked[1:]
    assert detector.asked[0] is None
    assert [region is None for region in later] == [False] * 6 + [True]
    assert later[0].left == pytest.approx(201, abs=3) and later[0].right == pytest.approx(
        399, abs=3
    )
    assert later[0].smallest == pytest.approx(67.5, abs=2)


@pytest.mark.parametrize("found", [[[330.0, 200.0, 90.0]], [[300.0, 200.0, 116.0]], []])
def test_a_face_that_is_not_where_it_was_expected_is_searched_for_in_more_of_the_image(found):
    before, frames = [[300.0, 200.0, 90.0]], 16
    _, _, detector = follow([before] * frames + [found], every=1, whole_every=100)
    close, around = detector.asked[frames : frames + 2]
    assert (close.left, close.right) == pytest.approx((223.5, 376.5), abs=3)
    assert (around.left, around.right) == pytest.approx((201, 399), abs=3)
    assert (around.smallest, around.largest) == pytest.approx((67.5, 126), abs=3)
    asked = [region.left for region in detector.asked[1:frames]]
    assert asked == [around.left] * 9 + [close.left] * (frames - 10)


def test_frames_are_made_grey_where_they_are_searched():
    """As whole ones are: of a face that moves, that is lost, and that jumps aside. Most are not at all."""
    face, tracker, parts = portrait(80), FaceTracker(whole_every=100), []

    class Noted(GreyFrame):
        def at(self, part):
            parts[-1].append((part.bottom - part.top) * (part.right - part.left) / face.size)
            return super().at(part)

    states = [tracker.init()] * 2
    for t in range(40):
        lost = t in range(25, 30)
        image = np.full_like(face, 128) if lost else np.roll(face, 2 * t + 20 * (t > 32), axis=1)
        parts.append([])
        frame = Noted(np.repeat(image[..., None], 3, 2))
        states = [tracker.step(states[0], image), tracker.step(states[1], frame)]
        assert torch.equal(states[0].mean, states[1].mean)
    assert len(states[0].mean) == 1
    assert parts[21] == parts[23] == [] and max(map(max, filter(None, parts[4:]))) < 0.4


def test_without_a_face_the_whole_image_is_searched_now_and_then():
    _, _, detector = follow([[]] * 11, search_every=5)
    small = Region(0, 0, 640, 480, 11.0, 40.0)
    assert detector.asked == [None, None, small] * 3  # as it is, turned, and for small faces
    later = [[]] * 6 + [[[300.0, 200.0, 90.0]]] * 8
    tracker, states, _ = follow(later, search_every=5)
    assert [len(s.mean) for s in states] == [0] * 10 + [1] * 4
    assert bool(tracker.usable(states[-1]).all())


@pytest.mark.parametrize("size", [20.0, 90.0, 300.0])
def test_a_face_that_walks_out_of_the_image_is_searched_for_in_what_is_left_of_it(size):
    """On every side, in steps of a sixth of a pixel of the searched image."""
    parts = []

    def noted(image, region=None):
        parts.append(image[region.top : region.bottom, region.left : region.right].shape)
        return nobody(image)

    tracker, image = FaceTracker(noted, detail=80.0), np.zeros((480, 640), np.uint8)
    for out in np.arange(0.9, 1.3, 1 / 480) * size:
        for place in ((-out, 200.0), (639 + out, 200.0), (300.0, -out), (300.0, 479 + out)):
            assert len(tracker._look_near(image, [*place, size], lasting=True)) == 0
    assert min(map(min, parts)) >= 1
    assert max(map(min, parts)) <= 0.25 * 80  # never the rest of the image


def test_a_face_that_is_lost_while_it_becomes_smaller_ends():
    sizes = [90.0] * 9 + [90.0 * 0.89**t for t in range(9)] + [None] * 30

    def whole(image, region=None):
        size = sizes[int(image[0, 0])]
        there = size is not None and region is None
        return torch.tensor([[300.0, 200.0, size]]).double() if there else nobody(image)

    tracker, states = FaceTracker(whole, every=1, whole_every=1, search_every=1), []
    for t in range(len(sizes)):
        before = states[-1] if states else tracker.init()
        states.append(tracker.step(before, np.full((480, 640), t, np.uint8)))
    assert len(states[17].mean) == 1 and bool(tracker.usable(states[17]).all())
    assert all(bool((state.mean[:, 2] > 0).all()) for state in states)
    assert len(states[-1].mean) == 0 and states[-1].next_identity == 1


def test_one_face_in_two_overlapping_regions_is_one_detection():
    near = [[200.0, 200.0, 80.0], [250.0, 200.0, 80.0]]
    _, states, _ = follow([near] * 4 + [near[:1]] * 2, every=1, whole_every=100)
    assert states[-1].unseen.tolist() == [0, 2] and states[-1].next_identity == 2


def test_of_detections_that_overlap_the_one_where_the_face_is_known_to_be_is_taken():
    """Whatever their order: a hand before a face gives a second box, over its upper half."""
    face, second = [300.0, 200.0, 90.0], [290.0, 168.0, 84.0]
    frames = [[face]] * 6 + [[second, face]] * 20
    _, states, _ = follow(frames, every=1, whole_every=100)
    assert states[-1].mean[:, :3].tolist() == [pytest.approx(face, abs=0.5)]
    assert states[-1].next_identity == 1


def test_bad_input_is_refused():
    with pytest.raises(InputError, match="memory at least"):
        FaceTracker(nobody, min_hits=5, memory=4)
    with pytest.raises(InputError, match="must be positive"):
        FaceTracker(nobody, gate=0.0)
    with pytest.raises(InputError, match="scale_factor"):
        HaarFaceDetector(scale_factor=1.0)
    with pytest.raises(InputError, match="grey"):
        HaarFaceDetector()(np.zeros((10, 10, 3), np.uint8))
    with pytest.raises(InputError, match="must be callable"):
        FaceTracker("haar")
    tracker = FaceTracker(nobody)
    with pytest.raises(InputError):
        tracker.update(tracker.init(), torch.tensor([[1.0, float("nan"), 2.0]]))
    with pytest.raises(ShapeError):
        tracker.update(tracker.init(), torch.zeros(1, 4))


def test_threads_that_share_a_detector_search_one_after_the_other():
    """OpenCV's cascade keeps the image that it searches; another search meanwhile ended in its own error."""
    detector, inside, most = HaarFaceDetector(), [], []

    class Cascade:
        def detectMultiScale(self, *_, **__):
            inside.append(1)
            most.append(len(inside))
            time.sleep(0.01)
            inside.pop()
            return ()

    detector._cascade = Cascade()
    with ThreadPoolExecutor(2) as threads:
        list(threads.map(detector, [np.zeros((40, 40), np.uint8)] * 4))
    assert most == [1] * 4


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 1, 0], [1, 0, 2]])
def test_detections_come_in_one_order_however_threads_end(order):
    boxes = np.array([[60, 20, 50, 50], [10, 30, 40, 40], [200, 10, 40, 40]])

    class Cascade:
        def detectMultiScale(self, *_, **__):
            return boxes[order]

    detector = HaarFaceDetector()
    detector._cascade = Cascade()
    found = detector(np.full((120, 320), 128, np.uint8))
    assert found.tolist() == [[220, 30, 40], [30, 50, 40], [85, 45, 50]]


def test_the_detector_finds_nothing_in_an_empty_region():
    image = np.full((200, 200), 128, np.uint8)
    assert len(HaarFaceDetector()(image)) == 0
    assert len(HaarFaceDetector()(image, Region(50, 50, 50, 90, 40, 60))) == 0


def faces_of_signer(clip, frames):
    """Return the faces (x, y, size) that are used in each of the first frames of a clip."""
    cv2 = pytest.importorskip("cv2")
    video = cv2.VideoCapture(str(data_dir_or_skip("video_asl") / f"{clip}.mkv"))
    tracker, found = FaceTracker(), []
    state = tracker.init()
    for _ in range(frames):
        read, image = video.read()
        assert read
        state = tracker.step(state, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
        found.append(state.mean[tracker.usable(state), :3])
    return found


@pytest.mark.parametrize("clip", ["again", "bird", "learn"])
def test_faces_of_signers_are_followed_without_false_ones(clip):
    """Within 40 pixels of MediaPipe's nose in every frame after fifteen, and nothing else is used."""
    with np.load(data_dir_or_skip("video_asl") / f"{clip}_mediapipe_pose1.npz") as landmarks:
        nose = torch.from_numpy(landmarks["joints2d"][:, 0]).double()
    for t, faces in enumerate(faces_of_signer(clip, 40)[15:], 15):
        assert len(faces) == 1
        assert torch.dist(faces[0, :2], nose[t]) < 40


def test_a_face_behind_a_hand_does_not_jump():
    faces = torch.cat(faces_of_signer("bird", 58)[15:])
    steps = faces[:, :2].diff(dim=0).norm(dim=1) / faces[1:, 2]
    assert len(faces) == 43
    assert steps.max() < 0.1  # it jumped by a third of its size


@pytest.mark.parametrize("size", [20.0, 90.0, 400.0])
def test_known_faces_are_looked_for_at_the_size_that_the_detector_likes(size):
    """A detector that finds the brightest square, whatever its size, and remembers what it saw."""
    seen = []

    def brightest(image, region=None):
        rows, columns = np.nonzero(image > 128)
        side = float(columns.max() - columns.min() + 1)
        if region is not None:
            seen.append((side, region.smallest, region.largest))
        place = [columns.mean(), rows.mean(), side]
        return torch.tensor([place], dtype=torch.float64)

    image = np.zeros((900, 1200), np.uint8)
    half = round(size / 2)
    image[400 - half : 400 + half, 500 - half : 500 + half] = 255
    tracker = FaceTracker(brightest, every=1, detail=80.0)
    state = tracker.init()
    for _ in range(8):
        state = tracker.step(state, image)
    np.testing.assert_allclose(state.mean[0, :3], [499.5, 399.5, size], atol=0.02 * size)
    assert all(side == pytest.approx(80.0, rel=0.2) for side, _, _ in seen)
    assert all(low < side < high for side, low, high in seen)


def test_a_far_smaller_face_on_the_chest_of_another_is_not_used():
    person, collar, child = [300.0, 150.0, 100.0], [310.0, 400.0, 40.0], [310.0, 300.0, 80.0]
    behind = [450.0, 150.0, 40.0]
    frames = [[person, collar, child, behind]] * 6
    tracker, states, _ = follow(frames, every=1, whole_every=1, gate=0.2)
    assert len(states[-1].mean) == 4
    used = states[-1].mean[tracker.usable(states[-1]), :3]
    torch.testing.assert_close(used, torch.tensor([person, child, behind]).double())


def portrait(size, degrees=0.0, light=1.0):
    """A face so many pixels large in the middle of a grey image of 480 x 270, turned and darkened."""
    cv2 = pytest.importorskip("cv2")
    pytest.importorskip("matplotlib")
    from torchpose.demo._rendering import look

    grey = cv2.cvtColor(look._read(), cv2.COLOR_RGB2GRAY)
    scale = size / look._FACE_SIDE
    matrix = cv2.getRotationMatrix2D(look._FACE, degrees, scale)
    matrix[:, 2] += np.array([240, 135]) - look._FACE
    if scale < 0.5:
        grey = cv2.GaussianBlur(grey, (0, 0), 0.4 / scale)
    image = cv2.warpAffine(
        grey, matrix, (480, 270), borderMode=cv2.BORDER_CONSTANT, borderValue=120
    )
    return (light * image).astype(np.uint8)


@pytest.mark.parametrize(
    ("size", "degrees", "light"),
    [(16, 0, 1.0), (20, 0, 1.0), (30, 0, 0.4), (160, 0, 1.0), (70, 0, 0.15), (70, 32, 1.0), (70, -32, 0.3)],
)  # fmt: skip
def test_small_large_tilted_and_dark_faces_are_found_where_they_are(size, degrees, light):
    image, tracker = portrait(size, degrees, light), FaceTracker()
    state = tracker.init()
    for _ in range(10):
        state = tracker.step(state, image)
    faces = state.mean[tracker.usable(state), :3]
    assert len(faces) == 1
    assert torch.dist(faces[0, :2], torch.tensor([240.0, 135.0]).double()) < 0.25 * size
    assert 0.75 * size < faces[0, 2] < 1.4 * size


def test_small_faces_are_not_searched_for_while_a_larger_one_is_known():
    face = [[300.0, 200.0, 90.0]]
    _, _, detector = follow([face] * 24, every=2, whole_every=10)
    whole = [r for r in detector.asked if r is None or (r.right, r.bottom) == (640, 480)]
    assert whole == [None] * 3


def test_a_face_that_comes_after_far_smaller_patterns_is_found_and_takes_their_place():
    patterns, face = [[500.0, 100, 15], [500, 200, 14]], [200.0, 200, 120]

    def detector(image, region=None):
        if image.shape == (480, 640) and region is None:
            found = [face] if image[0, 0] >= 8 else []
        elif image.shape == (480, 640):
            found = patterns
        else:  # about a known face, scaled
            found = [[image.shape[1] / 2, image.shape[0] / 2, 80.0]]
        return torch.tensor(found, dtype=torch.float64).reshape(-1, 3)

    tracker = FaceTracker(detector)
    state = tracker.init()
    used = []
    for t in range(30):
        state = tracker.step(state, np.full((480, 640), t, np.uint8))
        used.append(state.mean[tracker.usable(state), 2].tolist())
    assert used[7] == pytest.approx([15, 14], abs=2)  # nobody else is known
    assert used[-1] == pytest.approx([120], abs=2)


def test_somebody_who_walks_away_from_another_is_still_used():
    tracker = FaceTracker(nobody)
    state = tracker.init()
    for t in range(90):
        size = 60 * 0.985**t
        found = torch.tensor([[150.0, 200, 120], [450.0, 100, size]], dtype=torch.float64)
        state = tracker.update(tracker._predict(state), found)
    assert size < 0.3 * 120
    used = state.mean[tracker.usable(state), 2]
    assert used.tolist() == pytest.approx([120.0, size], rel=0.05)


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (np.array([[30.0, 30.0, 60.0]]), "must be a floating-point tensor, got ndarray"),
        ([], "must be a floating-point tensor, got list"),
        (torch.ones(1, 3, dtype=torch.long), "got torch.int64"),
        (torch.ones(1, 4), r"must have shape \[N, 3\], got \[1, 4\]"),
    ],
)
def test_a_detector_of_ones_own_that_returns_no_faces_is_named(found, said):
    tracker = FaceTracker(lambda image, region=None: found)
    with pytest.raises((InputError, ShapeError), match="faces of the face detector.*" + said):
        tracker.step(tracker.init(), np.zeros((120, 160), np.uint8))
