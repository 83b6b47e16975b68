"""Errors while one hand is hidden for some seconds, and jumps of the other joints when it returns."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks._upper_body import plain_prior
from torchpose.evaluation._report import Report, Table
from torchpose.evaluation._trials import (
    CAMERA,
    MEASURED,
    Estimate,
    Trials,
    add_picture,
    make_test_set,
    track,
)
from torchpose.metrics import align, coverage, joint_errors_3d
from torchpose.priors import UpperBodyPrior
from torchpose.skeleton import LEFT_ARM, RIGHT_ARM
from torchpose.skeleton._upper_body import OTHER_SIDE

GAPS = (1.0, 2.0, 5.0)
_START, _DURATION = 1.5, 8.0
_ARMS = {"left": LEFT_ARM, "right": RIGHT_ARM}


def back_and_forth(n_frames: int, wanted: int) -> Int[Tensor, " wanted"]:
    """Return frame numbers that play a sequence to its end, backwards, forwards and so on.

    >>> back_and_forth(3, 7).tolist()
    [0, 1, 2, 1, 0, 1, 2]
    """
    if n_frames == 1:
        return torch.zeros(wanted, dtype=torch.long)
    period = 2 * (n_frames - 1)
    place = torch.arange(wanted) % period
    return torch.minimum(place, period - place)


def add_gap_tables(
    report: Report,
    out: Path,
    prior: UpperBodyPrior,
    poses: Sequence[Float[Tensor, "T 8 3"]],
    fps: float,
    seed: int,
    n_sequences: int,
    progress: bool,
    quick: bool,
) -> None:
    """Hide each hand in turn for 1, 2 and 5 seconds, with several transitions.

    The recordings are shorter than that, so each is played back and forth for 8 s (which keeps
    poses and speeds real); the gap begins after 1.5 s.

    Args:
        report: to add to. out: folder of the picture. prior: of the tracker.
        poses: test sequences, of which `n_sequences` are used, evenly spaced. fps: frame rate.
        seed: of the noise. progress: whether to show bars. quick: only the shortest gap.
    """
    chosen = torch.linspace(0, len(poses) - 1, min(n_sequences, len(poses))).round().long().tolist()
    wanted = round(_DURATION * fps)
    test = make_test_set([poses[i][back_and_forth(len(poses[i]), wanted)] for i in chosen], CAMERA,
                         fps, seed)  # fmt: skip
    table, jumps = _tables(report, len(chosen))
    curves: dict[str, Tensor] = {}
    lengths = GAPS[:1] if quick else GAPS
    shown = lengths[:2][-1]  # the second, if there is one
    runs = _models(prior)
    bar = tqdm(total=len(runs) * (1 + 2 * len(lengths)), disable=not progress, desc="gaps")
    for name, (own, options) in runs.items():
        whole = {frame: track(own, CAMERA, test, frame=frame, **options)
                 for frame in ("camera", "body")}  # fmt: skip
        bar.update()
        for seconds in lengths:
            parts = []
            for side in _ARMS:
                parts.append(_one_gap(own, test, whole, side, seconds, options))
                bar.update()
            rows = torch.stack([torch.tensor(values) for values, _, _ in parts])
            table.add(f"{name}, {seconds:g} s", rows.mean(0).tolist())
            worst = torch.stack([torch.tensor(values) for _, values, _ in parts]).amax(0)
            jumps.add(f"{name}, {seconds:g} s", worst.tolist())
            if seconds == shown:
                curves[name] = torch.stack([errors for _, _, errors in parts]).mean(0)
    bar.close()
    _picture(report, out, curves, fps, shown)


def _tables(report: Report, n_sequences: int) -> tuple[Table, Table]:
    """Return the empty tables of errors about gaps, and of jumps of the other arm."""
    gaps = report.table(
        "gaps",
        f"One hand hidden in {n_sequences} sequences of 8 s (cm; inside the 50 % and 90 % "
        "ellipsoids, %)",
        ["hand before", "hand during", "elbow during", "hand 1 s after", "elbow 1 s after",
         "hand 50 %", "hand 90 %", "elbow 50 %", "elbow 90 %"],
        digits=(1, 1, 1, 1, 1, 0, 0, 0, 0),
        note="Both hands in turn. 'before' is the second before the gap; coverage is that during it.",
    )  # fmt: skip
    jumps = report.table(
        "jumps",
        "Change of the other arm's steps where the gap begins and ends, against no gap (cm)",
        [
            "body, largest",
            "body, median",
            "camera, largest",
            "camera, median",
            "own hand, median",
            "median step without a gap",
        ],
        digits=(2, 2, 1, 2, 1, 2),
        note="With single poses the arms are independent in the body's frame and in the image; in "
        "camera axes they share the estimated rotation and place of the camera. Windows hold the "
        "other hand as well. 'median' is over sequences.",
    )
    return gaps, jumps


def _models(prior: UpperBodyPrior) -> dict[str, tuple[UpperBodyPrior, dict[str, Any]]]:
    """Return the models to compare: the recipe's prior, single poses only, and hand-set noise."""
    plain = plain_prior(prior)
    models: dict[str, tuple[UpperBodyPrior, dict[str, Any]]] = {"MKF": (prior, {})}
    if prior.windows:
        models["MKF, single poses"] = (prior, {"method": "mkf-fixed"})
    models["paper, hand-set noise"] = (plain, {})
    models["stationary, hand-set noise"] = (
        plain,
        {"method": "mkf-fixed", "transition": "stationary"},
    )
    return models


def _one_gap(
    prior: UpperBodyPrior,
    test: Trials,
    whole: dict[str, Estimate],
    side: str,
    seconds: float,
    options: dict[str, Any],
) -> tuple[list[float], list[float], Tensor]:
    """Return the numbers of both tables, and errors over time [T, 8], mirrored so that the left is hidden."""
    first = round(_START * test.fps)
    gap = slice(first, first + round(seconds * test.fps))
    mask = torch.ones(test.keypoints.shape[:3], dtype=torch.bool)
    mask[:, gap, MEASURED.index(f"hand_{side}")] = False
    hidden = {frame: track(prior, CAMERA, test, mask, frame=frame, **options) for frame in whole}
    errors = 100 * joint_errors_3d(hidden["camera"].joints3d, test.truth3d)
    over_time = errors.nanmean(0)
    if side == "right":
        over_time = over_time[:, list(OTHER_SIDE)]
    return (
        _errors_about(gap, hidden["camera"], errors, test, side),
        _changes(gap, hidden, whole, round(test.fps), side),
        over_time,
    )


def _errors_about(
    gap: slice, estimate: Estimate, errors: Float[Tensor, "B T 8"], test: Trials, side: str
) -> list[float]:
    """Return errors of hand and elbow before, in and after a gap, and the shares in ellipsoids."""
    hand, elbow = _ARMS[side][:2]
    second = round(test.fps)
    after = errors[:, gap.stop : gap.stop + second]
    values = [
        errors[:, gap.start - second : gap.start, hand], errors[:, gap, hand], errors[:, gap, elbow],
        after[..., hand], after[..., elbow],
    ]  # fmt: skip
    aligned = align(estimate.joints3d, test.truth3d, covariance=estimate.covariance3d)
    turned: Any = aligned.covariance
    held = coverage(aligned.points[:, gap], turned[:, gap], test.truth3d[:, gap])
    shares = [100 * held.per_joint[level, joint] for joint in (hand, elbow) for level in (0, 1)]
    return [float(v.nanmean()) for v in values] + [float(s) for s in shares]


def _changes(
    gap: slice, hidden: dict[str, Estimate], whole: dict[str, Estimate], second: int, side: str
) -> list[float]:
    """Return how steps of both arms change where a gap begins and ends, and a step without it, cm."""
    other = list(_ARMS["right" if side == "left" else "left"][:3])
    edges = [gap.start, gap.stop]
    changes = []
    for frame in ("body", "camera"):
        each = _jump(hidden[frame], whole[frame], other, edges)
        changes += [float(each.max()), float(each.median())]
    hand = _ARMS[side][0]
    changes.append(float(_jump(hidden["camera"], whole["camera"], [hand], edges).median()))
    steps = whole["camera"].joints3d[:, second:, other].diff(dim=1).norm(dim=-1)
    changes.append(100 * float(steps.amax(-1).median()))
    return changes


def _jump(
    hidden: Estimate, whole: Estimate, joints: list[int], frames: list[int]
) -> Float[Tensor, " B"]:
    """Return the largest |step with the gap - step without it| into these frames, per sequence, cm."""
    steps = [e.joints3d[:, :, joints].diff(dim=1) for e in (hidden, whole)]
    at = [f - 1 for f in frames]
    return 100 * (steps[0] - steps[1])[:, at].norm(dim=-1).flatten(1).amax(1)


def _picture(
    report: Report, out: Path, curves: dict[str, Tensor], fps: float, seconds: float
) -> None:
    from torchpose.viz import plot_errors_over_time

    figure = plot_errors_over_time(
        curves, fps, ("hand_left", "hand_right", "elbow_left", "elbow_right"), scale=1.0,
        title=f"One hand, drawn as the left one, is hidden from {_START:g} s to "
        f"{_START + seconds:g} s (mean over sequences)",
    )  # fmt: skip
    add_picture(report, out, "hidden-hand.png", figure)
