"""Say what is doubtful about the keypoints of a file, and refuse those of images of another size."""

import math
from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.errors import CameraError
from torchpose.io._keypoints import Keypoints, said_of_crowd
from torchpose.skeleton._joint_sets import canonical_names

_UPPER = ("head", "nose", "neck")
_LOWER = ("shoulder_left", "shoulder_right", "elbow_left", "elbow_right", "hip_left", "hip_right")
_HEAD, _NECK = ("head",), ("neck",)
_LEAST_CONFIDENCE = 0.3  # confidence below which a keypoint is left out
_MOST = 0.8  # share of the frames in which a doubt has to hold
_ALONG = 0.7  # cosine of the largest angle between the way from trunk to head and a direction
_LOW_NECK = 0.1  # of the way from the middle of the shoulders to the head; Kinect's neck is at 0.37

_SHORTER = 0.55  # over the other forearm's length; the least of 348 clips of twenty persons is 0.69
_LONGEST = 0.95  # quantile of the lengths in all frames that counts as the longest
_LEAST_FRAMES = 30  # frames with a length, below which none counts


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
            f"{size[0]} x {size[1]} pixels, most of those with high confidence; if they are of a video of "
            "another size, give its camera and image_size"
        )


def doubts_about(keypoints: Keypoints, neck_is_told: bool, up: Tensor | None) -> Iterator[str]:
    """Yield a note on each doubt about the keypoints of a file.

    Args:
        keypoints: of a file. neck_is_told: whether their neck is known to be the prior's, or not to be.
        up: the direction that points up, camera axes, [3]; None if the camera is about level.
    """
    if crowd := said_of_crowd(keypoints.n_people, keypoints.keypoints):
        yield crowd
    if keypoints.first_frame:
        yield f"frame 0 is number {keypoints.first_frame} of the file"
    joints = _Joints(keypoints)
    yield from _turned(joints, up)
    if _mostly(_facing(joints, up), 0.0):
        yield (
            "the left shoulder is to the left of the right one in most frames, as from behind, and the nose "
            "is seen: left and right are the person's own; exchange them if the person faces the camera"
        )
    if not neck_is_told and _between_shoulders(joints):
        yield (
            "the neck lies between the shoulders in most frames, and is taken for the prior's, which is 9 to "
            "13 cm above: --neck mid-shoulder says that it is their middle"
        )
    yield from _shorter_forearm(joints)


class _Joints:
    """Pixels of the joints of a file, by their canonical names."""

    def __init__(self, keypoints: Keypoints) -> None:
        self._places = {name: i for i, name in enumerate(canonical_names(keypoints.names))}
        doubtful = torch.zeros(1, dtype=torch.bool)
        if keypoints.confidence is not None:
            doubtful = keypoints.confidence[..., None] < _LEAST_CONFIDENCE
        self._pixels = keypoints.keypoints.masked_fill(doubtful, torch.nan)

    def __call__(self, name: str) -> Float[Tensor, "T 2"]:
        """Return the pixels of a joint, NaN where it is missing or not sure."""
        place = self._places.get(name)
        if place is None:
            return torch.full_like(self._pixels[:, 0], torch.nan)
        return self._pixels[:, place]

    def mean(self, names: Sequence[str]) -> Float[Tensor, "T 2"]:
        """Return the mean of the joints that are there in each frame."""
        return torch.stack([self(name) for name in names]).nanmean(0)


def _turned(joints: _Joints, up: Tensor | None) -> Iterator[str]:
    """Yield a note on each way in which the image seems to be turned: upside down, on its side."""
    upper, lower = _ends(joints)
    rise, aside = _directions(joints.mean(upper) - joints.mean(lower), up)
    alone = lower == _NECK
    subject = "the head lies" if alone else "head and neck lie"
    if _mostly(rise, -_ALONG):
        yield (
            f"{subject} below {'the neck' if alone else 'shoulders and elbows'} in most frames: rows of "
            "pixels count downwards, so keypoints that count upwards have to be turned over"
        )
    if _mostly(-aside.abs(), -_ALONG):
        yield (
            f"{subject} beside {'the neck' if alone else 'shoulders and hips'} in most frames: unless the "
            "person lies, v was given before u, or the video lies on its side (--roll 90 or -90)"
        )


def _ends(joints: _Joints) -> tuple[Sequence[str], Sequence[str]]:
    """Return the joints of the head and of the trunk, or head and neck where nothing of a trunk is seen."""
    if bool(joints.mean(_LOWER).isfinite().any()):
        return _UPPER, _LOWER
    return _HEAD, _NECK


def _directions(
    way: Float[Tensor, "T 2"], up: Tensor | None
) -> tuple[Float[Tensor, " T"], Float[Tensor, " T"]]:
    """Return how much of the way from trunk to head is up, and how much aside, -1 to 1."""
    rise, aside = (way @ axis for axis in _axes(up, way))
    length = torch.linalg.vector_norm(way, dim=-1)
    return rise / length, aside / length


def _axes(up: Tensor | None, like: Tensor) -> tuple[Float[Tensor, " 2"], Float[Tensor, " 2"]]:
    """Return up and the right of the image, upright."""
    rise = like.new_tensor([0.0, -1.0]) if up is None else up[:2].to(like)
    rise = rise / torch.linalg.vector_norm(rise)
    return rise, torch.stack([-rise[1], rise[0]])


def _facing(joints: _Joints, up: Tensor | None) -> Float[Tensor, " T"]:
    """Return by how much the left shoulder is on the right of the other, NaN where no face is seen."""
    across = joints("shoulder_left") - joints("shoulder_right")
    aside = across @ _axes(up, across)[1]
    return torch.where(joints("nose").isfinite().all(-1), aside, torch.nan)


def _between_shoulders(joints: _Joints) -> bool:
    """Return whether the neck is the middle of the shoulders, and the head is above."""
    middle = joints.mean(["shoulder_left", "shoulder_right"])
    both = (joints("shoulder_left") + joints("shoulder_right")).isfinite().all(-1)
    to_head, to_neck = joints("head") - middle, joints("neck") - middle
    share = (to_neck * to_head).sum(-1) / to_head.square().sum(-1)
    return _mostly(torch.where(both, share, torch.nan), _LOW_NECK)


def _shorter_forearm(joints: _Joints) -> Iterator[str]:
    """Yield a note if one forearm always looks much shorter than the other."""
    lengths = {side: _longest_forearm(joints, side) for side in ("left", "right")}
    shorter, longer = sorted(lengths, key=lambda side: lengths[side])
    if lengths[shorter] < _SHORTER * lengths[longer]:
        share = lengths[shorter] / lengths[longer]
        yield (
            f"the {shorter} forearm looks at most {100 * share:.0f} % as long as the {longer} one, and both "
            "arms are taken to have bones of one length: unless it points along the line of sight all the "
            f"time, its elbow comes out too bent; leave out the {shorter} wrist and hand"
        )


def _longest_forearm(joints: _Joints, side: str) -> float:
    """Return how long a forearm looks where it is longest, pixels; NaN if it is seldom seen."""
    end = joints(f"wrist_{side}")
    if not bool(end.isfinite().any()):
        end = joints(f"hand_{side}")
    lengths = torch.linalg.vector_norm(end - joints(f"elbow_{side}"), dim=-1)
    known = lengths[lengths.isfinite()]
    return float(known.quantile(_LONGEST)) if len(known) >= _LEAST_FRAMES else math.nan


def _mostly(values: Float[Tensor, " T"], bound: float) -> bool:
    """Return whether most of the values that are known lie below a bound."""
    known = values[values.isfinite()]
    return len(known) > 0 and float((known < bound).double().mean()) > _MOST
