"""Follow persons from frame to frame by the distances of their keypoints."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.measure._detectors.protocol import Detections
from torchpose.measure._face import nearest_pairs
from torchpose.skeleton._joint_sets import canonical_names

_GATE = 0.5  # mean distance of keypoints, in scales of the person, within which it is the same one
_DRIFT = 0.05  # of the gate, per frame in which the person was not detected
_WIDEST = 1.5  # gate
_DOUBLE = 0.15  # mean distance in scales, within which two detections are of one person
_LEAST_SHARED = 3  # keypoints that both have, or half of a smaller set
_MEMORY = 30  # most detections that count; a track loses a third of one in every frame without
_LEAST_HITS = 3  # detections before a person counts

_UPPER = tuple(f"{part}_{side}" for part in ("eye", "ear", "shoulder", "elbow", "wrist", "hand")
               for side in ("left", "right"))  # fmt: skip
_REACH = 2.0  # scales, from the middle of the shoulders to the border of a crop
_MARGIN = 1.25  # a crop over the box of the keypoints
_HEAD = 1.3  # sizes of a face, from the middle of the shoulders up to its centre
_FACE = 0.47  # size of a face over the width of the shoulders


class PersonTracks(NamedTuple):
    """Holds the P persons that are followed.

    Attributes:
        keypoints: last seen, pixels [P, J, 2], NaN where missing. hits: detections [P].
        unseen: frames since the last one [P]. identity: [P]. next_identity: of the next newcomer.
    """

    keypoints: Float[Tensor, "P J 2"]
    hits: Float[Tensor, " P"]
    unseen: Int[Tensor, " P"]
    identity: Int[Tensor, " P"]
    next_identity: int

    @property
    def usable(self) -> Bool[Tensor, " P"]:
        """Return the persons that were detected often enough."""
        return self.hits >= _LEAST_HITS


def no_tracks(n_keypoints: int) -> PersonTracks:
    """Return the state without persons."""
    nobody = torch.zeros(0, dtype=torch.long)
    points = torch.zeros(0, n_keypoints, 2, dtype=torch.float64)
    return PersonTracks(points, torch.zeros(0, dtype=torch.float64), nobody, nobody.clone(), 0)


def upper_rows(names: Sequence[str]) -> list[int]:
    """Return which keypoints are of the upper body."""
    wanted = {*_UPPER, "nose", "head", "neck"}
    return [i for i, name in enumerate(canonical_names(names)) if name in wanted]


def person_scale(
    keypoints: Float[Tensor, "N J 2"], names: Sequence[str]
) -> tuple[Float[Tensor, "N 2"], Float[Tensor, " N"]]:
    """Return the middle of the shoulders of each person, and about the width of those, pixels.

    The width is that of the shoulders or, of people who turn aside, the distance of nose or ears from their
    middle; without shoulders it is half the larger side of the box of all keypoints about its middle.
    """
    known = canonical_names(names)
    low, high = _extent(keypoints)
    side = (high - low).amax(-1) / 2
    if not {"shoulder_left", "shoulder_right"} <= set(known):
        return (low + high) / 2, side.clamp_min(1.0)
    pair = keypoints[:, [known.index("shoulder_left"), known.index("shoulder_right")]]
    width = (pair[:, 0] - pair[:, 1]).norm(dim=-1)
    middle = pair.mean(1)
    heads = [known.index(name) for name in ("nose", "ear_left", "ear_right") if name in known]
    if heads:
        height = (keypoints[:, heads] - middle[:, None]).norm(dim=-1)
        height = height.nan_to_num(0.0).amax(-1)
        width = torch.maximum(width, height)
    there = middle.isfinite().all(-1)
    middle = torch.where(there[:, None], middle, (low + high) / 2)
    return middle, torch.where(there, width, side).clamp_min(1.0)


def _extent(keypoints: Float[Tensor, "N J 2"]) -> tuple[Tensor, Tensor]:
    """Return the lowest and the highest coordinates of the keypoints of each person [N, 2]."""
    missing = keypoints.isnan()
    low = keypoints.masked_fill(missing, torch.inf).amin(1)
    high = keypoints.masked_fill(missing, -torch.inf).amax(1)
    return low, high


def _distances(
    first: Float[Tensor, "N J 2"], second: Float[Tensor, "P J 2"], scale: Float[Tensor, " P"]
) -> Float[Tensor, "N P"]:
    """Return the mean distances of shared keypoints in scales, infinite where too few are shared."""
    apart = (first[:, None] - second).norm(dim=-1)
    shared = apart.isfinite()
    mean = apart.nan_to_num(0.0).sum(-1) / shared.sum(-1).clamp_min(1) / scale
    return torch.where(shared.sum(-1) >= least_seen(first.shape[1]), mean, torch.inf)


def least_seen(n_keypoints: int) -> int:
    """Return the number of keypoints that make a person: three, or half of a set of fewer than five."""
    return min(_LEAST_SHARED, (n_keypoints + 1) // 2)


def without_doubles(
    found: Detections, scale: Float[Tensor, " N"], rows: Sequence[int]
) -> Int[Tensor, " n"]:
    """Return which persons are no repetition of a surer one.

    Args:
        scale: of the persons. rows: keypoints by which persons are compared.
    """
    order = found.confidence[:, rows].sum(1).argsort(descending=True)
    points = found.keypoints[order][:, rows]
    near = _distances(points, points, scale[order]) < _DOUBLE
    return order[~torch.tril(near, -1).any(1)].sort().values


def associate(
    tracks: PersonTracks,
    keypoints: Float[Tensor, "N J 2"],
    scale: Float[Tensor, " P"],
    rows: Sequence[int],
) -> tuple[PersonTracks, Int[Tensor, " N"]]:
    """Return the next tracks, and the row of the track of each detection; the nearest pairs go first.

    Args:
        tracks: of the frames before. keypoints: of the persons in this frame, NaN where missing.
        scale: of the tracked persons. rows: keypoints by which persons are compared.
    """
    distance = _distances(keypoints[:, rows], tracks.keypoints[:, rows], scale)
    gate = (_GATE * (1 + _DRIFT * tracks.unseen)).clamp_max(_WIDEST)
    owner = nearest_pairs(torch.where(distance <= gate, distance, torch.inf))
    mine = owner >= 0
    hits, unseen, last = tracks.hits - 1 / 3, tracks.unseen + 1, tracks.keypoints.clone()
    hits[owner[mine]] = (tracks.hits[owner[mine]] + 1).clamp_max(_MEMORY)
    unseen[owner[mine]] = 0
    last[owner[mine]] = keypoints[mine]
    new = torch.nonzero(~mine).flatten()
    owner[new] = len(last) + torch.arange(len(new))
    identity = tracks.next_identity + torch.arange(len(new))
    points, hits = torch.cat([last, keypoints[new]]), torch.cat([hits, hits.new_ones(len(new))])
    unseen = torch.cat([unseen, unseen.new_zeros(len(new))])
    alive = hits > 0
    kept = PersonTracks(
        points[alive],
        hits[alive],
        unseen[alive],
        torch.cat([tracks.identity, identity])[alive],
        tracks.next_identity + len(new),
    )
    return kept, (alive.long().cumsum(0) - 1)[owner]


def pseudo_faces(middle: Float[Tensor, "N 2"], scale: Float[Tensor, " N"]) -> Float[Tensor, "N 3"]:
    """Return (x, y, size) of the faces above shoulders, which say where clothes are."""
    size = _FACE * scale
    return torch.stack([middle[:, 0], middle[:, 1] - _HEAD * size, size], 1)


def crop_boxes(
    keypoints: Float[Tensor, "N J 2"],
    middle: Float[Tensor, "N 2"],
    scale: Float[Tensor, " N"],
    size: tuple[int, int],
) -> Float[Tensor, "N 4"]:
    """Return boxes about persons: left, top, right, bottom.

    They hold the box of the keypoints, a quarter larger, and of what arms reach the part in the image.

    Args:
        keypoints: of the persons. middle, scale: by `person_scale`. size: (w, h) of the image.
    """
    low, high = _extent(keypoints)
    centre, half = (low + high) / 2, _MARGIN * (high - low) / 2
    reach, border = _REACH * scale[:, None], keypoints.new_tensor(size)
    first = torch.minimum(centre - half, (middle - reach).clamp_min(0.0))
    last = torch.maximum(centre + half, torch.minimum(middle + reach, border))
    return torch.cat([first, last], 1)
