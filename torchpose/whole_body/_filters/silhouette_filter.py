"""Provide what the particle filters over body poses share: likelihood, limits, coasting, estimates.

A subclass implements `move`, which turns the particles of one frame into weighted particles of the
next. Batches, empty silhouettes, dead particles and the loop over time are handled here.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from tqdm.auto import tqdm

from torchpose._core.checks import (
    check_choice,
    check_count,
    check_finite,
    check_positive,
    check_shape,
    check_tensors,
    number_of,
)
from torchpose._core.former_arguments import rename_former_hook, takes_former_arguments
from torchpose._core.module_state import as_one_run
from torchpose._core.moved import warn_of_former
from torchpose.camera._rig import as_rig
from torchpose.errors import InputError
from torchpose.filters._measurements import check_lengths
from torchpose.filters._outputs import effective_sample_size
from torchpose.filters._recursive_filter import Generators, check_generators, standard_normal
from torchpose.filters._resampling import RESAMPLING
from torchpose.whole_body._filters.body_frames import (
    Frame,
    Likelihood,
    check_observation,
    check_sequences,
    see_frame,
    seen_until,
    with_keypoints,
)
from torchpose.whole_body._filters.body_particles import (
    BodyFilterOutput,
    BodyFilterState,
    PoseSpace,
    WeightedParticles,
    best_particle,
    check_body,
    check_limits,
    resample_state,
    stack_outputs,
    without_repeats,
)
from torchpose.whole_body._filters.hooks import BodyFilterHooks
from torchpose.whole_body._filters.legs import check_leg_swap, extra_copies, swap_legs
from torchpose.whole_body._filters.motion import diffusion_std, std_of_covariance
from torchpose.whole_body._keypoints.particle_likelihood import KeypointMeasurement
from torchpose.whole_body._silhouettes.likelihood import LIKELIHOODS
from torchpose.whole_body._silhouettes.outlines import check_limb_shape

_MOST_SPREAD = 10  # frames over which the noise of a filter that stays lost keeps growing


class SilhouetteParticleFilter(BodyFilterHooks):
    """Filters body poses by particles from silhouettes; a subclass implements `move`.

    `forward` tracks whole sequences; `init`, then `step` (one frame) or `advance` (some more frames) give the
    same numbers online. Estimates have no gradients: nothing runs through particles.

    Args:
        body: whose poses are tracked; anything with the methods of `PoseSpace`.
        n_particles: N.
        process_cov: variances of the diffusion per frame, [D], [D, D] without entries off the diagonal, or
            one number (squares of metres for the root, of sines of half angles for rotations); the
            square of `default_step_std` if None (MR 29). step_std: its square root; deprecated.
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
        leg_swap: for a person whose legs may have been taken for each other: an extra copy that
            resampling makes of a particle goes on with its legs exchanged with this probability times
            the angle between its upper legs over pi (Daubney & Xie, section 8); 0 for never.
        limb_shape: of the body in silhouettes, "cylinders" or "rectangles" (AS, section 3.2).
        respread_scale: particles that all died are drawn about the last mean with this many times
            the noise of a step, twice that in the second such frame, and so on up to ten times.

    Raises:
        InputError, ShapeError: an argument is not as described.
    """

    def __init__(
        self,
        body: PoseSpace,
        n_particles: int = 500,
        *,
        process_cov: Tensor | float | None = None,
        step_std: Tensor | float | None = None,
        likelihood: str | Likelihood = "bidirectional",
        sharpness: float = 1.0,
        limits: Any | None = None,
        limit_mode: str = "clamp",
        resampling: str = "systematic",
        resample_threshold: float = 1.0,
        estimate: str = "mean",
        leg_swap: float = 0.0,
        limb_shape: str = "cylinders",
        respread_scale: float = 5.0,
    ) -> None:
        super().__init__()
        if not callable(likelihood):
            check_choice("likelihood", likelihood, LIKELIHOODS)
        check_choice("limit_mode", limit_mode, ("clamp", "discard"))
        check_choice("resampling", resampling, RESAMPLING)
        check_choice("estimate", estimate, ("mean", "map"))
        check_count("n_particles", n_particles)
        if not 0 <= number_of(resample_threshold) <= 1:
            raise InputError(f"resample_threshold must be from 0 to 1, got {resample_threshold}")
        check_body(body)
        check_limits(limits, "clamp" if limit_mode == "clamp" else "inside")
        check_leg_swap(body, leg_swap)
        check_limb_shape(limb_shape)
        for name, value in (("sharpness", sharpness), ("respread_scale", respread_scale)):
            check_positive(name, value)
        self.body, self.limits, self.limit_mode = body, limits, limit_mode
        self.n_particles, self.sharpness = n_particles, float(sharpness)
        self.likelihood, self.limb_shape, self.estimate = likelihood, limb_shape, estimate
        self.resampling, self.resample_threshold = resampling, resample_threshold
        self.leg_swap, self.respread_scale = leg_swap, respread_scale
        self.register_buffer("step_std", diffusion_std(body, process_cov, step_std))

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        rename_former_hook(cls, "advance", "filter_frame")

    @property
    def _plain(self) -> bool:
        """Return whether observations are silhouettes, and not what a callable takes."""
        return not callable(self.likelihood)

    # --- running

    @takes_former_arguments
    @torch.no_grad()
    def forward(
        self,
        silhouettes: Tensor,
        cameras: Any,
        initial_state: Tensor,
        *,
        generator: Generators = None,
        lengths: Tensor | None = None,
        initial_cov: Tensor | float | None = None,
        progress: bool = False,
    ) -> BodyFilterOutput:
        """Track one person through a sequence, or several through a batch of sequences.

        Args:
            silhouettes: bool [T, C, H, W] or [B, T, C, H, W], undistorted; with a callable as the
                likelihood any observations [T, ...], or [B, T, ...] with an initial state [B, D].
            cameras: the C cameras (`CameraRig`, or what makes one); handed to the likelihood.
            initial_state: the pose one frame before the first, [D] or [B, D].
            generator: one generator, or a list of one for each sequence, which makes a sequence's
                numbers independent of its batch.
            lengths: [B], frames of each sequence; past them its last estimate is repeated.
            initial_cov: variances of the first particles, as `process_cov`; none if None, as published.
            progress: whether to show a progress bar.

        Returns:
            `BodyFilterOutput`, with the dimension of the batch if there was one.

        Raises:
            ShapeError: sizes that do not match. InputError: no frames, values that are not finite,
            silhouettes that are not bool, lengths outside 1..T. CameraError: as the likelihood.
        """
        frames, start, batched = check_sequences(
            silhouettes, initial_state, generator, self.body.dim, plain=self._plain
        )
        if lengths is not None:
            lengths = check_lengths(lengths, len(frames), frames.shape[1], self.step_std.device)
        state = self.init(start, generator=generator, initial_cov=initial_cov)
        track = self._run(state, frames, cameras, generator, lengths, progress)[1]
        return track if batched else track.element(0)

    if TYPE_CHECKING:  # nn.Module has Any
        __call__ = forward

    @takes_former_arguments
    @torch.no_grad()
    @as_one_run
    def init(
        self,
        initial_state: Float[Tensor, "*B D"],
        *,
        generator: Generators = None,
        initial_cov: Tensor | float | None = None,
    ) -> BodyFilterState:
        """Return N copies of the initial state, which are spread on request (step 1, MR).

        Args:
            initial_state: [D] or [B, D], metres and quaternion vectors.
            generator: one generator, or a list of one for each element.
            initial_cov: [D], variances of the spread, as `process_cov`; None spreads nothing.

        Returns:
            `BodyFilterState` with particles [B, N, D].

        Raises:
            ShapeError: other sizes. InputError: NaN or infinite numbers, a list of another length.
        """
        check_tensors(initial_state=initial_state)
        start = initial_state.to(self.step_std, copy=True).reshape(-1, initial_state.shape[-1])
        check_shape("initial_state", start, ["B", self.body.dim])
        check_finite("initial_state", start)
        check_generators(generator, len(start))
        particles = start[:, None].expand(-1, self.n_particles, -1).contiguous()
        if initial_cov is not None:
            spread = std_of_covariance("initial_cov", initial_cov, self.body.dim)
            particles = self.diffuse(particles, spread.to(self.step_std), generator)
        uniform = torch.full(
            particles.shape[:2], -math.log(self.n_particles), dtype=torch.float64,
            device=start.device,
        )  # fmt: skip
        lost = torch.zeros(len(start), dtype=torch.long, device=start.device)
        memory, trend = self.first_memory(particles), self.first_trend(start)
        return BodyFilterState(particles, uniform, start, lost, memory, trend)

    @takes_former_arguments
    @torch.no_grad()
    def step(
        self,
        state: BodyFilterState,
        silhouettes: Tensor,
        cameras: Any,
        *,
        generator: Generators = None,
    ) -> tuple[BodyFilterState, BodyFilterOutput]:
        """Track one more frame: the same numbers as the same frame of `forward`.

        Args:
            state: the state from `init`, `step` or `advance`. silhouettes: [B, C, H, W], bool.
            cameras, generator: as in `forward`.

        Returns:
            The next state, and a `BodyFilterOutput` without the dimension of time.

        Raises:
            ShapeError, InputError, CameraError: as `forward`, or the state of another filter.
        """
        self._check_state(state)
        check_observation(silhouettes, len(state.mean), generator, plain=self._plain)
        cameras = self._checked_cameras(cameras, silhouettes)
        state, out = self.filter_frame(state, silhouettes, cameras, generator)
        self.warn(stack_outputs([out]))
        return state, out

    @takes_former_arguments
    @torch.no_grad()
    def advance(
        self,
        state: BodyFilterState,
        silhouettes: Tensor,
        cameras: Any,
        *,
        generator: Generators = None,
    ) -> tuple[BodyFilterState, BodyFilterOutput]:
        """Track some more frames: the same numbers as `step` for one after the other.

        Args:
            state: the state from `init`, `step` or `advance`. silhouettes: [B, T, C, H, W], bool.
            cameras, generator: as in `forward`.

        Returns:
            The next state, and a `BodyFilterOutput` [B, T].

        Raises:
            ShapeError, InputError, CameraError: as `forward`.
        """
        self._check_state(state)
        check_tensors(silhouettes=silhouettes)
        if self._plain and silhouettes.ndim == 4:
            warn_of_former("advance is of several frames now, filter_frame of one; one frame goes")
            check_observation(silhouettes, len(state.mean), generator, plain=True)
            return self.filter_frame(state, silhouettes, cameras, generator)
        check_observation(silhouettes, len(state.mean), generator, plain=self._plain, frames=True)
        return self._run(state, silhouettes, cameras, generator)

    def _run(
        self,
        state: BodyFilterState,
        frames: Tensor,
        cameras: Any,
        generator: Generators,
        lengths: Int[Tensor, " B"] | None = None,
        progress: bool = False,
    ) -> tuple[BodyFilterState, BodyFilterOutput]:
        """Return the state after some frames [B, T, ...], and their estimates: the one loop over time."""
        cameras, steps = self._checked_cameras(cameras, frames), []
        for t in tqdm(range(frames.shape[1]), disable=not progress, unit="frame"):
            shown = frames[:, t] if lengths is None else seen_until(lengths > t, frames[:, t])
            state, out = self.filter_frame(state, shown, cameras, generator)
            steps.append(out)
        track = stack_outputs(steps, lengths)
        self.warn(without_repeats(track, lengths))
        return state, track

    @as_one_run
    def filter_frame(
        self,
        state: BodyFilterState,
        silhouettes: Tensor | None,
        cameras: Any,
        generator: Generators,
        keypoints: KeypointMeasurement | None = None,
    ) -> tuple[BodyFilterState, BodyFilterOutput]:
        """Track one more frame, as `step`, of checked silhouettes; without warnings.

        Args:
            state: the state of B elements, from `init` or the frame before.
            silhouettes: bool [B, C, H, W], or None with keypoints. cameras: the C cameras.
            generator: one generator, or a list of one for each element.
            keypoints: of the frame, whose log-likelihood adds to that of the silhouettes, or None.

        Returns:
            The next state, and the `BodyFilterOutput` of the frame, [B, ...].
        """
        frame = with_keypoints(self.body, self._outlined(state, silhouettes, cameras), keypoints)
        moved = self.move(self._resample(state, generator), frame, generator)
        dead = ~torch.isfinite(moved.log_weights.amax(-1))
        lost = torch.where(dead, state.lost + 1, 0)
        if bool(dead.any()):
            moved = self._respread(moved, state.mean, lost, generator)
        particles, log_weights = moved.particles, moved.log_weights
        mean = self._estimate(particles, log_weights)
        mean = torch.where(dead[:, None], state.mean, mean)
        evidence = torch.where(frame.seen, moved.log_evidence, 0.0)  # exactly: without rounding
        out = BodyFilterOutput(
            mean.clone(), torch.where(dead & ~evidence.isnan(), -torch.inf, evidence),
            self.spread(particles, log_weights, mean, moved.memory),
            effective_sample_size(log_weights), ~frame.seen, dead, moved.details or {},
        )  # fmt: skip
        after = BodyFilterState(particles, log_weights, mean, lost, moved.memory, moved.trend)
        return after, out

    # --- pieces that `move` uses

    def diffuse(
        self, particles: Float[Tensor, "B N D"], std: Float[Tensor, "*B D"], generator: Generators
    ) -> Float[Tensor, "B N D"]:
        """Return x + N(0, diag(std^2)) (MR 29), within the joint limits; orientations are composed.

        Args:
            particles: x [B, N, D], metres and quaternion vectors.
            std: [D] or [B, 1, D], in the units of a step.
            generator: one generator, or a list of one for each element.

        Returns:
            [B, N, D].
        """
        batch, n, dim = particles.shape
        noise = standard_normal(batch, (n, dim), generator, particles)
        return self.constrain(self.body.perturb(particles, noise * std))

    def constrain(self, particles: Float[Tensor, "B N D"]) -> Float[Tensor, "B N D"]:
        """Move particles to the joint limits, where `limit_mode` is "clamp".

        Args:
            particles: [B, N, D], metres and quaternion vectors.

        Returns:
            [B, N, D].
        """
        if self.limits is None or self.limit_mode != "clamp":
            return particles
        return self.limits.clamp(particles)

    def log_limits(self, particles: Float[Tensor, "B N D"]) -> Float[Tensor, "B N"]:
        """Return -inf for particles outside joint limits that discard, else 0.

        Args:
            particles: [B, N, D], metres and quaternion vectors.

        Returns:
            [B, N], float64.
        """
        zero = particles.new_zeros(particles.shape[:2], dtype=torch.float64)
        if self.limits is None or self.limit_mode != "discard":
            return zero
        return zero.masked_fill(~self.limits.inside(particles).all(-1), -torch.inf)

    # --- helpers

    def _checked_cameras(self, cameras: Any, silhouettes: Tensor) -> Any:
        """Return the cameras of silhouettes as a rig; what a callable takes stays as it is.

        Raises:
            CameraError: no cameras, or silhouettes of another number or size.
        """
        if not self._plain:
            return cameras
        rig = as_rig(cameras)
        rig.check_images("silhouettes", silhouettes.shape)
        return rig

    def _check_state(self, state: object) -> None:
        """Raise unless this is a state of this filter, of as many particles over as many columns."""
        if not isinstance(state, BodyFilterState):
            raise InputError(
                f"state must be a BodyFilterState from this filter's init or step, got {type(state).__name__}"
            )
        check_shape("state.particles", state.particles, ["B", self.n_particles, self.body.dim])
        if (state.trend is None) != (self.first_trend(state.mean) is None):
            raise InputError("state is of another kind of filter; begin with init")

    def _outlined(
        self, state: BodyFilterState, silhouettes: Tensor | None, cameras: Any
    ) -> Frame | None:
        """Return the frame of silhouettes, if there are any."""
        if silhouettes is None:
            return None
        return see_frame(
            self.body, state.mean, silhouettes.to(self.step_std.device), cameras, self.likelihood,
            self.sharpness, self.limb_shape,
        )  # fmt: skip

    def _resample(self, state: BodyFilterState, generator: Generators) -> BodyFilterState:
        """Resample where it is due, and exchange the legs of some extra copies."""
        state, ancestors = resample_state(
            state, self.resampling, self.resample_threshold, generator
        )
        if self.leg_swap == 0:
            return state
        extra = extra_copies(ancestors)  # of elements that were not resampled: none
        particles, swapped = swap_legs(self.body, state.particles, extra, self.leg_swap, generator)
        memory = None if state.memory is None else self.swap_memory(state.memory, swapped)
        return state._replace(particles=particles, memory=memory)

    def _respread(
        self,
        moved: WeightedParticles,
        mean: Float[Tensor, "B D"],
        lost: Int[Tensor, " B"],
        generator: Generators,
    ) -> WeightedParticles:
        """Draw new particles about the last mean in the elements whose particles died."""
        rows = torch.nonzero(lost > 0).reshape(-1)
        if isinstance(generator, Sequence):
            generator = [generator[i] for i in rows.tolist()]
        start = mean[rows, None].expand(-1, self.n_particles, -1)
        growth = lost[rows].clamp_max(_MOST_SPREAD)[:, None, None]
        particles, log_weights = moved.particles.clone(), moved.log_weights.clone()
        std = self.respread_scale * growth * self.step_std
        particles[rows] = self.diffuse(start, std, generator)
        log_weights[rows] = -math.log(self.n_particles)
        memory = self.first_memory(particles)
        if memory is not None and moved.memory is not None:
            fresh, memory = memory, moved.memory.clone()
            memory[rows] = fresh[rows]
        return moved._replace(particles=particles, log_weights=log_weights, memory=memory)

    def _estimate(self, particles: Tensor, log_weights: Tensor) -> Float[Tensor, "B D"]:
        if self.estimate == "mean":
            return self.body.mean(particles, log_weights.to(particles.dtype))
        return best_particle(particles, log_weights)
