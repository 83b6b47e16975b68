"""Cross-dataset: priors of one data set on another one's persons, and what motion capture adds.

1. UTD-MHAD (Kinect v1) and Berkeley MHAD (optical motion capture), each for training and for
   testing. Hands are wrists on both sides. MHAD has no head, and another neck: its head is made up by
   a conditional Gaussian learnt on UTD's training persons (`completion`), with a residual drawn for
   each training recording, so that priors have all their dimensions; the neck is put where UTD's
   training persons have theirs. The head is never measured, scored or aligned on. Nothing is learnt
   from a person that is tested.
2. Motion capture completed in the same way, with heads and hands, added to Kinect recordings: does a
   Kinect data set that was left out get a smaller error?

Camera, noise and error are those of UB-people; covariances are not calibrated.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

from torchpose._core.files import check_output_folder
from torchpose.errors import InputError
from torchpose.evaluation.common import Recipe, add_picture
from torchpose.evaluation.completion import (
    Completion,
    complete,
    facing_pieces,
    learn_completion,
    with_wrists,
)
from torchpose.evaluation.cross_tables import add_added, add_cross, plot_cross
from torchpose.evaluation.persons import by_person
from torchpose.evaluation.report import Report
from torchpose.evaluation.unseen import Job, ScoreSettings, fit_settings, run_jobs
from torchpose.io._recordings import Recording, read_recordings
from torchpose.learning._recipes.upper_body import fit_kinect_prior

__all__ = ["run"]

_UTD, _MHAD = "kinect_utd_mhad", "mocap_berkeley_mhad"
_KINECT = (_UTD, "burke_kinect", "kinect_laban")
_MOCAP = (_MHAD, "mocap_cmu_walk", "mocap_cmu_actions")
_TESTED = {"UTD": ("s7", "s8"), "MHAD": ("s9", "s10", "s11")}
"""Persons that no prior of their own data set sees. In MHAD s4 and s12, and s10 and s11, have bodies
of one size; the pairs stay together."""

_NO_HEAD = ("head",)


class _Split(NamedTuple):
    """Persons of a data set: to train on and to test, by name."""

    train: dict[str, list[Recording]]
    tested: dict[str, list[Recording]]


class _Wrists(NamedTuple):
    """UTD and MHAD with wrists as hands: MHAD with drawn heads to train on, mean ones to test."""

    completion: Completion
    utd: _Split
    drawn: _Split
    mean: _Split


def run(
    data: str | Path,
    out: str | Path,
    *,
    seed: int = 0,
    progress: bool = True,
    quick: bool = False,
    part: str = "both",
    n_components: int | None = None,
    window_components: int | None = None,
    window_samples: int | None = None,
    mocap_share: float = 1.0,
    every: int = 1,
    workers: int = 1,
    fits: str | None = None,
    recipe: Recipe = fit_kinect_prior,
) -> Report:
    """Run the protocol; writes report.json, report.md and a picture to `out`.

    Args:
        data: folder with kinect_utd_mhad and mocap_berkeley_mhad; for the second part also with
            burke_kinect, kinect_laban, mocap_cmu_walk and mocap_cmu_actions. out: folder for the
            results.
        seed: of priors, noise and made-up joints. progress: whether to show bars.
        quick: small priors and few sequences, to see that all of it works.
        part: "cross", "added" (motion capture for training) or "both".
        n_components: Gaussians per arm over poses; this and the next two as the recipe has them if
            None.
        window_components: Gaussians per arm over windows. window_samples: training windows.
        mocap_share: frames of motion capture that are added, at most, as a multiple of the Kinect's.
        every: only each n-th sequence of a person is tracked. workers: processes.
        fits: folder of fitted priors, to share them with other protocols; `out` if None.
        recipe: fits the priors.

    Raises:
        InputError: no such data, an unknown `part`. OutputError: `out` cannot be written.
    """
    if part not in ("both", "cross", "added"):
        raise InputError(f"part must be cross, added or both, got {part!r}")
    out = check_output_folder(out)
    folder = check_output_folder(fits or out)
    settings = fit_settings(
        "cross-dataset", seed, quick, n_components, window_components, window_samples, 0
    )
    scoring = ScoreSettings(seed=seed, every=max(every, 10) if quick else every)
    common: dict[str, Any] = {"settings": settings, "recipe": recipe}
    report = Report("Across data sets", settings | {
        "quick": quick, "every": scoring.every, "recipe": recipe.__qualname__, "part": part,
        "mocap share": mocap_share, "threads": torch.get_num_threads(), "workers": workers,
    })  # fmt: skip
    thin = 8 if quick else 1
    if part != "added":
        sets = _wrists(Path(data), thin, seed)
        scoring_both = replace(scoring, unmeasured=_NO_HEAD, unscored=_NO_HEAD, likelihood=False)
        held = _labelled("UTD", sets.utd.tested) | _labelled("MHAD", sets.mean.tested)
        jobs = [
            Job(f"trained on {name}", _all(train), held | far, test=scoring_both, **common)
            for name, train, far in (
                ("UTD", sets.utd.train, _labelled("MHAD", sets.mean.train)),
                ("MHAD", sets.drawn.train, _labelled("UTD", sets.utd.train)),
            )
        ]
        found = run_jobs(jobs, folder, workers, progress)
        add_cross(report, dict(zip(("UTD", "MHAD"), found, strict=True)), _TESTED)
        _add_completion(report, {"heads of MHAD": sets.completion})
        add_picture(report, out, "cross-dataset.png", plot_cross(report))
    if part != "cross":
        left_out = _training_sets(Path(data), thin, seed, mocap_share)
        keys = [(held, label) for held, (_, trains, _) in left_out.items() for label in trains]
        jobs = [
            Job(", ".join(key), left_out[key[0]][1][key[1]], left_out[key[0]][0], test=scoring,
                **common)
            for key in keys
        ]  # fmt: skip
        found = run_jobs(jobs, folder, workers, progress)
        frames = [sum(map(len, job.train)) for job in jobs]
        scores = dict(zip(keys, found, strict=True))
        add_added(report, scores, dict(zip(keys, frames, strict=True)))
        _add_completion(report, {f"without {held}": c for held, (_, _, c) in left_out.items()})
    report.save(out)
    return report


def _labelled(name: str, persons: Mapping[str, list[Recording]]) -> dict[str, list[Recording]]:
    return {f"{name} {person}": group for person, group in persons.items()}


def _all(persons: Mapping[str, list[Recording]]) -> list[Recording]:
    return [recording for group in persons.values() for recording in group]


def _read(data: Path, name: str, thin: int) -> dict[str, list[Recording]]:
    """Recordings of one data set by person; each n-th of every person."""
    if not (data / name).is_dir():
        raise InputError(f"{data}: expected the folder {name} in it, found none")
    return {
        person: group[::thin] for person, group in by_person(read_recordings(data / name)).items()
    }


def _split(persons: Mapping[str, list[Recording]], tested: Sequence[str], name: str) -> _Split:
    """Persons apart into those to train on and those to test.

    Raises:
        InputError: there is nobody of either.
    """
    held = {person: group for person, group in persons.items() if person in tested}
    train = {person: group for person, group in persons.items() if person not in tested}
    if not held or not train:
        raise InputError(
            f"{name}: expected recordings of {', '.join(tested)} and of others, found "
            f"{', '.join(persons)}"
        )
    return _Split(train, held)


def _wrists(data: Path, thin: int, seed: int) -> _Wrists:
    """Both data sets with wrists as hands."""
    kinect = _split(_read(data, _UTD, thin), _TESTED["UTD"], _UTD)
    mocap = _split(_read(data, _MHAD, thin), _TESTED["MHAD"], _MHAD)
    completion = learn_completion(_all(kinect.train), ("head",))

    def completed(source: torch.Generator | None) -> _Split:
        return _each(mocap, lambda recording: complete(recording, completion, source))

    drawn = completed(torch.Generator().manual_seed(seed))
    return _Wrists(completion, _each(kinect, with_wrists), drawn, completed(None))


def _each(split: _Split, convert: Callable[[Recording], Recording]) -> _Split:
    return _Split(*({n: [convert(r) for r in g] for n, g in part.items()} for part in split))


def _training_sets(
    data: Path, thin: int, seed: int, share: float
) -> dict[str, tuple[dict[str, list[Recording]], dict[str, list[Recording]], Completion]]:
    """For every data set left out: its persons, training sets by name, and the completion."""
    kinect = {name: _read(data, name, thin if name == _UTD else 1) for name in _KINECT}
    mocap = {
        name: [piece for r in _all(_read(data, name, thin)) for piece in facing_pieces(r)]
        for name in _MOCAP
    }
    tested = _split(kinect[_UTD], _TESTED["UTD"], _UTD)
    held: dict[str, tuple[dict[str, list[Recording]], dict[str, dict[str, list[Recording]]]]] = {
        name: (kinect[name], {n: p for n, p in kinect.items() if n != name}) for name in _KINECT
    }
    held["UTD s7, s8"] = (tested.tested, kinect | {_UTD: tested.train})
    sets = {}
    for name, (tests, left) in held.items():
        base = [r for persons in left.values() for r in _all(persons)]
        completion = learn_completion(base)
        generator = torch.Generator().manual_seed(seed)
        made = {
            other: [complete(r, completion, generator) for r in pieces]
            for other, pieces in mocap.items()
        }
        bound = round(share * sum(map(len, base)))
        whole = [r for pieces in made.values() for r in pieces]
        trains = {
            "Kinect alone": base,
            "with MHAD": base + _at_most(made[_MHAD], bound),
            "with all motion capture": base + _at_most(whole, bound),
        }
        sets[name] = (tests, trains, completion)
    return sets


def _at_most(recordings: Sequence[Recording], bound: int) -> list[Recording]:
    """Evenly spread recordings with at most about as many frames, counted at 30 per second."""
    frames = [len(r) * 30.0 / (r.fps or 30.0) for r in recordings]
    step = max(1.0, sum(frames) / max(1, bound))
    wanted = {int(i * step) for i in range(int(len(recordings) / step))}
    return [r for i, r in enumerate(recordings) if i in wanted]


def _add_completion(report: Report, completions: Mapping[str, Completion]) -> None:
    """How far made-up joints are from true ones, on the recordings they were learnt on."""
    if "completion" not in report:
        report.table(
            "completion",
            "Made-up joints: residual on the recordings they were learnt on (cm)",
            ["persons", "frames", "head", "hand L", "hand R", "neck"],
            digits=(0, 0, 1, 1, 1, 1),
        )
    for name, completion in completions.items():
        spread = [
            100 * completion.spread[target] if target in completion.spread else None
            for target in ("head", "hand_left", "hand_right")
        ]
        row = [len(completion.persons), completion.frames, *spread]
        report["completion"].add(name, [*row, 100 * completion.neck.residual])
