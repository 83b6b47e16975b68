"""Tables of the protocol Bend, and what they say in words."""

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.bend.runs import BendRun, BendRuns, mean_squared
from benchmarks.bend.trackees import BendTrackee, Variant, true_acceptance
from benchmarks.silhouette.runs import Tuning, sequence_name
from benchmarks.silhouette.tables import bootstrap, mean_of, pooled_std
from torchpose.body import BODY_15
from torchpose.evaluation import Report
from torchpose.evaluation.report import RESULTS
from torchpose.io._results import replace_own

__all__ = [
    "GATE",
    "add_dimensions",
    "add_limb_shapes",
    "add_particles",
    "add_sequences",
    "add_tuning",
    "details_mean",
    "joint_error",
    "root_error",
    "write_csv",
]

GATE = 0.9545
"""Share of a Gaussian within two standard deviations."""

_PELVIS = BODY_15.joint("pelvis")
_ROWS = {True: "constrained", False: "first order"}


def joint_error(runs: Mapping[str, Sequence[BendRun]]) -> Float[Tensor, "Q S"]:
    """Mean distance of the joints, mm, of every sequence and seed."""
    return _each(runs, lambda run: run.errors.double().nanmean())


def root_error(runs: Mapping[str, Sequence[BendRun]]) -> Float[Tensor, "Q S"]:
    """Mean distance of the pelvis, mm, of every sequence and seed."""
    return _each(runs, lambda run: run.errors[:, _PELVIS].double().nanmean())


def details_mean(runs: Mapping[str, Sequence[BendRun]], name: str) -> float:
    """Mean over everything of what a filter reports: acceptance, clamped, released, respread, seconds."""
    return float(_each(runs, lambda run: getattr(run, name).double().mean()).mean())


def _each(
    runs: Mapping[str, Sequence[BendRun]], value: Callable[[BendRun], Tensor]
) -> Float[Tensor, "Q S"]:
    return torch.stack([torch.stack([value(run) for run in seeds]) for seeds in runs.values()])


def _spread(errors: Float[Tensor, "Q S"]) -> float:
    return float(pooled_std(errors)) if errors.shape[1] > 1 else float("nan")


# --- error over the number of particles -----------------------------------------------------------


def add_particles(report: Report, runs: BendRuns) -> None:
    """Figure 3 as a table: both trackers over the number of particles, and what it says."""
    names = ["MSE", "± seeds", "worst", "root (mm)", "joints (mm)", "ms per frame"]
    table = report.table(
        "particles", "Error over the number of particles (MSE of the relative angles, degrees^2)",
        [*(f"{n}, constrained" for n in names), *(f"{n}, first order" for n in names),
         "accepted (%)", "clamped (%)"],
        note="Mean over sequences and seeds; ±: standard deviation over seeds, pooled over sequences; "
        "worst: the worst run of all. Root: distance of the pelvis. Accepted: drawn predictions that "
        "the gates let through. Clamped: particles that no draw brought through. Time: of one run of "
        "a batch of seeds.",
    )  # fmt: skip
    for n in sorted({variant.particles for variant in runs}):
        cells: list[float] = []
        for constrained in (True, False):
            found = runs[_variant(runs, constrained, n)]
            errors = mean_squared(found)
            cells += [
                float(mean_of(errors)), _spread(errors), float(errors.max()),
                float(mean_of(root_error(found))), float(mean_of(joint_error(found))),
                1000 * details_mean(found, "seconds"),
            ]  # fmt: skip
        gated = runs[_variant(runs, True, n)]
        cells += [100 * details_mean(gated, name) for name in ("acceptance", "clamped")]
        table.add(f"{n:,}", cells)
    _say_particles(report, runs)


def _say_particles(report: Report, runs: BendRuns) -> None:
    """Whether the paper's two claims hold, with intervals, and how the error falls."""
    numbers = sorted({variant.particles for variant in runs})
    few = 2000 if 2000 in numbers else numbers[len(numbers) // 2]
    most = numbers[-1]
    one = mean_squared(runs[_variant(runs, True, few)])
    other = mean_squared(runs[_variant(runs, False, most)])
    gap, low, high = bootstrap(mean_of, one, other)
    verdict = "no worse" if gap <= 0 else ("not clearly worse" if low <= 0 else "WORSE")
    report.findings.append(
        f"Constrained with {few:,} particles is {verdict} than unconstrained with {most:,}: "
        f"{float(mean_of(one)):.1f} against {float(mean_of(other)):.1f} degrees^2, difference "
        f"{gap:+.1f} (95 % interval {low:+.1f} to {high:+.1f})."
    )
    for constrained, label in _ROWS.items():
        small = [n for n in numbers if n <= 1000]
        found = {n: mean_squared(runs[_variant(runs, constrained, n)]) for n in numbers}
        text = ", ".join(f"{float(mean_of(found[n])):.0f} at {n:,}" for n in numbers)
        best = min(float(mean_of(f)) for f in found.values())
        worst = max(float(found[n].max()) for n in small) if small else float("nan")
        within = [n for n in numbers if float(mean_of(found[n])) <= 1.2 * best]
        report.findings.append(
            f"{label}: {text} degrees^2; within 20 % of its best from {within[0]:,} particles on; "
            f"worst single run up to 1,000 particles {worst:.0f}."
        )


def _variant(runs: BendRuns, constrained: bool, particles: int) -> Variant:
    return next(v for v in runs if v.constrained == constrained and v.particles == particles)


# --- dimensions, limbs, settings, sequences -------------------------------------------------------


def add_dimensions(report: Report, runs: BendRuns, trackees: Sequence[BendTrackee]) -> None:
    """The number of dimensions: what is rejected, of predictions and of true postures."""
    table = report.table(
        "dimensions", "Dimensions of the action space, at the same number of particles",
        ["MSE", "± seeds", "root (mm)", "joints (mm)", "accepted (%)", "clamped (%)",
         "true, unseen (%)", "best match", "any match", "true, trained (%)", "at best (%)"],
        note="Accepted: of the drawn predictions. True: postures of recorded performances that pass "
        "the gates about the posture drawn for them (AS 6), of the person who is left out (also "
        "about the most likely posture, and about any) and of one who trained. At best: a Gaussian "
        "posture that matches its own mean, 0.9545^D. D = 0 is the first order model without gates.",
    )  # fmt: skip
    for variant, found in runs.items():
        errors = mean_squared(found)
        cells = [float(mean_of(errors)), _spread(errors), float(mean_of(root_error(found))),
                 float(mean_of(joint_error(found)))]  # fmt: skip
        if variant.constrained:
            d = variant.dimensions
            shares = torch.tensor([true_acceptance(t, d) for t in trackees]).mean(0)
            cells += [100 * details_mean(found, n) for n in ("acceptance", "clamped")]
            cells += [*(100 * shares[0]).tolist(), 100 * float(shares[1, 0]), 100 * GATE**d]
        else:
            cells += [float("nan")] * 7
        table.add(f"{variant.dimensions if variant.constrained else 0}", cells)
    gated = {
        v.dimensions: float(mean_of(mean_squared(r))) for v, r in runs.items() if v.constrained
    }
    if gated:
        best = min(gated, key=lambda d: gated[d])
        report.findings.append(
            f"Of the dimensions tried, D = {best} has the smallest error ({gated[best]:.1f} "
            f"degrees^2); " + ", ".join(f"D = {d}: {e:.1f}" for d, e in gated.items()) + "."
        )


def add_limb_shapes(report: Report, runs: BendRuns) -> None:
    """Rectangles, as published, against tapered cylinders."""
    table = report.table(
        "limbs", "Limbs of the likelihood (AS 7), at the same number of particles",
        ["MSE", "± seeds", "root (mm)", "joints (mm)", "ms per frame"],
        note="Every row with exponent and diffusion of its own, chosen with the same budget; radii are "
        "fitted with cylinders.",
    )  # fmt: skip
    for variant, found in runs.items():
        errors = mean_squared(found)
        table.add(f"{variant.label}, {variant.limb_shape}", [
            float(mean_of(errors)), _spread(errors), float(mean_of(root_error(found))),
            float(mean_of(joint_error(found))), 1000 * details_mean(found, "seconds"),
        ])  # fmt: skip


def add_tuning(report: Report, tunings: Mapping[str, Tuning]) -> None:
    """What the clips of other persons chose for every tracker."""
    table = report.table(
        "tuning", "What other persons' clips chose: the setting with the smallest error",
        ["sharpness", "diffusion", "MSE", "sharpness 1", "tried: sharpness x diffusion, MSE"],
        digits=(0, 1, 1, 1, 0),
        note="Sharpness: exponent of the intersection over union, 1 as published. Diffusion: factor of "
        "sigma_phi, 1 being the error of a constant velocity on the training performances. First the "
        "diffusion is chosen, then the sharpness; the same settings, clips and seeds for all.",
    )  # fmt: skip
    for name, found in tunings.items():
        errors = dict(zip(found.tried, found.errors, strict=True))
        flat = [e for s, e in errors.items() if s.value == 1 and s.scale == found.setting.scale]
        text = "; ".join(f"{s.value:g} x {s.scale:g}, {e:.0f}" for s, e in errors.items())
        cells = [*found.setting, found.error, flat[0] if flat else None, text or "-"]
        table.add(name, cells)


def add_sequences(report: Report, trackees: Sequence[BendTrackee]) -> None:
    """Whom the cameras see, and how near the tracker's body can come."""
    table = report.table(
        "sequences", "Sequences",
        ["frames", "training performances", "nearest state (mm)", "recorded angles", "overlap",
         "in view (%)"],
        digits=(0, 0, 1, 1, 2, 1),
        note="Nearest state: error of the tracker's body fitted to the recorded joints; its angles are "
        "the truth. Recorded angles: mean squared difference of these from the angles of the recorded "
        "joints, degrees^2, whose clavicles are short and move. Overlap: intersection over union of "
        "that body's silhouettes with those that are tracked.",
    )  # fmt: skip
    for trackee in trackees:
        for view, gap in zip(trackee.tests, trackee.recorded_gap, strict=True):
            table.add(sequence_name(trackee, view), [
                len(view.clip), len(trackee.split.manifold), view.floor, gap, view.overlap,
                100 * view.in_view,
            ])  # fmt: skip


def write_csv(path: Path, runs: BendRuns, first_seed: int = 0) -> None:
    """One line for every run."""
    with (
        replace_own(path, RESULTS) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as out,
    ):
        writer = csv.writer(out)
        writer.writerow(["sequence", *Variant._fields, "seed", "mse_degrees2", "root_mm", "joints_mm",
                         "acceptance", "clamped", "respread_frames", "ms_per_frame"])  # fmt: skip
        for variant, sequences in runs.items():
            roots, joints = root_error(sequences), joint_error(sequences)
            for i, (name, seeds) in enumerate(sequences.items()):
                for s, run in enumerate(seeds):
                    numbers = [run.squared.double().mean(), roots[i, s], joints[i, s],
                               run.acceptance.mean(), run.clamped.mean()]  # fmt: skip
                    writer.writerow([
                        name, *variant, first_seed + s, *(f"{float(x):.4f}" for x in numbers),
                        int(run.respread.sum()), f"{1000 * float(run.seconds):.2f}",
                    ])  # fmt: skip
