"""Part of the protocol Bend: a view in which one arm hides the other (Figure 5 of the paper)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.bend.tracking import TRACKING, BendRun, grid_of
from benchmarks.bend.variants import BendPerson, Variant
from benchmarks.bodies.views import View, subjects_of
from benchmarks.engine import Results, Setting
from torchpose.body import BODY_15, Limbs, fit_state
from torchpose.evaluation import Report
from torchpose.whole_body._silhouettes.rendering import render_limbs

SIDE = 90.0
"""Where the camera stands, degrees from ahead, to the person's left: the right arm is the far one."""

HIDDEN = 0.15
"""A frame hides the arm if no more of its area lies outside of the rest of the body."""

SWING = -0.38
"""Sine of half the angle by which the lost arm is swung forward."""

_MOMENTS = {"0 s": 0.0, "0.5 s": 0.5, "1 s": 1.0, "2 s": 2.0}
_ARM = {
    side: [BODY_15.joint(f"{side}_{j}") for j in ("elbow", "wrist")] for side in ("left", "right")
}
_LIMBS = tuple(limb.name for limb in BODY_15.limbs)


class HiddenArm(NamedTuple):
    """One sequence: visible share of the far arm [T]; errors of the far and the near arm [S, T], mm."""

    name: str
    visible: Tensor
    far: dict[str, Tensor]
    near: dict[str, Tensor]


def visible_share(tracked: BendPerson, view: View) -> Float[Tensor, " T"]:
    """Return the share of the right arm's area in the image that no other limb covers, by the true states.

    |arm without rest| / |arm|: where it is small a silhouette says nothing about the arm.
    """
    limbs = tracked.body.limbs(fit_state(tracked.body, view.clip.joints))
    arm = [i for i, name in enumerate(_LIMBS) if name in ("right_upper_arm", "right_forearm")]
    rest = [i for i in range(len(_LIMBS)) if i not in arm]
    height, width = view.silhouettes.shape[-2:]
    drawn = [
        render_limbs(
            Limbs(limbs.start[:, rows], limbs.end[:, rows], limbs.radii[rows]),
            view.rig, height, width,
        )[:, 0]
        for rows in (arm, rest)
    ]  # fmt: skip
    area = drawn[0].sum((-1, -2)).double()
    return (drawn[0] & ~drawn[1]).sum((-1, -2)).double() / area.clamp_min(1)


def arm_errors(runs: Sequence[BendRun], side: str) -> Float[Tensor, "S T"]:
    """Return the mean distance of elbow and wrist, mm, of every seed and frame."""
    return torch.stack([run.errors[:, _ARM[side]].double().mean(-1) for run in runs])


def displaced(tracked: BendPerson, view: View) -> Float[Tensor, " D"]:
    """Return the true first pose, but with the far arm swung by a quarter of a turn, as if lost."""
    part = BODY_15.part("right_upper_arm")
    step = torch.zeros_like(view.initial_state)
    step[3 + 3 * part] = SWING
    return tracked.body.perturb(view.initial_state, step)


def with_lost_arm(tracked: BendPerson) -> BendPerson:
    """Return the same person, tracked from `displaced` first poses."""
    tests = [view._replace(initial_state=displaced(tracked, view)) for view in tracked.tests]
    return replace(tracked, tests=tuple(tests))


def hidden_arms(
    tracked_persons: Sequence[BendPerson], settings: Mapping[Variant, Setting], folder: Path,
    seeds: Sequence[int], progress: bool,
) -> tuple[list[HiddenArm], Results]:  # fmt: skip
    """Track everybody from the side, and measure both arms.

    Args:
        tracked_persons: seen from `SIDE`. settings: of every tracker. folder: of kept runs.
        seeds: of the runs. progress: whether to show a bar.
    """
    grid = grid_of(tracked_persons, settings)
    runs = TRACKING.run({"": grid}, seeds, folder, progress=progress, title="hidden arm")
    found = []
    for name, subject in subjects_of(tracked_persons).items():
        far, near = (
            {
                label: arm_errors(own.runs, side)
                for (label,), own in runs.where(subject=name).by("method").items()
            }
            for side in ("right", "left")
        )
        found.append(HiddenArm(name, visible_share(subject.person, subject.view), far, near))
    return found, runs


def add_occlusion(
    report: Report, given: Sequence[HiddenArm], lost: Sequence[HiddenArm], fps: float
) -> None:
    """Add errors of both arms while the far one is hidden and while it shows, and how a lost arm returns.

    Args:
        report: gets a table and a sentence for each tracker. given: runs from the true first pose.
        lost: runs from `displaced`. fps: frames per second.
    """
    length = min(len(arm.visible) for arm in given)
    moments = [(text, round(s * fps)) for text, s in _MOMENTS.items() if s * fps < length - 3]
    table = report.table(
        "occlusion", "From the side: error of elbow and wrist (mm), mean over sequences and seeds",
        ["far, hidden", "far, visible", "near", "far, at its worst", "far, at the end",
         *(f"lost, {text}" for text, _ in moments)],
        note=f"The camera stands at {SIDE:g} degrees, beside the person; the right arm is the far "
        f"one. Hidden: frames in which no more than {100 * HIDDEN:.0f} % of its area lies outside of "
        f"the other limbs ({_share(given):.0f} % of all). At its worst: the worst frame of the mean "
        "over seeds; at the end: the last half second. Lost: the far arm starts swung by a quarter "
        "of a turn; after so many seconds.",
    )  # fmt: skip
    end = max(round(fps / 2), 1)
    for label in given[0].far:
        worst = [a.far[label].mean(0).amax(keepdim=True) for a in given]
        cells = [
            _mean([a.far[label][:, a.visible <= HIDDEN] for a in given]),
            _mean([a.far[label][:, a.visible > HIDDEN] for a in given]),
            _mean([a.near[label] for a in given]), _mean(worst),
            _mean([a.far[label][:, -end:] for a in given]),
            *(_mean([a.far[label][:, t : t + 3] for a in lost]) for _, t in moments),
        ]  # fmt: skip
        table.add(label, cells)
        returned = (
            f" A lost arm is off by {cells[5]:.0f} mm at first and {cells[-1]:.0f} mm "
            f"{moments[-1][0]} later."
        )
        report.findings.append(
            f"{label}: the far arm is off by {cells[0]:.0f} mm while hidden and {cells[1]:.0f} mm "
            f"while visible, the near arm by {cells[2]:.0f} mm; from {cells[3]:.0f} mm at its worst it "
            f"comes to {cells[4]:.0f} mm at the end." + (returned if len(moments) > 1 else "")
        )


def _share(arms: Sequence[HiddenArm]) -> float:
    return 100 * float(torch.cat([a.visible <= HIDDEN for a in arms]).double().mean())


def _mean(values: Sequence[Tensor]) -> float:
    flat = torch.cat([v.flatten() for v in values])
    return float(flat.mean()) if len(flat) else float("nan")
