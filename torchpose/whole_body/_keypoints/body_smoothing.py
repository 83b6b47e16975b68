"""Smooth filtered body states backwards over time, after Rauch, Tung and Striebel."""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.body._articulation import BodyPoint
from torchpose.math._gaussian import safe_cholesky, symmetrise
from torchpose.whole_body._keypoints.body_kalman import BodyKalmanFilter
from torchpose.whole_body._keypoints.nested import PART, frame_at, mapped, part_of, stacked


class BodyMoments(NamedTuple):
    """Holds points [B, T] and their covariances [B, T, N, N]."""

    mean: BodyPoint
    cov: Tensor


def from_last_seen(
    jumped: Float[Tensor, "B T N"],
    seen: Bool[Tensor, "B T J"],
    started: Bool[Tensor, "B T"],
    carriers: Float[Tensor, "J N"],
) -> Float[Tensor, "B T N"]:
    """Return variances of jumps in the frame after that in which their joint was last seen.

    A joint that returns elsewhere than predicted did not jump there when it returned: its motion differed
    since it was hidden. With the jump at the end of the gap nothing of later frames would reach into it.

    Args:
        jumped: variances in the frames in which joints had jumped. seen: joints. started: frames in which
            tracking began anew. carriers: of `Articulation`, which columns move a joint.
    """
    hidden = torch.zeros_like(seen)
    hidden[:, 1:] = ~seen[:, :-1] & ~started[:, 1:, None]
    columns = hidden.to(jumped) @ carriers.to(jumped) > 0
    frames = torch.arange(seen.shape[1], device=seen.device)[:, None]
    first = frames.where(~columns, 0).cummax(1).values
    return (jumped * ~columns).scatter_add(1, first, jumped * columns)


def beginnings(
    started: Bool[Tensor, "B T"], coasting: Bool[Tensor, "B T"], longest: float
) -> Bool[Tensor, "B T"]:
    """Return frames in which tracking begins, so that they say nothing of the frames before.

    Where it begins anew right after nothing was measured for a while, which happens in one camera, it is the
    same person. Frames in a row in which it begins count as one.

    Args:
        started: frames in which tracking began. coasting: frames in which nothing was measured.
        longest: frames without a measurement, at most, after which it is the same person.
    """
    frames = torch.arange(started.shape[1], device=started.device).expand_as(started)
    measured = frames.where(~coasting, -1).cummax(1).values
    unseen = torch.zeros_like(frames)
    unseen[:, 1:] = (frames - measured)[:, :-1]
    first = frames.where(~started, -1).cummax(1).values + 1
    before = unseen.gather(1, first.clamp_max(started.shape[1] - 1))
    again = started & ~coasting & (before > 0) & (before <= longest)
    return started & ~(again & (started.cumsum(1) > 1))


def smooth(
    filter: BodyKalmanFilter,
    filtered: BodyMoments,
    widened: Float[Tensor, "B T N"],
    factor: Float[Tensor, "B T"],
    started: Bool[Tensor, "B T"],
    coasting: Bool[Tensor, "B T"],
) -> Iterator[tuple[slice, BodyMoments]]:
    """Yield which frames were smoothed, and their states, for parts of sequences from the last frame on.

    x_t|T = x_t + C (x_t+1|T - x_t+1|t),   P_t|T = P_t + C (P_t+1|T - P_t+1|t) C^T,   C = P_t F^T P_t+1|t^-1,

    with differences in tangent spaces. The pose prior is a measurement of its frame, which the filtered
    state has; the prediction is without it. The filtered states of frames that were yielded may be written
    over, so that the states of a long recording are held once.

    Args:
        filter: that filtered. filtered: posteriors of T frames. widened: variances added to the predictions.
        factor: of the variances of accelerations in the predictions.
        started: frames in which tracking began anew, which say nothing of the frames before.
        coasting: frames in which nothing was measured.
    """
    last = filtered.cov.shape[1] - 1
    after: BodyMoments = mapped(lambda value: value[:, last].clone(), filtered)
    yield slice(last, last + 1), mapped(lambda value: value[:, None], after)
    for end in range(last, 0, -PART):
        rows = slice(max(0, end - PART), end)
        later = slice(rows.start + 1, end + 1)
        part = _smoothed(
            filter, part_of(filtered, rows), after, widened[:, later], factor[:, later], started[:, later],
            coasting[:, rows],
        )  # fmt: skip
        yield rows, part
        after = mapped(lambda value: value[:, 0].clone(), part)


def _smoothed(
    filter: BodyKalmanFilter,
    filtered: BodyMoments,
    after: BodyMoments,
    widened: Float[Tensor, "B T N"],
    factor: Float[Tensor, "B T"],
    started: Bool[Tensor, "B T"],
    coasting: Bool[Tensor, "B T"],
) -> BodyMoments:
    """Return the smoothed states of some frames.

    Args:
        filter: that filtered. filtered: posteriors. after: [B], smoothed, of the frame after the last one.
        widened, factor, started: of the frames after each of these. coasting: of these.
    """
    body, found = filter.articulation, [after]
    ahead, predicted, gains = _gains(filter, filtered, widened, factor, started, coasting)
    for t in range(predicted.shape[1] - 1, -1, -1):
        (mean, cov), expected = frame_at((filtered, ahead), t)
        off = body.difference(found[-1].mean, expected)
        step = (gains[:, t] @ off[..., None]).squeeze(-1)
        change = gains[:, t] @ (found[-1].cov - predicted[:, t]) @ gains[:, t].mT
        found.append(BodyMoments(body.moved(mean, step), cov + symmetrise(change)))
    smoothed: BodyMoments = stacked(found[:0:-1])
    return smoothed


def _gains(
    filter: BodyKalmanFilter,
    filtered: BodyMoments,
    widened: Float[Tensor, "B T N"],
    factor: Float[Tensor, "B T"],
    started: Bool[Tensor, "B T"],
    coasting: Bool[Tensor, "B T"],
) -> tuple[BodyPoint, Tensor, Tensor]:
    """Return means and covariances predicted for the frames after some, and C.

    Args:
        filter: that filtered. filtered: posteriors. widened, factor, started: of the frames after
            these. coasting: of these.
    """
    model = filter.transition_of(coasting)
    ahead, matrix = model.ahead(filter.motion, filtered.mean)
    carried = matrix @ filtered.cov
    predicted = carried @ matrix.mT + filter.noise_of(model, factor) + torch.diag_embed(widened)
    gains = torch.cholesky_solve(carried, safe_cholesky(predicted)).mT
    return ahead, predicted, gains * ~started[..., None, None]
