"""Define what a filter over body poses says for itself; all but `move` has a usual form here."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.module_state import NoHalfModule
from torchpose.filters._recursive_filter import Generators
from torchpose.whole_body._filters.body_frames import Frame
from torchpose.whole_body._filters.body_particles import (
    BodyFilterOutput,
    BodyFilterState,
    PoseSpace,
    WeightedParticles,
    joint_covariance,
    particle_std,
    warn_of_frames,
)
from torchpose.whole_body._filters.motion import default_step_std

_SHARPNESS = 100.0  # exponent of a likelihood in [-2, 0] that tells poses apart
_DIED = (
    "all particles died {times} times ({frames}) and were spread about the last mean; use more "
    "particles, a larger process_cov, a smaller sharpness or wider joint limits"
)


class BodyFilterHooks(NoHalfModule, ABC):
    """Defines what `SilhouetteParticleFilter` and `BodyTracker` ask of a filter.

    Attributes:
        body: whose poses are tracked. step_std: standard deviations of the diffusion per frame [D].
    """

    least_particles: ClassVar[int] = 1  # of a layer if there are several: two or more survive
    unused: ClassVar[frozenset[str]] = frozenset()  # options that make no difference
    body: PoseSpace
    step_std: Tensor

    # --- what a subclass adds

    @abstractmethod
    def move(
        self, state: BodyFilterState, frame: Frame, generator: Generators
    ) -> WeightedParticles:
        """Return weighted particles of the next frame from those of the last.

        Args:
            state: the state of the last frame, with resampled particles and the filter's memory of them.
            frame: the observation of the frame.
            generator: one generator, or a list of one for each element.

        Returns:
            `WeightedParticles` [B, N, D] of the next frame.
        """

    def first_memory(self, particles: Float[Tensor, "B N D"]) -> Tensor | None:
        """Return what the filter keeps of new particles beside their states; nothing by default.

        Args:
            particles: [B, N, D], metres and quaternion vectors.

        Returns:
            [B, N, ...], or None.
        """
        return None

    def first_trend(self, mean: Float[Tensor, "B D"]) -> Tensor | None:
        """Return what the filter keeps of an element before its first frame; nothing by default.

        Args:
            mean: the first estimate [B, D].

        Returns:
            [B, ...], or None.
        """
        return None

    def swap_memory(self, memory: Tensor, swapped: Bool[Tensor, "B N"]) -> Tensor:
        """Return the memory of particles of which some have exchanged their legs; the same by default.

        Args:
            memory: the memory of the particles, as in the state.
            swapped: [B, N], True where a particle has exchanged its legs.

        Returns:
            Memory of the same shape.
        """
        return memory

    def spread(
        self,
        particles: Float[Tensor, "B N D"],
        log_weights: Float[Tensor, "B N"],
        mean: Float[Tensor, "B D"],
        memory: Tensor | None,
    ) -> Float[Tensor, "B D"]:
        """Return the standard deviation about the estimate, in the units of a step.

        Args:
            particles: [B, N, D]. log_weights: normalised, [B, N]. mean: the estimate [B, D].
            memory: the memory of the particles, as in the state.

        Returns:
            [B, D], metres for the root's position, sines of half angles for rotations.
        """
        return particle_std(self.body, particles, log_weights, mean)

    def joint_covariance(
        self, state: BodyFilterState, mean: Float[Tensor, "B D"]
    ) -> Float[Tensor, "B J 3 3"]:
        """Return the second moment of the joints of a `Body` about those of an estimate.

        Args:
            state: weighted particles after a step. mean: the estimate [B, D].

        Returns:
            [B, J, 3, 3], square metres, world axes.
        """
        return joint_covariance(self.body, state, mean)  # type: ignore[arg-type]

    def warn(self, track: BodyFilterOutput) -> None:
        """Warn of the frames of a track in which the filter degenerated.

        Args:
            track: the track of a batch, [B, T, ...]; past the length of a sequence its details are zero.
        """
        warn_of_frames(track.respread, _DIED)

    # --- how `BodyTracker` sets a filter up; a subclass may say otherwise

    @classmethod
    def likelihoods_per_particle(cls, options: Mapping[str, Any]) -> int:
        """Return the number of likelihoods of whole bodies that one particle costs in a frame.

        Args:
            options: the options of the filter, as given to it.

        Returns:
            Number of likelihoods for each particle and frame.
        """
        return 1

    @classmethod
    def tracking_options(cls, body: Any, fps: float, learnt: Any = None) -> dict[str, Any]:
        """Return the options that `BodyTracker` passes to the filter where the user sets none.

        Args:
            body: that is tracked. fps: frames per second. learnt: the model that the filter needs, if any.

        Returns:
            Keyword arguments of the filter.
        """
        return {"process_cov": default_step_std(body, fps).square(), "sharpness": _SHARPNESS}

    @property
    def process_cov(self) -> Float[Tensor, " D"]:
        """Return the variances of the diffusion per frame."""
        return self.step_std.square()

    @property
    def sharpness_cancels(self) -> bool:
        """Return whether the exponent of silhouettes alone makes no difference, as where it is solved for."""
        return "sharpness" in self.unused

    def start_std(self) -> Float[Tensor, " D"]:
        """Return the spread of particles about a first pose that was found in images."""
        return 2 * self.step_std

    @property
    def action_names(self) -> tuple[str, ...]:
        """Return the names of the columns of ``details["actions"]``; empty by default."""
        return ()

    def notes(self, track: BodyFilterOutput, first_frame: int = 0) -> tuple[str, ...]:
        """Report what is notable about a track; nothing by default.

        Args:
            track: the track of one sequence, [T, ...]. first_frame: number of its first frame.

        Returns:
            Sentences, none if there is nothing to report.
        """
        return ()
