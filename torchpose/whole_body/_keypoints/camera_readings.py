"""Say which camera is read in the wrong way: with other images or another pose of it, cameras agree."""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from torchpose._core.rows import joined
from torchpose.camera._rig import CameraRig
from torchpose.whole_body._keypoints.camera_conventions import (
    WELL_OF_TWO,
    Convention,
    image_conventions,
    maps_of_poses,
    pose_conventions,
)
from torchpose.whole_body._keypoints.camera_order import (
    MORE,
    WELL,
    agreement_of_readings,
    some_frames,
)
from torchpose.whole_body._keypoints.joint_triangulation import agreeing, agreement
from torchpose.whole_body._keypoints.keypoint_likelihood import Exchange, KeypointFrame, RigMaps

_FEW = 0.7  # share of a camera's keypoints that agree, below which its pose may be one of another convention
_MORE_OF_TWO = 0.3  # by how much two cameras agree better by another pose of one of them


class _Reading(NamedTuple):
    """Holds how well cameras agree if a camera is read in another way."""

    agreed: float
    convention: Convention
    camera: int


def notes_on_one_camera(
    rig: CameraRig, maps: RigMaps, frames: KeypointFrame, exchange: Exchange
) -> tuple[str, ...]:
    """Return a note if cameras agree far better with images or pose of one of them read in another way.

    Args:
        rig, maps: the cameras. frames: keypoints [T, C, J]. exchange: of sides.
    """
    some = some_frames(frames)
    given = float(agreement(maps, some))
    two = len(rig) == 2
    images = _best_images(rig, maps, some, exchange)
    tried = [(images, max(WELL_OF_TWO if two else WELL, given + MORE))]
    poses = _poses(rig, maps, some)
    if poses:
        others = max(reading.agreed for reading in (images, *poses[1:2]))
        least = max(given + _MORE_OF_TWO, others + MORE) if two else given + MORE
        tried.append((poses[0], max(WELL, least)))
    good = [reading for reading, least in tried if reading.agreed >= least]
    if not good:
        return ()
    best = max(good, key=lambda reading: reading.agreed)
    return (
        f"camera {rig.names[best.camera]}: cameras agree on {100 * best.agreed:.0f} % of the keypoints if, "
        f"of this camera alone, {best.convention.said}, and on {100 * given:.0f} % as they are given, so "
        f"poses may be wrong; {best.convention.advice}",
    )


def _best_images(
    rig: CameraRig, maps: RigMaps, some: KeypointFrame, exchange: Exchange
) -> _Reading:
    """Return the best of the other readings of the images of one camera."""
    readings = list(_readings(rig, some, exchange))
    tried = [_one_by_one(some, other) for _, other in readings]
    best, place = agreement_of_readings(maps, joined(tried, 1)).max(0)
    return _Reading(float(best), readings[int(place) // len(rig)][0], int(place) % len(rig))


def _poses(rig: CameraRig, maps: RigMaps, some: KeypointFrame) -> list[_Reading]:
    """Return the other readings of the poses of cameras that disagree with others, the best one first."""
    found = []
    for c in _disagreeing(maps, some):
        for convention in pose_conventions(rig):
            R, t = rig.rotation.clone(), rig.translation.clone()
            R[c], t[c] = convention.rotation[c], convention.translation[c]
            fits = float(agreement(maps_of_poses(rig, maps, R, t), some))
            found.append(_Reading(fits, convention, c))
    return sorted(found, key=lambda reading: reading.agreed, reverse=True)


def _disagreeing(maps: RigMaps, some: KeypointFrame) -> list[int]:
    """Return the cameras of whose keypoints few agree with others on a joint."""
    good = agreeing(maps, some).chosen & some.shared
    share = good.sum((0, 2)) / some.shared.sum((0, 2)).clamp_min(1)
    return (share < _FEW).nonzero().flatten().tolist()


def _readings(
    rig: CameraRig, some: KeypointFrame, exchange: Exchange
) -> Iterator[tuple[Convention, KeypointFrame]]:
    """Yield the other readings of images, each with the keypoints of all cameras read so."""
    for convention in image_conventions(rig):
        if convention.pixels is None:
            continue
        other = some._replace(pixels=convention.pixels(some.pixels))
        yield convention, other
        if convention.exchanges:
            yield convention, other.map(lambda value: value.index_select(2, exchange.mirror))


def _one_by_one(some: KeypointFrame, other: KeypointFrame) -> KeypointFrame:
    """Return keypoints [T, C, C, J] with those of each camera, one after the other, replaced."""
    own = torch.eye(some.pixels.shape[1], dtype=torch.bool, device=some.pixels.device)

    def put(value: Tensor, new: Tensor) -> Tensor:
        chosen = own.view(*own.shape, *[1] * (value.ndim - 2))
        return torch.where(chosen, new[:, None], value[:, None])

    return KeypointFrame(*map(put, some, other))
