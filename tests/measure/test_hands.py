"""The hand tracker on drawn persons, and on recordings of signers."""

import numpy as np
import pytest
import torch

import torchpose
from tests.data import data_dir_or_skip
from torchpose.errors import InputError, ShapeError
from torchpose.measure import HandTracker
from torchpose.measure._body_window import CELLS, cell_centres
from torchpose.measure._hand_likelihood import HandLikelihood, HandSettings
from torchpose.measure._hand_network import HandNetwork, HandPlaces
from torchpose.measure._hand_prior import HandPrior
from torchpose.measure._hands import HandState

cv2 = pytest.importorskip("cv2")
SKIN, CLOTH, WALL = (205, 152, 128), (40, 50, 115), (190, 190, 180)
BACKGROUND = np.random.default_rng(0).normal(0, 6, (480, 640, 3))


@pytest.fixture(scope="module")
def prior():
    return HandPrior.from_prior(torchpose.load_prior("kinect-upper-body"))


def draw(image, x, y, b, hands):
    """A person with long sleeves, the face at (x, y)."""

    def at(u, v):
        return (round(x + u * b), round(y + v * b))

    cv2.rectangle(image, at(-1.0, 1.0), at(1.0, 8.0), CLOTH, -1)
    for side, hand in zip((1, -1), hands, strict=True):
        shoulder, elbow = at(0.9 * side, 1.3), at(1.25 * side, 3.0)
        hand = (round(hand[0]), round(hand[1]))
        cv2.line(image, shoulder, elbow, CLOTH, round(0.55 * b))
        cv2.line(image, elbow, hand, CLOTH, round(0.45 * b))
        cv2.circle(image, hand, round(0.3 * b), SKIN, -1)
    cv2.ellipse(image, at(0, 0), (round(0.5 * b), round(0.65 * b)), 0, 0, 360, SKIN, -1)
    cv2.ellipse(image, at(0, -0.5), (round(0.5 * b), round(0.3 * b)), 0, 0, 360, (50, 40, 30), -1)


def hands_at(t, x=320.0, y=120.0, b=76.0):
    """Left and right hand, both on the move."""
    left = (x + b * (1.1 + 0.5 * np.cos(t / 8)), y + b * (2.2 + 1.2 * np.sin(t / 8)))
    right = (x - b * (1.1 + 0.5 * np.cos(t / 8)), y + b * (2.4 + 1.0 * np.sin(t / 8 + 0.5)))
    return np.array([left, right])


def scene(t, persons=((320.0, 120.0, 76.0),), lag=0):
    image = np.full((480, 640, 3), WALL, np.uint8)
    for n, (x, y, b) in enumerate(persons):
        draw(image, x, y, b, hands_at(t + 9 * n + lag, x, y, b))
    noisy = image + BACKGROUND + np.random.default_rng(t).normal(0, 2, image.shape)
    return np.clip(cv2.GaussianBlur(noisy, (0, 0), 1), 0, 255).astype(np.uint8)


def follow(tracker, frames, faces, identity=None):
    state, out = tracker.init(), []
    faces = torch.tensor(faces, dtype=torch.float64)
    identity = torch.arange(len(faces)) if identity is None else identity
    for frame in frames:
        state, hands = tracker.step(state, frame, faces, identity)
        out.append(hands)
    return state, out


@pytest.fixture(scope="module")
def clip():
    return [scene(t) for t in range(30)]


@pytest.fixture(scope="module")
def tracked(prior, clip):
    return follow(HandTracker(prior), clip, [(320.0, 120.0, 76.0)])


def test_moving_hands_are_found(tracked):
    _, out = tracked
    truth = np.stack([hands_at(t) for t in range(30)])
    points = torch.cat([hands.points for hands in out]).numpy()
    error = np.linalg.norm(points - truth, axis=-1)[5:]
    assert np.median(error) < 10 and error.max() < 0.49 * 76
    assert all(bool(hands.seen.all()) for hands in out[2:])
    covariance = torch.cat([hands.covariance for hands in out])
    assert (torch.linalg.eigvalsh(covariance) > (0.04 * 76) ** 2).all()
    mass = torch.cat([hands.mass for hands in out])
    assert ((mass > 0) & (mass < 1 + 1e-6)).all()


def test_the_same_again(prior, clip, tracked):
    _, out = follow(HandTracker(prior), clip[:8], [(320.0, 120.0, 76.0)])
    for one, two in zip(out, tracked[1], strict=False):
        for x, y in zip(one, two, strict=True):
            torch.testing.assert_close(x, y, atol=0, rtol=0, equal_nan=True)


def test_two_persons_are_each_alone(prior):
    faces = [(180.0, 110.0, 50.0), (470.0, 130.0, 56.0)]
    frames = [scene(t, faces) for t in range(6)]
    tracker = HandTracker(prior)
    _, both = follow(tracker, frames, faces)
    for n in range(2):
        _, alone = follow(tracker, frames, faces[n : n + 1])
        for pair, own in zip(both, alone, strict=True):
            torch.testing.assert_close(pair.points[n], own.points[0], atol=0.05, rtol=0)
            torch.testing.assert_close(pair.mass[n], own.mass[0], atol=1e-3, rtol=0)


def test_persons_come_and_go(prior):
    faces = torch.tensor([(180.0, 110.0, 50.0), (470.0, 130.0, 56.0)], dtype=torch.float64)
    tracker = HandTracker(prior)
    state = tracker.init()
    assert len(state.beliefs.identity) == 0
    frames = [scene(t, faces.tolist()) for t in range(8)]
    for t in range(4):
        state, hands = tracker.step(state, frames[t], faces[:1], torch.tensor([7]))
    before = state.beliefs.cells[0]
    state, hands = tracker.step(state, frames[4], faces.flip(0), torch.tensor([3, 7]))
    assert hands.points.shape == (2, 2, 2) and state.beliefs.frames.tolist() == [1, 5]
    assert (state.beliefs.cells[1] - before).abs().sum() < (
        state.beliefs.cells[0] - before
    ).abs().sum()
    first, _ = follow(tracker, frames[4:5], faces[1:].tolist(), torch.tensor([3]))
    torch.testing.assert_close(state.beliefs.cells[0], first.beliefs.cells[0], atol=1e-4, rtol=0)
    state, hands = tracker.step(state, frames[5], faces[1:], torch.tensor([3]))
    assert state.beliefs.identity.tolist() == [3] and state.beliefs.frames.tolist() == [2]
    state, hands = tracker.step(state, frames[6], faces[:0], torch.zeros(0, dtype=torch.long))
    assert hands.points.shape == (0, 2, 2) and len(state.beliefs.identity) == 0
    assert all(len(x) == 0 for x in leaves(state))


def test_windows_may_look_ahead_of_the_beliefs(prior):
    """Windows that have looked at all frames before the first belief give the same hands."""
    tracker, number = HandTracker(prior), torch.tensor([0])
    faces = torch.tensor([(320.0, 120.0, 76.0)])
    frames = [scene(t) for t in range(12)]
    views, windows = [], tracker.init().windows
    for frame in frames:
        windows, view = tracker.look(windows, frame, faces, number)
        views.append(view)
    state, beliefs = tracker.init(), tracker.init().beliefs
    for frame, view in zip(frames, views, strict=True):
        beliefs, ahead = tracker.find(beliefs, view)
        state, hands = tracker.step(state, frame, faces, number)
        torch.testing.assert_close(ahead, hands, rtol=0, atol=0, equal_nan=True)
    assert bool(hands.points.isfinite().all())
    for now, before in zip(leaves(state), [*leaves(windows), *leaves(beliefs)], strict=True):
        torch.testing.assert_close(now, before, rtol=0, atol=0, equal_nan=True)


def leaves(state):
    return [state] if isinstance(state, torch.Tensor) else [x for s in state for x in leaves(s)]


def test_every_tensor_of_the_state_has_the_persons_first(tracked):
    state, _ = tracked
    assert isinstance(state, HandState)
    assert all(len(x) == 1 for x in leaves(state))
    assert state.beliefs.cells.shape == (1, 2, *CELLS)
    torch.testing.assert_close(state.beliefs.cells.sum((2, 3)), torch.ones(1, 2))


def test_a_window_that_moves_with_its_person_changes_nothing(prior):
    """A camera that pans: face and hands move through the image, and take their window along."""
    tracker, state, errors, anchors = HandTracker(prior), None, [], set()
    for t in range(20):
        x, y, b = 250.0 + 8 * t, 120.0, 60.0
        image = scene(t, ((x, y, b),))
        face = torch.tensor([[x, y, b]], dtype=torch.float64)
        state, hands = tracker.step(state or tracker.init(), image, face, torch.tensor([0]))
        errors.append(hands.points[0].numpy() - hands_at(t, x, y, b))
        anchors.add(tuple(state.windows.anchors[0].tolist()))
    assert len(anchors) > 3
    error = np.linalg.norm(np.stack(errors[5:]), axis=-1)
    assert np.median(error) < 10 and error.max() < 0.49 * 60


def test_a_frame_of_4k_is_like_a_small_one(prior, clip, tracked):
    large = [cv2.resize(f, None, fx=6, fy=6, interpolation=cv2.INTER_LINEAR) for f in clip[:8]]
    face = [(6 * 320.5 - 0.5, 6 * 120.5 - 0.5, 6 * 76.0)]
    _, out = follow(HandTracker(prior), large, face)
    for t in range(3, 8):
        small = (out[t].points + 0.5) / 6 - 0.5
        assert (small - tracked[1][t].points).abs().max() < 0.1 * 76


def test_a_dark_room_is_like_a_bright_one(prior, clip, tracked):
    dark = [(0.08 * frame).astype(np.uint8) for frame in clip]
    _, out = follow(HandTracker(prior), dark, [(320.0, 120.0, 76.0)])
    apart = torch.cat([one.points - two.points for one, two in zip(out, tracked[1], strict=True)])
    assert float(apart[5:].norm(dim=-1).max()) < 0.15 * 76


class OneHandForTwo(HandNetwork):
    """A network that takes a hand for either one once the right hand is covered."""

    def __init__(self, hands, covered_from):
        super().__init__()
        away = cell_centres() - torch.tensor(hands, dtype=torch.float32)[:, None, None]
        peak = torch.exp(-0.5 * (away / 0.15).square().sum(-1)) + 1e-4
        peak[:, cell_centres()[..., 1] < 0.8] = 1e-6  # no hand at the face
        self.left, self.right = (p / p.sum() for p in peak)
        self.covered_from, self.frame = covered_from, 0

    def see_colours(self, lab, inside, faces):
        return torch.zeros(len(lab), 1, 44, 48)

    def find(self, *inputs):
        covered = self.frame >= self.covered_from
        right = 0.8 * self.left + 0.2 * self.right if covered else self.right
        self.frame += 1
        places = torch.stack([self.left, right])[None].log()
        odds = torch.tensor([[-3.0, -0.3 if covered else -3.0]])
        return HandPlaces(places, odds, places, odds)


def test_a_hand_that_is_covered_is_not_measured_at_the_other_one(prior):
    face, hands = (320.0, 120.0, 76.0), hands_at(0)
    image = scene(0)
    covered = image.copy()
    cv2.circle(covered, tuple(int(v) for v in hands[1].round()), 28, CLOTH, -1)
    frames = [image] * 5 + [covered] * 10
    away = []
    for cost in (0.0, HandSettings().jump_to_other):
        network = OneHandForTwo((hands - face[:2]) / face[2], covered_from=5)
        tracker = HandTracker(prior, HandSettings(jump_to_other=cost, still=1.0), network=network)
        _, out = follow(tracker, frames, [face])
        away.append([(h.points[0, 1] - torch.from_numpy(hands[0])).norm() / face[2]
                     if h.seen[0, 1] else torch.tensor(torch.inf) for h in out])  # fmt: skip
        left = torch.stack([h.points[0, 0] for h in out[5:]])
        assert (left - torch.from_numpy(hands[0])).norm(dim=-1).max() < 0.3 * face[2]
    free, held = torch.tensor(away)
    assert free.min() < 0.7  # what the network alone says
    assert held.min() > 1


def test_hands_out_of_the_image_are_not_seen(prior):
    """A narrow view of head and shoulders: no skin is invented where the image has ended."""
    frames = [scene(t)[:230, 200:440].copy() for t in range(8)]
    _, out = follow(HandTracker(prior), frames, [(120.0, 120.0, 76.0)])
    assert not out[-1].seen.any()


def test_hands_at_the_border_are_not_drawn_to_it(prior):
    """The image ends at the wrist's end of the fingers."""
    still = [
        np.clip(scene(0) * 0.0 + f, 0, 255).astype(np.uint8)
        for f in (hanging(seed) for seed in range(12))
    ]
    _, out = follow(HandTracker(prior), still, [(320.0, 100.0, 76.0)])
    error = (out[-1].points[0] - torch.tensor([[430.0, 448.0], [210.0, 448.0]])).norm(dim=-1)
    assert (error < 0.25 * 76).all()


def hanging(seed):
    image = np.full((480, 640, 3), WALL, np.uint8)
    draw(image, 320.0, 100.0, 76.0, [(430, 448), (210, 448)])
    noise = np.random.default_rng(seed).normal(0, 2, image.shape)
    return cv2.GaussianBlur(image + noise, (0, 0), 1)


def test_a_foreground_mask_hides_skin(prior, clip):
    faces, number = torch.tensor([(320.0, 120.0, 76.0)]), torch.tensor([0])
    tracker = HandTracker(prior)
    state, nothing = tracker.init(), np.zeros((480, 640), np.uint8)
    for frame in clip[:4]:
        state, hands = tracker.step(state, frame, faces, number, nothing)
    assert not hands.seen.any()
    whole = np.full((480, 640), 255, np.uint8)
    with_mask, _ = tracker.step(tracker.init(), clip[0], faces, number, whole)
    without, _ = tracker.step(tracker.init(), clip[0], faces, number)
    torch.testing.assert_close(with_mask.beliefs.cells, without.beliefs.cells)


def test_expected_hands_are_places_of_rebirth(prior, clip):
    tracker = HandTracker(prior, HandSettings(jump=0.3))
    faces, number = torch.tensor([(320.0, 120.0, 76.0)]), torch.tensor([0])
    state, _ = tracker.step(tracker.init(), clip[0], faces, number)
    place = torch.tensor([[[430.0, 200.0], [torch.nan, torch.nan]]])
    cov = 100 * torch.eye(2).expand(1, 2, 2, 2)
    with_hint, _ = tracker.step(state, clip[1], faces, number, expected=(place, cov))
    without, _ = tracker.step(state, clip[1], faces, number)
    assert torch.equal(with_hint.beliefs.cells[:, 1].argmax(), without.beliefs.cells[:, 1].argmax())
    at = cell_centres().double() * state.windows.anchors[0, 2] + state.windows.anchors[0, :2]
    near = (at - place[0, 0].double()).norm(dim=-1) < 20
    assert with_hint.beliefs.cells[0, 0][near].sum() > 2 * without.beliefs.cells[0, 0][near].sum()


def test_half_the_frame_rate(prior, clip):
    """Every second frame: hands are still found."""
    _, out = follow(HandTracker(prior, fps=15.0), clip[::2], [(320.0, 120.0, 76.0)])
    truth = np.stack([hands_at(t) for t in range(0, 30, 2)])
    error = np.linalg.norm(torch.cat([h.points for h in out]).numpy() - truth, axis=-1)[4:]
    assert np.median(error) < 12


def test_the_likelihood_prefers_the_end_of_a_bare_forearm():
    """Skin from the elbow at the top to the fingers: the cue is what lies beyond."""
    likelihood = HandLikelihood()
    skin, still = torch.zeros(1, 1, *CELLS), torch.zeros(1, 2, *CELLS)
    skin[..., 30:55, 46:49] = 1.0  # 2.5 B long, 0.3 B wide
    elbow = torch.zeros(1, 2, 2, *CELLS)
    elbow[:, :, 1] = 0.6  # above everything, in B from the anchor
    score = likelihood(likelihood.means(skin, still), likelihood.shape_places(elbow))[0, 0]
    row, column = divmod(int(score.argmax()), CELLS[1])
    assert abs(column - 47) <= 1 and 44 < row < 55
    plain = HandLikelihood(beyond=0.0, towards=0.0, beside=0.0)
    along = plain(plain.means(skin, still), plain.shape_places(elbow))[0, 0, 36:50, 47]
    assert along.max() - along.min() < 0.1 < score[52, 47] - score[40, 47]


def test_bad_input_is_refused(prior):
    tracker, frame = HandTracker(prior), np.zeros((48, 64, 3), np.uint8)
    face, number = torch.tensor([[30.0, 20.0, 10.0]]), torch.tensor([0])
    with pytest.raises(InputError, match="fps"):
        HandTracker(prior, fps=0.0)
    with pytest.raises(InputError, match="RGB"):
        tracker.step(tracker.init(), frame[..., 0], face, number)
    with pytest.raises(InputError, match="positive size"):
        tracker.step(tracker.init(), frame, -face, number)
    with pytest.raises(InputError, match="finite"):
        tracker.step(tracker.init(), frame, face * torch.nan, number)
    with pytest.raises(InputError, match="foreground"):
        tracker.step(tracker.init(), frame, face, number, frame[1:, :, 0])
    with pytest.raises(ShapeError):
        tracker.step(tracker.init(), frame, face[:, :2], number)


@pytest.mark.data
@pytest.mark.parametrize(("clip_name", "least"), [("help", 0.88), ("milk", 0.85)])
def test_the_hands_of_a_signer(prior, clip_name, least):
    """Within a quarter of the shoulder width of MediaPipe's; dark sleeves, and bare forearms."""
    folder = data_dir_or_skip("video_asl")
    with np.load(folder / f"{clip_name}_mediapipe_pose1.npz") as arrays:
        names = [str(n) for n in arrays["names"]]
        joints, visibility = arrays["joints2d"], arrays["visibility"]
    wrist, index = (
        [names.index(f"{s}_{j}") for s in ("left", "right")] for j in ("wrist", "index")
    )
    shoulders = [names.index(f"{s}_shoulder") for s in ("left", "right")]
    width = np.linalg.norm(joints[:, shoulders[0]] - joints[:, shoulders[1]], axis=-1).mean()
    truth = joints[:, wrist] + 0.7 * (joints[:, index] - joints[:, wrist])
    known = (visibility[:, wrist] >= 0.5) & (visibility[:, index] >= 0.5)
    known &= ((truth >= 0) & (truth < [640, 480])).all(-1)
    known[:15] = False
    tracker, video = HandTracker(prior), cv2.VideoCapture(str(folder / f"{clip_name}.mkv"))
    state, points = tracker.init(), []
    nose = joints[:, names.index("nose")]
    for t in range(len(joints)):
        frame = cv2.cvtColor(video.read()[1], cv2.COLOR_BGR2RGB)
        face = torch.tensor([[*nose[t], width / 1.95]], dtype=torch.float64)
        state, hands = tracker.step(state, frame, face, torch.tensor([0]))
        points.append(hands.points[0].numpy())
    error = np.linalg.norm(np.stack(points) - truth, axis=-1)[known]
    assert (error <= width / 4).mean() >= least


def test_hands_are_not_born_before_the_face(prior):
    image, faces = scene(0), torch.tensor([(320.0, 120.0, 76.0)])
    shares = []
    for cost in (0.0, 6.0):
        tracker = HandTracker(prior, HandSettings(face_rebirth=cost, jump=1.0, still=1.0))
        state, _ = tracker.step(tracker.init(), image, faces, torch.tensor([0]))
        anchor = state.windows.anchors[0]
        at = cell_centres().double() * anchor[2] + anchor[:2] - faces[0, :2]
        shares.append(float(state.beliefs.cells[0][:, at.norm(dim=-1) < 0.5 * 76].sum()))
    assert shares[1] < 0.02 * shares[0]
