"""Smooth filtered body states backwards over time, after Rauch, Tung and Striebel."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.body._articulation import BodyPoint
from torchpose.math._gaussian import safe_cholesky
from torchpose.whole_body._keypoints.body_kalman import BodyGaussian, BodyKalmanFilter

CHUNK = 256
"""Frames of which gains or Jacobians are computed at once; those of all would take most of the memory."""


class SmoothedBodies(NamedTuple):
    """Holds smoothed points [T, B] and their covariances [T, B, N, N]."""

    mean: BodyPoint
    cov: Tensor


def smooth(
    filter: BodyKalmanFilter,
    states: Sequence[BodyGaussian],
    widened: Float[Tensor, "T B N"],
    started: Bool[Tensor, "T B"],
) -> SmoothedBodies:
    """Return the smoothed states of whole sequences.

    x_t|T = x_t + C (x_t+1|T - x_t+1|t),   P_t|T = P_t + C (P_t+1|T - P_t+1|t) C^T,   C = P_t F^T P_t+1|t^-1,

    with differences in tangent spaces. The pose prior is a measurement of its frame, which the filtered
    state has; the prediction is without it.

    Args:
        filter: that filtered. states: posteriors of T frames. widened: variances added to the predictions.
        started: frames in which tracking began anew, which say nothing of the frames before.
    """
    points, covs = [states[-1].mean], [states[-1].cov]
    for end in range(len(states) - 1, 0, -CHUNK):
        rows = slice(max(0, end - CHUNK), end)
        after = slice(rows.start + 1, end + 1)
        mean, cov, ahead, predicted, gains = _gains(
            filter, states[rows], widened[after], started[after]
        )
        for t in range(len(cov) - 1, -1, -1):
            off = filter.articulation.difference(points[-1], ahead.map(lambda value: value[t]))  # noqa: B023
            step = (gains[t] @ off[..., None]).squeeze(-1)
            points.append(filter.articulation.moved(mean.map(lambda value: value[t]), step))  # noqa: B023
            change = gains[t] @ (covs[-1] - predicted[t]) @ gains[t].mT
            covs.append(cov[t] + (change + change.mT) / 2)
    points.reverse()
    covs.reverse()
    stacked = BodyPoint(*(torch.stack(v) for v in zip(*points, strict=True)))
    return SmoothedBodies(stacked, torch.stack(covs))


def _gains(
    filter: BodyKalmanFilter,
    states: Sequence[BodyGaussian],
    widened: Float[Tensor, "T B N"],
    started: Bool[Tensor, "T B"],
) -> tuple[BodyPoint, Tensor, BodyPoint, Tensor, Tensor]:
    """Return means and covariances of some frames, those predicted for the frames after them, and C.

    Args:
        filter: that filtered. states: posteriors. widened, started: of the frames after these.
    """
    model, body = filter.transition, filter.articulation
    mean = BodyPoint(*(torch.stack(v) for v in zip(*(s.mean for s in states), strict=True)))
    cov = torch.stack([s.cov for s in states])
    ahead = body.moved(mean, model.step(body, mean))
    carried = model.matrix @ cov
    predicted = carried @ model.matrix.mT + model.noise + torch.diag_embed(widened)
    gains = torch.cholesky_solve(carried, safe_cholesky(predicted)).mT
    return mean, cov, ahead, predicted, gains * ~started[..., None, None]
