"""One camera whose height above the floor is known, rightly or wrongly.

In rings the floor is that of the recording. That of a Kinect is where s1 to s4 of UTD-MHAD stand, from whom
the lifters learned the place of this Kinect as well: the median of their lowest ankles, `_ANKLE` lower.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tqdm.auto import tqdm

from benchmarks.keypoint_bodies.clips import KINECT, KINECT_TRAINING, Clip, pair_of, recorded
from benchmarks.keypoint_bodies.methods import OURS, Method, row_of
from benchmarks.keypoint_bodies.scoring import Score, score
from torchpose.evaluation import Report

_HEIGHTS = {
    "": None,
    ", height": 0.0,
    ", 5 cm too high": 0.05,
    ", 5 cm too low": -0.05,
    ", 10 cm too high": 0.1,
    ", 10 cm too low": -0.1,
}
"""Rows of a method, and by how many metres their height is wrong; None is not given."""
_ANKLE = 0.09  # metres above the floor
_MEASURES = {"all": "error", "rigid": "rigid", "with scale": "similar", "50 %": "inside_50",
             "90 %": "inside_90"}  # fmt: skip


def height_of_kinect(data: Path) -> float:
    """Return the height of the Kinect of UTD-MHAD above the floor, metres."""
    lowest = [
        (-clip.joints[:, pair_of("ankle")].double() @ clip.up.double()).amax(-1)
        for clip in recorded(data / KINECT, KINECT_TRAINING)
    ]
    return float(torch.cat(lowest).median()) + _ANKLE


def add_height_table(
    report: Report,
    methods: Mapping[str, Method],
    clips: Sequence[Clip],
    title: str,
    height: float | None = None,
) -> None:
    """Add a table of one camera with a height that is known.

    Args:
        report: gets the table. methods: by name; those of `OURS` get the height as well.
        clips: in one camera. title: of the table.
        height: of the camera, metres; by default above where the recording has its floor.
    """
    table = report.table(
        title, title, [*_MEASURES], digits=(1, 1, 1, 0, 0),
        note="Errors are relative to the pelvis. A method marked * has seen no later frame. Where a height "
        "is given, so is `up`.",
    )  # fmt: skip
    for name, method in tqdm(methods.items(), desc=title):
        for label, wrong in (_HEIGHTS if name in OURS else {"": None}).items():
            scores = [_scored(method, clip, height, wrong) for clip in clips]
            mean = Score(*torch.tensor(scores).nanmean(0).tolist())
            table.add(
                f"{row_of(name)}{label}", [getattr(mean, field) for field in _MEASURES.values()]
            )


def _scored(method: Method, clip: Clip, height: float | None, wrong: float | None) -> Score:
    """Return the measures of a clip, with a height that is wrong by so much, or None."""
    options: dict[str, Any] = {}
    if wrong is not None:
        up = clip.up.abs().argmax()
        centre = -clip.rig.rotation[0].mT @ clip.rig.translation[0]
        known = float(centre @ clip.up) if height is None else height
        options = {"up": "xyz"[int(up)], "camera_height": known + wrong}
    return score(method(*clip.given, **options), clip)
