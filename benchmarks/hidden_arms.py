"""Arms that are hidden for some frames, beside the simplest ways to fill a gap.

Recordings are seen by one camera with 3 px of noise (as in `unseen_sets`, whose priors do not know them), and
keypoints are taken away:

- "third": every third frame; "bursts": a quarter of the frames, 6 at a time; "long": two fifths, 20 at a
  time;
- "arm": elbow and hand of each arm in three tenths of its frames, 8 at a time; "long arm": in half of them,
  30 at a time;
- "hand", "elbow": as "arm", but one of the two.

    python -m benchmarks.hidden_arms --data DIR [--smoothed] [--method NAME] [--every 4] [--out FILE]

A row for each set and kind of gap. The error is that of the vector from the shoulder to the hand, for "elbow"
to the elbow, in camera axes, nothing aligned; in the image it is that of the joint itself. The simplest way
is, without later frames, the pose (the keypoint) when the joint was last seen; with them the straight line
between the poses (the keypoints) before and after the gap.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from benchmarks import bones
from benchmarks._command import OneOf, run_command
from benchmarks._table_file import TableFile, print_tables
from benchmarks.unseen_sets import NAMES, Unseen, leave_out
from torchpose import PoseTrack
from torchpose.evaluation import Report
from torchpose.evaluation._report import Table
from torchpose.metrics import coverage
from torchpose.skeleton._joint_sets import canonical_names

_UTD, _BURKE, _LABAN, _MHAD = NAMES
_SETS = {
    "s5 and s6 of UTD-MHAD": (_UTD, ("s5", "s6")),
    "kinect_laban": (_LABAN, ()),
    "s9 to s12 of Berkeley MHAD": (_MHAD, ()),
    "s7 and s8 of UTD-MHAD": (_UTD, ("s7", "s8")),
    "burke_kinect": (_BURKE, ()),
}
_LIMBS = {"elbow": ("elbow",), "hand": ("hand", "wrist"), "arm": ("elbow", "hand", "wrist")}


class _Kind(NamedTuple):
    """Gaps of one kind: `frames` of `period` frames in which a limb, or everything, is hidden."""

    limb: str | None
    frames: int
    period: int


KINDS = {
    "third": _Kind(None, 1, 3),
    "bursts": _Kind(None, 6, 24),
    "long": _Kind(None, 20, 50),
    "arm": _Kind("arm", 8, 27),
    "long arm": _Kind("arm", 30, 60),
    "hand": _Kind("hand", 8, 27),
    "long hand": _Kind("hand", 30, 60),
    "elbow": _Kind("elbow", 8, 27),
}
"""Kinds of gaps."""
_SEEN_FIRST = 10  # frames
_COLUMNS = (
    "all frames (cm)", "in gaps (cm)", "simplest way (cm)", "in gaps (px)", "simplest way (px)",
    "inside 50 %", "inside 90 %",
)  # fmt: skip
_DIGITS = (1, 1, 1, 1, 1, 0, 0)


def hidden(view: bones.View, kind: str, number: int) -> Bool[Tensor, "T J"]:
    """Return which keypoints of a recording are taken away.

    Args:
        view: the recording. kind: of the gaps. number: of the recording, by which gaps are elsewhere.
    """
    limb, frames, period = KINDS[kind]
    names = canonical_names(view.names)
    gone = torch.zeros(len(view.keypoints), len(names), dtype=torch.bool)
    time = torch.arange(len(gone))
    for side, phase in (("left", 0), ("right", 0 if limb is None else period // 2)):
        start = (7 * number + phase) % period
        inside = ((time - _SEEN_FIRST - start) % period < frames) & (time >= _SEEN_FIRST)
        for row, name in enumerate(names):
            if limb is None or (name.endswith(side) and name.split("_")[0] in _LIMBS[limb]):
                gone[:, row] |= inside
    return gone


def filled(
    values: Float[Tensor, "T 2 D"], gone: Bool[Tensor, "T 2"], later: bool
) -> Float[Tensor, "T 2 D"]:
    """Return values with those in gaps as they were last, or on the straight line to the next ones.

    Args:
        values: of left and right. gone: which are in gaps. later: whether next ones are known; past the last
            of them the last one stays.
    """
    time = torch.arange(len(gone))[:, None].expand_as(gone)
    before = time.where(~gone, 0).cummax(0).values
    after = time.where(~gone, len(gone)).flip(0).cummin(0).values.flip(0)
    after = torch.where(after < len(gone), after, before) if later else before
    share = (time - before) / (after - before).clamp_min(1)
    sides = torch.arange(2)
    return values[before, sides].lerp(values[after, sides], share[..., None].to(values))


class _Ends(NamedTuple):
    """Elbows, or hands, of left and right that are scored, [T, 2, ...].

    Attributes:
        vectors: from the shoulder, camera axes, metres. places: in the image.
    """

    vectors: Tensor
    places: Tensor


def scored(
    view: bones.View, poses: PoseTrack, gone: Bool[Tensor, "T J"], kind: str, later: bool
) -> list[float]:
    """Return a row for a recording.

    Args:
        view: what was seen. poses: of a tracker. gone: the keypoints that it was not given, because of gaps
            of this kind. later: whether it knows later frames.
    """
    end = 1 if kind == "elbow" else 2  # of shoulder, elbow and hand
    rows = [arm[end] for arm in bones.arm_rows(view.names)]
    joints, covs = poses.joints3d[0], poses.covariance3d[0]
    arms = joints[:, bones.ENDS]
    own = [arm[end] for arm in bones.ENDS]
    found = _Ends(arms[:, :, end] - arms[:, :, 0], poses.joints2d[0][:, own])
    homogeneous = view.truth[:, :, end] @ view.camera.matrix.mT
    true = _Ends(
        view.truth[:, :, end] - view.truth[:, :, 0], homogeneous[..., :2] / homogeneous[..., 2:]
    )
    gaps = gone[:, rows]
    simple = _Ends(filled(found.vectors, gaps, later), filled(view.keypoints[:, rows], gaps, later))
    known = true.vectors.isfinite().all(-1)
    inside = gaps & known
    errors = [
        100 * _distance(found.vectors, true.vectors, known),
        100 * _distance(found.vectors, true.vectors, inside),
        100 * _distance(simple.vectors, true.vectors, inside),
        _distance(found.places, true.places, inside),
        _distance(simple.places, true.places, inside),
    ]
    middles = [x[:, :, 0].mean(1, keepdim=True) for x in (arms, view.truth)]
    held = coverage(
        arms[:, :, end] - middles[0], covs[:, own], view.truth[:, :, end] - middles[1], mask=inside
    )
    return [*errors, *(100 * held.overall).tolist()]


def _distance(ours: Tensor, theirs: Tensor, chosen: Tensor) -> float:
    return float((ours - theirs).norm(dim=-1)[chosen].mean())


def add_rows(table: Table, name: str, unseen: Unseen, method: str, smoothed: bool) -> None:
    """Add a row for each kind of gap in the recordings of a set.

    Args:
        table: of all sets. name: of the set, or of persons in it. unseen: its recordings, and priors that do
            not know them. method: of the tracker. smoothed: whether it knows all later frames.
    """
    options = bones.trackers(unseen.arms, unseen.network)[method] | {
        "smoothing": "full" if smoothed else None
    }
    for kind in KINDS:
        rows = []
        for number, view in enumerate(unseen.views):
            gone = hidden(view, kind, number)
            seen = view._replace(confidence=view.confidence.masked_fill(gone, 0.0))
            poses = bones.poses_of(seen, unseen.prior, None, **options)
            rows.append(scored(view, poses, gone, kind, smoothed))
        table.add(f"{name}: {kind}", torch.tensor(rows).nanmean(0))


def left_out(data: Path, quick: bool) -> Iterator[tuple[str, Unseen]]:
    """Yield the recordings of each set, with the priors that do not know it.

    Args:
        data: folder with the sets. quick: one set, few recordings, and the priors that come with torchpose.
    """
    known: dict[str, Unseen] = {}
    for name, (folder, persons) in _SETS.items():
        if quick and folder != _MHAD:
            continue
        unseen = known[folder] = known.get(folder) or leave_out(data, folder, quick, ())
        if persons:
            unseen = unseen._replace(views=bones.kinect_views(data, persons=persons))
        yield name, unseen


def main(
    *,
    data: Path,
    method: Annotated[str, OneOf(bones.METHODS)] = "articulated",
    smoothed: bool = False,
    every: int = 1,
    threads: int = 2,
    out: TableFile | None = None,
    quick: bool = False,
) -> None:
    """Print the table.

    Args:
        data: folder with the sets.
        method: of the tracker.
        smoothed: whether it knows all later frames.
        every: one recording in so many.
        threads: cores.
        out: file for the same as Markdown, or a folder.
        quick: one set, few recordings.
    """
    torch.set_num_threads(threads)
    report = Report("Arms that are hidden for some frames")
    title = f"{method}, {'smoothed' if smoothed else 'without later frames'}"
    table = report.table("hidden", title, _COLUMNS, digits=_DIGITS)
    for name, unseen in left_out(data, quick):
        some = unseen._replace(views=unseen.views[::every])
        add_rows(table, name, some, method, smoothed)
    print_tables(report, out)


if __name__ == "__main__":
    run_command(main)
