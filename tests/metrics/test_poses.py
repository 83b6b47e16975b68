"""Metrics against scipy, brute force, Monte Carlo and cases worked out by hand."""

import importlib
import math
import sys

import numpy as np
import pytest
import scipy.stats
import torch
from scipy.spatial.transform import Rotation

from torchpose import metrics
from torchpose.errors import InputError, MissingDependencyError, ShapeError
from torchpose.metrics._calibration import chi2_cdf, chi2_quantile
from torchpose.metrics._pose_errors import share_below


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def random_rotations(n: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(Rotation.random(n, random_state=seed).as_matrix())


# --- Procrustes -----------------------------------------------------------------------------------


@pytest.mark.parametrize("n_points", [3, 4, 8])
def test_procrustes_agrees_with_scipy(n_points: int) -> None:
    source, target = normal(20, n_points, 3, seed=1), normal(20, n_points, 3, seed=2)
    motion = metrics.procrustes(source, target)
    for s, x, rotation, translation in zip(source, target, *motion, strict=True):
        best, _ = Rotation.align_vectors((x - x.mean(0)).numpy(), (s - s.mean(0)).numpy())
        np.testing.assert_allclose(rotation.numpy(), best.as_matrix(), atol=1e-9)
        expected = x.mean(0) - rotation @ s.mean(0)
        torch.testing.assert_close(translation, expected)


def test_procrustes_recovers_a_rigid_motion_and_keeps_the_scale() -> None:
    source, rotation, shift = normal(5, 7, 8, 3), random_rotations(35).reshape(5, 7, 3, 3), 3.0
    motion = metrics.procrustes(source, source @ rotation.mT + shift)
    torch.testing.assert_close(motion.rotation, rotation)
    torch.testing.assert_close(motion.translation, torch.full((5, 7, 3), shift).double())
    twice = metrics.procrustes(source, 2 * source)
    torch.testing.assert_close(twice.rotation, torch.eye(3).double().expand(5, 7, 3, 3))


def test_procrustes_never_reflects() -> None:
    source = normal(50, 8, 3)
    mirrored = source * torch.tensor([-1.0, 1.0, 1.0])
    torch.testing.assert_close(
        torch.linalg.det(metrics.procrustes(source, mirrored).rotation), torch.ones(50).double()
    )
    flat = source.clone()
    flat[..., 2] = 0  # coplanar, as head, neck and shoulders nearly are
    turned = flat @ random_rotations(50).mT
    torch.testing.assert_close(metrics.align(flat, turned, joints=None).points, turned)


def test_procrustes_beats_rotations_nearby() -> None:
    source, target = normal(8, 3, seed=3), normal(8, 3, seed=4)
    motion = metrics.procrustes(source, target)

    def cost(rotation: torch.Tensor) -> torch.Tensor:
        moved = (source - source.mean(0)) @ rotation.mT + target.mean(0)
        return (moved - target).square().sum((-2, -1))

    others = torch.cat([random_rotations(2000), random_rotations(500, seed=1)])
    near = torch.from_numpy(Rotation.from_rotvec(0.02 * normal(500, 3).numpy()).as_matrix())
    assert cost(motion.rotation) <= cost(torch.cat([others, near @ motion.rotation])).min()


def test_procrustes_leaves_out_missing_points_and_marks_hopeless_frames() -> None:
    source, target = normal(3, 6, 3), normal(3, 6, 3, seed=1)
    expected = metrics.procrustes(source[:, 2:], target[:, 2:])
    holed = source.clone()
    holed[:, 0] = math.nan
    mask = torch.tensor([True, False, True, True, True, True]).expand(3, 6)
    motion = metrics.procrustes(holed, target, mask)
    torch.testing.assert_close(motion.rotation, expected.rotation)
    holed[1, :4] = math.nan
    motion = metrics.procrustes(holed, target)
    assert motion.rotation[1].isnan().all() and motion.translation[1].isnan().all()
    assert torch.isfinite(motion.rotation[[0, 2]]).all()


def test_align_uses_the_chosen_joints_and_turns_covariances() -> None:
    truth, rotation = normal(4, 8, 3), random_rotations(4)
    estimate = (truth - 1) @ rotation
    estimate[:, 0] += 0.5  # a hand, which must not disturb the alignment
    root = normal(4, 8, 3, 3, seed=5)
    covariance = root @ root.mT + torch.eye(3)
    moved = metrics.align(estimate, truth, covariance=covariance)
    torch.testing.assert_close(moved.points[:, 1:], truth[:, 1:])
    turn = rotation[:, None]
    torch.testing.assert_close(moved.covariance, turn @ covariance @ turn.mT)
    errors = metrics.joint_errors_3d(estimate, truth)
    assert errors[:, 1:].max() < 1e-9
    torch.testing.assert_close(errors[:, 0], torch.full((4,), 0.5 * math.sqrt(3)).double())
    plain = metrics.joint_errors_3d(estimate, truth, procrustes=False)
    torch.testing.assert_close(plain, (estimate - truth).norm(dim=-1))


# --- errors ---------------------------------------------------------------------------------------


def test_errors_and_their_summary_leave_out_what_is_missing() -> None:
    truth = torch.zeros(2, 2, 2)
    estimate = torch.tensor([[[3.0, 4.0], [0.0, 1.0]], [[math.nan, 0.0], [0.0, 3.0]]])
    errors = metrics.joint_errors_2d(estimate, truth)
    assert errors[0].tolist() == [5.0, 1.0]
    assert errors[1, 0].isnan()
    summary = metrics.summarise_errors(errors)
    assert summary.mean == 3.0  # (5 + 1 + 3) / 3: pooled, not a mean of means
    assert summary.per_joint.tolist() == [5.0, 2.0]
    assert summary.std.tolist() == [0.0, 1.0]
    assert summary.counts.tolist() == [1, 2]
    assert summary.median.tolist() == [5.0, 2.0]
    mask = torch.tensor([[True, True], [True, False]])
    assert metrics.summarise_errors(metrics.joint_errors(estimate, truth, mask)).mean == 3.0
    share, count = share_below(errors, 2.0)
    assert share.tolist() == [0.0, 0.5]
    assert count.tolist() == [1, 2]


def test_what_is_missing_has_no_gradient() -> None:
    truth = torch.rand(4, 8, 3, dtype=torch.float64)
    truth[0, 2], mask = torch.nan, torch.ones(4, 8, dtype=torch.bool)
    mask[1] = False
    estimate = torch.rand(4, 8, 3, dtype=torch.float64, requires_grad=True)
    metrics.joint_errors(estimate, truth, mask=mask).nanmean().backward()
    assert estimate.grad is not None and bool(estimate.grad.isfinite().all())
    assert not estimate.grad[1].any() and not estimate.grad[0, 2].any()
    assert bool((estimate.grad[2] != 0).all())


@pytest.mark.parametrize(
    "measured",
    [metrics.joint_errors, metrics.joint_errors_3d, lambda x, _: metrics.jitter(x, 30.0)],
)
def test_missing_joints_leave_no_trace_in_gradients_of_others(measured) -> None:
    estimate, truth = normal(6, 8, 3).requires_grad_(), normal(6, 8, 3, seed=1)
    gone = torch.zeros(6, 8, dtype=torch.bool)
    gone[0, 3], gone[1, :6] = True, True  # the head, and all but two
    measured(estimate.masked_fill(gone[..., None], torch.nan), truth).nansum().backward()
    assert estimate.grad is not None and bool(estimate.grad.isfinite().all())
    assert not estimate.grad[gone].any()
    alone = estimate[2:].detach().requires_grad_()
    measured(alone, truth[2:]).sum().backward()
    assert alone.grad is not None
    torch.testing.assert_close(estimate.grad[2:, :6], alone.grad[:, :6])


@pytest.mark.parametrize("n_frames", [1, 6, 7])
def test_the_median_is_that_of_numpy_and_infinite_errors_count(n_frames: int) -> None:
    errors = normal(n_frames, 5).abs()
    errors[0, 1] = errors[:, 4] = math.nan
    errors[-1, 2] = math.inf
    summary = metrics.summarise_errors(errors)
    expected = [
        np.median(column[~np.isnan(column)]) if not np.isnan(column).all() else math.nan
        for column in errors.T.numpy()
    ]
    np.testing.assert_array_equal(summary.median.numpy(), expected)
    assert summary.counts.tolist() == [n_frames, n_frames - 1, n_frames, n_frames, 0]
    assert summary.per_joint[2] == math.inf


def test_jitter_of_known_motions() -> None:
    time = torch.arange(31, dtype=torch.float64)[:, None, None] / 30
    steady = torch.cat([2 * time, time, 0 * time], -1)
    assert metrics.jitter(steady, 30.0).item() == pytest.approx(0, abs=1e-9)
    thrown = torch.cat([time, 0.5 * 9.81 * time**2, 0 * time], -1)
    thrown[7] = math.nan
    assert metrics.jitter(thrown, 30.0).item() == pytest.approx(9.81)


# --- PCP ------------------------------------------------------------------------------------------


def test_pcp_worked_out_by_hand() -> None:
    # An arm of two limbs, 10 px and 20 px long; the elbow is 4 px off, the hand 9 px.
    truth = torch.tensor([[0.0, 0.0], [10.0, 0.0], [30.0, 0.0]])
    estimate = truth + torch.tensor([[0.0, 0.0], [0.0, 4.0], [0.0, -9.0]])
    curve = metrics.pcp(estimate, truth, [0.2, 0.39, 0.4, 0.44, 0.45, 0.5], [(0, 1), (1, 2)])
    assert curve.per_limb[0].tolist() == [0, 0, 1, 1, 1, 1]  # 4 <= 0.4 x 10
    assert curve.per_limb[1].tolist() == [0, 0, 0, 0, 1, 1]  # both ends: 9 <= 0.45 x 20
    assert curve.overall.tolist() == [0, 0, 0.5, 0.5, 1, 1]
    assert curve.counts.tolist() == [1, 1]


def test_pcp_needs_both_ends() -> None:
    truth = torch.tensor([[0.0, 0.0], [10.0, 0.0]])
    estimate = truth + torch.tensor([[0.0, 0.0], [6.0, 0.0]])  # the mean of both is 3 px
    assert metrics.pcp(estimate, truth, [0.5], [(0, 1)]).overall.item() == 0


def test_pcp_counts_missing_estimates_as_wrong_and_leaves_out_missing_truth() -> None:
    truth = normal(10, 8, 2)
    estimate = truth.clone()
    estimate[0, 0] = math.nan  # left hand: one left forearm of ten is wrong
    truth[1, 6] = math.nan  # right elbow: two limbs are unknown
    curve = metrics.pcp(estimate, truth, [0.5])
    assert curve.per_limb[:, 0].tolist() == [1.0, 0.9, 1.0, 1.0]
    assert curve.counts.tolist() == [10, 10, 9, 9]
    assert curve.overall.item() == pytest.approx(37 / 38)


# --- calibration ----------------------------------------------------------------------------------


@pytest.mark.parametrize("dof", [1, 2, 3, 7, 21])
def test_chi_square_agrees_with_scipy(dof: int) -> None:
    p = torch.tensor([0, 1e-6, 0.01, 0.1, 0.5, 0.9, 0.99, 1 - 1e-9, 1], dtype=torch.float64)
    quantile = chi2_quantile(p, dof)
    np.testing.assert_allclose(quantile, scipy.stats.chi2.ppf(p, dof), rtol=1e-7)
    x = torch.linspace(0, 60, 200, dtype=torch.float64)
    np.testing.assert_allclose(chi2_cdf(x, dof), scipy.stats.chi2.cdf(x, dof), atol=1e-12)


def gaussian_joints(n: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Truth drawn from the estimate's own Gaussians, with scales from millimetres to metres."""
    root = normal(8, 3, 3, seed=7) * torch.logspace(-3, 0, 8, dtype=torch.float64)[:, None, None]
    mean = normal(8, 3, seed=8).expand(n, 8, 3)
    truth = mean + (root @ normal(n, 8, 3, 1, seed=9)).squeeze(-1)
    return mean, (root @ root.mT).expand(n, 8, 3, 3), truth


def test_coverage_of_right_and_wrong_covariances_by_monte_carlo() -> None:
    n = 4000
    mean, covariance, truth = gaussian_joints(n)
    curve = metrics.reliability(mean, covariance, truth)
    error = 4.5 * (curve.levels * (1 - curve.levels) / n).sqrt()  # 152 comparisons
    assert ((curve.per_joint - curve.levels[:, None]).abs() < error[:, None]).all()
    assert metrics.calibration_error(curve).max() < 0.04
    # Covariances half as large: the share at level p is F(q_p / 2).
    half = metrics.coverage(mean, covariance / 2, truth, [0.5, 0.9])
    expected = scipy.stats.chi2.cdf(scipy.stats.chi2.ppf([0.5, 0.9], 3) / 2, 3)
    np.testing.assert_allclose(half.overall, expected, atol=0.015)


def test_coverage_does_not_change_under_a_common_rotation() -> None:
    mean, covariance, truth = gaussian_joints(200)
    turn = random_rotations(200)
    rotated = turn[:, None] @ covariance @ turn[:, None].mT
    once = metrics.coverage(mean, covariance, truth)
    again = metrics.coverage(mean @ turn.mT, rotated, truth @ turn.mT)
    torch.testing.assert_close(once.per_joint, again.per_joint)


def test_coverage_leaves_out_what_it_cannot_judge() -> None:
    mean, covariance, truth = (t.clone() for t in gaussian_joints(50))
    covariance[0, 0] = math.nan
    covariance[1, 1] = -torch.eye(3)
    truth[2, 2] = math.nan
    mask = torch.ones(50, 8, dtype=torch.bool)
    mask[3:8, 3] = False
    curve = metrics.coverage(mean, covariance, truth, mask=mask)
    assert curve.counts.tolist() == [49, 49, 49, 45, 50, 50, 50, 50]
    assert torch.isfinite(curve.per_joint).all()


def test_predictive_log_likelihood_agrees_with_scipy() -> None:
    weights = torch.tensor([0.2, 0.8], dtype=torch.float64)
    means, root, value = normal(2, 2), normal(2, 2, 2, seed=1), normal(2, seed=2)
    covariance = root @ root.mT
    density = sum(
        w * scipy.stats.multivariate_normal.pdf(value, m, c)
        for w, m, c in zip(weights.tolist(), means.numpy(), covariance.numpy(), strict=True)
    )
    # Weights need not be normalised.
    got = metrics.predictive_log_likelihood(weights.log() + 5, means, covariance, value)
    assert got.item() == pytest.approx(math.log(density))


# --- dtype, device, batch shape -------------------------------------------------------------------

CUDA = pytest.param(
    torch.float64,
    "cuda",
    marks=[
        pytest.mark.cuda,
        pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
    ],
)


@pytest.mark.parametrize(("dtype", "device"), [(torch.float32, "cpu"), CUDA])
def test_other_dtypes_devices_and_batch_shapes_agree(dtype: torch.dtype, device: str) -> None:
    mean, covariance, truth = gaussian_joints(24)

    def everything(*tensors: torch.Tensor) -> list[torch.Tensor]:
        m, c, x = tensors
        moved = metrics.align(m, x, covariance=c)
        assert moved.covariance is not None
        return [
            metrics.joint_errors_3d(m, x).reshape(-1, 8),
            metrics.pcp(m, x).overall,
            metrics.coverage(moved.points, moved.covariance, x).overall,
            metrics.summarise_errors(metrics.joint_errors(m, x)).median,
        ]

    other = [t.reshape(2, 3, 4, *t.shape[1:]).to(device, dtype) for t in (mean, covariance, truth)]
    for a, b in zip(everything(mean, covariance, truth), everything(*other), strict=True):
        assert b.device.type == device
        torch.testing.assert_close(b.cpu().to(a), a, atol=2e-5, rtol=1e-4)


# --- bad input ------------------------------------------------------------------------------------


def test_bad_input_is_named() -> None:
    with pytest.raises(ShapeError, match=r"truth must have shape .* got \[2, 7, 3\]"):
        metrics.joint_errors(torch.zeros(2, 8, 3), torch.zeros(2, 7, 3))
    with pytest.raises(InputError, match="three or more"):
        metrics.align(torch.zeros(8, 3), torch.zeros(8, 3), joints=[0, 1])
    with pytest.raises(InputError, match=r"probabilities in \[0, 1\]"):
        metrics.coverage(*gaussian_joints(2), levels=[1.5])
    with pytest.raises(ShapeError, match=r"levels must have shape \[L\], got \[\]"):
        metrics.coverage(*gaussian_joints(2), levels=0.5)
    with pytest.raises(InputError, match="three frames"):
        metrics.jitter(torch.zeros(2, 8, 3), 30.0)


# --- torchmetrics ---------------------------------------------------------------------------------


@pytest.fixture
def adapters():
    pytest.importorskip("torchmetrics", reason="torchmetrics is not installed")
    return importlib.import_module("torchpose.metrics._torchmetrics_adapters")


def test_torchmetrics_add_up_over_batches_and_ranks(adapters) -> None:
    mean, covariance, truth = (t.clone() for t in gaussian_joints(60))
    truth[3, 0] = math.nan
    parts = [slice(0, 10), slice(10, 11), slice(11, 60)]
    error = adapters.MeanPerJointError(procrustes=True, per_joint=True)
    share = adapters.PercentageOfCorrectParts([0.1, 0.5], per_limb=True)
    inside = adapters.EllipsoidCoverage(procrustes=True, per_joint=True)
    for part in parts:
        error.update(mean[part], truth[part])
        share.update(mean[part], truth[part])
        inside.update(mean[part], covariance[part], truth[part])
    torch.testing.assert_close(
        error.compute(), metrics.summarise_errors(metrics.joint_errors_3d(mean, truth)).per_joint
    )
    torch.testing.assert_close(
        share.compute(), metrics.pcp(mean, truth, [0.1, 0.5]).per_limb, check_dtype=False
    )
    moved = metrics.align(mean, truth, covariance=covariance)
    whole = metrics.coverage(moved.points, moved.covariance, truth)
    torch.testing.assert_close(inside.compute(), whole.per_joint)
    for metric in (error, share, inside):  # every state is reduced by a sum
        assert {f.__name__ for f in metric._reductions.values()} == {"dim_zero_sum"}


def test_torchmetrics_pooled_values_reset_and_errors(adapters) -> None:
    mean, covariance, truth = gaussian_joints(30)
    error = adapters.MeanPerJointError()
    assert error(mean, truth) == pytest.approx(float(metrics.joint_errors(mean, truth).mean()))
    error.reset()
    assert error.count.sum() == 0
    share = adapters.PercentageOfCorrectParts()
    torch.testing.assert_close(
        share(mean, truth), metrics.pcp(mean, truth).overall, check_dtype=False
    )
    inside = adapters.EllipsoidCoverage()
    torch.testing.assert_close(
        inside(mean, covariance, truth), metrics.coverage(mean, covariance, truth).overall
    )
    with pytest.raises(ShapeError, match="set n_joints"):
        error.update(mean[:, :5], truth[:, :5])


def test_without_torchmetrics_the_message_says_what_to_do(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "torchmetrics", None)
    monkeypatch.delitem(sys.modules, "torchpose.metrics._torchmetrics_adapters", raising=False)
    with pytest.raises(MissingDependencyError, match="pip install torchmetrics"):
        importlib.import_module("torchpose.metrics._torchmetrics_adapters")


def test_chains_are_no_limbs_and_one_joint_does_not_align():
    poses = torch.rand(2, 8, 3, generator=torch.Generator().manual_seed(0))
    for limbs in ([(0, 1, 2), (3, 4, 5)], [0, 1], [(0.0, 1.0)]):
        with pytest.raises(InputError, match="limbs must be pairs of joints below 8"):
            metrics.pcp(poses, poses, limbs=limbs)
    with pytest.raises(InputError, match="joints must be three or more different indices"):
        metrics.align(poses, poses, joints=[1, 1, 1])
