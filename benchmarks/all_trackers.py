"""Every tracker with what each shipped prior's recipe brings, by default, on persons never seen.

UB-people (prior of s1 to s6, every n-th sequence of s7 and s8) and UB-one (prior of the first 60 % of
one recording, the first frames of the rest), each with the number of components of kinect-upper-body
and of kinect-upper-body-small. Every method of `torchpose.upper_body.METHODS` runs with its defaults,
beside the mean pose of the training persons. What was fitted and tracked is kept in the folder, so that
a run that was stopped goes on.

    python -m benchmarks.all_trackers --data DIR --out DIR
    python -m benchmarks.all_trackers --data DIR --out DIR --every 12 --frames 300 --windows false
"""

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks.ub_one import split_recording
from benchmarks.ub_people import mean_pose, people
from torchpose._core.files import check_output_folder
from torchpose.camera import PinholeCamera
from torchpose.evaluation import Report
from torchpose.evaluation.common import (
    MEASURED,
    Estimate,
    Trials,
    cached_prior,
    centred_on_neck,
    make_test_set,
    projected_training_poses,
    score,
    settings_hash,
)
from torchpose.evaluation.kept_runs import keep, read_kept
from torchpose.io import Recording
from torchpose.learning._recipes import fit_kinect_prior
from torchpose.priors import UpperBodyPrior
from torchpose.upper_body import METHODS, UpperBodyTracker, method_options

CAMERA = PinholeCamera(525.0, 525.0, 319.5, 239.5, 640, 480)
RECIPES: dict[str, dict[str, Any]] = {
    "kinect-upper-body": {"n_components": 30},
    "kinect-upper-body-small": {"n_components": 10, "window_components": 48},
}
WINDOWS = "window-mixture"


class Run(NamedTuple):
    """Poses and sample sizes of a method: as `Estimate`, and [B, T, 2]."""

    joints2d: Tensor
    joints3d: Tensor
    covariance3d: Tensor
    effective_sample_size: Tensor


def run_method(prior: UpperBodyPrior, test: Trials, method: str, arguments: Any) -> Run:
    """Track a test set, or read what the same call gave before."""
    facts = [method, test.keypoints, prior.left.means, *prior.noise.values(), arguments.particles]
    path = arguments.out / f"{method}-{settings_hash(facts)}.npz"
    found = read_kept(path, Run, Run._fields)
    if found is None:
        drawn = "n_particles" in method_options(method)
        particles = {"n_particles": arguments.particles} if drawn else {}
        tracker = UpperBodyTracker(
            prior, CAMERA, method, fps=test.fps, neck=prior.info.neck, max_gap=None, **particles
        )
        generator = [torch.Generator().manual_seed(b) for b in range(len(test.lengths))]
        with torch.inference_mode():
            track = tracker(
                test.keypoints, names=MEASURED, lengths=test.lengths, generator=generator,
                progress=arguments.progress,
            )  # fmt: skip
        found = Run(*(getattr(track, name) for name in Run._fields))
        keep(path, found)
    run: Run = found
    return run


def ub_people(arguments: argparse.Namespace) -> tuple[list[Recording], Trials]:
    """Training recordings and test set: some sequences of persons never seen."""
    train, tested = people(arguments.data)
    tested = tested[:: arguments.every]
    poses = [centred_on_neck(r.upper_body().joints) for r in tested]
    return train, make_test_set(poses, CAMERA, tested[0].fps or 30.0)


def ub_one(arguments: argparse.Namespace) -> tuple[list[Recording], Trials]:
    """The first part of the authors' own recording, and frames of the rest."""
    first, rest = split_recording(arguments.data)
    pose = centred_on_neck(rest.upper_body().joints)[: arguments.frames or None]
    return [first], make_test_set([pose], CAMERA, rest.fps or 30.0)


PROTOCOLS = {"UB-people": ub_people, "UB-one": ub_one}


def compare(
    name: str, recordings: list[Recording], test: Trials, report: Report, arguments: Any
) -> None:
    """A table for each recipe: error, coverage and sample size of every method."""
    still = mean_pose(test, *projected_training_poses(recordings, CAMERA, 20_000))
    for recipe in arguments.recipes:
        settings = RECIPES[recipe]
        if arguments.folds is not None:
            settings = settings | {"calibration_folds": arguments.folds}
        if not arguments.windows:
            settings = settings | {"window_components": 0}
        prior = cached_prior(
            arguments.out,
            recordings,
            fit_kinect_prior,
            arguments.progress,
            seed=0,
            name=name,
            **settings,
        )
        table = report.table(
            f"{name} {recipe}",
            f"{name}, recipe of {recipe}: {len(test.lengths)} sequences, {int(test.lengths.sum())} frames",
            ["3D (cm)", "2D (pixels)", "inside 50 %", "inside 90 %", "sample size, median", "below 2 (%)",
             "lost frames"],
            digits=(2, 1, 0, 0, 1, 0, 0),
        )  # fmt: skip
        bar = tqdm(METHODS, disable=not arguments.progress, desc=f"{name} {recipe}")
        for method in bar:
            bar.set_postfix_str(method)
            if method != WINDOWS or prior.windows:
                table.add(method, row(run_method(prior, test, method, arguments), test))
        found = score(still, test)
        nothing = [None] * 5
        table.add(
            "mean pose",
            [100 * float(found.errors3d.nanmean()), float(found.errors2d.nanmean()), *nothing],
        )
        add_finding(report, f"{name} {recipe}")


def row(run: Run, test: Trials) -> list[float | None]:
    """The numbers of a method."""
    found = score(Estimate(*run[:3]), test)
    if found.coverage is None:
        raise RuntimeError("a track has covariances")
    inside = [100 * float(x) for x in found.coverage.overall]
    size = run.effective_sample_size[test.inside]
    lost = float(run.joints3d[test.inside].isnan().flatten(1).any(1).sum())
    return [
        100 * float(found.errors3d.nanmean()), float(found.errors2d.nanmean()), *inside,
        float(size.nanmedian()), 100 * float((size < 2).double().mean()), lost,
    ]  # fmt: skip


def add_finding(report: Report, key: str) -> None:
    """Say which methods are behind the mean pose."""
    table = report[key]
    still = float(table["mean pose", "3D (cm)"])
    behind = [m for m in METHODS if m in table.rows and not float(table[m, "3D (cm)"]) < still]
    said = f"behind it: {', '.join(behind)}" if behind else "every tracker is ahead of it"
    report.findings.append(f"{table.title.partition(':')[0]}: mean pose {still:.2f} cm, {said}.")


def main() -> None:
    """Fit, track and write the report."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of the recordings")
    parser.add_argument(
        "--out", type=Path, required=True, help="folder for what is kept, and the report"
    )
    parser.add_argument(
        "--every", type=int, default=1, help="take every n-th sequence of UB-people"
    )
    parser.add_argument("--frames", type=int, default=0, help="frames of UB-one (0: all)")
    parser.add_argument("--particles", type=int, default=10_000, help="of each particle filter")
    parser.add_argument(
        "--windows", choices=("true", "false"), default="true", help="fit windows as well"
    )
    parser.add_argument("--folds", type=int, help="of the calibration (default the recipe's)")
    parser.add_argument("--recipes", nargs="+", choices=RECIPES, default=[*RECIPES])
    parser.add_argument("--protocols", nargs="+", choices=PROTOCOLS, default=[*PROTOCOLS])
    parser.add_argument("--progress", action="store_true", help="show bars")
    arguments = parser.parse_args()
    arguments.windows = arguments.windows == "true"
    arguments.out = check_output_folder(arguments.out)
    shown = ("every", "frames", "particles", "windows", "folds", "recipes", "protocols")
    report = Report("All trackers", {name: getattr(arguments, name) for name in shown})
    for name in arguments.protocols:
        compare(name, *PROTOCOLS[name](arguments), report, arguments)
    report.save(arguments.out)
    print((arguments.out / "report.md").read_text())


if __name__ == "__main__":
    main()
