"""Test sequences, scores, and priors kept between runs."""

import math
from dataclasses import replace

import pytest
import torch

from benchmarks._gaps import back_and_forth
from benchmarks._upper_body import score
from benchmarks.ub_people import mean_pose, nearest_neighbour, people, sway
from tests.evaluation.recordings import poses, small_recipe, write_people
from torchpose.camera import PinholeCamera
from torchpose.errors import InputError
from torchpose.evaluation import Report
from torchpose.evaluation import _trials as common
from torchpose.evaluation._trials import (
    TEST_ANGLES,
    TEST_TRANSLATION,
    Estimate,
    cached_prior,
    centred_on_neck,
    draw_picture,
    make_test_set,
    track,
)
from torchpose.skeleton._upper_body import mirror_pose
from torchpose.upper_body._single_poses import default_process_cov

CAMERA = PinholeCamera(525.0, 525.0, 319.5, 239.5)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_people(tmp_path_factory.mktemp("data") / "kinect_utd_mhad")


@pytest.fixture(scope="module")
def prior(data):
    return small_recipe(people(data)[0])


def rotation():
    """Rz(roll) Rx(pitch) Ry(yaw), written out (BL 3)."""
    (cr, cp, cy), (sr, sp, sy) = ([f(a) for a in TEST_ANGLES] for f in (math.cos, math.sin))
    rz = torch.tensor([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    rx = torch.tensor([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    ry = torch.tensor([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    return (rz @ rx @ ry).double()


def test_projection_of_the_test_camera():
    pose = centred_on_neck(poses(5, 0))
    test = make_test_set([pose], CAMERA, 30.0, noise_std=0.0)
    expected = pose @ rotation().T + torch.tensor(TEST_TRANSLATION, dtype=torch.float64)
    torch.testing.assert_close(test.truth3d[0], expected)
    u = 525.0 * expected[..., 0] / expected[..., 2] + 319.5
    torch.testing.assert_close(test.truth2d[0, ..., 0], u)
    torch.testing.assert_close(test.keypoints[0], test.truth2d[0][:, [3, 4, 0, 7]])


def test_noise_has_its_size_and_seed():
    long = [centred_on_neck(poses(400, 0))]
    test = make_test_set(long, CAMERA, 30.0, seed=3)
    noise = test.keypoints - test.truth2d[:, :, [3, 4, 0, 7]]
    assert abs(float(noise.std()) - 3.0) < 5 * 3.0 / math.sqrt(2 * noise.numel())
    again = make_test_set(long, CAMERA, 30.0, seed=3)
    assert torch.equal(again.keypoints, test.keypoints)


def test_a_moving_body_moves_in_camera_axes():
    pose = centred_on_neck(poses(121, 0))
    path = sway(121, 30.0)
    still = make_test_set([pose], CAMERA, 30.0)
    moving = make_test_set([pose], CAMERA, 30.0, paths=[path])
    torch.testing.assert_close(
        moving.truth3d - still.truth3d, path[None, :, None].expand(1, -1, 8, 3)
    )
    torch.testing.assert_close(path[0], path[120])  # once around in 4 s
    assert torch.allclose(path.amax(0), torch.tensor([0.3, 0.0, 0.3]).double(), atol=1e-3)
    assert torch.allclose(path.norm(dim=1), torch.tensor(0.3).double())


def test_sequences_of_different_lengths_are_padded_with_nan():
    test = make_test_set([poses(4, 0), poses(7, 1)], CAMERA, 30.0)
    assert test.lengths.tolist() == [4, 7]
    assert bool(test.truth3d[0, 4:].isnan().all()) and bool(
        test.truth3d[test.inside].isfinite().all()
    )
    broken = poses(4, 0)
    broken[1, 2] = torch.nan
    with pytest.raises(InputError, match="eight joints"):
        make_test_set([broken], CAMERA, 30.0)
    with pytest.raises(InputError, match="at least one"):
        make_test_set([], CAMERA, 30.0)


def test_scores_of_known_errors():
    test = make_test_set([poses(4, 0), poses(7, 1)], CAMERA, 30.0)
    joints = test.truth3d.nan_to_num().clone()
    joints[..., 0, 0] += 0.1  # a hand, on which nothing is aligned
    pixels = test.truth2d.nan_to_num() + torch.tensor([3.0, 4.0], dtype=torch.float64)
    cov = 0.01 * torch.eye(3, dtype=torch.float64).expand(2, 7, 8, 3, 3)
    found = score(Estimate(pixels, joints, cov), test)
    assert int(found.errors3d.isfinite().sum()) == 11 * 8
    means = found.errors3d.flatten(0, 1).nanmean(0)
    torch.testing.assert_close(means, torch.tensor([0.1] + [0.0] * 7).double(), atol=1e-7, rtol=0)
    torch.testing.assert_close(found.errors2d.nanmean(), torch.tensor(5.0).double())
    assert found.coverage is not None
    # 0.1 m is one standard deviation, inside the 50 % ellipsoid (1.54) and all others are at 0
    assert bool((found.coverage.per_joint == 1).all())
    own = test.truth3d[1, :7].diff(n=2, dim=0).norm(dim=-1) * 900
    first = test.truth3d[0, :4].diff(n=2, dim=0).norm(dim=-1) * 900
    torch.testing.assert_close(found.jitter, torch.cat([own, first]).mean(0))


def test_mirrored_poses_change_sides():
    pose = poses(3, 0)
    mirrored = mirror_pose(pose)
    torch.testing.assert_close(mirror_pose(mirrored), pose)
    flipped = pose[:, 0] * torch.tensor([-1.0, 1.0, 1.0])
    torch.testing.assert_close(mirrored[:, 7], flipped)
    torch.testing.assert_close(mirrored[:, 3], pose[:, 3] * torch.tensor([-1.0, 1.0, 1.0]))


def test_nearest_neighbour_and_mean_pose():
    test = make_test_set([centred_on_neck(poses(6, 0))], CAMERA, 30.0, noise_std=0.0)
    joints = torch.cat([test.truth3d[0], test.truth3d[0] + 5])
    uv = torch.cat([test.truth2d[0], test.truth2d[0] + 300])
    found = nearest_neighbour(test, joints, uv, chunk=4)
    torch.testing.assert_close(found.joints3d, test.truth3d)
    torch.testing.assert_close(found.joints2d, test.truth2d)
    mean = mean_pose(test, joints, uv)
    torch.testing.assert_close(mean.joints3d[0, 3], joints.mean(0))
    torch.testing.assert_close(mean.joints2d[:, :, 4], test.keypoints[:, :, 1])


def test_hand_set_noise_is_that_of_the_released_tracker_in_other_pixels(prior):
    process_cov = default_process_cov(prior)
    metres = process_cov[0].sqrt() * prior.left.moments()[0][2:15:3].mean() / prior.info.fx
    released = math.sqrt(560) * 4.5 / 1550 * math.sqrt(25 / 30)
    assert float(metres) == pytest.approx(released, rel=1e-9)
    assert float(process_cov[2]) == pytest.approx(25 / 30)


def test_a_prior_is_fitted_once(data, tmp_path):
    calls = []

    def recipe(recordings, **options):
        calls.append(options)
        return small_recipe(recordings, 2, **options)

    train, _ = people(data)
    first = cached_prior(tmp_path, train[:2], recipe, False, seed=0)
    again = cached_prior(tmp_path, train[:2], recipe, False, seed=0)
    assert len(calls) == 1
    torch.testing.assert_close(first.left.means, again.left.means)
    assert again.noise.keys() == first.noise.keys()
    cached_prior(tmp_path, train[:2], recipe, False, seed=1)
    cached_prior(tmp_path, train[1:3], recipe, False, seed=0)
    cached_prior(tmp_path, [replace(r, fps=15.0) for r in train[:2]], recipe, False, seed=0)
    half = torch.full((len(train[0]), len(train[0].names)), 0.5, dtype=torch.float64)
    weighed = [replace(train[0], weights=half), train[1]]
    cached_prior(tmp_path, weighed, recipe, False, seed=0)
    assert len(calls) == 5
    for path in tmp_path.glob("prior-*.safetensors"):
        path.write_bytes(path.read_bytes()[:100])
    cached_prior(tmp_path, train[:2], recipe, False, seed=0)
    assert len(calls) == 6


def test_tracking_in_chunks_changes_nothing(prior):
    test = make_test_set([centred_on_neck(poses(n, n)) for n in (12, 9, 15)], CAMERA, 30.0)
    whole = track(prior, CAMERA, test)
    parts = track(prior, CAMERA, test, chunk=1)
    inside = test.inside
    for a, b in zip(whole, parts, strict=True):
        torch.testing.assert_close(a[inside], b[inside], rtol=1e-9, atol=1e-9)


def test_back_and_forth_keeps_speeds():
    place = back_and_forth(5, 23)
    assert int(place.max()) == 4 and bool((place.diff().abs() == 1).all())
    assert back_and_forth(1, 3).tolist() == [0, 0, 0]


def test_without_matplotlib_the_report_says_what_is_missing(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(common, "find_spec", lambda name: None)
    report = Report("Protocol")
    draw_picture(report, tmp_path, "persons.png", lambda: pytest.fail("nothing can be drawn"))
    assert report.pictures == []
    assert report.findings == ["persons.png was not drawn: matplotlib is not installed."]
