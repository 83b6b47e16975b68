"""Refuse cameras and keypoints of another convention, in which cameras agree far better on the person.

Poses from camera to world, axes of other programs and images that were scaled or turned give poses of a
person who is somewhere else, upside down or turned about, and some of them agree not badly. So the known
conventions are tried on some frames. What decides is how well cameras agree on the joints (`agreement`) in
one in which the person has the size of one.
"""

import math
from collections.abc import Callable, Iterator
from functools import partial
from itertools import starmap
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.body._skeleton import BODY_15
from torchpose.camera._rig import CameraRig
from torchpose.errors import CameraError
from torchpose.whole_body._keypoints.body_kalman import BodyKalmanFilter
from torchpose.whole_body._keypoints.camera_order import MORE, WELL, agreement_of_orders
from torchpose.whole_body._keypoints.camera_units import log_factors
from torchpose.whole_body._keypoints.joint_triangulation import agreement
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame, RigMaps

WELL_OF_TWO = 0.9
"""In place of WELL where there are two cameras, which agree more easily."""
_FRAMES = 12  # that are looked at, at most
_LEAST_KEYPOINTS = 24  # in these frames, of joints that two cameras see
_LEAST_BONES = 20  # in all images, that tell a size
_SURE = 0.92  # agreement from which on nothing else is tried, unless the person is upside down
_MOST_TRUNKS = 0.8  # share of images that show the trunk the same way
_LITTLE = 0.02  # by how much cameras have to agree better on one who is not upside down
_TIE = 0.01  # exchanged inputs of two cameras, one of which is the world's axes, look like an inverted pose
_SIZES = (0.4, 1.6)  # of a person, by what is expected
_MOST = 0.99  # share of the keypoints that is in the images
_SCALES = ((1, 3), (1, 2), (2, 3), (3, 2), (2, 1), (3, 1))  # of images by the calibrated ones

_FLIPS = (
    ((1.0, -1.0, -1.0), "y and z"),
    ((-1.0, 1.0, -1.0), "x and z"),
    ((-1.0, -1.0, 1.0), "x and y"),
)

_Pixels = Callable[[Tensor], Tensor]


class Convention(NamedTuple):
    """Holds another reading of what is given.

    Attributes:
        said: in which cameras agree, after "if". advice: what to do.
        rotation, translation: of the cameras [C, 3, 3], [C, 3].
        pixels: the change of keypoints [..., C, J, 2].
        tilts: whether what is up in images is not up in these.
        exchanges: whether a detector that sees the images takes left for right.
    """

    said: str
    advice: str
    rotation: Tensor
    translation: Tensor
    pixels: _Pixels | None = None
    tilts: bool = False
    exchanges: bool = False


def check_conventions(rig: CameraRig, filter: BodyKalmanFilter, frames: KeypointFrame) -> None:
    """Raise `CameraError` where cameras agree far better on the person in another convention.

    Args:
        rig: the cameras. filter: of the person whose bones are expected. frames: keypoints [B, T, C, J].
    """
    if len(rig) == 1:
        return
    flat = frames.map(lambda value: value.flatten(0, 1))
    some = flat.some(flat.there.any(-1).sum(-1) >= 2, _FRAMES)
    if int(some.shared.sum()) < _LEAST_KEYPOINTS:
        return
    given = float(agreement(filter.maps, some))
    found = _better(rig, filter, some, given)
    if not found:
        return
    best, convention = max(found, key=lambda pair: pair[0])
    ordered = float(agreement_of_orders(filter.maps, some)[1].max())
    if ordered > best:
        return  # a note tells of the order
    or_order = ", or inputs are in another order than the cameras" if ordered > best - _TIE else ""
    raise CameraError(
        f"cameras agree on {100 * given:.0f} % of the keypoints as they are given, and on {100 * best:.0f} % "
        f"if {convention.said}{or_order}; {convention.advice}"
    )


def _better(
    rig: CameraRig, filter: BodyKalmanFilter, some: KeypointFrame, given: float
) -> list[tuple[float, Convention]]:
    """Return the conventions in which cameras agree far better than as given, each after how well they do."""
    human = _is_human(filter, filter.maps, some)
    above, upside_down = _trunks(some)
    if human and given > _SURE and not upside_down:
        return []
    found = []
    least = WELL_OF_TWO if len(rig) == 2 else WELL
    conventions = (
        *_of_poses(rig.rotation, rig.translation),
        *_of_images(rig),
        *_of_sizes(rig, some),
    )
    for convention in conventions:
        if above and convention.tilts:
            continue
        maps = maps_of_poses(rig, filter.maps, convention.rotation, convention.translation)
        moved = some
        if convention.pixels is not None:
            moved = some._replace(pixels=convention.pixels(some.pixels))
        fits = float(agreement(maps, moved))
        more = _LITTLE if upside_down and convention.tilts else MORE
        if fits > max(least, given + more if human else 0.0) and _is_human(filter, maps, moved):
            found.append((fits, convention))
    return found


def _is_human(filter: BodyKalmanFilter, maps: RigMaps, some: KeypointFrame) -> bool:
    """Return whether bones are about as long as those of a person, or too few tell."""
    logs = log_factors(maps, some, filter.motion)
    return len(logs) < _LEAST_BONES or _SIZES[0] < math.exp(float(logs.median())) < _SIZES[1]


def _trunks(some: KeypointFrame) -> tuple[bool, bool]:
    """Return whether the neck is above the pelvis in most images, more than beside it, and whether below."""
    ends = [BODY_15.joint("neck"), BODY_15.joint("pelvis")]
    both = (some.inlier[..., ends] > 0).all(-1)
    across, down = (some.pixels[..., ends[1], :] - some.pixels[..., ends[0], :])[both].unbind(-1)
    if len(down) == 0:
        return False, False
    above, below = ((side > across.abs()).double().mean() for side in (down, -down))
    return bool(above > _MOST_TRUNKS), bool(below > _MOST_TRUNKS)


def maps_of_poses(rig: CameraRig, maps: RigMaps, rotation: Tensor, translation: Tensor) -> RigMaps:
    """Return the maps of cameras with other poses."""
    matrix = rig.matrix.to(maps.matrix)
    shift = (matrix @ translation[..., None]).squeeze(-1)
    turned = matrix @ rotation
    return maps._replace(matrix=turned, shift=shift, centre=-torch.linalg.solve(turned, shift))


def image_conventions(rig: CameraRig) -> Iterator[Convention]:
    """Yield the other readings of keypoints in images."""
    yield from _of_images(rig)
    yield from (_of_size(rig, one, of) for one, of in _SCALES)


def pose_conventions(rig: CameraRig) -> Iterator[Convention]:
    """Yield the other readings of poses, those of one camera whose axes were turned included."""
    R, t = rig.rotation, rig.translation
    yield from _of_poses(R, t)
    yield Convention(
        "the translation has the other sign", "give -t: x_camera = R x_world + t", R, -t
    )
    for signs, axes in _FLIPS:
        turn = torch.tensor(signs).to(R)
        if axes != "y and z":  # that is OpenGL's
            yield Convention(
                f"its own axes {axes} point the other way",
                "its axes are x to the right, y down, z ahead",
                turn[:, None] * R, turn * t,
            )  # fmt: skip
        yield Convention(
            f"the axes {axes} of the world point the other way",
            "give the pose in the world of the other cameras", R * turn, t,
        )  # fmt: skip


def _of_images(rig: CameraRig) -> Iterator[Convention]:
    """Yield the conventions of images of the calibrated size."""
    seen = partial(Convention, rotation=rig.rotation, translation=rig.translation)
    yield seen(
        "keypoints are v, u, a row and a column", "give u, v: u to the right and v down",
        pixels=lambda pixels: pixels.flip(-1), tilts=True,
    )  # fmt: skip
    if None in rig.sizes:
        return
    h, w = torch.tensor(rig.sizes).to(rig.rotation).T[..., None]
    yield seen(
        "v is counted from the lower edge of the image", "give height - 1 - v, which is down",
        pixels=lambda p: torch.stack([p[..., 0], h - 1 - p[..., 1]], -1), tilts=True,
    )  # fmt: skip
    yield seen(
        "the images are mirrored",
        "give keypoints of images as they were calibrated, u = width - 1 - u (and exchange left and right if "
        "a detector found them in mirrored images)",
        pixels=lambda p: torch.stack([w - 1 - p[..., 0], p[..., 1]], -1), exchanges=True,
    )  # fmt: skip
    turns: dict[str, _Pixels] = {
        "upside down": lambda p: torch.stack([w - 1 - p[..., 0], h - 1 - p[..., 1]], -1),
        "turned by 90 degrees clockwise": lambda p: torch.stack([p[..., 1], h - 1 - p[..., 0]], -1),
        "turned by 90 degrees counterclockwise": lambda p: torch.stack(
            [w - 1 - p[..., 1], p[..., 0]], -1
        ),
    }
    for turn, pixels in turns.items():
        yield seen(
            f"the images are {turn} against the calibrated ones",
            "turn the images, or their keypoints, back, or calibrate the turned images",
            pixels=pixels, tilts=True,
        )  # fmt: skip


def _of_sizes(rig: CameraRig, some: KeypointFrame) -> Iterator[Convention]:
    """Yield the sizes of images in which keypoints can be: all lie inside, and in no smaller image of these.

    Two cameras close together tell sizes poorly, so only those that the keypoints themselves speak for count.
    """
    # as matrices have them
    sides = (2 * rig.matrix[:, :2, 2] + 1).clamp_min(1).to(some.pixels)[:, None]
    used = float((some.pixels / sides).amax(-1)[some.there].quantile(_MOST))
    for one, of in _SCALES:
        s = one / of
        if (s < 1 and used > s) or (s > 1 and used < 1):
            continue
        yield _of_size(rig, one, of)


def _of_size(rig: CameraRig, one: int, of: int) -> Convention:
    """Return the convention of images that are larger than the calibrated ones by a factor."""
    return Convention(
        f"keypoints are of images of {one}/{of} of the calibrated size",
        f"give the calibration of these images: the first two rows of `matrix` and `size` times "
        f"{one}/{of}, or give keypoints of the calibrated images (.npz and .csv may state image_size)",
        rig.rotation, rig.translation, lambda pixels: (pixels + 0.5) * of / one - 0.5,
    )  # fmt: skip


def _of_poses(R: Float[Tensor, "C 3 3"], t: Float[Tensor, "C 3"]) -> Iterator[Convention]:
    """Yield the conventions of poses R, t of cameras."""
    flip = torch.tensor([1.0, -1.0, -1.0]).to(R)

    def moved(turn: Tensor, point: Tensor) -> Tensor:
        return -(turn @ point[..., None]).squeeze(-1)

    opengl = "cameras look along -z with y up, as those of OpenGL and Blender"
    turned = flip[:, None] * R.mT
    yield from starmap(Convention, [
        ("poses are those from camera to world",
         "a camera file has those from world to camera: the rotation R^T and the translation -R^T t",
         R.mT, moved(R.mT, t)),
        ("translations are the places of the cameras",
         "a camera at c has the translation -R c", R, moved(R, t)),
        ("rotations are those from camera to world, and translations are not",
         "give the rotations R^T, of Rodrigues vectors with the other sign", R.mT, t),
        (opengl, "give the rotation F R and the translation F t, with F = diag(1, -1, -1)",
         flip[:, None] * R, flip * t),
        (f"{opengl}, and poses are those from camera to world",
         "give the rotation F R^T and the translation -F R^T t, with F = diag(1, -1, -1)",
         turned, moved(turned, t)),
    ])  # fmt: skip
