"""What metrics and filters refuse at the door, and that precisions are brought together."""

import copy

import pytest
import torch
from torch import nn

from tests.priors.mixtures import random_mixture
from torchpose import metrics
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.errors import CovarianceError, InputError, ShapeError, TorchposeError
from torchpose.filters import BootstrapParticleFilter, MixtureKalmanFilter


def draw(*shape, dtype=torch.float64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(
        dtype
    )


PAIRS = {
    "joint_errors": metrics.joint_errors, "joint_errors_3d": metrics.joint_errors_3d,
    "procrustes": metrics.procrustes, "align": metrics.align, "pcp": metrics.pcp,
}  # fmt: skip


def first(result):
    """A tensor of a result, whatever it is."""
    return result if isinstance(result, torch.Tensor) else result[0]


@pytest.mark.parametrize("name", PAIRS)
@pytest.mark.parametrize("kinds", [(torch.float32, torch.float64), (torch.float64, torch.float32)])
def test_mixed_precisions_are_those_of_the_wider_one(name, kinds):
    estimate, truth = draw(5, 8, 3, dtype=kinds[0]), draw(5, 8, 3) + 0.1
    expected = first(PAIRS[name](estimate.double(), truth.to(kinds[1]).double()))
    found = first(PAIRS[name](estimate, truth.to(kinds[1])))
    assert found.dtype == torch.float64
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("name", PAIRS)
def test_half_precision_is_widened(name):
    estimate, truth = draw(5, 8, 3, dtype=torch.float16), draw(5, 8, 3).half() + 0.5
    found = first(PAIRS[name](estimate, truth))
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, first(PAIRS[name](estimate.float(), truth.float())))


@pytest.mark.parametrize("name", PAIRS)
@pytest.mark.parametrize(
    ("estimate", "truth", "error"),
    [
        (draw(5, 8, 3), draw(4, 8, 3), ShapeError),
        (draw(5, 8, 3), draw(8, 3), ShapeError),
        (draw(5, 8, 3), draw(5, 7, 3), ShapeError),
        (draw(5, 8, 0), draw(5, 8, 0), ShapeError),
        (draw(3), draw(3), ShapeError),
        (draw(5, 8, 3).long(), draw(5, 8, 3), InputError),
        (draw(5, 8, 3) + 0j, draw(5, 8, 3), InputError),
    ],
)
def test_pairs_that_do_not_match(name, estimate, truth, error):
    with pytest.raises(error):
        PAIRS[name](estimate, truth)


@pytest.mark.parametrize("mask", [torch.ones(5, 8), torch.ones(5, 7, dtype=torch.bool)])
def test_masks_that_are_none(mask):
    with pytest.raises(TorchposeError, match="mask"):
        metrics.joint_errors(draw(5, 8, 3), draw(5, 8, 3), mask)


def test_covariances_of_another_batch():
    eye = torch.eye(3, dtype=torch.float64)
    for covariance in (eye.expand(4, 8, 3, 3), eye.expand(8, 3, 3), eye.expand(5, 8, 3, 3).long()):
        with pytest.raises(TorchposeError, match="covariance"):
            metrics.coverage(draw(5, 8, 3), covariance, draw(5, 8, 3))
    with pytest.raises(ShapeError, match="covariance"):
        metrics.predictive_log_likelihood(
            draw(5, 3), draw(5, 3, 3), eye.expand(4, 3, 3, 3), draw(5, 3)
        )


def test_limbs_of_joints_that_are_not_there():
    with pytest.raises(InputError, match="limbs"):
        metrics.pcp(draw(5, 4, 3), draw(5, 4, 3), limbs=[(0, 4)])


def test_no_errors_at_all_have_no_mean():
    summary = metrics.summarise_errors(torch.zeros(0, 8))
    assert bool(summary.mean.isnan()) and summary.counts.tolist() == [0] * 8


def filters():
    mixture = random_mixture(3, 4)
    common = (mixture, 0.1 * torch.eye(4).double(), torch.eye(2).double(), (0, 1))
    return {
        "fixed": MixtureKalmanFilter(*common),
        "sampled": MixtureKalmanFilter(*common, tracks="sampled", n_tracks=5),
        "split": MixtureKalmanFilter(*common, tracks="split", n_tracks=5),
        "particles": BootstrapParticleFilter(*common, n_particles=20),
        "walk": BootstrapParticleFilter(*common, proposal="random-walk", n_particles=20),
    }


@pytest.mark.parametrize("name", filters())
def test_a_state_of_another_batch_or_filter(name):
    model, generator = filters()[name], torch.Generator().manual_seed(0)
    state = model.init(3, generator=generator)
    with pytest.raises(ShapeError, match=r"2 elements of z.*init\(2\)"):
        model.step(state, draw(2, 2), generator=generator)
    other = filters()["particles" if name in ("fixed", "sampled", "split") else "fixed"]
    with pytest.raises(InputError, match="state must be a"):
        model.step(other.init(2, generator=generator), draw(2, 2), generator=generator)
    state, _ = model.step(model.init(2, generator=generator), draw(2, 2), generator=generator)
    model.step(state, draw(2, 2), generator=generator)  # its own are taken


def test_points_that_are_whole_numbers_do_not_cut_the_camera_to_them():
    camera = PinholeCamera(525.5, 525.5, 319.5, 239.5)
    for project in (camera, CameraRig([camera])):
        with pytest.raises(InputError, match="floating-point"):
            project(torch.ones(2, 4, 3, dtype=torch.long))


@pytest.mark.parametrize(
    "held",
    [random_mixture(3, 4), PinholeCamera(1234, 1234, 959.5, 539.5), filters()["fixed"]],
    ids=lambda held: type(held).__name__,
)
def test_models_with_rounded_covariances_or_cameras_are_refused(held):
    model = nn.ModuleDict({"held": held, "head": nn.Linear(2, 2)})
    before = copy.deepcopy(held.state_dict())
    with pytest.raises(
        InputError, match=rf"{type(held).__name__} .*model\.head\.to\(torch\.bfloat16\)"
    ):
        model.to(torch.bfloat16)
    torch.testing.assert_close(held.state_dict(), before, rtol=0, atol=0)
    model.head.to(torch.bfloat16)
    model.to("cpu").double()


@pytest.mark.parametrize("name", filters())
def test_filters_refuse_measurements_that_were_rounded(name):
    with pytest.raises(
        InputError, match=r"z must be torch\.float32 or torch\.float64, got torch\.bfloat16"
    ):
        filters()[name](draw(1, 3, 2, dtype=torch.bfloat16))


@pytest.mark.parametrize(
    "learnt", [torch.tensor([1.0, -0.5]), torch.diag(torch.tensor([1.0, -0.5]))]
)
def test_a_learnt_variance_that_became_negative_is_named(learnt):
    mixture, what = (
        random_mixture(3, 2),
        r"-0\.5 at index \(1,\)" if learnt.ndim == 1 else "definite",
    )
    with pytest.raises(CovarianceError, match=f"process_cov must be positive.*{what}") as caught:
        MixtureKalmanFilter(mixture, nn.Parameter(learnt), torch.ones(1), (0,))
    assert "index ()" not in str(caught.value)
