"""Protocol Silhouette: whole bodies tracked from silhouettes of several cameras, three filters.

Recorded motion is rendered as silhouettes of another body than the tracker's, with the faults of
background subtraction. Everybody is tracked by SIR, by the annealed particle filter and by the
manifold-regularised one, with the same number of likelihoods a frame, the same diffusion, and
exponents chosen on validation clips. Errors are distances of joints (MR 31).
"""

import re
from collections.abc import Sequence
from pathlib import Path

import torch
from tqdm.auto import tqdm

from torchpose.camera_rig import CameraRig
from torchpose.errors import InputError
from torchpose.io.files import check_output_folder
from torchpose.io.mocap import MocapClip, read_mocap
from torchpose.protocols.common import add_picture
from torchpose.protocols.report import Report
from torchpose.protocols.silhouette_data import Split, looped, split_clips
from torchpose.protocols.silhouette_runs import Run, Runs, Tuning, run_all, sequence_name, tune
from torchpose.protocols.silhouette_tables import (
    add_differences,
    add_errors,
    add_parts,
    add_pooled,
    add_setup,
    add_tuning,
    mean_of,
    part_errors,
    write_csv,
)
from torchpose.protocols.silhouette_trackees import (
    METHODS,
    PUBLISHED_SURVIVAL,
    Conditions,
    Setting,
    Trackee,
    prepare,
)

__all__ = ["WALKERS", "run"]

FPS = 60.0
WALKERS = ("07", "08", "35", "39")
"""The persons of CMU's walks who have enough trials; tracked if nobody is named."""

SPACED = ("method", "train_persons", "test_persons", "actions")
"""Options that a command line takes as words with blanks between them."""

_VALIDATION_FRAMES = 60


def run(
    data: str | Path,
    out: str | Path,
    *,
    seed: int = 0,
    progress: bool = True,
    quick: bool = False,
    method: tuple[str, ...] = ("sir", "apf", "mrpf"),
    seeds: int = 5,
    cameras: str | None = None,
    train_persons: tuple[str, ...] = (),
    test_persons: tuple[str, ...] = (),
    actions: tuple[str, ...] = (),
    clips: int = 1,
    frames: int = 150,
    particles: int = 500,
    cameras_used: int = 3,
    faults: float = 1.0,
    size: str = "160x120",
    likelihood: str = "bidirectional",
    initial: str = "given",
    setting: float | None = None,
    loop: int = 0,
) -> Report:
    """Run the protocol; writes report.json, report.md, runs.csv and pictures to `out`.

    Runs are kept in `out`, one file each, so that a killed run goes on where it stopped.

    Args:
        data: folder or file of motion capture. out: folder for the results.
        seed: of shapes, faults and the first run. progress: whether to show bars.
        quick: few frames and particles, two runs, to see that all of it works.
        method: filters, among sir, apf, mrpf (exact weights, samples of the product),
            mrpf-diffusion (exact weights), mrpf-published, mrpf-published-product.
        seeds: runs of every filter on every clip.
        cameras: TOML file with K, R, t of cameras in the axes of the recordings; without one, three
            of 640 x 480 pixels stand 3.8 m around the middle of every clip.
        train_persons: whose trials make manifolds; all persons if none is named.
        test_persons: who is tracked; with a manifold of their own other trials if they train as well,
            else of the others.
        actions: only recordings of these.
        clips: trials tracked of each person. frames: of each trial, from its first.
        particles: likelihoods a frame; the annealed filter has a fifth of them in each of its layers.
        cameras_used: the first 1, 2 or 3 of the cameras.
        faults: severity of holes, ragged edges, shadows and missing limbs; 0 for none.
        size: of the silhouettes, width x height.
        likelihood: bidirectional (MR 12) or overlap (AS 7).
        initial: given, or found in the first silhouettes.
        setting: sharpness of the likelihood (1 as published) instead of what validation chooses;
            the annealed filter then has its published survival rate, and all the plain diffusion.
        loop: walk one cycle of every test trial so many times on the spot; 0 for the trial itself.

    Raises:
        InputError: unknown methods, persons or actions, too few trials, cameras that do not fit.
        OutputError: `out` cannot be written.
    """
    out = check_output_folder(out)
    _check(method, seeds, initial)
    if quick:
        frames, particles, seeds, clips = min(frames, 20), min(particles, 50), min(seeds, 2), 1
    recorded = read_mocap(data, FPS, actions)
    _one_action(recorded)
    persons = _default_persons(recorded)
    splits = split_clips(recorded, train_persons or persons, test_persons or persons, clips)
    if loop:
        splits = [_looped(split, loop) for split in splits]
        frames = max(len(clip) for split in splits for clip in split.test)
    rig = None if cameras is None else CameraRig.load(cameras)
    conditions = Conditions(_size(size), faults, cameras_used, rig, seed)
    validation = 15 if quick else _VALIDATION_FRAMES
    trackees = [
        prepare(split, conditions, frames, validation, seed)
        for split in tqdm(splits, disable=not progress, desc="bodies and manifolds")
    ]
    tunings = _tunings(trackees, method, particles, likelihood, out, setting, progress)
    runs = run_all(
        trackees, {name: tuning.setting for name, tuning in tunings.items()}, out, seeds=seeds,
        seed=seed, n_particles=particles, likelihood=likelihood, initial=initial,
        progress=progress,
    )  # fmt: skip
    report = Report("Silhouettes: three filters over body poses", {
        "quick": quick, "seed": seed, "seeds": seeds, "methods": list(method),
        "persons": [t.split.person for t in trackees], "frames": frames, "particles": particles,
        "cameras": cameras or "three around each clip, 3.8 m from its middle",
        "cameras used": cameras_used, "faults": faults, "size": size, "likelihood": likelihood,
        "initial pose": initial, "looped": loop, "threads": torch.get_num_threads(),
        "settings": {name: tuning.setting._asdict() for name, tuning in tunings.items()},
    })  # fmt: skip
    _fill(report, runs, tunings, trackees, out, seed)
    report.save(out)
    return report


def _fill(
    report: Report, runs: Runs, tunings: dict[str, Tuning], trackees: Sequence[Trackee], out: Path,
    seed: int,
) -> None:  # fmt: skip
    add_errors(report, runs)
    add_parts(report, runs)
    add_pooled(report, runs, FPS)
    if any(name.startswith("mrpf") for name in runs) and {"sir", "apf"} & runs.keys():
        add_differences(report, runs)
        _add_order(report, runs)
    add_tuning(report, tunings)
    add_setup(report, trackees)
    write_csv(out / "runs.csv", runs, FPS, seed)
    _add_pictures(report, runs, trackees, out)


def _add_order(report: Report, runs: Runs) -> None:
    """Whether the order of the paper's tables appears, in words."""
    if not {"sir", "apf", "mrpf"} <= runs.keys():
        return
    for part in ("", "arms"):
        mean = {name: float(mean_of(part_errors(runs, name, part))) for name in runs}
        best = mean["mrpf"] < min(mean["sir"], mean["apf"])
        what = "arms" if part else "the whole body"
        report.findings.append(
            f"The paper's order {'appears' if best else 'does NOT appear'} for {what}: MRPF "
            f"{mean['mrpf']:.1f} mm, SIR {mean['sir']:.1f} mm, APF {mean['apf']:.1f} mm."
        )


def _add_pictures(report: Report, runs: Runs, trackees: Sequence[Trackee], out: Path) -> None:
    from torchpose.protocols.silhouette_pictures import (
        plot_errors_by_part,
        plot_errors_by_time,
        plot_silhouettes,
    )

    add_picture(report, out, "error-over-time.png", plot_errors_by_time(runs, FPS))
    add_picture(report, out, "error-by-part.png", plot_errors_by_part(runs))
    trackee = trackees[0]
    view = trackee.tests[0]
    name = sequence_name(trackee, view)
    last = list(runs)[-1]
    shown: list[tuple[str, Run]] = [(METHODS[last].label, runs[last][name][0])]
    title = f"{name}: silhouettes and estimates"
    figure = plot_silhouettes(trackee, view, shown, n_frames=6, title=title)
    add_picture(report, out, "silhouettes.png", figure)


def _tunings(
    trackees: Sequence[Trackee], methods: Sequence[str], particles: int, likelihood: str, out: Path,
    setting: float | None, progress: bool,
) -> dict[str, Tuning]:  # fmt: skip
    found = {}
    for name in tqdm(methods, disable=not progress, desc="exponents"):
        if setting is None:
            found[name] = tune(trackees, name, particles, likelihood, out)
        else:
            value = PUBLISHED_SURVIVAL if name == "apf" else setting
            found[name] = Tuning(Setting(value))
    return found


# --- what the arguments mean ----------------------------------------------------------------------


def _check(methods: Sequence[str], seeds: int, initial: str) -> None:
    unknown = [name for name in methods if name not in METHODS]
    if unknown or not methods:
        raise InputError(f"--method takes {', '.join(METHODS)}; got {', '.join(unknown) or 'none'}")
    if seeds < 1:
        raise InputError(f"--seeds must be at least 1, got {seeds}")
    if initial not in ("given", "found"):
        raise InputError(f"--initial must be given or found, got {initial!r}")


def _one_action(clips: Sequence[MocapClip]) -> None:
    found = sorted({clip.action for clip in clips})
    if len(found) > 1:
        raise InputError(
            f"a manifold is of one action; the recordings are of {', '.join(found)}: choose with "
            "--actions"
        )


def _default_persons(clips: Sequence[MocapClip]) -> tuple[str, ...]:
    """CMU's four walkers where all of them are, else everybody with four trials or more."""
    trials: dict[str, int] = {}
    for clip in clips:
        trials[clip.person] = trials.get(clip.person, 0) + 1
    if all(f"s{name}" in trials for name in WALKERS):
        return tuple(f"s{name}" for name in WALKERS)
    enough = tuple(name for name, count in trials.items() if count >= 4)
    if not enough:
        raise InputError(
            "nobody has four trials or more, for tests, manifold and validation; there are "
            + ", ".join(f"{count} of {name}" for name, count in trials.items())
        )
    return enough


def _size(text: str) -> tuple[int, int]:
    """(height, width) of ``160x120``."""
    match = re.fullmatch(r"\s*(\d+)\s*[x×]\s*(\d+)\s*", text)
    if match is None or 0 in (int(match[1]), int(match[2])):
        raise InputError(f"--size must be width x height such as 160x120, got {text!r}")
    return int(match[2]), int(match[1])


def _looped(split: Split, times: int) -> Split:
    return split._replace(test=tuple(looped(clip, times) for clip in split.test))
