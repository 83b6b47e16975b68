"""Check what filters are given: measurements with masks, noise and lengths, and covariances."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchpose._core.checks import (
    check_covariance,
    check_finite,
    check_floating,
    check_real,
    check_shape,
    check_tensors,
    check_variances,
    refuse_half,
)
from torchpose._core.value_checks import values_visible
from torchpose.errors import InputError, ShapeError
from torchpose.filters._lengths import inside_lengths


class Measurements(NamedTuple):
    """Holds the checked measurements of a batch of sequences.

    Attributes:
        z: [B, T, Z], zero where missing. mask: [B, T, Z], True where measured.
        cov: R [Z, Z], or [B, T, Z, Z] if it changes. lengths: [B].
    """

    z: Tensor
    mask: Tensor
    cov: Tensor
    lengths: Tensor

    def frame(self, t: int) -> "Measurements":
        """Return the measurements of one frame: z [B, Z], mask [B, Z], cov [Z, Z] or [B, Z, Z]."""
        cov = self.cov if self.cov.ndim == 2 else self.cov[:, t]
        return Measurements(self.z[:, t], self.mask[:, t], cov, self.lengths)

    def some(self, chunk: slice) -> "Measurements":
        """Return the measurements of some sequences."""
        cov = self.cov if self.cov.ndim == 2 else self.cov[chunk]
        return Measurements(self.z[chunk], self.mask[chunk], cov, self.lengths[chunk])

    def of_filter(self, i: int) -> "Measurements":
        """Return the measurements of one of some filters side by side."""
        return Measurements(*(values[i] for values in self))

    def as_sequences(self) -> "Measurements":
        """Return the measurements of one frame as sequences of a single frame."""
        cov = self.cov if self.cov.ndim == 2 else self.cov[:, None]
        return Measurements(self.z[:, None], self.mask[:, None], cov, self.lengths)


def check_values(
    z: Tensor, mask: Tensor | None, lengths: Tensor | None, like: Tensor, n_observed: int
) -> tuple[Float[Tensor, "B T Z"], Bool[Tensor, "B T Z"], Int[Tensor, " B"]]:
    """Return measured values, zero where missing, with their mask and lengths; checked.

    Args:
        z: [B, T, Z]. mask: [B, T, Z], True where measured; None is everywhere. lengths: [B]; None is T.
        like: tells device and dtype. n_observed: Z.

    Raises:
        ShapeError, InputError: what does not fit.
    """
    check_floating("z", z)
    check_tensors(z=z)
    refuse_half("z", z)
    check_shape("z", z, ["B", "T", n_observed])
    batch, n_frames = z.shape[:2]
    if batch == 0 or n_frames == 0:
        raise InputError(f"z must hold at least one sequence of one frame, got {list(z.shape)}")
    z = z.to(like)
    lengths = check_lengths(lengths, batch, n_frames, z.device)
    inside = inside_lengths(lengths, n_frames)
    if mask is None:
        mask = inside[..., None].expand(z.shape)
    else:
        if mask.dtype != torch.bool:
            raise InputError(f"mask must be bool (True = measured), got {mask.dtype}")
        check_shape("mask", mask, list(z.shape))
        mask = mask.to(z.device) & inside[..., None]
    check_finite("z", z, mask, "mark missing values with mask=False")
    return torch.where(mask, z, torch.zeros_like(z)), mask, lengths


def check_lengths(
    lengths: Tensor | None, batch: int, n_frames: int, device: torch.device
) -> Int[Tensor, " B"]:
    """Return the frames of each sequence [B] on a device; all of them for None.

    Raises:
        ShapeError: not [B]. InputError: not whole numbers from 1 to T.
    """
    if lengths is None:
        return torch.full((batch,), n_frames, device=device)
    lengths = torch.as_tensor(lengths, device=device)
    check_shape("lengths", lengths, [batch])
    broken = lengths.dtype.is_floating_point or lengths.is_complex() or lengths.dtype == torch.bool
    # unsigned numbers of 16 bits and more cannot be compared
    found = torch.zeros_like(lengths, dtype=torch.long) if broken else lengths.long()
    outside = (found < 1) | (found > n_frames)
    if broken or (values_visible() and bool(outside.any())):
        raise InputError(f"lengths must be integers from 1 to {n_frames}, got {lengths.tolist()}")
    return found


def check_noise(measurement_cov: Tensor, z: Float[Tensor, "B T Z"]) -> Tensor:
    """Return R of these measurements, [Z, Z] or [B, T, Z, Z]; checked.

    Args:
        measurement_cov: one R, or one for every frame, or their diagonals. z: with this noise.

    Raises:
        ShapeError, CovarianceError: what does not fit.
    """
    batch, n_frames, n_observed = z.shape
    trailing = 4 if measurement_cov.ndim >= 3 else 2
    cov = as_covariance("measurement_cov", measurement_cov, n_observed, trailing).to(z.device)
    if trailing == 4:
        check_shape("measurement_cov", cov, [batch, n_frames, n_observed, n_observed])
    return cov


def as_covariance(name: str, value: Tensor, dim: int, trailing: int = 2) -> Tensor:
    """Return a checked covariance [..., D, D], in float64, from one or from its diagonal [..., D].

    Args:
        trailing: number of dimensions of a single full covariance with its leading ones (2 for
            [D, D], 4 for [B, T, D, D]).

    Raises:
        ShapeError, InputError, CovarianceError.
    """
    check_real(name, value)
    value = torch.as_tensor(value, dtype=torch.float64)
    if value.ndim == trailing - 1:
        check_shape(name, value, ["...", dim])
        check_variances(name, value)
        value = torch.diag_embed(value)
    check_shape(name, value, ["...", dim, dim])
    if value.ndim != trailing:
        raise ShapeError(
            f"{name} must have {trailing} dimensions (or {trailing - 1} for diagonals), "
            f"got shape {list(value.shape)}"
        )
    with torch.no_grad():
        check_covariance(name, value)
    return value


def given_covariance(name: str, value: Tensor, dim: int, trailing: int = 2) -> Tensor:
    """Return a checked covariance to be registered: a parameter as it is, else as `as_covariance`.

    A parameter may be the diagonal [D], and stays one.
    """
    covariance = as_covariance(name, value, dim, trailing)
    return value if isinstance(value, nn.Parameter) else covariance


def given_initial_cov(value: Tensor | None, covariances: Tensor) -> Tensor | None:
    """Return a checked initial covariance [D, D], [D] or [K, D, D] to be registered; None for None.

    Args:
        covariances: the covariances of the K components, [K, D, D].
    """
    if value is None:
        return None
    per_component = value.ndim == 3
    if per_component:
        check_shape("initial_cov", value, list(covariances.shape))
    trailing = 3 if per_component else 2
    return given_covariance("initial_cov", value, covariances.shape[-1], trailing)
