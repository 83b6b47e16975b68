"""Protocol Silhouette: whole bodies tracked from silhouettes of several cameras, three filters.

Recorded motion is rendered as silhouettes of another body than the tracker's, with the faults of
background subtraction. Everybody is tracked by SIR, by the annealed particle filter and by the
manifold-regularised one, with the same number of likelihoods a frame, the same diffusion, and
exponents chosen on validation clips. Errors are distances of joints (MR 31).
"""

from collections.abc import Sequence
from pathlib import Path

import torch
from tqdm.auto import tqdm

from benchmarks.bodies.clips import Split, looped, split_clips
from benchmarks.bodies.tracking import PUBLISHED_SURVIVAL
from benchmarks.bodies.views import Conditions, Subject, image_size, subjects_of
from benchmarks.engine import Grid, Setting, Tuning, read_settings
from benchmarks.humaneva_files import is_humaneva
from benchmarks.silhouette.filters import METHODS, TRACKING, Filter, SilhouettePerson, prepare, tune
from benchmarks.silhouette.humaneva import HumanEvaFootage, humaneva_splits
from benchmarks.silhouette.report import Case, fill_one, fill_several
from torchpose._core.files import check_output_folder
from torchpose.camera import CameraRig
from torchpose.errors import InputError
from torchpose.evaluation import Report
from torchpose.io import read_mocap
from torchpose.io._mocap import MocapClip

FPS = 60.0
WALKERS = ("07", "08", "35", "39")
"""The persons of CMU's walks who have enough trials; tracked if nobody is named."""

SPACED = (
    "method", "train_persons", "test_persons", "actions", "test_actions", "particles", "size",
)  # fmt: skip
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
    test_actions: tuple[str, ...] = (),
    clips: int = 1,
    frames: int = 150,
    particles: tuple[int, ...] = (500,),
    cameras_used: int = 3,
    faults: float = 1.0,
    size: tuple[str, ...] = ("160x120",),
    likelihood: str = "bidirectional",
    initial: str = "given",
    sharpness: float | None = None,
    settings: str | None = None,
    loop: int = 0,
) -> Report:
    """Run the protocol; writes report.json, report.md, runs.csv and pictures to `out`.

    Runs are kept in `out`, one file each, so that a killed run goes on where it stopped.

    Args:
        data: folder or file of motion capture, or the folder of HumanEva-I: then its own videos are
            tracked, by its own partitions (``--frames 200`` as in the paper), without rendering.
        out: folder for the results.
        seed: of shapes, faults and the first run. progress: whether to show bars.
        quick: few frames and particles, two runs, to see that all of it works.
        method: filters, among sir, apf, mrpf (exact weights, samples of the product),
            mrpf-diffusion (exact weights), mrpf-published, mrpf-published-product.
        seeds: runs of every filter on every clip.
        cameras: TOML file with K, R, t of cameras in the axes of the recordings; without one, three
            of 640 x 480 pixels stand 3.8 m around the middle of every clip.
        train_persons: whose trials make manifolds. test_persons: who is tracked; with a manifold of
            their own other trials if they train as well, else of the others. Where none is named,
            CMU's four walkers, else everybody with trials enough.
        actions: only recordings of these, one action; of HumanEva several, each with manifolds of its
            own, Walking and Jog if none is named.
        test_actions: tracked instead of those, which still make the manifold and choose noise and
            exponents; so the manifold never saw what is tracked.
        clips: trials tracked of each person. frames: of each trial, from its first.
        particles: likelihoods a frame, one number or several for a table over them; the annealed
            filter has a fifth of them in each of its layers.
        cameras_used: the first 1, 2 or 3 of the cameras.
        faults: severity of holes, ragged edges, shadows and missing limbs; 0 for none.
        size: of the silhouettes, width x height, one or several for a table over them.
        likelihood: bidirectional (MR 12) or overlap (AS 7).
        initial: given, or found in the first silhouettes.
        sharpness: of the likelihood (1 as published) instead of what validation chooses;
            the annealed filter then has its published survival rate, and all the plain diffusion.
        settings: folder or report.json of an earlier run; exponents and diffusion are those that it
            chose, for all particles and sizes. Without it validation chooses for each of them.
        loop: walk one cycle of every test trial so many times on the spot; 0 for the trial itself.

    Raises:
        InputError: unknown methods, persons or actions, too few trials, cameras that do not fit.
        FileFormatError: `settings` is no report. OutputError: `out` cannot be written.
    """
    out = check_output_folder(out)
    _check(method, seeds, initial, particles, size)
    given = _given_settings(method, sharpness, settings)
    if quick:
        frames, seeds, clips = min(frames, 20), min(seeds, 2), 1
        particles = tuple(dict.fromkeys(min(n, 50) for n in particles))
    named = (actions, test_actions, train_persons, test_persons)
    footage = None
    if is_humaneva(data):
        _check_footage(cameras, loop, clips)
        footage = HumanEvaFootage(out, progress)
        splits = humaneva_splits(data, footage, *named)
    else:
        splits = _splits(data, *named, clips)
    if loop:
        splits = [_looped(split, loop) for split in splits]
        frames = max(len(clip) for split in splits for clip in split.test)
    rig = None if cameras is None else CameraRig.load(cameras)
    cases = []
    for text in size:
        conditions = Conditions(image_size(text), faults, cameras_used, rig, seed, footage=footage)
        tracked_persons = [
            prepare(split, conditions, frames, 15 if quick else _VALIDATION_FRAMES, seed)
            for split in tqdm(splits, disable=not progress, desc="bodies and manifolds")
        ]
        for n in particles:
            tunings = given or {
                name: tune(tracked_persons, name, n, likelihood, out)
                for name in tqdm(method, disable=not progress, desc="exponents")
            }
            cases.append(Case(n, text, tracked_persons, tunings))
    by_name = _named(cases)
    runs = TRACKING.run(
        {name: _grid(case, likelihood, initial) for name, case in by_name.items()},
        range(seed, seed + seeds), out, progress=progress, title="tracking",
    )  # fmt: skip
    report = Report("Silhouettes: three filters over body poses", {
        "quick": quick, "seed": seed, "seeds": seeds, "methods": list(method),
        "persons": list(dict.fromkeys(split.person for split in splits)),
        "actions": _actions(splits, "manifold"), "tracked actions": _actions(splits, "test"),
        "frames": frames, "particles": _one_or_all(particles),
        "cameras": _cameras(cameras, footage),
        "cameras used": cameras_used, "faults": faults if footage is None else "real",
        "size": _one_or_all(size),
        "likelihood": likelihood, "initial pose": initial, "looped": loop,
        "threads": torch.get_num_threads(), "settings": _chosen(cases),
    })  # fmt: skip
    if len(cases) == 1:
        fill_one(report, cases[0], runs, out, FPS)
    else:
        fill_several(report, by_name, runs, out, FPS)
    report.save(out)
    return report


def _splits(
    data: str | Path, actions: tuple[str, ...], test_actions: tuple[str, ...],
    train_persons: tuple[str, ...], test_persons: tuple[str, ...], clips: int,
) -> list[Split]:  # fmt: skip
    """Return the splits of clips, with the given names completed by those that are recorded."""
    recorded = read_mocap(data, FPS, actions)
    _one_action(recorded)
    if not test_actions:
        if not (train_persons and test_persons):
            persons = _default_persons(recorded)
            train_persons, test_persons = train_persons or persons, test_persons or persons
        return split_clips(recorded, train_persons, test_persons, clips)
    tracked = read_mocap(data, FPS, test_actions)
    if {clip.action for clip in tracked} & {clip.action for clip in recorded}:
        raise InputError(
            f"--test-actions {' '.join(test_actions)}: the manifold is of this action as well; name "
            "other ones, or leave the option out to track other trials of the same action"
        )
    return split_clips(recorded, train_persons, test_persons, clips, tracked=tracked)


def _given_settings(
    methods: Sequence[str], sharpness: float | None, settings: str | None
) -> dict[str, Tuning]:
    """Return the settings that are given, without validation; an empty dictionary if it is to choose."""
    if settings is not None:
        if sharpness is not None:
            raise InputError("--settings holds a sharpness already: leave --sharpness out")
        return {name: Tuning(found) for name, found in read_settings(settings, methods).items()}
    if sharpness is None:
        return {}
    return {
        name: Tuning(Setting(PUBLISHED_SURVIVAL if name == "apf" else sharpness))
        for name in methods
    }


def _named(cases: Sequence[Case]) -> dict[str, Case]:
    """Return conditions by what they differ in."""
    one_size = len({case.size for case in cases}) == 1
    one_number = len({case.n_particles for case in cases}) == 1

    def name(case: Case) -> str:
        number = "" if one_number else f"{case.n_particles:,} likelihoods"
        size = "" if one_size else case.size
        return ", ".join(part for part in (number, size) if part)

    return {name(case): case for case in cases}


def _grid(case: Case, likelihood: str, initial: str) -> Grid[Subject[SilhouettePerson], Filter]:
    """Return the persons and filters of one condition."""
    return Grid(
        subjects_of(case.tracked_persons),
        {
            name: Filter(name, tuning.setting, case.n_particles, likelihood, initial)
            for name, tuning in case.tunings.items()
        },
    )


# --- what a report says ---------------------------------------------------------------------------


def _chosen(cases: Sequence[Case]) -> dict[str, object]:
    """Return settings by method; by condition and method where they differ."""
    by_case = {
        f"{case.n_particles} at {case.size}": {
            name: tuning.setting._asdict() for name, tuning in case.tunings.items()
        }
        for case in cases
    }
    first, *others = by_case.values()
    return dict(first) if all(other == first for other in others) else dict(by_case)


def _cameras(path: str | None, footage: HumanEvaFootage | None) -> str:
    if footage is not None:
        return "HumanEva's own, with its videos"
    return path or "three around each clip, 3.8 m from its middle"


def _actions(splits: Sequence[Split], part: str) -> list[str]:
    return sorted({clip.action for split in splits for clip in getattr(split, part)})


def _one_or_all(values: Sequence[object]) -> object:
    return values[0] if len(values) == 1 else list(values)


# --- what the arguments mean ----------------------------------------------------------------------


def _check(
    methods: Sequence[str], seeds: int, initial: str, particles: Sequence[int], sizes: Sequence[str]
) -> None:
    unknown = [name for name in methods if name not in METHODS]
    if unknown or not methods:
        raise InputError(f"--method takes {', '.join(METHODS)}; got {', '.join(unknown) or 'none'}")
    if seeds < 1:
        raise InputError(f"--seeds must be at least 1, got {seeds}")
    if initial not in ("given", "found"):
        raise InputError(f"--initial must be given or found, got {initial!r}")
    if not particles or min(particles) < 1:
        raise InputError(f"--particles must be 1 or more, got {' '.join(map(str, particles))!r}")
    for name, values in (("particles", particles), ("size", sizes)):
        if len(set(values)) < max(len(values), 1):
            raise InputError(f"--{name} takes each value once, got {' '.join(map(str, values))!r}")
    for size in sizes:
        image_size(size)


def _check_footage(cameras: str | None, loop: int, clips: int) -> None:
    """Refuse what cannot be had from videos that are there."""
    if cameras is not None:
        raise InputError("--cameras: HumanEva has its own calibration; leave the option out")
    if loop or clips != 1:
        raise InputError(
            "--loop and --clips have no meaning for the videos of HumanEva: each person has one filmed "
            "trial of an action; leave them out"
        )


def _one_action(clips: Sequence[MocapClip]) -> None:
    found = sorted({clip.action for clip in clips})
    if len(found) > 1:
        raise InputError(
            f"a manifold is of one action; the recordings are of {', '.join(found)}: choose with "
            "--actions"
        )


def _default_persons(clips: Sequence[MocapClip]) -> tuple[str, ...]:
    """Return CMU's four walkers where all of them are, else everybody with four trials or more."""
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


def _looped(split: Split, times: int) -> Split:
    return split._replace(test=tuple(looped(clip, times) for clip in split.test))
