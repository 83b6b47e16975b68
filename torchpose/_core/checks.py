"""Check arguments, and raise typed errors that say what was expected, what came and what to do."""

import math
from collections.abc import Callable, Collection, Iterable, Sequence
from numbers import Integral, Real
from typing import Any

import torch
from torch import Tensor

from torchpose._core.uncompiled import is_exporting
from torchpose._core.value_checks import look_at, values_visible
from torchpose.errors import (
    CovarianceError,
    InputError,
    ShapeError,
)

MOST_CONFIDENCE = 2.0
"""Of a keypoint: peaks of heat maps may exceed 1, and count as 1; more is a score in percent."""
INLIER = (0.05, 0.97)
"""Least and largest prior probability that a keypoint is its joint's, whatever its confidence."""
CONFIDENCE_ADVICE = "divide scores in percent by 100, and take the sigmoid of logits"
"""What to do with confidences of another scale."""
STAYS_POSITIVE = "what is learnt stays positive as the exponential of a parameter"
_SMALLEST, _TALLEST = 0.5, 2.6  # metres, of a person
_FASTEST, _SLOWEST = 1000.0, 0.1  # frames per second
_LARGEST_SHARE = 2.0  # of the image; joints may lie outside of it
_MOST_SKEW = 1e-6  # of a covariance, relative to its largest entry
_RGB_ADVICE = (
    "; cv2.cvtColor converts BGR, RGBA and grey, np.asarray a PIL image, and (255 * image).astype(np.uint8) "
    "values from 0 to 1"
)
_SEEDS = 2**63
_SEVERAL = 3  # keypoints that tell whether most are shares


def refuse_export(what: str, instead: str) -> None:
    """Raise `InputError` while `torch.export` traces what depends on values.

    Args:
        what: name of what cannot be exported. instead: name of what can.
    """
    if is_exporting():
        raise InputError(f"{what} cannot be exported; export {instead}")


def check_shape(name: str, tensor: Tensor, expected: Sequence[int | str | None]) -> None:
    """Raise `ShapeError` unless `tensor` has the expected sizes.

    Args:
        name: the name of the tensor, for the message.
        tensor: the tensor to look at.
        expected: one entry per dimension; an int is a fixed size, a str or None is any size. A
            leading ``"..."`` stands for any number of leading dimensions.

    Raises:
        ShapeError: with the expected and the given shape.
    """
    sizes = list(expected)
    open_ended = bool(sizes) and sizes[0] == "..."
    if open_ended:
        sizes = sizes[1:]
    shape = tuple(tensor.shape)
    tail = shape[len(shape) - len(sizes) :] if len(shape) >= len(sizes) else ()
    wrong_rank = len(shape) < len(sizes) or (not open_ended and len(shape) != len(sizes))
    wrong_size = any(isinstance(e, int) and e != s for e, s in zip(sizes, tail, strict=False))
    if wrong_rank or wrong_size:
        wanted = ", ".join("any" if e is None else str(e) for e in expected)
        raise ShapeError(f"{name} must have shape [{wanted}], got {list(shape)}")


def check_finite(name: str, tensor: Tensor, where: Tensor | None = None, hint: str = "") -> None:
    """Raise `InputError` if an element is NaN or infinite (where `where` is True, if given)."""
    if not values_visible():
        return
    bad = ~torch.isfinite(tensor)
    if where is not None:
        bad = bad & where
    if look_at(bad.any()):
        index = tuple(int(i) for i in torch.nonzero(bad)[0])
        value = float(tensor.detach()[index])
        count = int(bad.sum())
        message = f"{name} must be finite, got {value} at index {index} ({count} such values)"
        raise InputError(f"{message}; {hint}" if hint else message)


def check_floating(name: str, tensor: Any) -> None:
    """Raise `InputError` unless `tensor` holds real floating-point numbers."""
    if not isinstance(tensor, Tensor):
        raise InputError(
            f"{name} must be a floating-point tensor, got {type(tensor).__name__}; convert it with "
            "torch.as_tensor"
        )
    if not tensor.is_floating_point():
        raise InputError(
            f"{name} must be a floating-point tensor, got {tensor.dtype}; convert it with .double()"
        )


def refuse_half(name: str, pixels: Tensor) -> None:
    """Raise `InputError` for pixels in half precision: above 512, bfloat16 has every fourth one alone."""
    if pixels.dtype in (torch.float16, torch.bfloat16):
        raise InputError(
            f"{name} must be torch.float32 or torch.float64, got {pixels.dtype}, which does not hold "
            "pixels; compute them with .float() in the network, outside autocast"
        )


def check_tensors(**values: object) -> None:
    """Raise `InputError` for what are no tensors of real numbers, by their names; None may pass.

    Tensors on the device "meta" have a shape and no numbers. Sparse ones are not what is computed with.
    """
    for name, value in values.items():
        if value is None:
            continue
        if not isinstance(value, Tensor):
            raise InputError(
                f"{name} must be a tensor, got {type(value).__name__}; convert it with torch.as_tensor"
            )
        check_real(name, value)
        if value.is_meta:
            raise InputError(
                f"{name} must hold numbers, got a tensor on the device meta, which has a shape alone; make "
                'it on a device that computes, such as "cpu"'
            )
        if value.layout != torch.strided:
            raise InputError(
                f"{name} must be a dense tensor, got {value.layout}; convert it with .to_dense()"
            )


def check_real(name: str, values: Any) -> None:
    """Raise `InputError` for complex numbers, whose imaginary parts a conversion would drop."""
    dtype = getattr(values, "dtype", None)
    if getattr(dtype, "is_complex", False) or getattr(dtype, "kind", "") == "c":
        raise InputError(f"{name} must be real, got {dtype}")


def check_pixels(name: str, points: Tensor, there: Tensor) -> None:
    """Raise `InputError` for shares of the image in place of pixels: nobody is so small that most fit.

    Points at exactly (0, 0) are what some detectors write where they found nothing, and do not count.

    Args:
        name: the name of the points, for the message. points: [*batch, 2]. there: which are meant, [*batch].
    """
    if not values_visible():
        return
    small = (points.detach().abs() <= _LARGEST_SHARE).all(-1)
    if not bool(small.any()):  # as nearly always
        return
    counted = there & (points != 0).any(-1)
    given, shares = points.detach()[counted], small[counted]
    if len(given) >= _SEVERAL and 2 * int(shares.sum()) > len(given):
        raise InputError(
            f"{name} must be in pixels, got most of them between {float(given[shares].min()):.3g} and "
            f"{float(given[shares].max()):.3g}; multiply those between 0 and 1 by the width and height of "
            "the image"
        )


def check_rgb(name: str, image: Any, empty: bool = True) -> None:
    """Raise `InputError` unless `image` is an array [H, W, 3] of uint8; `empty` ones may pass."""
    _check_image(name, image, "RGB, [H, W, 3]", 3, empty, _RGB_ADVICE)


def check_grey(name: str, image: Any) -> None:
    """Raise `InputError` unless `image` is an array [H, W] of uint8."""
    _check_image(name, image, "grey, [H, W]", None, True)


def _check_image(
    name: str, image: Any, kind: str, channels: int | None, empty: bool, advice: str = ""
) -> None:
    shape = tuple(getattr(image, "shape", ()))
    dtype = getattr(image, "dtype", None)
    fits = len(shape) == (2 if channels is None else 3) and channels in (None, shape[-1])
    if not fits or str(dtype) != "uint8" or (not empty and 0 in shape):
        got = f"{list(shape)} of {dtype}" if shape else type(image).__name__
        raise InputError(f"{name} must be {kind} of uint8, got {got}{advice}")


def check_rate(name: str, fps: Any) -> float:
    """Return `fps` as a float, or raise `InputError` unless it is in (0, 1000] frames per second.

    Filters and windows look back for so many frames; a rate that no camera has takes the memory for
    them.
    """
    number = isinstance(fps, Real) and not isinstance(fps, bool)
    if not number or not 0 < fps <= _FASTEST:
        raise InputError(
            f"{name} must be positive and at most {_FASTEST:g} frames per second, got {fps!r:.60}"
        )
    return float(fps)


def check_tracked_rate(fps: Any) -> None:
    """Raise `InputError` unless this is a rate at which somebody can be followed.

    Lower ones are seconds per frame that were given in place of frames per second.
    """
    rate = check_rate("fps", fps)
    if rate < _SLOWEST:
        raise InputError(
            f"fps must be at least {_SLOWEST:g} frames per second to follow anybody, got {fps!r}; give "
            f"1 / {rate:.3g} for frames that are {rate:.3g} s apart"
        )


def check_choice(name: str, value: object, choices: Collection[str]) -> None:
    """Raise `InputError` unless an option is one of these words."""
    if not (isinstance(value, str) and value in choices):
        raise InputError(f"{name} must be one of {', '.join(choices)}, got {value!r}")


def check_positive(name: str, value: float) -> float:
    """Return a number, or raise `InputError` unless it is above 0 and finite."""
    if isinstance(value, str) or not 0 < value < math.inf:
        raise InputError(f"{name} must be positive and finite, got {value}")
    return value


def number_of(value: Any) -> float:
    """Return a value as a number, NaN if it is none; text and truth values are none."""
    try:
        return math.nan if isinstance(value, bool | str) else float(value)
    except (TypeError, ValueError):
        return math.nan


def check_height(height: float, name: str = "height") -> float:
    """Return the height of a person, or raise `InputError` unless it can be one in metres."""
    metres = number_of(height)
    if not _SMALLEST <= metres <= _TALLEST:
        raise InputError(
            f"{name} must lie between {_SMALLEST} and {_TALLEST} m, got {height!r}; it is in metres"
        )
    return metres


def check_count(name: str, value: int) -> None:
    """Raise `InputError` unless a number of things is a whole one of at least 1."""
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise InputError(f"{name} must be a whole number, got {value!r:.60}")
    if value < 1:
        raise InputError(f"{name} must be at least 1, got {value}")


def check_generator(generator: Any, wanted: str = "a torch.Generator") -> None:
    """Raise `InputError` unless this is a source of random numbers, or None.

    Args:
        generator: to look at. wanted: for the message.
    """
    if generator is not None and not isinstance(generator, torch.Generator):
        raise InputError(
            f"generator must be {wanted}, got {generator!r:.60}; torch.Generator().manual_seed(0) makes one "
            "of a seed"
        )


def check_seed(name: str, seed: int) -> None:
    """Raise `InputError` unless a seed is a whole number that all generators take."""
    if not (isinstance(seed, Integral) and 0 <= seed < _SEEDS):
        raise InputError(f"{name} must be a whole number from 0 on, below 2**63, got {seed!r:.60}")


def check_weights(name: str, weights: Tensor) -> None:
    """Raise `InputError` unless all weights are positive and finite."""
    check_finite(name, weights)
    if weights.numel() == 0:
        raise InputError(f"{name} must hold at least one weight, got none")
    if values_visible() and bool((weights <= 0).any()):
        index = int(torch.nonzero((weights <= 0).reshape(-1))[0])
        raise InputError(
            f"{name} must be positive, got {float(weights.reshape(-1)[index]):g} at index {index}; "
            "drop components of zero weight"
        )


def check_variances(name: str, variances: Tensor) -> None:
    """Raise `CovarianceError` unless all variances are positive; NaN may pass."""
    if values_visible() and bool((variances <= 0).any()):
        index = tuple(torch.nonzero(variances <= 0)[0].tolist())
        raise CovarianceError(
            f"{name} must be positive, got {float(variances.detach()[index]):g} at index {index}; "
            f"{STAYS_POSITIVE}"
        )


def check_covariance(name: str, covariance: Tensor) -> None:
    """Raise `CovarianceError` unless every matrix is symmetric and positive definite.

    Args:
        name: the name of the covariance, for the message.
        covariance: [..., D, D].

    Raises:
        ShapeError: not square. InputError: not finite. CovarianceError: not symmetric or not
            positive definite (the index of the first such matrix is named).
    """
    if covariance.ndim < 2 or covariance.shape[-1] != covariance.shape[-2]:
        raise ShapeError(f"{name} must have shape [..., D, D], got {list(covariance.shape)}")
    if not values_visible() or _are_covariances(covariance):
        return
    check_finite(name, covariance)
    scale = covariance.abs().amax((-2, -1)).clamp_min(torch.finfo(covariance.dtype).tiny)
    skew = (covariance - covariance.mT).abs().amax((-2, -1)) / scale
    if bool((skew > _MOST_SKEW).any()):
        index = tuple(int(i) for i in torch.nonzero(skew > _MOST_SKEW)[0])
        raise CovarianceError(
            f"{name} must be symmetric, got a matrix with relative asymmetry {float(skew.max()):.2g}"
            f"{_at(index)}; pass (C + C.mT) / 2 if that is what you mean"
        )
    info = torch.linalg.cholesky_ex((covariance + covariance.mT) / 2).info
    if bool((info != 0).any()):
        index = tuple(int(i) for i in torch.nonzero(info)[0])
        raise CovarianceError(
            f"{name} must be positive definite, got a matrix that is not{_at(index)}; "
            "add a small multiple of the identity or drop its dependent dimensions"
        )


def check_flat_covariance(name: str, covariance: Tensor) -> None:
    """Raise as `check_covariance`, but for covariances without extent in a direction."""
    cov = covariance.double()
    size = cov.abs().amax((-2, -1), keepdim=True).clamp_min(torch.finfo(torch.float32).tiny)
    check_covariance(name, cov + 1e-7 * size * torch.eye(cov.shape[-1]).to(cov))


def _at(index: tuple[int, ...]) -> str:
    """Return where a matrix is among several, for a message; nothing for a single one."""
    return f" at index {index}" if index else ""


def _are_covariances(matrices: Tensor) -> bool:
    """Return whether all matrices are covariances beyond doubt; NaN and infinite numbers are not."""
    skew = (matrices - matrices.mT).abs().amax((-2, -1))
    close = (skew < _MOST_SKEW * matrices.abs().amax((-2, -1))).all()
    info = torch.linalg.cholesky_ex((matrices + matrices.mT) / 2).info
    return bool(look_at(close & ~info.any()))


def refuse_unused(
    options: Iterable[str],
    said: str,
    method: str,
    methods: Iterable[str],
    options_of: Callable[[str], tuple[str, ...]],
) -> None:
    """Raise for the first option that a method does not use, and name the methods that do.

    Args:
        options: names given. said: what is wrong with such an option, after its name.
        method: the one that was chosen, of `methods`. options_of: the options of a method.

    Raises:
        InputError: such an option.
    """
    own = options_of(method)
    for name in options:
        if name in own:
            continue
        others = [other for other in methods if name in options_of(other)]
        raise InputError(
            f"option {name!r} {said}, which has {', '.join(own)}; "
            + (f"it is of {', '.join(others)}" if others else "it is of no method")
        )
