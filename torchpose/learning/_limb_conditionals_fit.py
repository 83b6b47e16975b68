"""Fit limb conditionals: rotations between connected limbs and how fast limbs turn, from recorded bodies."""

import math
from collections.abc import Sequence
from typing import Unpack

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose._core.checks import check_finite, check_rate, check_shape, check_tensors, number_of
from torchpose.body._kinematics import Body
from torchpose.body._skeleton import BodySkeleton
from torchpose.errors import InputError
from torchpose.math._rotation_gaussians import fit_gaussian, safe_centre
from torchpose.math._rotations import compose, conjugate
from torchpose.math._unscented import floor_eigenvalues
from torchpose.priors._facts import FitFacts
from torchpose.priors._limb_conditionals import (
    LEAST_STD,
    PART_TREE,
    LimbConditionals,
    LimbInfo,
    check_body_frame,
)

_MOST_CANDIDATES = 2000  # training rotations that a centre is looked for among
_STRIDES = (2, 3, 4)  # frames, over which the growth of diffusion is looked at
_STILL = 1e-6  # sine of half the angle by which a limb turns in a frame: rounding


def fit_limb_conditionals(
    body: Body,
    sequences: Tensor | Sequence[Tensor],
    fps: float,
    *,
    edges: Sequence[tuple[str, str]] = PART_TREE,
    least_std: float = LEAST_STD,
    **facts: Unpack[FitFacts],
) -> LimbConditionals:
    """Fit limb conditionals and diffusion to recorded states.

    The covariance of q_ij is taken about its mean, that of the steps about zero (DX 14).

    Args:
        body: whose states they are, with ``frame="body"``. States of several persons come from
            `in_body_frame`: only centres and frame of the body count, not its size.
        sequences: states [T, D], one tensor per recording without gaps.
        fps: the frame rate of all sequences, frames per second.
        edges: names of the parts above and below.
        least_std: floor of the standard deviations of q_ij, as an eigenvalue of the covariance:
            joints tell no twist of a limb, whose variance would be zero.
        **facts: fields of `LimbInfo`.

    Returns:
        `LimbConditionals` with quaternion vectors as means and their covariances, per frame at `fps`.

    Raises:
        PriorError: a body of another frame, or an edge of the root. InputError: no states, not
            finite, no two frames in a row, no motion, a rate that is not positive, a negative
            `least_std`. SkeletonError: an unknown part or edges that are no tree. ShapeError:
            another number of columns.
    """
    check_body_frame(body)
    check_rate("fps", fps)
    if not 0 <= number_of(least_std) < math.inf:
        raise InputError(f"least_std must be zero or more and finite, got {least_std}")
    parts = [sequences] if isinstance(sequences, Tensor) else list(sequences)
    turns = [part_rotations(body, states) for states in parts]
    diffusion = _steps(turns, 1) if turns else None
    if diffusion is None:
        raise InputError("limb conditionals need two frames in a row, got none; add recordings")
    if not bool((_trace(diffusion[1:]) > _STILL**2).any()):
        raise InputError(
            "limb conditionals need limbs that move, got the same pose in all frames of each recording"
        )
    pairs = _edge_indices(body.skeleton, edges).to(body.centres.device)
    between = edge_rotations(torch.cat(turns), pairs).transpose(0, 1)  # q_ij [E, N, 3]
    every = -(-between.shape[1] // _MOST_CANDIDATES)
    centres = safe_centre(between[:, ::every])
    mean, covariance = fit_gaussian(between, centres)
    info = LimbInfo(
        parts=tuple(body.skeleton.parts),
        fps=float(fps),
        fitted_fps=float(fps),
        n_frames=between.shape[1],
        **facts,
    )
    return LimbConditionals(
        info,
        pairs,
        mean,
        floor_eigenvalues(covariance, least_std**2),
        centres,
        body.centres.clone(),
        diffusion,
        _growth(turns, diffusion),
    )


def _edge_indices(skeleton: BodySkeleton, edges: Sequence[tuple[str, str]]) -> Tensor:
    pairs = [[skeleton.part(name) for name in edge] for edge in edges]
    return torch.tensor(pairs, dtype=torch.long).reshape(-1, 2)


def _steps(turns: Sequence[Tensor], stride: int) -> Tensor | None:
    """Return second moments [P, 3, 3] of the rotations over `stride` frames; None without such frames."""
    steps = frame_rotations(turns, stride)
    return torch.einsum("npi,npj->pij", steps, steps) / len(steps) if len(steps) else None


def _growth(turns: Sequence[Tensor], diffusion: Tensor) -> Tensor:
    """Return exponents g [P] of diffusion over time, by least squares over some strides; 0 to 2."""
    size = _trace(diffusion)
    found = [(math.log(k), steps) for k in _STRIDES if (steps := _steps(turns, k)) is not None]
    if not found:
        return torch.ones_like(size)
    logs = [log * (_trace(steps) / size).log() for log, steps in found]
    slopes = torch.stack(logs).sum(0) / sum(log * log for log, _ in found)
    return torch.where(size > 0, slopes, torch.ones_like(size)).clamp(0, 2)


def _trace(matrices: Tensor) -> Tensor:
    return matrices.diagonal(dim1=-2, dim2=-1).sum(-1)


def part_rotations(body: Body, states: Tensor) -> Float[Tensor, "T P 3"]:
    """Return the rotations q_j of the parts without centres, the root's in the world, others in its axes.

    Raises:
        ShapeError: another number of columns. InputError: states that are not finite.
    """
    check_tensors(states=states)
    check_shape("states", states, [None, body.dim])
    check_finite("states", states, hint="end the sequence where the recording has a gap")
    return compose(body.centres, states[:, 3:].to(body.centres).unflatten(-1, (-1, 3)))


def edge_rotations(
    turns: Float[Tensor, "T P 3"], pairs: Int[Tensor, "E 2"]
) -> Float[Tensor, "T E 3"]:
    """Return the rotations q_ij = q_i^-1 q_j from the part above each edge to the part below."""
    above, below = turns[:, pairs].unbind(2)
    return compose(conjugate(above), below)


def frame_rotations(
    turns: Sequence[Float[Tensor, "_ P 3"]], stride: int = 1
) -> Float[Tensor, "steps P 3"]:
    """Return the rotations of each part over `stride` frames of one sequence, for all sequences."""
    return torch.cat([compose(conjugate(q[:-stride]), q[stride:]) for q in turns])
