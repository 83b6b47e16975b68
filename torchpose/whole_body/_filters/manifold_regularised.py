"""Run the manifold-regularised particle filter."""

from typing import TYPE_CHECKING, Any, Protocol, Unpack, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.checks import check_choice, check_shape
from torchpose.errors import InputError, PriorError
from torchpose.filters._recursive_filter import Generators, standard_normal
from torchpose.whole_body._filters.body_frames import Frame
from torchpose.whole_body._filters.body_particles import (
    BodyFilterOptions,
    BodyFilterState,
    PoseSpace,
    WeightedParticles,
    reweight,
)
from torchpose.whole_body._filters.motion import default_step_std
from torchpose.whole_body._filters.silhouette_filter import SilhouetteParticleFilter

MANIFOLD_WEIGHTS = ("published", "normalised")
MANIFOLD_PROPOSALS = ("diffusion", "product")
_TRACKING_STEP = 2.0  # times sigma x->x, which was learnt from the true poses
_LEAST_STD = 1e-3  # of sigma z->x: the twist of a limb, which no joint shows, does not vary at all


@runtime_checkable
class PoseManifold(Protocol):
    """Declares what the filter needs of a manifold, such as `torchpose.priors.BackConstrainedGPLVM`.

    Attributes:
        to_latent(x): g(x), [..., Q] -> [..., d] (MR 21). pose_mean(z): f(z), [..., d] -> [..., Q]
            (MR 25). check_for(body, fps): refuses another skeleton, and another frame rate unless None.
        std_latent: sigma x->z [d]. std_step: sigma x->x [Q]. std_pose: sigma z->x [Q].
    """

    if TYPE_CHECKING:  # from Python 3.12 on, checks at run time do not find the buffers of a module
        std_latent: Tensor
        std_step: Tensor
        std_pose: Tensor

    def to_latent(self, x: Tensor) -> Tensor: ...

    def pose_mean(self, z: Tensor) -> Tensor: ...

    def check_for(self, body: Any, fps: float | None = None) -> None: ...


class ManifoldParticleFilter(SilhouetteParticleFilter):
    """Filters by particles that are also weighted by their distance from a learnt manifold of poses (MRPF).

    Algorithm 1, in frame t, for each particle n, with S_xx = diag(sigma x->x^2) and S_zx alike:
        z_n ~ N(g(x_{t-1}), diag(sigma x->z^2))                                        (MR 27)
        x_n ~ q(x_t | x_{t-1})
        omega_n = p(x_t | x_{t-1}, z_t) / q(x_t | x_{t-1})                             (MR 7)
        xi_n = pi_n omega_n / sum_j pi_j omega_j                                       (MR 11)
    The estimate is the mean under xi (step 8 of the algorithm prints omega; xi is the posterior's
    weight, MR 10), then the particles are resampled.

    The dynamics are p(x_t | x_{t-1}, z_t) proportional to N(x_t | x_{t-1}, S_xx) N(x_t | f(z_t), S_zx)
    (MR 28-30). The paper leaves out what normalises them over x_t, c = N(x_{t-1} | f(z_t), S_xx + S_zx):

        published, diffusion:  q = N(x_t | x_{t-1}, S_xx) (MR 29),  omega = N(x_t | f(z), S_zx) (MR 30)
        published, product:    q the normalised product, a Gaussian,  omega = c
        normalised, diffusion: q = N(x_t | x_{t-1}, S_xx),  omega = N(x_t | f(z), S_zx) / c
        normalised, product:   q the normalised product,  omega = 1

    The proposal does not change the posterior; the product wastes fewer particles.

    The manifold covers the rotations of the parts relative to each other. The root's position and
    orientation diffuse by (MR 29) alone. While no camera sees the person, particles are drawn from the
    normalised product and not weighed: poses stay near the manifold, and the particles apart.

    Args:
        body: as `SilhouetteParticleFilter`, with `relative_columns`, the Q columns of the state that
            the manifold covers.
        manifold: a fitted `BackConstrainedGPLVM`, or what has the methods of `PoseManifold`.
        n_particles: N.
        weights: "published" or "normalised". proposal: "diffusion" or "product". The defaults are the
            exact model with the proposal that wastes no particles; on walks at 60 Hz the published
            form holds poses so close to the manifold that they fall behind.
        fps: of the frames to be tracked; the manifold must have its noise for that rate. None if it
            does not matter.
        **options: as `SilhouetteParticleFilter`. `process_cov` [D] is the root's and sigma x->x^2; that of
            the manifold's own `std_step` (and `default_step_std` for the root) if None.

    Raises:
        PriorError: a manifold of another skeleton or frame rate, or without its noise.
        InputError, ShapeError: an argument is not as described.

    Reference:
        MR, Algorithm 1, equations (7)-(11) and (27)-(30).
    """

    def __init__(
        self,
        body: PoseSpace,
        manifold: PoseManifold,
        n_particles: int = 500,
        *,
        weights: str = "normalised",
        proposal: str = "product",
        fps: float | None = None,
        **options: Unpack[BodyFilterOptions],
    ) -> None:
        check_choice("weights", weights, MANIFOLD_WEIGHTS)
        check_choice("proposal", proposal, MANIFOLD_PROPOSALS)
        if not isinstance(manifold, PoseManifold):
            raise InputError(
                "manifold must be a BackConstrainedGPLVM, or have to_latent, pose_mean and check_for, got "
                f"{type(manifold).__name__}"
            )
        manifold.check_for(body, fps)
        columns = torch.as_tensor(body.relative_columns, dtype=torch.long)  # type: ignore[attr-defined]
        _check_noise(manifold, len(columns))
        if options.get("process_cov") is None and options.get("step_std") is None:
            options["process_cov"] = _process_cov(body, manifold)
        super().__init__(body, n_particles, **options)
        self.manifold, self.weights, self.proposal = manifold, weights, proposal
        self.register_buffer("columns", columns.to(self.step_std.device), persistent=False)
        self.columns: Tensor

    @classmethod
    def tracking_options(
        cls, body: Any, fps: float, learnt: PoseManifold | None = None
    ) -> dict[str, Any]:
        """Return the options of tracking: the usual ones, with twice the noise of the manifold."""
        options = super().tracking_options(body, fps)
        if learnt is not None:
            options["process_cov"] = _process_cov(body, learnt, fps, _TRACKING_STEP)
        return options

    def move(
        self, state: BodyFilterState, frame: Frame, generator: Generators
    ) -> WeightedParticles:
        """Take steps 3 to 7 of Algorithm 1: draw targets, propose, weigh by the manifold and the image."""
        particles, seen = state.particles, frame.seen
        before = particles.index_select(-1, self.columns)
        target = self.draw_targets(before, generator)
        # without an image to weigh by, weights would only thin the particles out
        exact = ~seen if self.proposal == "diffusion" else torch.ones_like(seen)
        moved = self._propose(particles, target - before, exact, generator)
        after = moved.index_select(-1, self.columns)
        log_omega = self._log_omega(before, after, target).double()
        log_prior = state.log_weights + torch.where(seen[:, None], log_omega, 0.0)
        return reweight(moved, log_prior + self.log_limits(moved), frame.score(moved))

    def draw_targets(
        self, before: Float[Tensor, "B N Q"], generator: Generators
    ) -> Float[Tensor, "B N Q"]:
        """Draw a latent point z of each particle (MR 27), and return its pose f(z).

        Args:
            before: relative columns [B, N, Q] of the last frame.
            generator: one generator, or a list of one for each element.

        Returns:
            Relative columns [B, N, Q], quaternion vectors.
        """
        latent = self.manifold.to_latent(before.to(self.manifold.std_latent.dtype))
        noise = standard_normal(len(latent), latent.shape[1:], generator, latent)
        latent = latent + noise * self.manifold.std_latent.to(latent)
        return self.manifold.pose_mean(latent).to(before)

    def _propose(
        self,
        particles: Float[Tensor, "B N D"],
        ahead: Float[Tensor, "B N Q"],
        exact: Bool[Tensor, " B"],
        generator: Generators,
    ) -> Float[Tensor, "B N D"]:
        """Draw by (MR 29), or where `exact` by the normalised product, with `ahead` = f(z) - x_{t-1}."""
        step = standard_normal(len(particles), particles.shape[1:], generator, particles)
        step = step * self.step_std
        var_step, var_pose = self._variances(particles)
        gain = var_step / (var_step + var_pose)
        product = gain * ahead + (1.0 - gain).sqrt() * step[..., self.columns]
        step[..., self.columns] = torch.where(
            exact[:, None, None], product, step[..., self.columns]
        )
        return self.constrain(self.body.perturb(particles, step))

    def _log_omega(self, before: Tensor, after: Tensor, target: Tensor) -> Float[Tensor, "B N"]:
        """Return log omega up to a constant that all particles share."""
        var_step, var_pose = self._variances(before)
        log_omega = before.new_zeros(before.shape[:2])
        if self.proposal == "diffusion":
            log_omega = log_omega - 0.5 * ((after - target).square() / var_pose).sum(-1)
        if (self.weights == "normalised") == (self.proposal == "diffusion"):
            log_c = -0.5 * ((before - target).square() / (var_step + var_pose)).sum(-1)
            log_omega = log_omega - log_c if self.weights == "normalised" else log_omega + log_c
        return log_omega

    def _variances(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Return the diagonals of S_xx and S_zx, [Q]."""
        pose = self.manifold.std_pose.to(like).clamp_min(_LEAST_STD)
        return self.step_std[self.columns].square(), pose.square()


def _process_cov(
    body: PoseSpace, manifold: PoseManifold, fps: float = 60.0, scale: float = 1.0
) -> Float[Tensor, " D"]:
    """Return the variances [D]: the root's by default, and of the parts (factor x sigma x->x) squared."""
    std = default_step_std(body, fps)
    columns = torch.as_tensor(body.relative_columns, dtype=torch.long)  # type: ignore[attr-defined]
    std[columns.to(std.device)] = scale * manifold.std_step.detach().to(std)
    return std.square()


def _check_noise(manifold: PoseManifold, n_columns: int) -> None:
    """Raise unless the manifold covers these columns and has its standard deviations."""
    for name, size in (("std_latent", "d"), ("std_pose", n_columns), ("std_step", n_columns)):
        std = getattr(manifold, name)
        check_shape(f"{name} of the manifold", std, [size])
        if not bool(torch.isfinite(std).all()):
            raise PriorError(
                f"the manifold has no {name} yet; call fit_gplvm_noise with it and validation poses"
            )
