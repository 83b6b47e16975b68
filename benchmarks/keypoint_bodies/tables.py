"""Tables of scores, by the number of cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tqdm.auto import tqdm

from benchmarks.keypoint_bodies.clips import ACTIONS, KINECT, MHAD, OTHER_KINECT, WALKS, Clip
from benchmarks.keypoint_bodies.methods import Method, row_of, takes
from benchmarks.keypoint_bodies.scoring import Score, score
from torchpose.evaluation import Report

_SETS = {WALKS: "walks", ACTIONS: "actions", MHAD: "MHAD", KINECT: "Kinect",
         OTHER_KINECT: "other Kinect"}  # fmt: skip
_MEASURES = {
    "all": "error", "rigid": "rigid", "with scale": "similar", "seldom seen": "unseen",
    "exchanged": "exchanged", "jitter": "jitter", "50 %": "inside_50", "90 %": "inside_90",
    "bones %": "bones", "true bones %": "true_bones", "none %": "without",
}  # fmt: skip
_DIGITS = (1, 1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 1, 1, 1)
_NOTE = (
    "Mean over clips; a method marked * has seen no later frame. 'rigid' and 'with scale': after the best "
    "motion of every frame. 'exchanged': joints whose left and right are exchanged in a camera. 'jitter': "
    "mean acceleration over that of the truth. '50 %' and '90 %': share of true joints inside of the "
    "ellipsoids. 'bones': standard deviation of their lengths over time. 'none': joints without a result."
)
_SEVERAL = (
    "Errors are in the axes of the room. 'seldom seen': joints that fewer than two cameras see. "
)
_ONE = (
    "Errors are relative to the pelvis, and so are ellipsoids. 'seldom seen': joints that the camera "
    "does not see. "
)


def score_clips(method: Method, clips: Sequence[Clip], cameras: int) -> list[Score]:
    """Return the scores of a method on clips in the first cameras of their rings."""
    seen = [clip.of_cameras(cameras) for clip in clips]
    return [score(method(*clip.given), clip) for clip in seen]


def add_table(
    report: Report,
    methods: Mapping[str, Method],
    clips: Mapping[str, Sequence[Clip]],
    cameras: int,
    title: str = "",
) -> None:
    """Add the table of a number of cameras, if a method takes so many.

    Args:
        report: gets the table. methods: by name; those that take another number are left out.
        clips: by set. cameras: how many. title: of the table; by default the number of cameras.
    """
    able = {name: method for name, method in methods.items() if takes(name, cameras)}
    if not able:
        return
    several = cameras > 1
    title = title or (f"{cameras} cameras (mm)" if several else "One camera (mm)")
    table = report.table(
        title, title, [*(_SETS[name] for name in clips), *_MEASURES],
        digits=_DIGITS[-len(clips) - len(_MEASURES) :], note=(_SEVERAL if several else _ONE) + _NOTE,
    )  # fmt: skip
    for name, method in tqdm(able.items(), desc=title):
        groups = [torch.tensor(score_clips(method, group, cameras)) for group in clips.values()]
        mean = Score(*torch.cat(groups).nanmean(0).tolist())
        errors = [float(group[:, Score._fields.index("error")].nanmean()) for group in groups]
        table.add(row_of(name), [*errors, *(getattr(mean, field) for field in _MEASURES.values())])
