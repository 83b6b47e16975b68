"""Tables and findings of the protocol Bend."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from benchmarks.bend.tracking import BendRun, Filter, mean_squared
from benchmarks.bend.variants import BendPerson, Variant, recorded_gap, true_acceptance
from benchmarks.bodies.tracking import part_error
from benchmarks.bodies.views import SEEN, Subject, subjects_of
from benchmarks.engine import (
    Grid,
    Results,
    Row,
    Setting,
    Tuning,
    bootstrap,
    describe,
    mean,
    mean_of,
    pivot,
    spread,
    worst,
)
from benchmarks.engine.statistics import Cell
from torchpose.body import BODY_15
from torchpose.evaluation import Report

CONSTRAINED, FIRST_ORDER = "constrained", "first order"
"""Labels of the trackers."""

GATE = 0.9545
"""Share of a Gaussian within two standard deviations."""

JOINT_ERROR = part_error()
"""Mean distance of the joints of a run, mm."""

_PELVIS = BODY_15.joint("pelvis")


def root_error(run: BendRun) -> Tensor:
    """Return the mean distance of the pelvis, mm."""
    return run.errors[:, _PELVIS].double().nanmean()


def detail(name: str) -> Callable[[BendRun], Tensor]:
    """Return the mean of what a filter reports: acceptance, clamped, released, respread, seconds."""
    return lambda run: getattr(run, name).double().mean()


_ERRORS: dict[str, Cell] = {
    "MSE": mean(mean_squared),
    "± seeds": spread(mean_squared),
    "root (mm)": mean(root_error),
    "joints (mm)": mean(JOINT_ERROR),
}
_SHARES: dict[str, Cell] = {
    "accepted (%)": mean(detail("acceptance"), 100),
    "clamped (%)": mean(detail("clamped"), 100),
}
_MILLISECONDS = mean(detail("seconds"), 1000)


# --- error over the number of particles -----------------------------------------------------------


def add_particles(report: Report, runs: Results) -> None:
    """Add Figure 3 as a table: both trackers over the number of particles, and what it says.

    Args:
        report: gets the table. runs: by number of particles, such as "1,000".
    """
    cells = {
        "MSE, {}": _ERRORS["MSE"], "± seeds, {}": _ERRORS["± seeds"], "worst, {}": worst(mean_squared),
        "root (mm), {}": _ERRORS["root (mm)"], "joints (mm), {}": _ERRORS["joints (mm)"],
        "ms per frame, {}": _MILLISECONDS,
    }  # fmt: skip

    def gated(cell: Cell) -> Cell:
        return lambda own: cell(own.where(method=CONSTRAINED))

    pivot(
        report, "particles", "Error over the number of particles (MSE of the relative angles, degrees^2)",
        runs, ["condition"], cells, columns="method",
        more={name: gated(cell) for name, cell in _SHARES.items()},
        note="Mean over sequences and seeds; ±: standard deviation over seeds, pooled over sequences; "
        "worst: the worst run of all. Root: distance of the pelvis. Accepted: drawn predictions that "
        "the gates let through. Clamped: particles that no draw brought through. Time: of one run of "
        "a batch of seeds.",
    )  # fmt: skip
    _say_particles(report, runs)


def _say_particles(report: Report, runs: Results) -> None:
    """Add findings: whether the paper's two claims hold, with intervals, and how the error falls."""
    errors = {
        (method, int(name.replace(",", ""))): own.values(mean_squared)
        for (method, name), own in runs.by("method", "condition").items()
    }
    numbers = sorted({n for _, n in errors})
    few = 2000 if 2000 in numbers else numbers[len(numbers) // 2]
    most = numbers[-1]
    one, other = errors[CONSTRAINED, few], errors[FIRST_ORDER, most]
    gap, low, high = bootstrap(mean_of, one, other)
    verdict = "no worse" if gap <= 0 else ("not clearly worse" if low <= 0 else "WORSE")
    report.findings.append(
        f"Constrained with {few:,} particles is {verdict} than unconstrained with {most:,}: "
        f"{float(mean_of(one)):.1f} against {float(mean_of(other)):.1f} degrees^2, difference "
        f"{gap:+.1f} (95 % interval {low:+.1f} to {high:+.1f})."
    )
    for label in (CONSTRAINED, FIRST_ORDER):
        found = {n: float(mean_of(errors[label, n])) for n in numbers}
        text = ", ".join(f"{error:.0f} at {n:,}" for n, error in found.items())
        within = [n for n, error in found.items() if error <= 1.2 * min(found.values())]
        small = [float(errors[label, n].max()) for n in numbers if n <= 1000]
        report.findings.append(
            f"{label}: {text} degrees^2; within 20 % of its best from {within[0]:,} particles on; "
            f"worst single run up to 1,000 particles {max(small, default=float('nan')):.0f}."
        )


def csv_columns(
    conditions: Mapping[str, Grid[Any, Filter]],
) -> dict[str, Callable[[Row], Any]]:
    """Return the columns of runs.csv, as functions of a row.

    Args:
        conditions: of the runs, by name; their filters' variants are told.
    """

    def variant(field: str) -> Callable[[Row], Any]:
        return lambda row: getattr(conditions[row.condition].methods[row.method].variant, field)

    def number(measure: Callable[[BendRun], Tensor]) -> Callable[[Row], str]:
        return lambda row: f"{float(measure(row.run)):.4f}"

    return {
        "sequence": lambda row: row.subject,
        **{name: variant(name) for name in Variant._fields},
        "seed": lambda row: row.seed, "mse_degrees2": number(mean_squared),
        "root_mm": number(root_error), "joints_mm": number(JOINT_ERROR),
        "acceptance": number(lambda run: run.acceptance.mean()),
        "clamped": number(lambda run: run.clamped.mean()),
        "respread_frames": lambda row: int(row.run.respread.sum()),
        "ms_per_frame": lambda row: f"{1000 * float(row.run.seconds):.2f}",
    }  # fmt: skip


# --- dimensions, limbs, settings, sequences -------------------------------------------------------


def add_dimensions(report: Report, runs: Results, tracked_persons: Sequence[BendPerson]) -> None:
    """Add the number of dimensions: what is rejected, of predictions and of true postures.

    Args:
        report: gets the table. runs: by number of dimensions, "0" for the first order alone.
        tracked_persons: whose postures are put to the gates.
    """
    shares = {
        name: torch.tensor([true_acceptance(t, int(name)) for t in tracked_persons]).mean(0)
        for name in runs.names("condition")
        if name != "0"
    }

    def gated(value: Callable[[str], float]) -> Cell:
        def cell(own: Results) -> float:
            (name,) = own.names("condition")
            return value(name) if name in shares else float("nan")

        return cell

    def share(person: int, way: int) -> Cell:
        return gated(lambda name: 100 * float(shares[name][person, way]))

    table = pivot(
        report, "dimensions", "Dimensions of the action space, at the same number of particles",
        runs, ["condition"],
        {
            **_ERRORS, **_SHARES, "true, unseen (%)": share(0, 0), "best match": share(0, 1),
            "any match": share(0, 2), "true, trained (%)": share(1, 0),
            "at best (%)": gated(lambda name: 100 * GATE ** int(name)),
        },
        note="Accepted: of the drawn predictions. True: postures of recorded performances that pass "
        "the gates about the posture drawn for them (AS 6), of the person who is left out (also "
        "about the most likely posture, and about any) and of one who trained. At best: a Gaussian "
        "posture that matches its own mean, 0.9545^D. D = 0 is the first order model without gates.",
    )  # fmt: skip
    errors = {name: float(table[name, "MSE"]) for name in shares}
    if errors:
        best = min(errors, key=lambda name: errors[name])
        report.findings.append(
            f"Of the dimensions tried, D = {best} has the smallest error ({errors[best]:.1f} "
            f"degrees^2); " + ", ".join(f"D = {d}: {e:.1f}" for d, e in errors.items()) + "."
        )


def add_limb_shapes(report: Report, runs: Results) -> None:
    """Add rectangles, as published, against tapered cylinders.

    Args:
        report: gets the table. runs: by shape.
    """
    pivot(
        report, "limbs", "Limbs of the likelihood (AS 7), at the same number of particles", runs,
        ["method", "condition"], {**_ERRORS, "ms per frame": _MILLISECONDS},
        note="Every row with exponent and diffusion of its own, chosen with the same budget; radii are "
        "fitted with cylinders.",
    )  # fmt: skip


def add_tuning(report: Report, tunings: Mapping[str, Tuning]) -> None:
    """Add the settings that the clips of other persons chose for every tracker."""

    def flat(found: Tuning) -> float:
        return found.error_of(Setting(1.0, found.setting.scale))

    describe(
        report, "tuning", "What other persons' clips chose: the setting with the smallest error", tunings,
        {
            "sharpness": lambda found: found.setting.value,
            "diffusion": lambda found: found.setting.scale, "MSE": lambda found: found.error,
            "sharpness 1": flat, "tried: sharpness x diffusion, MSE": lambda found: found.text(),
        },
        digits=(0, 1, 1, 1, 0),
        note="Sharpness: exponent of the intersection over union, 1 as published. Diffusion: factor of "
        "sigma_phi, 1 being the error of a constant velocity on the training performances. First the "
        "diffusion is chosen, then the sharpness; the same settings, clips and seeds for all.",
    )  # fmt: skip


def add_sequences(report: Report, tracked_persons: Sequence[BendPerson]) -> None:
    """Add whom the cameras see, and how near the tracker's body can come."""
    floor, overlap, in_view = SEEN.items()

    def trained(subject: Subject[BendPerson]) -> int:
        return len(subject.person.split.manifold)

    describe(
        report, "sequences", "Sequences", subjects_of(tracked_persons),
        {
            "frames": lambda subject: len(subject.view.clip), "training performances": trained,
            **dict([floor, ("recorded angles", recorded_gap), overlap, in_view]),
        },
        digits=(0, 0, 1, 1, 2, 1),
        note="Nearest state: error of the tracker's body fitted to the recorded joints; its angles are "
        "the truth. Recorded angles: mean squared difference of these from the angles of the recorded "
        "joints, degrees^2, whose clavicles are short and move. Overlap: intersection over union of "
        "that body's silhouettes with those that are tracked.",
    )  # fmt: skip
