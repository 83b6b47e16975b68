"""Gain of each choice of the recipe: the tracker of UB-people with one of them changed at a time.

Measured on training persons alone: s1, s2, s4 and s5 of UTD-MHAD are fitted, and every third sequence
of s3 and s6 is tracked from head, neck and hands with 3 px noise, as `python -m benchmarks.ub_people`
tracks its test persons. Files of the test persons, s7 and s8, are not opened.

The error is the 3D distance after fixed-scale Procrustes, pooled over joints and frames. Seconds are
CPU time of the fit of the mixtures that a row tracks with (both arms); rows that change the tracker
alone repeat the default's. "another seed" says how far two fits of the same kind are apart.

    python -m benchmarks.ub_people_levers --data DIR --out DIR [--only GROUP ...] [--seeds 0 1]

All of it takes hours. Fits and finished rows are kept in the folder `--out`, so that a run that was
stopped goes on; levers.md there holds the table as far as it goes.
"""

from collections.abc import Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import Annotated, NamedTuple

import torch
from tqdm.auto import tqdm

from benchmarks._command import OneOf, run_command
from benchmarks._levers import (
    FIT_PERSONS,
    MODES,
    QUICK,
    SCORED_PERSONS,
    Bench,
    Lever,
    Measured,
    Size,
    Windows,
    read_persons,
)
from benchmarks._table_file import save_text
from benchmarks.speed._timing import machine_line, markdown_table
from torchpose._core.files import check_output_folder
from torchpose.camera._viewpoints import PAPER_VIEWS
from torchpose.learning import TRAINING_VIEWS
from torchpose.priors._window import WindowLayout

HEADER = ("lever", "filtered (cm)", "jitter", "fit (s)", "smoothed (cm)", "jitter", "fit (s)")


def layouts(own: Sequence[int], other: Sequence[int]) -> dict[str, WindowLayout]:
    """Return the lags of both hands: of the past for the filter, to both sides for the smoother."""
    there, elsewhere = (
        tuple(dict.fromkeys(sign * lag for lag in lags for sign in (1, -1)))
        for lags in (own, other)
    )
    return {
        "causal": WindowLayout(tuple(own), tuple(other)),
        "full": WindowLayout(there, elsewhere),
    }


def without_bodies(**kept: float) -> Windows:
    """Return windows of bodies as they were recorded, but for the given changes."""
    return Windows(bodies=tuple(({"body_size": 0.0, "bone_lengths": 0.0} | kept).items()))


def levers() -> list[Lever]:
    """Return all rows of the table, the most interesting first."""
    ou = {"transition": "ou"}
    return [
        Lever("default", "default"),
        Lever("layouts", "windows: own hand 5, 10", Windows(layouts([5, 10], []))),
        Lever(
            "layouts",
            "windows: own 4, 10, 20, 32; other 0, 10",
            Windows(layouts([4, 10, 20, 32], [0, 10])),
        ),
        Lever(
            "layouts",
            "windows: own 3, 7, 12, 20; other 0, 7, 16",
            Windows(layouts([3, 7, 12, 20], [0, 7, 16])),
        ),
        *(
            Lever("components", f"{n} components over windows (240)", Windows(components=n))
            for n in (120, 60, 30)
        ),
        Lever("motion", "no motion stage", options={"steady": False}),
        Lever("motion", "motion stage, joint ratio x 0.1", factors={"joint_ratio": 0.1}),
        Lever("motion", "motion stage, joint ratio x 10", factors={"joint_ratio": 10.0}),
        Lever("single", "single poses", None),
        Lever("single", "single poses, learnt Q and R", None, learnt_noise=True),
        *(
            Lever("single", f"single poses, ou, gamma {gamma}", None, ou | {"gamma": gamma})
            for gamma in (0.3, 0.8, 0.95)
        ),
        Lever("single", "single poses, initial covariance x 4", None, start_factor=4.0),
        Lever("seeds", "another seed", seed_offset=1),
        Lever("seeds", "two seeds joined, 480 components", Windows(seeds=2)),
        *(
            Lever("power", f"likelihood power {power} (0.3; smoothed 0.25)", options=_power(power))
            for power in (1.0, 0.5, 0.15)
        ),
        *(
            Lever("noise", f"R of {std:g} px (3)", options={"measurement_std": std})
            for std in (1.0, 6.0)
        ),
        *(
            Lever("samples", f"{n:,} training windows (120,000)", Windows(samples=n))
            for n in (60_000, 30_000)
        ),
        Lever("mirror", "none mirrored (a quarter)", Windows(bodies=(("mirror_share", 0.0),))),
        Lever("bodies", "bodies as recorded", without_bodies()),
        Lever("bodies", "bodies of other sizes, bones as recorded", without_bodies(body_size=0.15)),
        Lever("views", "half the viewpoints' range", Windows(views=TRAINING_VIEWS.scaled(0.5))),
        Lever("views", "the paper's viewpoints, 30 degrees", Windows(views=PAPER_VIEWS)),
    ]


def _power(power: float) -> dict[str, float]:
    return {"likelihood_power": power}


GROUPS = tuple(dict.fromkeys(lever.group for lever in levers()))


class Task(NamedTuple):
    """One number of the table."""

    lever: Lever
    mode: str
    seed: int


def cells(found: Sequence[Measured], n_seeds: int) -> tuple[str, str, str]:
    """Return error, jitter and seconds, means over seeds; dashes until all seeds are there."""
    if len(found) < n_seeds:
        return "-", "-", "-"
    errors, jitters, seconds = (
        [float(getattr(one, name)) for one in found] for name in ("error", "jitter", "seconds")
    )
    spread = f" ± {stdev(errors):.2f}" if n_seeds > 1 else ""
    return f"{mean(errors):.2f}{spread}", f"{mean(jitters):.1f}", f"{mean(seconds):.0f}"


def table(tasks: Sequence[Task], known: Sequence[Measured], n_seeds: int) -> str:
    """Return the Markdown table, and what was learnt about the noise.

    Args:
        tasks: numbers of the table. known: what was measured for the first of them.
        n_seeds: number of seeds.
    """
    done = list(zip(tasks, known, strict=False))
    rows, notes = [], []
    for lever in dict.fromkeys(task.lever.name for task in tasks):
        row = [lever]
        for mode in MODES:
            found = [m for task, m in done if (task.lever.name, task.mode) == (lever, mode)]
            row += cells(found, n_seeds)
            notes += [f"{lever}: {m.note}." for m in found if m.note]
        rows.append(row)
    return "\n\n".join([markdown_table(HEADER, rows), *dict.fromkeys(notes)])


def settings_line(bench: Bench, seeds: Sequence[int]) -> str:
    """Return a line on what was fitted and tracked."""
    test, size = bench.persons.test, bench.size
    return (
        f"Fitted: {len(bench.persons.fitted)} sequences of {', '.join(FIT_PERSONS)}; tracked: "
        f"{len(test.lengths)} sequences of {' and '.join(SCORED_PERSONS)}, {int(test.lengths.sum())} "
        f"frames. Seeds of the fits: {', '.join(map(str, seeds))}. Jitter in m/s2, fit in CPU seconds. "
        f"{size.pose_components} components over poses, {size.em_steps} steps of EM"
        f"{', everything tiny (--quick): the figures mean nothing' if size == QUICK else ''}."
    )


def main(
    *,
    data: Path,
    out: Path,
    only: Annotated[Sequence[str], OneOf(GROUPS)] | None = None,
    modes: Annotated[Sequence[str], OneOf(MODES)] = tuple(MODES),
    seeds: Sequence[int] = (0,),
    threads: int = 2,
    quick: bool = False,
) -> None:
    """Measure what is missing, filtered before smoothed, and print the table.

    Args:
        data: folder with kinect_utd_mhad/.
        out: folder of fits, rows and table.
        only: groups of rows.
        modes: one of both columns.
        seeds: of the fits.
        threads: cores.
        quick: tiny fits, to see that it works.
    """
    torch.set_num_threads(threads)
    size = QUICK if quick else Size()
    bench = Bench(read_persons(data, size), size, check_output_folder(out))
    chosen = [lever for lever in levers() if only is None or lever.group in only]
    tasks = [Task(lever, mode, seed) for mode in modes for lever in chosen for seed in seeds]
    lines = [settings_line(bench, seeds), machine_line(threads)]
    known: list[Measured] = []
    bar = tqdm(tasks, unit="row", smoothing=0.0)
    for task in bar:
        bar.set_postfix_str(f"{task.lever.name}, {task.mode}")
        known.append(bench.measure(*task))
        text = "\n\n".join([table(tasks, known, len(seeds)), *lines]) + "\n"
        save_text(out / "levers.md", text)
    print(text, end="")


if __name__ == "__main__":
    run_command(main)
