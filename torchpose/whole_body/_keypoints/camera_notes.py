"""Say which cameras the keypoints of a tracked body contradict, by what, and what was refined."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.camera._rig import CameraRig
from torchpose.whole_body._keypoints.camera_bundle import CameraErrors, adjust, by_pose
from torchpose.whole_body._keypoints.camera_refinement import (
    DELAY,
    RefinedCameras,
    free_errors,
    given_for,
)
from torchpose.whole_body._keypoints.keypoint_likelihood import Exchange, KeypointFrame

_FRAMES = 150  # at most, of those that are looked at
_WIDTHS = (12.0, 6.0, 3.0, 1.5, 1.0, 1.0)
_LEAST_DELAY = 0.5  # frames
_SURE_DELAY = 4.0  # standard deviations; right cameras have up to 3
_LEAST_TURN = 0.4  # degrees by which a camera sees joints elsewhere
_SURE_TURN = 8.0  # standard deviations; right cameras stay below 2, turned ones have 25 to 90
_WINDOW = 0.1  # seconds over which tracked joints are averaged before they give velocities


class CameraDoubts(NamedTuple):
    """Holds by what each of C cameras seems to be wrong.

    Attributes:
        delays, delay_std: [C], frames against the first camera. turns: [C], degrees by which the camera sees
            joints elsewhere than the other cameras have them, root mean square, if they are right.
        turn_sigmas: [C], that in standard deviations.
    """

    delays: Tensor
    delay_std: Tensor
    turns: Tensor
    turn_sigmas: Tensor


def doubt_cameras(
    rig: CameraRig,
    frames: KeypointFrame,
    joints: Float[Tensor, "T J 3"],
    fps: float,
    exchange: Exchange,
    turns: bool,
) -> CameraDoubts:
    """Return by what cameras seem to be wrong, from one adjustment about the tracked joints.

    Delays are those of all cameras together, with their poses free. Turns are those of one camera after the
    other, since which of several cameras are wrong is not told by keypoints.

    Args:
        rig: two cameras or more. frames: keypoints [T, C, J]. joints: tracked. fps: frames per second.
        exchange: of sides. turns: whether turns are looked for, else they are 0.
    """
    stride = max(1, len(joints) // _FRAMES)
    joints = _averaged(joints, max(1, round(_WINDOW * fps) // 2))
    none = CameraErrors.none(rig)
    start = none.values[:, DELAY]

    every = free_errors(len(rig), "both")
    given = given_for(frames, joints, start, every, fps, exchange, stride)

    def adjusted(free: Tensor) -> CameraErrors:
        return adjust(rig, given._replace(free=free), none, _WIDTHS).errors

    together = adjusted(every)
    angles, sigmas = torch.zeros_like(start), torch.zeros_like(start)
    there = frames.inlier[::stride] > 0
    for c in range(len(rig) if turns else 0):
        free = torch.zeros(len(rig), DELAY + 1, dtype=torch.bool)
        free[c] = True
        found = adjusted(free)
        error, rows = found.values[c], slice(c * (DELAY + 1), c * (DELAY + 1) + DELAY)
        moves = by_pose(rig.select([c]), joints[::stride])[:, 0][there[:, c]]
        if not len(moves):
            continue
        moved = (moves @ error[:DELAY]).norm(dim=-1).square().mean().sqrt()
        angles[c] = torch.rad2deg(moved / rig.matrix[c].diagonal()[:2].mean())
        pose, cov = error[:DELAY, None], found.cov[rows, rows]
        chi = (pose.mT @ torch.cholesky_solve(pose, torch.linalg.cholesky(cov))).sum()
        sigmas[c] = (chi / DELAY).sqrt()
    return CameraDoubts(together.values[:, DELAY], together.std[:, DELAY], angles, sigmas)


def sure_delays(doubts: CameraDoubts) -> Float[Tensor, " C"]:
    """Return delays, frames against the first camera, of cameras that surely have one, 0 of the others."""
    size = doubts.delays.abs()
    sure = (size > _LEAST_DELAY) & (size > _SURE_DELAY * doubts.delay_std)
    return torch.where(sure, doubts.delays, 0.0)


def notes_on_cameras(
    names: Sequence[str], doubts: CameraDoubts, explained: bool = False, refined: str = "none"
) -> tuple[str, ...]:
    """Return notes on cameras that are surely and much wrong, and which option corrects them.

    Args:
        names: of the cameras. doubts: about them, as they are refined. explained: whether something else than
            poses explains what cameras see. refined: which errors were asked to be estimated.
    """
    as_refined = "" if refined == "none" else ", as refined,"
    notes = [
        f"camera {names[c]}{as_refined} seems to have begun "
        f"{_in_words(doubts.delays[c], doubts.delay_std[c])} than {names[0]}; "
        f"{_correction('delays', refined)}"
        for c in sure_delays(doubts).nonzero().flatten().tolist()
    ]
    turned = (doubts.turns > _LEAST_TURN) & (doubts.turn_sigmas > _SURE_TURN)
    if bool(turned.any()) and not explained:
        c = int(torch.where(turned, doubts.turn_sigmas, 0).argmax())
        notes.append(
            f"camera {names[c]}{as_refined} sees joints {float(doubts.turns[c]):.1f} degrees away from where "
            "the others have them, so the pose of this or of another camera is wrong; "
            f"{_correction('extrinsics', refined)}"
        )
    return tuple(notes)


def _correction(kind: str, refined: str) -> str:
    """Return which option corrects a kind of errors where some were refined; delays depend on poses."""
    if refined == "both" or refined == kind == "extrinsics":
        return "refine found nothing that explains it; check the calibration and the frame rates"
    option = kind if refined == "none" else "both"
    return f'refine="{option}" (--refine {option}) corrects that in recordings of one person'


def notes_on_refined(names: Sequence[str], refined: RefinedCameras) -> tuple[str, ...]:
    """Return notes on what was corrected, with standard deviations; or that the cameras stay as given."""
    what = refined.what
    if refined.kept:
        return (
            f"refine={what!r} found nothing that explains the keypoints better: cameras as given",
        )
    values, std = refined.errors.values, refined.errors.std
    posed = what != "delays" and bool((values[:, :DELAY] != 0).any())
    notes = []
    if what == "both" and not posed:
        notes.append(
            f"refine={what!r} found no poses of cameras that explain the keypoints better: poses as given"
        )
    for c, name in enumerate(names):
        parts = []
        if what != "extrinsics" and c > 0:
            parts.append(f"began {_in_words(values[c, DELAY], std[c, DELAY])} than {names[0]}")
        if posed:
            turn, shift = values[c, :3].norm(), 100 * values[c, 3:DELAY].norm()
            parts.append(
                f"was turned by {_rounded(torch.rad2deg(turn), torch.rad2deg(std[c, :3].norm()), 2)} degrees "
                f"and shifted by {_rounded(shift, 100 * std[c, 3:DELAY].norm(), 1)} cm"
            )
        notes += [f"refined: camera {name} {' and '.join(parts)}"] if parts else []
    return tuple(notes)


def _in_words(delay: Tensor, std: Tensor) -> str:
    """Return a delay in words: who began too early has shown a moment in a later frame than others."""
    word = "earlier" if float(delay) > 0 else "later"
    return f"{_rounded(delay.abs(), std, 2)} frames {word}"


def _rounded(value: Tensor, std: Tensor, digits: int) -> str:
    return f"{float(value):.{digits}f} ± {float(std):.{digits}f}"


def _averaged(joints: Float[Tensor, "T J 3"], reach: int) -> Float[Tensor, "T J 3"]:
    """Return running means over so many frames before and after."""
    flat = joints.flatten(1).T[:, None]
    padded = torch.nn.functional.pad(flat, (reach, reach), mode="replicate")
    return torch.nn.functional.avg_pool1d(padded, 2 * reach + 1, 1)[:, 0].T.view_as(joints)
