"""Say in plain words what the keypoints of cameras show: mirrored videos, cameras that disagree, gaps."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.wording import counted
from torchpose.body._skeleton import BODY_15

TOO_FEW = "too few keypoints were given"
"""Why a track begins late."""

_DISAGREES = 0.5  # share of a camera's keypoints that fit no joint, above which it is said
_UNSURE = 0.1  # confidence below which half of the keypoints hardly count
_MIRRORED = 0.5  # share of frames in which a camera's sides are exchanged
_GAP = 30  # frames without keypoints that are worth a word
_LEAST_TURN = 0.3  # degrees by which keypoints are turned back, from which on it is said
_STRAYS = 30.0  # percent of its frames in which a camera has a detection that fits no person
_HEIGHTS = (1.0, 2.3)  # metres, of a person beyond which it is said
# Factor of the height from which on it is another one; proportions differ by less.
_OTHER_SIZE = 1.12
_OFF_THE_FLOOR = 0.2  # metres of feet in half of the frames, from which on it is said
_DOWN = 0.5  # of a unit vector, along the columns of an image
_LYING = 60.0  # degrees of the trunk from the axis that points up, from which on it is said
_LEANS = 8.0  # degrees by which trunk and legs lean in most images of a camera that may be rolled


def late_note(first_frame: int, why: str) -> tuple[str, ...]:
    """Return a note on the frames before the first pose, if there are any.

    Args:
        first_frame: number of the first pose's. why: there is none before.
    """
    if first_frame == 0:
        return ()
    before = "frame" if first_frame == 1 else f"{first_frame} frames"
    have = "has" if first_frame == 1 else "have"
    return (f"the first {before}, in which {why}, {have} no pose",)


def notes_of(
    cameras: Sequence[str],
    there: Bool[Tensor, "T C J"],
    inlier: Float[Tensor, "T C J"],
    exchanged: Float[Tensor, "T C 2"],
    coasting: Bool[Tensor, " T"],
    alone: Int[Tensor, " T"],
    off: Bool[Tensor, "T C"],
    sized: bool,
    first_frame: int,
) -> tuple[str, ...]:
    """Return notes on the keypoints of a track.

    Args:
        cameras: their names. there: which keypoints there were. inlier: probability that each was a joint's.
        exchanged: probability that sides were exchanged. coasting: frames without a measurement.
        alone: which of several cameras alone decided, -1 if all did. off: cameras whose keypoints count not.
        sized: whether the person's size, or the camera's height, was given.
        first_frame: number of the first of the frames.
    """
    notes = []
    for c, name in enumerate(cameras):
        count = int(there[:, c].sum())
        if count == 0:
            if not bool(off[:, c].any()):
                notes.append(f"camera {name} has no keypoint of this person in any frame")
            continue
        astray = 1 - float(inlier[:, c][there[:, c]].mean())
        if astray > _DISAGREES:
            notes.append(
                f"{100 * astray:.0f} % of the keypoints of camera {name} do not agree with the body; check "
                "its calibration (also for which image size it is), its delay against the others, whether "
                "its video is mirrored, and whether its keypoints are those of another person"
            )
        swapped = float((exchanged[:, c] > 0.5).all(-1)[there[:, c].any(-1)].double().mean())
        if swapped > _MIRRORED:
            notes.append(
                f"left and right of camera {name} are exchanged in {100 * swapped:.0f} % of the frames; "
                "is its video mirrored?"
            )
    if len(cameras) == 1 and not sized:
        notes.append(
            "one camera cannot measure the size of a person: size and distance are those of an average "
            "person; give height, body, or camera_height with up, if one of them is known"
        )
    notes += _notes_on_joints_without_keypoints(there)
    guessed = int((alone >= 0).sum())
    if guessed and not sized:
        seen_by = ", ".join(cameras[c] for c in alone[alone >= 0].unique().tolist())
        notes.append(
            f"one camera alone ({seen_by}) saw the person in {counted(guessed, 'frame')}: size and "
            "distance there are those of an average person; give height or body if one of them is known"
        )
    notes += [
        f"nothing was measured in frames {first_frame + first} to {first_frame + last}; the poses "
        "there are predictions"
        for first, last in _runs(coasting)
        if last - first + 1 >= _GAP
    ]
    return tuple(notes)


def _notes_on_joints_without_keypoints(there: Bool[Tensor, "T C J"]) -> list[str]:
    never = ~there.flatten(0, 1).any(0)
    if not bool(never.any()):
        return []
    joints = ", ".join(name for name, flag in zip(BODY_15.names, never, strict=True) if flag)
    return [
        f"no camera has a keypoint of {joints} in any frame: they are guessed from how the people of the "
        "prior stand and move, and may be off by half a metre if the person sits or lies"
    ]


def notes_on_unsure_keypoints(inlier: Float[Tensor, "T C J"]) -> tuple[str, ...]:
    """Return a note if most keypoints are of so low a confidence that they hardly count.

    Args:
        inlier: prior probability that a keypoint is its joint's, 0 where there is none.
    """
    there = inlier[inlier > 0]
    if not len(there) or float(there.median()) >= _UNSURE:
        return ()
    return (
        f"half of the keypoints or more have a confidence below {_UNSURE:g}, and hardly count: confidence is "
        "the probability that a keypoint is right; scale values of another kind, such as peaks of heat maps "
        "that sum to 1, so that sure keypoints are near 1, or leave them out",
    )


def notes_on_size(height: float, n_cameras: int, told: float | None) -> tuple[str, ...]:
    """Return a note if several cameras, which tell the size of a person, tell another one than was given.

    Without one that was given, it is said if it is that of hardly anybody.

    Args:
        height: of the estimated bones, metres. n_cameras: how many there are. told: height that was given.
    """
    if n_cameras == 1:
        return ()
    if told is not None and not 1 / _OTHER_SIZE < height / told < _OTHER_SIZE:
        return (
            f"the person is {told:.2f} m tall by the given height or body, and by the cameras the bones are "
            f"those of a person of {height:.2f} m; check height or body, whether cameras are in metres, and "
            "whether keypoints are of images of the calibrated size",
        )
    if told is not None or _HEIGHTS[0] <= height <= _HEIGHTS[1]:
        return ()
    return (
        f"the estimated bones are those of a person of {height:.2f} m; if that is wrong, the cameras are not "
        "in metres, or the keypoints are of images of another size than the calibrated ones",
    )


def notes_on_camera_height(
    off: Float[Tensor, " T"], seen: Bool[Tensor, " T"], height: float
) -> tuple[str, ...]:
    """Return a note if the given height of the only camera told nothing, or agrees with no size of a person.

    Args:
        off: metres by which the lower ankle is above where one is that stands on the floor. seen: whether
            it was seen. height: of the camera, metres.
    """
    if not bool(seen.any()):
        return ("no foot was seen, so camera_height told nothing of the person's size",)
    away = float(off[seen].median())
    if abs(away) < _OFF_THE_FLOOR:
        return ()
    side = "above" if away > 0 else "below"
    return (
        f"camera_height does not fit: feet are {abs(away):.1f} m {side} the floor of a camera at {height:g} "
        "m with any likely size of the person, so their size and distance are not to be trusted; check the "
        "height, whether the person stands on that floor, and up, tilt or the rotation of the camera",
    )


def notes_on_still_cameras(
    cameras: Sequence[str],
    pixels: Float[Tensor, "T C J 2"],
    there: Bool[Tensor, "T C J"],
    first_frame: int = 0,
) -> tuple[str, ...]:
    """Return notes on cameras whose keypoints stay exactly the same while those of others do not.

    Args:
        cameras: their names. pixels: of keypoints. there: which there were.
        first_frame: number of the first of the frames.
    """
    both = there[1:] & there[:-1]
    moved = ((pixels[1:] != pixels[:-1]).any(-1) & both).any(-1)
    still = both.any(-1) & ~moved & moved.any(-1, keepdim=True)
    return tuple(
        f"the keypoints of camera {name} are exactly the same in frames {first_frame + first} to "
        f"{first_frame + last + 1}, which were not used; check whether its video stands still"
        for name, flags in zip(cameras, still.unbind(1), strict=True)
        for first, last in _runs(flags)
        if last - first + 2 >= _GAP
    )


def notes_on_left_out_cameras(
    cameras: Sequence[str], off: Bool[Tensor, "T C"], first_frame: int
) -> tuple[str, ...]:
    """Return notes on cameras that were left out.

    Args:
        cameras: their names. off: which were left out. first_frame: number of the first of the frames.
    """
    return tuple(
        f"camera {name} was left out in frames {first_frame + first} to {first_frame + last}, since it does "
        "not see what the others see"
        for name, flags in zip(cameras, off.unbind(1), strict=True)
        for first, last in _runs(flags)
    )


def notes_on_turned_cameras(
    cameras: Sequence[str], turns: Float[Tensor, "T C"], first_frame: int
) -> tuple[str, ...]:
    """Return a note on cameras whose keypoints were turned back, if there are any.

    Args:
        cameras: their names. turns: radians by which keypoints were turned; the last ones are said, since
            later frames tell them better.
        first_frame: number of the first of the frames.
    """
    degrees = torch.rad2deg(turns)
    much = degrees > _LEAST_TURN
    said = []
    for c in much.any(0).nonzero().flatten().tolist():
        frames = much[:, c].nonzero().flatten()
        angle = f"{float(degrees[frames[-1], c]):.1f} degrees"
        said.append(
            f"camera {cameras[c]} (by {angle} from frame {first_frame + int(frames[0])} on)"
        )
    return (_turned_back(said, "were"),) if said else ()


def notes_on_strays(
    cameras: Sequence[str], strays: Bool[Tensor, "T C"], there: Bool[Tensor, "T C"]
) -> tuple[str, ...]:
    """Return notes on cameras with many detections that fit no tracked person.

    Args:
        cameras: their names. strays: whether a camera had a detection that fits no person, and missed a
            tracked one.
        there: whether it had any detection.
    """
    share = 100 * strays.sum(0) / there.sum(0).clamp_min(1)
    return tuple(
        f"in {float(share[c]):.0f} % of its frames camera {cameras[c]} has a detection that fits no tracked "
        "person, and none of a person who is tracked: its calibration may be wrong, its input may be that "
        "of another camera, or its video may be late or mirrored"
        for c in ((share > _STRAYS) & (strays.sum(0) >= _GAP)).nonzero().flatten().tolist()
    )


def notes_on_cameras_now(
    cameras: Sequence[str],
    still: Float[Tensor, " C"],
    off: Bool[Tensor, " C"],
    turns: Float[Tensor, " C"],
) -> tuple[str, ...]:
    """Return notes on cameras that are wrong in a frame of a live stream.

    Args:
        cameras: their names. still: for how many frames their keypoints have been those of the frame before.
        off: which are left out. turns: radians by which keypoints are turned.
    """
    notes = [
        f"the keypoints of camera {cameras[c]} have been exactly the same for {int(still[c]) + 1} frames, "
        "and are not used; check whether its video stands still"
        for c in (still >= _GAP - 1).nonzero().flatten().tolist()
    ]
    notes += [
        f"camera {cameras[c]} is left out, since it does not see what the others see"
        for c in off.nonzero().flatten().tolist()
    ]
    degrees = torch.rad2deg(turns)
    said = [
        f"camera {cameras[c]} (by {float(degrees[c]):.1f} degrees)"
        for c in (degrees > _LEAST_TURN).nonzero().flatten().tolist()
    ]
    return (*notes, _turned_back(said, "are")) if said else tuple(notes)


def _turned_back(said: Sequence[str], verb: str) -> str:
    """Return a note on cameras whose keypoints were, or are, turned back."""
    return (
        f"{' and '.join(said)} seem{'s' * (len(said) == 1)} to be turned against the calibration; keypoints "
        f"{verb} turned back, but the position of the person in the room may be wrong; "
        'refine="extrinsics" (--refine extrinsics) on a recording of one person gives corrected cameras'
    )


def notes_on_a_rolled_camera(
    name: str, pixels: Float[Tensor, "T J 2"], there: Bool[Tensor, "T J"]
) -> tuple[str, ...]:
    """Return a note if a single camera that is taken to be level sees the person lean most of the time.

    Args:
        name: of the camera. pixels: of keypoints. there: which there were.
    """
    trunk = _lean(pixels, there, "neck", ("left_hip", "right_hip"))
    legs = _lean(pixels, there, "pelvis", ("left_ankle", "right_ankle"))
    leans = min(abs(trunk), abs(legs))
    upside_down = leans > 90
    if leans < _LEANS or (trunk * legs <= 0 and not upside_down):
        return ()
    if upside_down:
        return (
            f"the person is upside down in most images of camera {name}, which is taken to be level since no "
            "up is given; v of keypoints is to be counted downwards from the upper edge of an image. If the "
            "camera hangs that way, and not the person, give up (--up), the axis of the world that points "
            "up, or turn the images",
        )
    return (
        f"the person leans by {leans:.0f} degrees or more in most images of camera {name}, which is taken "
        "to be level since no up is given; if the camera is rolled, or its video turned, and the "
        "person does not lie, give up (--up), the axis of the world that points up, or turn the images",
    )


def notes_on_upside_down_cameras(
    up: str | None, rotation: Float[Tensor, "C 3 3"]
) -> tuple[str, ...]:
    """Return a note if the axis that is said to point up points down in the images of all cameras.

    Args:
        up: "y" or "z", None if it is not known. rotation: from world to camera axes.
    """
    if up is None or not bool((rotation[:, 1, "xyz".index(up)] > _DOWN).all()):
        return ()
    return (
        "the axis that was given as up points down in all images: another axis points up, or the cameras' "
        "rotations are not those of a calibration (a camera without a rotation has y down); leave up (--up) "
        "out, or correct the rotations",
    )


def notes_on_up(up: str | None, joints: Float[Tensor, "T J 3"]) -> tuple[str, ...]:
    """Return a note if trunks are far from the axis that is said to point up.

    Args:
        up: "y" or "z", None if it is not known. joints: of the person, metres, world axes.
    """
    if up is None:
        return ()
    trunk = joints[:, BODY_15.joint("neck")] - joints[:, BODY_15.joint("pelvis")]
    cosine = trunk[:, "xyz".index(up)] / trunk.norm(dim=-1).clamp_min(1e-9)
    angle = float(torch.rad2deg(cosine.clamp(-1, 1).acos()).median())
    if angle < _LYING:
        return ()
    return (
        f"in half of the frames or more the trunk is {angle:.0f} degrees away from {up}, which was given as "
        "up; if the person is not lying down, another axis points up, and the files of --formats are turned "
        "too",
    )


def _lean(
    pixels: Float[Tensor, "T J 2"], there: Bool[Tensor, "T J"], top: str, low: tuple[str, str]
) -> float:
    """Return by how many degrees a joint is to the right above the middle of two, 0 if few frames tell.

    It is the median over frames.
    """
    joints = [BODY_15.joint(joint) for joint in (top, *low)]
    above, *below = pixels[there[:, joints].all(-1)][:, joints].unbind(1)
    if len(above) < _GAP:
        return 0.0
    axis = above - torch.stack(below).mean(0)
    return float(torch.rad2deg(torch.atan2(axis[:, 0], -axis[:, 1])).median())


def _runs(flags: Bool[Tensor, " T"]) -> list[tuple[int, int]]:
    """Return first and last index of each run of True."""
    runs, begin = [], None
    for t, flag in enumerate([*flags.tolist(), False]):
        if flag and begin is None:
            begin = t
        if not flag and begin is not None:
            runs.append((begin, t - 1))
            begin = None
    return runs
