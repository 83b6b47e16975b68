"""More measured joints never make poses worse: on persons whom the prior over arms does not know."""

import functools
from itertools import accumulate, pairwise

import pytest
import torch

import torchpose
from benchmarks.bones.arm_prior_fit import fit_arm_prior
from tests.data import few_recordings
from torchpose.camera._projection import project
from torchpose.io import read_recordings
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body import UpperBodyTracker

CAMERA = torchpose.PinholeCamera(525.0, 525.0, 319.5, 239.5)
KNOWN, UNKNOWN = ("s01", "s02", "s03", "s04", "s05", "s06"), ("s07", "s08")
FRAMES = 30
DEPTHS = (
    1.7,
    2.5,
    3.6,
)  # metres: at the one that is usual, a joint more has nothing to tell about it
NECK = UPPER_BODY.index("neck")
PAIRS = [f"{joint}_{side}" for joint in ("hand", "elbow", "shoulder") for side in ("left", "right")]
HANDS, ELBOWS, SHOULDERS = PAIRS[:2], PAIRS[2:4], PAIRS[4:]
CHAINS = (
    (["neck", *HANDS], ["head"], SHOULDERS, ELBOWS),
    (["neck", *HANDS], ELBOWS, SHOULDERS, ["head"]),
    (["neck", *SHOULDERS], ELBOWS, HANDS),
)
TOLERANCE = 1.03  # the noise of nine sequences: 3 px of a joint more move the others a little


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """Return what a camera sees of two persons, their joints about the neck, and arms of six others."""
    folder = tmp_path_factory.mktemp("data")
    known = read_recordings(few_recordings("kinect_utd_mhad", folder / "known", 9, KNOWN))
    unknown = read_recordings(few_recordings("kinect_utd_mhad", folder / "unknown", 4, UNKNOWN))
    arms = fit_arm_prior([known], 16, n_samples=4000)
    joints = [r.upper_body().joints[:FRAMES].double() for r in unknown]
    joints = torch.stack([x for x in joints if len(x) >= FRAMES])
    turns = torch.eye(3, dtype=torch.float64).expand(*joints.shape[:2], 3, 3)
    place = torch.tensor([0.0, -0.2, 1.0], dtype=torch.float64).repeat(*joints.shape[:2], 1)
    place[..., 2] = torch.tensor(DEPTHS).repeat(len(joints))[: len(joints), None]
    joints = joints - joints[:, :, [NECK]]
    uv = project(joints, CAMERA.matrix.double(), turns, place)[..., :2]
    generator = torch.Generator().manual_seed(0)
    noise = 3 * torch.randn(uv.shape, generator=generator, dtype=uv.dtype)
    return uv + noise, joints, arms


@pytest.fixture(scope="module")
def mean_error(seen):
    """Return the mean error of all eight joints about the neck, metres; of each set of joints once."""
    return functools.cache(functools.partial(_mean_error, seen))


def _mean_error(seen, joined):
    uv, joints, arms = seen
    names = [name for name in UPPER_BODY if name in joined]
    prior = torchpose.load_prior("kinect-upper-body-small")
    tracker = UpperBodyTracker(prior, CAMERA, "articulated", fps=30.0, arms=arms)
    rows = [UPPER_BODY.index(name) for name in names]
    found = tracker(uv[:, :, rows], names=names).joints3d
    return float((found - found[:, :, [NECK]] - joints).norm(dim=-1).mean())


@pytest.mark.data
@pytest.mark.parametrize("chain", CHAINS, ids=lambda chain: "-".join(part[0] for part in chain))
def test_more_measured_joints_never_make_poses_worse(mean_error, chain):
    errors = [mean_error(frozenset(names)) for names in accumulate(chain)]
    for fewer, more in pairwise(errors):
        assert more <= TOLERANCE * fewer, errors
    assert errors[-1] < 0.95 * errors[0]
