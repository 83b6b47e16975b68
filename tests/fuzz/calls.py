"""Public functions of tensors, called with tensors of wrong shapes, types and values."""

import functools
import warnings
from collections.abc import Callable
from random import Random
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tests.fuzz.readers import SilentError
from tests.fuzz.samples import prior
from torchpose import metrics
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.filters import BootstrapParticleFilter, MixtureKalmanFilter
from torchpose.metrics._calibration import chi2_cdf, chi2_quantile, mahalanobis_squared
from torchpose.metrics._pose_errors import limb_hits, share_below
from torchpose.priors import GaussianMixture
from torchpose.upper_body import UpperBodyTracker

__all__ = ["odd_call"]


class _Call(NamedTuple):
    """A function, arguments that it takes, and the tensors among them that may be odd."""

    run: Callable[..., Any]
    arguments: dict[str, Any]


def _randn(*sizes: int) -> Tensor:
    generator = torch.Generator().manual_seed(len(sizes))
    return torch.randn(*sizes, generator=generator, dtype=torch.float64)


def _spd(*sizes: int) -> Tensor:
    factor = _randn(*sizes, sizes[-1])
    return factor @ factor.mT + torch.eye(sizes[-1], dtype=torch.float64)


@functools.cache
def _filters() -> dict[str, Any]:
    mixture = GaussianMixture(torch.full((3,), 1 / 3).double(), _randn(3, 4), _spd(3, 4))
    common = (mixture, 0.1 * torch.eye(4).double(), torch.eye(2).double(), (0, 1))
    return {
        "fixed": MixtureKalmanFilter(*common),
        "sampled": MixtureKalmanFilter(*common, tracks="sampled", n_tracks=5),
        "particles": BootstrapParticleFilter(*common, n_particles=20),
    }


@functools.cache
def _tracker() -> UpperBodyTracker:
    return UpperBodyTracker(prior(), camera=PinholeCamera(525, 525, 319.5, 239.5))


def _step(which: str, z: Tensor, mask: Tensor, cov: Tensor, states: int) -> Any:
    model = _filters()[which]
    generator = torch.Generator().manual_seed(0)
    state = model.init(states, generator=generator)
    return model.step(state, z, mask, cov, generator=generator, return_cov=True)


def _foreign_state(which: str, other: str, z: Tensor) -> Any:
    generator = torch.Generator().manual_seed(0)
    state = _filters()[other].init(len(z) if z.ndim else 1, generator=generator)
    return _filters()[which].step(state, z, None, None, generator=generator, return_cov=True)


def _run(which: str, z: Tensor, mask: Tensor, cov: Tensor, lengths: Tensor) -> Any:
    generator = torch.Generator().manual_seed(0)
    return _filters()[which](z, mask, cov, lengths=lengths, generator=generator, return_cov=True)


def _track(keypoints: Tensor, confidence: Tensor, mask: Tensor) -> Any:
    names = ("hand_left", "head", "neck", "hand_right")
    return _tracker()(keypoints, confidence, names, mask)


def _stream(keypoints: Tensor, confidence: Tensor, states: int) -> Any:
    state = _tracker().init(states)
    return _tracker().step(state, keypoints, confidence)


def _calls() -> dict[str, _Call]:
    mask = torch.ones(5, 8, dtype=torch.bool)
    pair = {"estimate": _randn(5, 8, 3), "truth": _randn(5, 8, 3), "mask": mask}
    flat = {"estimate": _randn(5, 8, 2), "truth": _randn(5, 8, 2), "mask": mask}
    spread = {"estimate": _randn(5, 8, 3), "covariance": _spd(5, 8, 3), "truth": _randn(5, 8, 3)}
    frames = {"z": _randn(2, 6, 2), "mask": torch.ones(2, 6, 2, dtype=torch.bool),
              "cov": _spd(2, 6, 2), "lengths": torch.tensor([6, 4])}  # fmt: skip
    frame = {"z": _randn(2, 2), "mask": torch.ones(2, 2, dtype=torch.bool), "cov": _spd(2, 2)}
    camera = PinholeCamera(525, 525, 319.5, 239.5, 640, 480)
    points = _randn(2, 4, 3) + torch.tensor([0, 0, 9.0])
    found = {
        "joint_errors": _Call(metrics.joint_errors, pair),
        "joint_errors_3d": _Call(metrics.joint_errors_3d, pair),
        "joint_errors_2d": _Call(metrics.joint_errors_2d, flat),
        "procrustes": _Call(
            metrics.procrustes, {"source": _randn(5, 8, 3), "target": _randn(5, 8, 3), "mask": mask}
        ),
        "align": _Call(metrics.align, {**spread, "mask": mask}),
        "pcp": _Call(metrics.pcp, flat),
        "limb_hits": _Call(limb_hits, {**flat, "thresholds": torch.rand(4).double()}),
        "jitter": _Call(metrics.jitter, {"points": _randn(6, 8, 3), "fps": 30.0}),
        "summarise_errors": _Call(metrics.summarise_errors, {"errors": _randn(5, 8).abs()}),
        "share_below": _Call(share_below, {"errors": _randn(5, 8).abs()}),
        "coverage": _Call(metrics.coverage, {**spread, "mask": mask}),
        "reliability": _Call(metrics.reliability, {**spread, "mask": mask}),
        "mahalanobis_squared": _Call(mahalanobis_squared, {**spread, "mask": mask}),
        "chi2_cdf": _Call(chi2_cdf, {"x": _randn(4).abs()}),
        "chi2_quantile": _Call(chi2_quantile, {"p": torch.rand(4).double()}),
        "predictive_log_likelihood": _Call(
            metrics.predictive_log_likelihood,
            {"log_weights": _randn(5, 3), "means": _randn(5, 3, 2), "covariance": _spd(5, 3, 2),
             "value": _randn(5, 2)},
        ),
        "mixture": _Call(
            lambda weights, means, covariances, x: GaussianMixture(weights, means, covariances).log_prob(x),
            {"weights": torch.tensor([0.4, 0.6]).double(), "means": _randn(2, 3),
             "covariances": _spd(2, 3), "x": _randn(5, 3)},
        ),
        "camera": _Call(camera, {"points": points}),
        "rig": _Call(CameraRig([camera]), {"points": points}),
        "matrix": _Call(lambda matrix: PinholeCamera.from_matrix(matrix), {"matrix": camera.matrix}),
        "track": _Call(
            _track,
            {"keypoints": 300 + 50 * _randn(2, 5, 4, 2), "confidence": torch.rand(2, 5, 4),
             "mask": torch.ones(2, 5, 4, dtype=torch.bool)},
        ),
        "stream": _Call(
            _stream, {"keypoints": 300 + 50 * _randn(2, 8, 2), "confidence": torch.rand(2, 8), "states": 2}
        ),
    }  # fmt: skip
    for name in _filters():
        found[f"{name} forward"] = _Call(functools.partial(_run, name), frames)
        found[f"{name} step"] = _Call(functools.partial(_step, name), {**frame, "states": 2})
        for other in _filters():
            foreign = functools.partial(_foreign_state, name, other)
            found[f"{name} with a state of {other}"] = _Call(foreign, {"z": _randn(2, 2)})
    return found


def odd_call(rng: Random) -> str:
    """Call a function with one odd tensor or two; its name.

    Raises:
        SilentError: infinity in a result of finite arguments.
    """
    calls = _known()
    name = rng.choice(list(calls))
    call = calls[name]
    arguments = dict(call.arguments)
    for _ in range(rng.choice((1, 1, 2))):
        key = rng.choice(list(arguments))
        with warnings.catch_warnings():  # about complex numbers made real again
            warnings.simplefilter("ignore")
            arguments[key] = _odd(arguments[key], rng)
    result = call.run(**arguments)
    _check_failures(name, result)
    if all(_moderate(value) for value in arguments.values()):
        _check(name, result)
    return name


_known = functools.cache(_calls)


def _odd(value: Any, rng: Random) -> Any:
    if not isinstance(value, Tensor):
        return (
            rng.choice((1, 3, 7))
            if isinstance(value, int)
            else rng.choice((0.0, -1.0, float("nan")))
        )
    value = value.clone()
    match rng.randrange(12):
        case 0:
            return value.half()
        case 1:
            return value.float()
        case 2:
            return value.to(rng.choice((torch.int64, torch.bool, torch.complex128, torch.bfloat16)))
        case 3:
            return value[None]
        case 4:
            return value[0] if value.ndim and value.shape[0] else value
        case 5:
            return value[..., :-1] if value.ndim else value
        case 6:
            return value[:-1] if value.ndim else value
        case 7:
            return value[..., :0] if value.ndim else value
        case 8:
            return value[:0] if value.ndim else value
        case 9:
            return value.mT if value.ndim > 1 else value
        case 10 if value.is_floating_point() and value.numel():
            odd = (float("nan"), float("inf"), 1e200, -1.0, 0.0, 1e-200)
            number = torch.tensor(rng.choice(odd), dtype=torch.float64)
            value.reshape(-1)[rng.randrange(value.numel())] = number.to(value.dtype)
            return value
        case _:
            if value.is_floating_point():
                return value * rng.choice((0, -1, 1e6))
            return value if value.is_complex() else ~value


def _moderate(value: Any) -> bool:
    """Whether all numbers are within reach of the arithmetic, of doubles."""
    if not isinstance(value, Tensor):
        return True
    if value.dtype != torch.float64:
        return not value.is_floating_point()
    return bool((value.isfinite() & (value.abs() < 1e9)).all())


_INFINITE = ("chi2_quantile", "camera", "rig")  # of probability one; of depth zero


def _check(name: str, result: Any) -> None:
    for value in _tensors(result):
        if value.is_floating_point() and bool(value.isposinf().any()) and name not in _INFINITE:
            raise SilentError(f"{name}: infinity in the result")


def _check_failures(name: str, result: Any) -> None:
    """An element that did not fail has finite estimates and covariances."""
    failed_at = getattr(result, "failed_at", None)
    for field in ("mean", "cov", "joints2d", "joints3d", "covariance2d", "covariance3d"):
        value = getattr(result, field, None)
        if failed_at is None or value is None:
            continue
        if not bool(value[failed_at < 0].isfinite().all()):
            raise SilentError(f"{name}: {field} is not finite without failed_at")


def _tensors(result: Any) -> list[Tensor]:
    if isinstance(result, Tensor):
        return [result]
    if isinstance(result, tuple | list):
        return [tensor for part in result for tensor in _tensors(part)]
    return (
        [v for v in vars(result).values() if isinstance(v, Tensor)]
        if hasattr(result, "__dict__")
        else []
    )
