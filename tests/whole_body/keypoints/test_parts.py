"""Parts of tracking by keypoints against finite differences, dense algebra and exact geometry."""

import math

import pytest
import torch

import torchpose
from tests.priors.motions import some_body_motion
from tests.whole_body.keypoints.scenes import ring, scene
from torchpose.body import BODY_15, Body
from torchpose.body._articulation import Articulation, BodyPoint
from torchpose.priors._shipped import load_body_motion
from torchpose.whole_body._keypoints.adapted_noise import AdaptedNoise
from torchpose.whole_body._keypoints.body_kalman import BodyGaussian, BodyKalmanFilter
from torchpose.whole_body._keypoints.body_transition import coasting_transition, transition
from torchpose.whole_body._keypoints.joint_triangulation import triangulate
from torchpose.whole_body._keypoints.keypoint_likelihood import (
    Beliefs,
    KeypointFrame,
    RigMaps,
    exchange_of,
    information,
    readings_of,
    see,
    weigh,
)
from torchpose.whole_body._keypoints.known_person import (
    of_one_camera,
    with_body,
    with_height,
    with_usual_trunk,
)
from torchpose.whole_body._keypoints.upright import camera_up

J = BODY_15.joint


@pytest.fixture(scope="module")
def motion():
    return load_body_motion("whole-body")


def random_point(articulation: Articulation, count: int = 2, seed: int = 0) -> BodyPoint:
    generator = torch.Generator().manual_seed(seed)
    n_parts = len(articulation.skeleton.parts)
    zero = torch.zeros(count, articulation.n_pose, dtype=torch.float64)
    rest = BodyPoint(
        zero[:, :3],
        torch.eye(3, dtype=torch.float64).expand(count, n_parts, 3, 3),
        zero,
        zero[:, : len(articulation.groups)],
        zero.new_zeros(count, len(articulation.shifted), 3),
    )
    step = 0.3 * torch.randn(count, articulation.dim, generator=generator, dtype=torch.float64)
    return articulation.moved(rest, step)


def frame_of(given, t: int = 0) -> KeypointFrame:
    one = torch.ones_like(given.confidence[t : t + 1])
    return KeypointFrame(given.keypoints[t : t + 1], 16 * one, 0 * one, 0.9 * one)


def test_the_lean_has_the_slope_of_differences():
    body, upright = Articulation(), camera_up(ring(1))
    point, lean = random_point(body), None
    lean = upright.lean(body, point)
    for column in range(body.dim):
        step = torch.zeros(2, body.dim, dtype=torch.float64)
        step[:, column] = 1e-6
        ahead, behind = (upright.lean(body, body.moved(point, s)).gap for s in (step, -step))
        slope = (behind - ahead) / 2e-6  # of the lean, which the gap takes away
        torch.testing.assert_close(lean.jacobian[..., column], slope, rtol=0, atol=1e-8)


def test_what_cameras_see_has_the_slope_of_differences():
    maps, joints = RigMaps.of(ring(3)), scene(3, 1).joints
    seen = see(maps, joints)
    for axis in range(3):
        step = torch.zeros_like(joints)
        step[..., axis] = 1e-6
        slope = (see(maps, joints + step).pixels - see(maps, joints - step).pixels) / 2e-6
        torch.testing.assert_close(seen.by_joint[..., axis], slope, rtol=1e-6, atol=1e-5)


def test_exact_keypoints_are_triangulated_exactly_and_outliers_left_out():
    given = scene(4, 1, noise=0.0)
    keypoints = given.keypoints.clone()
    keypoints[0, 2, J("left_wrist")] += 300.0
    keypoints[0, 0, J("head")] -= 500.0
    found = triangulate(RigMaps.of(given.rig), frame_of(given._replace(keypoints=keypoints)))
    torch.testing.assert_close(found, given.joints[:1], rtol=0, atol=1e-6)


def test_a_joint_that_one_camera_sees_is_not_triangulated():
    given = scene(3, 1)
    frame = frame_of(given)
    frame.inlier[0, 1:, J("left_knee")] = 0
    found = triangulate(RigMaps.of(given.rig), frame)
    assert found[0, J("left_knee")].isnan().all() and found[0, J("right_knee")].isfinite().all()


def test_one_iteration_is_the_dense_kalman_update(motion):
    """The same posterior as of all pixels stacked, R weighted by the inlier probabilities."""
    given = scene(3, 1)
    maps, body = RigMaps.of(given.rig), motion.articulation
    point = random_point(body, 1)
    point = point._replace(position=torch.zeros(1, 3, dtype=torch.float64))
    generator = torch.Generator().manual_seed(1)
    root = torch.randn(body.dim, body.dim, generator=generator, dtype=torch.float64)
    cov = (root @ root.mT * 1e-3 + 1e-3 * torch.eye(body.dim, dtype=torch.float64))[None]
    new = point.position.new_full
    of_cameras = new((1, 3), 1.0)
    state = BodyGaussian(
        point, cov, new((1, 3, 2), -50.0), of_cameras, new((1, 15), -5.0), of_cameras,
        new((1, 15, 3), torch.nan), AdaptedNoise.usual(new((1, 45), 0.0)),
    )  # fmt: skip
    frame = frame_of(given)
    found = BodyKalmanFilter(motion, given.rig, 30.0).correct(state, frame, (1.0,))

    joints, jacobian = body.linearise(point)
    seen = see(maps, joints)
    spread = jacobian @ cov[:, None] @ jacobian.mT
    exchange = exchange_of(BODY_15, torch.device("cpu"))
    readings = readings_of(frame, exchange)
    weighed = weigh(readings, seen, maps, state.beliefs, exchange, spread, marginal=True)
    H = torch.einsum("bcjik,bjkn->bcjin", seen.by_joint, jacobian).reshape(-1, body.dim)
    weight = (weighed.own / weighed.variance)[..., None].expand(-1, -1, -1, 2).reshape(-1)
    residual = (frame.pixels - seen.pixels).reshape(-1)
    precision = torch.linalg.inv(cov[0]) + H.mT @ (weight[:, None] * H)
    dense = torch.linalg.inv(precision)
    step = dense @ H.mT @ (weight * residual)
    torch.testing.assert_close(found.state.cov[0], dense, rtol=1e-5, atol=1e-9)
    moved = body.joints(body.moved(point, step[None]))
    torch.testing.assert_close(found.joints, moved, rtol=0, atol=1e-6)
    W, _ = information(readings, seen, weighed)
    assert (torch.linalg.eigvalsh(W) >= -1e-6).all()


def test_keypoints_of_joints_behind_a_camera_are_outliers():
    given = scene(2, 1)
    frame, maps = frame_of(given), RigMaps.of(given.rig)
    exchange = exchange_of(BODY_15, torch.device("cpu"))
    behind = given.joints - 1.4 * given.rig.rotation[0].T @ given.rig.translation[0]
    seen = see(maps, behind)
    assert not seen.in_front[:, 0].any() and seen.in_front[:, 1].all()
    beliefs = Beliefs(torch.full((1, 2, 2), -6.0).double(), torch.ones(1, 2).double())
    weighed = weigh(readings_of(frame, exchange), seen, maps, beliefs, exchange)
    outlier = math.log(0.1 / (1920 * 1080 / 4))
    assert torch.allclose(weighed.log_joint[:, 0], torch.tensor(outlier).double())
    assert (weighed.own[:, 0] == 0).all() and (weighed.other[:, 0] == 0).all()
    off = weigh(readings_of(frame, exchange), see(maps, given.joints + 1), maps, beliefs, exchange)
    assert weighed.log_evidence < off.log_evidence + 1e-6


@pytest.mark.parametrize("coasting", [False, True])
def test_a_prediction_in_two_halves_is_one(motion, coasting):
    up = torch.tensor([0.6, 0.8, 0.0], dtype=torch.float64)
    whole, half = (
        coasting_transition(motion, dt, up) if coasting else transition(motion, dt)
        for dt in (0.04, 0.02)
    )
    torch.testing.assert_close(half.matrix @ half.matrix, whole.matrix, rtol=1e-10, atol=1e-12)
    noise = half.matrix @ half.noise @ half.matrix.mT + half.noise
    torch.testing.assert_close(noise, whole.noise, rtol=1e-8, atol=1e-14)


def test_only_the_horizontal_motion_of_whom_nobody_sees_goes_on():
    motion = some_body_motion()
    body = motion.articulation
    point = random_point(body)._replace(velocity=torch.ones(2, body.n_pose).double())
    filter = BodyKalmanFilter(motion, ring(2), 30.0, up="y")
    model = filter.transition_of(torch.tensor([False, True]))
    usual, (seen, unseen) = (
        body.difference(one.ahead(motion, point).mean, point) for one in (filter.transition, model)
    )
    torch.testing.assert_close(seen, usual[0])
    x, y, z = unseen[body.columns["position"]]
    assert float(x) == pytest.approx(1 / 30, rel=0.01) and float(z) == pytest.approx(float(x))
    assert float(x) > 1.05 * float(y)
    rest = torch.ones(body.dim, dtype=torch.bool)
    rest[body.columns["position"]] = rest[body.columns["velocity"]] = False
    torch.testing.assert_close(unseen[rest], usual[1, rest])
    assert float(y) == pytest.approx(float(usual[1, 1]))
    assert model.driven[0].any() and not model.driven[1].any()


def test_a_usual_trunk_is_the_prior_given_what_is_usual():
    """By the density of the joint Gaussian of lengths and of what trunks are against arms."""
    motion = load_body_motion("whole-body")
    usual, groups = with_usual_trunk(motion), motion.articulation.groups
    information = torch.linalg.inv(motion.scale_cov)
    pull = information @ motion.scale_mean
    for bone, other, mean, std in (("neck", "elbow", 0.05, 0.06), ("hip", "shoulder", 0.02, 0.08)):
        h = torch.zeros_like(motion.scale_mean)
        h[groups.index(bone)], h[groups.index(other)] = 1, -1
        information = information + h[:, None] * h / std**2
        pull = pull + h * mean / std**2
    torch.testing.assert_close(usual.scale_cov, torch.linalg.inv(information))
    torch.testing.assert_close(usual.scale_mean, torch.linalg.solve(information, pull))


def test_a_usual_trunk_hardly_changes_a_known_person():
    known = with_body(load_body_motion("whole-body"), Body.of_height(BODY_15, 1.7))
    usual = with_usual_trunk(known)
    assert float((usual.scale_mean - known.scale_mean).abs().max()) < 0.01


def test_a_height_tells_the_legs(motion):
    tall = with_height(motion, 2.0)
    body = motion.articulation
    legs = [body.groups.index(name) for name in ("knee", "ankle")]
    wanted = body.scales_of(BODY_15.standard_lengths(2.0))[legs].mean()
    assert float((tall.scale_mean[legs].mean() - wanted).abs()) < 0.03
    before, after = (m.scale_cov.diagonal()[legs] for m in (motion, tall))
    assert (after < before).all()
    assert (torch.linalg.eigvalsh(tall.scale_cov) > 0).all()


def test_one_camera_fixes_the_legs_and_leaves_the_prior_alone(motion):
    before = motion.scale_cov.clone()
    one = of_one_camera(motion)
    names = motion.articulation.groups
    legs = torch.tensor([0.5 * (name in ("knee", "ankle")) for name in names]).double()
    assert float(legs @ one.scale_cov @ legs) <= 0.0101**2
    std, usual = one.scale_cov.diagonal().sqrt(), motion.scale_cov.diagonal().sqrt()
    assert (std < usual).all()
    assert float(std[names.index("hip")]) > 0.1
    assert (torch.linalg.eigvalsh(one.scale_cov) > 0).all()
    torch.testing.assert_close(motion.scale_cov, before)


def test_where_legs_are_has_the_slope_of_differences():
    """In axes of the shoulders, which stay while knees and ankles move."""
    body, upright = Articulation(), camera_up(ring(1))
    point, parts = random_point(body), body.skeleton.parts
    limbs = [parts.index(f"{side}_{n}") for side in ("left", "right") for n in ("thigh", "shank")]
    turns = [i for i, part in enumerate(body.axis_part.tolist()) if part in limbs]
    legs = upright.legs(body, point)
    for column in (body.columns["rotations"].start + i for i in turns):
        step = torch.zeros(body.dim, dtype=torch.float64)
        step[column] = 1e-6
        ahead, behind = (upright.legs(body, body.moved(point, s)).gap for s in (step, -step))
        slope = (behind - ahead) / 2e-6
        torch.testing.assert_close(legs.jacobian[..., column], slope, rtol=0, atol=1e-8)


def test_trunks_are_expected_upright_whatever_the_pelvis_does():
    body, upright = Articulation(), camera_up(ring(1))
    point = random_point(body)
    lean = upright.trunk_lean(body, point)
    joints = body.joints(point)
    pairs = [[body.skeleton.joint(f"{side}_{n}") for side in ("left", "right")]
             for n in ("shoulder", "hip")]  # fmt: skip
    trunk = joints[..., pairs[0], :].mean(-2) - joints[..., pairs[1], :].mean(-2)
    sine = (lean.gap.square().sum(-1)).sqrt()
    upward = (trunk @ upright.direction) / trunk.norm(dim=-1)
    torch.testing.assert_close(sine.square() + upward.square(), torch.ones_like(sine))


def test_who_bends_far_is_expected_upright_with_less_force():
    """The variance of the lean grows with the square of the gap, as that of a t distribution does."""
    body, upright = Articulation(), camera_up(ring(1))
    lean = upright.lean(body, random_point(body, 20))
    far = (lean.gap.square() / upright.variance).sum(-1)
    order = far.argsort()
    grown = (lean.variance / upright.variance)[order]
    assert float(far.max()) > 20 > 1 > float(far.min())
    assert (grown.diff(dim=0) > 0).all()
    assert float(grown[0, 0]) < 1 < float(grown[-1, 0])


def test_constants_move_with_the_filter(motion):
    tracker = torchpose.BodyTracker(ring(1), "kalman", motion=motion)
    filter = tracker.by_keypoints.tracker.filter
    assert filter.maps.matrix.device.type == "cpu"
    tracker.to("meta")
    found = [*filter.maps, *filter.upright, *filter.exchange, *tracker.buffers()]
    assert len(found) > 20 and {t.device.type for t in found} == {"meta"}
