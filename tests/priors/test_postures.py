"""Relative angles of limbs: against explicit geometry, invariances, and the way back to states."""

import math

import pytest
import torch

from torchpose.body import BODY_15, Body, BodySkeleton
from torchpose.errors import InputError, ShapeError, SkeletonError
from torchpose.math._rotations import rotvec_to_matrix
from torchpose.priors._actions.polar_limbs import LIMBS_12, check_limbs
from torchpose.priors._actions.postures import (
    normalise_postures,
    posture_angles,
    posture_directions,
    posture_root,
    posture_to_state,
    state_postures,
)


def angle(postures, limb):
    first = 3 * [one.name for one in LIMBS_12].index(limb)
    return postures[..., first : first + 3]


def random_states(body, count=200, seed=0, size=0.6):
    generator = torch.Generator().manual_seed(seed)
    state = torch.zeros(count, body.dim, dtype=torch.float64)
    turns = torch.randn(count, body.dim - 3, generator=generator, dtype=torch.float64)
    turns = turns.unflatten(-1, (-1, 3))
    state[:, :3] = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    share = size * torch.rand(count, len(body.skeleton.parts), 1, generator=generator).double()
    state[:, 3:] = (share * turns / turns.norm(dim=-1, keepdim=True)).flatten(-2)
    return state


def joints_of(**places):
    """A figure of straight lines that stands and looks along z."""
    base = {
        "pelvis": (0, 1, 0), "neck": (0, 1.5, 0), "head": (0, 1.7, 0),
        "left_shoulder": (0.2, 1.5, 0), "left_elbow": (0.2, 1.2, 0), "left_wrist": (0.2, 0.95, 0),
        "left_hip": (0.1, 1, 0), "left_knee": (0.1, 0.55, 0), "left_ankle": (0.1, 0.1, 0),
    }  # fmt: skip
    mirrored = {k.replace("left", "right"): (-v[0], *v[1:]) for k, v in base.items()}
    points = {**mirrored, **base, **places}
    return torch.tensor([points[n] for n in BODY_15.names], dtype=torch.float64)


@pytest.mark.parametrize(
    ("limb", "places", "expected"),
    [
        ("torso", {}, (0, 90, 0)),
        ("left_clavicle", {}, (90, 0, 0)),
        ("right_clavicle", {}, (-90, 0, 0)),
        ("left_upper_arm", {}, (0, -90, 0)),
        ("right_forearm", {}, (-90, 0, 0)),  # straight: along the upper arm's own line
        ("left_forearm", {"left_wrist": (0.2, 1.2, 0.25)}, (0, 0, 90)),
        ("left_thigh", {"left_knee": (0.1, 1, 0.45)}, (0, 0, 90)),
        ("left_thigh", {"left_knee": (0.4, 0.6, 0)}, (36.8699, -53.1301, 0)),
        ("right_shank", {"right_ankle": (-0.1, 0.55, -0.45)}, (0, 0, -90)),
        ("left_upper_arm", {"left_elbow": (0.2, 1.8, 0)}, (0, 90, 0)),
        ("head", {"head": (0, 1.6, 0.1)}, (0, 45, 45)),
    ],
)
def test_angles_are_those_between_bone_and_planes(limb, places, expected):
    found = angle(posture_angles(joints_of(**places)), limb)
    torch.testing.assert_close(found, torch.tensor(expected).double(), atol=1e-4, rtol=0)


def test_axes_are_carried_on_by_the_smallest_rotation():
    # the arm swung forward by 90 degrees takes the forearm's axes with it: up stays up
    joints = joints_of(left_elbow=(0.2, 1.5, 0.3), left_wrist=(0.2, 1.75, 0.3))
    found = angle(posture_angles(joints), "left_forearm")
    torch.testing.assert_close(found, torch.tensor([0.0, 90, 0]).double(), atol=1e-5, rtol=0)
    # by hand: R = exp of the angle between the two directions about their cross product
    state = random_states(Body.of_height(BODY_15, 1.7), 1, seed=5)
    body = Body.of_height(BODY_15, 1.7)
    joints = body.joints(state)[0]
    point = {name: joints[i] for i, name in enumerate(BODY_15.names)}
    frame, unit = posture_root(joints), torch.nn.functional.normalize
    for limb in ("left_thigh", "left_shank"):
        one = next(part for part in LIMBS_12 if part.name == limb)
        u = frame.mT @ unit(point[one.end] - point[one.start], dim=0)
        sines = torch.deg2rad(angle(posture_angles(joints), limb)).sin()
        torch.testing.assert_close(sines, u, atol=1e-9, rtol=0)
        straight = torch.tensor(one.straight).double()
        axis = torch.linalg.cross(straight, u)
        turn = math.atan2(float(axis.norm()), float(straight @ u))
        frame = frame @ rotvec_to_matrix(turn * unit(axis, dim=0))


def test_place_heading_and_size_make_no_difference():
    body = Body.of_height(BODY_15, 1.75)
    joints = body.joints(random_states(body, 20))
    turn = rotvec_to_matrix(torch.tensor([0.3, -1.9, 0.8]).double())
    moved = 1.3 * joints @ turn.mT + torch.tensor([2.0, -1, 5])
    torch.testing.assert_close(posture_angles(moved), posture_angles(joints), atol=1e-5, rtol=0)


def test_angles_are_bounded_and_have_no_jumps():
    body = Body.of_height(BODY_15, 1.75)
    ends = random_states(body, 2, seed=2, size=0.9)
    share = torch.linspace(0, 1, 2001, dtype=torch.float64)[:, None]
    found = state_postures(body, (1 - share) * ends[0] + share * ends[1])
    assert float(found.abs().max()) <= 90
    assert float(found.diff(dim=0).abs().max()) < 1.0
    assert torch.isfinite(found).all()


@pytest.mark.parametrize("frame", ["parent", "body"])
def test_states_come_back(frame):
    body = Body.of_height(BODY_15, 1.75, frame=frame)
    centres = 0.2 * torch.ones(len(BODY_15.parts), 3, dtype=torch.float64)
    centres[0] = 0
    for one in (body, body.altered(centres=centres)):
        state = random_states(one).reshape(4, 50, -1)
        postures = state_postures(one, state)
        back = posture_to_state(one, postures, state)
        torch.testing.assert_close(one.joints(back), one.joints(state), atol=1e-9, rtol=0)
        other = state.clone()  # the root alone matters, and the plane in which the torso leans
        other[..., 3 + 3 * BODY_15.part("left_forearm") :] = 0.1
        back = posture_to_state(one, postures, other)
        torch.testing.assert_close(state_postures(one, back), postures, atol=1e-5, rtol=0)


def test_one_root_serves_many_postures():
    body = Body.of_height(BODY_15, 1.6)
    postures = state_postures(body, random_states(body, 6)).reshape(2, 3, 36)
    root = torch.zeros(body.dim, dtype=torch.float64)
    states = posture_to_state(body, postures, root)
    assert states.shape == (2, 3, body.dim)
    torch.testing.assert_close(state_postures(body, states), postures, atol=1e-5, rtol=0)


def test_postures_that_no_body_can_take_still_give_states():
    body = Body.of_height(BODY_15, 1.6)
    postures = torch.tensor([0.0, 300.0]).double()[:, None].expand(2, 36)
    states = posture_to_state(body, postures, torch.zeros(2, body.dim).double())
    assert torch.isfinite(states).all() and float(states[:, 3:].abs().max()) <= 1


def test_normalised_postures_are_those_of_directions():
    body = Body.of_height(BODY_15, 1.6)
    postures = state_postures(body, random_states(body, 6))
    torch.testing.assert_close(normalise_postures(postures), postures, atol=1e-5, rtol=0)
    found = normalise_postures(0.5 * postures)
    sines = torch.deg2rad(found).sin().unflatten(-1, (12, 3))
    torch.testing.assert_close(sines.norm(dim=-1), torch.ones(6, 12).double())


def test_directions_are_unit_vectors_of_the_joints():
    body = Body.of_height(BODY_15, 1.6)
    joints = body.joints(random_states(body, 30))
    found = posture_directions(posture_angles(joints), posture_root(joints))
    at = {name: joints[:, i] for i, name in enumerate(BODY_15.names)}
    seen = torch.stack([at[limb.end] - at[limb.start] for limb in LIMBS_12], 1)
    seen = torch.nn.functional.normalize(seen, dim=-1)
    torch.testing.assert_close(found, seen, atol=1e-7, rtol=0)


def test_a_joint_that_the_set_lacks_is_at_rest():
    joints = joints_of(head=(0, 1.6, 0.1)).repeat(3, 1, 1)
    joints[:, BODY_15.joint("head")] = torch.nan
    joints[:, BODY_15.joint("left_elbow")] = torch.nan
    found = posture_angles(joints)
    torch.testing.assert_close(angle(found, "head")[0], torch.tensor([0.0, 90, 0]).double())
    torch.testing.assert_close(
        angle(found, "left_upper_arm")[0], torch.tensor([0.0, -90, 0]).double()
    )
    assert torch.isfinite(found).all()


def test_bad_input():
    joints = joints_of().repeat(4, 1, 1)
    gap = joints.clone()
    gap[2, BODY_15.joint("left_wrist"), 0] = torch.nan
    with pytest.raises(InputError, match="'left_wrist' is missing in frame 2"):
        posture_angles(gap)
    gap[:, BODY_15.joint("left_wrist")] = torch.nan
    gap[:, BODY_15.joint("neck")] = torch.nan
    with pytest.raises(InputError, match="hips, neck and pelvis"):
        posture_angles(gap)
    flat = joints_of(left_hip=(0, 1, 0), right_hip=(0, 1, 0))
    with pytest.raises(InputError, match="one point or in one line"):
        posture_angles(flat)
    with pytest.raises(InputError, match="'left_shank' has no length"):
        posture_angles(joints_of(left_ankle=(0.1, 0.55, 0)))
    with pytest.raises(ShapeError, match="15, 3"):
        posture_angles(joints[:, :12])
    with pytest.raises(SkeletonError, match="torso, head"):
        check_limbs(("torso", "tail"))
    body = Body.of_height(BODY_15, 1.75)
    with pytest.raises(ShapeError, match="36"):
        posture_to_state(body, torch.zeros(2, 35).double(), torch.zeros(2, 36).double())
    with pytest.raises(InputError, match="finite"):
        posture_to_state(body, torch.full((36,), torch.nan).double(), torch.zeros(36).double())
    renamed = BodySkeleton(
        **{f: getattr(BODY_15, f) for f in ("parents", "part_of", "part_parents", "directions",
                                             "proportions")},
        name="other", names=tuple(f"{n}_" for n in BODY_15.names), parts=BODY_15.parts,
    )  # fmt: skip
    lengths = BODY_15.standard_lengths(1.7)
    other = Body(renamed, lengths, torch.zeros(0, 2).double())
    with pytest.raises(SkeletonError, match="'other'"):
        state_postures(other, torch.zeros(36).double())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtypes(dtype):
    body = Body.of_height(BODY_15, 1.75, dtype=dtype)
    state = random_states(body, 5).to(dtype)
    found = state_postures(body, state)
    assert found.dtype == dtype
    assert posture_to_state(body, found, state).dtype == dtype


def test_gradients_at_rest_are_finite_whatever_is_missing():
    """An angle of 90 degrees falls on every side; one beside it has the slope of a turned bone."""
    for missing in ((), ("head",), ("left_wrist", "right_wrist")):
        joints = joints_of(**{name: (math.nan,) * 3 for name in missing}).requires_grad_()
        postures = posture_angles(joints)
        for limb, expected in (("left_thigh", [1 / 0.45, 0, 0]), ("right_forearm", None)):
            (slopes,) = torch.autograd.grad(angle(postures, limb)[0], joints, retain_graph=True)
            assert bool(torch.isfinite(slopes).all())
            if expected is not None:
                found = torch.deg2rad(slopes[BODY_15.joint("left_knee")])
                torch.testing.assert_close(found, torch.tensor(expected).double())
