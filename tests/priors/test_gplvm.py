"""The manifold: prediction against dense algebra, noise, files, what is refused, real walks."""

import copy
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel
from torch import Tensor

from tests.data import data_dir_or_skip
from tests.priors.motions import CYCLE, NOISE, motion
from torchpose.body import BODY_15, Body, body_joints, fit_body, fit_state
from torchpose.errors import FileFormatError, InputError, PriorError, ShapeError
from torchpose.learning import fit_gplvm, fit_gplvm_noise
from torchpose.learning._gplvm_fit import GPLVMFit, median_gamma, run_fit
from torchpose.learning._manifolds import fit_target, gplvm_of_fit, thin
from torchpose.priors import BackConstrainedGPLVM, ManifoldInfo
from torchpose.priors._manifold.prediction import KernelParameters

FACTS = {"name": "walk", "fps": 60.0, "persons": ("a#1",), "sequences": ("one", "two")}


def pca_error(train: Tensor, test: Tensor, dims: int = 2) -> float:
    mean = train.mean(0)
    _, _, axes = torch.linalg.svd(train - mean, full_matrices=False)
    back = (test - mean) @ axes[:dims].T @ axes[:dims]
    return float((test - mean - back).square().mean().sqrt())


def rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())


@pytest.fixture(scope="module")
def body() -> Body:
    return Body.of_height(BODY_15, 1.8)


@pytest.fixture(scope="module")
def manifold(body) -> BackConstrainedGPLVM:
    info = ManifoldInfo.of_body(body, **FACTS)
    poses = [motion(90), motion(70, phase=2.0, seed=1)]
    fitted = fit_gplvm(poses, steps=12, info=info)
    return fit_gplvm_noise(fitted, motion(150, phase=1.0, seed=2), 60.0)


# --- prediction


def test_predictions_are_those_of_gaussian_process_regression(manifold) -> None:
    """Each column of (MR 25, 26) is a Gaussian process regression of scikit-learn's."""
    beta, beta0, gamma, _ = (value.exp().item() for value in manifold.kernel)
    kernel = ConstantKernel(beta) * RBF(1 / math.sqrt(gamma)) + ConstantKernel(beta0)
    noise = manifold.kernel.noise.item()
    peer = GaussianProcessRegressor(kernel, alpha=noise, optimizer=None)
    mean = manifold.poses.mean(0)
    peer.fit(manifold.latents.numpy(), (manifold.poses - mean).numpy())
    z = 1.5 * torch.randn(7, 2, generator=torch.Generator().manual_seed(3)).double()
    expected, deviation = peer.predict(z.numpy(), return_std=True)
    found, variance = manifold.to_pose(z)
    np.testing.assert_allclose(found.numpy(), expected + mean.numpy(), atol=1e-8)
    np.testing.assert_allclose(variance.numpy(), deviation[:, 0] ** 2 + noise, rtol=1e-6)
    torch.testing.assert_close(manifold.pose_mean(z), found, rtol=0, atol=0)


def test_the_variance_falls_back_to_the_prior_far_away(manifold) -> None:
    far = torch.full((1, 2), 1e3, dtype=torch.float64)
    _, variance = manifold.to_pose(far)
    kernel, count = manifold.kernel, len(manifold.poses)
    assert float(variance) <= float(kernel.variance + kernel.noise)
    assert float(variance) >= float(kernel.log_beta.exp())
    assert float(variance) > 50 * float(manifold.to_pose(manifold.latents)[1].mean()), count


def test_the_back_constraints_are_the_formula(manifold) -> None:
    x = motion(5, phase=0.7, seed=9)
    distance = torch.cdist(x, manifold.poses).square()
    kernel = torch.exp(-0.5 * manifold.gamma_x * distance)
    expected = kernel @ manifold.weights + manifold.bias
    torch.testing.assert_close(manifold.to_latent(x), expected, rtol=1e-7, atol=1e-9)
    torch.testing.assert_close(manifold.to_latent(manifold.poses), manifold.latents)


def test_any_leading_shape_and_any_number_of_particles(manifold) -> None:
    x = motion(1300, seed=5)
    z = manifold.to_latent(x)
    mean, variance = manifold.to_pose(z)
    each = manifold.to_pose(manifold.to_latent(x[1000:1001]))
    torch.testing.assert_close(mean[1000:1001], each[0])
    torch.testing.assert_close(variance[1000:1001], each[1])
    shaped = manifold(x[:1200].reshape(3, 4, 100, 30))
    torch.testing.assert_close(shaped[0].reshape(1200, 30), mean[:1200])
    assert shaped[1].shape == (3, 4, 100)
    one = manifold.to_pose(z[0])
    assert one[0].shape == (30,) and one[1].shape == ()
    none = manifold.to_pose(z[:0])
    assert none[0].shape == (0, 30) and none[1].shape == (0,)


def test_single_precision_is_close(manifold) -> None:
    narrow = copy.deepcopy(manifold).float()
    x = motion(100, seed=6)
    mean, variance = manifold(x)
    found = narrow(x.float())
    assert found[0].dtype == found[1].dtype == torch.float32
    assert float((found[0] - mean).abs().max()) < 2e-3
    assert float((found[1] / variance - 1).abs().max()) < 0.05
    assert narrow.std_pose.dtype == torch.float32 and narrow.lengths.dtype == torch.long


@pytest.mark.parametrize("name", ["poses", "scale", "weights", "bias", "gamma_x", "log_kernel"])
def test_what_is_edited_counts_as_what_is_loaded(manifold, name: str) -> None:
    changed, z = 1.02 * manifold.state_dict()[name], manifold.latents[:5].clone()
    loaded, edited = copy.deepcopy(manifold), copy.deepcopy(manifold)
    loaded.load_state_dict(manifold.state_dict() | {name: changed})
    edited.state_dict()[name].copy_(changed)
    want = loaded.pose_mean(z)
    assert float((want - manifold.pose_mean(z)).abs().max()) > 1e-9
    assert torch.equal(edited.pose_mean(z), want)
    assert torch.equal(edited.latents, loaded.latents)
    x = motion(5, seed=6)
    found = torch.func.functional_call(manifold, {name: changed}, (x,))
    torch.testing.assert_close(found, loaded(x), rtol=0, atol=0)


def test_gradients_flow_through_both_maps(manifold) -> None:
    x = motion(2, seed=7).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: manifold.reconstruct(x).sum(-1), (x,), atol=1e-4)
    z = manifold.latents[:2].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda z: manifold.to_pose(z)[1], (z,), atol=1e-4)


# --- fit


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_a_fit_needs_no_mode_of_gradients(mode) -> None:
    whole = fit_gplvm(motion(40), steps=1, optimiser="adam")
    with mode():
        found = fit_gplvm(motion(40), steps=1, optimiser="adam")
    assert torch.equal(found.weights, whole.weights)
    assert not found.weights.requires_grad and not found.weights.is_inference()


def test_held_out_poses_come_back_better_than_from_two_principal_components(manifold) -> None:
    test = motion(200, phase=0.4, seed=11, speed=1.1)
    error = rms(test - manifold.reconstruct(test))
    assert error < 0.25 * pca_error(manifold.poses, test)
    assert error < 2 * NOISE


def test_neighbours_in_time_are_neighbours_in_latent_space(manifold) -> None:
    path = manifold.trajectories()[0]
    step = path.diff(dim=0).norm(dim=-1)
    assert float(step.max()) < 0.35 * float((path[None] - path[:, None]).norm(dim=-1).max())
    again = (path[CYCLE] - path[0]).norm()
    assert float(again) < 0.2 * float((path[CYCLE // 2] - path[0]).norm())


def test_latent_axes_are_principal_and_do_not_depend_on_the_optimiser() -> None:
    poses = motion(60)
    one = fit_gplvm(poses, steps=6)
    centred = one.latents - one.latents.mean(0)
    products = centred.T @ centred
    assert abs(float(products[0, 1])) < 1e-8 * float(products[0, 0])
    assert float(products[0, 0]) >= float(products[1, 1])
    assert bool((one.latents[0] >= 0).all())


def test_units_do_not_matter() -> None:
    """Degrees instead of quaternion vectors: gamma_x and beta follow the data."""
    poses = motion(60)
    one = fit_gplvm(poses, steps=4)
    other = fit_gplvm(100 * poses, steps=4)
    assert float(other.gamma_x) == pytest.approx(1e-4 * float(one.gamma_x))
    test = motion(30, seed=3)
    torch.testing.assert_close(
        other.reconstruct(100 * test), 100 * one.reconstruct(test), rtol=1e-2, atol=0.1
    )


def test_standardised_columns_weigh_the_same() -> None:
    poses = motion(60)
    poses[:, 0] *= 50
    plain = fit_gplvm(poses, steps=8)
    scaled = fit_gplvm(poses, steps=8, standardise=True)
    assert torch.equal(plain.scale, torch.ones(30).double())
    torch.testing.assert_close(scaled.scale[0], poses[:, 0].std(), rtol=1e-6, atol=0)
    test = motion(60, seed=4)
    test[:, 0] *= 50
    errors = [rms((test - m.reconstruct(test))[:, 1:]) for m in (plain, scaled)]
    assert errors[1] < errors[0]


def test_validation_poses_end_a_fit_where_they_come_back_best() -> None:
    poses, other = motion(60, noise=0.05), motion(60, phase=0.5, seed=3, noise=0.05)
    errors = [
        fit_gplvm(poses, steps=n, tolerance=0).reconstruction_error(other) for n in range(1, 9)
    ]
    found = fit_gplvm(poses, steps=8, tolerance=0, validation=other, patience=8, n_init=1)
    assert found.reconstruction_error(other) == pytest.approx(min(errors), rel=1e-6)
    early = fit_gplvm(poses, tolerance=0, validation=[other], patience=1, n_init=1)
    first = next(n for n in range(1, 9) if n == 8 or errors[n] >= errors[n - 1])
    assert early.reconstruction_error(other) == pytest.approx(errors[first - 1], rel=1e-6)


def test_several_starts_keep_the_best() -> None:
    poses, other = motion(50), motion(50, phase=1.0, seed=6)
    each = []
    for start in range(3):
        target = fit_target(poses, (), standardise=False, gamma_x=None, seed=0)
        centred = poses - poses.mean(0)
        fit = run_fit(GPLVMFit(centred, 2, median_gamma(centred), start=start), 3)
        each.append((fit.history[-1], gplvm_of_fit(fit, target)))
    best = fit_gplvm(poses, steps=3, n_init=3)
    assert torch.equal(best.latents, max(each, key=lambda one: one[0])[1].latents)
    watched = fit_gplvm(poses, steps=3, n_init=3, validation=other)
    single = fit_gplvm(poses, steps=3, n_init=1, validation=other)
    assert watched.reconstruction_error(other) <= single.reconstruction_error(other)


def test_poses_are_thinned_evenly() -> None:
    parts = thin([motion(100), motion(50)], 30)
    assert [len(part) for part in parts] == [20, 10]
    assert torch.equal(parts[0], motion(100)[::5])
    assert [len(part) for part in thin([motion(20)], 500)] == [20]


# --- noise


def test_deviations_are_of_validation_poses_within_sequences(manifold) -> None:
    poses = [motion(40, seed=20), motion(30, phase=3.0, seed=21)]
    other = fit_gplvm_noise(copy.deepcopy(manifold), poses, 30.0)
    assert other.info.fps == 30.0 and manifold.info.fps == 60.0
    steps = torch.cat([part.diff(dim=0) for part in poses])
    torch.testing.assert_close(other.std_step, steps.square().mean(0).sqrt())
    whole = torch.cat(poses)
    residual = whole - manifold.pose_mean(manifold.to_latent(whole))
    torch.testing.assert_close(other.std_pose, residual.square().mean(0).sqrt())
    latent_steps = torch.cat([manifold.to_latent(part).diff(dim=0) for part in poses])
    torch.testing.assert_close(other.std_latent, latent_steps.square().mean(0).sqrt())


def test_a_still_column_keeps_a_deviation(manifold) -> None:
    poses = motion(60, noise=0.0)
    poses[:, 3] = 0.1
    still = fit_gplvm(poses, steps=3)
    other = motion(50, phase=1.0, noise=0.0)
    other[:, 3] = 0.1
    fit_gplvm_noise(still, other, 60)
    for deviations in (still.std_pose, still.std_step):
        moving = torch.cat([deviations[:3], deviations[4:]])
        assert float(deviations[3]) == pytest.approx(
            0.05 * 29**0.5 / 30**0.5 * rms(moving), rel=1e-3
        )


def test_deviations_refuse_poses_that_were_fitted_to(manifold) -> None:
    with pytest.raises(InputError, match="poses that were not fitted to, got some that were"):
        fit_gplvm_noise(manifold, motion(90), 60.0)
    for fps in (0.0, -1.0, math.inf):
        with pytest.raises(InputError, match="fps must be positive"):
            fit_gplvm_noise(manifold, motion(20, seed=3), fps)
    with pytest.raises(InputError, match="a step takes two frames of one sequence"):
        fit_gplvm_noise(manifold, [motion(1, seed=i) for i in range(30, 42)], 60.0)
    with pytest.raises(InputError, match="need poses that move"):
        fit_gplvm_noise(manifold, motion(1, seed=3).expand(20, -1), 60.0)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_gpu_gives_the_same(manifold) -> None:
    poses = [part.cuda() for part in (motion(90), motion(70, phase=2.0, seed=1))]
    there = fit_gplvm_noise(fit_gplvm(poses, steps=12), motion(50, seed=3).cuda(), 60.0)
    x = motion(20, seed=8)
    torch.testing.assert_close(
        there.reconstruct(x.cuda()).cpu(), manifold.reconstruct(x), rtol=0, atol=5e-3
    )
    moved = copy.deepcopy(manifold).cuda()
    mean, variance = moved(x.cuda())
    torch.testing.assert_close(mean.cpu(), manifold(x)[0], rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(variance.cpu(), manifold(x)[1], rtol=1e-5, atol=1e-9)


# --- what is refused


def test_bad_poses_are_refused(manifold, body) -> None:
    for bad, name in ((motion(20).numpy(), "poses"), ([motion(20).tolist()], "sequence 0 of")):
        with pytest.raises(InputError, match=f"{name}.* must be a tensor, got"):
            fit_gplvm(bad)
    with pytest.raises(InputError, match="poses must be real"):
        fit_gplvm(motion(20) + 0j)
    with pytest.raises(InputError, match="at least 10 frames of poses, got 9"):
        fit_gplvm(motion(9))
    with pytest.raises(InputError, match="at least 10 frames of poses, got 0"):
        fit_gplvm([])
    poses = motion(20)
    poses[7, 4] = math.nan
    with pytest.raises(InputError, match="got nan in frame 7, column 4; 1 such values"):
        fit_gplvm(poses)
    named = ManifoldInfo.of_body(body)
    with pytest.raises(InputError, match=r"sequence 1 .* frame 7, column 4 \(head y\)"):
        fit_gplvm([motion(20), poses], info=named)
    with pytest.raises(InputError, match="gamma_x cannot be told"):
        fit_gplvm(torch.ones(20, 30).double())
    with pytest.raises(ShapeError, match=r"sequence 1 of the poses must have shape \[T, 30\]"):
        fit_gplvm([motion(20), motion(20)[:, :29]])
    with pytest.raises(ShapeError, match=r"poses must have shape \[T, 30\], got \[20, 29\]"):
        fit_gplvm_noise(manifold, motion(20)[:, :29], 60.0)
    with pytest.raises(ShapeError, match=r"x must have shape \[..., 30\]"):
        manifold.to_latent(motion(3)[:, :29])
    with pytest.raises(ShapeError, match=r"z must have shape \[..., 2\]"):
        manifold.to_pose(motion(3))
    with pytest.raises(InputError, match="n_init and steps must be at least 1"):
        fit_gplvm(motion(20), steps=0)


def test_a_manifold_of_another_body_is_refused(manifold, body) -> None:
    manifold.check_for(body)
    manifold.check_for(body, fps=60.0)
    with pytest.raises(PriorError, match="its frame is parent, the body's is body"):
        manifold.check_for(body.altered(frame="body"))
    centres = torch.zeros(len(BODY_15.parts), 3).double()
    centres[3, 0] = 0.2
    with pytest.raises(PriorError, match="centred elsewhere"):
        manifold.check_for(body.altered(centres=centres))
    renamed = SimpleNamespace(names=("hips", *BODY_15.names[1:]), parts=BODY_15.parts)
    other = SimpleNamespace(skeleton=renamed, frame="parent", relative_columns=range(6, 36))
    with pytest.raises(PriorError, match=r"its skeleton is pelvis, neck.*the body's is hips, neck"):
        manifold.check_for(other)
    with pytest.raises(PriorError, match="are for 60 frames per second, got 30"):
        manifold.check_for(body, fps=30.0)
    plain = fit_gplvm(motion(20), steps=1)
    plain.check_for(body)
    with pytest.raises(PriorError, match="no standard deviations yet; call fit_gplvm_noise"):
        plain.check_for(body, fps=60.0)
    narrow = fit_gplvm(motion(20)[:, :12], steps=1)
    with pytest.raises(PriorError, match="it has 12 columns, poses of the body have 30"):
        narrow.check_for(body)


def test_sizes_that_do_not_fit_are_refused(manifold) -> None:
    m = manifold
    good = (m.poses, m.lengths, m.weights, m.bias, m.gamma_x, m.kernel)
    for at, value in ((1, m.lengths[:1]), (2, m.weights[:-1]), (3, m.bias[:1])):
        with pytest.raises(ShapeError):
            BackConstrainedGPLVM(*good[:at], value, *good[at + 1 :])
    kernel = KernelParameters(*(torch.tensor(math.nan) for _ in range(4)))
    with pytest.raises(InputError, match="log_kernel must be finite"):
        BackConstrainedGPLVM(*good[:5], kernel)


# --- files


def test_a_file_holds_everything(manifold, tmp_path) -> None:
    manifold.save(tmp_path / "walk.safetensors")
    found = BackConstrainedGPLVM.load(tmp_path / "walk.safetensors")
    assert found.info == manifold.info and found.info.columns[:2] == ("torso x", "torso y")
    assert found.state_dict().keys() == manifold.state_dict().keys()
    for name, value in manifold.state_dict().items():
        assert torch.equal(value, found.state_dict()[name]), name
    x = motion(20, seed=8)
    assert torch.equal(found.reconstruct(x), manifold.reconstruct(x))
    assert [len(path) for path in found.trajectories()] == [90, 70]
    assert not list(tmp_path.glob(".*"))


def test_a_state_dict_brings_its_predictions_along(manifold) -> None:
    poses = [motion(90, seed=30), motion(70, seed=31)]
    other = fit_gplvm(poses, steps=1)
    other.load_state_dict(manifold.state_dict())
    x = motion(20, seed=8)
    assert torch.equal(other.reconstruct(x), manifold.reconstruct(x))


def test_files_of_another_kind_are_refused(manifold, tmp_path) -> None:
    from safetensors.torch import save_file

    path = tmp_path / "m.safetensors"
    with pytest.raises(InputError, match="no such file"):
        BackConstrainedGPLVM.load(path)
    manifold.save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FileFormatError, match="truncated or of another kind"):
        BackConstrainedGPLVM.load(path)
    path.write_bytes(whole.replace(b"torchpose-manifold", b"torchpose-manyfold"))
    with pytest.raises(FileFormatError, match="expected a torchpose-manifold"):
        BackConstrainedGPLVM.load(path)
    save_file({"poses": torch.zeros(3)}, path)
    with pytest.raises(FileFormatError, match="got a file of another kind"):
        BackConstrainedGPLVM.load(path)
    manifold.save(path)
    extra = replace(manifold.info, extra={"bad": object()})
    broken = copy.deepcopy(manifold)
    broken.info = extra
    with pytest.raises(PriorError, match="only what JSON can hold"):
        broken.save(path)
    assert BackConstrainedGPLVM.load(path).info == manifold.info
    with pytest.raises(FileFormatError, match="unknown field 'colour'"):
        ManifoldInfo.from_json('{"colour": 1}')
    with pytest.raises(FileFormatError, match="bad value of persons"):
        ManifoldInfo.from_json('{"persons": "a"}')


# --- real walks


def test_a_real_walk_is_reconstructed_better_than_by_principal_components() -> None:
    folder = data_dir_or_skip("mocap_cmu_walk")
    joints = []
    for trial in ("01", "02", "03", "04", "07"):
        with np.load(folder / f"s39_39_{trial}_walk.npz") as file:
            names = [str(name) for name in file["names"]]
            joints.append(body_joints(torch.from_numpy(file["joints"][::2]).double(), names))
    body = fit_body(torch.cat(joints[:4]))
    poses = [body.relative(fit_state(body, part)) for part in joints]
    train = thin(poses[:4], 250)
    info = ManifoldInfo.of_body(body, fps=60.0)
    manifold = fit_gplvm_noise(fit_gplvm(train, steps=8, info=info), poses[4:], 60.0)
    manifold.check_for(body, fps=60.0)
    error = rms(poses[4] - manifold.reconstruct(poses[4]))
    assert error < 0.6 * pca_error(torch.cat(train), poses[4])
    assert bool((manifold.std_pose > 0).all() and (manifold.std_step > 0).all())
    assert float(manifold.std_pose.mean()) < float(poses[4].std(0).mean())
