"""Tables, findings and pictures of UB-people."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from benchmarks._upper_body import Scores
from torchpose.evaluation import Report
from torchpose.evaluation._person_tables import SHORT_NAMES
from torchpose.evaluation._report import Table
from torchpose.evaluation._trials import HANDS, Trials, add_picture
from torchpose.metrics import jitter
from torchpose.metrics._pose_errors import PCP, share_below
from torchpose.priors import UpperBodyPrior

MAIN, LAGGED, SMOOTHED = "MKF filtered", "MKF fixed lag", "MKF smoothed"
DEFAULT = "windows and bones"
UNCALIBRATED = "MKF filtered, uncalibrated"
BASELINE = "MKF paper, hand-set noise"
MEAN_POSE, NEIGHBOUR = "mean pose", "nearest neighbour"


def add_error_tables(
    report: Report,
    scores: dict[str, Scores],
    moved: dict[str, Scores],
    still: Trials,
    moving: Trials,
) -> None:
    """Add 3D and 2D errors, with the root at rest and moving."""
    for key, title, found in (
        ("errors", "every frame centred on its neck", scores),
        ("moving_root", "moving root: a circle of 0.3 m on the floor in 4 s", moved),
    ):
        table = report.table(
            f"{key}_3d",
            f"3D error after Procrustes (cm), {title}",
            ["mean", "hands < 20 cm (%)", "jitter (m/s2)", *SHORT_NAMES],
            digits=(2, 1, 1, *[1] * 8),
        )
        pixels = report.table(
            f"{key}_2d", f"2D error (pixels), {title}", ["mean", *SHORT_NAMES], digits=(2, *[1] * 8)
        )
        for name, s in found.items():
            hands = s.errors3d[..., list(HANDS)]
            share, _ = share_below(hands, 0.2)
            table.add(name, [
                s.mean_error, 100 * float(share.mean()), float(s.jitter.mean()),
                *(100 * s.errors3d.flatten(0, 1).nanmean(0)).tolist(),
            ])  # fmt: skip
            by_joint = s.errors2d.flatten(0, 1).nanmean(0)
            pixels.add(name, [float(s.errors2d.nanmean()), *by_joint.tolist()])
        own = _own_jitter(still if key == "errors" else moving)
        table.note = f"Jitter is the mean acceleration; the Kinect's own is {own:.1f} m/s2."
        pixels.note = "The mean pose is put on the measured neck."


def _own_jitter(test: Trials) -> float:
    long = test.lengths > 2
    each = jitter(test.truth3d[long], test.fps).mean(-1)
    triples = (test.lengths[long] - 2).double()
    return float((each * triples).sum() / triples.sum())


def add_pcp_table(report: Report, limbs: Mapping[str, PCP]) -> None:
    """Add the share of correct upper arms and forearms at some thresholds."""
    marks = (0.1, 0.2, 0.3, 0.5)
    columns = [f"{part} {m:g}" for part in ("upper arm", "forearm") for m in marks]
    title = "Correct limbs in the image (%), both ends within a share of the limb"
    table = report.table("pcp", title, columns)
    for name, found in limbs.items():
        at = [int((found.thresholds - m).abs().argmin()) for m in marks]
        pairs = ([0, 2], [1, 3])
        table.add(name, [100 * float(found.per_limb[pair, i].mean()) for pair in pairs for i in at])


def add_calibration_table(report: Report, prior: UpperBodyPrior, scores: dict[str, Scores]) -> None:
    """Add the share of true joints inside the ellipsoids, before and after calibration."""
    table = report.table(
        "coverage",
        "True 3D joints inside the 50 % and 90 % ellipsoids (%), Procrustes rotation applied",
        ["level", "all", *SHORT_NAMES],
        digits=0,
    )
    for name, s in scores.items():
        if s.coverage is None:
            continue
        for level, overall, each in zip(
            s.coverage.levels, s.coverage.overall, s.coverage.per_joint, strict=True
        ):
            at = round(100 * float(level))
            values = [100 * float(overall), *(100 * each).tolist()]
            table.add(f"{name}, {at} %", [at, *values])
    if any(k.startswith("calibration") for k in prior.noise):
        table.note = (
            "With the prior's calibration, which was fitted on training persons, except for hand-set "
            "noise and where it says 'uncalibrated'."
        )
    else:
        table.note = "This prior brings no calibration."


def add_findings(report: Report) -> None:
    """Add sentences on what smoothing, noise and transition gave, and on how calibrated it is."""
    errors = report["errors_3d"]

    def mean(name: str) -> float:
        return float(errors[name, "mean"])

    names = list(errors.rows)
    report.findings.append(
        f"Fixed tracks: {mean(MAIN):.2f} cm filtered, {mean(SMOOTHED):.2f} cm smoothed; "
        f"mean pose {mean(MEAN_POSE):.2f} cm, nearest neighbour {mean(NEIGHBOUR):.2f} cm."
    )
    gains = ", ".join(
        f"{name} {mean(name) - mean(MAIN):+.2f}"
        for name in names
        if name not in (MAIN, MEAN_POSE, NEIGHBOUR) and "uncalibrated" not in name
    )
    report.findings.append(f"Against '{MAIN}', in cm: {gains}.")
    moved = report["moving_root_3d"]
    report.findings.append(
        f"With a moving root: {float(moved[MAIN, 'mean']):.2f} cm filtered "
        f"({float(moved[MAIN, 'mean']) - mean(MAIN):+.2f}), "
        f"{float(moved[SMOOTHED, 'mean']):.2f} cm smoothed."
    )
    table = report["coverage"]
    for name in (MAIN, f"{DEFAULT}, filtered", UNCALIBRATED, BASELINE):
        rows = [row for row in table.rows if row in (f"{name}, 50 %", f"{name}, 90 %")]
        if rows:
            report.findings.append(f"Coverage of '{name}': {_coverage_text(table, rows)}")


def _coverage_text(table: Table, rows: list[str]) -> str:
    """Return how far shares in ellipsoids are from nominal, and how they hold elbows."""
    gaps = {
        f"{joint} at {table[row, 'level']} %": float(table[row, joint]) - table[row, "level"]
        for row in rows
        for joint in SHORT_NAMES
    }
    worst = max(gaps, key=lambda k: abs(gaps[k]))
    hidden = [j for j in SHORT_NAMES if j.startswith("elbow")]
    elbows = sum(float(table[rows[-1], j]) for j in hidden) / len(hidden)
    return (
        f"the furthest from nominal is {worst}, by {gaps[worst]:+.0f} "
        f"points; {sum(abs(g) <= 5 for g in gaps.values())} of {len(gaps)} are within 5 points; "
        f"elbows, which are never measured, are inside their 90 % ellipsoid "
        f"{elbows:.0f} % of the time."
    )


def add_pictures(report: Report, out: Path, scores: dict[str, Scores]) -> None:
    """Add bars of the errors, curves of correct limbs, reliability."""
    from torchpose import viz

    usual = (f"{DEFAULT}, filtered", f"{DEFAULT}, smoothed")
    shown = [n for n in (*usual, MAIN, SMOOTHED, BASELINE, NEIGHBOUR, MEAN_POSE) if n in scores]
    bars = viz.plot_error_bars(
        {n: scores[n].errors3d for n in shown}, title="3D error on persons never seen"
    )
    add_picture(report, out, "errors-3d.png", bars)
    flat = viz.plot_error_bars(
        {n: scores[n].errors2d for n in shown}, "px", 1.0, title="2D error on persons never seen"
    )
    add_picture(report, out, "errors-2d.png", flat)
    curves = viz.plot_pcp({n: scores[n].limbs for n in shown}, by_limb=True, title="Correct limbs")
    add_picture(report, out, "pcp.png", curves)
    held = {
        n: scores[n].reliability
        for n in (usual[0], MAIN, SMOOTHED, UNCALIBRATED, BASELINE)
        if n in scores
    }
    known = {n: curve for n, curve in held.items() if curve is not None}
    diagram = viz.plot_reliability(known, title="Calibration of the 3D covariances")
    add_picture(report, out, "reliability.png", diagram)
