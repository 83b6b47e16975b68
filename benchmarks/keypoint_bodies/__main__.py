"""Whole bodies from keypoints of one to four cameras: a tracker beside triangulation and learned lifters.

Recorded bodies (walks and actions of CMU, Berkeley MHAD) are seen by rings of cameras of 1920 x 1080 pixels
at 3 to 5 m, through a detector with 4 px of noise, 10 % missing in bursts, 5 % outliers, and left and right
exchanged in 3 % of the frames. Persons who are scored are not among those on whom constants were chosen,
or methods learned. Persons whom a Kinect recorded are seen by one camera in its place; lifters learned from
others in the same place, and from nobody in the place of the other Kinect. In the recording of
Pose2Sim a person is seen by four real cameras: every one is predicted from the others.

    python -m benchmarks.keypoint_bodies --data DIR [--out FILE] [--methods NAME ...] [--lifters FILE]
    python -m benchmarks.keypoint_bodies --data DIR --noise-alone --methods kalman kalman-smoothed pose2sim
    python -m benchmarks.keypoint_bodies --data DIR --heights [--lifters FILE]
    python -m benchmarks.keypoint_bodies --data DIR --sitting [--lifters FILE]
    python -m benchmarks.keypoint_bodies --data DIR --lying [--lifters FILE]
    python -m benchmarks.keypoint_bodies --data DIR --desk
    python -m benchmarks.keypoint_bodies --data DIR --hidden
    python -m benchmarks.keypoint_bodies --data DIR --uncalibrated [--lifters FILE]
    python -m benchmarks.keypoint_bodies --data DIR --choose
    python -m benchmarks.keypoint_bodies --data DIR --fit FILE.safetensors [--upper-body]

The second line shows what noise costs by itself, in several cameras. The third tells one camera how high it
is. The fourth shows people who sit to one camera, the fifth people who lie. The sixth shows people whose
hips and legs are hidden to two cameras. The seventh hides joints in all cameras for some frames. The eighth
tilts a camera that nobody calibrated. The ninth prints what the constants of the filters of single joints
were chosen by. The tenth fits a network that comes with torchpose and lifts the keypoints of one camera.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import torch

from benchmarks._command import OneOf, run_command
from benchmarks._table_file import TableFile, print_tables
from benchmarks.keypoint_bodies.camera_heights import add_height_table, height_of_kinect
from benchmarks.keypoint_bodies.choosing import add_choices
from benchmarks.keypoint_bodies.clips import (
    CHOOSING,
    FAULTS,
    KINECT,
    KINECT_SCORED,
    NOISE_ALONE,
    OTHER_KINECT,
    RIGS,
    SCORED,
    Clip,
    Faults,
    begun,
    read_clips,
    read_kinect,
)
from benchmarks.keypoint_bodies.desk import add_desk_table
from benchmarks.keypoint_bodies.hidden import add_hidden_table
from benchmarks.keypoint_bodies.lifting import fit_shipped, fit_upper_body
from benchmarks.keypoint_bodies.lying import add_lying_table
from benchmarks.keypoint_bodies.methods import LIFTERS, METHODS, OURS, Method, methods_of
from benchmarks.keypoint_bodies.real import add_real_table
from benchmarks.keypoint_bodies.sitting import add_sitting_table
from benchmarks.keypoint_bodies.tables import add_table
from benchmarks.keypoint_bodies.tilts import add_tilt_tables
from torchpose.evaluation import Report

_ALL = (*METHODS, *LIFTERS)
_KINECT_TITLE = "One camera, persons of a Kinect (mm)"
_KINECT_HEIGHT_TITLE = "One camera of known height, persons of a Kinect (mm)"
_OTHER_TITLE = "One camera, a person of another Kinect (mm)"


def main(
    *,
    data: Path,
    methods: Annotated[Sequence[str], OneOf(_ALL)] = _ALL,
    lifters: Path | None = None,
    threads: int = 2,
    out: TableFile | None = None,
    noise_alone: bool = False,
    heights: bool = False,
    sitting: bool = False,
    lying: bool = False,
    desk: bool = False,
    hidden: bool = False,
    uncalibrated: bool = False,
    choose: bool = False,
    fit: Path | None = None,
    upper_body: bool = False,
    quick: bool = False,
) -> None:
    """Print the tables.

    Args:
        data: folder with the sets.
        methods: rows; all without it.
        lifters: file for the weights of the learned lifters, read if it is there, else written.
        threads: cores.
        out: file for the same as Markdown, or a folder.
        noise_alone: whether keypoints have noise and nothing else, in several cameras only.
        heights: whether one camera is told how high it is, in place of the tables.
        sitting: whether people sit, seen by one camera, in place of the tables.
        lying: whether people lie, seen by one camera, in place of the tables.
        desk: whether hips and legs are hidden to two cameras, in place of the tables; of methods `OURS`.
        hidden: whether all cameras miss joints for some frames, in place of the tables; of `kalman` alone.
        uncalibrated: whether one camera is tilted and nobody has calibrated it, in place of the tables; with
            the lifters of methods beside the filter.
        choose: print the errors of several constants on the clips for that, in place of the tables.
        fit: file for the network that lifts keypoints of one camera, in place of the tables.
        upper_body: fit that for upper bodies, which goes on from the one for whole bodies.
        quick: few and short clips, to see that it works.
    """
    torch.set_num_threads(threads)
    if fit is not None:
        (fit_upper_body if upper_body else fit_shipped)(data, quick).save(fit)
        return

    def those(names: Sequence[str]) -> dict[str, Method]:
        return methods_of([name for name in methods if name in names], data, lifters, quick)

    def rings(names: Mapping[str, Sequence[str]]) -> dict[str, list[Clip]]:
        return _rings(data, names, NOISE_ALONE if noise_alone else FAULTS, quick)

    report, of_one_camera = Report("Whole bodies from keypoints"), (*OURS, *LIFTERS)
    if desk:
        add_desk_table(report, those(OURS), data, quick)
    elif hidden:
        add_hidden_table(report, data, quick)
    elif uncalibrated:
        add_tilt_tables(report, those(LIFTERS), data, quick)
    elif choose:
        add_choices(report, rings(CHOOSING))
    elif sitting:
        add_sitting_table(report, those(of_one_camera), data, quick)
    elif lying:
        add_lying_table(report, those(of_one_camera), data, quick)
    elif heights:
        _add_heights(report, those(of_one_camera), rings(SCORED), data, quick)
    else:
        every, clips = those(_ALL), rings(SCORED)
        for cameras in (count for count in RIGS if count > 1 or not noise_alone):
            add_table(report, every, clips, cameras)
        if not noise_alone:
            _add_recorded_views(report, every, data, quick)
    print_tables(report, out)


def _rings(
    data: Path, names: Mapping[str, Sequence[str]], faults: Faults, quick: bool
) -> dict[str, list[Clip]]:
    """Return recordings in rings of cameras, by set."""
    if not quick:
        return read_clips(data, names, faults=faults)
    clips = read_clips(data, {folder: some[:1] for folder, some in names.items()}, faults=faults)
    return {folder: [begun(clip) for clip in group] for folder, group in clips.items()}


def _add_heights(
    report: Report,
    methods: Mapping[str, Method],
    clips: Mapping[str, Sequence[Clip]],
    data: Path,
    quick: bool,
) -> None:
    """Add the tables of one camera whose height is known."""
    rings = [clip.of_cameras(1) for group in clips.values() for clip in group]
    add_height_table(report, methods, rings, "One camera of known height (mm)")
    kinect = read_kinect(data, KINECT_SCORED[:1] if quick else KINECT_SCORED)
    height = height_of_kinect(data)
    add_height_table(report, methods, kinect, _KINECT_HEIGHT_TITLE, height)


def _add_recorded_views(
    report: Report, methods: Mapping[str, Method], data: Path, quick: bool
) -> None:
    """Add the tables of persons whom a Kinect recorded, and of real cameras."""
    kinect = read_kinect(data, KINECT_SCORED[:1] if quick else KINECT_SCORED)
    add_table(report, methods, {KINECT: kinect}, 1, _KINECT_TITLE)
    other = read_kinect(data, ("Ges01*",) if quick else ("*",), folder=OTHER_KINECT)
    add_table(report, methods, {OTHER_KINECT: other}, 1, _OTHER_TITLE)
    add_real_table(report, methods, data, quick)


if __name__ == "__main__":
    run_command(main)
