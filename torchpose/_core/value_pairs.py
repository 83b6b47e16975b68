"""Check values that are compared, such as estimates and truth: one shape and precision, boolean masks."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchpose._core.checks import check_floating, check_shape
from torchpose.errors import InputError, ShapeError


def as_values(name: str, values: Tensor, sizes: Sequence[int | str | None]) -> Tensor:
    """Return real numbers of these sizes, in single precision or double; half precision is widened.

    Raises:
        InputError: whole or complex numbers. ShapeError: other sizes, or a point of no dimensions.
    """
    check_floating(name, values)
    check_shape(name, values, sizes)
    if len(sizes) > 1 and 0 in values.shape[len(values.shape) - len(sizes) + 1 :]:
        raise ShapeError(f"{name} must hold joints of some dimensions, got {list(values.shape)}")
    return values.to(torch.promote_types(values.dtype, torch.float32))


def as_pair(
    estimate: Tensor,
    truth: Tensor,
    mask: Tensor | None,
    sizes: Sequence[int | str | None],
    names: tuple[str, str] = ("estimate", "truth"),
) -> tuple[Tensor, Tensor]:
    """Return both in the wider of their precisions; `mask` is of the same frames and joints.

    Raises:
        InputError: whole or complex numbers, a mask that is not bool. ShapeError: other sizes, or sizes
            that differ.
    """
    estimate, truth = (
        as_values(n, x, sizes) for n, x in zip(names, (estimate, truth), strict=True)
    )
    check_shape(names[1], truth, list(estimate.shape))
    check_mask(mask, estimate.shape[:-1])
    dtype = torch.promote_types(estimate.dtype, truth.dtype)
    return estimate.to(dtype), truth.to(dtype)


def check_mask(mask: Tensor | None, shape: Sequence[int]) -> None:
    """Raise unless a mask is None, or bool and of this shape."""
    if mask is None:
        return
    if mask.dtype != torch.bool:
        raise InputError(f"mask must be bool (True = count the joint), got {mask.dtype}")
    check_shape("mask", mask, list(shape))
