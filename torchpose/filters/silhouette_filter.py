"""What the particle filters over body poses share: likelihood, limits, coasting, failure, estimates.

A filter is its `move`: how the particles of one frame become weighted particles of the next. Batches,
empty silhouettes, dead particles and the loop over time are handled here.
"""

import math
import warnings
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from tqdm.auto import tqdm

from torchpose.body.silhouette_likelihood import LIKELIHOODS
from torchpose.errors import (
    DegenerateFilterWarning,
    InputError,
    ShapeError,
    check_finite,
    check_shape,
)
from torchpose.filters.base import Generators, effective_sample_size, standard_normal
from torchpose.filters.body_particles import (
    BodyFilterState,
    BodyTrack,
    PoseSpace,
    Score,
    WeightedParticles,
    as_step_std,
    default_step_std,
    motion_std,
    reweight,
    silhouette_score,
    take_particles,
)
from torchpose.filters.resampling import RESAMPLING, resample

__all__ = [
    "BodyFilterState",
    "BodyTrack",
    "PoseSpace",
    "SilhouetteParticleFilter",
    "WeightedParticles",
    "default_step_std",
    "motion_std",
    "reweight",
]

LIMIT_MODES = ("clamp", "discard")
ESTIMATES = ("mean", "map")
_MOST_SPREAD = 10  # frames over which the noise of a filter that stays lost keeps growing

Likelihood = Callable[[Tensor, Tensor], Tensor]


class SilhouetteParticleFilter(nn.Module):
    """Base of the particle filters over body poses; a subclass is its `move`.

    Args:
        body: whose poses are tracked; anything with the methods of `PoseSpace`.
        n_particles: N.
        step_std: standard deviation of the diffusion per frame, [D] or one number (metres for the
            root, sines of half angles for rotations); `default_step_std` if None. (MR 29)
        likelihood: "bidirectional" (MR 12), "overlap" (log of AS 7), or a callable
            (states [B, N, D], frame [B, ...]) -> log-likelihood [B, N] for observations of another
            kind.
        sharpness: exponent of the likelihood; 1 is the published form. See `fit_sharpness`.
        limits: joint limits with `clamp(states)` and `inside(states)` [..., P], or None.
        limit_mode: "clamp" moves particles to the limits, "discard" gives those outside no weight.
        resampling: "systematic", "stratified", "multinomial" or "residual".
        resample_threshold: share of N below which the effective sample size leads to resampling;
            1 is in every frame, as published.
        estimate: "mean", weighted before resampling, or "map", the particle of the largest weight.
        respread_scale: particles that all died are drawn about the last mean with this many times
            `step_std`, twice that in the second such frame, and so on.

    Raises:
        InputError, ShapeError: an argument is not as described.
    """

    step_std: Tensor

    def __init__(
        self,
        body: PoseSpace,
        n_particles: int = 500,
        *,
        step_std: Tensor | float | None = None,
        likelihood: str | Likelihood = "bidirectional",
        sharpness: float = 1.0,
        limits: Any | None = None,
        limit_mode: str = "clamp",
        resampling: str = "systematic",
        resample_threshold: float = 1.0,
        estimate: str = "mean",
        respread_scale: float = 5.0,
    ) -> None:
        super().__init__()
        _check_choice("likelihood", likelihood, tuple(LIKELIHOODS))
        _check_choice("limit_mode", limit_mode, LIMIT_MODES)
        _check_choice("resampling", resampling, tuple(RESAMPLING))
        _check_choice("estimate", estimate, ESTIMATES)
        if n_particles < 1:
            raise InputError(f"n_particles must be at least 1, got {n_particles}")
        if not 0 <= resample_threshold <= 1:
            raise InputError(f"resample_threshold must be from 0 to 1, got {resample_threshold}")
        for name, value in (("sharpness", sharpness), ("respread_scale", respread_scale)):
            if not 0 < value < math.inf:
                raise InputError(f"{name} must be positive and finite, got {value}")
        self.body, self.limits, self.limit_mode = body, limits, limit_mode
        self.n_particles, self.sharpness = n_particles, float(sharpness)
        self.likelihood, self.estimate = likelihood, estimate
        self.resampling, self.resample_threshold = resampling, resample_threshold
        self.respread_scale = respread_scale
        self.register_buffer("step_std", as_step_std(body, step_std))

    # --- what a subclass adds

    @abstractmethod
    def move(
        self,
        particles: Float[Tensor, "B N D"],
        log_weights: Float[Tensor, "B N"],
        score: Score,
        seen: Bool[Tensor, " B"],
        generator: Generators,
    ) -> WeightedParticles:
        """Weighted particles of the next frame from those of the last.

        Args:
            particles, log_weights: of the last frame, resampled if that was due; normalised.
            score: states [B, N, D] -> sharpened log-likelihood of the frame [B, N], float64; 0 in
                elements that nobody sees.
            seen: [B], False where the frame is empty. generator: for what is drawn.
        """

    # --- running

    @torch.no_grad()
    def forward(
        self,
        silhouettes: Tensor,
        cameras: Any,
        initial_state: Tensor,
        generator: Generators = None,
        progress: bool = False,
        initial_std: Tensor | None = None,
    ) -> BodyTrack:
        """Track one person through a sequence, or several through a batch of sequences.

        Args:
            silhouettes: bool [T, C, H, W] or [B, T, C, H, W], undistorted; with a callable as the
                likelihood any observations [T, ...], or [B, T, ...] with an initial state [B, D].
            cameras: the C cameras (`CameraRig`, or what makes one); handed to the likelihood.
            initial_state: the pose one frame before the first, [D] or [B, D].
            generator: one generator, or a list of one for each sequence, which makes a sequence's
                numbers independent of its batch.
            progress: whether to show a progress bar.
            initial_std: [D], spread of the first particles; none if None, as published.

        Returns:
            `BodyTrack`, with the dimension of the batch if there was one.

        Raises:
            ShapeError: sizes that do not match. InputError: no frames, values that are not finite,
            silhouettes that are not bool. CameraError: as the likelihood.
        """
        frames, start, batched = self._check(silhouettes, initial_state, generator)
        state = self.init(start, generator, initial_std)
        steps = []
        for t in tqdm(range(frames.shape[1]), disable=not progress, unit="frame"):
            state, out = self._advance(state, frames[:, t], cameras, generator)
            steps.append(out)
        track = BodyTrack(*(torch.stack(part, 1) for part in zip(*steps, strict=True)))
        _warn_if_respread(track.respread)
        return track if batched else BodyTrack(*(part[0] for part in track))

    @torch.no_grad()
    def init(
        self,
        initial_state: Float[Tensor, "*B D"],
        generator: Generators = None,
        initial_std: Tensor | None = None,
    ) -> BodyFilterState:
        """N copies of the initial state (MR, Algorithm 1, step 1), spread if `initial_std` [D] is given."""
        start = initial_state.to(self.step_std).reshape(-1, initial_state.shape[-1])
        check_shape("initial_state", start, ["B", self.body.dim])
        check_finite("initial_state", start)
        particles = start[:, None].expand(-1, self.n_particles, -1).contiguous()
        if initial_std is not None:
            spread = torch.as_tensor(initial_std).to(self.step_std)
            particles = self.diffuse(particles, spread, generator)
        uniform = torch.full(particles.shape[:2], -math.log(self.n_particles))
        uniform = uniform.to(start.device, torch.float64)
        lost = torch.zeros(len(start), dtype=torch.long, device=start.device)
        return BodyFilterState(particles, uniform, start, lost)

    @torch.no_grad()
    def step(
        self,
        state: BodyFilterState,
        silhouettes: Tensor,
        cameras: Any,
        generator: Generators = None,
    ) -> tuple[BodyFilterState, BodyTrack]:
        """One frame online: the same numbers as the same frame of `forward`.

        Args:
            state: from `init` or the step before. silhouettes: [B, C, H, W], bool.
            cameras, generator: as in `forward`.

        Returns:
            The next state, and a `BodyTrack` without the dimension of time.
        """
        if len(silhouettes) != len(state.mean):
            raise ShapeError(
                f"silhouettes must hold one frame for each of the {len(state.mean)} elements of the "
                f"state, [B, C, H, W]; got {list(silhouettes.shape)}"
            )
        self._check_silhouettes(silhouettes[:, None])
        state, out = self._advance(state, silhouettes, cameras, generator)
        _warn_if_respread(out.respread[:, None])
        return state, out

    def _advance(
        self, state: BodyFilterState, frame: Tensor, cameras: Any, generator: Generators
    ) -> tuple[BodyFilterState, BodyTrack]:
        frame = frame.to(self.step_std.device)
        seen = _is_seen(frame)
        score = self._score(frame, cameras, seen)
        particles, log_weights = self._resample(state, generator)
        moved = self.move(particles, log_weights, score, seen, generator)
        dead = ~torch.isfinite(moved.log_weights.amax(-1))
        lost = torch.where(dead, state.lost + 1, 0)
        particles, log_weights = moved.particles, moved.log_weights
        if bool(dead.any()):
            particles, log_weights = self._respread(moved, state.mean, lost, generator)
        mean = self._estimate(particles, log_weights)
        mean = torch.where(dead[:, None], state.mean, mean)
        evidence = torch.where(seen, moved.log_evidence, 0.0)  # exactly: without rounding
        out = BodyTrack(
            mean,
            torch.where(dead & ~evidence.isnan(), -torch.inf, evidence),
            self._std(particles, log_weights, mean),
            effective_sample_size(log_weights),
            ~seen,
            dead,
        )
        return BodyFilterState(particles, log_weights, mean, lost), out

    # --- pieces that `move` uses

    def diffuse(
        self,
        particles: Float[Tensor, "B N D"],
        std: Float[Tensor, "*B D"],
        generator: Generators,
    ) -> Float[Tensor, "B N D"]:
        """x + N(0, diag(std^2)) (MR 29): the root's orientation is composed; then the joint limits."""
        batch, n, dim = particles.shape
        noise = standard_normal(batch, (n, dim), generator, particles)
        return self.constrain(self.body.perturb(particles, noise * std))

    def constrain(self, particles: Float[Tensor, "B N D"]) -> Float[Tensor, "B N D"]:
        """Particles moved to the joint limits, where `limit_mode` says so."""
        if self.limits is None or self.limit_mode != "clamp":
            return particles
        return self.limits.clamp(particles)

    def log_limits(self, particles: Float[Tensor, "B N D"]) -> Float[Tensor, "B N"]:
        """-inf for particles outside joint limits that discard, else 0; float64."""
        zero = particles.new_zeros(particles.shape[:2], dtype=torch.float64)
        if self.limits is None or self.limit_mode != "discard":
            return zero
        return zero.masked_fill(~self.limits.inside(particles).all(-1), -torch.inf)

    # --- helpers

    def _score(self, frame: Tensor, cameras: Any, seen: Bool[Tensor, " B"]) -> Score:
        raw: Score | None = None
        if bool(seen.any()):
            if callable(self.likelihood):
                likelihood = self.likelihood
                raw = lambda states: likelihood(states, frame)  # noqa: E731
            else:
                raw = silhouette_score(self.body, frame, cameras, self.likelihood)

        def score(states: Tensor) -> Tensor:
            if raw is None:
                return states.new_zeros(states.shape[:2], dtype=torch.float64)
            value = self.sharpness * raw(states).double()
            value = torch.where(torch.isfinite(value), value, -torch.inf)
            return torch.where(seen[:, None], value, 0.0)

        return score

    def _resample(self, state: BodyFilterState, generator: Generators) -> tuple[Tensor, Tensor]:
        """Resample the elements whose effective sample size is low; the others stay."""
        n = self.n_particles
        due = effective_sample_size(state.log_weights) < self.resample_threshold * n
        # drawn for all: what an element draws must not depend on its neighbours
        ancestors = resample(state.log_weights, self.resampling, generator)
        ancestors = torch.where(due[:, None], ancestors, torch.arange(n, device=due.device))
        particles = take_particles(state.particles, ancestors)
        return particles, torch.where(due[:, None], -math.log(n), state.log_weights)

    def _respread(
        self,
        moved: WeightedParticles,
        mean: Float[Tensor, "B D"],
        lost: Int[Tensor, " B"],
        generator: Generators,
    ) -> tuple[Tensor, Tensor]:
        """New particles about the last mean in the elements whose particles died."""
        rows = torch.nonzero(lost > 0).reshape(-1)
        if isinstance(generator, Sequence):
            generator = [generator[i] for i in rows.tolist()]
        start = mean[rows, None].expand(-1, self.n_particles, -1)
        growth = lost[rows].clamp_max(_MOST_SPREAD)[:, None, None]
        particles, log_weights = moved.particles.clone(), moved.log_weights.clone()
        std = self.respread_scale * growth * self.step_std
        particles[rows] = self.diffuse(start, std, generator)
        log_weights[rows] = -math.log(self.n_particles)
        return particles, log_weights

    def _estimate(self, particles: Tensor, log_weights: Tensor) -> Float[Tensor, "B D"]:
        if self.estimate == "mean":
            return self.body.mean(particles, log_weights.to(particles.dtype))
        best = log_weights.argmax(-1, keepdim=True)
        return take_particles(particles, best)[:, 0]

    def _std(self, particles: Tensor, log_weights: Tensor, mean: Tensor) -> Float[Tensor, "B D"]:
        gap = self.body.difference(particles, mean[:, None].expand_as(particles))
        weights = log_weights.exp().to(gap.dtype)
        return torch.einsum("bn,bnd->bd", weights, gap.square()).sqrt()

    def _check(
        self, silhouettes: Tensor, initial_state: Tensor, generator: Generators
    ) -> tuple[Tensor, Tensor, bool]:
        """Observations [B, T, ...], initial states [B, D], and whether a batch was given."""
        check_shape("initial_state", initial_state, ["...", self.body.dim])
        if initial_state.ndim > 2:
            raise ShapeError(
                f"initial_state must be [D] or [B, D], got {list(initial_state.shape)}"
            )
        batched = initial_state.ndim == 2
        if callable(self.likelihood):
            frames = silhouettes if batched else silhouettes[None]
        else:
            if silhouettes.ndim not in (4, 5):
                raise ShapeError(
                    "silhouettes must have shape [T, C, H, W] or [B, T, C, H, W], "
                    f"got {list(silhouettes.shape)}"
                )
            batched = batched or silhouettes.ndim == 5
            frames = silhouettes if silhouettes.ndim == 5 else silhouettes[None]
            self._check_silhouettes(frames)
        start = initial_state if initial_state.ndim == 2 else initial_state[None]
        sizes = {len(frames), len(start)} - {1}
        if len(sizes) > 1 or 0 in sizes or 0 in frames.shape[:2]:
            raise ShapeError(
                "silhouettes and initial_state must hold the same number of sequences, at least one "
                f"of one frame; got {list(silhouettes.shape)} and {list(initial_state.shape)}"
            )
        batch = max(len(frames), len(start))
        if isinstance(generator, Sequence) and len(generator) != batch:
            raise InputError(
                f"a list of generators must hold one for each of the {batch} sequences, "
                f"got {len(generator)}"
            )
        return frames.expand(batch, *frames.shape[1:]), start.expand(batch, -1), batched

    def _check_silhouettes(self, frames: Tensor) -> None:
        if callable(self.likelihood):
            return
        check_shape("silhouettes", frames, ["B", "T", "C", "H", "W"])
        if frames.dtype != torch.bool:
            raise InputError(
                f"silhouettes must be bool (True = person), got {frames.dtype}; pass mask > 0"
            )


def _is_seen(frame: Tensor) -> Bool[Tensor, " B"]:
    """Whether anything is observed: a True pixel, or a number that is not NaN."""
    known = frame if frame.dtype == torch.bool else ~torch.isnan(frame)
    return known.flatten(1).any(1)


def _check_choice(name: str, value: Any, choices: Sequence[str]) -> None:
    if isinstance(value, str) and value in choices:
        return
    if name == "likelihood" and callable(value):
        return
    raise InputError(f"{name} must be one of {', '.join(choices)}, got {value!r}")


def _warn_if_respread(respread: Bool[Tensor, "B T"]) -> None:
    if not bool(respread.any()):
        return
    rows, frames = torch.nonzero(respread, as_tuple=True)
    listed = [
        f"element {b} at frame {t}" for b, t in zip(rows.tolist(), frames.tolist(), strict=True)
    ]
    warnings.warn(
        f"all particles died {len(listed)} times ({', '.join(listed[:8])}) and were spread about the "
        "last mean; use more particles, a larger step_std, a smaller sharpness or wider joint limits",
        DegenerateFilterWarning,
        stacklevel=3,
    )
