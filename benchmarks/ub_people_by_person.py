"""Differences between persons: each training person of UB-people, tracked by a prior of the others.

For each of s1 to s6 a prior is fitted to the other five, without calibration, and tracks that person
in the test camera. Scale and floor of the covariances then come from the errors of the other five,
each under the prior that did not know them (`torchpose.learning._recipes.fit_calibration`). The table
shows the error and the share of true joints inside the 50 % and 90 % ellipsoids, person by person:
its spread is what a calibration on a handful of persons can promise for the next one. What was fitted
and tracked is kept in the folder of the report.

    python -m benchmarks.ub_people_by_person --data DIR --out DIR
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks._command import run_command
from benchmarks._upper_body import TRACKING, Tracker, trials_of
from benchmarks.engine import Grid, describe
from benchmarks.ub_people import people
from torchpose._core.files import check_output_folder
from torchpose.evaluation import Report
from torchpose.evaluation._person_tables import SHORT_NAMES
from torchpose.evaluation._trials import Estimate, Trials, cached_prior
from torchpose.evaluation._unseen import QUICK
from torchpose.io import Recording
from torchpose.learning import fit_kinect_prior
from torchpose.learning._recipes import fit_calibration
from torchpose.metrics import align, coverage

LEVELS = (0.5, 0.9)


class Options(NamedTuple):
    """What is fitted and tracked.

    Attributes:
        data: folder of kinect_utd_mhad.
        out: folder for what is kept, and the report.
        window_components: by default as the shipped prior.
        window_samples: by default as the shipped prior.
        every: track every n-th sequence.
        seed: of fits and noise.
        threads: cores.
        quick: small, to see that all of it works.
    """

    data: Path
    out: Path
    window_components: int | None = None
    window_samples: int | None = None
    every: int = 1
    seed: int = 0
    threads: int = 2
    quick: bool = False


class HeldOut(NamedTuple):
    """Aligned estimates, covariances and truth of a person whom the prior never saw, [N, 8, ...]."""

    points: Tensor
    covs: Tensor
    truth: Tensor


def hold_out(
    recordings: list[Recording], options: Options
) -> Iterator[tuple[str, Trials, Tracker]]:
    """Yield every person with sequences and a tracker whose prior is of all others."""
    settings = {"seed": options.seed, "calibration_folds": 0, "name": "ub-people-by-person"}
    if options.quick:
        settings |= QUICK | {"n_samples": 1000, "window_samples": 1000, "window_steps": 2}
    else:
        settings |= {
            "window_components": options.window_components,
            "window_samples": options.window_samples,
        }
    for person in tqdm(sorted({r.person for r in recordings if r.person}), desc="persons held out"):
        seen = [r for r in recordings if r.person != person]
        own = [r for r in recordings if r.person == person][:: options.every]
        prior = cached_prior(options.out, seen, fit_kinect_prior, False, **settings)
        yield person, trials_of(own, options.seed), Tracker(prior, {})


def aligned(found: Estimate, test: Trials) -> HeldOut:
    """Return estimates, covariances and truth of the frames of a person."""
    if found.covariance3d is None:
        raise RuntimeError("the tracker returned no covariances")
    inside = test.inside
    truth = test.truth3d[inside]
    turned = align(found.joints3d[inside], truth, covariance=found.covariance3d[inside])
    if turned.covariance is None:
        raise RuntimeError("align was given covariances and returned none")
    return HeldOut(turned.points, turned.covariance, truth)


def calibrated_coverage(person: str, parts: dict[str, HeldOut]) -> Tensor:
    """Return shares inside the ellipsoids [2, 8], calibrated on all other persons."""
    others = [part for name, part in parts.items() if name != person]
    errors = torch.cat([part.points - part.truth for part in others])
    scale, floor = fit_calibration(errors, torch.cat([part.covs for part in others]), LEVELS)
    own = parts[person]
    covs = own.covs * scale[:, None, None] + floor[:, None, None] * torch.eye(3).double()
    return coverage(own.points, covs, own.truth, levels=LEVELS).per_joint


def fill(report: Report, parts: dict[str, HeldOut]) -> None:
    """Add errors and coverage, with mean and standard deviation over persons."""
    numbers = {
        name: torch.cat([
            100 * (part.points - part.truth).norm(dim=-1).mean()[None],
            100 * calibrated_coverage(name, parts).flatten(),
        ])
        for name, part in parts.items()
    }  # fmt: skip
    over = torch.stack(list(numbers.values()))
    numbers |= {"mean": over.mean(0), "standard deviation": over.std(0)}

    def pair(joint: int) -> Callable[[Tensor], str]:
        return lambda row: f"{row[1 + joint]:.0f} / {row[1 + len(SHORT_NAMES) + joint]:.0f}"

    columns: dict[str, Callable[[Tensor], float | str]] = {"error (cm)": lambda row: float(row[0])}
    columns |= {f"{name}, 50 / 90 %": pair(joint) for joint, name in enumerate(SHORT_NAMES)}
    title = "3D error, and true joints inside the ellipsoids calibrated on all other persons"
    describe(report, "persons", title, numbers, columns, digits=2)


def main(options: Options) -> None:
    """Fit, track, write the report and print it."""
    check_output_folder(options.out)
    torch.set_num_threads(options.threads)
    recordings, _ = people(options.data, options.quick)
    tests, grids = {}, {}
    for person, test, tracker in hold_out(recordings, options):
        tests[person] = test
        grids[person] = Grid({person: test}, {"prior of the others": tracker})
    found = TRACKING.run(grids, (options.seed,), options.out)
    parts = {row.subject: aligned(row.run, tests[row.subject]) for row in found.rows}
    shown = ("window_components", "window_samples", "every", "seed", "quick")
    report = Report("UB-people by person", {name: getattr(options, name) for name in shown})
    fill(report, parts)
    report.save(options.out)
    print(report.to_markdown())


if __name__ == "__main__":
    run_command(main)
