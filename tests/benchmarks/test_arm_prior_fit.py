"""A prior over arms says what the recordings it was fitted to do."""

import math

import pytest
import torch

from benchmarks.bones.arm_prior_fit import arm_directions, fit_arm_prior
from torchpose.demo import performer
from torchpose.errors import InputError
from torchpose.io import Recording
from torchpose.math import euler_to_matrix
from torchpose.skeleton import UPPER_BODY
from torchpose.skeleton._torso import upright_axes
from torchpose.skeleton._upper_body import mirror_pose


def recording(joints, person):
    return Recording(joints=joints, names=UPPER_BODY, fps=30.0, person=person, source="made")


@pytest.fixture(scope="module")
def joints():
    return performer(200, seed=0).joints.double()


def test_directions_do_not_change_as_a_person_turns_moves_or_grows(joints):
    angles = torch.tensor([0.0, 0.0, 0.7], dtype=torch.float64)
    turned = 1.2 * joints @ euler_to_matrix(angles, "zxy").mT + torch.tensor([1.0, 0.2, 3.0])
    torch.testing.assert_close(arm_directions(turned), arm_directions(joints))


def test_the_right_arm_is_the_mirror_image_of_the_left_one(joints):
    mirrored = arm_directions(mirror_pose(joints))
    torch.testing.assert_close(mirrored.flip(1), arm_directions(joints))


def test_upright_axes_keep_the_vertical():
    across = torch.tensor([0.3, 0.1, -0.2], dtype=torch.float64)
    axes = upright_axes(torch.atan2(-across[2], across[0]))
    torch.testing.assert_close(axes @ axes.mT, torch.eye(3, dtype=torch.float64))
    turned = axes @ across
    assert turned[0] > 0 and abs(float(turned[2])) < 1e-12
    assert float(turned[1]) == pytest.approx(0.1)


def test_lengths_are_those_of_the_persons_and_poses_the_likelier(joints):
    people = [recording(joints * s, f"p{i}") for i, s in enumerate((0.9, 1.0, 1.1))]
    prior = fit_arm_prior([people], n_components=4, n_samples=3000)
    left = [joints[:, UPPER_BODY.index(f"{j}_left")] for j in ("shoulder", "elbow")]
    upper = float(torch.linalg.vector_norm(left[0] - left[1], dim=-1).median())
    assert float(prior.lengths[0]) == pytest.approx(upper, rel=0.03)
    assert 0.04 <= float(prior.spread[0]) < 0.12
    seen = prior.log_prob(arm_directions(joints).flatten(0, 1)).mean()
    assert float(seen) > -2 * math.log(4 * math.pi) + 1
    assert len(prior.info.persons) == 3
    again = fit_arm_prior([people], n_components=4, n_samples=3000)
    torch.testing.assert_close(again.directions.means, prior.directions.means, rtol=0, atol=0)


def test_necks_that_are_none_of_kinects_tell_no_height_of_heads(joints):
    neck, head = UPPER_BODY.index("neck"), UPPER_BODY.index("head")
    near = joints.clone()
    near[:, head] = near[:, neck].lerp(near[:, head], 0.45)  # as motion capture puts them
    own, other = [recording(joints, "a")], [recording(near, f"m{i}") for i in range(9)]
    few = {"n_components": 2, "n_samples": 500}
    prior = fit_arm_prior([own, other], shares=[0.1, 0.9], **few)
    alone = fit_arm_prior([own], **few)
    torch.testing.assert_close(prior.lengths[4], alone.lengths[4])
    torch.testing.assert_close(prior.spread[4], alone.spread[4])
    torch.testing.assert_close(prior.lengths[0], alone.lengths[0])


def test_persons_of_one_set_are_one_measurement_of_lengths(joints):
    few = {"n_components": 2, "n_samples": 500}
    one = fit_arm_prior([[recording(joints, "a")]], **few)
    many = fit_arm_prior([[recording(joints, f"p{i}") for i in range(9)]], **few)
    torch.testing.assert_close(one.spread, many.spread)


@pytest.mark.parametrize(("alike", "least", "most"), [(True, 0.3, 0.7), (False, 0.0, 0.05)])
def test_arms_that_go_together_are_known_to(alike, least, most):
    """Arms hang or reach out to the side: both the same, or each as it likes; in nats per frame."""
    generator = torch.Generator().manual_seed(0)
    out = torch.randint(2, (2, 400), generator=generator).bool()
    if alike:
        out[1] = out[0]
    poses = torch.zeros(400, len(UPPER_BODY), 3, dtype=torch.float64)
    for side, away, reach in (("left", 1.0, out[0]), ("right", -1.0, out[1])):
        bone = torch.where(
            reach[:, None], torch.tensor([away, 0.1, 0.0]), torch.tensor([0.0, 1, 0])
        )
        place = torch.tensor([0.17 * away, 0.0, 2.5], dtype=torch.float64).expand(400, 3)
        for joint in ("shoulder", "elbow", "hand"):
            poses[:, UPPER_BODY.index(f"{joint}_{side}")] = place
            place = place + 0.28 * bone
    prior = fit_arm_prior([[recording(poses, "p")]], n_components=2, n_samples=4000)
    together, weights = prior.together, prior.directions.weights
    torch.testing.assert_close(together.sum(1), weights, rtol=0, atol=1e-6)
    torch.testing.assert_close(together, together.mT)
    said = (together * (together / (weights[:, None] * weights)).log()).sum()
    assert least <= float(said) <= most


def test_one_arm_that_is_never_known_leaves_arms_apart(joints):
    joints = joints.clone()
    joints[:, UPPER_BODY.index("hand_right")] = torch.nan
    prior = fit_arm_prior([[recording(joints, "p")]], n_components=4, n_samples=1000)
    weights = prior.directions.weights
    torch.testing.assert_close(prior.together, weights[:, None] * weights)


def test_sets_without_arms_are_refused(joints):
    with pytest.raises(InputError, match="at least one recording"):
        fit_arm_prior([[]])
    with pytest.raises(InputError, match="no frame"):
        fit_arm_prior([[recording(torch.full_like(joints, torch.nan), "p")]])
