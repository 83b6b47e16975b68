"""Say which camera has a wrong focal length or lens, or that two cameras agree poorly.

Several cameras tell what is wrong with one of them if an error of it explains the keypoints better than any
pose of any camera does. Two cameras tell only that they agree poorly: nearly every error of one is explained
by a turn of the other.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.rows import joined
from torchpose.camera._lens import distort_rays
from torchpose.camera._rig import CameraRig
from torchpose.whole_body._keypoints.camera_causes import (
    FOCAL,
    LENS,
    POSE,
    TURN,
    Causes,
    Explained,
    explain,
)
from torchpose.whole_body._keypoints.coarse_delays import shifted
from torchpose.whole_body._keypoints.faulty_cameras import without_still_frames
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame

_FRAMES = 30  # at most, that are looked at
_LEAST_KEYPOINTS = 100  # of joints that two cameras see
_PROMISE = 0.015  # gain of a linear step that has explanations tried; right cameras have 0.007
_MOST_CAMERAS = 3  # that are tried, those that promise most
# gains are log-densities for a keypoint of full trust; no error explains right cameras by 0.02 more
_LEAST_GAINS = {"focal": 0.1, "lens": 0.03, "raw": 0.03}
_OF_TWO = 0.08
_BEFORE_OTHERS = 0.01  # gain by which a cause is ahead of all others
_WORST_OF_TWO = 1.0  # misfit of two cameras that nothing explains; right ones have up to 0.6
_MOST = 0.8  # share of keypoints that are nearer to joints than the distance that is said
_LEAST_FOCAL = 0.04  # log of a factor

_POSE, _TURN = tuple(range(POSE)), tuple(range(TURN))


class CameraCause(NamedTuple):
    """Holds what seems to be wrong with a camera.

    Attributes:
        kind: "focal", "lens", "raw" (a lens is given that keypoints do not have), "turn" or "nothing".
        camera: which. value: the factor of the focal length, the distortion, or the turn in degrees.
        given, explained: distances from joints beyond which a fifth of the keypoints is, pixels, as given and
            without the error.
    """

    kind: str
    camera: int
    value: float
    given: float
    explained: float


def notes_on_causes(
    rig: CameraRig, frames: KeypointFrame, delays: Float[Tensor, " C"]
) -> tuple[str, ...]:
    """Return a note on what seems to be wrong with one camera, or with both of two.

    Args:
        rig: two cameras or more. frames: keypoints [T, C, J]. delays: frames by which cameras are surely too
            early, 0 for the others.
    """
    if bool(delays.any()):
        frames = shifted(frames, delays.round().long())[0]
    cause = find_cause(rig, frames)
    if cause is None:
        return ()
    return (_of_two(rig, cause) if len(rig) == 2 else _of_several(rig, cause),)


def find_cause(rig: CameraRig, frames: KeypointFrame) -> CameraCause | None:
    """Return what seems to be wrong with one camera, None if nothing does or if it is not a matter of these.

    Args:
        rig: two cameras or more. frames: keypoints [T, C, J].
    """
    moving = without_still_frames(frames)
    some = moving.some(moving.there.any(-1).sum(-1) >= 2, _FRAMES)
    count = float((some.inlier * some.shared).sum())
    if count < _LEAST_KEYPOINTS:
        return None
    n = len(rig)
    given = explain(rig, _repeated(some, n), Causes.of([(c, ()) for c in range(n)], _device(some)))
    cost = float(given.cost[0]) / count
    tell = bool(given.promise.max() > _PROMISE * count)
    if not tell and not (n == 2 and cost > _WORST_OF_TWO):
        return None
    cameras = given.promise.topk(min(n, _MOST_CAMERAS)).indices.tolist()
    seen = _Seen(rig, some, cameras, count, cost, _distance(given, 0, some))
    return _cause_of_two(seen) if n == 2 else _cause_of_several(seen)


class _Seen(NamedTuple):
    """Holds what cameras see, and how well they agree as they are given.

    Attributes:
        rig, frames: the cameras and some frames. cameras: of which errors are tried.
        n_keypoints: how many. cost: of one of them. distance: see `CameraCause.given`.
    """

    rig: CameraRig
    frames: KeypointFrame
    cameras: list[int]
    n_keypoints: float
    cost: float
    distance: float

    def costs(self, found: Explained) -> Float[Tensor, " N"]:
        """Return the cost of a keypoint by explanations."""
        return found.cost / self.n_keypoints


def _cause_of_two(seen: _Seen) -> CameraCause | None:
    """Return the turn of one camera that explains what both see, or nothing."""
    causes = [(c, _TURN) for c in seen.cameras]
    some = seen.frames
    found = explain(seen.rig, _repeated(some, len(causes)), Causes.of(causes, _device(some)))
    best = int(found.cost.argmin())
    left = float(seen.costs(found)[best])
    camera = causes[best][0]
    if seen.cost - left > _OF_TWO and left < _WORST_OF_TWO:
        degrees = float(torch.rad2deg(found.errors[best, :TURN].norm()))
        return CameraCause("turn", camera, degrees, seen.distance, _distance(found, best, some))
    if left > _WORST_OF_TWO:
        return CameraCause("nothing", camera, 0.0, seen.distance, seen.distance)
    return None


class _Tried(NamedTuple):
    """Holds an explanation: its kind, and of which camera which errors are free."""

    kind: str
    camera: int
    free: tuple[int, ...]


def _cause_of_several(seen: _Seen) -> CameraCause | None:
    """Return the focal length or the lens that explains what cameras see better than any pose does."""
    rig, some = seen.rig, seen.frames
    kinds = {"pose": _POSE, "focal": (FOCAL,), "lens": (LENS,)}
    tried = [_Tried(kind, c, free) for c in seen.cameras for kind, free in kinds.items()]
    raw = [_Tried("raw", c, ()) for c in seen.cameras if bool(rig.distortions[c].any())]
    own = _repeated(some, len(tried))
    distorted = [_distorted(rig, some, one.camera).map(lambda value: value[None]) for one in raw]
    frames = joined([own, *distorted])
    tried += raw
    found = explain(rig, frames, Causes.of([one[1:] for one in tried], _device(some)))
    gains = (seen.cost - seen.costs(found)).tolist()
    # a lens that is given and not there says more than that it is undone by another one
    row = max(range(len(tried)), key=lambda i: gains[i] + _BEFORE_OTHERS * (tried[i].kind == "raw"))
    kind, camera, _ = tried[row]
    others = [gain for gain, one in zip(gains, tried, strict=True) if not _alike(one, tried[row])]
    if kind == "pose" or gains[row] < max(_LEAST_GAINS[kind], max(others) + _BEFORE_OTHERS):
        return None
    errors = found.errors[row]
    if kind == "focal" and abs(float(errors[FOCAL])) < _LEAST_FOCAL:
        return None
    value = float(errors[FOCAL].exp()) if kind == "focal" else float(errors[LENS])
    return CameraCause(kind, camera, value, seen.distance, _distance(found, row, some))


def _alike(one: _Tried, other: _Tried) -> bool:
    """Return whether explanations say the same: a lens that is left out, or undone by another one."""
    lens = ("lens", "raw")
    same = one.kind == other.kind or (one.kind in lens and other.kind in lens)
    return same and one.camera == other.camera


def _repeated(frames: KeypointFrame, count: int) -> KeypointFrame:
    return frames.map(lambda value: value.expand(count, *value.shape))


def _distorted(rig: CameraRig, frames: KeypointFrame, camera: int) -> KeypointFrame:
    """Return keypoints with those of a camera as its detector gave them, before they were undistorted."""
    K = rig.matrix[camera].to(frames.pixels)
    rays = torch.linalg.solve(K[:2, :2], (frames.pixels[:, camera] - K[:2, 2]).mT).mT
    flat = distort_rays(
        rays.flatten(0, -2).cpu(), rig.distortions[camera].cpu(), rig.fisheye[camera]
    )
    pixels = frames.pixels.clone()
    pixels[:, camera] = flat.to(pixels).view_as(rays) @ K[:2, :2].mT + K[:2, 2]
    return frames._replace(pixels=pixels)


def _distance(found: Explained, row: int, frames: KeypointFrame) -> float:
    """Return how far the farthest fifth of the keypoints is from joints, pixels."""
    return float(found.pixels[row][frames.there].quantile(_MOST))


def _device(frames: KeypointFrame) -> torch.device:
    return frames.pixels.device


def _of_several(rig: CameraRig, cause: CameraCause) -> str:
    """Return the note on the focal length or the lens of one camera."""
    if cause.kind == "focal":
        f = float(rig.matrix[cause.camera, 0, 0])
        said = (
            f"its focal length is {cause.value:.2f} times the given one ({f * cause.value:.0f} pixels in "
            f"place of {f:.0f})"
        )
        advice = "check `matrix`: for which zoom it was calibrated, and for which size or crop of the images"
    elif cause.kind == "raw":
        said = "the lens distortion that is given is left out"
        advice = (
            "its keypoints seem to be of undistorted images already; set its `distortions` to zeros"
        )
    else:
        beside = " beside the given one" if bool(rig.distortions[cause.camera].any()) else ""
        said = f"its lens has a radial distortion k1 of about {cause.value:+.2f}{beside}"
        advice = "check its `distortions`: they seem to be missing, or those of another lens"
    return (
        f"camera {rig.names[cause.camera]}: cameras agree far better if {said}: a fifth of the keypoints is "
        f"then {cause.explained:.0f} pixels or more from common joints, and {cause.given:.0f} as cameras are "
        f"given, so poses, and turns of cameras that are said, may be wrong; {advice}"
    )


def _of_two(rig: CameraRig, cause: CameraCause) -> str:
    """Return the note on two cameras that agree poorly."""
    better = ""
    if cause.kind == "turn":
        better = (
            f", and {cause.explained:.0f} if {rig.names[cause.camera]} were turned by {cause.value:.1f} "
            "degrees, or something else were wrong with one of them"
        )
    return (
        f"cameras {rig.names[0]} and {rig.names[1]} agree poorly: a fifth of their keypoints is "
        f"{cause.given:.0f} pixels or more from common joints{better}, so poses may be wrong; two cameras do "
        "not tell which of them it is: check the calibration of both (pose, focal length, lens, image size, "
        "metres) and whether one of them is late"
    )
