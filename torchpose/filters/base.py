"""The interface of every tracker, its checks, and the one loop over time.

A filter is a fixed model (buffers) and pure steps over a state, which is a NamedTuple. A new tracker
implements `init` and `advance`; shapes, masks, lengths and failures are handled here.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from tqdm.auto import tqdm

from torchpose._core.module_state import (
    WideModule,
    derived,
    one_run,
    register_given,
    working_precision,
)
from torchpose._core.value_checks import values_visible
from torchpose.errors import (
    InputError,
    ShapeError,
    check_covariance,
    check_finite,
    check_floating,
    check_real,
    check_shape,
)
from torchpose.filters.outputs import FilterOutput, StepOutput, collect, effective_sample_size

__all__ = [
    "FilterOutput",
    "Generators",
    "Measurements",
    "RecursiveFilter",
    "StepOutput",
    "as_covariance",
    "effective_sample_size",
    "require_state",
    "standard_normal",
    "uniform",
]

Generators = torch.Generator | Sequence[torch.Generator] | None


class Measurements(NamedTuple):
    """Checked measurements of a batch of sequences.

    Attributes:
        z: [B, T, Z], zero where missing. mask: [B, T, Z], True where measured.
        cov: R [Z, Z], or [B, T, Z, Z] if it changes. lengths: [B].
    """

    z: Tensor
    mask: Tensor
    cov: Tensor
    lengths: Tensor

    def frame(self, t: int) -> "Measurements":
        """The measurements of one frame: z [B, Z], mask [B, Z], cov [Z, Z] or [B, Z, Z]."""
        cov = self.cov if self.cov.ndim == 2 else self.cov[:, t]
        return Measurements(self.z[:, t], self.mask[:, t], cov, self.lengths)

    def as_sequences(self) -> "Measurements":
        """Those of one frame, as sequences of a single frame."""
        cov = self.cov if self.cov.ndim == 2 else self.cov[:, None]
        return Measurements(self.z[:, None], self.mask[:, None], cov, self.lengths)


def standard_normal(
    batch: int, shape: Sequence[int], generator: Generators, like: Tensor
) -> Float[Tensor, "B *shape"]:
    """Standard normal numbers [B, *shape]; with a list of generators, each element draws from its own."""
    kind = {"dtype": like.dtype, "device": like.device}
    if isinstance(generator, torch.Generator) or generator is None:
        return torch.randn(batch, *shape, generator=generator, **kind)
    return torch.stack([torch.randn(*shape, generator=g, **kind) for g in generator])


def uniform(
    batch: int, shape: Sequence[int], generator: Generators, like: Tensor
) -> Float[Tensor, "B *shape"]:
    """Uniform numbers in [0, 1), as `standard_normal`."""
    kind = {"dtype": like.dtype, "device": like.device}
    if isinstance(generator, torch.Generator) or generator is None:
        return torch.rand(batch, *shape, generator=generator, **kind)
    return torch.stack([torch.rand(*shape, generator=g, **kind) for g in generator])


def as_covariance(name: str, value: Tensor, dim: int, trailing: int = 2) -> Tensor:
    """A covariance [..., D, D] from one or from its diagonal [..., D]; checked.

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
    """A covariance to be registered: a parameter as it is, anything else as `as_covariance`; checked.

    A parameter may be the diagonal [D], and stays it.
    """
    covariance = as_covariance(name, value, dim, trailing)
    return value if isinstance(value, nn.Parameter) else covariance


def require_state(state: Any, kind: type, field: str, shape: Sequence[int | None]) -> None:
    """Raise unless a state is of a kind, with a tensor of this shape; for `check_state`.

    Raises:
        InputError: of another filter. ShapeError: of another batch, or of a filter of another size.
    """
    if not isinstance(state, kind):
        raise InputError(
            f"state must be a {kind.__name__} from this filter's init or step, got {type(state).__name__}"
        )
    found = getattr(state, field)
    if not isinstance(found, Tensor):
        raise InputError(f"state.{field} must be a tensor, got {type(found).__name__}")
    try:
        check_shape(f"state.{field}", found, shape)
    except ShapeError as error:
        raise ShapeError(
            f"{error}, for this filter and the {shape[0]} elements of z; begin with init({shape[0]})"
        ) from error


def given_initial_cov(value: Tensor | None, covariances: Tensor) -> Tensor | None:
    """An initial covariance [D, D], [D] or [K, D, D] to be registered; checked, None where none is given.

    Args:
        covariances: of the K components, [K, D, D].
    """
    if value is None:
        return None
    per_component = value.ndim == 3
    if per_component:
        check_shape("initial_cov", value, list(covariances.shape))
    trailing = 3 if per_component else 2
    return given_covariance("initial_cov", value, covariances.shape[-1], trailing)


class RecursiveFilter(WideModule, ABC):
    """A recursive Bayesian filter over batches of sequences.

    Args:
        measurement_cov: R, [Z, Z] or its diagonal [Z].
        observed: the Z state indices that are measured (the rows of H in BL 15).
        dim: number of state dimensions D.
        dtype: of means, particles and measurements; covariances are always float64.
    """

    def __init__(
        self,
        measurement_cov: Tensor,
        observed: Sequence[int] | Tensor,
        dim: int,
        dtype: torch.dtype,
    ) -> None:
        super().__init__()
        index = torch.as_tensor(observed, dtype=torch.long)
        check_shape("observed", index, ["Z"])
        inside = bool(((index >= 0) & (index < dim)).all())
        if index.numel() == 0 or not inside or index.unique().numel() != index.numel():
            raise InputError(
                f"observed must hold distinct state indices in [0, {dim}), got {index.tolist()}"
            )
        self.dim = dim
        self.dtype = working_precision("dtype", dtype)
        register_given(self, "observed", index)
        noise = given_covariance("measurement_cov", measurement_cov, index.numel())
        register_given(self, "measurement_cov", noise)

    observed: Tensor
    measurement_cov: Tensor

    @abstractmethod
    def init(self, batch_size: int, generator: Generators = None) -> Any:
        """The state before the first measurement; the first step predicts, then updates."""

    @abstractmethod
    def advance(
        self, state: Any, frame: Measurements, generator: Generators, return_cov: bool
    ) -> tuple[Any, StepOutput]:
        """One time step on checked measurements of one frame."""

    def check_state(self, state: Any, batch: int) -> None:
        """Raise unless a state is one of this filter's, of so many elements; filters may leave it out."""

    def step(
        self,
        state: Any,
        z: Float[Tensor, "B Z"],
        mask: Bool[Tensor, "B Z"] | None = None,
        measurement_cov: Tensor | None = None,
        generator: Generators = None,
        return_cov: bool = False,
    ) -> tuple[Any, StepOutput]:
        """One time step online: the same numbers as the same frame of `forward`.

        Args:
            state: from `init` or the step before. z: [B, Z], pixels. mask: [B, Z], True = measured.
            measurement_cov: R of this frame, [Z, Z] or [B, Z, Z]; None is the filter's own.
            generator: for filters that draw; a generator, or a list of one for each element.
            return_cov: whether to return the covariance as well.

        Returns:
            The next state and a `StepOutput`.

        Raises:
            ShapeError, InputError, CovarianceError: as `forward`.
        """
        check_shape("z", z, ["B", self.observed.numel()])
        self.check_state(state, len(z))
        if measurement_cov is not None and measurement_cov.ndim == 3:
            measurement_cov = measurement_cov[:, None]
        mask = None if mask is None else mask[:, None]
        with one_run(self.observed.device):
            frames = self.check(z[:, None], mask, measurement_cov, None, generator)
            return self.advance(state, frames.frame(0), generator, return_cov)

    def forward(
        self,
        z: Float[Tensor, "B T Z"],
        mask: Bool[Tensor, "B T Z"] | None = None,
        measurement_cov: Tensor | None = None,
        lengths: Int[Tensor, " B"] | None = None,
        generator: Generators = None,
        return_cov: bool = False,
        progress: bool = False,
    ) -> FilterOutput:
        """Filter a batch of sequences.

        Args:
            z: measurements [B, T, Z] in the units of the state (pixels). mask: [B, T, Z], True where
                measured; what z holds elsewhere is ignored. measurement_cov: R [Z, Z] or
                [B, T, Z, Z], overrides the filter's own. lengths: [B], frames of each sequence.
            generator: for filters that draw; a generator, or a list of B generators, one for each
                element, which makes an element's numbers independent of its batch.
            return_cov: whether to return covariances. progress: whether to show a progress bar.

        Returns:
            `FilterOutput`.

        Raises:
            ShapeError: wrong shapes. InputError: empty sequences, NaN or infinite values that are
            not masked, lengths outside 1..T. CovarianceError: R not symmetric positive definite.
        """
        with one_run(self.observed.device):
            frames = self.check(z, mask, measurement_cov, lengths, generator)
            return self.run(frames, generator, return_cov, progress)

    def run(
        self, frames: Measurements, generator: Generators, return_cov: bool, progress: bool
    ) -> FilterOutput:
        """The loop over time, on checked measurements."""
        batch, n_frames = frames.z.shape[:2]
        state = self.init(batch, generator)
        steps = []
        times = range(n_frames)
        # a bar that shows nothing would still keep torch.compile out
        for t in tqdm(times, unit="frame") if progress else times:
            state, out = self.advance(state, frames.frame(t), generator, return_cov)
            steps.append(out)
        return collect(steps, frames.lengths)

    def check(
        self,
        z: Tensor,
        mask: Tensor | None,
        measurement_cov: Tensor | None,
        lengths: Tensor | None,
        generator: Generators,
    ) -> Measurements:
        """Check the arguments of `forward` before any work is done."""
        check_floating("z", z)
        check_shape("z", z, ["B", "T", self.observed.numel()])
        batch, n_frames = z.shape[:2]
        if batch == 0 or n_frames == 0:
            raise InputError(f"z must hold at least one sequence of one frame, got {list(z.shape)}")
        z = z.to(self.observed.device, self.dtype)
        lengths = self._check_lengths(lengths, batch, n_frames)
        inside = torch.arange(n_frames, device=z.device) < lengths[:, None]
        if mask is None:
            mask = inside[..., None].expand(z.shape)
        else:
            if mask.dtype != torch.bool:
                raise InputError(f"mask must be bool (True = measured), got {mask.dtype}")
            check_shape("mask", mask, list(z.shape))
            mask = mask.to(z.device)
            mask = mask & inside[..., None]
        check_finite("z", z, mask, "mark missing values with mask=False")
        z = torch.where(mask, z, torch.zeros_like(z))
        if measurement_cov is None:
            cov = self._own_noise()
        else:
            n = self.observed.numel()
            trailing = 4 if measurement_cov.ndim >= 3 else 2
            cov = as_covariance("measurement_cov", measurement_cov, n, trailing).to(z.device)
            if trailing == 4:
                check_shape("measurement_cov", cov, [batch, n_frames, n, n])
        if isinstance(generator, Sequence) and len(generator) != batch:
            raise InputError(
                f"a list of generators must hold one for each of the {batch} sequences, "
                f"got {len(generator)}"
            )
        return Measurements(z, mask, cov, lengths)

    def _own_noise(self) -> Float[Tensor, "Z Z"]:
        """R of the filter, float64."""
        given, count = self.measurement_cov, self.observed.numel()
        sources = (given,)
        return derived(self, "R", sources, lambda: as_covariance("measurement_cov", given, count))

    def _check_lengths(self, lengths: Tensor | None, batch: int, n_frames: int) -> Tensor:
        device = self.observed.device
        if lengths is None:
            return torch.full((batch,), n_frames, device=device)
        lengths = torch.as_tensor(lengths, device=device)
        check_shape("lengths", lengths, [batch])
        broken = lengths.dtype.is_floating_point or lengths.is_complex()
        outside = torch.zeros_like(lengths) if broken else (lengths < 1) | (lengths > n_frames)
        if broken or (values_visible() and bool(outside.any())):
            raise InputError(
                f"lengths must be integers from 1 to {n_frames}, got {lengths.tolist()}"
            )
        return lengths.long()
