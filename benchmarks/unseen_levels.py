"""Shares of the true joints inside ellipsoids of seven levels, on sets that are left out of every fit.

Sets, recordings and priors are those of `unseen_sets`. The squared Mahalanobis distances of elbows and
wrists (or hands) from the middle of the shoulders are chi-square with three degrees of freedom if the
covariances are right.

    python -m benchmarks.unseen_levels --data DIR [--every 2] [--out FILE]

A table for each method, with all joints measured and with few. The columns:

- the shares at each level;
- with others' radii: the same if the ellipsoids of a level had the radius that the other three sets need on
  average, which is the best that a constant shape of the density (as Student's t) can do;
- with its own factor: the same if the covariances of each recording were multiplied by the factor that its
  median needs, so that what differs from the level is the shape within a recording;
- factor: the least, the middle and the greatest of these.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks import bones
from benchmarks._command import run_command
from benchmarks._table_file import TableFile, print_tables
from benchmarks.unseen_sets import NAMES, Unseen, leave_out
from torchpose.evaluation import Report
from torchpose.metrics._calibration import chi2_quantile, mahalanobis_squared

LEVELS = (0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.99)
METHODS = ("multiple-model", "articulated")
_HALF, _MOST = LEVELS.index(0.5), LEVELS.index(0.9)
_COLUMNS = (
    *(f"inside {100 * level:.0f} %" for level in LEVELS),
    "with others' radii, 50 %", "90 %", "with its own factor, 90 %", "99 %",
    "least factor", "middle", "greatest",
)  # fmt: skip
_DIGITS = (0,) * 11 + (2,) * 3

Distances = Sequence[Float[Tensor, " N"]]
"""Squared Mahalanobis distances of each recording of a set."""


def distances(unseen: Unseen, method: str, few: bool, every: int) -> Distances:
    """Return the squared distances of a method on each recording of a set.

    Args:
        unseen: a set that is left out. method: its name. few: whether neck, hands and head alone are
            measured. every: one recording in so many.
    """
    options, chosen = (
        bones.trackers(unseen.arms, unseen.network)[method],
        unseen.few if few else None,
    )
    found = []
    for view in unseen.views[::every]:
        poses = bones.poses_of(view, unseen.prior, chosen, **options)
        squared = mahalanobis_squared(*bones.limbs(view, poses))
        found.append(squared[squared.isfinite()])
    return found


def add_table(report: Report, title: str, sets: dict[str, Distances]) -> None:
    """Add the table of a method.

    Args:
        report: of all methods. title: of the table. sets: the distances on each set.
    """
    nominal = torch.tensor(LEVELS, dtype=torch.float64)
    bounds = chi2_quantile(nominal)
    table = report.table(title, title, _COLUMNS, digits=_DIGITS)
    # averaged as logs, since sets differ by factors
    needed = {name: torch.cat([*d]).quantile(nominal).log() for name, d in sets.items()}
    for name, recordings in sets.items():
        others = [radii for other, radii in needed.items() if other != name]
        radii = torch.stack(others).mean(0).exp() if others else bounds * torch.nan
        factors = torch.stack([d.median() for d in recordings]) / bounds[_HALF]
        own = torch.cat([d / factor for d, factor in zip(recordings, factors, strict=True)])
        whole = torch.cat([*recordings])
        row = [
            _inside(whole, bounds),
            _inside(whole, radii)[[_HALF, _MOST]] if others else radii[:2],
            _inside(own, bounds)[[_MOST, -1]],
            factors.quantile(torch.tensor([0.0, 0.5, 1.0], dtype=factors.dtype)),
        ]
        table.add(name.split("/")[0], torch.cat(row))


def _inside(squared: Float[Tensor, " N"], bounds: Float[Tensor, " L"]) -> Float[Tensor, " L"]:
    """Return the percentages of squared distances within bounds."""
    return 100 * (squared[:, None] <= bounds).double().mean(0)


def main(
    *,
    data: Path,
    every: int = 1,
    threads: int = 2,
    out: TableFile | None = None,
    quick: bool = False,
) -> None:
    """Print the tables.

    Args:
        data: folder with the sets.
        every: one in so many of the recordings that `unseen_sets` scores.
        threads: cores.
        out: file for the same as Markdown, or a folder.
        quick: one set, few recordings.
    """
    torch.set_num_threads(threads)
    sets = {name: leave_out(data, name, quick, ()) for name in (NAMES[-1:] if quick else NAMES)}
    report = Report("Levels on sets that nobody knows")
    for method in METHODS:
        for few in (False, True):
            title = f"{method}, {'neck, hands and head' if few else 'all joints'}"
            found = {name: distances(unseen, method, few, every) for name, unseen in sets.items()}
            add_table(report, title, found)
    print_tables(report, out)


if __name__ == "__main__":
    run_command(main)
