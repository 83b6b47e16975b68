"""Run experiments: a grid of subjects, methods, conditions and seeds; kept runs; one table; reports.

- `Experiment` says how one run is made and what it depends on. It runs the cells of its grids that are
  missing in a folder, and returns `Results`: one row for each run.
- `pivot` and `describe` put tables of these rows into a report, `write_csv` writes them to a file, and
  `plot_by_condition` draws them.
- `choose_setting` and `search_setting` choose what a method is run with.
"""

from benchmarks.engine.experiment import Experiment, Grid, Results, Row
from benchmarks.engine.kept import kept_prior, kept_runs, source_hash
from benchmarks.engine.pictures import plot_by_condition
from benchmarks.engine.statistics import (
    bootstrap,
    mean,
    mean_of,
    pooled_std,
    spread,
    worst,
    worst_of,
)
from benchmarks.engine.tables import describe, pivot, write_csv
from benchmarks.engine.tuning import (
    Setting,
    Tuning,
    choose_setting,
    read_settings,
    search_setting,
)

__all__ = [
    "Experiment",
    "Grid",
    "Results",
    "Row",
    "Setting",
    "Tuning",
    "bootstrap",
    "choose_setting",
    "describe",
    "kept_prior",
    "kept_runs",
    "mean",
    "mean_of",
    "pivot",
    "plot_by_condition",
    "pooled_std",
    "read_settings",
    "search_setting",
    "source_hash",
    "spread",
    "worst",
    "worst_of",
    "write_csv",
]
