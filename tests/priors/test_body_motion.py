"""The prior over the motion of bodies: its file, what it refuses, and how poses pull."""

from dataclasses import replace

import pytest
import torch

from tests.priors.mixtures import random_mixture
from tests.priors.motions import some_body_motion
from torchpose._core.tensor_file import write_tensors
from torchpose.errors import (
    CovarianceError,
    FileFormatError,
    InputError,
    PriorError,
    ShapeError,
)
from torchpose.priors import GaussianMixture
from torchpose.priors._body_motion import _KIND, BodyMotion, BodyMotionInfo
from torchpose.priors._shipped import load_body_motion


def test_a_file_brings_it_back(tmp_path):
    info = BodyMotionInfo("mine", ("a#1",), ("walk",), ("a",), "CC0", "made", 30.0, 7, {"x": 1})
    one = some_body_motion(info=info)
    path = tmp_path / "body.safetensors"
    one.save(path)
    for two in (BodyMotion.load(path), load_body_motion(path)):
        assert two.info == info
        for name, value in one.state_dict().items():
            torch.testing.assert_close(two.state_dict()[name], value, rtol=1e-6, atol=1e-9)
    whole = path.read_bytes()
    path.write_bytes(whole[:200])
    with pytest.raises(FileFormatError, match="body-motion"):
        BodyMotion.load(path)
    path.write_bytes(whole.replace(b"torchpose-body-motion", b"torchpose-body-notion"))
    with pytest.raises(FileFormatError, match="body-motion"):
        BodyMotion.load(path)


def test_older_files_have_no_correlation_and_no_drift(tmp_path):
    motion, path = some_body_motion(), tmp_path / "old.safetensors"
    lacking = ("correlation", "drift")
    given = {
        n: getattr(motion, n) for n in _KIND.tensors if n not in lacking and hasattr(motion, n)
    }
    given |= {n: getattr(motion.poses, n) for n in ("weights", "means", "covariances")}
    write_tensors(path, replace(_KIND, version=1), motion.info, given)
    assert bool((BodyMotion.load(path).correlation == torch.eye(27).double()).all())
    given["correlation"] = torch.eye(27).double()
    write_tensors(path, replace(_KIND, version=2), motion.info, given)
    assert not BodyMotion.load(path).drift.any()
    del given["correlation"]
    write_tensors(path, _KIND, motion.info, given)
    with pytest.raises(FileFormatError, match=r"expected the tensors .*correlation"):
        BodyMotion.load(path)


def test_damage_to_the_mixture_names_the_file(tmp_path):
    motion, path = some_body_motion(), tmp_path / "body.safetensors"
    motion.poses.weights.mul_(3.0)
    motion.save(path)
    with pytest.raises(InputError, match=r"body\.safetensors: weights must sum to 1"):
        BodyMotion.load(path)


def test_the_shipped_one_is_of_the_body_that_is_tracked():
    motion = load_body_motion("whole-body")
    assert motion.articulation.n_pose == len(motion.acceleration)
    assert bool((motion.shift_std[1:3] == motion.shift_std[3:5]).all())


@pytest.mark.parametrize(
    ("changed", "error", "said"),
    [
        ({"decay": torch.zeros(27).double()}, PriorError, "decay must be positive"),
        ({"acceleration": torch.ones(3).double()}, ShapeError, "acceleration"),
        ({"correlation": torch.eye(3).double()}, ShapeError, "correlation"),
        ({"drift": torch.zeros(27, 48).double()}, ShapeError, "drift"),
        ({"shift_time": torch.ones(3).double()}, ShapeError, "shift_time"),
        ({"correlation": -torch.eye(27).double()}, CovarianceError, "correlation"),
        ({"shift_std": torch.ones(9).double()}, ShapeError, "shift_std"),
        ({"scale_cov": torch.eye(2).double()}, ShapeError, "scale_cov"),
        ({"poses": random_mixture(2, 5)}, ShapeError, "means"),
    ],
)
def test_what_does_not_fit_is_refused(changed, error, said):
    with pytest.raises(error, match=said):
        some_body_motion(**changed)


def test_a_single_gaussian_pulls_by_its_information():
    g = torch.Generator().manual_seed(0)
    poses = random_mixture(1, 21)
    motion = some_body_motion(poses=GaussianMixture(*poses.parameters_tuple()))
    angles = torch.randn(5, 21, generator=g, dtype=torch.float64)
    pull = motion.pull(angles, 0.1 * torch.eye(21).double().expand(5, 21, 21))
    information = torch.linalg.inv(poses.covariances[0])
    torch.testing.assert_close(pull.curvature, information.expand(5, 21, 21))
    torch.testing.assert_close(pull.slope, (poses.means - angles) @ information)
