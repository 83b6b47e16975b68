"""Smooth filtered body states backwards over time, after Rauch, Tung and Striebel."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.body._articulation import BodyPoint
from torchpose.math._gaussian import safe_cholesky
from torchpose.whole_body._keypoints.body_kalman import BodyGaussian, BodyKalmanFilter


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
    model, body = filter.transition, filter.articulation
    mean = BodyPoint(*(torch.stack(v) for v in zip(*(s.mean for s in states), strict=True)))
    cov = torch.stack([s.cov for s in states])
    ahead = body.moved(mean, model.step(body, mean)).map(lambda value: value[:-1])
    carried = model.matrix @ cov[:-1]
    predicted = carried @ model.matrix.mT + model.noise + torch.diag_embed(widened[1:])
    gains = torch.cholesky_solve(carried, safe_cholesky(predicted)).mT
    gains = gains * ~started[1:, :, None, None]
    points, covs = [mean.map(lambda value: value[-1])], [cov[-1]]
    for t in range(len(states) - 2, -1, -1):
        off = body.difference(points[-1], ahead.map(lambda value: value[t]))  # noqa: B023
        step = (gains[t] @ off[..., None]).squeeze(-1)
        points.append(body.moved(mean.map(lambda value: value[t]), step))  # noqa: B023
        change = gains[t] @ (covs[-1] - predicted[t]) @ gains[t].mT
        covs.append(cov[t] + (change + change.mT) / 2)
    points.reverse()
    covs.reverse()
    stacked = BodyPoint(*(torch.stack(v) for v in zip(*points, strict=True)))
    return SmoothedBodies(stacked, torch.stack(covs))
