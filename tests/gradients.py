"""What asking for gradients may and may not do, for any function of a tensor."""

from collections.abc import Callable, Iterable

import torch
from torch import Tensor


def assert_differentiable(
    function: Callable[[Tensor], Iterable[Tensor]],
    x: Tensor,
    step: float = 1e-5,
    tolerance: float = 1e-5,
    same: float = 1e-10,
) -> None:
    """Outputs do not change when gradients are asked for, and these are those of the function.

    Gradients of random weighted sums of each output are held against central differences along random
    directions.

    Args:
        function: float64 to a few tensors. x: where. step: of the differences, in units of x.
        tolerance: relative, of the gradients. same: of the outputs, relative where they exceed one.
    """
    with torch.no_grad():
        plain = list(function(x))
    leaf = x.clone().requires_grad_()
    learning = list(function(leaf))
    for ours, expected in zip(learning, plain, strict=True):
        torch.testing.assert_close(ours.detach(), expected, rtol=same, atol=same, equal_nan=True)
    generator = torch.Generator().manual_seed(0)
    weights = [_random_like(out, generator) / out.abs().nanmean().clamp_min(1e-3) for out in plain]
    gradients = []
    for i, weight in enumerate(weights):
        (gradient,) = torch.autograd.grad(
            (learning[i] * weight).nansum(), leaf, retain_graph=True, allow_unused=True
        )
        assert gradient is not None, f"output {i} has no gradient"
        assert bool(gradient.isfinite().all()), f"the gradient of output {i} is not finite"
        gradients.append(gradient)
    for direction in (_random_like(x, generator), _random_like(x, generator)):
        ahead, behind = _outputs(function, x, step * direction)
        for i, (weight, gradient) in enumerate(zip(weights, gradients, strict=True)):
            slope = ((ahead[i] - behind[i]) * weight).nansum() / (2 * step)
            found = (gradient * direction).sum()
            scale = gradient.norm() * direction.norm() / max(direction.numel(), 1) ** 0.5
            assert abs(found - slope) <= tolerance * max(scale, abs(slope), 1e-6), (
                f"output {i}: gradient {found:.8g}, differences {slope:.8g}"
            )


def assert_without_gradient(function: Callable[[Tensor], Iterable[Tensor]], x: Tensor) -> None:
    """Outputs do not change when gradients are asked for, and have none."""
    with torch.no_grad():
        plain = list(function(x))
    for ours, expected in zip(function(x.clone().requires_grad_()), plain, strict=True):
        assert not ours.requires_grad
        torch.testing.assert_close(ours, expected, rtol=0, atol=0, equal_nan=True)


@torch.no_grad()
def _outputs(
    function: Callable[[Tensor], Iterable[Tensor]], x: Tensor, shift: Tensor
) -> tuple[list[Tensor], list[Tensor]]:
    return list(function(x + shift)), list(function(x - shift))


def _random_like(x: Tensor, generator: torch.Generator) -> Tensor:
    return torch.randn(x.shape, generator=generator, dtype=x.dtype)
