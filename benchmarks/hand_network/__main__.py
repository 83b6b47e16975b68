"""Hands in video of persons that the network was not fitted to, beside what needs no network.

    python -m benchmarks.hand_network --data DIR --out FOLDER [--table FILE] [--pictures FOLDER]
    python -m benchmarks.hand_network --data DIR --out FOLDER --fit FILE.safetensors

The labels are MediaPipe's, as good as these are: a hand is seven tenths of the way from wrist to index
finger, is seen where its visibility is above 0.6 and it is in the image, and is not to be seen where that is
below 0.15 or the hand is below the image. Four fits leave three persons out each. Rendered performers, whose
truth is exact, are in every fit. The second line fits the network that comes with torchpose, to
everybody. FOLDER keeps rendered videos and fits: started again, the command goes on where it stopped.

Columns: visible hands, or elbows, that are measured within a quarter of the shoulder width; those that are
measured although they are not visible. The first 15 frames of a clip are not scored.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from benchmarks._command import run_command
from benchmarks._table_file import TableFile, print_tables
from benchmarks.hand_network.clips import (
    BURN_IN,
    FOLDS,
    LABELLED,
    PEOPLE,
    SIGNERS,
    Clip,
    Labels,
    Windows,
    measure,
    read_clips,
    render_clips,
    windows_of,
)
from benchmarks.hand_network.failures import Found, draw_failures
from benchmarks.hand_network.training import STEPS
from benchmarks.hand_network.training import fit as fit_network
from torchpose import PinholeCamera, VideoTracker, load_prior
from torchpose._core.files import check_output_folder
from torchpose.evaluation import Report
from torchpose.measure import HandTracker
from torchpose.measure._hand_network import HandNetwork, HandNetworkInfo
from torchpose.measure._hand_prior import HandPrior
from torchpose.skeleton import UPPER_BODY
from torchpose.video import open_video

_QUICK_STEPS = 3


class Score(NamedTuple):
    """Holds counts of hands, and the same of elbows.

    Attributes:
        right, seen: right ones, of those that are visible. invented, gone: measured ones, of those that
            are not visible.
    """

    right: Tensor
    seen: Tensor
    invented: Tensor
    gone: Tensor


def found_by(clip: Clip, network: HandNetwork | None) -> Found:
    """Return what a tracker with a network, or without (None), measures in a clip."""
    prior = HandPrior.from_prior(load_prior("kinect-upper-body"))
    with open_video(clip.path) as video:
        tracker, size = HandTracker(prior, fps=video.fps, network=network), video.size
    n_frames = len(clip.labels.nose)
    points = torch.full((n_frames, 2, 2, 2), torch.nan, dtype=torch.float64)
    measured = torch.zeros(n_frames, 2, 2, dtype=torch.bool)
    faces = torch.full((n_frames, 3), torch.nan, dtype=torch.float64)
    for t, _, hands, anchor in measure(clip, tracker):
        points[t] = torch.stack([hands.points, hands.elbows])
        measured[t] = torch.stack([hands.seen, hands.elbow_seen])
        faces[t] = anchor
    return Found(points, measured, faces, size)


def score(labels: Labels, found: Found) -> Score:
    """Return the counts of a clip."""
    away = (found.points - labels.centres.unflatten(1, (2, 2))).norm(dim=-1)
    seen = labels.seen.unflatten(1, (2, 2))[BURN_IN + 1 :]
    near, measured = (away < labels.width / 4)[BURN_IN + 1 :], found.measured[BURN_IN + 1 :]
    right, invented = near & measured & (seen == 1), measured & (seen == 0)
    counts = (right, seen == 1, invented, seen == 0)
    return Score(*(count.sum((0, 2)) for count in counts))


def elbow_error(clip: Clip, network: HandNetwork, elbows: bool) -> float:
    """Return the median distance of the poses' elbows from visible ones, in shoulder widths.

    Args:
        clip: with its labels. network: of the tracker. elbows: whether the tracker measures elbows.
    """
    labels = clip.labels
    centres, seen = labels.centres[:, 2:], labels.seen[:, 2:]
    with open_video(clip.path) as video:
        camera = PinholeCamera.from_image_size(*video.size)
        prior = load_prior("kinect-upper-body")
        tracker = VideoTracker(prior, camera, fps=video.fps, elbows=elbows)
        tracker.measurer.hand_tracker.network = network
        people = tracker(video)
    found = torch.full_like(centres, torch.nan)
    if people:
        rows = [UPPER_BODY.index(joint) for joint in LABELLED[2:]]
        joints = people[0].track.joints2d[0, : len(found) - people[0].first_frame, rows]
        found[people[0].first_frame :][: len(joints)] = joints
    away = (found - centres).norm(dim=-1)[BURN_IN + 1 :] / labels.width
    return float(away[seen[BURN_IN + 1 :] == 1].nanmedian())


@cache
def cached_windows(clip: Clip) -> Windows:
    """Return the windows of a clip, which are measured once and only if a fit needs them."""
    return windows_of(clip)


def fitted(clips: Sequence[Clip], path: Path, info: HandNetworkInfo, steps: int) -> HandNetwork:
    """Return the network of a file, or fit it and write the file."""
    if not path.is_file():
        windows = [(clip.person, cached_windows(clip)) for clip in clips]
        fit_network(windows, info, steps).save(path)
    return HandNetwork.load(path)


def facts(clips: Sequence[Clip], name: str, command: str) -> HandNetworkInfo:
    """Return what a network says about its fit."""
    return HandNetworkInfo(
        name=name,
        clips=tuple(clip.name for clip in clips),
        persons=tuple(sorted({clip.person for clip in clips})),
        licence="MIT; see the card for the clips",
        command=command,
    )


def add_table(
    report: Report, scores: dict[str, tuple[Score, ...]], errors: dict[str, list[float]]
) -> None:
    """Add the scores of all clips, without and with a network that was fitted without their persons.

    Args:
        report: of the benchmark. scores: without and with the network. errors: of the poses' elbows,
            not measured and measured, by clip.
    """
    kinds = ("right", "invented")
    columns = [f"{kind}, {tracker} (%)" for kind in kinds for tracker in ("grid", "learnt")]
    columns += [f"elbows {kind} (%)" for kind in kinds]
    columns += ["elbows of poses, inferred (widths)", "measured (widths)"]
    title = "Hands and elbows of persons left out"
    table = report.table("hands", title, columns, digits=(0,) * (len(columns) - 2) + (2, 2))

    def shares(s: Score) -> tuple[list[float], list[float]]:
        right, invented = 100 * s.right / s.seen, 100 * s.invented / s.gone
        return right.tolist(), invented.tolist()

    rows = {}
    for name, pair in scores.items():
        (right, invented), (own_right, own_invented) = (shares(s) for s in pair)
        hands = [right[0], own_right[0], invented[0], own_invented[0]]
        rows[name] = [*hands, own_right[1], own_invented[1], *errors[name]]
    for name, row in rows.items():
        table.add(name, row)
    for title, names in (("mean of strangers", PEOPLE), ("mean of signers", SIGNERS)):
        values = torch.tensor([rows[name] for name in names if name in rows])
        if len(values):
            table.add(title, values.nanmean(0))


def main(
    *,
    data: Path,
    out: Path,
    fit: Path | None = None,
    table: TableFile | None = None,
    pictures: Path | None = None,
    threads: int = 2,
    quick: bool = False,
) -> None:
    """Print the table, or fit the network that comes with torchpose.

    Args:
        data: folder with the clips.
        out: folder for what is kept.
        fit: file for a network that is fitted to everybody.
        table: file for the table, or a folder.
        pictures: folder for drawings of the hands that are wrong.
        threads: cores.
        quick: two clips and no fit worth its name.
    """
    torch.set_num_threads(threads)
    check_output_folder(out)
    clips = read_clips(data, ("akstheme_gesture", "milk") if quick else ())
    rendered = render_clips(out)
    steps = STEPS
    if quick:
        rendered, steps = rendered[:1], _QUICK_STEPS
    labelled = [*clips, *rendered]
    if fit is not None:
        command = (
            "python -m benchmarks.hand_network --data DIR --out FOLDER --fit hands.safetensors"
        )
        windows = [(clip.person, cached_windows(clip)) for clip in labelled]
        fit_network(windows, facts(labelled, "hands", command), steps).save(fit)
        return
    found: dict[str, tuple[Found, Labels]] = {}
    scores: dict[str, tuple[Score, ...]] = {}
    errors: dict[str, list[float]] = {}
    for number, persons in enumerate(FOLDS):
        left_out = [clip for clip in clips if clip.person in persons]
        if not left_out:
            continue
        known = [clip for clip in labelled if clip.person not in persons]
        info = facts(known, f"without {', '.join(persons)}", "")
        network = fitted(known, out / f"fold-{number}.safetensors", info, steps)
        for clip in left_out:
            found[clip.name] = found_by(clip, network), clip.labels
            both = found_by(clip, None), found[clip.name][0]
            scores[clip.name] = tuple(score(clip.labels, measured) for measured in both)
            errors[clip.name] = [elbow_error(clip, network, measured) for measured in (False, True)]
    report = Report("Hands of persons left out")
    add_table(report, scores, errors)
    print_tables(report, table)
    if pictures is not None:
        for kind, count, path in draw_failures(pictures, found):
            print(f"{kind}: {count} hands, {path}")


if __name__ == "__main__":
    run_command(main)
