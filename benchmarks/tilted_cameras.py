"""Errors of cameras that look up or down, with the tilt unknown, told, and chosen by the evidence.

Persons of Berkeley MHAD (one recording in forty, 75 frames, shoulders to wrists and neck with 3 px
noise, at 2.5 m), whom the prior over upper bodies does not know, with a prior over arms that is fitted
without them. The camera is turned about the neck, so that persons stay in the middle of the image. Error:
that of `bones`, the vector from the shoulder to the wrist and to the elbow, camera axes, nothing aligned.

    python -m benchmarks.tilted_cameras --data DIR [--out FILE]

"unknown" is a camera that is taken to be about level, "told" one that has its true tilt, "off by 5
degrees" one that is told 5 degrees too much. "chosen" has the tilt of these five under which elbows and
wrists of the recording are the likeliest, with a Gaussian prior of 10 degrees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

import torchpose
from benchmarks import bones
from benchmarks._command import run_command
from benchmarks._table_file import TableFile, save_text
from torchpose.camera._tilt import Turn
from torchpose.evaluation import Report
from torchpose.priors import UpperBodyPrior
from torchpose.priors._arms import shipped_arm_prior

PITCHES = (-25.0, -15.0, 0.0, 15.0, 25.0)
"""Degrees by which the camera looks up."""

_EVERY, _FRAMES = 14, 75
_PRIOR_STD = 10.0  # degrees, of the tilt that is chosen
_OFF = 5.0  # degrees by which a tilt is told wrong
_ROWS, _DIGITS = [0, 1, 5], (1, 1, 0)  # of `bones.errors`
_COLUMNS = ("wrist (cm)", "elbow (cm)", "inside 90 %")
_LIFT, _HANGING = "lift, others' lengths, own depth", "hanging arms"


def main(
    *, data: Path, threads: int = 2, out: TableFile | None = None, quick: bool = False
) -> None:
    """Print the tables.

    Args:
        data: folder with the sets.
        threads: cores.
        out: file for the same as Markdown, or a folder.
        quick: few recordings and one tilt, with the priors that come with torchpose.
    """
    torch.set_num_threads(threads)
    prior = torchpose.load_prior("kinect-upper-body-small" if quick else "kinect-upper-body")
    arms = shipped_arm_prior() if quick else bones.fit_without(data, "mocap_berkeley_mhad")
    report = Report("Cameras that look up or down")
    for pitch in PITCHES[3:4] if quick else PITCHES:
        views = bones.mhad_views(data, 150 if quick else _EVERY, math.radians(pitch))
        views = [bones.begun(view, 4 if quick else _FRAMES) for view in views]
        title = f"{pitch:+.0f} degrees" if pitch else "level"
        table = report.table(title, title, _COLUMNS, digits=_DIGITS)
        for name, scores in _scores(views, pitch, prior, {"arms": arms}).items():
            table.add(name, scores)
        print(table.to_markdown(), end="\n\n", flush=True)
    tables = [table.to_markdown() for table in report.values()]
    save_text(out, "\n\n".join(tables) + "\n")


def _scores(
    views: Sequence[bones.View], pitch: float, prior: UpperBodyPrior, arms: dict[str, object]
) -> dict[str, Tensor]:
    """Return the mean errors and coverage of every method, by name."""
    rows = {}
    told = {"unknown": None, "told": pitch, f"off by {_OFF:.0f} degrees": pitch + _OFF}
    trackers = {
        "articulated, all joints": {"method": "articulated", "chosen": None, **arms},
        "multiple-model, neck and wrists": {
            "method": "multiple-model",
            "chosen": bones.FEW,
            **arms,
        },
        "mkf-fixed, neck and wrists": {"method": "mkf-fixed", "chosen": bones.FEW},
    }
    for name, options in trackers.items():
        for how, angle in told.items():
            seen = [told_view(view, angle) for view in views]
            method = partial(bones.tracked, prior=prior, **options)
            rows[f"{name}, {how}"] = _mean([bones.errors(method(v), v.truth) for v in seen])
        if name.startswith("articulated"):
            own = {"method": "articulated", **arms}
            seen = [told_view(v, likeliest_tilt(v, prior, own)) for v in views]
            rows[f"{name}, chosen"] = _mean([bones.errors(method(v), v.truth) for v in seen])
    simple = bones.lifts(arms["arms"].lengths[:2].expand(2, 2))  # type: ignore[attr-defined]
    for name in (_LIFT, _HANGING):
        rows[name] = _mean([bones.errors(simple[name](v), v.truth) for v in views])
    hanging = [_hanging_along(told_view(v, pitch), simple[_HANGING](v)) for v in views]
    pairs = zip(hanging, views, strict=True)
    rows[f"{_HANGING}, told"] = _mean([bones.errors(arms, view.truth) for arms, view in pairs])
    return rows


def told_view(view: bones.View, pitch: float | None) -> bones.View:
    """Return a view whose camera is known to look up by an angle in degrees; None leaves it unknown."""
    if pitch is None:
        return view
    return view._replace(camera=view.camera.tilted(math.radians(pitch)))


def likeliest_tilt(view: bones.View, prior: UpperBodyPrior, options: dict[str, object]) -> float:
    """Return the tilt of `PITCHES` under which elbows and wrists are the likeliest, degrees.

    The log-evidence is a density over pixels of the level camera, and is made one over those of the camera.
    """
    limbs = [i for rows in bones.arm_rows(view.names) for i in rows[1:]]
    scores = []
    for pitch in PITCHES:
        told = told_view(view, pitch)
        tracker = torchpose.UpperBodyTracker(
            prior, told.camera, neck=view.neck, fps=view.fps, max_gap=None, **options
        )  # type: ignore[arg-type]
        with torch.inference_mode():
            track = tracker(view.keypoints[None], names=list(view.names))
        turn = Turn.to_level(told.camera.up, view.camera.matrix)  # type: ignore[arg-type]
        eye = torch.eye(2, dtype=torch.float64)
        area = turn.covariances(eye, view.keypoints[:, limbs]).logdet() / 2
        expected = (pitch / _PRIOR_STD) ** 2 / 2
        scores.append(float(track.log_evidence.sum() + area.sum()) - expected)
    return PITCHES[max(range(len(scores)), key=scores.__getitem__)]


def _hanging_along(view: bones.View, chains: bones.Chains) -> bones.Chains:
    """Return arms that hang along gravity in place of the image's vertical."""
    upright = view.camera.level_rotation  # level axes to camera axes from the right
    return bones.Chains(chains.upper @ upright, chains.lower @ upright)


def _mean(scores: Sequence[Sequence[float]]) -> Tensor:
    return torch.tensor(scores).nanmean(0)[_ROWS]


if __name__ == "__main__":
    run_command(main)
