"""Signer: the authors' released sign-language tracker, reproduced and then improved upon.

Parity: means and weights of the released code on two videos. Prediction: the log-density that a
tracker gives to the true (annotated) hand in the next frame, log p(hand_t | z_1:t-1), measurement
noise included, on the RWTH-PHOENIX annotations; with the hand measured all the time, and while it is
hidden. Head, hand and neck (45 pixels below the head) are measured, 25 frames per second.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks._data import data_folder
from benchmarks._signer_models import (
    FPS,
    SIDES,
    Noise,
    Videos,
    filters_of,
    hand_log_density,
    learn_noise,
    read_videos,
    released_filter,
)
from torchpose._core.files import check_output_folder
from torchpose._core.reading import read_npz
from torchpose.evaluation import Report
from torchpose.evaluation._trials import add_picture
from torchpose.filters import MixtureKalmanFilter
from torchpose.priors import UpperBodyPrior

_DATA = "signer"
_PRIOR = "released_prior_Training20_02.npz"
_LEARNING_FRAMES = 100
GAPS = (0.0, 0.5, 1.0)
_PERIOD, _FIRST = 2.0, 1.0  # a gap every two seconds, from the first second on


def run(
    data: str | Path,
    out: str | Path,
    *,
    seed: int = 0,
    progress: bool = True,
    quick: bool = False,
    learning_steps: int = 40,
) -> Report:
    """Run the protocol; writes report.json, report.md and a picture to `out`.

    Noise is learnt by gradient on the log-evidence of the first 100 frames of every second video;
    all models are scored on the other videos.

    Args:
        data: folder signer, or the one it is in. out: folder for the results.
        seed: not used, nothing is drawn. progress: whether to show bars.
        quick: four videos of at most 45 frames and five learning steps.
        learning_steps: steps of Adam.

    Raises:
        InputError: no such data. FileFormatError: not as described. OutputError: as it says.
    """
    out = check_output_folder(out)
    folder = data_folder(data, _DATA)
    prior = UpperBodyPrior.from_released(folder / _PRIOR)
    videos = read_videos(folder)
    if quick:
        videos, learning_steps = _cut(videos, 4, 45), min(learning_steps, 5)
    report = Report("Signer", {
        "quick": quick, "prior": _PRIOR, "videos": len(videos.names),
        "frames": int(videos.lengths.sum()), "learning steps": learning_steps,
        "threads": torch.get_num_threads(),
    })  # fmt: skip
    _add_parity(report, folder)
    train, tested = _rows(videos, slice(0, None, 2)), _rows(videos, slice(1, None, 2))
    train = _cut(train, len(train.names), _LEARNING_FRAMES)
    learnt = {
        kind: learn_noise(prior, train, kind, learning_steps, progress)
        for kind in ("paper", "stationary", "ou")
    }
    models: dict[str, list[MixtureKalmanFilter]] = {
        "released": [released_filter(getattr(prior, s), elbow=False) for s in SIDES],
        "released noise, own start and epsilon": filters_of(prior, "paper", None),
        "released noise, stationary": filters_of(prior, "stationary", None),
    }
    models |= {f"learnt noise, {kind}": filters_of(prior, kind, n) for kind, n in learnt.items()}
    found = _predictions(models, tested, progress)
    _add_predictions(report, found, tested)
    _add_noise(report, learnt)
    _picture(report, out, found)
    report.save(out)
    return report


# --- tables ---------------------------------------------------------------------------------------


def _add_parity(report: Report, folder: Path) -> None:
    table = report.table(
        "parity",
        "Largest difference from the released code, relative to max(|reference|, 1)",
        ["means", "weights", "within 1e-6"],
        digits=0,
    )
    prior = UpperBodyPrior.from_released(folder / _PRIOR)
    for path in sorted(folder.glob("reference_fixed_tracks_video_*.npz")):
        arrays = read_npz(path)
        for side in SIDES:
            z = torch.from_numpy(arrays[f"{side}_measurements"])[None]
            with torch.inference_mode():
                out = released_filter(getattr(prior, side))(z)
            gaps = [
                _gap(ours, arrays[f"{side}_{key}"])
                for ours, key in ((out.mean[0], "mean"), (out.log_weights[0].exp(), "weights"))
            ]
            video = path.stem.removeprefix("reference_fixed_tracks_")
            verdict = "yes" if max(gaps) <= 1e-6 else "NO"
            table.add(f"{video}, {side}", [*(f"{g:.1e}" for g in gaps), verdict])
    held = sum(row[2] == "yes" for row in table.rows.values())
    report.findings.append(
        f"Parity with the released code holds for {held} of {len(table.rows)} arms (1e-6)."
    )


def _gap(ours: Tensor, reference: np.ndarray) -> float:
    theirs = torch.from_numpy(reference)
    return float(((ours - theirs).abs() / theirs.abs().clamp_min(1)).max())


Predictions = dict[str, dict[float, Tensor]]


def _predictions(
    models: dict[str, list[MixtureKalmanFilter]], videos: Videos, progress: bool
) -> Predictions:
    """Return log densities of the frames that count [2, V, T], NaN elsewhere, by model and gap."""
    found: Predictions = {name: {} for name in models}
    bar = tqdm(total=len(models) * len(GAPS), disable=not progress, desc="prediction")
    for name, arms in models.items():
        for seconds in GAPS:
            hidden = _hidden(videos, seconds)
            with torch.inference_mode():
                each = [hand_log_density(m, z, hidden) for m, z in zip(arms, videos.z, strict=True)]
            scored = torch.stack(each)
            found[name][seconds] = scored.masked_fill(~hidden, torch.nan) if seconds else scored
            bar.update()
    bar.close()
    return found


def _hidden(videos: Videos, seconds: float) -> Bool[Tensor, "V T"]:
    time = torch.arange(videos.z.shape[2]) / FPS - _FIRST
    gap = (time >= 0) & (time % _PERIOD < seconds)
    return gap.expand(videos.z.shape[1], -1)


def _add_predictions(report: Report, found: Predictions, videos: Videos) -> None:
    for seconds in GAPS:
        what = (
            "always measured" if seconds == 0 else f"hidden for {seconds:g} s every {_PERIOD:g} s"
        )
        table = report.table(
            f"prediction_{seconds:g}",
            f"Log-density of the next hand position (nats per frame), hands {what}",
            ["mean", "against released", "standard error", "videos better (%)", "worst frame"],
            digits=(3, 3, 3, 0, 1),
            note=f"{len(videos.names)} videos whose noise was not learnt from; the standard error is "
            "that of the difference, over videos.",
        )
        base = _by_video(found["released"][seconds])
        for name, values in found.items():
            own = values[seconds]
            gain = _by_video(own) - base
            gain = gain[torch.isfinite(gain)]
            error = float(gain.std()) / math.sqrt(len(gain)) if len(gain) > 1 else math.nan
            least = float(own[torch.isfinite(own)].min())
            wins = 100 * float((gain > 0).double().mean())
            table.add(name, [float(own.nanmean()), float(gain.mean()), error, wins, least])
        others = {name: float(table[name, "mean"]) for name in table.rows if name != "released"}
        best = max(others, key=lambda n: others[n])
        report.findings.append(
            f"Hands {what}: '{best}' predicts best, {others[best]:.2f} nats against "
            f"{float(table['released', 'mean']):.2f} of the released tracker, better in "
            f"{float(table[best, 'videos better (%)']):.0f} % of the videos."
        )


def _by_video(values: Float[Tensor, "2 V T"]) -> Float[Tensor, " V"]:
    return values.permute(1, 0, 2).flatten(1).nanmean(1)


def _add_noise(report: Report, learnt: dict[str, Noise]) -> None:
    columns = ["gain (nats/frame)", "hand u", "hand v", "elbow u", "head u", "neck u",
               "R head", "R hand", "R neck", "gamma"]  # fmt: skip
    table = report.table(
        "noise",
        "What was learnt: standard deviations of Q per frame and of R (pixels)",
        columns,
        digits=(2, 1, 1, 1, 1, 1, 1, 1, 1, 4),
        note="'ou' has no Q.",
    )
    for kind, noise in learnt.items():
        steps: Sequence[Any] = [None] * 5 if kind == "ou" else [
            float(noise.process[i].sqrt()) for i in (0, 1, 3, 9, 12)
        ]  # fmt: skip
        spread = [float(noise.measurement[i : i + 2].mean().sqrt()) for i in (0, 2, 4)]
        gamma = None if noise.gamma is None else float(noise.gamma)
        table.add(kind, [noise.gain, *steps, *spread, gamma])


def _picture(report: Report, out: Path, found: Predictions) -> None:
    """Draw the mean log-density over the time since the hand was last seen."""
    from torchpose.viz._style import INK, NORMAL, add_legend, method_styles, new_figure, style_axes

    styles = method_styles(list(found))
    figure = new_figure(7.5, 4.4, "How well a hidden hand is predicted")
    ax = style_axes(figure.add_subplot(), "time since the hand was last seen (s)")
    ax.set_ylabel("log-density of its true position (nats)", fontsize=NORMAL, color=INK)
    lines = []
    for name, values in found.items():
        scored = values[GAPS[-1]]
        place = (torch.arange(scored.shape[-1]) / FPS - _FIRST) % _PERIOD
        steps = torch.round(place * FPS).long()
        n = round(GAPS[-1] * FPS)
        mean = torch.stack([scored[..., steps == i].nanmean() for i in range(n)])
        time = ((torch.arange(n) + 1) / FPS).numpy()
        lines += ax.plot(time, mean.numpy(), linewidth=1.8, label=name, **styles[name])
    add_legend(figure, lines)
    add_picture(report, out, "hidden-hand-prediction.png", figure)


def _rows(videos: Videos, rows: slice) -> Videos:
    lengths = videos.lengths[rows]
    return Videos(videos.z[:, rows, : int(lengths.max())], lengths, videos.names[rows])


def _cut(videos: Videos, n: int, frames: int) -> Videos:
    lengths = videos.lengths[:n].clamp_max(frames)
    return Videos(videos.z[:, :n, : int(lengths.max())], lengths, videos.names[:n])


if __name__ == "__main__":
    from benchmarks._protocols import run_protocol

    run_protocol("signer")
