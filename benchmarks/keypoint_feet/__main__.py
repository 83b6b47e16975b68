"""Feet from keypoints of one to four cameras: a tracker beside a fixed foot and triangulation.

The bodies, cameras and faults are those of `benchmarks.keypoint_bodies`, the first 80 frames of each clip.
A detector finds big toes too, with the same faults: those are the only points of feet that motion capture
has. Persons who are scored are not among those to whom the prior over feet was fitted. In the recording of
Pose2Sim heels and toes of every real camera are predicted from the others.

    python -m benchmarks.keypoint_feet --data DIR [--out FILE]
    python -m benchmarks.keypoint_feet --data DIR --fit FILE.safetensors

The second line fits the prior over feet that comes with torchpose.
"""

from __future__ import annotations

from pathlib import Path

import torch

from benchmarks._command import run_command
from benchmarks._table_file import TableFile, print_tables
from benchmarks.keypoint_bodies.clips import SCORED
from benchmarks.keypoint_feet.clips import begun, read_toed
from benchmarks.keypoint_feet.fit import fit_shipped
from benchmarks.keypoint_feet.tables import add_real_table, add_table
from torchpose.evaluation import Report

_RIGS = (4, 2, 1)
_FRAMES, _QUICK_FRAMES = 80, 10


def main(
    *,
    data: Path,
    threads: int = 2,
    out: TableFile | None = None,
    fit: Path | None = None,
    quick: bool = False,
) -> None:
    """Print the tables.

    Args:
        data: folder with the sets.
        threads: cores.
        out: file for the same as Markdown, or a folder.
        fit: file for the prior over feet, in place of the tables.
        quick: few and short clips, to see that it works.
    """
    torch.set_num_threads(threads)
    if fit is not None:
        fit_shipped(data, quick).save(fit)
        return
    names = {folder: chosen[:1] if quick else chosen for folder, chosen in SCORED.items()}
    frames = _QUICK_FRAMES if quick else _FRAMES
    clips = {
        folder: [begun(clip, frames) for clip in group]
        for folder, group in read_toed(data, names).items()
    }
    report = Report("Feet from keypoints")
    for cameras in _RIGS[::2] if quick else _RIGS:
        add_table(report, clips, cameras)
    add_real_table(report, data, frames if quick else None)
    print_tables(report, out)


if __name__ == "__main__":
    run_command(main)
