"""Fits against states that made the joints, SciPy's least squares, and recorded mocap."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from tests.body.test_kinematics import random_centres, random_states, some_body
from tests.data import data_dir_or_skip
from torchpose.body import BODY_15, Body, body_joints, fit_body, fit_state
from torchpose.body._fitting import fit_errors
from torchpose.errors import InputError, ShapeError


def someone(frame="parent", centres=None, lever=0.1):
    """A body whose pelvis joint lies `lever` metres above the line of the hips."""
    plain = Body.of_height(BODY_15, 1.7)
    offsets = plain.offsets.clone()
    for side in ("left", "right"):
        offsets[BODY_15.joint(f"{side}_hip"), 1] -= lever
    return Body(
        BODY_15, offsets.norm(dim=-1), plain.radii, directions=offsets, frame=frame, centres=centres
    )


@pytest.mark.parametrize("frame", ["parent", "body"])
@pytest.mark.parametrize("centred", [False, True])
def test_joints_of_a_body_are_met_exactly(frame, centred):
    body = someone(frame, random_centres() if centred else None)
    joints = body.joints(random_states(body, 60, scale=0.3))
    found = fit_state(body, joints)
    assert float(fit_errors(body, found, joints).max()) < 1e-4


@pytest.mark.parametrize("centred", [False, True])
def test_states_without_twist_come_back(centred):
    body = someone(centres=random_centres() if centred else None)
    states = random_states(body, 40, scale=0.2)
    states[:, 3 * 3 : 12] = states[:, 9:12]
    for part in range(2, 11):  # single bones: an axis across the bone's rest direction
        joint = BODY_15.part_of.index(part)
        rest = torch.nn.functional.normalize(body.offsets[joint], dim=-1)
        vector = states[:, 3 + 3 * part : 6 + 3 * part]
        vector -= (vector @ rest)[:, None] * rest
    found = fit_state(body, body.joints(states), steps=8)
    torch.testing.assert_close(found, states, rtol=0, atol=1e-6)


def test_the_swing_of_single_bones_has_no_twist():
    body = someone(centres=random_centres())
    found = fit_state(body, body.joints(random_states(body, 20)))
    for part in range(2, 11):
        joint = BODY_15.part_of.index(part)
        twist = found[:, 3 + 3 * part : 6 + 3 * part] @ body.offsets[joint]
        assert float(twist.abs().max()) < 1e-8


@pytest.mark.parametrize(("lever", "largest", "error"), [(0.0, 1e-4, 0.01), (0.02, 0.1, 25.0)])
def test_pelvis_near_the_line_of_the_hips_tilts_with_the_torso(lever, largest, error):
    body = someone(lever=lever)
    states = random_states(body, 30, scale=0.2)
    found = fit_state(body, body.joints(states))
    pelvis, torso = body.part_rotations(found)[:, :2].unbind(1)
    spine = torch.nn.functional.normalize(body.offsets[1], dim=-1)
    tilt = (pelvis[:, :, 2] * (torso @ spine)).sum(-1)  # how far the spine leans along its z
    assert float(tilt.abs().max()) < largest
    assert float(fit_errors(body, found, body.joints(states)).max()) < error


def test_gauss_newton_finds_the_least_squares():
    body = someone()
    generator = torch.Generator().manual_seed(4)
    joints = body.joints(random_states(body, 3, scale=0.2))
    noise = 0.03 * torch.randn(joints.shape, generator=generator, dtype=torch.float64)
    noise[:, [j for j, part in enumerate(BODY_15.part_of) if part == 0]] = 0  # hips tell the tilt
    joints = joints + noise
    closed, found = fit_state(body, joints, steps=0), fit_state(body, joints, steps=20)
    squared = [fit_errors(body, x, joints).square().sum(-1) for x in (closed, found)]
    assert bool((squared[1] < squared[0]).all())
    for t in range(3):

        def residual(x, t=t):
            return (1000 * (body.joints(torch.tensor(x)) - joints[t])).flatten().numpy()

        best = least_squares(residual, closed[t].numpy())
        assert float(squared[1][t]) == pytest.approx(2 * best.cost, rel=2e-2)
        assert float(squared[1][t]) > 2 * best.cost * (1 - 1e-6)


def test_body_of_recorded_joints():
    body = someone()
    joints = body.joints(random_states(body, 300, scale=0.15))
    found = fit_body(joints)
    torch.testing.assert_close(found.bone_lengths, body.bone_lengths, rtol=0, atol=2e-4)
    assert found.height == pytest.approx(1.7)
    assert torch.equal(found.radii, BODY_15.standard_radii(found.height))
    assert float(fit_errors(found, fit_state(found, joints), joints).max()) < 0.5
    radii = 1.1 * body.radii
    assert torch.equal(fit_body(joints, radii).radii, radii)
    other = fit_body(joints, centres=random_centres(), frame="body")
    assert other.frame == "body" and torch.equal(other.centres, random_centres())


def test_joints_that_a_set_lacks_leave_their_part_at_rest():
    body = someone()
    joints = body.joints(random_states(body, 20, scale=0.2))
    joints[:, BODY_15.joint("head")] = torch.nan
    joints[:, BODY_15.joint("left_elbow")] = torch.nan
    found = fit_state(body, joints)
    for name in ("head", "left_upper_arm", "left_forearm"):
        part = BODY_15.part(name)
        assert float(found[:, 3 + 3 * part : 6 + 3 * part].abs().max()) < 1e-7
    errors = fit_errors(body, found, joints)
    known = [j for j, n in enumerate(BODY_15.names) if "left_" not in n and n != "head"]
    assert float(errors[:, known].max()) < 1e-4 and bool(torch.isnan(errors[:, 2]).all())
    built = fit_body(joints)
    expected = BODY_15.standard_lengths(built.height)
    assert float(built.bone_lengths[2]) == pytest.approx(float(expected[2]))


def test_tips_on_the_neck_follow_the_shoulders():
    body = Body.of_height(BODY_15, 1.7)
    joints = body.joints(random_states(body, 50, scale=0.1))
    neck = BODY_15.joint("neck")
    torso = body.part_rotations(fit_state(body, joints))[:, 1]
    higher = joints.clone()
    higher[:, neck] += 0.06 * torso[:, :, 1]
    crown = [tip.name for tip in BODY_15.tips].index("crown")
    tips = fit_body(joints).tips[crown] - fit_body(higher).tips[crown]
    assert tips.tolist() == pytest.approx([0.0, 0.06, 0.0], abs=5e-3)


@pytest.mark.parametrize("head_top", [0.0, 0.12])
def test_the_top_of_the_head_lies_where_it_is_said(head_top):
    body = Body.of_height(BODY_15, 1.7)
    found = fit_body(body.joints(random_states(body, 50, scale=0.05)), head_top=head_top)
    rest = torch.zeros(36, dtype=torch.float64)
    limbs, head = found.limbs(rest), found.joints(rest)[BODY_15.joint("head")]
    top = float(limbs.end[0, 1] + limbs.radii[0, 1])
    assert top == pytest.approx(float(head[1]) + head_top, abs=1e-9)
    with pytest.raises(InputError, match="head_top must be finite"):
        fit_body(body.joints(rest[None]), head_top=float("nan"))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_any_dtype(dtype):
    body = some_body(dtype=dtype)
    joints = body.joints(random_states(body, 5, scale=0.2))
    found = fit_state(body, joints)
    assert found.dtype == dtype and float(fit_errors(body, found, joints).max()) < 0.1
    assert fit_body(joints).offsets.dtype == torch.float64


def test_gaps_and_other_bad_input_are_named():
    body = someone()
    joints = body.joints(random_states(body, 9))
    gap = joints.clone()
    gap[3, BODY_15.joint("left_wrist"), 1] = torch.nan
    for fit in (lambda: fit_state(body, gap), lambda: fit_body(gap)):
        with pytest.raises(InputError, match="'left_wrist' is missing in frame 3"):
            fit()
    gap[:, BODY_15.joint("left_hip")] = torch.nan
    gap[:, BODY_15.joint("left_wrist")] = 0.0
    with pytest.raises(InputError, match="missing are left_hip"):
        fit_state(body, gap)
    same = joints.clone()
    same[:, BODY_15.joint("left_knee")] = same[:, BODY_15.joint("left_hip")]
    with pytest.raises(InputError, match="bone to 'left_knee' has 0"):
        fit_body(same)
    with pytest.raises(InputError, match="at least one frame"):
        fit_body(joints[:0])
    with pytest.raises(InputError, match="steps"):
        fit_state(body, joints, steps=-1)
    with pytest.raises(ShapeError, match="joints must have shape"):
        fit_state(body, joints[:, :14])
    for fit in (lambda: fit_state(body, joints.numpy()), lambda: fit_body(joints.numpy())):
        with pytest.raises(InputError, match="joints must be a tensor, got ndarray"):
            fit()


@pytest.mark.data
@pytest.mark.parametrize(
    ("folder", "pattern", "limit"),
    [  # mean over joints and frames, mm
        ("mocap_cmu_walk", "s07_07_01*.npz", 2.0),
        ("mocap_cmu_actions", "running_train_1.npz", 5.0),
        ("mocap_berkeley_mhad", "s03_a02*_r1.npz", 18.0),
        ("multicam_pose2sim", "balancing*.npz", 14.0),
    ],
)
def test_error_left_on_recordings(folder, pattern, limit):
    path = next(iter(sorted(Path(data_dir_or_skip(folder)).glob(pattern))))
    with np.load(path) as file:
        names = [str(n) for n in file["names"]]
        joints = body_joints(torch.tensor(file["joints"][:400], dtype=torch.float64), names)
    body = fit_body(joints)
    errors = fit_errors(body, fit_state(body, joints), joints)
    assert float(errors.nanmean()) < limit
    assert 1.4 < body.height < 2.0


@pytest.mark.parametrize("unit", [1000.0, 100.0, 3.28])
def test_joints_in_other_units_are_refused(unit):
    body = Body.of_height(BODY_15, 1.7)
    joints = unit * body.joints(torch.zeros(3, body.dim, dtype=torch.float64))
    with pytest.raises(InputError, match=r"joints must be in metres, as the body is, got bones of"):
        fit_state(body, joints)
    with pytest.raises(InputError, match="the height of the body of these joints must lie between"):
        fit_body(joints)
