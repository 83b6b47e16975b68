"""Climb likelihood maps by mean shift, many windows at once (Burke & Lasenby, section 5.2)."""

from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.checks import check_finite, check_shape
from torchpose.errors import InputError

Kernel = Literal["box", "gaussian"]
_SIDES_PER_STD = 4.0  # of the Gaussian kernel: its window reaches two deviations to either side
_LEAST_MASS = 1e-6  # per pixel of the window; below it the map has no maximum to climb to


class MeanShift(NamedTuple):
    """Holds the result of N mean-shift windows.

    Attributes:
        centre: (x, y), pixels [N, 2]. size: width and height of the window, pixels [N, 2].
        mass: likelihood in the window, summed with the kernel's weights [N].
        covariance: second central moments of the likelihood under the kernel, pixels squared
            [N, 2, 2]; zeros where the mass is zero.
        iterations: steps taken by each window [N]. converged: whether it has converged on some mass [N].
    """

    centre: Float[Tensor, "N 2"]
    size: Float[Tensor, "N 2"]
    mass: Float[Tensor, " N"]
    covariance: Float[Tensor, "N 2 2"]
    iterations: Int[Tensor, " N"]
    converged: Bool[Tensor, " N"]


def mean_shift(
    likelihood: Float[Tensor, "N H W"],
    centre: Float[Tensor, "N 2"],
    size: Float[Tensor, "N 2"],
    kernel: Kernel = "box",
    max_iterations: int = 20,
    tolerance: float = 0.1,
    adapt: float | None = None,
    size_limits: tuple[float, float] = (0.5, 2.0),
) -> MeanShift:
    """Return windows moved to the nearest maxima of their likelihood maps.

        c <- sum_x k(x - c) l(x) x / sum_x k(x - c) l(x)

    k is 1 in the window ("box"; pixels on its border count by the part that is inside) or a Gaussian
    with a quarter of the window's sides as deviations. Kernels are products over the axes, so that
    all moments of a map are two products of matrices; windows stop one by one.

    Args:
        likelihood: maps, not negative, one for each window.
        centre: (x, y) where the windows start, pixels; (0, 0) is the centre of the first pixel.
        size: width and height of the windows, pixels.
        kernel: "box" or "gaussian". max_iterations: at most so many steps.
        tolerance: a window that moves less has converged, pixels.
        adapt: if given, the size adapts to the mass in the window, to adapt * sqrt(mass) in the
            geometric mean of its sides (2 in Bradski's paper); the proportions stay.
        size_limits: smallest and largest size, in sizes at the start.

    Returns:
        The windows after the last step. A window without mass stays and is not converged.

    Raises:
        ShapeError: wrong shapes. InputError: negative or infinite values, settings out of range.

    Reference:
        G. Bradski (1998), "Computer vision face tracking for use in a perceptual user interface",
        as cited by Burke & Lasenby, section 5.2; D. Comaniciu, P. Meer (2002) for the kernels.

    Example:
        >>> import torch
        >>> from torchpose.measure._mean_shift import mean_shift
        >>> likelihood = torch.zeros(1, 40, 60)
        >>> likelihood[0, 10:15, 30:35] = 1.0
        >>> found = mean_shift(likelihood, torch.tensor([[25.0, 15]]), torch.tensor([[16.0, 16]]))
        >>> found.centre.tolist(), found.mass.tolist()
        ([[32.0, 12.0]], [25.0])
    """
    _check(likelihood, centre, size, kernel, max_iterations, tolerance, adapt, size_limits)
    centre, size, start = centre.to(likelihood), size.to(likelihood), size.to(likelihood)
    iterations = torch.zeros(len(centre), dtype=torch.long, device=centre.device)
    active = torch.ones_like(iterations, dtype=torch.bool)
    for _ in range(max_iterations):
        mass, mean, _ = _moments(likelihood, centre, size, kernel)
        active = active & (mass > _LEAST_MASS * size.prod(1))
        if not bool(active.any()):
            break
        wanted = size if adapt is None else _adapted(mass, start, adapt, size_limits)
        change = torch.maximum((mean - centre).norm(dim=1), (wanted - size).abs().amax(1))
        centre = torch.where(active[:, None], mean, centre)
        size = torch.where(active[:, None], wanted, size)
        iterations = iterations + active
        active = active & (change >= tolerance)
    mass, mean, covariance = _moments(likelihood, centre, size, kernel)
    filled = mass > _LEAST_MASS * size.prod(1)
    covariance = torch.where(filled[:, None, None], covariance, 0.0)
    return MeanShift(centre, size, mass, covariance, iterations, filled & ~active)


def _moments(
    likelihood: Tensor, centre: Tensor, size: Tensor, kernel: Kernel
) -> tuple[Tensor, Tensor, Tensor]:
    """Return mass [N], mean [N, 2] and covariance [N, 2, 2] of the maps under their kernels."""
    height, width = likelihood.shape[1:]
    axes = _axes(max(height, width), centre, size, kernel)
    across, down = axes[:, 0, :, :width], axes[:, 1, :, :height]
    table = down @ (likelihood @ across.mT)  # [N, powers of y, powers of x], about the centre
    mass = table[:, 0, 0]
    share = table / mass.clamp_min(torch.finfo(mass.dtype).tiny)[:, None, None]
    x, y, xy = share[:, 0, 1], share[:, 1, 0], share[:, 1, 1]
    xx, yy = share[:, 0, 2] - x * x, share[:, 2, 0] - y * y
    cross = xy - x * y
    covariance = torch.stack([xx, cross, cross, yy], -1).view(-1, 2, 2)
    return mass, centre + torch.stack([x, y], -1), covariance


def _axes(length: int, centre: Tensor, size: Tensor, kernel: Kernel) -> Tensor:
    """Return kernels times powers 0 to 2 of the distance to the centre, by axis [N, 2, 3, length]."""
    place = torch.arange(length, dtype=centre.dtype, device=centre.device)
    away, side = place - centre[..., None], size[..., None]
    if kernel == "box":
        weight = (side / 2 + 0.5 - away.abs()).clamp(0, 1).minimum(side)
    else:
        weight = (-0.5 * (_SIDES_PER_STD * away / side).square()).exp()
    first = weight * away
    return torch.stack([weight, first, first * away], 2)


def _adapted(mass: Tensor, start: Tensor, adapt: float, limits: tuple[float, float]) -> Tensor:
    factor = adapt * (mass / start.prod(1)).sqrt()
    return start * factor.clamp(*limits)[:, None]


def _check(
    likelihood: Tensor,
    centre: Tensor,
    size: Tensor,
    kernel: str,
    max_iterations: int,
    tolerance: float,
    adapt: float | None,
    limits: tuple[float, float],
) -> None:
    check_shape("likelihood", likelihood, ["N", "H", "W"])
    check_shape("centre", centre, [len(likelihood), 2])
    check_shape("size", size, [len(likelihood), 2])
    for name, values in (("likelihood", likelihood), ("centre", centre), ("size", size)):
        check_finite(name, values)
    if bool((likelihood < 0).any()) or bool((size <= 0).any()):
        raise InputError("likelihood must not be negative, and size must be positive, got others")
    if kernel not in ("box", "gaussian"):
        raise InputError(f"kernel must be 'box' or 'gaussian', got {kernel!r}")
    if max_iterations < 1 or not tolerance > 0 or (adapt is not None and not adapt > 0):
        raise InputError(
            "max_iterations must be at least 1, tolerance and adapt positive, got "
            f"{max_iterations}, {tolerance} and {adapt}"
        )
    if not 0 < limits[0] <= limits[1]:
        raise InputError(f"size_limits must be positive and ascending, got {limits}")
