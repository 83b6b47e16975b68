"""Poses are averaged with what a network lifts, joint by joint as each is sure."""

import math

import pytest
import torch

from torchpose.priors._arm_lifter import ArmLifter, LiftedArms
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body import _lifted_ends
from torchpose.upper_body._articulated_frame import LIMBS, SHOULDERS
from torchpose.upper_body._estimator import SeenPoses
from torchpose.upper_body._lifted_ends import EndsAverage, farther_off

MATRIX = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=torch.float64)
WHOLE = torch.ones(8, dtype=torch.bool)
FEW = torch.tensor([name.split("_")[0] in ("hand", "neck", "head") for name in UPPER_BODY])
SIDES = ("left", "right")
ELBOWS, HANDS, BOTH_SHOULDERS = (
    [UPPER_BODY.index(f"{joint}_{side}") for side in SIDES]
    for joint in ("elbow", "hand", "shoulder")
)
STD = 0.1  # metres, of our elbows and hands


class Told(ArmLifter):
    """Stands for a network: the same elbows and hands in every frame, in axes that look at the neck."""

    def __init__(self, ends, std):
        super().__init__()
        self.told, self.std = ends, std

    def forward(self, seen):
        frames = seen.shape[:-1]
        std = torch.full((*frames, 2, 2), self.std, dtype=torch.float64)
        return LiftedArms(self.told.expand(*frames, 2, 2, 3), std)


def poses(n_frames=5, n_persons=2):
    """Return a person who holds both arms out; the neck is on the optical axis."""
    joints = torch.zeros(8, 3, dtype=torch.float64)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for reach, joint in ((0.18, "shoulder"), (0.45, "elbow"), (0.7, "hand")):
            joints[UPPER_BODY.index(f"{joint}_{side}")] = torch.tensor([sign * reach, 0.05, 0.0])
    joints[UPPER_BODY.index("head"), 1] = -0.2
    joints[:, 2] = 2.0
    joints = joints.expand(n_persons, n_frames, 8, 3)
    seen = joints @ MATRIX.mT
    eye = torch.eye(3, dtype=torch.float64).expand(n_persons, n_frames, 8, 3, 3)
    turn = eye[:, :, :1]
    return SeenPoses(
        joints, STD**2 * eye, turn, torch.ones_like(joints[..., :1, 0]), joints[:, :, 2],
        seen[..., :2] / seen[..., 2:], 0.0 * eye[..., :2, :2],
    )  # fmt: skip


def ends_of(joints):
    return joints[..., list(LIMBS), :].unflatten(-2, (2, 2)) - joints[..., SHOULDERS, None, :]


MODESTY = 0.25


def averaged(ends, std=STD, known=WHOLE, given=None, trust=(1.0, 1.0), unit=1.0, level=False):
    given = poses() if given is None else given
    model = EndsAverage(Told(ends, std), MATRIX, 30.0, False, trust, MODESTY, unit, level)
    known = known.expand(*given.joints.shape[:2], 8)
    state = model.init(len(known))
    lifted = model.lift(state, given, known)
    return model.advance(state, given, lifted, known)[1]


def own_ends():
    return ends_of(poses().joints)[0, 0]


@pytest.mark.parametrize("known", [WHOLE, FEW])
def test_a_network_that_is_not_sure_or_agrees_changes_no_joint(known):
    for ends, std in ((own_ends(), STD), (1.5 * own_ends(), 1e6)):
        found = averaged(ends, std, known)
        torch.testing.assert_close(found.joints, poses().joints, atol=1e-6, rtol=0)
        torch.testing.assert_close(found.uv, poses().uv, atol=1e-3, rtol=0)


@pytest.mark.parametrize("known", [WHOLE, FEW])
def test_arms_come_to_lie_between_both_and_measured_joints_stay_where_they_are_seen(known):
    theirs = own_ends() + torch.tensor([0.0, 0.0, -0.2], dtype=torch.float64)
    found = averaged(theirs, STD, known)
    away = ends_of(found.joints)[..., 2]
    assert bool((away < -0.03).all()) and bool((away > -0.17).all())
    seen = found.joints @ MATRIX.mT
    torch.testing.assert_close(seen[..., :2] / seen[..., 2:], found.uv)
    torch.testing.assert_close(found.uv[..., known, :], poses().uv[..., known, :])


def test_pixels_move_as_joints_do():
    """Pixels of joints that are not measured are means of their own, and not where mean joints project to."""
    given = poses()
    apart = torch.zeros_like(given.uv).index_fill(2, torch.tensor(ELBOWS), 30.0)
    given = given._replace(uv=given.uv + apart)
    nobody = FEW & ~torch.zeros(8, dtype=torch.bool).index_fill(0, torch.tensor(HANDS), True)
    theirs = own_ends() + torch.tensor([0.0, 0.1, 0.0], dtype=torch.float64)
    torch.testing.assert_close(averaged(theirs, STD, nobody, given).uv, given.uv)
    seen = averaged(theirs, STD, FEW, given)
    pixels = seen.joints @ MATRIX.mT
    torch.testing.assert_close(seen.uv - apart, pixels[..., :2] / pixels[..., 2:])


def test_the_surer_of_both_counts_more():
    theirs = own_ends() + torch.tensor([0.0, 0.0, -0.2], dtype=torch.float64)
    depths = [ends_of(averaged(theirs, std).joints)[0, 0, 0, 1, 2] for std in (0.03, 0.1, 0.3)]
    assert float(depths[0]) < float(depths[1]) - 0.03 < float(depths[2]) - 0.06


def test_a_network_that_knows_longer_arms_moves_the_body_farther_away():
    """At equal variances c is a fifth of the way to b, since ours counts for a quarter."""
    found = averaged(1.3 * own_ends(), STD)
    factor = 1 + 0.3 / 5
    first, last = found.place[0, [0, -1], 2] / 2.0
    assert 1.0 < float(first) < float(last) < factor
    torch.testing.assert_close(found.uv, poses().uv)
    middle = UPPER_BODY.index("neck")
    torch.testing.assert_close(found.joints[:, :, middle, 2], found.place[..., 2])


def test_a_network_knows_persons_of_the_size_that_they_are_known_to_have():
    found = averaged(own_ends() / 0.6, STD, unit=0.6)
    torch.testing.assert_close(found.joints, poses().joints)


@pytest.mark.parametrize("angle", [0.0, 0.35, -0.35])
def test_arms_of_bodies_that_are_seen_from_above_hang_along_gravity(angle):
    """The network has them hang in axes that look at the neck, whatever its angle below the horizon is."""
    hanging = torch.zeros_like(own_ends())
    hanging[..., 1] = math.cos(angle) * torch.tensor([0.27, 0.52], dtype=torch.float64)
    given = poses()
    lower = torch.tensor([0.0, 2.0 * math.tan(angle), 0.0], dtype=torch.float64)
    joints = given.joints + lower
    seen = joints @ MATRIX.mT
    given = given._replace(joints=joints, uv=seen[..., :2] / seen[..., 2:], place=joints[:, :, 2])
    depth = ends_of(averaged(hanging, 1e-4, FEW, given, level=True).joints)[..., 2]
    torch.testing.assert_close(depth, torch.zeros_like(depth), atol=0.02, rtol=0)


def test_a_network_that_is_wrong_and_sure_does_not_move_the_body_behind_the_camera():
    for ends in (-own_ends(), 20 * own_ends()):
        depth = averaged(ends, 1e-3).place[..., 2]
        assert float(depth.min()) > 1.6 - 1e-9 and float(depth.max()) < 2.5 + 1e-9


def test_many_frames_are_lifted_in_parts(monkeypatch):
    whole = averaged(1.2 * own_ends(), STD, FEW)
    monkeypatch.setattr(_lifted_ends, "_AT_ONCE", 3)
    parts = averaged(1.2 * own_ends(), STD, FEW)
    torch.testing.assert_close(parts.joints, whole.joints, atol=0, rtol=0)
    torch.testing.assert_close(parts.covs, whole.covs, atol=0, rtol=0)


def test_shoulders_go_where_arms_have_them_unless_they_or_elbows_are_measured():
    theirs = own_ends() + torch.tensor([0.0, 0.1, 0.0], dtype=torch.float64)
    bent = FEW | torch.zeros_like(FEW).index_fill(0, torch.tensor(ELBOWS), True)
    few, whole, elbows = (averaged(theirs, STD, known) for known in (FEW, WHOLE, bent))
    share = 1 / 5
    for side in BOTH_SHOULDERS:
        lifted = poses().joints[..., side, 1] - few.joints[..., side, 1]
        assert bool((lifted > 0.8 * share * 0.1).all())
    for found in (whole, elbows):
        seen = found.uv[..., BOTH_SHOULDERS, :]
        torch.testing.assert_close(seen, poses().uv[..., BOTH_SHOULDERS, :])


def test_an_arm_without_a_hand_is_moved_as_when_it_last_had_one():
    theirs = own_ends() + torch.tensor([0.0, 0.0, -0.2], dtype=torch.float64)
    known = WHOLE.repeat(2, 5, 1)
    known[:, 3:, HANDS[0]] = False
    known[1, :, HANDS[1]] = False
    found = averaged(theirs, STD, known)
    away = ends_of(found.joints)[..., 2]
    torch.testing.assert_close(away[:, 3:, 0, 1], away[:, [2, 2], 0, 1], atol=0.01, rtol=0)
    assert float(away[1, :, 1].abs().max()) < 1e-6  # never seen: not moved
    assert float(away[0, :, 1, 1].max()) < -0.03


def test_without_head_and_shoulders_nothing_tells_the_size_of_a_body():
    theirs = own_ends() + torch.tensor([0.0, 0.0, -0.2], dtype=torch.float64)
    head = torch.arange(8) == UPPER_BODY.index("head")
    shoulders = torch.zeros(8, dtype=torch.bool).index_fill(0, torch.tensor(BOTH_SHOULDERS), True)
    for known, moves in ((FEW & ~head, False), (FEW, True), (FEW & ~head | shoulders, True)):
        found = averaged(theirs, STD, known)
        assert bool((found.joints - poses().joints).abs().max() > 0.03) is moves


@pytest.mark.parametrize("size", [1, 2])
def test_a_stream_gives_the_numbers_of_the_whole_recording(size):
    given = poses(6)
    jumps = torch.linspace(0, 0.3, 6, dtype=torch.float64)[:, None, None]
    given = given._replace(joints=given.joints * (1 + jumps))
    known = torch.rand(2, 6, 8, generator=torch.Generator().manual_seed(0)) > 0.3
    model = EndsAverage(Told(1.2 * own_ends(), STD), MATRIX, 30.0, wrists=False)
    whole = model.advance(model.init(2), given, model.lift(model.init(2), given, known), known)[1]
    state, parts = model.init(2), []
    for first in range(0, 6, size):
        part = SeenPoses(*(values[:, first : first + size] for values in given))
        here = known[:, first : first + size]
        state, found = model.advance(state, part, model.lift(state, part, here), here)
        parts.append(found)
    for name in ("joints", "covs", "uv", "place"):
        torch.testing.assert_close(
            torch.cat([getattr(x, name) for x in parts], 1), getattr(whole, name)
        )


def test_covariances_are_those_of_an_intersection():
    """C = 2 v / (0.25 u + v) A, of arms that are seen alone."""
    known = WHOLE.repeat(2, 5, 1)
    known[1, :, HANDS[0]] = False
    known[0, :, ELBOWS[1]] = False
    found = averaged(own_ends(), STD, known, trust=(0.6, 0.75))
    factor = found.covs.diagonal(dim1=-2, dim2=-1)[..., 0] / STD**2
    for side, trust in ((0, 0.6), (1, 0.75)):
        ends = factor[0, :, [ELBOWS[side], HANDS[side]]]
        torch.testing.assert_close(ends, torch.full_like(ends, trust * 2 / 1.25))
    left = [ELBOWS[0], HANDS[0], *BOTH_SHOULDERS, UPPER_BODY.index("neck")]
    torch.testing.assert_close(factor[1, :, left], torch.ones(5, 5, dtype=torch.float64))


def test_pixels_that_are_not_known_make_the_network_less_sure():
    vague = poses()
    covs = 400.0 * torch.eye(2, dtype=torch.float64).expand_as(vague.uv_covs)
    theirs = own_ends() + torch.tensor([0.0, 0.0, -0.2], dtype=torch.float64)
    sure, unsure = (averaged(theirs, STD, given=x) for x in (vague, vague._replace(uv_covs=covs)))
    depths = [ends_of(found.joints)[0, 0, 0, 1, 2] for found in (sure, unsure)]
    assert float(depths[0]) < float(depths[1]) - 0.01


def test_what_is_nearer_to_the_network_is_likelier():
    model = EndsAverage(Told(own_ends(), STD), MATRIX, 30.0, wrists=False)
    given, state = poses(1), model.init(2)
    known = FEW.repeat(2, 1, 1)
    lifted = model.lift(state, given, known)
    off = given.joints + torch.zeros_like(given.joints).index_fill(2, torch.tensor(HANDS), 0.1)
    # both hands are off by 0.1 m along three axes, a mean with elbows that are not
    expected = 2 * 3 * 0.1**2 / STD**2 / 2 / 2
    found = farther_off(lifted, off, given.joints, known)
    torch.testing.assert_close(found, torch.full((2, 1), expected, dtype=torch.float64))
    torch.testing.assert_close(farther_off(lifted, given.joints, off, known), -found)
    known[..., ELBOWS] = True
    torch.testing.assert_close(farther_off(lifted, off, given.joints, known), 0.0 * found)
