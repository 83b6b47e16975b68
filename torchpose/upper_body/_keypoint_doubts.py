"""Say what is doubtful about the keypoints of a file, and refuse those of images of another size."""

from collections.abc import Iterator

import torch

from torchpose.errors import CameraError
from torchpose.io._keypoints import Keypoints, said_of_crowd
from torchpose.skeleton._joint_sets import canonical_names

_UPPER = ("head", "nose", "neck")
_LOWER = ("shoulder_left", "shoulder_right", "elbow_left", "elbow_right", "hip_left", "hip_right")
_TURNED = 0.8  # share of the frames in which what is above should not be below


def refuse_another_size(keypoints: Keypoints, size: tuple[int, int] | None) -> None:
    """Refuse keypoints most of which lie outside the image, each counted by its confidence.

    Detectors also say where what they do not see would be, beyond the border of the image.

    Args:
        keypoints: of a file. size: (width, height) of the images, None if unknown.

    Raises:
        CameraError: they are of images of another size.
    """
    if size is None:
        return
    there = keypoints.measured
    points, sure = keypoints.keypoints[there], keypoints.confidence
    weights = torch.ones_like(points[:, 0]) if sure is None else sure[there].to(points)
    outside = ((points < 0) | (points > points.new_tensor(size))).any(-1)
    if 2 * float(weights[outside].sum()) > float(weights.sum()):
        raise CameraError(
            f"{keypoints.path}: {int(outside.sum())} of {len(points)} keypoints lie outside the image of "
            f"{size[0]} x {size[1]} pixels, most of those that are sure; if they are of a video of another "
            "size, give its camera and image_size"
        )


def doubts_about(keypoints: Keypoints) -> Iterator[str]:
    """Yield a note on each doubt about the keypoints of a file."""
    if crowd := said_of_crowd(keypoints.n_people):
        yield crowd
    if keypoints.first_frame:
        yield f"frame 0 is number {keypoints.first_frame} of the file"
    if _upside_down(keypoints):
        yield (
            "head and neck lie below shoulders and elbows in most frames: rows of pixels count downwards, so "
            "keypoints that count upwards have to be turned over"
        )


def _upside_down(keypoints: Keypoints) -> bool:
    """Return whether what is above in people is below in most frames."""
    names = canonical_names(keypoints.names)
    above, below = ([names.index(n) for n in group if n in names] for group in (_UPPER, _LOWER))
    if not above or not below:
        return False
    rows = keypoints.keypoints[..., 1]
    gaps = rows[:, above].nanmean(1) - rows[:, below].nanmean(1)
    known = gaps.isfinite()
    return bool(known.any()) and float((gaps[known] > 0).double().mean()) > _TURNED
