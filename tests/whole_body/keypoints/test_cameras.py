"""Delays and poses of cameras from the keypoints of a person: found, left alone, said, and refused."""

import copy
import math
import re

import pytest
import torch

from tests.whole_body.keypoints.scenes import (
    FPS,
    Scene,
    camera_at,
    errors,
    kalman,
    moving_body,
    noisy,
    ring,
    scene,
    seen_by,
)
from torchpose.camera import CameraRig
from torchpose.errors import CameraError, InputError, ShapeError
from torchpose.math._rotations import cross_matrix, rotvec_to_matrix
from torchpose.whole_body import BodyTrack, BodyTracker
from torchpose.whole_body._keypoints.camera_bundle import CameraErrors, by_pose, corrected_pose
from torchpose.whole_body._keypoints.camera_refinement import DELAY, _corrected
from torchpose.whole_body._keypoints.coarse_delays import coarse_delays, shifted, shifted_flags
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame

T = 24
TURN = (0.6, -0.7, 0.4)  # direction of a rotation, and of a shift
SHIFT = (-0.5, 0.5, 0.7)


def filmed(delays=(0.0, 0.0, 0.0), noise: float = 3.0, seed: int = 0) -> Scene:
    """A person in cameras that began too early by so many frames."""
    rig = ring(len(delays))
    seen = [moving_body(T, phase=-delay / FPS) for delay in delays]
    pixels = torch.stack([rig(j).pixels[:, c] for c, j in enumerate(seen)], 1)
    pixels = noisy(pixels, noise, seed)
    return Scene(seen[0], rig, pixels, torch.full_like(pixels[..., 0], 0.9))


def disturbed(rig: CameraRig, camera: int, degrees: float, metres: float) -> CameraRig:
    values = CameraErrors.none(rig).values
    unit = [torch.tensor(v, dtype=torch.float64) / math.hypot(*v) for v in (TURN, SHIFT)]
    values[camera, :3], values[camera, 3:DELAY] = math.radians(degrees) * unit[0], metres * unit[1]
    return _corrected(rig, values)


def track(given: Scene, rig=None, **options):
    return kalman(given.rig if rig is None else rig)(
        keypoints=given.keypoints, confidence=given.confidence, smoothing="full", **options
    )


def mean_error(found, given: Scene) -> float:
    return float(errors(found, given.joints)[8:-8].mean())


@pytest.fixture(scope="module")
def late():
    """Cameras that began 3 and 1.5 frames too early."""
    return filmed((0.0, 3.0, 1.5))


@pytest.fixture(scope="module")
def right():
    return filmed()


@pytest.fixture(scope="module")
def tracked(right):
    return track(right)


@pytest.fixture(scope="module")
def in_step(late):
    return track(late, refine="delays")


# --- delays -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_delays_are_found(late, in_step):
    found = in_step
    delays, std = found.details["camera_delays"], found.details["camera_errors_std"][..., DELAY]
    assert delays.shape == (T, 3)
    torch.testing.assert_close(
        delays[0], torch.tensor([0.0, 3.0, 1.5], dtype=torch.float64), atol=0.2, rtol=0
    )
    assert (std[0, 1:] > 0).all() and (std[0, 1:] < 0.3).all()
    assert mean_error(found, late) < 0.01
    assert any("c1 began 3.0" in note and "earlier than c0" in note for note in found.notes)


def test_whole_frames_are_found_from_pairs_of_cameras():
    given = filmed((0.0, 5.0, -4.0), noise=1.0)
    ones = given.confidence
    frames = KeypointFrame(given.keypoints, ones, 0 * ones, ones)
    assert coarse_delays(given.rig, frames, 8).tolist() == [0, 5, -4]
    moved, by = shifted(frames, torch.tensor([0, 5, -4]))
    assert by[10].tolist() == [0, 5, -4] and by[-1].tolist() == [0, 0, -4]
    torch.testing.assert_close(moved.pixels[10, 1], given.keypoints[15, 1])
    assert not moved.inlier[-5:, 1].any() and moved.inlier[:-5, 1].all()
    assert not moved.inlier[:4, 2].any()


# --- poses ------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("undoubted_here")
def test_a_turned_and_shifted_camera_is_corrected(right, tracked):
    rig = disturbed(right.rig, 1, 1.0, 0.03)
    wrong, best = track(right, rig), tracked
    found = track(right, rig, refine="extrinsics")
    assert mean_error(found, right) < 0.6 * mean_error(wrong, right)
    apart = [_apart_of_one_motion(x.joints3d, right.joints) for x in (found, best, wrong)]
    assert apart[0] < apart[1] + 0.0003 < apart[2]
    turned = rotvec_to_matrix(found.details["camera_rotation"][0]) @ right.rig.rotation.mT
    angle = torch.rad2deg(torch.arccos(((turned[1].trace() - 1) / 2).clamp(-1, 1)))
    assert float(angle) < 0.6


def _apart_of_one_motion(joints, truth) -> float:
    """Mean distance after one rigid motion of the whole recording, by orthogonal Procrustes."""
    a, b = joints.reshape(-1, 3), truth.reshape(-1, 3)
    middle = a.mean(0), b.mean(0)
    u, _, vt = torch.linalg.svd((a - middle[0]).T @ (b - middle[1]))
    flip = torch.diag(torch.tensor([1.0, 1.0, float(torch.det(u @ vt))], dtype=a.dtype))
    return float(((a - middle[0]) @ (u @ flip @ vt) + middle[1] - b).norm(dim=-1).mean())


def test_derivatives_by_poses_are_those_of_differences(right):
    joints, rig = right.joints[:2], right.rig
    derivative = by_pose(rig, joints)
    for k in range(DELAY):
        values = CameraErrors.none(rig).values
        values[:, k] = 1e-6
        step = _corrected(rig, values)(joints).pixels - rig(joints).pixels
        torch.testing.assert_close(derivative[..., k], step / 1e-6, atol=1e-2, rtol=1e-4)


def test_a_rotation_leaves_a_camera_in_its_place(right):
    values = CameraErrors.none(right.rig).values
    values[:, :3] = torch.tensor(TURN, dtype=torch.float64)
    rotation, translation = corrected_pose(right.rig, values)
    places = [-(R.mT @ t[..., None]) for R, t in ((rotation, translation),
                                                  (right.rig.rotation, right.rig.translation))]  # fmt: skip
    torch.testing.assert_close(*places)
    small = torch.eye(3, dtype=torch.float64) + 1e-6 * cross_matrix(values[0, :3])
    torch.testing.assert_close(rotvec_to_matrix(1e-6 * values[0, :3]), small)


@pytest.mark.slow
@pytest.mark.usefixtures("undoubted_here")
def test_poses_stay_as_given_where_delays_explain_all(late, in_step):
    found = track(late, refine="both")
    given = late.rig.translation
    torch.testing.assert_close(found.details["camera_translation"][0], given, atol=1e-12, rtol=0)
    torch.testing.assert_close(found.details["camera_delays"], in_step.details["camera_delays"])
    assert mean_error(found, late) < 0.01
    assert any("poses as given" in note for note in found.notes)
    assert not any("was turned by" in note for note in found.notes)


@pytest.mark.slow
@pytest.mark.usefixtures("undoubted_here")
def test_a_camera_that_is_left_out_since_it_is_late_is_used_again():
    rig, seen = ring(3), [jumping(-delay / FPS) for delay in (0, 8, 0)]
    pixels = torch.stack([rig(joints).pixels[:, c] for c, joints in enumerate(seen)], 1)
    given = Scene(seen[0], rig, pixels + 1.0, torch.full_like(pixels[..., 0], 0.9))
    before, found = track(given), track(given, refine="delays")
    assert any("camera c1 was left out" in note for note in before.notes)
    assert not any("was left out" in note for note in found.notes)
    assert float(found.details["inlier"][2:-10, 1].mean()) > 0.9
    assert float(found.details["camera_delays"][0, 1]) == pytest.approx(8.0, abs=0.2)


def jumping(phase: float) -> torch.Tensor:
    """Joints [36, 15, 3] of a person who jumps about."""
    t = torch.arange(36, dtype=torch.float64) / FPS + phase
    way = torch.stack([(4.4 * t).sin(), (6.3 * t).sin().abs(), (4.4 * t).cos()], -1)
    return moving_body(36, phase=phase) + 0.8 * way[:, None]


def test_flags_are_moved_as_their_frames_are():
    flags = torch.zeros(8, 2, dtype=torch.bool)
    flags[5:7, 1] = True
    moved = shifted_flags(flags, torch.tensor([0, 3]))
    assert moved[:, 1].nonzero().flatten().tolist() == [2, 3] and not moved[:, 0].any()


# --- what is right, and what nobody asked for ---------------------------------------------------------


@pytest.mark.slow
def test_right_cameras_stay_and_nothing_is_said(right, tracked):
    found = track(right, refine="both")
    assert not found.details["camera_delays"].any()
    torch.testing.assert_close(
        found.details["camera_translation"][0], right.rig.translation, atol=1e-12, rtol=0
    )
    torch.testing.assert_close(found.joints3d, tracked.joints3d)
    assert any("cameras as given" in note for note in found.notes)
    assert not any("seems" in note or "degrees" in note for note in found.notes)
    assert not tracked.notes


def test_notes_say_what_was_not_asked_for(right):
    late = track(filmed((0.0, 0.0, 2.0))).notes
    assert len(late) == 1 and "camera c2 seems to have begun" in late[0]
    assert "earlier than c0" in late[0] and "--refine delays" in late[0]
    turned = track(right, disturbed(right.rig, 1, 1.5, 0.02)).notes
    assert (
        len(turned) == 1 and "camera c1 (by 1." in turned[0] and "--refine extrinsics" in turned[0]
    )


@pytest.mark.parametrize("refine", ["none", pytest.param("extrinsics", marks=pytest.mark.slow)])
def test_no_other_reading_is_looked_for_where_turned_or_refined_cameras_agree(
    right, monkeypatch, refine
):
    """By chance another convention of a camera may explain keypoints better than its wrong calibration."""
    given = "torchpose.whole_body._keypoints.track_builder"
    for name in ("notes_on_one_camera", "notes_on_order"):
        monkeypatch.setattr(f"{given}.{name}", lambda *_: ("another reading",))
    rig = disturbed(right.rig, 1, 1.5, 0.12)
    assert "another reading" not in track(right, rig, refine=refine).notes


@pytest.mark.slow
def test_notes_do_not_ask_for_what_was_refined(right):
    """Delays that are estimated with wrong poses are wrong: both are to be."""
    notes = track(right, disturbed(right.rig, 1, 1.5, 0.02), refine="delays").notes
    assert "--refine both" in " ".join(notes) and "--refine delays" not in " ".join(notes), notes


def test_a_refined_track_is_saved_and_read(in_step, tmp_path):
    in_step.save(tmp_path / "body.npz")
    again = BodyTrack.load(tmp_path / "body.npz")
    torch.testing.assert_close(
        again.details["camera_delays"].double(), in_step.details["camera_delays"]
    )


@pytest.mark.usefixtures("undoubted_here")
def test_a_single_frame_and_a_blind_camera_leave_cameras_as_given(right):
    tracker = kalman(right.rig)
    one = tracker(keypoints=right.keypoints[:1], refine="both")
    assert any("cameras as given" in note for note in one.notes)
    blind = right.keypoints[:3].clone()
    blind[:, 2] = torch.nan
    found = tracker(keypoints=blind, refine="both")
    assert not found.details["camera_delays"][:, 2].any()
    assert float(found.details["camera_errors_std"][0, 2, DELAY]) == pytest.approx(0.2 * FPS)


def test_what_cannot_be_refined_is_refused(right):
    one = kalman(right.rig.select([0]))
    with pytest.raises(InputError, match="needs two or more, got one"):
        one(keypoints=right.keypoints[:, :1], refine="both")
    several = kalman(right.rig)
    with pytest.raises(ShapeError, match="one recording"):
        several(keypoints=right.keypoints[None], refine="both")
    with pytest.raises(InputError, match="refine"):
        several(keypoints=right.keypoints, refine="all")


@pytest.mark.usefixtures("undoubted_here")
def test_cameras_that_are_all_turned_a_little_are_used_together():
    given = scene(4, n_frames=12)
    generator = torch.Generator().manual_seed(1)
    axes = torch.randn(4, 3, generator=generator, dtype=torch.float64)
    turns = rotvec_to_matrix(math.radians(1.0) * torch.nn.functional.normalize(axes, dim=-1))
    given.rig.rotation.copy_(turns @ given.rig.rotation)
    given.rig.translation.copy_((turns @ given.rig.translation[..., None]).squeeze(-1))
    found = track(given)
    assert found.details["inlier"].mean((0, 2)).min() > 0.9
    assert float(errors(found, given.joints).mean()) < 0.04  # 7 cm off in each camera


# --- units ------------------------------------------------------------------------------------------


def scaled(rig, factor):
    rig = copy.copy(rig)
    rig._buffers = {**dict(rig.named_buffers()), "translation": factor * rig.translation}
    return rig


@pytest.mark.parametrize("factor", [40.0, 3.28, 0.1])  # within 200 m, in feet, of no scale
def test_cameras_in_other_units_are_refused_with_their_factor(factor):
    given = scene(2, 10, noise=6.0)
    tracker = kalman(scaled(given.rig, factor))
    with pytest.raises(CameraError, match="in metres, but with these cameras") as told:
        tracker(keypoints=given.keypoints)
    found = float(re.search(r"about (\S+) times", str(told.value))[1])
    assert found == pytest.approx(factor, rel=0.15)


@pytest.mark.parametrize("method", ["sir", "kalman"])
def test_cameras_in_feet_are_refused_by_particles_and_for_several_persons(method):
    given = scene(3, 20)
    tracker = BodyTracker(scaled(given.rig, 3.28), method, fps=FPS)
    several = {"persons": "all", "keypoints": given.keypoints[:, :, None]}
    with pytest.raises(CameraError, match="in metres, but with these cameras"):
        tracker(**(several if method == "kalman" else {"keypoints": given.keypoints}))


@pytest.mark.usefixtures("undoubted_here")
@pytest.mark.parametrize(
    "height, distance, apart", [(0.65, 4.0, 1.5), (2.15, 4.0, 1.5), (1.7, 4.0, 0.01)]
)
def test_small_and_tall_people_and_cameras_side_by_side_are_in_metres(height, distance, apart):
    rig = CameraRig([camera_at(0.6 + i * apart, distance, f"c{i}") for i in range(2)])
    assert len(track(seen_by(rig, moving_body(6, height), 3.0))) == 6
