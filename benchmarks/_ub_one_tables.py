"""Tables, findings and pictures of UB-one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool
from torch import Tensor

from benchmarks._people_tables import add_pcp_table
from benchmarks._upper_body import Scores
from torchpose.evaluation._person_tables import SHORT_NAMES
from torchpose.evaluation._report import Report, Table
from torchpose.evaluation._trials import HANDS, Trials, add_picture
from torchpose.metrics import jitter
from torchpose.metrics._pose_errors import share_below
from torchpose.priors import UpperBodyPrior

SUMMARY = (
    "2D error (px)", "3D error (cm)", "jitter (m/s2)", "arm raised (cm)", "iteration (ms)",
    "the paper's", "process noise",
)  # fmt: skip

SAMPLED = ("mkf-sampled", "pf-walk", "pf-walk-unscaled", "pf-mixture")
FIXED, DRAWN, SPLIT = "MKF fixed tracks", "MKF sampled", "split tracks"
WALK, SCALED, MIXTURE = "PF walk, no scaling", "PF walk, scaled", "PF mixture"
_PARTICLES = (WALK, SCALED, MIXTURE)
_PAPER_SECONDS = {FIXED: 15, DRAWN: 21, WALK: 28, SCALED: 46, MIXTURE: 2947}
_SHOWN_SECONDS = 15.0  # more would be a thicket
Runs = Mapping[str, Sequence[Scores]]


def add_tables(
    report: Report,
    scores: Runs,
    times: Mapping[str, float],
    test: Trials,
    raised: Bool[Tensor, "T 2"],
) -> None:
    """Add errors, correct limbs, spikes and smoothness, time."""
    _add_errors(report, scores)
    _add_behaviour(report, scores, test, raised)
    curves = {name: torch.stack([s.limbs.per_limb for s in runs]) for name, runs in scores.items()}
    add_pcp_table(
        report,
        {name: scores[name][0].limbs._replace(per_limb=c.mean(0)) for name, c in curves.items()},
    )
    table = report.table(
        "time",
        "Time of one iteration of one arm (ms)",
        ["median", "paper's Table 1"],
        digits=(2, 0),
        note=f"Online steps of one sequence, {torch.get_num_threads()} threads.",
    )
    for name, milliseconds in times.items():
        table.add(name, [milliseconds, _PAPER_SECONDS.get(name)])


def _add_errors(report: Report, scores: Runs) -> None:
    for key, title, field, scale in (
        ("errors_2d", "2D error (pixels; mean over seeds, and its spread)", "errors2d", 1.0),
        ("errors_3d", "3D error after Procrustes (cm; mean over seeds, and its spread)",
         "errors3d", 100.0),
    ):  # fmt: skip
        columns = ["mean", "spread", *SHORT_NAMES]
        table = report.table(key, title, columns, digits=(2, 2, *[1] * 8))
        for name, runs in scores.items():
            values = [scale * getattr(s, field) for s in runs]
            means = torch.stack([v.nanmean() for v in values])
            spread = float(means.std()) if len(means) > 1 else float("nan")
            joints = torch.stack([v.flatten(0, 1).nanmean(0) for v in values]).mean(0)
            table.add(name, [float(means.mean()), spread, *joints.tolist()])


def _add_behaviour(report: Report, scores: Runs, test: Trials, raised: Bool[Tensor, "T 2"]) -> None:
    table = report.table(
        "behaviour",
        "Spikes, smoothness and raised arms (3D errors in cm)",
        ["hands < 20 cm (%)", "99th percentile", "largest", "jitter (m/s2)", "arm raised",
         "arm not raised", "frames lost"],
    )  # fmt: skip
    for name, runs in scores.items():
        rows = torch.tensor([_behaviour(s, raised) for s in runs])
        table.add(name, rows.mean(0).tolist())
    own = float(jitter(test.truth3d, test.fps).mean())
    table.note = (
        f"Jitter is the mean acceleration; the Kinect's own is {own:.1f} m/s2. 'arm raised' is the "
        f"mean error of hand and elbow of an arm whose hand is above its shoulder "
        f"({int(raised.sum())} of {raised.numel()} arm-frames). Percentile and largest are over all "
        "joints. Lost frames have no estimate and are not in the other numbers."
    )


def fill_summary(table: Table, report: Report, noise: Mapping[str, str], title: str) -> None:
    """Fill the table that stands first from the others, with the process noise that each row ran with.

    Args:
        table: with the columns `SUMMARY`. report: after `add_tables`. noise: of each tracker, in words;
            rows without are of the recipe's own.
        title: what all rows have in common.
    """
    table.title = title
    timed = report["time"].rows
    for name in report["errors_2d"].rows:
        table.add(name, [
            report["errors_2d"][name, "mean"], report["errors_3d"][name, "mean"],
            report["behaviour"][name, "jitter (m/s2)"], report["behaviour"][name, "arm raised"],
            *timed.get(name, (None, None)), noise.get(name, "the recipe's"),
        ])  # fmt: skip


def _behaviour(scores: Scores, raised: Bool[Tensor, "T 2"]) -> list[float]:
    errors = 100 * scores.errors3d[0]
    share, _ = share_below(errors[:, list(HANDS)], 20.0)
    arms = torch.stack([errors[:, [0, 1]].mean(1), errors[:, [7, 6]].mean(1)], 1)
    known = errors[torch.isfinite(errors)]
    lost = float(errors.isnan().any(-1).sum())
    if known.numel() == 0:
        return [*[float("nan")] * 6, lost]
    return [
        100 * float(share.mean()),
        float(torch.quantile(known, 0.99)),
        float(known.max()),
        float(scores.jitter.mean()),
        float(arms[raised].nanmean()),
        float(arms[~raised].nanmean()),
        lost,
    ]


class _Claim(NamedTuple):
    """Holds what the paper says, whether it holds in these numbers, and the numbers."""

    text: str
    holds: bool
    numbers: str


def add_findings(report: Report, times: Mapping[str, float], raised: Bool[Tensor, "T 2"]) -> None:
    """Add findings: which claims of the paper's section 4 hold in these numbers."""
    claims = [
        *_claims_on_pixels(report),
        *_claims_on_behaviour(report, raised),
        _claim_on_time(times),
    ]
    report.findings += [
        f"{text}: {'yes' if holds else 'no'} ({numbers})." for text, holds, numbers in claims
    ]


def _claims_on_pixels(report: Report) -> Iterator[_Claim]:
    px = _column(report["errors_2d"], "mean")
    narrow = "PF mixture, Q of the MKF"
    yield _Claim(
        "The mixture Kalman filters are ahead of all particle filters",
        max(px(FIXED), px(DRAWN)) < min(map(px, _PARTICLES)),
        _listed((FIXED, DRAWN, SPLIT, *_PARTICLES), px, "pixels"),
    )
    yield _Claim(
        "The unscaled random walk is the best particle filter",
        px(WALK) == min(map(px, _PARTICLES)),
        _listed(_PARTICLES, px, "pixels"),
    )
    yield _Claim(
        "The scaled random walk tracks poorly (over 1.5 times the unscaled one's error)",
        px(SCALED) > 1.5 * px(WALK),
        _listed((SCALED, WALK), px, "pixels"),
    )
    yield _Claim(
        "The mixture proposal, with its larger Q and no burn-in, comes last",
        px(MIXTURE) == max(map(px, _PARTICLES)),
        _listed(_PARTICLES, px, "pixels"),
    )
    yield _Claim(
        "The mixture proposal needs a larger Q than the Kalman filters, or it loses the joints",
        px(narrow) > 1.5 * px(MIXTURE),
        _listed((MIXTURE, narrow), px, "pixels"),
    )


def _claims_on_behaviour(report: Report, raised: Bool[Tensor, "T 2"]) -> Iterator[_Claim]:
    table = report["behaviour"]
    tail = _column(table, "99th percentile")
    yield _Claim(
        "Particle filters have error spikes that the mixture Kalman filters have not",
        min(map(tail, _PARTICLES)) > max(tail(FIXED), tail(DRAWN)),
        "99th percentile of the 3D error: " + _listed((FIXED, DRAWN, *_PARTICLES), tail, "cm"),
    )
    shake = _column(table, "jitter (m/s2)")
    yield _Claim(
        "Fixed tracks are smoother than sampled ones",
        shake(FIXED) < shake(DRAWN),
        "jitter: " + _listed((FIXED, DRAWN, SPLIT), shake, "m/s2"),
    )
    if bool(raised.any()):
        up = _column(table, "arm raised")
        yield _Claim(
            "Fixed tracks are better on raised arms than sampled ones",
            up(FIXED) < up(DRAWN),
            f"hand and elbow, {int(raised.sum())} arm-frames: " + _listed((FIXED, DRAWN), up, "cm"),
        )
    near = _column(table, "hands < 20 cm (%)")
    yield _Claim(
        "For much of the time the error in hand position is below 20 cm",
        near(FIXED) > 50,
        "share of the frames: " + _listed((FIXED, DRAWN, *_PARTICLES), near, "%"),
    )


def _claim_on_time(times: Mapping[str, float]) -> _Claim:
    fast = max(times[FIXED], times[DRAWN]) < min(times[name] for name in _PARTICLES)
    return _Claim(
        "The mixture proposal is the slowest, and both mixture Kalman filters are the fastest",
        times[MIXTURE] == max(times.values()) and fast,
        _listed((FIXED, DRAWN, *_PARTICLES), times.__getitem__, "ms"),
    )


def _column(table: Table, name: str) -> Callable[[str], float]:
    return lambda row: float(table[row, name])


def _listed(names: Sequence[str], value: Callable[[str], float], unit: str) -> str:
    return ", ".join(f"{name} {value(name):.1f}" for name in names) + f" {unit}"


def add_pictures(
    report: Report,
    out: Path,
    scores: Mapping[str, Scores],
    fps: float,
    prior: UpperBodyPrior,
) -> None:
    """Add the error per joint, correct limbs, errors over time, the prior's mean poses."""
    from torchpose import viz

    bars = viz.plot_error_bars(
        {n: s.errors2d for n, s in scores.items()}, "px", 1.0, title="2D error (paper's Figure 3)"
    )
    add_picture(report, out, "errors-2d.png", bars)
    limbs = viz.plot_pcp(
        {n: s.limbs for n, s in scores.items()}, by_limb=True, title="Correct limbs (Figure 4)"
    )
    add_picture(report, out, "pcp.png", limbs)
    shown = (FIXED, DRAWN, WALK, SCALED, MIXTURE)
    n_frames = min(round(_SHOWN_SECONDS * fps), next(iter(scores.values())).errors2d.shape[1])
    for name, field, unit, scale in (
        ("errors-over-time-2d.png", "errors2d", "px", 1.0),
        ("errors-over-time-3d.png", "errors3d", "cm", 100.0),
    ):
        curves = {n: getattr(scores[n], field)[0, :n_frames] for n in shown if n in scores}
        over_time = viz.plot_errors_over_time(
            curves, fps, unit=unit, scale=scale, bound=20.0 if unit == "cm" else None,
            title=f"Errors over the first {n_frames / fps:.0f} s (paper's Figure 5)",
        )  # fmt: skip
        add_picture(report, out, name, over_time)
    means = viz.plot_prior_means({"left": prior.left, "right": prior.right})
    add_picture(report, out, "prior-means.png", means)
