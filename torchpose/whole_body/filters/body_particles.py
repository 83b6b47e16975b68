"""Particles over body poses: what a body has to offer, weights, estimates and the noise of a frame."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor, nn

from torchpose.errors import InputError, check_finite, check_shape
from torchpose.whole_body.silhouettes.likelihood import silhouette_log_likelihood
from torchpose.whole_body.silhouettes.rendering import (
    PreparedSilhouettes,
    count_pixels,
    prepare_silhouettes,
)

__all__ = [
    "BodyFilterState",
    "BodyTrack",
    "PoseSpace",
    "Score",
    "WeightedParticles",
    "as_step_std",
    "default_step_std",
    "motion_std",
    "reweight",
    "silhouette_score",
    "stack_tracks",
    "take_particles",
]

# Per frame at 60 Hz, about twice the motion of a walk: metres, then sines of half angles.
_POSITION_STD, _HEADING_STD, _PART_STD = 0.015, 0.015, 0.03

Score = Callable[[Tensor], Tensor]


@runtime_checkable
class PoseSpace(Protocol):
    """What a filter asks of a body; `torchpose.body.Body` has it.

    Attributes:
        dim: D. perturb(state, step): the state moved by a step, both [..., D].
        difference(a, b): the step with perturb(b, step) = a.
        mean(states, log_weights): weighted mean of states [..., N, D] over N, [..., D].
    """

    dim: int

    def perturb(self, state: Tensor, step: Tensor) -> Tensor: ...

    def difference(self, a: Tensor, b: Tensor) -> Tensor: ...

    def mean(self, states: Tensor, log_weights: Tensor) -> Tensor: ...


class BodyTrack(NamedTuple):
    """Estimates of a sequence; [T, ...] from one sequence, [B, T, ...] from a batch, [B, ...] of a step.

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

    def element(self, index: int) -> "BodyTrack":
        """The track of one element of a batch."""
        parts: dict[str, Any] = {name: getattr(self, name)[index] for name in self._fields[:-1]}
        return BodyTrack(**parts, details={n: value[index] for n, value in self.details.items()})


class BodyFilterState(NamedTuple):
    """Weighted particles after a step, before they are resampled.

    Attributes:
        particles: [B, N, D]. log_weights: normalised, [B, N], float64. mean: last estimate [B, D].
        lost: number of frames in a row in which all particles died, [B].
        memory: what a filter remembers of every particle beside its state, [B, N, ...]; resampled
            with them. trend: what it remembers of every element, [B, ...].
    """

    particles: Tensor
    log_weights: Tensor
    mean: Tensor
    lost: Tensor
    memory: Tensor | None = None
    trend: Tensor | None = None


class WeightedParticles(NamedTuple):
    """What `move` returns.

    Attributes:
        particles: [B, N, D]. log_weights: normalised [B, N], float64; NaN in an element whose particles
            all died. log_evidence: of the frame, [B]; it counts where somebody is seen.
        memory, trend: as in the state, of the new frame. details: as in `BodyTrack`, [B, ...].
    """

    particles: Tensor
    log_weights: Tensor
    log_evidence: Tensor
    memory: Tensor | None = None
    trend: Tensor | None = None
    details: dict[str, Tensor] | None = None


def stack_tracks(steps: Sequence[BodyTrack]) -> BodyTrack:
    """Steps [B, ...] as one track [B, T, ...]."""
    parts: dict[str, Any] = {
        name: torch.stack([getattr(step, name) for step in steps], 1)
        for name in BodyTrack._fields[:-1]
    }
    names = steps[0].details
    details = {name: torch.stack([step.details[name] for step in steps], 1) for name in names}
    return BodyTrack(**parts, details=details)


def silhouette_score(
    body: Any,
    silhouettes: Tensor | PreparedSilhouettes,
    cameras: Any,
    likelihood: str,
    limb_shape: str = "cylinders",
) -> Score:
    """states [B, N, D] -> log-likelihood [B, N] of the silhouettes [B, C, H, W] of one frame."""
    if not isinstance(silhouettes, PreparedSilhouettes):
        silhouettes = prepare_silhouettes(silhouettes)

    def score(states: Tensor) -> Tensor:
        counts = count_pixels(body, states, cameras, silhouettes, limb_shape=limb_shape)
        return silhouette_log_likelihood(counts, likelihood)

    return score


def reweight(
    particles: Float[Tensor, "B N D"],
    log_prior: Float[Tensor, "B N"],
    log_likelihood: Float[Tensor, "B N"],
) -> WeightedParticles:
    """Weights of the posterior from those of the prediction, and the log-evidence.

    xi_n = pi_n omega_n / sum_j pi_j omega_j,   log p(I_t | I_1:t-1) = log sum_n omega_n pi_n / sum_n omega_n

    Args:
        log_prior: omega, of the prediction, normalised or not. log_likelihood: pi.

    Reference: (MR 5), (MR 9)-(MR 11).
    """
    log_prior = log_prior - torch.logsumexp(log_prior, -1, keepdim=True)
    joint = log_prior + log_likelihood
    evidence = torch.logsumexp(joint, -1)
    log_weights = joint - evidence[:, None]
    return WeightedParticles(particles, log_weights, evidence.nan_to_num(-torch.inf))


def take_particles(
    particles: Shaped[Tensor, "B N *rest"], ancestors: Int[Tensor, "B n"]
) -> Shaped[Tensor, "B n *rest"]:
    """particles[b, ancestors[b, i]]."""
    batch, n, *rest = particles.shape
    first = torch.arange(batch, device=ancestors.device)[:, None] * n
    taken = particles.flatten(0, 1).index_select(0, (ancestors + first).reshape(-1))
    return taken.view(batch, ancestors.shape[1], *rest)


def default_step_std(body: PoseSpace) -> Float[Tensor, " D"]:
    """Diffusion per frame at 60 Hz: 15 mm for the root, 1.7 degrees for its orientation, 3.4 for parts."""
    std = torch.full((body.dim,), _PART_STD, dtype=torch.float64)
    std[:3], std[3:6] = _POSITION_STD, _HEADING_STD
    return std


def motion_std(
    body: PoseSpace, states: Float[Tensor, "T D"] | Sequence[Tensor], floor: float = 0.0
) -> Float[Tensor, " D"]:
    """Root mean square change of recorded states from one frame to the next, for `step_std`.

    Args:
        states: one sequence [T, D], or several. Frames with NaN are passed over.
        floor: no element is smaller. The twist of a limb, which no joint shows, does not vary in
            recorded states: with 0 it stays as it is.

    Raises:
        InputError: no two frames that follow each other.
    """
    sequences = [states] if isinstance(states, Tensor) else list(states)
    steps = torch.cat([body.difference(s[1:], s[:-1]) for s in sequences])
    steps = steps[torch.isfinite(steps).all(-1)]
    if len(steps) == 0:
        raise InputError("states must hold two frames that follow each other, got none")
    return steps.square().mean(0).sqrt().clamp_min(floor)


def as_step_std(body: PoseSpace, value: Tensor | float | None) -> Float[Tensor, " D"]:
    """`step_std` of a filter, checked, in the dtype and on the device of the body.

    Raises:
        ShapeError: not [D]. InputError: not finite, or negative.
    """
    std = default_step_std(body) if value is None else torch.as_tensor(value).detach()
    std = std if std.is_floating_point() else std.double()
    if std.ndim == 0:
        std = std.double().expand(body.dim)
    check_shape("step_std", std, [body.dim])
    check_finite("step_std", std)
    if bool((std < 0).any()):
        raise InputError(f"step_std must not be negative, got {float(std.min()):g}")
    if isinstance(body, nn.Module):
        std = std.to(next((b for b in body.buffers() if b.is_floating_point()), std))
    return std.clone()
