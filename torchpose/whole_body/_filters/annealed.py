"""Run the annealed particle filter of Deutscher and Reid."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Unpack

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.checks import check_count
from torchpose.errors import InputError
from torchpose.filters._recursive_filter import Generators
from torchpose.filters._resampling import (
    LEAST_SURVIVORS,
    check_survival_rate,
    resample,
    survival_exponent,
    survival_rate,
)
from torchpose.whole_body._filters.body_frames import Frame, Score
from torchpose.whole_body._filters.body_particles import (
    BodyFilterOptions,
    BodyFilterState,
    PoseSpace,
    WeightedParticles,
    take_particles,
)
from torchpose.whole_body._filters.silhouette_filter import SilhouetteParticleFilter

_LAYERS, _SURVIVAL = 5, 0.5


class Annealing(NamedTuple):
    """Holds the particles of the last layer, and the exponents and survival rates of all.

    Attributes:
        particles: [B, N, D]. log_weights: normalised [B, N]; NaN where all particles died.
        exponents: beta of every layer [B, M]. survival: alpha of every layer [B, M].
    """

    particles: Tensor
    log_weights: Tensor
    exponents: Tensor
    survival: Tensor


def anneal(
    particles: Float[Tensor, "B N D"],
    score: Score,
    diffuse: Callable[[Tensor, int], Tensor],
    n_layers: int,
    rate: float = 0.5,
    schedule: Sequence[float] | None = None,
    resampling: str = "systematic",
    generator: Generators = None,
) -> Annealing:
    """Run layers of diffusion, weights w^beta and resampling, from broad to narrow.

    In layer m: diffuse; w_n proportional to p(I | x_n)^beta_m, with beta_m so that alpha of the
    particles survives (`survival_exponent`); resample, but for the last layer.

    Args:
        particles: unweighted, [B, N, D].
        score: states [B, N, D] -> log-likelihood [B, N]; -inf rules a particle out.
        diffuse: (particles, layer from 0) -> particles, with noise that shrinks from layer to layer.
        n_layers: M, each of which evaluates N likelihoods. rate: alpha of every layer.
        schedule: the M exponents beta, instead of those solved from the survival rate.
        resampling, generator: as `resample`.

    Reference:
        Deutscher & Reid (2005), doi:10.1023/B:VISI.0000043757.18370.9c, section 4.
    """
    exponents, survival = [], []
    for layer in range(n_layers):
        particles = diffuse(particles, layer)
        value = score(particles)
        if schedule is None:
            exponent = survival_exponent(value, rate)
        else:
            exponent = torch.full_like(value[:, 0], schedule[layer])
        # an exponent of 0 times a log-weight of -inf would be NaN
        value = torch.where(torch.isfinite(value), exponent[:, None] * value, -torch.inf)
        log_weights = value - torch.logsumexp(value, -1, keepdim=True)
        exponents.append(exponent)
        survival.append(survival_rate(log_weights))
        if layer < n_layers - 1:
            particles = take_particles(particles, resample(log_weights, resampling, generator))
    return Annealing(particles, log_weights, torch.stack(exponents, 1), torch.stack(survival, 1))


class AnnealedParticleFilter(SilhouetteParticleFilter):
    """Filters by annealing: in every frame, layers from a broad to a peaked likelihood.

    Each frame starts from the particles of the last, resampled. Layer m = 0, ..., M - 1:
        x ~ N(x, alpha^m diag(process_cov)),   w_n = p(I_t | x_n)^beta_m / sum_j p(I_t | x_j)^beta_m
    and resampling between layers. beta_m is solved so that the share alpha of the particles survives,
    alpha = (sum w^beta)^2 / (N sum w^(2 beta)), and the covariance of the noise shrinks at the same
    rate. The estimate is that of the last layer, weighted.

    With solved exponents `sharpness` cancels; the survival rate plays its part. With a schedule it
    does not. The weights are those of no posterior, so the log-evidence is NaN (0 while coasting); the
    spread of the particles is that about one mode.

    An element that nobody sees is diffused once, with `process_cov`, and not annealed.

    Args:
        body: as `SilhouetteParticleFilter`. n_particles: N of each layer.
        n_layers: M; a frame costs M N likelihoods. The two papers have 5 x 100 and 5 x 160.
        survival_rate: alpha of every layer, at least 2 / N.
        schedule: M exponents, instead of those solved from the survival rate.
        noise_decay: factor of the noise's covariance per layer; alpha if None.
        **options: as `SilhouetteParticleFilter`, without `resample_threshold`: what is annealed has no
            weights.

    Raises:
        InputError, ShapeError: an argument is not as described.

    Reference:
        Deutscher & Reid (2005), doi:10.1023/B:VISI.0000043757.18370.9c, sections 4 and 5; Daubney &
        Xie, section 8; MR, section 6.1.
    """

    least_particles: ClassVar[int] = round(LEAST_SURVIVORS / _SURVIVAL)
    unused: ClassVar[frozenset[str]] = frozenset({"resample_threshold"})

    def __init__(
        self,
        body: PoseSpace,
        n_particles: int = 100,
        *,
        n_layers: int = _LAYERS,
        survival_rate: float = _SURVIVAL,
        schedule: Sequence[float] | None = None,
        noise_decay: float | None = None,
        **options: Unpack[BodyFilterOptions],
    ) -> None:
        super().__init__(body, n_particles, **options)
        if self.resample_threshold < 1:
            raise InputError(
                "every layer is resampled, and so is the last one before the next frame; leave "
                f"resample_threshold out, got {self.resample_threshold}"
            )
        check_count("n_layers", n_layers)
        if schedule is None:
            check_survival_rate(survival_rate, n_particles)
        else:
            finite = all(0 < b < math.inf for b in schedule)
            if len(schedule) != n_layers or not finite:
                raise InputError(
                    f"schedule must hold {n_layers} positive exponents, one per layer, "
                    f"got {list(schedule)}"
                )
        decay = survival_rate if noise_decay is None else noise_decay
        if not 0 < decay <= 1:
            raise InputError(f"noise_decay must be above 0 and at most 1, got {noise_decay}")
        self.n_layers, self.survival_rate = n_layers, survival_rate
        self.schedule, self.noise_decay = schedule, decay

    @property
    def sharpness_cancels(self) -> bool:
        """Return whether the exponents are solved from the survival rate."""
        return self.schedule is None

    @classmethod
    def likelihoods_per_particle(cls, options: Mapping[str, Any]) -> int:
        """Return the number of likelihoods that one particle costs in a frame: the number of layers."""
        n_layers = options.get("n_layers", _LAYERS)
        check_count("n_layers", n_layers)
        return n_layers

    def move(
        self, state: BodyFilterState, frame: Frame, generator: Generators
    ) -> WeightedParticles:
        """Anneal from the resampled particles of the last frame."""
        run = self.anneal(state.particles, frame.score, frame.seen, generator)
        no_evidence = torch.full_like(run.log_weights[:, 0], torch.nan)
        return WeightedParticles(run.particles, run.log_weights, no_evidence)

    def anneal(
        self,
        particles: Float[Tensor, "B N D"],
        score: Score,
        seen: Bool[Tensor, " B"],
        generator: Generators,
    ) -> Annealing:
        """Run the layers of one frame.

        Args:
            particles: [B, N, D], resampled, of the last frame.
            score: log-likelihood [B, N] of particles.
            seen: [B], whether a camera sees the person of an element.
            generator: one generator, or a list of one for each element.

        Returns:
            `Annealing` with the last layer, and the exponents and survival rates of all.
        """

        def diffuse(particles: Tensor, layer: int) -> Tensor:
            std = self.step_std * self.noise_decay ** (layer / 2)
            if layer > 0:  # an element that nobody sees moves once
                std = std * seen[:, None, None]
            return self.diffuse(particles, std, generator)

        return anneal(
            particles, lambda states: score(states) + self.log_limits(states), diffuse,
            self.n_layers, self.survival_rate, self.schedule, self.resampling, generator,
        )  # fmt: skip
