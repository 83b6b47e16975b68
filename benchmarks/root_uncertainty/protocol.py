"""Protocol Root uncertainty: a tracker of root hypotheses against SIR and the annealed filter.

Walks of three persons, rendered as in the protocol Silhouette, are tracked in 3 and 2 cameras and at
60, 30, 20 and 15 frames per second, with the same number of likelihoods a frame, the same diffusion,
leg swap and limb limits for every method, in the manner of Daubney & Xie's Tables 1 and 2 and Figures
8 and 9; and from where a body is not. Errors are distances of joints.
"""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from tqdm.auto import tqdm

from benchmarks.bodies.clips import split_clips
from benchmarks.bodies.pictures import plot_errors_by_time
from benchmarks.bodies.tracking import csv_columns, part_error
from benchmarks.bodies.views import Conditions, image_size
from benchmarks.engine import Setting, Tuning, plot_by_condition, read_settings, write_csv
from benchmarks.root_uncertainty.pictures import add_pictures
from benchmarks.root_uncertainty.recovery import (
    DISPLACEMENTS,
    RECOVERY,
    Displacement,
    add_recovery,
    displaced_grids,
)
from benchmarks.root_uncertainty.report import (
    add_differences,
    add_errors,
    add_order,
    add_rates,
    add_sequences,
    add_speed,
    add_tuning,
)
from benchmarks.root_uncertainty.walkers import (
    FPS,
    METHODS,
    POINTS,
    TRACKING,
    Budget,
    Walker,
    grid_of,
    prepare,
    published,
    slower,
    tune,
    with_cameras,
)
from benchmarks.silhouette.protocol import WALKERS
from torchpose._core.files import check_output_folder
from torchpose.errors import DegenerateFilterWarning, InputError
from torchpose.evaluation import Report
from torchpose.evaluation._trials import add_picture
from torchpose.io import read_mocap
from torchpose.io._mocap import MocapClip

PARTS = ("tables", "rates", "recovery", "all")

SPACED = ("method", "persons", "cameras_used", "fps", "displaced_at")
"""Options that a command line takes as words with blanks between them."""

_N_PERSONS = 3
_VALIDATION_FRAMES = 75
_TRACKED_ON = 1.0  # seconds after a displacement


def run(
    data: str | Path,
    out: str | Path,
    *,
    seed: int = 0,
    progress: bool = True,
    quick: bool = False,
    part: str = "all",
    method: tuple[str, ...] = ("sir", "apf", "root"),
    seeds: int = 5,
    recovery_seeds: int = 3,
    displaced_at: tuple[float, ...] = (0.0,),
    persons: tuple[str, ...] = (),
    frames: int = 150,
    cameras_used: tuple[int, ...] = (3, 2),
    fps: tuple[float, ...] = (60.0, 30.0, 20.0, 15.0),
    particles: int = 800,
    size: str = "160x120",
    faults: float = 1.0,
    likelihood: str = "bidirectional",
    leg_swap: float = 0.02,
    limits: bool = True,
    settings: str = "validation",
) -> Report:
    """Run the protocol; writes report.json, report.md, runs as CSV and pictures to `out`.

    Runs are kept in `out`, one file each: parts may be run one after the other, a killed run goes on
    where it stopped, and ``--part all`` puts together what is there.

    Args:
        data: folder or file of motion capture. out: folder for the results.
        seed: of shapes, faults and the first run. progress: whether to show bars.
        quick: few frames, particles and conditions, to see that all of it works.
        part: tables (errors by person and number of cameras, over time, poses), rates (errors over
            frames per second), recovery (after the body was displaced), or all.
        method: filters, among sir, apf, root (limbs weighed by the share of their pixels), root-pixels
            (by their number, as published).
        seeds: runs of every filter on every clip. recovery_seeds: and after every displacement.
        displaced_at: when bodies are displaced, seconds from the start, one or several.
        persons: who is tracked; CMU's s07, s08 and s35, else the three with most frames. Their other
            trials train.
        frames: of each trial, from its first. cameras_used: the first 1, 2 or 3 of the cameras, one
            table for each number; rates and recovery have the first of them.
        fps: frames per second for the rates, whole parts of 60.
        particles: likelihoods a frame; APF has a fifth of them in each of its layers, the root tracker
            a hypothesis for every seven.
        size: of the silhouettes, width x height.
        faults: severity of holes, ragged edges, shadows and missing limbs; 0 for none.
        likelihood: of SIR and APF, bidirectional (MR 12) or overlap (AS 7).
        leg_swap: probability of swapping legs that point in opposite directions, all methods.
        limits: whether poses outside learnt limits are discarded, all methods.
        settings: validation chooses survival rate and diffusion at every frame rate; published ones;
            or the folder or report.json of an earlier run with those it chose.

    Raises:
        InputError: unknown methods, parts or persons, too few trials, rates that are no part of 60.
        FileFormatError: `settings` is no report. OutputError: `out` cannot be written.
    """
    out = check_output_folder(out)
    steps = _check(part, method, seeds, recovery_seeds, cameras_used, fps)
    displacements: Sequence[Displacement] = DISPLACEMENTS
    if quick:
        frames, particles, seeds, recovery_seeds = min(frames, 12), min(particles, 35), 2, 1
        steps = {rate: n for rate, n in steps.items() if rate in (fps[0], fps[-1])}
        displacements = DISPLACEMENTS[:1] + DISPLACEMENTS[-1:]
    budget = Budget(particles, likelihood, leg_swap, limits)
    recorded = read_mocap(data, FPS, ())
    chosen = persons or _most_frames(recorded)
    splits = split_clips(recorded, chosen, chosen, 1)
    conditions = Conditions(image_size(size), faults, max(cameras_used), None, seed)
    walkers = prepare(splits, conditions, frames, 8 if quick else _VALIDATION_FRAMES)
    first = [with_cameras(walker, cameras_used[0]) for walker in walkers]
    report = Report("Large uncertainty of the root: three filters over body poses", {
        "quick": quick, "part": part, "seed": seed, "seeds": seeds,
        "recovery seeds": recovery_seeds, "methods": list(method), "persons": list(chosen),
        "frames": frames, "particles": particles, "hypotheses": round(particles / POINTS),
        "cameras used": list(cameras_used), "fps": list(fps), "faults": faults, "size": size,
        "likelihood": likelihood, "leg swap": leg_swap, "limits": limits,
        "threads": torch.get_num_threads(),
    })  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DegenerateFilterWarning)  # the tables count them
        by_rate = {rate: [slower(w, n) for w in first] for rate, n in _rates(part, steps).items()}
        tunings = _tunings(by_rate, method, budget, out, settings, quick, progress)
        chosen_at = {
            rate: {name: tuning.setting for name, tuning in found.items()}
            for rate, found in tunings.items()
        }
        known = chosen_at.get(FPS, {})
        numbers = range(seed, seed + seeds)
        if part in ("tables", "all"):
            _fill_tables(report, walkers, known, budget, cameras_used, numbers, out, progress)
        if part in ("rates", "all"):
            asked = {rate: by_rate[rate] for rate in steps}
            _fill_rates(report, asked, chosen_at, budget, numbers, out, progress)
        if part in ("recovery", "all"):
            some = range(seed, seed + recovery_seeds)
            seconds = min(_TRACKED_ON, frames / FPS / 2) if quick else _TRACKED_ON
            times = _times(displaced_at, seconds, first)
            _fill_recovery(
                report, first, known, budget, displacements, some, times, seconds, out, progress
            )
    report.settings["settings"] = {
        f"{rate:g}": {name: setting._asdict() for name, setting in found.items()}
        for rate, found in chosen_at.items()
    }
    add_tuning(report, tunings, budget)
    add_sequences(report, walkers)
    report.save(out)
    return report


# --- parts ----------------------------------------------------------------------------------------


def _fill_tables(
    report: Report, walkers: Sequence[Walker], settings: Mapping[str, Setting], budget: Budget,
    cameras_used: Sequence[int], seeds: Sequence[int], out: Path, progress: bool,
) -> None:  # fmt: skip
    """Add Tables 1 and 2, Figures 8 and 10, and what the distributions look like."""
    by_cameras = {n: [with_cameras(walker, n) for walker in walkers] for n in cameras_used}
    grids = {f"{n} cameras": grid_of(seen, settings, budget) for n, seen in by_cameras.items()}
    runs = TRACKING.run(grids, seeds, out, progress=progress, title="cameras")
    for n, key in zip(by_cameras, grids, strict=True):
        own = runs.where(condition=key)
        add_errors(report, key, f"Error (mm) with {key}", own)
        add_order(report, n, own)
        write_csv(out / f"runs-{n}-cameras.csv", own, csv_columns(FPS))
    add_differences(report, runs)
    first = next(iter(grids))
    speed = f"{budget.particles} likelihoods a frame in {first}"
    add_speed(report, runs.where(condition=first), speed)
    for n, key in zip(by_cameras, grids, strict=True):
        figure = plot_errors_by_time(runs.where(condition=key), FPS, f"Error over time, {key}")
        add_picture(report, out, f"error-over-time-{n}-cameras.png", figure)
    seen = by_cameras[cameras_used[0]]
    add_pictures(report, seen, settings, budget, runs.where(condition=first), out)


def _fill_rates(
    report: Report, by_rate: Mapping[float, Sequence[Walker]],
    settings: Mapping[float, Mapping[str, Setting]], budget: Budget, seeds: Sequence[int], out: Path,
    progress: bool,
) -> None:  # fmt: skip
    """Add Figure 9, every rate with the settings that were chosen at it."""
    grids = {f"{fps:g}": grid_of(seen, settings[fps], budget) for fps, seen in by_rate.items()}
    runs = TRACKING.run(grids, seeds, out, progress=progress, title="frame rates")
    for fps, key in zip(by_rate, grids, strict=True):
        write_csv(out / f"runs-{key}-fps.csv", runs.where(condition=key), csv_columns(fps))
    add_rates(report, runs)
    figure = plot_by_condition(runs, {"error (mm)": part_error()}, "Error over frames per second")
    add_picture(report, out, "error-over-rates.png", figure)


def _fill_recovery(
    report: Report, walkers: Sequence[Walker], settings: Mapping[str, Setting], budget: Budget,
    displacements: Sequence[Displacement], seeds: Sequence[int], times: Sequence[float],
    seconds: float, out: Path, progress: bool,
) -> None:  # fmt: skip
    grids = displaced_grids(walkers, settings, budget, displacements, times, seconds)
    runs = RECOVERY.run(grids, seeds, out, progress=progress, title="displaced")
    add_recovery(report, runs, FPS, seconds)


def _tunings(
    by_rate: Mapping[float, Sequence[Walker]], methods: Sequence[str], budget: Budget, out: Path,
    settings: str, quick: bool, progress: bool,
) -> dict[float, dict[str, Tuning]]:  # fmt: skip
    """Choose settings at every frame rate, from the highest on, each search starting from the last choice."""
    found: dict[float, dict[str, Tuning]] = {}
    started: dict[str, Setting] = {}
    for fps in sorted(by_rate, reverse=True):
        if settings == "published" or (quick and settings == "validation"):
            found[fps] = {name: Tuning(published(name, fps)) for name in methods}
        elif settings != "validation":
            read = read_settings(settings, methods, f"{fps:g}")
            found[fps] = {name: Tuning(setting) for name, setting in read.items()}
        else:
            found[fps] = {
                name: tune(by_rate[fps], name, budget, out, started.get(name))
                for name in tqdm(methods, disable=not progress, desc=f"settings, {fps:g} fps")
            }
        started = {name: tuning.setting for name, tuning in found[fps].items()}
    return found


def _rates(part: str, steps: Mapping[float, int]) -> dict[float, int]:
    """Return frame rates that a part needs, each with the n of which it takes every n-th frame."""
    whole = {FPS: 1} if part != "rates" else {}
    return whole | (dict(steps) if part in ("rates", "all") else {})


def _times(times: Sequence[float], seconds: float, walkers: Sequence[Walker]) -> tuple[float, ...]:
    """Return times, checked to leave `seconds` of everybody's clip."""
    shortest = min(len(walker.tests[0].clip) for walker in walkers) / FPS
    if not times or min(times) < 0 or max(times) + seconds > shortest + 1e-9:
        given = " ".join(f"{t:g}" for t in times) or "none"
        raise InputError(
            f"--displaced-at takes seconds from 0 to {shortest - seconds:g}: the shortest clip has "
            f"{shortest:.2f} s, of which {seconds:g} s are tracked from there on; got {given}"
        )
    return tuple(times)


# --- what the arguments mean ----------------------------------------------------------------------


def _check(
    part: str, methods: Sequence[str], seeds: int, recovery_seeds: int, cameras: Sequence[int],
    rates: Sequence[float],
) -> dict[float, int]:  # fmt: skip
    """Check the options; return rates, each with the n of which it takes every n-th frame."""
    if part not in PARTS:
        raise InputError(f"--part must be one of {', '.join(PARTS)}, got {part!r}")
    unknown = [name for name in methods if name not in METHODS]
    if unknown or not methods:
        raise InputError(f"--method takes {', '.join(METHODS)}; got {', '.join(unknown) or 'none'}")
    if min(seeds, recovery_seeds) < 1:
        raise InputError(f"--seeds must be at least 1, got {min(seeds, recovery_seeds)}")
    if not cameras or not all(1 <= n <= 3 for n in cameras):
        given = " ".join(map(str, cameras))
        raise InputError(
            f"--cameras-used takes 1, 2 and 3 (cameras that are placed), got {given!r}"
        )
    wrong = [f"{rate:g}" for rate in rates if not 0 < rate <= FPS or FPS % rate]
    if wrong or not rates:
        raise InputError(
            f"--fps takes whole parts of {FPS:g}, of which every n-th frame is taken: 60, 30, 20, 15, "
            f"12, 10; got {' '.join(wrong) or 'none'}"
        )
    return {rate: round(FPS / rate) for rate in rates}


def _most_frames(clips: Sequence[MocapClip]) -> tuple[str, ...]:
    """Return CMU's first three walkers where they are, else those with most frames in three trials."""
    frames: dict[str, list[int]] = {}
    for clip in clips:
        frames.setdefault(clip.person, []).append(len(clip))
    known = tuple(f"s{name}" for name in WALKERS[:_N_PERSONS])
    if all(name in frames for name in known):
        return known
    enough = {name: sum(count) for name, count in frames.items() if len(count) >= 3}
    if not enough:
        raise InputError(
            "nobody has three trials, for test, training and validation; there are "
            + ", ".join(f"{len(count)} of {name}" for name, count in frames.items())
        )
    return tuple(sorted(enough, key=lambda name: -enough[name])[:_N_PERSONS])
