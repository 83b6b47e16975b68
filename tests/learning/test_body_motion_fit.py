"""What is fitted to recorded bodies: processes come back, sides are alike, sets count alike."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.body.test_articulation import zero_point
from tests.priors.poses import recording
from torchpose.body import BODY_15, fit_body, fit_state
from torchpose.body._articulation import Articulation, BodyPoint, mirror_of
from torchpose.errors import InputError
from torchpose.learning._body_motion_fit import (
    BodyMotionRecipe,
    _draw_poses,
    acceleration_ratio,
    fit_body_motion,
    pose_log_density,
)
from torchpose.learning._motion_sequences import MotionSequence, motion_sequence
from torchpose.learning._recipes.body_motion import _set_of
from torchpose.math._rotations import matrix_to_quaternion_vector

QUICK = BodyMotionRecipe(n_components=4, n_samples=400, acceleration_scale=1.0)
ACCELERATION, DECAY = 2.0, 4.0
SHIFT, SHIFT_TIME = 0.03, 0.6
FPS = 30.0


@pytest.fixture(scope="module")
def articulation() -> Articulation:
    return Articulation()


def walk(
    articulation: Articulation,
    frames: int = 900,
    fps: float = FPS,
    acceleration: float = ACCELERATION,
    seed: int = 0,
    person: str = "a#1",
    size: float = 1.0,
    mix: torch.Tensor | None = None,
) -> MotionSequence:
    """Somebody whose position and angles are Ornstein-Uhlenbeck processes, as are the joints of the trunk.

    They are linear combinations `mix` of independent ones.
    """
    g = torch.Generator().manual_seed(seed)
    steps = velocity_steps(articulation.n_pose, frames, fps, acceleration, g)
    steps = steps if mix is None else steps @ mix.mT
    turns = articulation._turns(steps[:, 3:])
    rotations = [torch.eye(3).double().expand_as(turns[0])]
    for turn in turns:
        rotations.append(rotations[-1] @ turn)
    rest = zero_point(articulation, frames + 1)
    position = torch.cat([rest.position[:1], steps[:, :3].cumsum(0)])
    point = BodyPoint(position, torch.stack(rotations), *rest[2:])
    kept = math.exp(-1 / (fps * SHIFT_TIME))
    noise = SHIFT * torch.randn(
        frames + 1, *rest.shifts.shape[1:], generator=g, dtype=torch.float64
    )
    residual = [noise[0]]
    for new in noise[1:]:
        residual.append(kept * residual[-1] + math.sqrt(1 - kept**2) * new)
    lengths = size * articulation.offsets.norm(dim=-1)
    known = torch.ones(len(lengths), dtype=torch.bool)
    return MotionSequence(
        person.partition("#")[0], person, fps, point, torch.stack(residual), lengths, known
    )


def velocity_steps(n, frames, fps, acceleration, g, fine=10):
    """How far a process with decaying velocity goes from frame to frame."""
    dt = 1 / (fps * fine)
    v = acceleration / math.sqrt(2 * DECAY) * torch.randn(n, generator=g, dtype=torch.float64)
    noise = acceleration * math.sqrt(dt) * torch.randn(frames, fine, n, generator=g).double()
    steps = []
    for frame in noise:
        moved = torch.zeros_like(v)
        for change in frame:
            moved, v = moved + v * dt, v * math.exp(-DECAY * dt) + change
        steps.append(moved)
    return torch.stack(steps)


def without(sequence: MotionSequence, articulation: Articulation, *names: str) -> MotionSequence:
    known = sequence.known.clone()
    known[[articulation.skeleton.joint(name) for name in names]] = False
    return sequence._replace(known=known)


def test_recorded_joints_are_those_of_the_motion(articulation):
    """Hips sit lower than on the standard body, and the neck moves."""
    truth = walk(articulation, frames=40).point
    shifts = torch.zeros_like(truth.shifts)
    names = [articulation.skeleton.names[j] for j in articulation.shifted]
    shifts[:, [names.index("left_hip"), names.index("right_hip")], 1] = -0.05
    shifts[:, names.index("neck"), 2] = 0.01 * torch.linspace(0, 6, 41).double().sin()
    joints = articulation.joints(truth._replace(shifts=shifts))
    joints[:, articulation.skeleton.joint("head")] = torch.nan
    centres = matrix_to_quaternion_vector(articulation.centres)
    body = fit_body(joints, centres=centres)
    found = motion_sequence(articulation, body, fit_state(body, joints), joints, FPS, "a#1")
    assert (found.origin, found.person, found.fps) == ("a", "a#1", FPS)
    assert found.known.tolist() == [name != "head" for name in articulation.skeleton.names]
    point = found.point._replace(scales=found.point.scales + articulation.scales_of(found.lengths))
    again = articulation.joints(point._replace(shifts=found.residual))
    told = found.known & (articulation.part_of < 2)
    root = joints[:, :1] - again[:, :1]
    torch.testing.assert_close(again[:, told] + root, joints[:, told], atol=1e-4, rtol=0)
    assert 0.01 < float(found.residual.square().mean().sqrt()) < 0.03


@pytest.mark.parametrize("fps", [FPS, 15.0])
def test_processes_come_back(articulation, fps):
    sequences = [walk(articulation, fps=fps, seed=seed, person=f"a#{seed}") for seed in range(4)]
    found = fit_body_motion(sequences, QUICK)
    torch.testing.assert_close(
        found.acceleration, torch.full_like(found.acceleration, ACCELERATION), rtol=0.08, atol=0
    )
    assert float(found.decay.mean()) == pytest.approx(DECAY, rel=0.1)
    torch.testing.assert_close(found.decay, torch.full_like(found.decay, DECAY), rtol=0.3, atol=0)
    torch.testing.assert_close(
        found.shift_std, torch.full_like(found.shift_std, SHIFT), rtol=0.15, atol=0
    )
    times = torch.full_like(found.shift_time, SHIFT_TIME)
    torch.testing.assert_close(found.shift_time, times, rtol=0.25, atol=0)
    assert acceleration_ratio(found, sequences) == pytest.approx(1, abs=0.05)


def test_correlations_come_back_with_their_mirror_images(articulation):
    """A thigh and a shank that swing against each other on the left do so on both sides."""
    n, mirror = articulation.n_pose, mirror_of(articulation)
    thigh, shank = (
        3 + int((articulation.axis_part == articulation.skeleton.part(name)).nonzero()[0])
        for name in ("left_thigh", "left_shank")
    )
    mix = torch.eye(n, dtype=torch.float64)
    mix[shank, thigh], mix[shank, shank] = -0.8, 0.6
    sequences = [
        walk(articulation, seed=seed, person=f"{name}#{seed}", mix=mix)
        for name in "ab"
        for seed in range(3)
    ]
    sequences = [
        s if s.origin == "a" else without(s, articulation, "left_ankle") for s in sequences
    ]
    found = fit_body_motion(sequences, QUICK).correlation
    other = 3 + mirror.columns[[thigh - 3, shank - 3]]
    expected = 0.9 * -0.8 / 2 / 2  # of one side and of one set in two
    for i, j in ((thigh, shank), tuple(other.tolist())):
        assert float(found[i, j]) == pytest.approx(expected, abs=0.03)
        found[i, j] = found[j, i] = 0
    torch.testing.assert_close(found, torch.eye(n).double(), atol=0.08, rtol=0)


def test_hips_that_stay_where_a_person_has_them_hardly_shift(articulation):
    """Persons differ in where hips are, and none of them moves them; necks and shoulders do move."""
    hips = [j for j, n in enumerate(articulation.shifted) if "hip" in BODY_15.names[n]]
    sequences = [walk(articulation, seed=seed, person=f"a#{seed}") for seed in range(4)]
    for seed, sequence in enumerate(sequences):
        sequence.residual[:, hips] = 0.03 * (-1) ** seed
    found = fit_body_motion(sequences, QUICK)
    assert float(found.shift_std[hips].mean()) == pytest.approx(0.03, rel=0.01)
    assert found.shift_time[hips].tolist() == [60.0, 60.0]
    others = [j for j in range(len(articulation.shifted)) if j not in hips]
    assert found.shift_time[others].tolist() == pytest.approx([SHIFT_TIME] * 3, rel=0.25)


@pytest.mark.slow
@pytest.mark.parametrize("fps", [FPS, 60.0])
def test_limbs_that_swing_have_mean_accelerations(articulation, fps):
    """A thigh is a driven pendulum; a shank is pushed by how its thigh turns. Both sides are alike."""
    joint = {
        name: 3 + int((articulation.axis_part == articulation.skeleton.part(name)).nonzero()[0])
        for name in ("left_thigh", "left_shank", "right_thigh", "right_shank")
    }
    stiff, damp, push, fine = 60.0, 3.0, 5.0, 20
    g, dt, frames = torch.Generator().manual_seed(0), 1 / (fps * 20), 2400
    angle, speed = torch.zeros(4).double(), torch.zeros(4).double()  # thighs, shanks
    angles = []
    for _ in range(frames + 1):
        for noise in 3.0 * math.sqrt(dt) * torch.randn(fine, 4, generator=g).double():
            pulled = -stiff * angle - damp * speed
            pulled[2:] += push * speed[:2]
            angle, speed = angle + speed * dt, speed + pulled * dt + noise
        angles.append(angle)
    columns = [joint[n] for n in ("left_thigh", "right_thigh", "left_shank", "right_shank")]
    steps = torch.zeros(frames, articulation.n_pose).double()
    steps[:, columns] = torch.stack(angles).diff(dim=0)
    turns = articulation._turns(steps[:, 3:])
    rotations = [articulation._turns(_angles(articulation, columns, angles[0]))]
    for turn in turns:
        rotations.append(rotations[-1] @ turn)
    rest = walk(articulation, frames=frames, fps=fps)
    sequence = rest._replace(point=rest.point._replace(rotations=torch.stack(rotations)))
    found = fit_body_motion([sequence], QUICK)
    law = torch.zeros(8, 8).double()  # of four angles and their speeds
    law[:4, 4:] = torch.eye(4)
    law[4:, :4], law[4:, 4:] = -stiff * torch.eye(4), -damp * torch.eye(4)
    law[6, 4] = law[7, 5] = push
    lag = round(0.1 * fps) / fps
    expected = torch.linalg.matrix_exp(law * lag)[4:]
    kept = torch.exp(-found.decay * lag)
    reach = ((1 - kept) / found.decay)[columns]
    n = found.drift.shape[1] - articulation.n_pose
    by_angle = reach[:, None] * found.drift[columns][:, [c - 6 + 1 for c in columns]]
    by_speed = reach[:, None] * found.drift[columns][:, [n + c for c in columns]]
    by_speed += torch.diag(kept[columns])
    torch.testing.assert_close(by_angle, expected[:, :4], atol=0.6, rtol=0.15)
    torch.testing.assert_close(by_speed, expected[:, 4:], atol=0.1, rtol=0.1)


def _angles(articulation, columns, values):
    turned = torch.zeros(articulation.n_pose).double()
    turned[columns] = values
    return turned[3:]


def test_a_glitch_changes_little(articulation):
    clean = walk(articulation)
    position = clean.point.position.clone()
    position[400] += 0.5
    broken = clean._replace(point=clean.point._replace(position=position))
    one, other = (fit_body_motion([s], QUICK).acceleration for s in (clean, broken))
    torch.testing.assert_close(other, one, rtol=0.1, atol=0)


def test_a_large_set_counts_as_a_small_one(articulation):
    slow = [walk(articulation, seed=seed, person="a#1") for seed in range(3)]
    fast = [walk(articulation, acceleration=4 * ACCELERATION, seed=9, person="b#1")]
    found = fit_body_motion([*slow, *fast], QUICK).acceleration
    torch.testing.assert_close(found, torch.full_like(found, 2 * ACCELERATION), rtol=0.08, atol=0)


def test_a_set_says_nothing_of_joints_that_it_lacks(articulation):
    whole = walk(articulation, seed=1, person="a#1")
    still = walk(articulation, acceleration=0.1, seed=2, person="b#1", size=1.1)
    found = fit_body_motion([whole, without(still, articulation, "head")], QUICK)
    part = articulation.skeleton.part("head")
    head = found.acceleration[3:][articulation.axis_part == part]
    torch.testing.assert_close(head, torch.full_like(head, ACCELERATION), rtol=0.1, atol=0)
    scale = found.scale_mean[articulation.groups.index("head")]
    assert float(scale) == pytest.approx(0, abs=1e-9)
    with pytest.raises(InputError, match="no recording has the joint head, left_wrist; add"):
        fit_body_motion([without(whole, articulation, "head", "left_wrist")], QUICK)


def test_a_part_of_which_no_set_has_all_joints_is_refused(articulation):
    sides = ("left_hip", "right_hip")
    halves = [
        without(walk(articulation, seed=i, person=f"{i}#1"), articulation, side)
        for i, side in enumerate(sides)
    ]
    with pytest.raises(InputError, match=r"no set of recordings has all of the joints .*left_hip"):
        fit_body_motion(halves, QUICK)


def test_folders_of_persons_are_no_sets():
    """Who states no source is of a joint set, whatever the folder."""
    stated = recording(person="a")
    silent = [replace(stated, source="", path=Path(f"/home/{name}/x.npz")) for name in "ab"]
    assert _set_of(stated) == "site:set"
    assert len({_set_of(one) for one in silent}) == 1
    assert {_set_of(replace(one, skeleton="mhad-16")) for one in silent} == {"mhad-16"}


def test_angles_that_no_set_tells_together_are_drawn_from_those_that_tell_them(articulation):
    """Two sets that each lack a joint: their angles are those of the other one, and never zero."""
    headless = without(walk(articulation, seed=1, person="a#1"), articulation, "head")
    footless = without(walk(articulation, seed=2, person="b#1"), articulation, "left_ankle")
    sets = {"a": [headless], "b": [footless]}
    drawn = _draw_poses(articulation, sets, 400, torch.Generator().manual_seed(0))
    own = {name: articulation.relative_angles(one.point) for name, (one,) in sets.items()}
    parts = articulation.axis_part[articulation.n_root :]
    shank = int(articulation.part_of[articulation.skeleton.joint("left_ankle")])
    for part, owner in ((articulation.skeleton.part("head"), "b"), (shank, "a")):
        angles = drawn[:, parts == part]
        assert bool(torch.isin(angles, own[owner][:, parts == part]).all())
        assert float(angles.std(0).min()) > 0.01


def test_poses_and_motion_are_alike_on_both_sides(articulation):
    found = fit_body_motion([walk(articulation)], QUICK)
    mirror = mirror_of(articulation)
    assert torch.equal(mirror.columns[mirror.columns], torch.arange(articulation.n_rotations))
    root = int((articulation.axis_part == 0).sum())
    index, sign = mirror.columns[root:] - root, mirror.sign[root:]
    poses = found.poses.sample((50,), torch.Generator().manual_seed(0))
    torch.testing.assert_close(
        found.poses.log_prob(poses[:, index] * sign), found.poses.log_prob(poses)
    )
    for values in (found.acceleration, found.decay):
        torch.testing.assert_close(values[3:][mirror.columns], values[3:])
        assert len(values[:3].unique()) == 1
    assert math.isfinite(pose_log_density(found, [walk(articulation, seed=5)]))


def test_joints_in_a_mirror_are_those_of_mirrored_angles(articulation):
    g = torch.Generator().manual_seed(0)
    angles = 0.5 * torch.randn(3, articulation.n_rotations, generator=g, dtype=torch.float64)
    mirror = mirror_of(articulation)
    rest = zero_point(articulation, 3)
    names = articulation.skeleton.names
    other = [names.index(name.replace("left", "x").replace("right", "left").replace("x", "right"))
             for name in names]  # fmt: skip
    one, two = (
        articulation.joints(rest._replace(rotations=articulation._turns(turn)))
        for turn in (angles, angles[:, mirror.columns] * mirror.sign)
    )
    flipped = one[:, other] * torch.tensor([-1.0, 1.0, 1.0]).double()
    torch.testing.assert_close(two, flipped)


def test_persons_and_joint_sets_spread_the_proportions(articulation):
    sizes = {"a#1": 0.9, "a#2": 1.1, "b#1": 1.0}
    sequences = [
        walk(articulation, frames=60, person=person, seed=i, size=size)
        for i, (person, size) in enumerate(sizes.items())
    ]
    found = fit_body_motion(sequences, QUICK)
    expected = (math.log(0.9) + math.log(1.1)) / 4  # the mean of the sets' means
    torch.testing.assert_close(found.scale_mean, torch.full_like(found.scale_mean, expected))
    std = found.scale_cov.diagonal().sqrt()
    assert 0.08 < float(std[articulation.groups.index("knee")]) < 0.12
    assert float(std[articulation.groups.index("hip")]) > 0.2
    assert bool((torch.linalg.eigvalsh(found.scale_cov) > 0).all())


def test_the_seed_decides(articulation):
    sequences = [walk(articulation, frames=200)]
    one, two = (fit_body_motion(sequences, QUICK) for _ in range(2))
    assert all(torch.equal(v, two.state_dict()[name]) for name, v in one.state_dict().items())
    other = BodyMotionRecipe(n_components=4, n_samples=400, seed=1)
    assert not torch.equal(fit_body_motion(sequences, other).poses.means, one.poses.means)


def test_settings_are_in_the_prior(articulation):
    sequences = [walk(articulation, frames=200)]
    one = fit_body_motion(sequences, QUICK)
    recipe = BodyMotionRecipe(
        4,
        400,
        acceleration_scale=3.0,
        least_shift=0.1,
        pull_time=2.0,
    )
    other = fit_body_motion(sequences, recipe)
    torch.testing.assert_close(other.acceleration, 3 * one.acceleration)
    assert float(other.shift_std.min()) == 0.1 and float(other.pull_time) == 2.0


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"n_components": 5}, "n_components must be even"),
        ({"n_components": 0}, "n_components must be even"),
        ({"n_samples": 3}, "n_samples must be at least"),
        ({"pull_time": 0.0}, "pull_time must be positive"),
        ({"acceleration_scale": math.inf}, "acceleration_scale must be positive and finite"),
    ],
)
def test_bad_settings_are_refused(settings, said):
    with pytest.raises(InputError, match=said):
        BodyMotionRecipe(**settings)


def test_too_few_frames_are_refused(articulation):
    short = walk(articulation, frames=3)
    with pytest.raises(InputError, match="the longest has 4 frames; add longer ones"):
        fit_body_motion([short], QUICK)
    with pytest.raises(InputError, match="the longest has 0 frames"):
        fit_body_motion([], QUICK)
