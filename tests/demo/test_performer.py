"""The animated performer: bones, anatomy, speeds, keypoints."""

import math

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from torchpose import demo
from torchpose.demo._mannequin import ANGLE_LIMITS, BodyAngles, BodySize, angles_to_joints
from torchpose.demo._performer import minimum_jerk
from torchpose.errors import InputError
from torchpose.skeleton import UPPER_BODY
from torchpose.skeleton._upper_body import LIMBS, measure_neck_kind

SEEDS = (0, 1, 2)


def bone_lengths(joints: torch.Tensor) -> torch.Tensor:
    a, b = torch.tensor(LIMBS).unbind(-1)
    return (joints[:, a] - joints[:, b]).norm(dim=-1)


def arms(**angles: float) -> BodyAngles:
    """Both arms in one posture, the rest of the body upright; degrees."""
    four = [math.radians(angles.get(name, 0.0)) for name in ANGLE_LIMITS]
    zero = torch.zeros(1, 3, dtype=torch.float64)
    return BodyAngles(zero, zero, zero, torch.tensor([[four, four]], dtype=torch.float64))


@pytest.mark.parametrize("seed", SEEDS)
def test_bones_keep_their_length(seed: int) -> None:
    lengths = bone_lengths(demo.performer(seed=seed).joints)
    size = BodySize()
    shoulder = math.hypot(size.half_shoulders, size.neck_above_shoulders)
    arm = [size.forearm + size.hand, size.upper_arm, shoulder]
    expected = torch.tensor([*arm, math.hypot(size.head, 0.03), *arm[::-1]], dtype=torch.float64)
    torch.testing.assert_close(lengths, expected.expand_as(lengths), rtol=0, atol=1e-9)


def test_postures_that_can_be_checked_by_eye() -> None:
    size = BodySize()
    reach = size.forearm + size.hand
    hand, elbow, shoulder = (UPPER_BODY.index(f"{n}_left") for n in ("hand", "elbow", "shoulder"))

    def vectors(**angles: float) -> tuple[torch.Tensor, torch.Tensor]:
        joints = angles_to_joints(arms(**angles))[0][0]
        return joints[elbow] - joints[shoulder], joints[hand] - joints[elbow]

    def close(vector: torch.Tensor, expected: list[float]) -> None:
        torch.testing.assert_close(vector, torch.tensor(expected, dtype=torch.float64))

    upper, fore = vectors()  # hanging: both straight down
    close(upper, [0, size.upper_arm, 0])
    close(fore, [0, reach, 0])
    close(vectors(elbow=90)[1], [0, 0, -reach])  # folds forward, to the camera
    close(vectors(abduction=90)[0], [size.upper_arm, 0, 0])  # the left arm to the left
    close(vectors(flexion=90)[0], [0, 0, -size.upper_arm])  # forward
    close(vectors(flexion=90, elbow=90)[1], [0, -reach, 0])  # folds up
    close(vectors(elbow=90, twist=90)[1], [reach, 0, 0])  # outwards
    close(vectors(abduction=90, elbow=90, twist=90)[1], [0, -reach, 0])  # the waving arm


def test_the_right_arm_mirrors_the_left() -> None:
    joints, wrists = angles_to_joints(arms(abduction=40, flexion=30, twist=-20, elbow=70))
    mirror = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(joints[:, [7, 6, 5]], joints[:, [0, 1, 2]] * mirror)
    torch.testing.assert_close(wrists[:, 1], wrists[:, 0] * mirror)


def test_arm_chain_agrees_with_scipy_rotations() -> None:
    degrees = {"abduction": 50.0, "flexion": 35.0, "twist": 40.0, "elbow": 80.0}
    joints = angles_to_joints(arms(**degrees))[0][0].numpy()
    a, f, t, e = (math.radians(degrees[n]) for n in ANGLE_LIMITS)
    upper = Rotation.from_rotvec([-f, 0, -a]) * Rotation.from_rotvec([0, -t, 0])
    fore = upper * Rotation.from_rotvec([-e, 0, 0])
    np.testing.assert_allclose(joints[1] - joints[2], upper.apply([0, 0.28, 0]), atol=1e-12)
    np.testing.assert_allclose(joints[0] - joints[1], fore.apply([0, 0.305, 0]), atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_movement_is_humanly_possible(seed: int) -> None:
    performance = demo.performer(seed=seed)
    joints = performance.joints
    speed = joints.diff(dim=0).norm(dim=-1) * performance.fps
    bound = {"hand": 4.5, "elbow": 2.5, "shoulder": 0.6, "head": 0.5, "neck": 0.4}
    for i, name in enumerate(UPPER_BODY):
        assert speed[:, i].max() < bound[name.split("_")[0]], name
    acceleration = joints.diff(n=2, dim=0).norm(dim=-1) * performance.fps**2
    assert acceleration.max() < 40  # m/s^2; fast reaching reaches that
    assert speed[:, [0, 7]].max() > 1.5  # and it does move
    low, high = torch.deg2rad(torch.tensor(list(ANGLE_LIMITS.values()))).double().unbind(-1)
    angles = performance.angles
    assert ((angles.arms >= low) & (angles.arms <= high)).all()
    assert angles.torso.abs().max() < math.radians(20)
    assert angles.head.abs().max() < math.radians(40)
    assert 0.002 < angles.position.abs().max() < 0.05


@pytest.mark.parametrize("seed", SEEDS)
def test_nothing_passes_through_the_body(seed: int) -> None:
    joints = demo.performer(seed=seed).joints
    hands, head = joints[:, [0, 7]], joints[:, 3:4]
    assert (hands - head).norm(dim=-1).min() > 0.10
    assert (joints[:, 0] - joints[:, 7]).norm(dim=-1).min() > 0.06
    s = torch.linspace(0, 1, 20, dtype=torch.float64)[:, None]
    left = joints[:, 1:2] + s * (joints[:, 0:1] - joints[:, 1:2])
    right = joints[:, 6:7] + s * (joints[:, 7:8] - joints[:, 6:7])
    assert torch.cdist(left, right).min() > 0.05  # forearms, also when crossed


def test_every_part_of_the_performance_is_there() -> None:
    performance = demo.performer()
    joints, labels = performance.joints, np.array(performance.labels)
    assert set(labels) == {"rest", "wave", "reach", "cross", "face"}
    neck, hands = joints[:, 4:5], joints[:, [0, 7]]
    relative = hands - neck
    raised = (relative[..., 1] < -0.05).any(-1).numpy()
    assert raised[labels == "wave"].mean() > 0.5
    assert (relative.norm(dim=-1) > 0.6).any(-1).numpy()[labels == "reach"].mean() > 0.4
    crossed = (relative[:, 0, 0] < relative[:, 1, 0]).numpy()  # the left hand is on the right
    assert crossed[labels == "cross"].mean() > 0.5
    assert not crossed[labels == "rest"][:30].any()
    at_face = ((hands - joints[:, 3:4]).norm(dim=-1) < 0.18).any(-1).numpy()
    assert at_face[labels == "face"].mean() > 0.4
    assert not at_face[labels == "rest"][:30].any()


def test_body_fits_kinect_conventions_and_the_image() -> None:
    performance = demo.performer(n_frames=600)
    joints = performance.joints
    assert performance.names == UPPER_BODY
    assert measure_neck_kind(joints) == "neck"
    rest = joints[0]
    above = (rest[[2, 5]].mean(0) - rest[4]).norm()
    assert above.item() == pytest.approx(0.106, abs=0.01)
    assert rest[0, 0] > rest[7, 0]  # the person's left is at larger x
    assert joints[:, 4, 2].mean().item() == pytest.approx(2.0, abs=0.05)
    pixels = demo.noisy_keypoints(joints, std_px=0, gap=None)
    assert (pixels > 0).all() and (pixels < torch.tensor([640.0, 480.0])).all()
    moved = performance.body @ performance.rotation.mT + performance.translation
    torch.testing.assert_close(moved, joints)
    wrist = (performance.wrists[:, 1] - joints[:, 7]).norm(dim=-1)
    torch.testing.assert_close(wrist, torch.full_like(wrist, 0.065))


def test_same_seed_same_movement_and_it_starts_over_smoothly() -> None:
    once, again, other = demo.performer(60), demo.performer(60), demo.performer(60, seed=1)
    assert torch.equal(once.joints, again.joints)
    assert not torch.equal(once.joints, other.joints)
    assert torch.equal(demo.performer(90).joints[:60], once.joints)
    lap = demo.performer(660).joints[590:610]
    assert lap.diff(dim=0).norm(dim=-1).max() * 30 < 0.5
    fast = demo.performer(120, fps=60.0).joints[::2]
    torch.testing.assert_close(fast, once.joints)


def test_minimum_jerk_is_the_quintic_with_rest_at_both_ends() -> None:
    keys, values = torch.tensor([0.0, 2.0]).double(), torch.tensor([[1.0], [4.0]]).double()
    times = torch.linspace(0, 2, 2001, dtype=torch.float64)
    x = minimum_jerk(times, keys, values)[:, 0]
    spline = CubicSpline(times.numpy(), x.numpy())
    assert x[0] == 1 and x[-1] == 4 and x[1000] == pytest.approx(2.5)
    for order in (1, 2):
        np.testing.assert_allclose(spline([0, 2], order), 0, atol=2e-3)
    assert spline(1.0, 1) == pytest.approx(1.875 * 3 / 2, rel=1e-6)  # known peak speed
    outside = minimum_jerk(torch.tensor([-1.0, 9.0]).double(), keys, values)
    assert outside[:, 0].tolist() == [1, 4]


def test_keypoints_have_the_noise_and_the_gap_that_were_asked_for() -> None:
    joints = demo.performer().joints
    clean = demo.noisy_keypoints(joints, std_px=0, gap=None)
    noisy = demo.noisy_keypoints(joints, std_px=3.0, seed=4, gap=("hand_left", 7.0, 1.0))
    assert noisy.shape == (600, 4, 2)
    hand = demo.KEYPOINT_NAMES.index("hand_left")
    assert noisy.isnan().any(-1).nonzero()[:, 0].tolist() == list(range(210, 240))
    assert noisy[210:240, hand].isnan().all()
    noise = (noisy - clean)[torch.isfinite(noisy)]
    assert noise.std().item() == pytest.approx(3.0, rel=0.05)
    assert abs(noise.mean().item()) < 4 * 3.0 / math.sqrt(noise.numel())
    expected = 525 * joints[:, 3, 0] / joints[:, 3, 2] + 319.5
    torch.testing.assert_close(clean[:, 0, 0], expected)


def test_bad_input_is_named() -> None:
    with pytest.raises(InputError, match=r"gap must be \(one of head, neck"):
        demo.noisy_keypoints(demo.performer(5).joints, gap=("foot", 0.0, 1.0))
    with pytest.raises(InputError, match="n_frames >= 1"):
        demo.performer(0)
    with pytest.raises(InputError, match=r"BodySize\.forearm"):
        BodySize(forearm=-0.2)


@pytest.mark.parametrize(
    ("seconds", "word"), [(8.7, "reach"), (9.4, "cross"), (11.5, "cross"), (11.8, "rest")]
)
def test_frames_have_the_word_of_the_nearest_key_frame(seconds: float, word: str) -> None:
    performance = demo.performer(fps=30.0)
    assert performance.labels[round(30 * seconds)] == word
