"""The paper's hand tracker on drawn persons whose hands are known, and on recordings of signers."""

import math

import numpy as np
import pytest
import torch

from tests.data import data_dir_or_skip
from torchpose import load_prior
from torchpose.errors import InputError, ShapeError
from torchpose.measure import MeanShiftHandTracker
from torchpose.measure._face import FaceTracker
from torchpose.measure._hand_prior import HandPrior

cv2 = pytest.importorskip("cv2")

SKIN, CLOTH, WALL = (205, 155, 130), (40, 50, 110), (190, 190, 180)
FACE = (160.0, 60.0, 40.0)


def draw(hands, face=FACE, canvas=None, seed=0):
    """A person with hands at these places, RGB [240, 320, 3]."""
    image = np.full((240, 320, 3), WALL, np.uint8) if canvas is None else canvas
    x, y, size = face
    cv2.rectangle(image, (int(x - size), int(y + 1.1 * size)), (int(x + size), 240), CLOTH, -1)
    cv2.ellipse(image, (int(x), int(y)), (int(0.5 * size), int(0.7 * size)), 0, 0, 360, SKIN, -1)
    for hand in hands:
        if hand is not None:
            cv2.circle(image, tuple(round(c) for c in hand), int(0.3 * size), SKIN, -1)
    noise = np.random.default_rng(seed).normal(0, 3, image.shape)
    return (image + noise).clip(0, 255).astype(np.uint8)


def follow(tracker, frames, faces=FACE, identity=(0,), foreground=None):
    state, found = tracker.init(), []
    for frame in frames:
        rows = torch.tensor(faces).reshape(-1, 3)
        state, hands = tracker.step(state, frame, rows, torch.tensor(identity), foreground)
        found.append(hands)
    return state, found


@pytest.mark.parametrize("likelihood", ["back-projection", "ratio"])
def test_moving_hands_are_followed_and_each_keeps_its_name(likelihood):
    t = np.arange(30)
    left = np.stack([240 + 30 * np.cos(t / 6), 150 + 30 * np.sin(t / 6)], 1)
    right = np.stack([80 + 1.0 * t, 200 - 3.0 * t], 1)
    frames = [draw(pair, seed=i) for i, pair in enumerate(zip(left, right, strict=True))]
    _, found = follow(MeanShiftHandTracker(likelihood), frames)
    points = torch.cat([hands.points for hands in found])
    truth = torch.from_numpy(np.stack([left, right], 1)).float()
    assert torch.cat([hands.seen for hands in found]).all()
    assert (points - truth).norm(dim=-1).max() < 4.0
    eigenvalues = torch.linalg.eigvalsh(torch.cat([hands.covariance for hands in found]))
    assert (eigenvalues > 0).all() and eigenvalues.sqrt().max() < 20


def test_hands_begin_only_in_their_areas():
    frame = draw([(70, 200), (110, 200)])  # both to the left of the face
    _, found = follow(MeanShiftHandTracker(), [frame])
    assert found[0].seen.tolist() == [[False, True]]
    assert torch.isnan(found[0].points[0, 0]).all() and found[0].mass[0, 0] < 0.1


def test_a_hand_that_disappears_is_lost_and_found_in_its_area_again():
    there, gone = draw([(240, 160), (80, 160)]), draw([None, (80, 160)])
    _, found = follow(
        MeanShiftHandTracker(), [there, there, gone, gone, draw([(250, 100), (80, 160)])]
    )
    assert [bool(hands.seen[0, 0]) for hands in found] == [True, True, False, False, True]
    assert all(bool(hands.seen[0, 1]) for hands in found)
    assert (found[-1].points[0, 0] - torch.tensor([250.0, 100])).norm() < 3


def test_patience_bridges_what_is_hidden_for_a_moment():
    x = 200 + 6.0 * np.arange(10)
    frames = [draw([None if i in (6, 7) else (x[i], 160), None]) for i in range(10)]
    tracker = MeanShiftHandTracker(patience=4)
    _, found = follow(tracker, frames)
    assert not found[6].seen[0, 0] and not found[7].seen[0, 0]
    # the prediction goes on, so that the hand need not be in its area
    assert found[8].seen[0, 0]
    assert (found[8].points[0, 0] - torch.tensor([x[8], 160]).float()).norm() < 4


def test_the_hand_that_is_at_rest_keeps_its_name_when_the_other_one_passes():
    rest = (200.0, 180.0)
    x = np.linspace(80, 150, 15)
    frames = [draw([rest, (u, 170.0)], seed=i) for i, u in enumerate(x)]
    _, found = follow(MeanShiftHandTracker(), frames)
    for hands in found:
        assert (hands.points[0, 0] - torch.tensor(rest)).norm() < 4


def test_the_other_hand_is_masked():
    tracker = MeanShiftHandTracker()
    skin = torch.ones(1, 60, 80)
    predicted = torch.tensor([[[20.0, 30.0], [60.0, 30.0]]])
    face = torch.tensor([[40.0, 10.0, 20.0]])
    both, one = torch.tensor([[True, True]]), torch.tensor([[False, True]])
    maps = tracker._without_the_other(skin, predicted, both, face)
    v, u = np.mgrid[:60, :80]
    for hand in (0, 1):
        centre = predicted[0, 1 - hand].numpy()
        inside = np.hypot(u - centre[0], v - centre[1]) < 0.5 * 20
        np.testing.assert_array_equal(maps[0, hand].numpy() == 0, inside)
    maps = tracker._without_the_other(skin, predicted, one, face)
    assert (maps[0, 1] == 1).all() and (maps[0, 0] == 0).any()


def test_what_is_background_is_no_hand():
    frame = draw([(240, 160), (80, 160)])
    foreground = np.full((240, 320), 255, np.uint8)
    foreground[:, 200:] = 0
    _, found = follow(MeanShiftHandTracker(), [frame], foreground=foreground)
    assert found[0].seen.tolist() == [[False, True]]


def test_persons_come_and_go_and_are_followed_as_if_alone():
    faces = {7: (80.0, 60.0, 30.0), 3: (240.0, 60.0, 30.0)}
    hands = {7: [(110, 150), (50, 150)], 3: [(270, 170), (210, 170)]}
    canvas = draw(hands[7], faces[7])
    frame = draw(hands[3], faces[3], canvas)
    tracker = MeanShiftHandTracker()
    state = tracker.init()
    for present in ([7], [7, 3], [3, 7], [], [3], [7, 3]):
        rows = torch.tensor([faces[i] for i in present]).reshape(-1, 3)
        state, found = tracker.step(state, frame, rows, torch.tensor(present, dtype=torch.long))
        assert state.identity.tolist() == present and len(found.points) == len(present)
        if len(present) > 1:
            for row, i in enumerate(present):
                truth = torch.tensor(hands[i]).float()
                assert (found.points[row] - truth).norm(dim=-1).max() < 4


def test_a_batch_of_persons_is_its_elements():
    faces = torch.tensor([[80.0, 60.0, 30.0], [240.0, 60.0, 30.0]])
    frames = [
        draw(
            [(250 + i, 150), (200, 160)],
            (240, 60, 30),
            draw([(110, 150 - i), (50, 150)], (80, 60, 30)),
        )
        for i in range(4)
    ]
    tracker = MeanShiftHandTracker()
    both, alone = tracker.init(), [tracker.init(), tracker.init()]
    for frame in frames:
        both, together = tracker.step(both, frame, faces, torch.tensor([0, 1]))
        for n in range(2):
            alone[n], single = tracker.step(alone[n], frame, faces[n : n + 1], torch.tensor([n]))
            # a person who is alone has the whole image, and the other one's hands are far away
            if bool(single.seen.all()) and (single.points - together.points[n]).abs().max() < 10:
                torch.testing.assert_close(single.points[0], together.points[n], atol=1.0, rtol=0)
    assert together.seen.all()


@pytest.mark.parametrize("likelihood", ["back-projection", "ratio"])
@pytest.mark.parametrize("by_prior", [False, True])
def test_a_person_is_measured_alike_beside_somebody_whose_face_has_another_size(
    likelihood, by_prior
):
    faces = torch.tensor([[120.0, 60.0, 58.0], [520.0, 60.0, 19.0]])  # maps of a third, and whole
    foreground = np.full((240, 640), 255, np.uint8)
    foreground[:, :20] = 0
    prior = HandPrior.from_prior(load_prior("kinect-upper-body")) if by_prior else None
    tracker = MeanShiftHandTracker(likelihood, prior=prior)
    both, alone = tracker.init(), [tracker.init(), tracker.init()]
    for i in range(5):
        canvas = np.full((240, 640, 3), WALL, np.uint8)
        larger = draw([(200 + i, 180 - 2 * i), (60, 170)], faces[0].tolist(), canvas, seed=i)
        frame = draw([(545, 110 + i), (495 - i, 115)], faces[1].tolist(), larger, seed=9 + i)
        both, together = tracker.step(both, frame, faces, torch.tensor([4, 7]), foreground)
        assert together.seen.all()
        for n in range(2):
            own, name = faces[n : n + 1], both.identity[n : n + 1]
            alone[n], single = tracker.step(alone[n], frame, own, name, foreground)
            for found, expected in zip(together, single, strict=True):
                torch.testing.assert_close(
                    found[n : n + 1], expected, rtol=1e-6, atol=1e-6, equal_nan=True
                )
            for found, expected in zip(both.skin, alone[n].skin, strict=True):
                assert torch.equal(found[n : n + 1], expected)


def test_with_the_prior_a_hand_may_begin_on_the_other_side():
    frames = [draw([None, (60, 150)])] * 2 + [draw([(128, 150), (60, 150)])] * 3
    prior = HandPrior.from_prior(load_prior("kinect-upper-body"))
    _, by_area = follow(MeanShiftHandTracker(), frames)
    _, by_prior = follow(MeanShiftHandTracker(prior=prior), frames)
    assert not by_area[-1].seen[0, 0]
    assert by_prior[-1].seen.all()
    assert (by_prior[-1].points[0, 0] - torch.tensor([128.0, 150])).norm() < 4


def test_bad_input_is_refused():
    tracker, frame = MeanShiftHandTracker(), draw([])
    face, identity = torch.tensor([FACE]), torch.tensor([0])
    with pytest.raises(InputError, match="likelihood"):
        MeanShiftHandTracker("hue")
    with pytest.raises(InputError, match="threshold"):
        MeanShiftHandTracker(threshold=1.5)
    with pytest.raises(InputError, match="window"):
        MeanShiftHandTracker(window=0.0)
    with pytest.raises(InputError, match="RGB"):
        tracker.step(tracker.init(), frame[..., 0], face, identity)
    with pytest.raises(InputError, match="foreground"):
        tracker.step(tracker.init(), frame, face, identity, frame[:10, :, 0])
    with pytest.raises(InputError, match="positive size"):
        tracker.step(tracker.init(), frame, -face, identity)
    with pytest.raises(ShapeError, match="identity"):
        tracker.step(tracker.init(), frame, face, torch.tensor([0, 1]))


@pytest.mark.data
def test_dark_sleeves_are_followed():
    """The paper's recipe alone, on the clip that is easiest for it."""
    folder = data_dir_or_skip("video_asl")
    with np.load(folder / "again_mediapipe_pose1.npz") as file:
        names, joints = list(file["names"]), file["joints2d"]
    video = cv2.VideoCapture(str(folder / "again.mkv"))
    faces, tracker = FaceTracker(), MeanShiftHandTracker()
    tracks, state, errors = faces.init(), tracker.init(), []
    width = np.median(np.hypot(*(joints[:, 5] - joints[:, 6]).T))
    assert names[5:7] == ["left_shoulder", "right_shoulder"]
    for t in range(40):
        frame = cv2.cvtColor(video.read()[1], cv2.COLOR_BGR2RGB)
        tracks = faces.step(tracks, cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY))
        used = faces.usable(tracks)
        state, hands = tracker.step(state, frame, tracks.mean[used, :3], tracks.identity[used])
        for k, side in enumerate(("left", "right")):
            wrist, index = (joints[t, names.index(f"{side}_{p}")] for p in ("wrist", "index"))
            if t >= 15:
                errors.append(math.dist(hands.points[0, k].tolist(), wrist + 0.7 * (index - wrist)))
    assert np.mean(np.array(errors) < width / 4) > 0.9
