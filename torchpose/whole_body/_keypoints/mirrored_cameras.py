"""Say which camera's video is mirrored: with its keypoints mirrored back, cameras agree on joints."""

import torch
from torch import Tensor

from torchpose.camera._rig import CameraRig
from torchpose.whole_body._keypoints.camera_order import (
    MORE,
    WELL,
    agreement_of_readings,
    some_frames,
)
from torchpose.whole_body._keypoints.keypoint_likelihood import Exchange, KeypointFrame, RigMaps

_LEAST_CAMERAS = 3  # two agree too easily


def notes_on_mirrored_cameras(
    rig: CameraRig, maps: RigMaps, frames: KeypointFrame, exchange: Exchange
) -> tuple[str, ...]:
    """Return a note if cameras agree far better with the keypoints of one of them mirrored.

    A detector takes left for right in a mirrored image. Keypoints alone may be mirrored as well, so each is
    tried with and without exchanged sides.

    Args:
        rig, maps: the cameras. frames: keypoints [T, C, J]. exchange: of sides.
    """
    count = len(rig)
    if count < _LEAST_CAMERAS or None in rig.sizes:
        return ()
    some = some_frames(frames)
    given = float(agreement_of_readings(maps, some.map(lambda value: value[:, None]))[0])
    if given > 1 - MORE:
        return ()
    u = torch.tensor([size[1] - 1 for size in rig.sizes if size is not None]).to(some.pixels)
    mirrored = some._replace(
        pixels=torch.stack([u[:, None] - some.pixels[..., 0], some.pixels[..., 1]], -1)
    )
    both = (mirrored, mirrored.map(lambda value: value.index_select(2, exchange.mirror)))
    agreed = torch.stack(
        [agreement_of_readings(maps, _one_by_one(some, other)) for other in both]
    ).amax(0)
    best, camera = agreed.max(0)
    if float(best) < max(WELL, given + MORE):
        return ()
    return (
        f"the video of camera {rig.names[int(camera)]} seems to be mirrored: cameras agree on "
        f"{100 * float(best):.0f} % of the keypoints with it mirrored back and on {100 * given:.0f} % as they "
        "are given, so poses may be wrong; mirror it back before a detector sees it, or give u = width - 1 - u "
        "with left and right exchanged",
    )


def _one_by_one(some: KeypointFrame, other: KeypointFrame) -> KeypointFrame:
    """Return keypoints [T, C, C, J] with those of each camera, one after the other, replaced."""
    own = torch.eye(some.pixels.shape[1], dtype=torch.bool, device=some.pixels.device)

    def put(value: Tensor, new: Tensor) -> Tensor:
        chosen = own.view(*own.shape, *[1] * (value.ndim - 2))
        return torch.where(chosen, new[:, None], value[:, None])

    return KeypointFrame(*map(put, some, other))
