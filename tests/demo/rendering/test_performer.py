"""Rendered frames: the face is found, parts are where the truth is, near ones hide far ones."""

from itertools import cycle, pairwise

import cv2
import numpy as np
import pytest
import torch

from benchmarks._performances import PERFORMANCES, crossing, performance
from tests.demo.rendering.frames import CAMERA, K, painted, posture, sampled
from torchpose.camera import PinholeCamera
from torchpose.demo import performer
from torchpose.demo._rendering import (
    LOOKS,
    Look,
    Scene,
    performance_truth,
    render_performance,
)
from torchpose.demo._rendering.look import FACE_BOX, load_portrait
from torchpose.demo._rendering.parts import FACE_FROM_HEAD
from torchpose.errors import CameraError, InputError, MissingDependencyError
from torchpose.measure import HaarFaceDetector
from torchpose.skeleton import UPPER_BODY

STILL = Scene(exposure=0)
PLAIN = Scene(clutter=False, noise=0, exposure=0)
HEAD = UPPER_BODY.index("head")


def pixel(point: torch.Tensor) -> np.ndarray:
    u, v, w = K @ point.numpy()
    return np.array([u / w, v / w])


@pytest.mark.slow
@pytest.mark.parametrize("distance", [1.3, 1.6, 2.0])
def test_the_face_is_found_where_it_is(distance):
    detector = HaarFaceDetector()
    clips = [
        sampled(performance(name, 600, seed=1, distance=distance), range(5, 600, 100))
        for name in PERFORMANCES
    ]
    found, sizes, places, extra = 0, [], [], 0
    for clip, look in zip(clips, cycle(LOOKS), strict=False):
        frames = render_performance(clip, CAMERA, scene=STILL, look=look)
        for image, joints in zip(frames, clip.joints, strict=True):
            boxes = detector(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)).numpy()
            expected = pixel(joints[HEAD] + torch.tensor(FACE_FROM_HEAD))
            size = FACE_BOX * 525 / float(joints[HEAD, 2])
            near = np.abs(boxes[:, :2] - expected).max(1) < 0.3 * size
            found, extra = found + bool(near.any()), extra + int((~near).sum())
            if near.any():
                sizes.append(boxes[near][0, 2] / size)
                places.append((boxes[near][0, :2] - expected) / size)
    assert found >= 0.95 * 6 * len(clips)
    assert extra <= 2
    assert np.abs(np.mean(places, 0)).max() < 0.08
    if distance < 2:  # farther away all sizes below the detector's smallest are missing
        assert 0.95 < np.mean(sizes) < 1.18


@pytest.mark.parametrize("side", ["left", "right"])
def test_hands_are_drawn_where_the_truth_is(side):
    clip = performer(600)
    joint = UPPER_BODY.index(f"hand_{side}")
    (truth,) = performance_truth(sampled(clip, range(0, 600, 20)), CAMERA)
    errors = []
    for i, frame in enumerate(range(0, 600, 20)):
        if truth.occluded[i, joint]:
            continue
        everything = painted(clip, frame)
        without = painted(clip, frame, lambda part: part.name != f"hand_{side}")
        changed = np.abs(everything - without).max(-1) > 8
        centre = np.argwhere(changed)[:, ::-1].mean(0)
        point = clip.joints[frame, joint]
        errors.append(np.linalg.norm(centre - pixel(point)) * float(point[2]) / 525)
        np.testing.assert_allclose(truth.joints2d[i, joint], pixel(point), atol=1e-9)
    assert len(errors) > 15
    assert np.median(errors) < 0.02  # metres
    assert np.max(errors) < 0.055  # partly hidden


def test_a_joint_is_visible_if_and_only_if_its_part_makes_a_difference():
    clip = performer(600)
    frames = [*range(0, 600, 40), *range(280, 340, 8)]
    (truth,) = performance_truth(sampled(clip, frames), CAMERA)
    own = {"hand": ("hand",), "elbow": ("upper_arm", "forearm"), "head": ("head",)}
    seen = {True: 0, False: 0}
    for i, frame in enumerate(frames):
        everything = painted(clip, frame)
        for j, name in enumerate(UPPER_BODY):
            kind, _, side = name.partition("_")
            if kind not in own:
                continue
            parts = {f"{part}_{side}".strip("_") for part in own[kind]}
            without = painted(clip, frame, lambda part, parts=parts: part.name not in parts)
            u, v = np.rint(pixel(clip.joints[frame, j])).astype(int)
            difference = np.abs(everything[v, u] - without[v, u]).max()
            if 1e-3 < difference < 20:
                continue  # on the edge of what is before it
            hidden = bool(truth.occluded[i, j])
            assert hidden == (difference < 1e-3), (frame, name)
            seen[hidden] += 1
    assert seen[True] >= 5 and seen[False] >= 60


def test_a_hand_before_the_face_hides_it():
    clip = performer(600)
    frame = clip.labels.index("face") + 30
    everything = painted(clip, frame)
    no_head = painted(clip, frame, lambda part: part.name != "head")
    no_hand = painted(clip, frame, lambda part: part.name != "hand_right")
    hand = np.abs(everything - no_hand).max(-1) > 8
    head = np.abs(everything - no_head).max(-1) > 8
    box = np.abs(no_hand - painted(clip, frame, lambda p: p.name not in ("hand_right", "head")))
    covered = (box.max(-1) > 8) & ~head
    assert (covered & hand).sum() > 60  # pixels of the face that show the hand
    (truth,) = performance_truth(sampled(clip, [0, frame]), CAMERA)
    assert not truth.occluded[:, UPPER_BODY.index("hand_right")].any()


def test_a_hand_behind_the_back_does_not_show():
    clip = posture({"abduction": 8, "flexion": -30, "twist": -85, "elbow": 75}, {})
    hand = UPPER_BODY.index("hand_left")
    assert clip.joints[0, hand, 2] > clip.joints[0, UPPER_BODY.index("neck"), 2] + 0.1
    without = painted(clip, 0, lambda part: part.name != "hand_left")
    np.testing.assert_allclose(painted(clip, 0), without, atol=1e-3)
    (truth,) = performance_truth(clip, CAMERA)
    assert truth.occluded[0, hand]
    assert not truth.occluded[0, UPPER_BODY.index("hand_right")]


def test_same_seed_same_frames():
    clip = performer(3)
    scene = Scene(flicker=0.02)
    once = np.stack(list(render_performance(clip, CAMERA, seed=4, scene=scene)))
    again = np.stack(list(render_performance(clip, CAMERA, seed=4, scene=scene)))
    other = np.stack(list(render_performance(clip, CAMERA, seed=5, scene=scene)))
    assert once.shape == (3, 480, 640, 3) and once.dtype == np.uint8
    np.testing.assert_array_equal(once, again)
    assert (once != other).mean() > 0.5


def test_an_open_shutter_blurs_what_moves_along_its_way():
    clip = performer(80)
    hand = clip.joints[:, UPPER_BODY.index("hand_right")]
    steps = [np.abs(pixel(b) - pixel(a)).max() for a, b in pairwise(hand[:79])]
    frame, step = int(np.argmax(steps)), max(steps)
    assert step > 8

    def moving(exposure: float) -> np.ndarray:
        scene = Scene(clutter=False, noise=0, exposure=exposure)
        _, image, _ = render_performance(
            sampled(clip, range(frame - 1, frame + 2)), CAMERA, scene=scene, look=_red_hands()
        )
        return image

    sharp, blurred = (hand_extent(moving(e), clip, frame) for e in (0.0, 1.0))
    assert blurred > sharp + 0.5 * step


def _red_hands() -> Look:
    return Look((250.0, 250.0, 250.0), (250.0, 250.0, 250.0))


def hand_extent(image: np.ndarray, clip, frame: int) -> float:
    """Width or height, the larger, of what is darker than wall and clothes about the hand."""
    u, v = np.rint(pixel(clip.joints[frame, UPPER_BODY.index("hand_right")])).astype(int)
    part = image[v - 60 : v + 60, u - 60 : u + 60].astype(int)
    skin = np.argwhere(part[..., 0] - part[..., 2] > 12)
    return float(np.ptp(skin, 0).max())


def test_two_people_cross_and_the_near_one_hides_the_far_one():
    near, far = crossing(270, seconds=9.0)
    frames = [2, 135]
    pair = (sampled(near, frames), sampled(far, frames))
    images = list(render_performance(pair, CAMERA, scene=STILL))
    truths = performance_truth(pair, CAMERA)
    detector = HaarFaceDetector(min_size=24)
    apart = detector(cv2.cvtColor(images[0], cv2.COLOR_RGB2GRAY)).numpy()
    for truth in truths:
        size = 60
        assert (np.abs(apart[:, :2] - truth.joints2d[0, HEAD].numpy()).max(1) < size / 2).any()
        assert not truth.occluded[0, HEAD]
    gap = (truths[0].joints2d[:, HEAD] - truths[1].joints2d[:, HEAD]).norm(dim=-1)
    assert gap[0] > 200 and gap[1] < 60  # they stand far apart, then one behind the other
    assert truths[1].occluded[1].sum() >= 3
    assert truths[0].occluded[1].sum() <= 1
    # The near one looks the same with and without the far one behind.
    alone = list(render_performance(pair[0], CAMERA, scene=PLAIN))[1]
    both = list(render_performance(pair, CAMERA, scene=PLAIN))[1]
    u, v = truths[0].joints2d[1, UPPER_BODY.index("neck")].round().int().tolist()
    np.testing.assert_array_equal(alone[v + 20 : v + 80, u - 20 : u + 20],
                                  both[v + 20 : v + 80, u - 20 : u + 20])  # fmt: skip


def test_without_matplotlib_the_message_says_what_to_install(monkeypatch):
    load_portrait.cache_clear()
    monkeypatch.setitem(__import__("sys").modules, "matplotlib", None)
    look = Look((1.0, 2.0, 3.0))
    with pytest.raises(MissingDependencyError, match="pip install matplotlib"):
        render_performance(performer(1), CAMERA, look=look)


def test_bad_input_is_named():
    clip = performer(2)
    with pytest.raises(CameraError, match="image size"):
        render_performance(clip, PinholeCamera(525, 525, 320, 240))
    with pytest.raises(InputError, match="same length"):
        render_performance([clip, performer(3)], CAMERA)
    with pytest.raises(InputError, match="same length"):
        render_performance([], CAMERA)
    with pytest.raises(InputError, match="dark sleeves, short sleeves"):
        render_performance(clip, CAMERA, look="toga")
    with pytest.raises(InputError, match="one for each of 1 performers"):
        render_performance(clip, CAMERA, look=["dark sleeves", "short sleeves"])
    with pytest.raises(InputError, match="from 0 to 255"):
        render_performance(clip, CAMERA, look=Look((300.0, 0.0, 0.0)))


@pytest.mark.parametrize("size", [(320, 240), (161, 121)])
def test_any_image_size(size):
    camera = PinholeCamera.from_image_size(*size)
    (image,) = render_performance(performer(1), camera)
    assert image.shape == (size[1], size[0], 3)


def test_somebody_outside_the_image_is_no_error():
    clip = performer(1)
    camera = PinholeCamera(525, 525, -2000, 240, 640, 480)
    (image,) = render_performance(clip, camera, scene=PLAIN)
    (wall,) = render_performance(performer(1, seed=3), camera, scene=PLAIN)
    np.testing.assert_array_equal(image, wall)
    (truth,) = performance_truth(clip, camera)
    assert truth.occluded.all()
