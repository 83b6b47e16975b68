"""Several bodies from keypoints: who is who, how well each is tracked, and what more persons cost.

Recorded walkers who pass each other within half a metre, in rings of cameras with a detector's faults
(`benchmarks.keypoint_bodies.clips`). A person who is half covered by another is not detected, and there are
detections of nobody.

    python -m benchmarks.keypoint_people --data DIR [--out FILE]
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from tqdm.auto import tqdm

from benchmarks._command import run_command
from benchmarks._table_file import TableFile, print_tables
from benchmarks.keypoint_people.clips import CHOOSING, QUARTET, SCORED, People, meet
from benchmarks.keypoint_people.methods import METHODS, milliseconds
from benchmarks.keypoint_people.scoring import PeopleScore, score_people
from torchpose.evaluation import Report

_RIGS = (4, 3, 2)
_WORDS = {2: "Two persons", 3: "Three persons"}
_MEASURES = {"mm": "error", "switches": "switches", "tracked": "tracked", "false": "false"}
_TIMED_FRAMES = 60
_TIMED = (1, 2, 4)
_NOTE = (
    "Mean over {} clips. 'mm': mean distance of joints of the persons who are tracked. 'switches': how often "
    "another track took a person over, in a clip. 'tracked': share of persons and frames with a track within "
    "0.3 m, %. 'false': bodies where nobody is, in % of persons and frames."
)


def main(
    *,
    data: Path,
    threads: int = 1,
    out: TableFile | None = None,
    seed: int = 0,
    choose: bool = False,
    quick: bool = False,
) -> None:
    """Print the tables.

    Args:
        data: folder with the sets.
        threads: cores.
        out: file for the same as Markdown, or a folder.
        seed: of cameras and faults.
        choose: the clips on which constants are chosen, in place of those that are scored.
        quick: one clip, to see that it works.
    """
    torch.set_num_threads(threads)
    report = Report("Several persons")
    groups = CHOOSING if choose else SCORED
    clips = [meet(data, group, seed) for group in (groups[:1] if quick else groups)]
    for count, title in _WORDS.items():
        chosen = [clip for clip in clips if clip.joints.shape[1] == count]
        if chosen:
            _add_table(report, title, chosen)
    _add_times(report, meet(data, QUARTET, seed, frames=_TIMED_FRAMES))
    print_tables(report, out)


def _add_table(report: Report, title: str, clips: Sequence[People]) -> None:
    columns = [f"{n}: {measure}" for n in _RIGS for measure in _MEASURES]
    table = report.table(
        title, title, columns, digits=(1, 1, 1, 1) * len(_RIGS), note=_NOTE.format(len(clips))
    )
    for name, method in METHODS.items():
        cells: list[float] = []
        for n in _RIGS:
            seen = [clip.of_cameras(n) for clip in clips]
            scores = torch.tensor(
                [score_people(method(clip), clip.joints)
                 for clip in tqdm(seen, desc=f"{title}, {n} cameras, {name}")]
            )  # fmt: skip
            mean = PeopleScore(*scores.nanmean(0).tolist())
            cells += [getattr(mean, field) for field in _MEASURES.values()]
        table.add(name, cells)


def _add_times(report: Report, clip: People) -> None:
    table = report.table(
        "time", "Time for a frame", ["1 person", "2 persons", "4 persons"], digits=(2, 2, 2),
        note=f"Filtered, {_TIMED_FRAMES} frames, least of three runs; ratio to one person.",
    )  # fmt: skip
    for n in (4, 2):
        taken = [milliseconds(clip.of_cameras(n), count) for count in tqdm(_TIMED, desc="time")]
        table.add(f"{n} cameras, ratio", [one / taken[0] for one in taken])
        table.add(f"{n} cameras, ms", taken)


if __name__ == "__main__":
    run_command(main)
