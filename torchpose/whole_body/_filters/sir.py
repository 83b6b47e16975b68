"""Run sampling importance resampling over body poses, from silhouettes."""

from typing import Unpack

import torch

from torchpose.filters._recursive_filter import Generators
from torchpose.filters._resampling import check_survival_rate, survival_exponent
from torchpose.whole_body._filters.body_frames import Frame
from torchpose.whole_body._filters.body_particles import (
    BodyFilterOptions,
    BodyFilterState,
    PoseSpace,
    WeightedParticles,
    reweight,
)
from torchpose.whole_body._filters.silhouette_filter import SilhouetteParticleFilter


class SIRParticleFilter(SilhouetteParticleFilter):
    """Filters by the Condensation algorithm: diffuse, weigh by the image, resample.

    x_t ~ N(x_{t-1}, diag(process_cov)) (MR 29),   w_n = p(I_t | x_t^(n))^s / sum_j p(I_t | x_t^(j))^s

    with the sharpness s. With a survival rate the exponent is instead solved in every frame, so that
    this share of the particles survives (Daubney & Xie); then `sharpness` cancels and the log-evidence
    is NaN, since the weights are no posterior's.

    Args:
        body, n_particles, **options: as `SilhouetteParticleFilter`.
        survival_rate: per frame, at least 2 / N, or None. Daubney & Xie have 0.01 per second
            (`survival_rate_per_frame`), 800 particles and `estimate="map"`.

    Raises:
        InputError, ShapeError: an argument is not as described.

    Reference:
        MR, section 6.1; Daubney & Xie, sections 7 and 8; Isard & Blake (1998),
        doi:10.1023/A:1008078328650.
    """

    def __init__(
        self,
        body: PoseSpace,
        n_particles: int = 500,
        *,
        survival_rate: float | None = None,
        **options: Unpack[BodyFilterOptions],
    ) -> None:
        super().__init__(body, n_particles, **options)
        if survival_rate is not None:
            check_survival_rate(survival_rate, n_particles)
        self.survival_rate = survival_rate

    @property
    def sharpness_cancels(self) -> bool:
        """Return whether the exponent is solved from the survival rate."""
        return self.survival_rate is not None

    def move(
        self, state: BodyFilterState, frame: Frame, generator: Generators
    ) -> WeightedParticles:
        """Diffuse the particles (MR 29), and weigh them by the image (MR 5)."""
        particles = self.diffuse(state.particles, self.step_std, generator)
        log_limits, log_likelihood = self.log_limits(particles), frame.score(particles)
        log_prior = state.log_weights + log_limits
        if self.survival_rate is None:
            return reweight(particles, log_prior, log_likelihood)
        exponent = survival_exponent(log_likelihood + log_limits, self.survival_rate)[:, None]
        moved = reweight(particles, log_prior, exponent * log_likelihood)
        return moved._replace(log_evidence=torch.full_like(moved.log_evidence, torch.nan))
