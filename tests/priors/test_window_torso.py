"""Windows that hold the arm in the axes of the torso: their states, mirrors, files and poses."""

import pytest
import torch

from tests.priors.mixtures import random_mixture
from tests.priors.poses import recording
from torchpose.camera import lift
from torchpose.demo import KEYPOINT_NAMES, demo_camera, noisy_keypoints, performer
from torchpose.learning._recipes import UpperBodyRecipe
from torchpose.learning._samplers import all_samples
from torchpose.math import euler_to_matrix
from torchpose.metrics import joint_errors_3d
from torchpose.priors import UpperBodyPrior
from torchpose.priors._window import WindowLayout, WindowPrior
from torchpose.skeleton._torso import in_torso_axes
from torchpose.upper_body import UpperBodyTracker
from torchpose.upper_body._measured_joints import in_prior_pixels
from torchpose.upper_body._picked import pick_joints

NAMES = list(KEYPOINT_NAMES)
LAYOUT = WindowLayout((2, 5), (0,), torso=True)
RECIPE = UpperBodyRecipe(
    n_components=4, n_samples=4000, pose_steps=10, window_components=8, window_samples=4000,
    window_steps=10, causal=LAYOUT, full=LAYOUT, calibration_folds=0,
)  # fmt: skip


@pytest.fixture(scope="module")
def recordings():
    return [recording(performer(300, seed=s).body, person=f"p{s}", fps=30.0) for s in (1, 2)]


@pytest.fixture(scope="module")
def prior(recordings):
    return RECIPE.fit(recordings)


def test_the_dimensions_of_a_state_are_told_apart():
    assert LAYOUT.dim == 21 + 2 * 3 + 15 and LAYOUT.n_hands == 3
    assert list(LAYOUT.hands) == list(range(21, 27)) and list(LAYOUT.in_torso) == list(
        range(27, 42)
    )
    assert LAYOUT.at_rate(60.0) == WindowLayout((4, 10), (0,), 60.0, torso=True)
    plain = WindowLayout((2, 5), (0,))
    assert plain.dim == 27 and list(plain.in_torso) == [] and plain.deciding == list(range(27))


def test_a_state_holds_the_arm_of_its_pose_on_the_torso(recordings):
    task = RECIPE.tasks(recordings)["causal.left"]
    assert task.source.dim == len(LAYOUT.deciding) == 6 + 6 + 15
    both = [
        all_samples(RECIPE.tasks(recordings)[f"causal.{side}"].source.source).states[:50]
        for side in ("left", "right")
    ]
    arms = []
    for states in both:
        rotation = euler_to_matrix(states[:, 15:18], "zxy")
        joints = states[:, :15].unflatten(1, (5, 3))
        arms.append(lift(joints, RECIPE.matrix, rotation, states[:, 18:21]))
    body = torch.cat([arms[0], arms[1][:, :3].flip(1)], 1)
    expected = in_torso_axes(body)
    torch.testing.assert_close(both[0][:, 27:].unflatten(1, (5, 3)), expected[:, :5])
    torch.testing.assert_close(both[1][:, 27:].unflatten(1, (5, 3)), expected[:, [7, 6, 5, 3, 4]])


def test_mirrored_twice_they_are_what_they_were_and_files_keep_them(prior, tmp_path):
    left, right = (random_mixture(2, LAYOUT.dim, seed) for seed in (0, 1))
    window = WindowPrior(left, right, LAYOUT, {"hand_std": 3.0})
    mirrored = window.mirrored(320.0)
    assert mirrored.left.means[0, 27] == -right.means[0, 27]
    torch.testing.assert_close(mirrored.mirrored(320.0).left.means, left.means)
    torch.testing.assert_close(mirrored.mirrored(320.0).left.covariances, left.covariances)
    prior.save(tmp_path / "prior.safetensors")
    loaded = UpperBodyPrior.load(tmp_path / "prior.safetensors").windows["causal"]
    assert loaded.layout == LAYOUT
    del (facts := loaded.facts())["torso"]  # files from before torsos were known
    plain = random_mixture(2, 27)
    assert not WindowPrior.from_facts(plain, plain, facts).layout.torso


def test_the_pose_is_read_from_the_torso(prior):
    truth = performer(90, seed=0).joints
    keypoints = noisy_keypoints(truth, std_px=3.0)[None]
    tracker = UpperBodyTracker(prior, demo_camera(), steady=False)
    track = tracker(keypoints, names=NAMES)
    picked = pick_joints(len(NAMES), NAMES, None, prior.info.neck, prior.info.hand)
    measured = in_prior_pixels(
        keypoints.double(), None, None, None, picked, prior, demo_camera(), tracker.measurement_cov
    )
    joints = {side: ("hand", "head", "neck") for side in ("left", "right")}
    estimates = tracker.estimator.forward(measured, joints, dict.fromkeys(joints))
    poses = [out.mean[..., 21:].unflatten(-1, (5, 3)) for out in (estimates.left, estimates.right)]
    expected = torch.cat([poses[0][:, :, :3], poses[1][:, :, :3].flip(2)], 2)
    found = in_torso_axes(track.joints3d)[:, :, [0, 1, 2, 5, 6, 7]]
    assert float((found - expected).norm(dim=-1).max()) < 0.05  # two torsos, of about one shape
    assert float(joint_errors_3d(track.joints3d[0], truth).mean()) < 0.15
    assert (torch.linalg.eigvalsh(track.covariance3d) > 0).all()
