"""Cameras that are slightly wrong: delays and turned cameras, found from the keypoints of a body.

Recorded bodies in rings of cameras with a detector's faults (`benchmarks.keypoint_bodies.clips`), two scored
clips of each set, 80 frames. Cameras begin up to four frames too early or too late; or all but one are turned
by 1 degree about any axis and shifted by 2 cm; or both; or they are right. With `--faulty`, cameras are
much wrong: one stands still, was knocked over, or is mirrored, or all are turned; one clip of each set.

    python -m benchmarks.keypoint_cameras --data DIR [--out FILE]
    python -m benchmarks.keypoint_cameras --data DIR --faulty [--out FILE]
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from tqdm.auto import tqdm

from benchmarks._command import run_command
from benchmarks._table_file import TableFile, print_tables
from benchmarks.keypoint_bodies.clips import CHOOSING, SCORED, Clip, read_clips
from benchmarks.keypoint_cameras.disturbed import disturb
from benchmarks.keypoint_cameras.faulty import add_faulty_cameras
from benchmarks.keypoint_cameras.real import add_real_cameras
from benchmarks.keypoint_cameras.ways import WAYS, Errors, measure
from torchpose.evaluation import Report

_EACH = 2  # clips of a set
_RIGS = (4, 3, 2)
_KINDS = {
    "Delays": (True, False, "delays"),
    "Turned and shifted cameras": (False, True, "extrinsics"),
    "Delays, and turned and shifted cameras": (True, True, "both"),
    "Right cameras": (False, False, "both"),
}
_MEASURES = {"room mm": "room", "moved mm": "moved", "delay": "delay", "angle": "angle"}
_NOTE = (
    "Mean over clips. 'room': error of joints in the axes of the room. 'moved': after one rigid motion of "
    "the whole clip, which pixels do not tell. 'delay': mean error, frames. 'angle': mean error of rotations "
    "relative to the first camera, degrees."
)


def main(
    *,
    data: Path,
    threads: int = 2,
    out: TableFile | None = None,
    choose: bool = False,
    faulty: bool = False,
    quick: bool = False,
) -> None:
    """Print the tables.

    Args:
        data: folder with the sets.
        threads: cores.
        out: file for the same as Markdown, or a folder.
        choose: the clips on which constants are chosen, in place of those that are scored.
        faulty: the tables of cameras that are much wrong, in place of those of slightly wrong ones.
        quick: one clip, to see that it works.
    """
    torch.set_num_threads(threads)
    report = Report("Cameras that are slightly wrong")
    names = {k: v[:_EACH] for k, v in (CHOOSING if choose else SCORED).items()}
    if quick:
        names = {k: v[:1] for k, v in list(names.items())[:1]}
    clips = [clip for group in read_clips(data, names).values() for clip in group]
    if faulty:
        add_faulty_cameras(report, clips[::_EACH], [n for n in _RIGS if n > 2])
    else:
        for title, (late, turned, what) in _KINDS.items():
            _add_table(report, title, clips, late, turned, what)
        add_real_cameras(report, data)
    print_tables(report, out)


def _add_table(
    report: Report, title: str, clips: Sequence[Clip], late: bool, turned: bool, what: str
) -> None:
    columns = [f"{n}: {measure}" for n in _RIGS for measure in _MEASURES]
    table = report.table(title, title, columns, digits=(1, 1, 2, 2) * len(_RIGS), note=_NOTE)
    found: Mapping[str, list[float]] = {name: [] for name in WAYS}
    for count in _RIGS:
        chosen = [disturb(clip.of_cameras(count), late, turned) for clip in clips]
        for name, way in tqdm(WAYS.items(), desc=f"{title}, {count} cameras"):
            scores = torch.tensor([measure(way(clip, what), clip) for clip in chosen])
            mean = Errors(*scores.mean(0).tolist())
            found[name] += [getattr(mean, field) for field in _MEASURES.values()]
    for name, cells in found.items():
        table.add(name, cells)


if __name__ == "__main__":
    run_command(main)
