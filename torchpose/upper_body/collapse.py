"""What to say of particles that have collapsed onto one of them."""

from dataclasses import replace

import torch

from torchpose.upper_body.methods import METHODS
from torchpose.upper_body.pose_track import PoseTrack

__all__ = ["note_collapse"]

_FEW = 2.0  # particles: below that, one of them has most of the weight
_SHARE = 0.25  # of the frames of an arm; quick movements alone lose the others in fewer


def note_collapse(track: PoseTrack) -> PoseTrack:
    """Return the track with a note if its particles have collapsed, else the track itself.

    An arm has collapsed where its effective sample size (BL 25) is below 2 in more than a quarter of the
    frames of a sequence. Banks of Kalman filters have no such note: one track that has all the weight
    still is a Gaussian.

    Args:
        track: of any method; frames that failed or do not know their sample size are not counted.
    """
    method = METHODS.get(track.method)
    if method is None or not method.particles:
        return track
    size = track.effective_sample_size
    frames = torch.arange(size.shape[1], device=size.device)
    counted = size.isfinite() & (frames < track.lengths.to(size.device)[:, None])[..., None]
    few = (counted & (size < _FEW)).sum(1)
    collapsed = few > _SHARE * counted.sum(1)
    if not bool(collapsed.any()):
        return track
    arms = " and ".join(
        f"{name} arm" for name, lost in zip(("left", "right"), collapsed.any(0).tolist(), strict=True)
        if lost
    )  # fmt: skip
    where = ""
    if len(track) > 1:
        where = f" of {int(collapsed.any(1).sum())} of {len(track)} sequences"
    share = 100 * float(few[collapsed].sum() / counted.sum(1)[collapsed].sum())
    note = (
        f"particles collapsed ({arms}{where}): fewer than two of them carry the weight in {share:.0f} % "
        "of the frames, so that estimate and covariance are those of a single one; process noise much "
        "wider than the motion, too few particles or a camera unlike the prior's do that"
    )
    return replace(track, notes=(*track.notes, note))
