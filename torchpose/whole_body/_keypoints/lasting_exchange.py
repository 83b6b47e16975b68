"""Tell limbs whose sides seem to be exchanged in a camera since the body has them the wrong way round.

A fast body may follow keypoints of exchanged sides. When their sides are right again, it takes these for
exchanged, and fits them as well as the true body would. The frame alone tells which is right, by the bones
and the pose of a body that begins in it: with the keypoints as they are, or with the sides exchanged.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.rows import joined
from torchpose.whole_body._keypoints.body_kalman import BodyKalmanFilter, CorrectedBody
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame, with_sides_exchanged
from torchpose.whole_body._keypoints.keypoint_start import FEW_HEADINGS, start

# Values of `frames_lost`: in the second frame of exchanged sides, and every third after it.
_FIRST, _EVERY = 1.0, 1.5
_LEAST_GAIN = 5.0  # log-evidence of the sides as they are, in every frame
_MOST_GAIN = 15.0  # log-evidence of one frame, at most; sides are wrong with more
_MOST_CAMERAS = 3  # cameras that see a limb, at most; where more do the others tell
_SEEN = 0.5  # share of the joints of a limb that such a camera sees


def evidence_of_own_sides(
    filter: BodyKalmanFilter,
    frame: KeypointFrame,
    found: CorrectedBody,
    lost: Float[Tensor, " B"],
    before: Float[Tensor, "B C 2"],
) -> Float[Tensor, "B C 2"]:
    """Return the log-evidence that arms and legs taken for exchanged are not, of frames in a row.

    Single frames are misleading, one in twenty.

    Args:
        filter: of cameras that are apart. frame: the keypoints. found: what was found in it.
        lost: of `frames_lost` before this frame; each frame of exchanged sides counts a half.
        before: the same evidence, of the frames up to this one.
    """
    exchanged, after = found.weighed.exchanged > 0.5, torch.zeros_like(before)
    if not bool(exchanged.any()):
        return after
    due = ((lost + 0.5) % _EVERY == _FIRST)[:, None, None] | (before > 0)
    places = (exchanged & due & _few_see(filter, frame)[:, None]).nonzero()
    if not len(places):
        return after
    as_is = frame.take(places[:, 0])
    limb = torch.zeros_like(exchanged[places[:, 0]])
    limb[torch.arange(len(places), device=places.device), places[:, 1], places[:, 2]] = True
    both = joined([as_is, with_sides_exchanged(as_is, limb, filter.exchange)])
    own, other = start(filter, both, FEW_HEADINGS).log_evidence.chunk(2)
    at = tuple(places.T)
    gain = (own - other).clamp_max(_MOST_GAIN)
    return after.index_put(at, torch.where(gain > _LEAST_GAIN, before[at] + gain, 0.0))


def are_wrong(evidence: Float[Tensor, "B C 2"]) -> Bool[Tensor, "B C 2"]:
    """Return which limbs are taken for exchanged and are not; at least two frames have to say so."""
    return evidence > _MOST_GAIN


def _few_see(filter: BodyKalmanFilter, frame: KeypointFrame) -> Bool[Tensor, "B 2"]:
    """Return of whose arms and legs few cameras see most."""
    groups = filter.exchange.groups
    share = frame.there.to(groups) @ groups.mT / groups.sum(-1)
    return (share >= _SEEN).sum(1) <= _MOST_CAMERAS
