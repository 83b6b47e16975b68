"""Kinematics against a joint-by-joint recursion with SciPy's rotations."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchpose.body import BODY_15, Body, TaperedCylinder, centres_of
from torchpose.errors import InputError, ShapeError, SkeletonError
from torchpose.math import quaternion_vector_to_matrix


def random_states(body, *lead, scale=0.35, seed=0):
    generator = torch.Generator().manual_seed(seed)
    states = scale * torch.randn(*lead, body.dim, generator=generator, dtype=torch.float64)
    return body.perturb(torch.zeros_like(states), states).to(body.offsets.dtype)


def random_centres(scale=0.3):
    centres = scale * torch.randn(11, 3, generator=torch.Generator().manual_seed(9))
    centres[0] = 0
    return centres.double()


def some_body(frame="parent", centred=True, **kind):
    centres = random_centres() if centred else None
    lengths, radii = BODY_15.standard_lengths(1.8), BODY_15.standard_radii(1.8)
    return Body(BODY_15, lengths, radii, centres=centres, frame=frame, **kind)


def walk_down(body, state):
    """World rotations by part, and positions of joints and tips by name, one after the other."""
    skeleton = body.skeleton

    def turn(vector):
        w = np.sqrt(max(0.0, 1 - float(vector @ vector)))
        return Rotation.from_quat([*vector.tolist(), w])

    rotations = [turn(state[3:6])]
    for part in range(1, len(skeleton.parts)):  # parents come before their parts
        above = rotations[0 if body.frame == "body" else skeleton.part_parents[part]]
        vector = state[3 + 3 * part : 6 + 3 * part]
        rotations.append(above * turn(body.centres[part]) * turn(vector))
    points = {skeleton.names[0]: state[:3].numpy()}
    for joint in range(1, len(skeleton.names)):
        offset = rotations[skeleton.part_of[joint]].apply(body.offsets[joint].numpy())
        points[skeleton.names[joint]] = points[skeleton.names[skeleton.parents[joint]]] + offset
    for tip, offset in zip(skeleton.tips, body.tips, strict=True):
        turned = rotations[skeleton.part(tip.part)].apply(offset.numpy())
        points[tip.name] = points[tip.joint] + turned
    return rotations, points


@pytest.mark.parametrize("frame", ["parent", "body"])
@pytest.mark.parametrize("centred", [False, True])
def test_rotations_joints_and_limbs_are_those_of_the_recursion(frame, centred):
    body = some_body(frame, centred)
    states = random_states(body, 3)
    rotations, joints, limbs = body.part_rotations(states), body.joints(states), body.limbs(states)
    for t, state in enumerate(states):
        expected, points = walk_down(body, state)
        matrices = torch.tensor(np.stack([r.as_matrix() for r in expected]))
        torch.testing.assert_close(rotations[t], matrices)
        named = [torch.tensor(points[name]) for name in BODY_15.names]
        torch.testing.assert_close(joints[t], torch.stack(named))
        for end, found in (("start", limbs.start), ("end", limbs.end)):
            named = [torch.tensor(points[getattr(limb, end)]) for limb in BODY_15.limbs]
            torch.testing.assert_close(found[t], torch.stack(named))
    assert torch.equal(limbs.radii, body.radii)


def test_the_rest_pose_stands_with_hanging_arms():
    body = Body.of_height(BODY_15, 1.8)
    rest = dict(zip(BODY_15.names, body.joints(torch.zeros(36).double()), strict=True))
    assert rest["left_wrist"][0] > 0 > rest["right_wrist"][0]  # x is the person's left
    assert rest["head"][1] > rest["neck"][1] > 0 > rest["left_ankle"][1]
    limbs = body.limbs(torch.zeros(36).double())
    foot = [limb.name for limb in BODY_15.limbs].index("left_foot")
    assert limbs.end[foot, 2] > limbs.start[foot, 2] + 0.1  # feet point forward
    top = (limbs.end + limbs.radii[:, 1:])[0, 1]
    sole = (limbs.start[foot, 1] - limbs.radii[foot, 0]).item()
    assert float(top) - sole == pytest.approx(1.8, abs=0.05)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("lead", [(), (4,), (2, 3), (0,)])
def test_any_leading_shape_and_dtype(dtype, lead):
    body = some_body(dtype=dtype)
    states = random_states(body, *lead)
    assert body.joints(states).shape == (*lead, 15, 3)
    assert body.joints(states).dtype == dtype
    assert body.part_rotations(states).shape == (*lead, 11, 3, 3)
    assert body.limbs(states).start.shape == (*lead, 17, 3)
    assert body.relative(states).shape == (*lead, 30) == (*lead, len(body.relative_columns))


@pytest.mark.parametrize("frame", ["parent", "body"])
def test_states_of_another_precision_keep_theirs(frame):
    body = some_body(frame=frame)
    states, weights = random_states(body, 5), torch.zeros(5)
    single = states.float()
    for measured in (body.joints, lambda x: body.limbs(x).end, lambda x: body.mean(x, weights)):
        assert measured(single).dtype == torch.float32
        torch.testing.assert_close(measured(single), measured(states).float(), atol=1e-5, rtol=1e-5)
    back = body.state_of(single[:, :3], body.part_rotations(single))
    torch.testing.assert_close(body.joints(back), body.joints(single), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("frame", ["parent", "body"])
def test_gradients_are_right_and_finite_everywhere(frame):
    body = some_body(frame)
    state = random_states(body, 1).requires_grad_()
    assert torch.autograd.gradcheck(body.joints, state)
    on_sphere = torch.zeros(36, dtype=torch.float64)
    on_sphere[3::3] = 1.0
    for start in (torch.zeros(36).double(), on_sphere, 2 * on_sphere):
        leaf = start.clone().requires_grad_()
        moved = body.perturb(leaf, body.difference(leaf.detach(), leaf))
        (body.joints(moved).sum() + body.limbs(leaf).end.square().sum()).backward()
        assert bool(torch.isfinite(leaf.grad).all())


def test_states_of_another_frame_and_other_centres_turn_the_same_way():
    body = some_body("parent", centred=False)
    states = random_states(body, 50, scale=0.2)
    for other in (
        body.altered(frame="body"),
        body.altered(centres=random_centres()),
        body.altered(centres=random_centres(), frame="body"),
    ):
        converted = body.convert(states, other)
        torch.testing.assert_close(other.joints(converted), body.joints(states))
        back = other.convert(converted, body)
        torch.testing.assert_close(back, states)


def test_difference_is_the_inverse_of_perturb():
    body = some_body()
    a, b = random_states(body, 20, seed=1), random_states(body, 20, seed=2)
    moved = body.perturb(b, body.difference(a, b))
    torch.testing.assert_close(moved, a)


def test_a_heading_turns_all_the_way_round():
    body = some_body()
    state = torch.zeros(36, dtype=torch.float64)
    step = state.clone()
    step[4] = np.sin(np.deg2rad(30) / 2)  # 30 degrees about the body's y
    facing = []
    for _ in range(12):
        state = body.perturb(state, step)
        facing.append(body.part_rotations(state)[0, :, 2])
    torch.testing.assert_close(facing[5], torch.tensor([0.0, 0.0, -1.0]).double())
    torch.testing.assert_close(facing[11], torch.tensor([0.0, 0.0, 1.0]).double())


def test_large_steps_stay_in_the_unit_ball():
    body = some_body()
    states = random_states(body, 100, scale=3.0)
    norms = states[..., 3:].unflatten(-1, (-1, 3)).norm(dim=-1)
    assert float(norms.max()) <= 1 + 1e-12


def test_mean_of_particles():
    body = some_body()
    states = random_states(body, 2, 40)
    weights = torch.rand(2, 40, generator=torch.Generator().manual_seed(1)).double()
    mean = body.mean(states, weights.log() + 700)  # any common factor
    share = weights / weights.sum(-1, keepdim=True)
    plain = torch.einsum("bn,bnd->bd", share, states)
    torch.testing.assert_close(mean[:, :3], plain[:, :3])
    torch.testing.assert_close(mean[:, 6:], plain[:, 6:])
    for b in range(2):
        w = (1 - states[b, :, 3:6].square().sum(-1)).clamp_min(0).sqrt()
        rotations = Rotation.from_quat(torch.cat([states[b, :, 3:6], w[:, None]], -1).numpy())
        expected = torch.tensor(rotations.mean(weights[b].numpy()).as_matrix())
        torch.testing.assert_close(quaternion_vector_to_matrix(mean[b, 3:6]), expected)
    with pytest.raises(InputError, match="weight above zero"):
        body.mean(states, torch.full((2, 40), -torch.inf).double())


def test_mean_of_headings_about_the_back_is_at_the_back():
    body = some_body()
    states = torch.zeros(2, 36, dtype=torch.float64)
    states[:, 4] = torch.tensor([1.0, -1.0]) * np.sin(np.deg2rad(170) / 2)
    mean = body.mean(states, torch.zeros(2).double())
    assert abs(float(mean[4])) == pytest.approx(1.0)


def test_relative_columns_go_back_in():
    body = some_body()
    states, others = random_states(body, 6), random_states(body, 6, seed=5)
    mixed = body.with_relative(states[:1], body.relative(others))
    assert torch.equal(mixed[:, :6], states[:1, :6].expand(6, 6))
    assert torch.equal(mixed[:, 6:], others[:, 6:])
    assert torch.equal(mixed[:, list(body.relative_columns)], others[:, 6:])


def test_centres_bring_rotations_to_the_origin():
    body = some_body(centred=False)
    states = torch.zeros(30, 36, dtype=torch.float64)
    states[:, 6:] = 0.6 + 0.05 * torch.randn(30, 30, generator=torch.Generator().manual_seed(2))
    states = body.perturb(torch.zeros(36).double(), states)
    assert float(states[:, 6:].unflatten(-1, (-1, 3)).norm(dim=-1).max()) > 0.99
    centred = body.altered(centres=centres_of(body, states))
    converted = body.convert(states, centred)
    assert float(converted[:, 6:].unflatten(-1, (-1, 3)).norm(dim=-1).max()) < 0.5
    again = centres_of(centred, converted)
    torch.testing.assert_close(again, centred.centres)
    with pytest.raises(InputError, match="at least one recorded state"):
        centres_of(body, states[:0])


def test_candidates_of_one_person_have_batched_radii():
    body = some_body()
    radii = body.radii * torch.linspace(0.5, 2, 7).double()[:, None, None]
    limbs = body.altered(radii=radii).limbs(random_states(body, 2, 7))
    assert limbs.radii.shape == (7, 17, 2) and limbs.start.shape == (2, 7, 17, 3)


def test_buffers_follow_the_module_and_its_file():
    body = some_body()
    other = Body.of_height(BODY_15, 1.5)
    other.load_state_dict(body.state_dict())
    states = random_states(body, 3)
    assert torch.equal(other.joints(states), body.joints(states))
    assert body.float().joints(states.float()).dtype == torch.float32


@pytest.mark.cuda
def test_on_a_device():
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    body = some_body()
    states = random_states(body, 5)
    found = some_body().cuda().limbs(states.cuda())
    torch.testing.assert_close(found.end.cpu(), body.limbs(states).end)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"bone_lengths": torch.ones(14)}, ShapeError, "bone_lengths must have shape"),
        ({"bone_lengths": torch.zeros(15)}, InputError, "bone to 'neck' has 0"),
        ({"bone_lengths": torch.full((15,), torch.nan)}, InputError, "must be positive"),
        ({"radii": torch.ones(3, 2)}, ShapeError, "radii must have shape"),
        ({"radii": -torch.ones(17, 2)}, InputError, "'head' has -1"),
        ({"directions": torch.zeros(15, 3)}, InputError, "has no length"),
        ({"centres": torch.ones(11, 3)}, InputError, "root part has no centre"),
        ({"tips": torch.ones(3, 3)}, ShapeError, "tips must have shape"),
        ({"frame": "world"}, InputError, "frame must be one of"),
    ],
)
def test_what_no_body_can_be_built_from(change, error, message):
    given = {"bone_lengths": BODY_15.standard_lengths(1.8), "radii": BODY_15.standard_radii(1.8)}
    given |= change
    lengths, radii = given.pop("bone_lengths"), given.pop("radii")
    with pytest.raises(error, match=message):
        Body(BODY_15, lengths, radii, **given)


def test_a_limb_of_zero_length_is_refused():
    ball = TaperedCylinder("ball", "pelvis", "pelvis", (0.1, 0.1))
    skeleton = replace(BODY_15, limbs=(*BODY_15.limbs, ball))
    with pytest.raises(InputError, match="limb 'ball' has zero length"):
        Body.of_height(skeleton, 1.8)


def test_states_of_another_size_are_refused():
    body = some_body()
    with pytest.raises(ShapeError, match=r"states must have shape \[..., 36\]"):
        body.joints(torch.zeros(2, 33).double())
    other = Body.of_height(replace(BODY_15, name="other"), 1.8)
    with pytest.raises(SkeletonError, match="cannot be converted"):
        body.convert(random_states(body), other)


def test_a_changed_bone_moves_what_hangs_on_it():
    body, longer = (Body.of_height(BODY_15, 1.75) for _ in range(2))
    state = torch.zeros(1, body.dim, dtype=torch.float64)
    wrist = BODY_15.names.index("left_wrist")
    before = longer.joints(state)[0]
    with torch.no_grad():
        longer.bone_lengths[wrist] += 0.1
    moved = longer.joints(state)[0] - before
    assert abs(float(moved[wrist].norm()) - 0.1) < 1e-12
    assert float(moved[[i for i in range(15) if i != wrist]].norm()) < 1e-12
    body.load_state_dict(longer.state_dict())
    torch.testing.assert_close(body.joints(state), longer.joints(state), rtol=0, atol=0)
