"""Define the mixture Kalman filter: its model, its state, and the choice of tracks (paper section 3.4).

`FixedTrackFilter`, `SampledTrackFilter` and `SplitTrackFilter` are the three kinds of it.
"""

import inspect
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, ClassVar, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_choice, check_count
from torchpose._core.former_arguments import takes_former_arguments
from torchpose._core.module_state import derived, register_given, wide_or_parameter
from torchpose.errors import InputError
from torchpose.filters._measurements import (
    Measurements,
    as_covariance,
    given_covariance,
    given_initial_cov,
)
from torchpose.filters._outputs import StepOutput
from torchpose.filters._recursive_filter import Generators, RecursiveFilter, require_state
from torchpose.filters._transition import (
    BURN_IN_SCALE,
    Transition,
    check_transition_options,
    inflation,
    make_transition,
)
from torchpose.filters._weights import normalise
from torchpose.math._gaussian import definite_cholesky
from torchpose.priors._gaussian_mixture import GaussianMixture


class MKFState(NamedTuple):
    """Holds weighted Kalman tracks.

    Attributes:
        log_weights: log w that the next step starts from (epsilon mixed in), [B, M].
        mean: track means [B, M, D]. cov: track covariances [G, M, D, D], float64.
        group: which row of `cov` each element has, [B]; elements whose histories of masks and
            noise are the same share one row.
        time: number of frames seen.
    """

    log_weights: Tensor
    mean: Tensor
    cov: Tensor
    group: Tensor
    time: int


class MixtureKalmanFilter(RecursiveFilter):
    """Filters by a mixture Kalman filter, a mixture of Ornstein-Uhlenbeck motion models.

    Given its indicator i, the state follows (BL 32)
        x_t = F_i x_{t-1} + (I - F_i) mu_i + N(0, N_i),  F_i = Sigma_i (Q + Sigma_i)^-1,
    and is measured through z_t = H x_t + N(0, R) (BL 33). Each track is one history of indicators
    with a Kalman filter of its own (BL 34-42); the estimate is the weighted mean (BL 48).

    There are three kinds of tracks, each a class of its own with its own options. A call of this class
    makes a filter of the kind that `tracks` names:

    - "fixed", `FixedTrackFilter`: track j always keeps indicator j (BL 49).
    - "sampled", `SampledTrackFilter`: indicators are drawn from pi (BL 47), and tracks are resampled.
    - "split", `SplitTrackFilter`: every track is continued by every component, and the M likeliest are
      kept (Smith & Winter).

    Args:
        gmm: the mixture prior (BL 7), K components over D dimensions.
        process_cov: Q, [D, D] or its diagonal [D], per frame.
        measurement_cov: R, [Z, Z] or its diagonal [Z].
        observed: the Z state indices that are measured.
        tracks: "fixed", "sampled" or "split".
        initial_cov: covariance of every track before the first prediction, [D, D], [D] or [K, D, D];
            by default that of its component.
        transition: "paper", "stationary" or "ou", see `make_transition`. gamma, subspace: of "ou".
        burn_in: number of frames over which Q starts inflated and decays to itself geometrically (paper
            section 3.3, after BL 26). 0 is no burn-in, as it has to be for "ou", which has no Q.
        burn_in_scale: factor of Q in the first frame of the burn-in; 100 by default.
        dtype: the floating-point type of means and measurements; covariances are always float64.
        n_tracks: see `SampledTrackFilter`, `SplitTrackFilter`.
        resample_threshold: see `SampledTrackFilter`.
        uniform_weight, likelihood_power, weighting, reset_below, medians: see `FixedTrackFilter`.

    Attributes:
        tracks: the kind. n_tracks: M. dim: D.
        means, covariances: of the components, [K, D] and [K, D, D]. log_prior: log pi [K].

    Raises:
        InputError, ShapeError, CovarianceError: for what does not fit, before any work; InputError also
            for an option that the kind of tracks, weighting or transition does not use.

    Reference:
        M. Burke, J. Lasenby, "Single camera pose estimation using Bayesian filtering and Kinect
        motion priors", eqs 27-49. R. Chen, J. S. Liu, "Mixture Kalman filters" (2000).

    Example:
        >>> import torch
        >>> from torchpose.filters import MixtureKalmanFilter
        >>> from torchpose.priors import GaussianMixture
        >>> prior = GaussianMixture(
        ...     torch.tensor([0.5, 0.5]), torch.tensor([[0.0, 0.0], [4.0, 4.0]]),
        ...     torch.eye(2).expand(2, 2, 2))
        >>> f = MixtureKalmanFilter(prior, torch.ones(2), torch.ones(1), observed=[0])
        >>> out = f(torch.full((1, 20, 1), 4.0))
        >>> bool((out.mean[0, -1] > 3).all())
        True
    """

    tracks: ClassVar[str]
    log_prior: Tensor
    means: Tensor
    covariances: Tensor
    process_cov: Tensor
    initial_cov: Tensor | None
    gamma: Tensor | None

    _kinds: ClassVar[dict[str, type["MixtureKalmanFilter"]]] = {}

    def __init_subclass__(cls, tracks: str | None = None, **options: Any) -> None:
        super().__init_subclass__(**options)
        if tracks is not None:
            cls.tracks = tracks
            cls._kinds[tracks] = cls

    def __init__(
        self,
        gmm: GaussianMixture,
        process_cov: Tensor,
        measurement_cov: Tensor,
        observed: Sequence[int] | Tensor,
        tracks: str = "fixed",
        n_tracks: int | None = None,
        uniform_weight: float | None = None,
        initial_cov: Tensor | None = None,
        transition: str = "paper",
        gamma: Tensor | float | None = None,
        subspace: int | None = None,
        resample_threshold: float | None = None,
        burn_in: int = 0,
        burn_in_scale: float | None = None,
        likelihood_power: float = 1.0,
        weighting: str = "sequence",
        reset_below: float | None = None,
        dtype: torch.dtype = torch.float64,
        medians: Sequence[int] = (),
    ) -> None:
        if type(self) is not MixtureKalmanFilter:
            raise InputError(
                f"{type(self).__name__} must be derived from the class of its tracks: "
                f"{', '.join(kind.__name__ for kind in self._kinds.values())}"
            )
        if tracks == "fixed" and n_tracks == gmm.n_components:
            n_tracks = None  # which fixed tracks always are
        kind = _kind_of(tracks)
        options = _options_of(kind, {
            "n_tracks": n_tracks, "uniform_weight": uniform_weight, "initial_cov": initial_cov,
            "transition": transition, "gamma": gamma, "subspace": subspace,
            "resample_threshold": resample_threshold, "burn_in": burn_in,
            "burn_in_scale": burn_in_scale, "likelihood_power": likelihood_power,
            "weighting": weighting, "reset_below": reset_below, "dtype": dtype, "medians": medians,
        })  # fmt: skip
        self.__class__ = kind
        kind.__init__(self, gmm, process_cov, measurement_cov, observed, **options)

    def __setstate__(self, state: dict[str, Any]) -> None:
        if type(self) is MixtureKalmanFilter:  # pickled before the kinds had classes of their own
            self.__class__ = self._kinds[state["tracks"]]
        super().__setstate__(state)

    def _register_model(
        self,
        gmm: GaussianMixture,
        process_cov: Tensor,
        measurement_cov: Tensor,
        observed: Sequence[int] | Tensor,
        *,
        n_tracks: int | None,
        initial_cov: Tensor | None,
        transition: str,
        gamma: Tensor | float | None,
        subspace: int | None,
        burn_in: int,
        burn_in_scale: float | None,
        dtype: torch.dtype,
    ) -> None:
        """Register what filters of every kind have; the first call of their constructors."""
        RecursiveFilter.__init__(self, measurement_cov, observed, gmm.dim, dtype)
        check_transition_options(transition, gamma, subspace, burn_in, burn_in_scale)
        if n_tracks is not None:
            check_count("n_tracks", n_tracks)
        self.n_tracks = n_tracks or gmm.n_components
        self.transition_kind, self.subspace = transition, subspace
        self.burn_in = burn_in
        self.burn_in_scale = BURN_IN_SCALE if burn_in_scale is None else float(burn_in_scale)
        weights = gmm.weights.to(torch.float64)
        register_given(self, "log_prior", (weights / weights.sum()).log())
        register_given(self, "means", wide_or_parameter(gmm.means))
        register_given(self, "covariances", wide_or_parameter(gmm.covariances))
        register_given(self, "process_cov", given_covariance("process_cov", process_cov, self.dim))
        register_given(self, "gamma", wide_or_parameter(gamma))
        register_given(self, "initial_cov", given_initial_cov(initial_cov, self.covariances))
        self.to(gmm.means.device)
        self.transition(self.burn_in)  # raises what does not fit before any work

    @property
    def sources(self) -> tuple[Tensor, ...]:
        """Return the tensors that every gain depends on, beside R."""
        tensors = (self.log_prior, self.means, self.covariances, self.process_cov)
        return (*tensors, *(t for t in (self.gamma, self.initial_cov) if t is not None))

    @property
    def start_cov(self) -> Float[Tensor, "K D D"]:
        """Return the covariance of every component's track before the first prediction."""
        if self.initial_cov is None:
            return self.covariances.to(torch.float64)
        cov = as_covariance("initial_cov", self.initial_cov, self.dim, self.initial_cov.ndim)
        return cov.expand(self.means.shape[0], -1, -1)

    @property
    def is_memoryless(self) -> bool:
        """Return whether frames do not depend on each other: neither weights nor states do."""
        return False

    def transition(self, time: int) -> Transition:
        """Return the transition into one frame, with the inflated Q of the burn-in.

        Args:
            time: number of the frame, 0 is the first.

        Returns:
            `Transition` of K components: F [K, D, D], b [K, D] and N [K, D, D].
        """
        if time < self.burn_in:
            return self._make_transition(inflation(time, self.burn_in, self.burn_in_scale))
        sources = (self.means, self.covariances, self.process_cov, self.gamma)
        return derived(self, "transition", sources, lambda: self._make_transition(1.0))

    def _make_transition(self, inflated: float) -> Transition:
        wide = torch.float64
        if self.covariances.requires_grad:
            definite_cholesky("covariances of the prior", self.covariances.detach().to(wide))
        return make_transition(
            self.transition_kind,
            self.means.to(wide),
            self.covariances.to(wide),
            inflated * as_covariance("process_cov", self.process_cov, self.dim),
            None if self.gamma is None else self.gamma.to(wide),
            self.subspace,
        )

    @takes_former_arguments
    def init(self, batch_size: int, *, generator: Generators = None) -> MKFState:
        """Return the state before the first frame: tracks at the component means, weighted by pi.

        Args:
            batch_size: B. generator: for sampled tracks, which draw their components.

        Returns:
            `MKFState` with means [B, M, D].
        """
        check_count("batch_size", batch_size)
        return MKFState(
            normalise(self.log_prior).to(self.dtype).repeat(batch_size, 1),
            self.means.to(self.dtype).repeat(batch_size, 1, 1),
            self.start_cov[None].clone(),
            torch.zeros(batch_size, dtype=torch.long, device=self.means.device),
            0,
        )

    def check_state(self, state: Any, batch: int) -> None:
        """Check that a state is one of this filter's, for a batch of this size."""
        require_state(state, MKFState, "mean", (batch, self.n_tracks, self.dim))

    def filter_frame(
        self, state: MKFState, frame: Measurements, generator: Generators, return_cov: bool
    ) -> tuple[MKFState, StepOutput]:
        """Filter one frame, given its checked measurements; implemented for each kind of tracks."""
        raise NotImplementedError(f"{type(self).__name__} has no tracks")

    def extra_repr(self) -> str:
        """Return the main settings, for printing."""
        return (
            f"n_tracks={self.n_tracks}, dim={self.dim}, "
            f"observed={self.observed.tolist()}, transition={self.transition_kind}"
        )


@cache
def _defaults(kind: type[MixtureKalmanFilter]) -> dict[str, Any]:
    """Return the arguments of a constructor by name, each with its default."""
    parameters = inspect.signature(kind).parameters
    return {name: parameter.default for name, parameter in parameters.items()}


def _kind_of(tracks: str) -> type[MixtureKalmanFilter]:
    """Return the class of these tracks."""
    kinds = MixtureKalmanFilter._kinds
    check_choice("tracks", tracks, kinds)
    return kinds[tracks]


def _options_of(kind: type[MixtureKalmanFilter], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the given options that a kind of tracks has; refuse others that are not at their default."""
    own, defaults = _defaults(kind), _defaults(MixtureKalmanFilter)
    for name in [name for name in given if name not in own]:
        value, default = given[name], defaults[name]
        if value != default and not (default == () and len(value) == 0):
            of = [k for k, c in kind._kinds.items() if name in _defaults(c)]
            raise InputError(
                f"{name} does not apply to tracks={kind.tracks!r}; it is of tracks="
                f"{' or '.join(map(repr, of))}"
            )
    return {name: value for name, value in given.items() if name in own}
