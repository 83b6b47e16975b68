"""Step tracks that may change their component in every frame, mean and covariance as one matrix.

A track is A = [P, x; x^T, c], filled up by zeros to a width that products are fast at. Under component k
a step is two products of that width, the rows of the measured dimensions, and one product of rank Z,

A <- [F, 0; 0, 1] A [F, 0; 0, 1]^T + [N, b; b^T, 0],   W = L^-1 [H P, H x - z],   A <- A - W^T W,

with L L^T = H P H^T + R; the last column of W is minus the whitened innovation. c is not used.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchpose._core.module_state import derived
from torchpose.filters._frame_noise import own_noise
from torchpose.filters._measurements import Measurements
from torchpose.filters._mkf import MixtureKalmanFilter
from torchpose.filters._outputs import (
    FilterOutput,
    Mending,
    StepOutput,
    finish_output,
    mending,
    stacked_mending,
)
from torchpose.filters._weights import estimate_of
from torchpose.math._gaussian import LOG_2PI, mended_cholesky, spare_columns, symmetrise

__all__ = [
    "TRACK_NUMBERS",
    "JointModel",
    "JointProblem",
    "correct_joint",
    "joined",
    "joint_chunks",
    "joint_estimate",
    "joint_model",
    "joint_problem",
    "joint_state",
    "predict_joint",
    "stacked",
]

TRACK_NUMBERS = 300_000
"""Numbers in the tracks that are stepped at a time: 2.4 MB, which stay in the cache."""


class JointModel(NamedTuple):
    """Holds the prediction by every component: `matrix` [F, 0; 0, 1] and `noise` [N, b; b^T, 0], [K, E, E]."""

    matrix: Tensor
    noise: Tensor


class JointProblem(NamedTuple):
    """Holds what is measured in one frame by B elements.

    Attributes:
        z: [B, 1, Z], 0 where missing. noise, both: of `own_noise` [B, 1, Z, Z]; `both` is None where
            nothing is missing. mask: [B, 1, Z, 1]. log_norm: constant of the likelihood [B, 1].
    """

    z: Tensor
    noise: Tensor
    both: Tensor | None
    mask: Tensor
    log_norm: Tensor


def joint_chunks(model: MixtureKalmanFilter, batch: int, numbers: int) -> list[slice]:
    """Return equal shares of a batch whose tracks are about so many numbers each."""
    width = model.dim + spare_columns(model.dim)
    count = max(1, min(batch, round(batch * model.n_tracks * width**2 / numbers)))
    edges = [round(batch * i / count) for i in range(count + 1)]
    return [slice(*pair) for pair in zip(edges, edges[1:], strict=False)]


def joint_model(model: MixtureKalmanFilter, time: int) -> JointModel:
    """Return the prediction into a frame, kept after the burn-in."""

    def make() -> JointModel:
        matrix, offset, noise = model.transition(time)
        spare = spare_columns(model.dim) - 1
        joint = pad(torch.cat([noise, offset[..., None]], -1), (0, spare, 0, spare + 1))
        joint[:, model.dim, : model.dim] = offset
        square = pad(matrix, (0, spare + 1, 0, spare + 1))
        square[:, model.dim, model.dim] = 1
        return JointModel(square, joint)

    return make() if time < model.burn_in else derived(model, "joint", model.sources, make)


def joint_state(
    mean: Float[Tensor, "*batch D"], cov: Float[Tensor, "*batch D D"]
) -> Float[Tensor, "*batch E E"]:
    """Return tracks as joint matrices."""
    spare = spare_columns(mean.shape[-1])
    joint = pad(torch.cat([cov, mean[..., None]], -1), (0, spare - 1, 0, spare))
    joint[..., mean.shape[-1], : mean.shape[-1]] = mean
    return joint


def joint_problem(frame: Measurements) -> JointProblem:
    """Return what is measured in a frame, for `correct_joint`."""
    noise, both = own_noise(frame.cov.to(torch.float64), frame.mask)
    return JointProblem(
        frame.z[:, None].to(noise),
        noise[:, None],
        None if bool(frame.mask.all()) else both[:, None],
        frame.mask[:, None, :, None].to(noise),
        -0.5 * LOG_2PI * frame.mask.sum(-1, keepdim=True).to(noise),
    )


def predict_joint(
    model: JointModel, state: Float[Tensor, "B M E E"], component: Int[Tensor, "B M"]
) -> Float[Tensor, "B M E E"]:
    """Return tracks after the prediction by a component each (BL 34, 37)."""
    chosen = component.flatten()
    matrix = model.matrix.index_select(0, chosen)
    moved = torch.bmm(matrix, state.flatten(0, 1))
    return model.noise.index_select(0, chosen).baddbmm_(moved, matrix.mT).view_as(state)


def correct_joint(
    state: Float[Tensor, "B M E E"], problem: JointProblem, observed: Int[Tensor, " Z"], dim: int
) -> tuple[Float[Tensor, "B M"], Float[Tensor, "B M"] | None]:
    """Update tracks in place by a measurement (BL 38-41).

    Args:
        state: the predicted tracks. observed: measured state dimensions. dim: D.

    Returns:
        The log-likelihood of every track, and the jitter of its covariance, as `mended_cholesky`.
    """
    joint = state.index_select(-2, observed)
    innovation = joint.index_select(-1, observed)
    if problem.both is None:
        innovation += problem.noise
    else:
        innovation = torch.addcmul(problem.noise, problem.both, innovation)
        joint *= problem.mask
    joint[..., dim] -= problem.z
    factor, jitter = mended_cholesky(innovation)
    white = torch.linalg.solve_triangular(factor, joint, upper=False)
    flat = white.flatten(0, 1)
    state.flatten(0, 1).baddbmm_(flat.mT, flat, alpha=-1)
    log_det = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    squared = white[..., dim].square().sum(-1)
    return torch.add(problem.log_norm - log_det, squared, alpha=-0.5), jitter


def joint_estimate(
    state: Float[Tensor, "B M E E"],
    log_weights: Float[Tensor, "B M"],
    log_evidence: Float[Tensor, " B"],
    jitter: Tensor | None,
    dim: int,
    return_cov: bool,
) -> StepOutput:
    """Return the estimate of a frame (BL 48); without covariances its mean is that of the tracks [B, M, D].

    Args:
        log_evidence: also where nothing is measured. jitter: of `correct_joint`. dim: D.
    """
    mean = state[..., :dim, dim].to(log_weights)
    work = (None, None) if jitter is None else mending(log_weights, jitter)
    if not return_cov:
        return StepOutput(mean, log_weights, log_evidence, None, *work)
    estimate, total = estimate_of(log_weights, mean, state[..., :dim, :dim])
    total = None if total is None else symmetrise(total)
    return StepOutput(estimate, log_weights, log_evidence, total, *work)


def stacked(steps: Sequence[StepOutput], frames: Measurements) -> FilterOutput:
    """Stack the frames of some sequences, and average the means of tracks, all at once."""
    log_weights = torch.stack([step.log_weights for step in steps], 1)
    mean = torch.stack([step.mean for step in steps], 1)
    if mean.ndim == 4:
        mean = (log_weights.exp()[..., None, :] @ mean)[..., 0, :]
    evidence = torch.stack([step.log_evidence for step in steps], 1)
    evidence = torch.where(frames.mask.any(-1), evidence, torch.zeros_like(evidence))
    covs = [step.cov for step in steps if step.cov is not None]
    none = mending(evidence)
    work = stacked_mending([
        none if s.mended is None or s.jitter is None else Mending(s.mended, s.jitter) for s in steps
    ])  # fmt: skip
    return FilterOutput(
        mean, log_weights, evidence, torch.stack(covs, 1) if covs else None, none.mended, *work
    )


def joined(parts: Sequence[FilterOutput], lengths: Tensor) -> FilterOutput:
    """Join what `stacked` returned for the shares of a batch, and finish it."""
    mean, log_weights, evidence = (torch.cat([part[i] for part in parts]) for i in range(3))
    covs = [part.cov for part in parts if part.cov is not None]
    mended = torch.cat([part.mended for part in parts if part.mended is not None])
    jitter = torch.cat([part.jitter for part in parts if part.jitter is not None])
    cov = torch.cat(covs) if covs else None
    return finish_output(mean, log_weights, evidence, cov, lengths, Mending(mended, jitter))
