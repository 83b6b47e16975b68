"""Define particles over body poses: their weights, states and tracks, and the body they need."""

import math
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, TypedDict, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchpose._core.facade import set_up_facade
from torchpose.body._kinematics import Body
from torchpose.errors import DegenerateFilterWarning, InputError
from torchpose.filters._lengths import held_past_lengths, inside_lengths
from torchpose.filters._outputs import effective_sample_size
from torchpose.filters._recursive_filter import Generators
from torchpose.filters._resampling import resample
from torchpose.whole_body._filters.body_frames import Likelihood

_LISTED = 8  # frames that a warning names
_ROUNDING = 1e-9  # of the effective sample size: particles of equal weights are left as they are


@runtime_checkable
class PoseSpace(Protocol):
    """Declares what filters need of a body that they track; `torchpose.body.Body` has it.

    Attributes:
        dim: D. perturb(state, step): the state moved by a step, both [..., D].
        difference(a, b): the step with perturb(b, step) = a.
        mean(states, log_weights): weighted mean of states [..., N, D] over N, [..., D].
    """

    dim: int

    def perturb(self, state: Tensor, step: Tensor) -> Tensor: ...

    def difference(self, a: Tensor, b: Tensor) -> Tensor: ...

    def mean(self, states: Tensor, log_weights: Tensor) -> Tensor: ...


class WeightingOptions(TypedDict, total=False):
    """Declares the options of `SilhouetteParticleFilter` but for its noise."""

    likelihood: str | Likelihood
    sharpness: float
    limits: Any | None
    limit_mode: str
    resampling: str
    resample_threshold: float
    estimate: str
    leg_swap: float
    limb_shape: str
    respread_scale: float


class BodyFilterOptions(WeightingOptions, total=False):
    """Declares the options of `SilhouetteParticleFilter`, which every filter over body poses has."""

    process_cov: Tensor | float | None
    step_std: Tensor | float | None


class BodyFilterOutput(NamedTuple):
    """Holds the estimates of a sequence [T, ...], of a batch [B, T, ...], or of a step [B, ...].

    A filter over bodies that fails goes on: in the frames of `respread` its particles are drawn anew.

    Past the length of a sequence its last estimate is repeated, with log-evidence 0.

    Attributes:
        mean: the estimated state [..., D].
        log_evidence: log p(I_t | I_1:t-1). 0 while coasting, -inf where all particles died, NaN from
            filters whose weights are no posterior's.
        std: standard deviation of the particles about the mean [..., D], in the units of a step
            (`Body.difference`).
        effective_sample_size: 1 / sum_n w_n^2 of the weights of the estimate.
        coasting: True where no camera saw the person: diffused, not weighted by an image.
        respread: True where all particles had died: drawn anew about the last mean.
        details: what only some filters report, by name, each with the same leading dimensions.
    """

    mean: Tensor
    log_evidence: Tensor
    std: Tensor
    effective_sample_size: Tensor
    coasting: Tensor
    respread: Tensor
    details: dict[str, Tensor]

    @property
    def failed_at(self) -> Int[Tensor, "*batch"]:
        """Return the first frame in which all particles died, -1 where there is none; of sequences."""
        return first_true(self.respread)

    @property
    def failed(self) -> Bool[Tensor, "*batch"]:
        """Return whether the filter failed, in any frame; of sequences."""
        return self.respread.any(-1)

    def element(self, index: int) -> "BodyFilterOutput":
        """Return the track of one element of a batch.

        Args:
            index: the index of the element, 0 to B - 1.

        Returns:
            `BodyFilterOutput` without the batch dimension.
        """
        parts: dict[str, Any] = {name: getattr(self, name)[index] for name in self._fields[:-1]}
        return BodyFilterOutput(
            **parts, details={n: value[index] for n, value in self.details.items()}
        )


class BodyFilterState(NamedTuple):
    """Holds weighted particles after a step, before they are resampled.

    Attributes:
        particles: [B, N, D]. log_weights: normalised, [B, N], float64. mean: last estimate [B, D].
        lost: number of frames in a row in which all particles died, [B].
        memory: what a filter keeps of every particle beside its state, [B, N, ...]; resampled
            with them. trend: what it keeps of every element, [B, ...].
    """

    particles: Tensor
    log_weights: Tensor
    mean: Tensor
    lost: Tensor
    memory: Tensor | None = None
    trend: Tensor | None = None


class WeightedParticles(NamedTuple):
    """Holds the particles of a new frame, as `SilhouetteParticleFilter.move` returns them.

    Attributes:
        particles: [B, N, D]. log_weights: normalised [B, N], float64; NaN in an element whose particles
            all died. log_evidence: of the frame, [B]; it counts where somebody is seen.
        memory, trend: as in the state, of the new frame. details: as in `BodyFilterOutput`, [B, ...].
    """

    particles: Tensor
    log_weights: Tensor
    log_evidence: Tensor
    memory: Tensor | None = None
    trend: Tensor | None = None
    details: dict[str, Tensor] | None = None


def check_body(body: object) -> None:
    """Raise `InputError` unless particles can be moved in this space."""
    if not isinstance(body, PoseSpace):
        raise InputError(
            f"body must be a torchpose.body.Body, or have dim, perturb, difference and mean, got "
            f"{type(body).__name__}"
        )


def check_limits(limits: object, method: str) -> None:
    """Raise `InputError` unless limits are None or have this method, as `torchpose.body.JointLimits`."""
    if limits is not None and not callable(getattr(limits, method, None)):
        raise InputError(
            f"limits must be a torchpose.body.JointLimits, or have its method {method}, got "
            f"{type(limits).__name__}"
        )


def first_true(flags: Bool[Tensor, "*batch T"]) -> Int[Tensor, "*batch"]:
    """Return the first frame that is True, -1 where none is."""
    return torch.where(flags.any(-1), flags.int().argmax(-1), -1)


def stack_outputs(
    steps: Sequence[BodyFilterOutput], lengths: Int[Tensor, " B"] | None = None
) -> BodyFilterOutput:
    """Put the steps [B, ...] of a run together as one track [B, T, ...].

    Args:
        lengths: [B], frames of each sequence; all of them if None.
    """
    parts: dict[str, Any] = {
        name: torch.stack([getattr(step, name) for step in steps], 1)
        for name in BodyFilterOutput._fields[:-1]
    }
    names = steps[0].details
    details = {name: torch.stack([step.details[name] for step in steps], 1) for name in names}
    if lengths is None:
        return BodyFilterOutput(**parts, details=details)
    inside = inside_lengths(lengths, len(steps))
    parts = {name: held_past_lengths(value, lengths) for name, value in parts.items()}
    parts["log_evidence"] = torch.where(inside, parts["log_evidence"], 0.0)
    parts["respread"] = parts["respread"] & inside
    details = {name: held_past_lengths(value, lengths) for name, value in details.items()}
    return BodyFilterOutput(**parts, details=details)


def without_repeats(track: BodyFilterOutput, lengths: Int[Tensor, " B"] | None) -> BodyFilterOutput:
    """Return a track [B, T, ...] whose details are zero past the lengths, where they repeat the last ones."""
    if lengths is None:
        return track
    past = ~inside_lengths(lengths, track.mean.shape[1])
    details = {
        name: value.masked_fill(past.view(*past.shape, *[1] * (value.ndim - 2)), 0)
        for name, value in track.details.items()
    }
    return track._replace(details=details)


def reweight(
    particles: Float[Tensor, "B N D"],
    log_prior: Float[Tensor, "B N"],
    log_likelihood: Float[Tensor, "B N"],
) -> WeightedParticles:
    """Return particles with the weights of the posterior, and the log-evidence of the frame.

    xi_n = pi_n omega_n / sum_j pi_j omega_j,   log p(I_t | I_1:t-1) = log sum_n omega_n pi_n / sum_n omega_n

    Args:
        particles: [B, N, D].
        log_prior: log omega [B, N], of the prediction, normalised or not.
        log_likelihood: log pi [B, N].

    Returns:
        `WeightedParticles`; the log-evidence is -inf where all particles died.

    Reference: (MR 5), (MR 9)-(MR 11).
    """
    log_prior = log_prior - torch.logsumexp(log_prior, -1, keepdim=True)
    joint = log_prior + log_likelihood
    evidence = torch.logsumexp(joint, -1)
    log_weights = joint - evidence[:, None]
    evidence = torch.where(evidence.isnan(), -torch.inf, evidence)
    return WeightedParticles(particles, log_weights, evidence)


def take_particles(
    particles: Shaped[Tensor, "B N *rest"], ancestors: Int[Tensor, "B n"]
) -> Shaped[Tensor, "B n *rest"]:
    """Return particles[b, ancestors[b, i]]."""
    batch, n, *rest = particles.shape
    first = torch.arange(batch, device=ancestors.device)[:, None] * n
    taken = particles.flatten(0, 1).index_select(0, (ancestors + first).reshape(-1))
    return taken.view(batch, ancestors.shape[1], *rest)


def resample_state(
    state: BodyFilterState, method: str, threshold: float, generator: Generators
) -> tuple[BodyFilterState, Int[Tensor, "B N"]]:
    """Resample the elements whose effective sample size is low; returns the state and the ancestors.

    Args:
        method: as `resample`. threshold: share of N below which it is due; the other elements stay.
    """
    n = state.particles.shape[1]
    due = effective_sample_size(state.log_weights) < threshold * n * (1 - _ROUNDING)
    # drawn for all: what an element draws must not depend on its neighbours
    ancestors = resample(state.log_weights, method, generator)
    ancestors = torch.where(due[:, None], ancestors, torch.arange(n, device=due.device))
    memory = None if state.memory is None else take_particles(state.memory, ancestors)
    resampled = state._replace(
        particles=take_particles(state.particles, ancestors),
        log_weights=torch.where(due[:, None], -math.log(n), state.log_weights),
        memory=memory,
    )
    return resampled, ancestors


def best_particle(
    particles: Float[Tensor, "B N D"], log_weights: Float[Tensor, "B N"]
) -> Float[Tensor, "B D"]:
    """Return the particle of the largest weight."""
    return take_particles(particles, log_weights.argmax(-1, keepdim=True))[:, 0]


def particle_std(
    body: PoseSpace,
    particles: Float[Tensor, "B N D"],
    log_weights: Float[Tensor, "B N"],
    mean: Float[Tensor, "B D"],
) -> Float[Tensor, "B D"]:
    """Return the standard deviation of particles about an estimate, in the units of a step."""
    gap = body.difference(particles, mean[:, None].expand_as(particles))
    weights = log_weights.exp().to(gap.dtype)
    return torch.einsum("bn,bnd->bd", weights, gap.square()).sqrt()


def joint_covariance(
    body: Body, state: BodyFilterState, mean: Float[Tensor, "B D"]
) -> Float[Tensor, "B J 3 3"]:
    """Return the second moment of the particles' joints about those of an estimate, metres squared."""
    away = body.joints(state.particles) - body.joints(mean)[:, None]
    weights = state.log_weights.exp().to(away)
    return torch.einsum("bn,bnji,bnjk->bjik", weights, away, away)


def warn_of_frames(failed: Bool[Tensor, "B T"], text: str) -> None:
    """Warn of the frames in which a filter degenerated, if there are any.

    Args:
        failed: True in those frames. text: with {times} and {frames}, and what to do about it.
    """
    if not bool(failed.any()):
        return
    rows, frames = torch.nonzero(failed, as_tuple=True)
    listed = [
        f"element {b} at frame {t}" for b, t in zip(rows.tolist(), frames.tolist(), strict=True)
    ]
    warnings.warn(
        text.format(times=len(listed), frames=", ".join(listed[:_LISTED])),
        DegenerateFilterWarning,
        stacklevel=4,
    )


set_up_facade(__name__)
