"""Note what tells that a camera, or its method, does not suit the keypoints."""

from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.camera._pinhole import PinholeCamera
from torchpose.filters._lengths import inside_lengths
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.upper_body._screen_model import guessed_size

_NECK = UPPER_BODY.index("neck")
_NEAREST_NECK = 0.3  # metres before the camera; people at webcams are farther away


def size_notes(
    camera: PinholeCamera,
    keypoints: Float[Tensor, "B T J 2"],
    known: Bool[Tensor, "B T 8"],
    places: tuple[int, ...],
) -> tuple[str, ...]:
    """Return a note if most keypoints lie beyond the image whose size is guessed; nothing if it is known.

    Args:
        camera: of the keypoints. keypoints: pixels. known: which of `UPPER_BODY` are measured.
        places: where these are among the keypoints; negative where they are not.
    """
    if camera.image_size is not None:
        return ()
    rows = [row for row, place in enumerate(places) if place >= 0]
    size = guessed_size(camera).to(keypoints)
    beyond = (keypoints[:, :, [places[row] for row in rows]] > size).any(-1) & known[:, :, rows]
    if 2 * int(beyond.sum()) <= int(known[:, :, rows].sum()):
        return ()
    width, height = (f"{float(side):.0f}" for side in size)
    return (
        f"most keypoints lie beyond {width} x {height} pixels, which is guessed to be the image from the "
        "principal point, and may be taken as outliers; give the camera the width and height of its image",
    )


def nearness_notes(
    joints: Float[Tensor, "B T 8 3"], lengths: Int[Tensor, " B"] | None
) -> tuple[str, ...]:
    """Return a note if single poses put a neck nearer to the camera than a person is.

    Args:
        joints: camera axes, metres. lengths: the number of frames of each sequence; None is all.
    """
    near = joints[:, :, _NECK, 2] < _NEAREST_NECK
    if lengths is not None:
        near = near & inside_lengths(lengths.to(near.device), near.shape[1])
    if not bool(near.any()):
        return ()
    return (
        f"the neck comes out less than {_NEAREST_NECK:g} m before the camera: single poses do not reach "
        "persons so near, or the focal length is wrong; method 'articulated' follows persons who are near",
    )
