"""Tables of toes against recorded ones, and of heels and toes against a real camera that was left out."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks.keypoint_bodies.clips import ACTIONS, MHAD, WALKS
from benchmarks.keypoint_bodies.methods import row_of
from benchmarks.keypoint_bodies.real import read_filmed, undistorted
from benchmarks.keypoint_feet.clips import TOES, ToedClip
from benchmarks.keypoint_feet.methods import CAUSAL, METHODS, FootEstimate, estimates_of
from torchpose._core.reading import read_npz
from torchpose.body import BODY_15
from torchpose.body._feet import ANKLES, FEET, foot_points
from torchpose.evaluation import Report
from torchpose.metrics import coverage

__all__ = ["add_real_table", "add_table"]

_SETS = {WALKS: "walks", ACTIONS: "actions", MHAD: "MHAD"}
_POINTS = [FEET.index(name) for name in TOES]
_MEASURES = ("all", "from the ankle", "seldom seen", "50 %", "90 %")
_SURE = 0.5  # confidence from which a keypoint of the camera left out counts
_QUICK_EVERY = 5  # choices of cameras, of which a quick run takes one
_PELVIS = BODY_15.joint("pelvis")
_NOTE = (
    "Mean over clips; a method marked * has seen no later frame. 'from the ankle': error of the line from "
    "the ankle to the toe. '50 %' and '90 %': share of true toes inside of the ellipsoids. "
)


class _Score(NamedTuple):
    """Mean distance of toes, mm; of the lines from the ankles; of toes seldom seen; shares in ellipsoids."""

    error: float
    away: float
    unseen: float
    half: float
    most: float


def add_table(report: Report, clips: Mapping[str, Sequence[ToedClip]], cameras: int) -> None:
    """Add the table of a number of cameras.

    Args:
        report: gets the table. clips: by set. cameras: how many, the first ones of each ring.
    """
    scores: dict[str, dict[str, list[_Score]]] = defaultdict(lambda: defaultdict(list))
    every = [(folder, clip) for folder, group in clips.items() for clip in group]
    title = f"{cameras} cameras: big toes (mm)" if cameras > 1 else "One camera: big toes (mm)"
    for folder, whole in tqdm(every, desc=title):
        clip = whole.of_cameras(cameras)
        body = clip.body
        found = estimates_of(body.rig, *_with_toes(clip), body.fps)
        for name, estimate in found.items():
            scores[name][folder].append(_score(estimate, clip))
    several = "'seldom seen': toes that fewer than two cameras see."
    one = (
        "Errors are relative to the pelvis, ellipsoids in the axes of the room. 'seldom seen': toes that "
        "the camera does not see."
    )
    table = report.table(
        title, title, [*(_SETS[name] for name in clips), *_MEASURES],
        note=_NOTE + (several if cameras > 1 else one),
    )  # fmt: skip
    for name in METHODS:
        if name in scores:
            groups = [torch.tensor(scores[name][folder]) for folder in clips]
            mean = torch.cat(groups).nanmean(0).tolist()
            table.add(
                row_of(name, CAUSAL), [*(float(group[:, 0].nanmean()) for group in groups), *mean]
            )


def _with_toes(clip: ToedClip) -> tuple[Tensor, Tensor]:
    """Return keypoints and confidence of the fifteen joints and of feet, of which toes alone are seen."""
    seen = clip.body.seen
    lead = clip.confidence.shape[:2]
    feet = clip.keypoints.new_full((*lead, len(FEET), 2), torch.nan)
    trust = clip.confidence.new_zeros(*lead, len(FEET))
    feet[:, :, _POINTS], trust[:, :, _POINTS] = clip.keypoints, clip.confidence
    keypoints = torch.cat([seen.keypoints, feet], 2)
    return keypoints, torch.cat([seen.confidence, trust.to(seen.confidence)], 2)


def _score(estimate: FootEstimate, clip: ToedClip) -> _Score:
    """Return the measures of an estimate."""
    toes, truth, body = estimate.points[:, _POINTS], clip.toes, clip.body.joints
    away, half, most = torch.nan, torch.nan, torch.nan
    if estimate.covariance is not None:
        inside = coverage(toes, estimate.covariance[:, _POINTS], truth).overall
        half, most = (100 * inside).tolist()
    if estimate.joints is not None:
        lines = toes - estimate.joints[:, ANKLES], truth - body[:, ANKLES]
        away = _mean(lines[0] - lines[1])
        if len(clip.body.rig) == 1:
            toes = toes + body[:, [_PELVIS]] - estimate.joints[:, [_PELVIS]]
    unseen = clip.clean.sum(1) < min(2, len(clip.body.rig))
    return _Score(_mean(toes - truth), away, _mean((toes - truth)[unseen]), half, most)


def _mean(off: Float[Tensor, "*batch 3"]) -> float:
    """Return the mean length, mm, of those that are known."""
    return 1000 * float(off.norm(dim=-1).nanmean())


def add_real_table(report: Report, data: Path, frames: int | None = None) -> None:
    """Add the table of cameras left out, of heels and toes that OpenPose found.

    Args:
        report: gets the table. data: folder with the sets.
        frames: how many, of few choices of cameras; None is all of both.
    """
    filmed = read_filmed(data)
    arrays = read_npz(data / "multicam_pose2sim" / "balancing_4cam.npz")
    table = torch.from_numpy(arrays["openpose_2d"]).double().transpose(0, 1)
    table = table.masked_fill((table[..., 2] <= 0)[..., None], torch.nan)
    feet = foot_points(table, [str(name) for name in arrays["openpose_names"]])
    assert feet is not None  # OpenPose's set has feet
    pixels = undistorted(filmed.rig, feet[..., :2])
    keypoints = torch.cat([filmed.keypoints, pixels], 2)[:frames]
    confidence = torch.cat([filmed.confidence, feet[..., 2].nan_to_num()], 2)[:frames]
    pixels, trust = keypoints[:, :, -len(FEET) :], confidence[:, :, -len(FEET) :]
    errors: dict[str, dict[int, list[Tensor]]] = defaultdict(lambda: defaultdict(list))
    counts = range(len(filmed.rig) - 1, 0, -1)
    chosen = [c for n in counts for c in itertools.combinations(range(len(filmed.rig)), n)]
    chosen = chosen if frames is None else chosen[::_QUICK_EVERY]
    for rows in tqdm([list(c) for c in chosen], desc="real"):
        others = [c for c in range(len(filmed.rig)) if c not in rows]
        rig = filmed.rig.select(rows)
        found = estimates_of(rig, keypoints[:, rows], confidence[:, rows], filmed.fps)
        for name, estimate in found.items():
            off = (filmed.rig(estimate.points).pixels - pixels).norm(dim=-1)[:, others]
            errors[name][len(rows)].append(off[trust[:, others] > _SURE])
    columns = [f"{n} camera{'s' * (n > 1)}, {what}" for n in counts for what in ("median", "90 %")]
    result = report.table(
        "real", "Heels and toes in a real camera, predicted from others (pixels)", columns,
        note="All cameras left out and all choices of the others. A method marked * has seen no later frame.",
    )  # fmt: skip
    for name in METHODS:
        cells: list[float] = []
        for n in counts:
            known = torch.cat(errors[name][n] or [torch.tensor([torch.nan]).double()])
            known = known[known.isfinite()]
            levels = torch.tensor([0.5, 0.9]).to(known)
            cells += known.quantile(levels).tolist() if len(known) else [torch.nan] * 2
        result.add(row_of(name, CAUSAL), cells)
