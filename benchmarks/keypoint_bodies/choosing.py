"""Constants of the filters of single joints, by their errors on the clips for that."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks.keypoint_bodies.clips import RIGS, Clip
from benchmarks.keypoint_bodies.joint_filters import (
    Filtered,
    Settings,
    filter_pixels,
    filter_points,
)
from benchmarks.keypoint_bodies.methods import Method
from benchmarks.keypoint_bodies.scoring import Estimate, Score
from benchmarks.keypoint_bodies.tables import score_clips
from torchpose.camera import CameraRig
from torchpose.evaluation import Report

_ACCELERATIONS = (3.0, 10.0, 30.0, 100.0)  # m^2/s^3
_NOISES = {filter_points: (0.02, 0.04, 0.08), filter_pixels: (6.0, 12.0, 24.0)}  # metres; pixels
_INSIDE = [Score._fields.index(field) for field in ("inside_50", "inside_90")]
_SEVERAL = [cameras for cameras in RIGS if cameras > 1]


def add_choices(report: Report, clips: Mapping[str, Sequence[Clip]]) -> None:
    """Add a table for each filter: errors and coverage of several constants.

    Args:
        report: gets the tables. clips: by set.
    """
    columns = [*(f"{n} cameras" for n in _SEVERAL), "mean", "50 %", "90 %"]
    flat = [clip for group in clips.values() for clip in group]
    for run, noises in _NOISES.items():
        title = f"{run.__name__}: acceleration (m^2/s^3), noise; mean error (mm)"
        table = report.table(run.__name__, title, columns)
        for values in tqdm(list(itertools.product(_ACCELERATIONS, noises)), desc=run.__name__):
            method = _filtered(run, Settings(*values))
            scores = torch.tensor([score_clips(method, flat, n) for n in _SEVERAL]).nanmean(1)
            inside = scores[:, _INSIDE].mean(0).tolist()
            errors = scores[:, 0].tolist()
            table.add(
                f"{values[0]:g}, {values[1]:g}", [*errors, sum(errors) / len(errors), *inside]
            )


def _filtered(run: Callable[..., Filtered], settings: Settings) -> Method:
    """Return a filter with its noise as a method."""

    def method(rig: CameraRig, keypoints: Tensor, confidence: Tensor, fps: float) -> Estimate:
        return Estimate(*run(rig, keypoints, confidence, fps, settings))

    return method
