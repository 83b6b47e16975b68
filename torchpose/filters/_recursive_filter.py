"""Define the interface of the recursive filters: checks of measurements, and the one loop over time.

A filter is a fixed model (buffers) and pure steps over a state, which is a NamedTuple. A new filter
implements `init` and `filter_frame`; shapes, masks, lengths and failures are handled here.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Bool, Float, Integer
from torch import Tensor
from tqdm.auto import tqdm

from torchpose._core.checks import check_generator, check_shape
from torchpose._core.former_arguments import rename_former_hook, takes_former_arguments
from torchpose._core.module_state import (
    WideModule,
    derived,
    one_run,
    register_given,
    working_precision,
)
from torchpose.errors import InputError, ShapeError
from torchpose.filters._measurements import (
    Measurements,
    as_covariance,
    check_noise,
    check_values,
    given_covariance,
)
from torchpose.filters._outputs import FilterOutput, StepOutput, collect

Generators = torch.Generator | Sequence[torch.Generator] | None
"""One generator, a list of one for each element of the batch, or None for PyTorch's own."""


def standard_normal(
    batch: int, shape: Sequence[int], generator: Generators, like: Tensor
) -> Float[Tensor, "B *shape"]:
    """Draw standard normal numbers.

    Args:
        batch: B. shape: of one element. generator: with a list, each element draws from its own, and its
            numbers do not depend on the batch. like: tells dtype and device.

    Returns:
        [B, *shape], of the dtype and on the device of `like`.

    Raises:
        InputError: neither a generator nor a list of B of them.
    """
    check_generators(generator, batch)
    kind = {"dtype": like.dtype, "device": like.device}
    if isinstance(generator, torch.Generator) or generator is None:
        return torch.randn(batch, *shape, generator=generator, **kind)
    return torch.stack([torch.randn(*shape, generator=g, **kind) for g in generator])


def uniform(
    batch: int, shape: Sequence[int], generator: Generators, like: Tensor
) -> Float[Tensor, "B *shape"]:
    """Draw uniform numbers in [0, 1).

    Args:
        batch: B. shape: of one element. generator: with a list, each element draws from its own, and its
            numbers do not depend on the batch. like: tells dtype and device.

    Returns:
        [B, *shape], of the dtype and on the device of `like`.

    Raises:
        InputError: neither a generator nor a list of B of them.
    """
    check_generators(generator, batch)
    kind = {"dtype": like.dtype, "device": like.device}
    if isinstance(generator, torch.Generator) or generator is None:
        return torch.rand(batch, *shape, generator=generator, **kind)
    return torch.stack([torch.rand(*shape, generator=g, **kind) for g in generator])


def check_generators(generator: Generators, batch: int) -> None:
    """Raise `InputError` for what is no generator, and a list that does not hold one for each sequence."""
    if generator is None:
        return
    several = isinstance(generator, Sequence)
    each: Sequence[Any] = generator if isinstance(generator, Sequence) else [generator]
    for one in each:
        check_generator(one, "a torch.Generator, or a list of them")
    if several and len(each) != batch:
        raise InputError(
            f"a list of generators must hold {batch}, one for each sequence, got {len(each)}"
        )


def check_lag(lag: int | None) -> None:
    """Raise `InputError` for a negative number of later frames."""
    if lag is not None and lag < 0:
        raise InputError(
            f"lag must be at least 0 frames, or None for the whole sequence, got {lag}"
        )


def require_state(state: Any, kind: type, field: str, shape: Sequence[int | None]) -> None:
    """Raise unless a state is of this type, with a tensor of this shape; for `check_state`.

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


class RecursiveFilter(WideModule, ABC):
    """Filters batches of sequences by a recursive Bayesian filter; base class of all filters.

    `forward` filters whole sequences; `init`, then `step` (one frame) or `advance` (some more frames)
    give the same numbers online. `smooth` uses later frames too, where a filter can. Randomness, masks
    and noise have the same arguments in all of them.

    A filter implements `init` and `filter_frame`, which get checked arguments. It may override
    `filter_frames`, the loop over time, where it has a faster way, and `smooth_frames`.

    Args:
        measurement_cov: R, [Z, Z] or its diagonal [Z].
        observed: the Z state indices that are measured (the rows of H in BL 15).
        dim: number of state dimensions D.
        dtype: the floating-point type of means, particles and measurements; covariances are always float64.
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

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        rename_former_hook(cls, "advance", "filter_frame")

    @abstractmethod
    def init(self, batch_size: int, *, generator: Generators = None) -> Any:
        """Return the state before the first measurement; the first step predicts, then updates.

        Args:
            batch_size: B, number of sequences.
            generator: for filters that draw; one generator, or a list of one for each sequence.

        Returns:
            State of B sequences, a named tuple of tensors.

        Raises:
            InputError: batch_size below 1.
        """

    @abstractmethod
    def filter_frame(
        self, state: Any, frame: Measurements, generator: Generators, return_cov: bool
    ) -> tuple[Any, StepOutput]:
        """Filter one frame, given its checked measurements.

        Args:
            state: the state of the B sequences, from `init` or the frame before.
            frame: checked measurements of one frame: z [B, Z], mask [B, Z], cov [Z, Z] or [B, Z, Z].
            generator: for filters that draw; one generator, or a list of one for each sequence.
            return_cov: whether to return the covariance as well.

        Returns:
            The next state, and a `StepOutput` with the mean [B, D].
        """

    def check_state(self, state: Any, batch: int) -> None:
        """Check that a state is one of this filter's, for a batch of this size; checks nothing by default.

        Args:
            state: as a step would take it.
            batch: B, number of sequences.

        Raises:
            InputError: a state of another kind of filter. ShapeError: another batch size, or a filter
                of other sizes.
        """

    @takes_former_arguments
    def step(
        self,
        state: Any,
        z: Float[Tensor, "B Z"],
        mask: Bool[Tensor, "B Z"] | None = None,
        measurement_cov: Tensor | None = None,
        *,
        generator: Generators = None,
        return_cov: bool = False,
    ) -> tuple[Any, StepOutput]:
        """Filter one frame online: the same numbers as the same frame of `forward`.

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
            return self.filter_frame(state, frames.frame(0), generator, return_cov)

    @takes_former_arguments
    def advance(
        self,
        state: Any,
        z: Float[Tensor, "B T Z"],
        mask: Bool[Tensor, "B T Z"] | None = None,
        measurement_cov: Tensor | None = None,
        *,
        generator: Generators = None,
        return_cov: bool = False,
        progress: bool = False,
    ) -> tuple[Any, FilterOutput]:
        """Filter some more frames online: the same numbers as `step` for one after the other.

        Args:
            state: from `init`, `step` or `advance`. z, mask, measurement_cov, generator, return_cov,
                progress: as `forward`.

        Returns:
            The next state and a `FilterOutput`, whose `failed_at` counts from the first of these frames.

        Raises:
            ShapeError, InputError, CovarianceError: as `forward`.
        """
        check_shape("z", z, ["B", "T", self.observed.numel()])
        self.check_state(state, len(z))
        with one_run(self.observed.device):
            frames = self.check(z, mask, measurement_cov, None, generator)
            return self.continue_frames(state, frames, generator, return_cov, progress)

    @takes_former_arguments
    def forward(
        self,
        z: Float[Tensor, "B T Z"],
        mask: Bool[Tensor, "B T Z"] | None = None,
        measurement_cov: Tensor | None = None,
        *,
        generator: Generators = None,
        lengths: Integer[Tensor, " B"] | None = None,
        return_cov: bool = False,
        progress: bool = False,
    ) -> FilterOutput:
        """Filter a batch of sequences.

        Args:
            z: measurements [B, T, Z] in the units of the state (pixels). mask: [B, T, Z], True where
                measured; what z holds elsewhere is ignored. measurement_cov: R [Z, Z] or
                [B, T, Z, Z], overrides the filter's own.
            generator: for filters that draw; a generator, or a list of B generators, one for each
                element, which makes an element's numbers independent of its batch.
            lengths: [B], frames of each sequence; past them its last estimate is repeated.
            return_cov: whether to return covariances. progress: whether to show a progress bar.

        Returns:
            `FilterOutput`.

        Raises:
            ShapeError: wrong shapes. InputError: empty sequences, NaN or infinite values that are
            not masked, lengths outside 1..T. CovarianceError: R not symmetric positive definite.
        """
        with one_run(self.observed.device):
            frames = self.check(z, mask, measurement_cov, lengths, generator)
            return self.filter_frames(frames, generator, return_cov, progress)

    if TYPE_CHECKING:  # nn.Module has Any
        __call__ = forward

    @takes_former_arguments
    def smooth(
        self,
        z: Float[Tensor, "B T Z"],
        mask: Bool[Tensor, "B T Z"] | None = None,
        measurement_cov: Tensor | None = None,
        *,
        lengths: Integer[Tensor, " B"] | None = None,
        lag: int | None = None,
        return_cov: bool = False,
    ) -> FilterOutput:
        """Return estimates that use later measurements too, of filters that can: `FixedTrackFilter`.

        Args:
            z, mask, measurement_cov, lengths, return_cov: as `forward`.
            lag: number of later frames that each estimate may use; None is the whole sequence.

        Returns:
            `FilterOutput` with smoothed mean, weights and covariance, and the filter's log-evidence.

        Raises:
            InputError: the filter cannot smooth, or not with its options (`smooth_frames`), or lag is
            negative; else as `forward`.
        """
        check_lag(lag)
        with one_run(self.observed.device):
            frames = self.check(z, mask, measurement_cov, lengths, None)
            return self.smooth_frames(frames, lag, return_cov)

    def smooth_frames(
        self, frames: Measurements, lag: int | None, return_cov: bool
    ) -> FilterOutput:
        """Smooth whole sequences, given checked measurements; refused here, by filters that cannot.

        Args:
            frames: checked measurements: z [B, T, Z], mask [B, T, Z], cov [Z, Z] or [B, T, Z, Z], lengths
                [B].
            lag: number of later frames that an estimate may use; None is all of them.
            return_cov: whether to return covariances as well.

        Returns:
            `FilterOutput` with smoothed means [B, T, D].

        Raises:
            InputError: the filter cannot smooth.
        """
        raise InputError(
            f"{type(self).__name__} cannot smooth: that needs tracks='fixed' (FixedTrackFilter), whose "
            "tracks have a past each"
        )

    def filter_frames(
        self, frames: Measurements, generator: Generators, return_cov: bool, progress: bool
    ) -> FilterOutput:
        """Filter whole sequences, given checked measurements.

        Args:
            frames: checked measurements: z [B, T, Z], mask [B, T, Z], cov [Z, Z] or [B, T, Z, Z], lengths
                [B].
            generator: for filters that draw; one generator, or a list of one for each sequence.
            return_cov: whether to return covariances as well.
            progress: whether to show a progress bar.

        Returns:
            `FilterOutput` with means [B, T, D].
        """
        state = self.init(len(frames.z), generator=generator)
        return self.continue_frames(state, frames, generator, return_cov, progress)[1]

    def continue_frames(
        self,
        state: Any,
        frames: Measurements,
        generator: Generators,
        return_cov: bool,
        progress: bool = False,
    ) -> tuple[Any, FilterOutput]:
        """Filter some more frames one by one, given checked measurements.

        Args:
            state: the state of the B sequences, from `init` or the frames before.
            frames: checked measurements: z [B, T, Z], mask [B, T, Z], cov [Z, Z] or [B, T, Z, Z], lengths
                [B].
            generator: for filters that draw; one generator, or a list of one for each sequence.
            return_cov: whether to return covariances as well.
            progress: whether to show a progress bar.

        Returns:
            The next state, and a `FilterOutput` with means [B, T, D].
        """
        steps = []
        times = range(frames.z.shape[1])
        # a bar that shows nothing would still keep torch.compile out
        for t in tqdm(times, unit="frame") if progress else times:
            state, out = self.filter_frame(state, frames.frame(t), generator, return_cov)
            steps.append(out)
        return state, collect(steps, frames.lengths)

    def check(
        self,
        z: Tensor,
        mask: Tensor | None,
        measurement_cov: Tensor | None,
        lengths: Tensor | None,
        generator: Generators,
    ) -> Measurements:
        """Check the arguments of `forward` before any work is done.

        Args:
            z: measurements [B, T, Z], in the units of the state.
            mask: [B, T, Z], True where measured; None is everywhere.
            measurement_cov: R [Z, Z] or [B, T, Z, Z]; None is the filter's own. lengths: [B], or None for T.
            generator: one generator, a list of B of them, or None.

        Returns:
            `Measurements`, with the defaults filled in.

        Raises:
            ShapeError: wrong shapes. InputError: empty sequences, NaN or infinite values that are not masked,
                lengths outside 1..T, a list of another number of generators.
            CovarianceError: R not symmetric positive definite.
        """
        like = torch.empty(0, dtype=self.dtype, device=self.observed.device)
        z, mask, lengths = check_values(z, mask, lengths, like, self.observed.numel())
        cov = self.own_noise() if measurement_cov is None else check_noise(measurement_cov, z)
        check_generators(generator, len(z))
        return Measurements(z, mask, cov, lengths)

    def own_noise(self) -> Float[Tensor, "Z Z"]:
        """Return R of the filter, float64."""
        given, count = self.measurement_cov, self.observed.numel()
        sources = (given,)
        return derived(self, "R", sources, lambda: as_covariance("measurement_cov", given, count))
