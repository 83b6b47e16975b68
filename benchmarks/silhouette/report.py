"""Reports of the protocol Silhouette: of one condition with all its tables, or of several in a row."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks.silhouette.pictures import (
    plot_errors_by_condition,
    plot_errors_by_part,
    plot_errors_by_time,
    plot_silhouettes,
)
from benchmarks.silhouette.runs import Run, Runs, Tuning, sequence_name
from benchmarks.silhouette.tables import (
    add_differences,
    add_errors,
    add_parts,
    add_pooled,
    add_setup,
    add_tuning,
    mean_of,
    part_errors,
    pooled_std,
    write_csv,
)
from benchmarks.silhouette.trackees import METHODS, Trackee
from torchpose.evaluation import Report
from torchpose.evaluation.common import add_picture

__all__ = ["Cell", "fill_one", "fill_several"]


class Cell(NamedTuple):
    """All runs with one number of particles and one size of silhouettes.

    Attributes:
        n_particles: likelihoods a frame. size: of the silhouettes, such as 160x120.
        trackees: who is tracked. tunings, runs: by method.
    """

    n_particles: int
    size: str
    trackees: Sequence[Trackee]
    tunings: Mapping[str, Tuning]
    runs: Runs


def fill_one(report: Report, cell: Cell, out: Path, fps: float, seed: int) -> None:
    """All tables, findings and pictures of one condition, and runs.csv."""
    runs, trackees = cell.runs, cell.trackees
    add_errors(report, runs)
    add_parts(report, runs)
    add_pooled(report, runs, fps)
    if _comparable(runs):
        add_differences(report, runs)
        report.findings += _order(runs)
    add_tuning(report, cell.tunings)
    add_setup(report, trackees)
    write_csv(out / "runs.csv", runs, fps, seed)
    add_picture(report, out, "error-over-time.png", plot_errors_by_time(runs, fps))
    add_picture(report, out, "error-by-part.png", plot_errors_by_part(runs))
    trackee = trackees[0]
    view = trackee.tests[0]
    name = sequence_name(trackee, view)
    last = list(runs)[-1]
    shown: list[tuple[str, Run]] = [(METHODS[last].label, runs[last][name][0])]
    title = f"{name}: silhouettes and estimates"
    figure = plot_silhouettes(trackee, view, shown, n_frames=6, title=title)
    add_picture(report, out, "silhouettes.png", figure)


def fill_several(report: Report, cells: Sequence[Cell], out: Path, fps: float, seed: int) -> None:
    """Errors over particles or sizes, and the tables of each; a runs-....csv for each."""
    by_name = _named(cells)
    _add_conditions(report, by_name)
    given = not any(t.tried for cell in cells for t in cell.tunings.values())
    for name, cell in by_name.items():
        if _comparable(cell.runs):
            add_differences(report, cell.runs, name)
            report.findings += [f"{name}: {text}" for text in _order(cell.runs)]
        if not given:
            add_tuning(report, cell.tunings, name)
        write_csv(out / f"runs-{cell.n_particles}-{cell.size}.csv", cell.runs, fps, seed)
    if given:  # the same everywhere
        add_tuning(report, cells[0].tunings)
    for name, cell in by_name.items():
        add_errors(report, cell.runs, name)
    for size, cell in {cell.size: cell for cell in cells}.items():
        add_setup(report, cell.trackees, size)
    figure = plot_errors_by_condition({name: cell.runs for name, cell in by_name.items()})
    add_picture(report, out, "error-by-condition.png", figure)


def _named(cells: Sequence[Cell]) -> dict[str, Cell]:
    """Cells by what they differ in."""
    one_size = len({cell.size for cell in cells}) == 1
    one_number = len({cell.n_particles for cell in cells}) == 1

    def name(cell: Cell) -> str:
        number = "" if one_number else f"{cell.n_particles:,} likelihoods"
        size = "" if one_size else cell.size
        return ", ".join(part for part in (number, size) if part)

    return {name(cell): cell for cell in cells}


def _add_conditions(report: Report, cells: Mapping[str, Cell]) -> None:
    """One row for each condition: error, spread over seeds, error of the arms and time of a frame."""
    methods = {m: METHODS[m].label for m in next(iter(cells.values())).runs}
    columns = [
        c for label in methods.values() for c in (label, f"± {label}", f"arms {label}", f"ms {label}")
    ]  # fmt: skip
    table = report.table(
        "conditions", "Error (mm) over all sequences by condition", columns,
        note="±: standard deviation over seeds, pooled over sequences. Arms: error of elbows and "
        "wrists (mm). ms: of a frame of one run of a batch of seeds.",
    )  # fmt: skip
    for name, cell in cells.items():
        values: list[float] = []
        for method in methods:
            errors = part_errors(cell.runs, method)
            every = [run for seeds in cell.runs[method].values() for run in seeds]
            values += [
                float(mean_of(errors)),
                float(pooled_std(errors)) if errors.shape[1] > 1 else float("nan"),
                float(mean_of(part_errors(cell.runs, method, "arms"))),
                1000 * sum(float(run.seconds) for run in every) / len(every),
            ]
        table.add(name, values)


def _comparable(runs: Runs) -> bool:
    """Whether there is a filter with a manifold and one without."""
    return any(name.startswith("mrpf") for name in runs) and bool({"sir", "apf"} & runs.keys())


def _order(runs: Runs) -> list[str]:
    """Whether the order of the paper's tables appears, in words."""
    if not {"sir", "apf", "mrpf"} <= runs.keys():
        return []
    found = []
    for part in ("", "arms"):
        mean = {name: float(mean_of(part_errors(runs, name, part))) for name in runs}
        best = mean["mrpf"] < min(mean["sir"], mean["apf"])
        what = "arms" if part else "the whole body"
        found.append(
            f"The paper's order {'appears' if best else 'does NOT appear'} for {what}: MRPF "
            f"{mean['mrpf']:.1f} mm, SIR {mean['sir']:.1f} mm, APF {mean['apf']:.1f} mm."
        )
    return found
