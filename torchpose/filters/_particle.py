"""Run bootstrap particle filters with the three proposals of Burke & Lasenby, section 3.3."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchpose._core.checks import check_choice, check_count
from torchpose._core.former_arguments import takes_former_arguments
from torchpose._core.module_state import derived, register_given, wide_or_parameter
from torchpose._core.value_checks import values_visible
from torchpose.errors import InputError
from torchpose.filters._measurements import (
    Measurements,
    as_covariance,
    given_covariance,
    given_initial_cov,
)
from torchpose.filters._outputs import Mending, StepOutput, effective_sample_size, mending
from torchpose.filters._recursive_filter import (
    Generators,
    RecursiveFilter,
    require_state,
    standard_normal,
    uniform,
)
from torchpose.filters._resampling import RESAMPLING, resample
from torchpose.filters._transition import (
    BURN_IN_SCALE,
    check_transition_options,
    inflation,
    make_transition,
)
from torchpose.filters._walk import MixtureWalk, Moves, grouped_affine
from torchpose.math._gaussian import mended_update, safe_cholesky
from torchpose.math._mixture_steps import MixtureParameters
from torchpose.priors._gaussian_mixture import GaussianMixture

PROPOSALS = ("mixture", "random-walk", "random-walk-unscaled")
_STARTS = ("prior", "measured")


class ParticleState(NamedTuple):
    """Holds weighted particles after a step, before they are resampled.

    Attributes:
        white: particles [B, N, D] in the whitened coordinates of the filter; see
            `BootstrapParticleFilter.particles`.
        log_weights: normalised, [B, N], float64.
        time: number of frames seen.
        log_scaling: log sum_i pi_i c_i (BL 13) of the next step at each particle [B, N], which is
            resampled along with it; only for the proposal "random-walk".
    """

    white: Tensor
    log_weights: Tensor
    time: int
    log_scaling: Tensor | None


class _Constants(NamedTuple):
    """Holds the tensors that the model determines before any measurement.

    Attributes:
        walk: prior density and evidence in whitened coordinates. initial: maps noise to the first
            particles. initial_cov: of the components that these are drawn from [K, D, D]. steady:
            moves of the proposal "mixture" without burn-in. walk_factor: of Q.
    """

    walk: MixtureWalk
    initial: Moves
    initial_cov: Tensor
    steady: Moves | None
    walk_factor: Tensor


class BootstrapParticleFilter(RecursiveFilter):
    """Filters by particles under the mixture of discrete Ornstein-Uhlenbeck processes.

    Proposals and weights, w_t = w_{t-1} times

    - ``mixture``: x_t from (BL 14): component i with probability proportional to
      pi_i c_i(x_{t-1}), then N(mu_c^i, Sigma_c^i);  p(z_t | x_t)   (BL 23)
    - ``random-walk``: x_t from N(x_{t-1}, Q);
      p(z_t | x_t) Phi(x_t) / sum_i pi_i c_i(x_{t-1})   (BL 26)
    - ``random-walk-unscaled``: the same without the division.

    The first two have the same posterior. Particles are resampled at the start of a step when the
    effective sample size (BL 25) of the step before fell below `resample_threshold` times N;
    otherwise the old weights stay. Estimates are weighted means before resampling. They have no
    gradients: nothing runs through particles, whatever is asked of the measurements.

    Log-evidence. With V_t proportional to W_{t-1} v_t, the normalised weights of the prediction (v_t
    is the factor above without p(z_t | x_t), W_{t-1} the normalised old weights, uniform after
    resampling), the increment is log sum_k V_t^k p(z_t | x_t^k): right whether or not step t - 1 was
    resampled, and 0 where nothing is measured. For "mixture" V_t = W_{t-1}, and the evidence of a
    sequence is an unbiased estimate. For "random-walk" sum_k W_{t-1}^k v_t^k estimates 1; dividing
    by it costs a bias of order 1/N in exchange for a smaller variance, and keeps what a gap did to
    the weights out of the next increment. For "random-walk-unscaled" it is NaN.

    Args:
        gmm: the prior Phi. process_cov: Q [D, D] or its diagonal [D], per frame.
        measurement_cov: R [Z, Z] or its diagonal [Z]. observed: the Z state indices measured.
        proposal: "mixture", "random-walk" or "random-walk-unscaled".
        n_particles: N. resample_threshold: share of N, 0 (never) to 1 (always).
        resampling: "systematic", "stratified", "multinomial" or "residual".
        burn_in: number of frames over which Q starts inflated and decays to itself geometrically,
            Q_t = scale^(1 - t / burn_in) Q. 0 is no burn-in.
        burn_in_scale: factor of Q in the first frame of the burn-in; 100 by default.
        initial_cov: the first particles are drawn from the prior, or if this is given ([D, D], [D]
            or [K, D, D]) from sum_i pi_i N(mu_i, initial_cov), as the mixture Kalman filter starts.
        start: "prior": x_0 is drawn from that density, and moved and weighed like any other.
            "measured": it is the density of x_1 instead, whose particles are drawn from
            p(x_1 | z_1), a mixture of Gaussians, with equal weights. In many dimensions hardly any
            particle of the prior agrees with the first measurement.
        transition, gamma, subspace: as `make_transition`. The random walks need "paper", from
            which (BL 26) follows. For "stationary" and "ou", c_i = N(x_{t-1} | mu_i, Sigma_i), so
            that the mixture of processes leaves Phi unchanged.
        dtype: of the particles and of `log_weights` in the output. Covariances are factorised, and
            weights and evidence summed, in float64; means and covariances are returned in float64.

    Raises:
        InputError, ShapeError, CovarianceError: an argument is not as described.

    Reference:
        Burke & Lasenby, section 3.3.

    >>> gmm = GaussianMixture(torch.ones(1), torch.zeros(1, 2), torch.eye(2)[None])
    >>> tracker = BootstrapParticleFilter(gmm, torch.ones(2), torch.ones(1), [0], n_particles=100)
    >>> out = tracker(torch.zeros(1, 3, 1), generator=torch.Generator().manual_seed(0))
    >>> out.mean.shape, out.log_evidence.shape
    (torch.Size([1, 3, 2]), torch.Size([1, 3]))
    """

    process_cov: Tensor
    weights: Tensor
    means: Tensor
    covariances: Tensor
    initial_cov: Tensor | None
    gamma: Tensor | None

    def __init__(
        self,
        gmm: GaussianMixture,
        process_cov: Tensor,
        measurement_cov: Tensor,
        observed: Sequence[int] | Tensor,
        proposal: str = "mixture",
        n_particles: int = 10_000,
        resample_threshold: float = 0.5,
        resampling: str = "systematic",
        burn_in: int = 0,
        burn_in_scale: float | None = None,
        initial_cov: Tensor | None = None,
        start: str = "prior",
        transition: str = "paper",
        gamma: Tensor | float | None = None,
        subspace: int | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__(measurement_cov, observed, gmm.dim, dtype)
        _check_options(proposal, n_particles, resample_threshold, resampling, start, transition)
        check_transition_options(transition, gamma, subspace, burn_in, burn_in_scale)
        self.proposal, self.transition, self.subspace = proposal, transition, subspace
        self.n_particles, self.resample_threshold = n_particles, resample_threshold
        self.resampling, self.start = resampling, start
        self.burn_in = burn_in
        self.burn_in_scale = BURN_IN_SCALE if burn_in_scale is None else float(burn_in_scale)
        for name, value in zip(
            ("weights", "means", "covariances"), gmm.parameters_tuple(), strict=True
        ):
            given = value if isinstance(value, nn.Parameter) else value.detach().double()
            register_given(self, name, given)
        register_given(self, "process_cov", given_covariance("process_cov", process_cov, self.dim))
        register_given(self, "gamma", wide_or_parameter(gamma))
        register_given(self, "initial_cov", given_initial_cov(initial_cov, self.covariances))
        self.to(gmm.means.device)
        self._constants()  # raises what does not fit before any work

    def _constants(self) -> "_Constants":
        given = (self.weights, self.means, self.covariances, self.process_cov)
        sources = (*given, self.gamma, self.initial_cov)
        return derived(self, f"constants {self.dtype}", sources, self._make_constants)

    @property
    def walk(self) -> MixtureWalk:
        """Return the random walk under the prior, in whitened coordinates."""
        return self._constants().walk

    @torch.no_grad()
    def _make_constants(self) -> "_Constants":
        process_cov = as_covariance("process_cov", self.process_cov, self.dim)
        mixture = MixtureParameters(
            self.weights.double(), self.means.double(), self.covariances.double()
        )
        walk = MixtureWalk(mixture, process_cov, self.dtype)
        spread = mixture.covariances
        if self.initial_cov is not None:
            cov = as_covariance("initial_cov", self.initial_cov, self.dim, self.initial_cov.ndim)
            spread = cov.expand_as(spread)
        initial = walk.noise_moves(mixture.means, spread)
        steady = self._moves_at(1.0, walk) if self.proposal == "mixture" else None
        eye = torch.eye(self.dim, dtype=torch.float64, device=spread.device)
        whitener = torch.linalg.solve_triangular(walk.scale, eye, upper=False)
        factor = safe_cholesky(whitener @ process_cov @ whitener.mT)
        return _Constants(walk, initial, spread, steady, factor.mT.contiguous().to(self.dtype))

    def _moves_at(self, inflation: float, walk: MixtureWalk) -> Moves:
        cov = inflation * as_covariance("process_cov", self.process_cov, self.dim)
        gamma = None if self.gamma is None else self.gamma.double()
        mixture = self.means.double(), self.covariances.double()
        parts = make_transition(self.transition, *mixture, cov, gamma, self.subspace)
        return walk.moves(*parts)

    def inflation(self, time: int) -> float:
        """Return the factor of Q in one frame, above 1 during the burn-in.

        Args:
            time: number of the frame, 0 is the first.

        Returns:
            scale^(1 - t / burn_in) for t < burn_in, then 1.
        """
        return inflation(time, self.burn_in, self.burn_in_scale)

    @torch.no_grad()
    @takes_former_arguments
    def init(self, batch_size: int, *, generator: Generators = None) -> ParticleState:
        """Return the state before the first frame, with particles drawn from the prior.

        Args:
            batch_size: B. generator: one generator, or a list of one for each element.

        Returns:
            `ParticleState` with N particles for each element.
        """
        check_count("batch_size", batch_size)
        weights = self.weights.double().expand(batch_size, -1)
        white = self._draw(weights, self._constants().initial, generator)
        return self._evenly(white, 0)

    def check_state(self, state: Any, batch: int) -> None:
        """Check that a state is one of this filter's, for a batch of this size."""
        require_state(state, ParticleState, "white", (batch, self.n_particles, self.dim))

    def _draw(
        self, weights: Float[Tensor, "B K"], moves: Moves, generator: Generators
    ) -> Float[Tensor, "B N D"]:
        """Draw particles of a mixture, by one map of noise for each component [K] or for all [B K]."""
        batch, n_components = weights.shape
        n, like = self.n_particles, moves.offset
        u = uniform(batch, (n,), generator, like.new_empty(0, dtype=torch.float64))
        noise = standard_normal(batch, (n, self.dim), generator, like)
        edges = weights.cumsum(1)
        component = torch.searchsorted(edges, u * edges[:, -1:], right=True)
        component = component.clamp_max(n_components - 1)
        if len(moves.offset) > n_components:
            component += n_components * torch.arange(batch, device=u.device)[:, None]
        white = grouped_affine(noise.view(-1, self.dim), component.view(-1), moves)
        return white.view_as(noise)

    def _evenly(self, white: Float[Tensor, "B N D"], time: int) -> ParticleState:
        """Return the state of particles that all weigh the same."""
        log_weights = white.new_full(white.shape[:2], -math.log(self.n_particles)).double()
        scaling = (
            self._prior_and_scaling(white, time)[1] if self.proposal == "random-walk" else None
        )
        return ParticleState(white, log_weights, time, scaling)

    def _draw_measured(
        self, frame: Measurements, generator: Generators
    ) -> tuple[Float[Tensor, "B N D"], Float[Tensor, " B"], Mending]:
        """Draw particles of p(x | z), prop. to p(x) N(z | H x, R); return them with log p(z)."""
        constants = self._constants()
        cov = frame.cov if frame.cov.ndim == 2 else frame.cov[:, None]
        means, covs, log_likelihood, jitter = mended_update(
            self.means.double().expand(len(frame.z), -1, -1), constants.initial_cov,
            frame.z.double()[:, None], cov, self.observed, frame.mask[:, None],
        )  # fmt: skip
        log_weights = self.weights.double().log() + log_likelihood
        moves = constants.walk.noise_moves(means.flatten(0, 1), covs.flatten(0, 1))
        white = self._draw(log_weights.softmax(1), moves, generator)
        return white, torch.logsumexp(log_weights, 1), mending(white, jitter, moves.jitter)

    def particles(self, state: ParticleState) -> Float[Tensor, "B N D"]:
        """Return the particles in the units of the state.

        Args:
            state: the state from `init` or `step`.

        Returns:
            [B, N, D], pixels, metres and radians, float64.
        """
        return self.walk.unwhiten(state.white)

    @torch.no_grad()
    def filter_frame(
        self, state: ParticleState, frame: Measurements, generator: Generators, return_cov: bool
    ) -> tuple[ParticleState, StepOutput]:
        """Filter one frame: resample if due, propose, weigh (BL 14, 23-26)."""
        if state.time == 0 and self.start == "measured":
            white, evidence, work = self._draw_measured(frame, generator)
            return self._output(self._evenly(white, 1), evidence, frame.mask, return_cov, work)
        state = self._resample(state, generator)
        white = self._propose(state, generator)
        predicted = state.log_weights
        scaling = None
        if self.proposal != "mixture":
            log_prior, scaling = self._prior_and_scaling(white, state.time + 1)
            predicted = predicted + log_prior
            if state.log_scaling is not None:
                predicted = predicted - state.log_scaling
            predicted = predicted - torch.logsumexp(predicted, -1, keepdim=True)
        log_likelihood, jitter = self.walk.log_likelihood(
            white, frame.z, frame.mask, frame.cov, self.observed
        )
        log_weights = predicted + log_likelihood
        evidence = torch.logsumexp(log_weights, -1)
        # An element whose weights all vanished, or hold NaN, is NaN from here on.
        evidence = torch.where(torch.isfinite(evidence), evidence, torch.nan)
        log_weights = log_weights - evidence[:, None]
        new_state = ParticleState(white, log_weights, state.time + 1, scaling)
        work = mending(white, jitter)
        return self._output(new_state, evidence, frame.mask, return_cov, work)

    def _output(
        self, state: ParticleState, evidence: Tensor, mask: Tensor, return_cov: bool, work: Mending
    ) -> tuple[ParticleState, StepOutput]:
        mean, cov = self.walk.moments(state.white, state.log_weights, return_cov)
        evidence = self._reported(evidence, mask)
        # kept for every frame by `forward`, so no wider than the particles
        return state, StepOutput(mean, state.log_weights.to(self.dtype), evidence, cov, *work)

    def _resample(self, state: ParticleState, generator: Generators) -> ParticleState:
        """Resample the elements whose effective sample size is low (BL 25), and leave the others."""
        n = self.n_particles
        due = effective_sample_size(state.log_weights) < self.resample_threshold * n
        # drawn for all: what an element draws must not depend on its neighbours
        ancestors = resample(state.log_weights, self.resampling, generator)
        if values_visible() and not bool(due.any()):
            return state
        own = torch.arange(n, device=ancestors.device)
        ancestors = torch.where(due[:, None], ancestors, own)
        first = torch.arange(len(due), device=ancestors.device)[:, None] * n
        flat = (ancestors + first).view(-1)
        white = state.white.view(-1, self.dim).index_select(0, flat).view_as(state.white)
        log_weights = torch.where(due[:, None], -math.log(n), state.log_weights)
        scaling = state.log_scaling
        if scaling is not None:
            scaling = scaling.view(-1).index_select(0, flat).view_as(scaling)
        return state._replace(white=white, log_weights=log_weights, log_scaling=scaling)

    def _propose(self, state: ParticleState, generator: Generators) -> Float[Tensor, "B N D"]:
        batch, n, dim = state.white.shape
        inflation = self.inflation(state.time)
        noise = standard_normal(batch, (n, dim), generator, state.white)
        if self.proposal != "mixture":
            factor = self._constants().walk_factor * math.sqrt(inflation)
            return (state.white.view(-1, dim).addmm(noise.view(-1, dim), factor)).view_as(noise)
        moves = self._constants().steady
        if moves is None or inflation != 1.0:
            moves = self._moves_at(inflation, self.walk)
        u = uniform(batch, (n,), generator, state.white)
        reach = inflation if self.transition == "paper" else 0.0
        component = self.walk.choose(state.white, u, reach).view(-1)
        rows = torch.cat([state.white, noise], -1).view(batch * n, 2 * dim)
        return grouped_affine(rows, component, moves).view_as(noise)

    def _prior_and_scaling(self, white: Tensor, time: int) -> tuple[Tensor, Tensor | None]:
        """Return log Phi and, where used, the log evidence (BL 13) for the step from these points."""
        if self.proposal == "random-walk-unscaled":
            return self.walk.log_prior(white), None
        return self.walk.log_prior_and_evidence(white, self.inflation(time))

    def _reported(
        self, evidence: Float[Tensor, " B"], mask: Bool[Tensor, "B Z"]
    ) -> Float[Tensor, " B"]:
        if self.proposal == "random-walk-unscaled":
            return torch.full_like(evidence, torch.nan)
        # without a measurement it is 0 up to rounding
        return torch.where(mask.any(-1) | torch.isnan(evidence), evidence, 0.0)


def _check_options(
    proposal: str,
    n_particles: int,
    threshold: float,
    resampling: str,
    start: str,
    transition: str,
) -> None:
    check_choice("proposal", proposal, PROPOSALS)
    check_choice("resampling", resampling, RESAMPLING)
    check_choice("start", start, _STARTS)
    if isinstance(n_particles, bool) or not isinstance(n_particles, int) or n_particles < 1:
        raise InputError(f"n_particles must be a whole number of at least 1, got {n_particles!r}")
    if not 0 <= threshold <= 1:
        raise InputError(f"resample_threshold must be a share from 0 to 1, got {threshold}")
    if proposal != "mixture" and transition != "paper":
        raise InputError(
            f"proposal {proposal!r} weighs by (BL 26), which holds for transition 'paper' only, "
            f"got {transition!r}; use proposal 'mixture'"
        )
