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
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks._upper_body import data_folder
from torchpose._core.files import check_output_folder
from torchpose._core.reading import read_npz
from torchpose.errors import FileFormatError
from torchpose.evaluation import Report
from torchpose.evaluation.common import add_picture
from torchpose.filters import MixtureKalmanFilter
from torchpose.priors import GaussianMixture, UpperBodyPrior
from torchpose.priors._upper_body import released_process_cov

_DATA = "signer"
_PRIOR = "released_prior_Training20_02.npz"
NECK_BELOW_HEAD = 45.0
FPS = 25.0
SIDES = ("left", "right")
# Order of the released code: head, hand, neck, elbow (u, v each).
OBSERVED = (9, 10, 0, 1, 12, 13, 3, 4)
RELEASED_R = (1.0, 1.0, 1.0, 1.0, 124.0, 144.0, 124.0, 144.0)
_LEARNING_FRAMES = 100
GAPS = (0.0, 0.5, 1.0)
_PERIOD, _FIRST = 2.0, 1.0  # a gap every two seconds, from the first second on


class Videos(NamedTuple):
    """Annotated hands and heads of many videos; past the length of a video all is NaN.

    Attributes:
        z: head, hand, neck (u, v) for each side, [2, V, T, 6], pixels.
        lengths: [V]. names: of the videos.
    """

    z: Float[Tensor, "2 V T 6"]
    lengths: Int[Tensor, " V"]
    names: tuple[str, ...]


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
        quick: four videos of at most 60 frames and five learning steps.
        learning_steps: steps of Adam.

    Raises:
        InputError: no such data. FileFormatError: not as described. OutputError: as it says.
    """
    out = check_output_folder(out)
    folder = data_folder(data, _DATA)
    prior = UpperBodyPrior.from_released(folder / _PRIOR)
    videos = read_videos(folder)
    if quick:
        videos, learning_steps = _cut(videos, 4, 60), min(learning_steps, 5)
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
        "released noise, own start and epsilon": _filters(prior, "paper", None),
        "released noise, stationary": _filters(prior, "stationary", None),
    }
    models |= {f"learnt noise, {kind}": _filters(prior, kind, n) for kind, n in learnt.items()}
    found = _predictions(models, tested, progress)
    _add_predictions(report, found, tested)
    _add_noise(report, learnt)
    _picture(report, out, found)
    report.save(out)
    return report


def read_videos(folder: Path) -> Videos:
    """Return head, hand and neck of every annotated video; zero coordinates are missing.

    Raises:
        InputError: no such file. FileFormatError: no videos, or not [T, 3, 2].
    """
    path = folder / "rwth_annotations.npz"
    arrays = read_npz(path)
    names = tuple(sorted(name for name in arrays if name.startswith("video_")))
    if not names:
        raise FileFormatError(
            f"{path}: expected keys video_NNN, found {', '.join(arrays) or 'none'}"
        )
    sequences = []
    for name in names:
        points = np.asarray(arrays[name], dtype=np.float64)
        if points.ndim != 3 or points.shape[1:] != (3, 2) or len(points) == 0:
            raise FileFormatError(f"{path}: {name} must be [T, 3, 2], got {list(points.shape)}")
        points = np.where((points == 0).any(-1, keepdims=True), np.nan, points)
        neck = points[:, 2] + (0.0, NECK_BELOW_HEAD)
        both = [np.concatenate([points[:, 2], points[:, side], neck], -1) for side in (0, 1)]
        sequences.append(torch.from_numpy(np.stack(both, 1)))
    z = torch.nn.utils.rnn.pad_sequence(sequences, True, padding_value=math.nan)
    return Videos(z.permute(2, 0, 1, 3), torch.tensor([len(s) for s in sequences]), names)


def released_filter(mixture: GaussianMixture, elbow: bool = True) -> MixtureKalmanFilter:
    """Return the released tracker of one arm: its Q, R, P0 = 5000 I, epsilon = 0.

    Args:
        mixture: its prior. elbow: whether its constant dummy elbow is measured too.
    """
    n = 8 if elbow else 6
    return MixtureKalmanFilter(
        mixture,
        released_process_cov(),
        torch.tensor(RELEASED_R[:n], dtype=torch.float64),
        OBSERVED[:n],
        uniform_weight=0.0,
        initial_cov=torch.full((mixture.dim,), 5000.0, dtype=torch.float64),
    )


def hand_log_density(
    model: MixtureKalmanFilter, z: Float[Tensor, "V T 6"], hidden: Bool[Tensor, "V T"]
) -> Float[Tensor, "V T"]:
    """Return log p(hand_t | z_1:t-1), R included, with hands hidden from the filter in some frames.

    The log-evidence of a step in which the hand alone is measured is that density; the step itself
    is thrown away, and the filter goes on with what it may see.

    Args:
        model: measures head, hand, neck. z: measurements, NaN = missing. hidden: frames in which
            the filter does not see the hand.

    Returns:
        Nats; NaN in the first frame and where the hand is not annotated.
    """
    measured = torch.isfinite(z)
    seen = measured.clone()
    seen[..., 2:4] &= ~hidden[..., None]
    only_hand = torch.zeros_like(measured)
    only_hand[..., 2:4] = measured[..., 2:4]
    values = z.nan_to_num()
    state = model.init(z.shape[0])
    densities = []
    for t in range(z.shape[1]):
        _, out = model.step(state, values[:, t], only_hand[:, t])
        densities.append(out.log_evidence)
        state, _ = model.step(state, values[:, t], seen[:, t])
    found = torch.stack(densities, 1).masked_fill(~measured[..., 2:4].all(-1), torch.nan)
    found[:, 0] = torch.nan
    return found


class Noise(NamedTuple):
    """Learnt noise of one transition: diagonal Q [21], R [6], gamma or None; log-evidence gained."""

    process: Tensor
    measurement: Tensor
    gamma: Tensor | None
    gain: float


def learn_noise(
    prior: UpperBodyPrior, videos: Videos, transition: str, n_steps: int, progress: bool = False
) -> Noise:
    """Return Q, R and gamma of most log-evidence, by Adam on their logarithms.

    Both arms share them. Pixels only: R stays at a quarter of a square pixel or more, since the
    annotations are whole numbers (variance 1/12) of a point that is itself uncertain.

    Args:
        prior: mixtures. videos: to learn from. transition: see `make_transition`.
        n_steps: of Adam. progress: whether to show a bar.
    """
    log_q = released_process_cov().log().requires_grad_()
    log_r = torch.tensor(RELEASED_R[:6], dtype=torch.float64).log().requires_grad_()
    logit = torch.tensor(3.0, dtype=torch.float64, requires_grad=True)
    is_ou = transition == "ou"
    leaves = [logit, log_r] if is_ou else [log_q, log_r]
    adam = torch.optim.Adam(leaves, lr=0.1)
    mask = torch.isfinite(videos.z)
    n = int(mask.any(-1).sum())
    history = []
    for _ in tqdm(range(n_steps), disable=not progress, desc=f"noise, {transition}", leave=False):
        adam.zero_grad()
        noise = _noise(log_q, log_r, logit if is_ou else None)
        total = torch.zeros((), dtype=torch.float64)
        for side, z, seen in zip(SIDES, videos.z, mask, strict=True):
            model = _filter(getattr(prior, side), transition, noise)
            evidence = model(z.nan_to_num(), seen, lengths=videos.lengths).log_evidence
            loss = -evidence.sum() / n
            loss.backward(retain_graph=True)
            total = total - loss.detach()
        history.append(float(total))
        adam.step()
    noise = _noise(log_q.detach(), log_r.detach(), logit.detach() if is_ou else None)
    return noise._replace(gain=history[-1] - history[0])


def _noise(log_q: Tensor, log_r: Tensor, logit: Tensor | None) -> Noise:
    gamma = None if logit is None else torch.sigmoid(logit)
    return Noise(log_q.exp(), 0.25 + log_r.exp(), gamma, 0.0)


def _filter(mixture: GaussianMixture, transition: str, noise: Noise | None) -> MixtureKalmanFilter:
    if noise is None:
        noise = Noise(
            released_process_cov(), torch.tensor(RELEASED_R[:6], dtype=torch.float64), None, 0.0
        )
    options: dict[str, Any] = {"transition": transition, "gamma": noise.gamma}
    return MixtureKalmanFilter(mixture, noise.process, noise.measurement, OBSERVED[:6], **options)


def _filters(
    prior: UpperBodyPrior, transition: str, noise: Noise | None
) -> list[MixtureKalmanFilter]:
    return [_filter(getattr(prior, side), transition, noise) for side in SIDES]


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
