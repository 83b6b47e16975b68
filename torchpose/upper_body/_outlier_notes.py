"""Note the number of outliers among the keypoints, and of frames with exchanged hands."""

import re
from collections.abc import Iterable

from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.wording import counted
from torchpose.filters._lengths import inside_lengths
from torchpose.skeleton._joint_sets import UPPER_BODY

_TAKEN, _EXCHANGED = "as if missing", "left and right exchanged back in"


def outlier_notes(
    probability: Float[Tensor, "B T 8"],
    exchanged: Bool[Tensor, "B T"] | int,
    lengths: Int[Tensor, " B"] | None = None,
) -> tuple[str, ...]:
    """Return a note about outliers and exchanged hands; nothing where there were none.

    Args:
        probability: the probability that a keypoint is no outlier. exchanged: whether left and right were
            exchanged, or the number of frames in which they were. lengths: the number of frames of each
            sequence; None is all.
    """
    outliers = probability < 0.5
    if lengths is not None:
        inside = inside_lengths(lengths.to(outliers.device), outliers.shape[1])
        outliers = outliers & inside[..., None]
        exchanged = exchanged & inside if isinstance(exchanged, Tensor) else exchanged
    counts, said = outliers.flatten(0, 1).sum(0).tolist(), []
    frames = int(exchanged.sum()) if isinstance(exchanged, Tensor) else exchanged
    if any(counts):
        joints = [f"{name} {n}" for name, n in zip(UPPER_BODY, counts, strict=True) if n]
        taken = counted(sum(counts), "keypoint taken as an outlier", "keypoints taken as outliers")
        said.append(f"{taken}, {_TAKEN}: {', '.join(joints)}")
    if frames:
        said.append(f"{_EXCHANGED} {counted(frames, 'frame')}")
    return ("; ".join(said),) if said else ()


def without_outliers(notes: Iterable[str]) -> tuple[str, ...]:
    """Return the notes that are about something else."""
    return tuple(note for note in notes if _TAKEN not in note and _EXCHANGED not in note)


def exchanged_frames(notes: Iterable[str]) -> int:
    """Return the number of frames with exchanged hands in the notes of `outlier_notes`."""
    found = (re.search(rf"{_EXCHANGED} (\d+) frame", note) for note in notes)
    return sum(int(match[1]) for match in found if match)
