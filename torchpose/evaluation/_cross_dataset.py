"""Cross-dataset: priors of one data set on another one's persons, and what motion capture adds.

1. Every data set for training and for testing. Where one has no heads, they are made up by a
   conditional Gaussian learnt on the training persons of those that have (`completion`), with a
   residual drawn for each training recording, so that priors have all their dimensions, and the neck
   is put where these have theirs; hands are wrists in all of them then, and heads are never measured,
   scored or aligned on. Nothing is learnt from a person that is tested.
2. Motion capture completed in the same way, with heads and hands, added to recordings of a sensor:
   does a data set that was left out get a smaller error?

Camera and noise are those of `score`; covariances are not calibrated. A folder that holds the published
data sets by their names is run with these: UTD-MHAD (Kinect v1) and Berkeley MHAD (optical motion
capture) in the first part, all of them in the second.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

from torchpose._core.checks import check_count, check_positive
from torchpose._core.files import check_output_folder
from torchpose._core.wording import counted
from torchpose.errors import InputError
from torchpose.evaluation._completion import (
    Completion,
    complete,
    facing_pieces,
    learn_completion,
    with_wrists,
)
from torchpose.evaluation._cross_tables import Crossed, add_added, add_cross, plot_cross
from torchpose.evaluation._person_recordings import by_person, read_known_persons
from torchpose.evaluation._report import Report
from torchpose.evaluation._trials import Recipe, draw_picture
from torchpose.evaluation._unseen import Job, Scored, ScoreSettings, fit_settings, run_jobs
from torchpose.io._recordings import Recording
from torchpose.learning._curation.splits import refuse_shared_between_persons
from torchpose.learning._recipes.upper_body import fit_kinect_prior
from torchpose.skeleton._upper_body import upper_body_indices

_UTD, _MHAD = "kinect_utd_mhad", "mocap_berkeley_mhad"
_KINECT = (_UTD, "burke_kinect", "kinect_laban")
_MOCAP = (_MHAD, "mocap_cmu_walk", "mocap_cmu_actions")
_TESTED = {"UTD": ("s7", "s8"), "MHAD": ("s9", "s10", "s11")}
"""Persons that no prior of their own data set sees. In MHAD s4 and s12, and s10 and s11, have bodies
of one size; the pairs stay together."""

_HELD_SHARE = 4  # one of so many persons is tested, if none is named

_Persons = dict[str, list[Recording]]
"""Recordings by person."""


class _DataSets(NamedTuple):
    """Holds the recordings of each data set, by the name of its folder.

    Attributes:
        sets: that are crossed, and left out in turn. mocap: that is added.
        published: whether they are those known by their names. notes: on what is doubtful about them.
    """

    sets: dict[str, list[Recording]]
    mocap: dict[str, list[Recording]]
    published: bool
    notes: list[str]


class _Split(NamedTuple):
    """Holds the persons of a data set: to train on, and to test on."""

    train: _Persons
    tested: _Persons


class _Alike(NamedTuple):
    """Holds the data sets with the same joints, by name.

    Attributes:
        drawn: to train on, made-up heads with residuals. mean: to test, without.
        completion: what made heads up, where some were. how: what was done, for the tables.
    """

    drawn: dict[str, _Persons]
    mean: dict[str, _Split]
    completion: Completion | None
    how: Crossed


class _Held(NamedTuple):
    """Holds the persons left out, and training sets for them: alone first, then with motion capture."""

    tests: _Persons
    trains: dict[str, list[Recording]]
    completion: Completion


def run(
    data: Sequence[str | Path] | str | Path,
    out: str | Path,
    *,
    seed: int = 0,
    progress: bool = True,
    quick: bool = False,
    part: str = "both",
    tested: tuple[str, ...] = (),
    added: tuple[str, ...] = (),
    n_components: int | None = None,
    window_components: int | None = None,
    window_samples: int | None = None,
    mocap_share: float = 1.0,
    every: int = 1,
    curate: bool = True,
    workers: int = 1,
    fits: str | None = None,
    recipe: Recipe = fit_kinect_prior,
) -> Report:
    """Run the protocol; writes report.json, report.md and a picture to `out`.

    Args:
        data: two folders or more, each with the recordings of a data set; or one folder with
            kinect_utd_mhad and mocap_berkeley_mhad, and for the second part also with burke_kinect,
            kinect_laban, mocap_cmu_walk and mocap_cmu_actions.
        out: folder for the results.
        seed: the seed of priors, noise and made-up joints. progress: whether to show bars.
        n_components, window_components, window_samples, every, curate, workers, fits: see
            `torchpose.evaluation._leave_one_person_out.run`.
        quick: small priors and few sequences, to see that all of it works.
        part: the part to run: "cross", "added" (motion capture for training) or "both" (default).
        tested: persons whom no prior of their own data set sees; by default the last quarter of a data
            set.
        added: folders of motion capture for the second part, with shoulders, elbows, wrists and hips;
            without one there is no second part.
        mocap_share: the largest number of frames of motion capture that are added, as a multiple of the
            others'.
        recipe: fits the priors.

    Raises:
        InputError: no such data, an unknown `part` or person, settings out of range. OverlapError: one
            recording under two persons. OutputError: `out` cannot be written.
    """
    check_count("every", every)
    check_count("workers", workers)
    check_positive("mocap_share", mocap_share)
    folders = [Path(data)] if isinstance(data, str | Path) else [Path(path) for path in data]
    part = _part_of(part, len(folders), added)
    out = check_output_folder(out)
    read = _read(folders, added, part, curate)
    _check_tested(read, tested)
    folder = check_output_folder(fits or out)
    settings = fit_settings(
        "cross-dataset", seed, quick, n_components, window_components, window_samples, 0
    )
    scoring = ScoreSettings(seed=seed, every=max(every, 10) if quick else every)
    common: dict[str, Any] = {"settings": settings, "recipe": recipe}
    report = Report("Across data sets", settings | {
        "quick": quick, "every": scoring.every, "curate": curate, "recipe": recipe.__qualname__, "part": part,
        "mocap share": mocap_share, "threads": torch.get_num_threads(), "workers": workers,
    })  # fmt: skip
    thin = 8 if quick else 1

    def scored(jobs: Sequence[Job]) -> list[dict[str, Scored]]:
        return run_jobs(jobs, folder, workers, progress)

    if part != "added":
        sets = _with_same_joints(_crossed(read, tested, thin), seed)
        _report_cross(report, out, sets, scored(_cross_jobs(sets, scoring, common)))
    if part != "cross":
        left_out = _left_out(read, thin, seed, mocap_share)
        jobs = _added_jobs(left_out, scoring, common)
        _report_added(report, left_out, jobs, scored(list(jobs.values())))
    report.findings += read.notes
    report.save(out)
    return report


def _part_of(part: str, n_folders: int, added: Sequence[str]) -> str:
    """Return the part that is run: the first one alone where there is nothing for the second.

    Raises:
        InputError: an unknown part, or motion capture that no part takes, or that is missing.
    """
    if part not in ("both", "cross", "added"):
        raise InputError(f"part must be cross, added or both, got {part!r}")
    if added and (part == "cross" or n_folders == 1):
        raise InputError(
            "added: motion capture is for the second part (added or both) on two folders or more, got part "
            f"{part} and {counted(n_folders, 'folder')}; leave --added out"
        )
    if n_folders == 1 or added:
        return part
    if part == "added":
        raise InputError("expected folders of motion capture with --added, got none")
    return "cross"


def _report_cross(
    report: Report, out: Path, sets: _Alike, found: Sequence[Mapping[str, Scored]]
) -> None:
    """Add what the first part found, and its picture."""
    add_cross(report, dict(zip(sets.mean, found, strict=True)), sets.how)
    if sets.completion is not None:
        heads = f"heads of {', '.join(sets.how.completed)}"
        _add_completion(report, {heads: sets.completion})
    draw_picture(report, out, "cross-dataset.png", lambda: plot_cross(report, list(sets.mean)))


def _added_jobs(
    left_out: Mapping[str, _Held], scoring: ScoreSettings, common: Mapping[str, Any]
) -> dict[tuple[str, str], Job]:
    """Return the jobs of the second part, by the persons left out and the training set."""
    return {
        (held, label): Job(f"{held}, {label}", train, one.tests, test=scoring, **common)
        for held, one in left_out.items()
        for label, train in one.trains.items()
    }


def _report_added(
    report: Report,
    left_out: Mapping[str, _Held],
    jobs: Mapping[tuple[str, str], Job],
    found: Sequence[Mapping[str, Scored]],
) -> None:
    """Add what the second part found."""
    frames = {key: sum(map(len, job.train)) for key, job in jobs.items()}
    add_added(report, dict(zip(jobs, found, strict=True)), frames)
    _add_completion(report, {f"without {held}": one.completion for held, one in left_out.items()})


# --- data sets ------------------------------------------------------------------------------------


def _recordings_of(persons: Mapping[str, list[Recording]]) -> list[Recording]:
    return [recording for group in persons.values() for recording in group]


def _read(folders: Sequence[Path], added: Sequence[str], part: str, curated: bool) -> _DataSets:
    """Read all data sets that the parts need.

    Raises:
        InputError: there are none. OverlapError: one recording under two persons.
    """
    published = len(folders) == 1
    if published:
        sets = _published(folders[0], (_UTD,) if part == "cross" else _KINECT)
        mocap = _published(folders[0], (_MHAD,) if part == "cross" else _MOCAP)
    else:
        sets, mocap = _named(folders), _named(added if part != "cross" else ())
    read = {
        folder: read_known_persons(folder, curated)
        for folder in dict.fromkeys([*sets.values(), *mocap.values()])
    }
    refuse_shared_between_persons([r for found in read.values() for r in found.recordings])
    return _DataSets(
        {name: read[folder].recordings for name, folder in sets.items()},
        {name: read[folder].recordings for name, folder in mocap.items()},
        published,
        [note for found in read.values() for note in found.notes],
    )


def _published(home: Path, names: Sequence[str]) -> dict[str, Path]:
    """Return folders of data sets that are known by their names."""
    for name in names:
        if not (home / name).is_dir():
            raise InputError(
                f"{home}: expected the folder {name} in it, found none; or name two folders or more, "
                "one for each data set"
            )
    return {name: home / name for name in names}


def _named(folders: Sequence[str | Path]) -> dict[str, Path]:
    """Return folders by their names."""
    names = [Path(folder).resolve().name for folder in folders]
    if len(set(names)) < len(names):
        raise InputError(
            f"data sets are told apart by their folders' names, got {', '.join(names)}"
        )
    return {name: Path(folder) for name, folder in zip(names, folders, strict=True)}


def _thinned(recordings: Sequence[Recording], thin: int) -> _Persons:
    """Return recordings by person; each n-th of every person."""
    return {person: group[::thin] for person, group in by_person(recordings).items()}


def _check_tested(read: _DataSets, tested: Sequence[str]) -> None:
    """Raise `InputError` for persons to test whom no data set has, or who are not asked for."""
    if read.published and tested:
        raise InputError(
            f"tested: the published data sets have test persons of their own, got {', '.join(tested)}; "
            "leave them out, or name two folders or more"
        )
    known = [person for recordings in read.sets.values() for person in by_person(recordings)]
    unknown = [person for person in tested if person not in known]
    if unknown:
        raise InputError(
            f"tested: there is no {', '.join(unknown)}; the persons are {', '.join(known)}"
        )


def _split(persons: _Persons, tested: Sequence[str], name: str) -> _Split:
    """Put persons to train on and to test apart.

    Raises:
        InputError: there is nobody of either.
    """
    held = {person: group for person, group in persons.items() if person in tested}
    train = {person: group for person, group in persons.items() if person not in tested}
    if not held or not train:
        raise InputError(
            f"{name}: expected recordings of persons to test ({', '.join(tested)}) and of others to train "
            f"on, found {', '.join(persons)} alone; add a person"
        )
    return _Split(train, held)


def _held_out(persons: _Persons, tested: Sequence[str]) -> list[str]:
    """Return the test persons: the named ones, else the last quarter."""
    last = list(persons)[-max(1, len(persons) // _HELD_SHARE) :]
    return [person for person in persons if person in tested] or last


def _crossed(read: _DataSets, tested: Sequence[str], thin: int) -> dict[str, _Split]:
    """Return the data sets of the first part by name."""
    if read.published:
        published = {"UTD": (_UTD, read.sets[_UTD]), "MHAD": (_MHAD, read.mocap[_MHAD])}
        return {
            short: _split(_thinned(recordings, thin), _TESTED[short], name)
            for short, (name, recordings) in published.items()
        }
    sets = {name: _thinned(recordings, thin) for name, recordings in read.sets.items()}
    return {name: _split(own, _held_out(own, tested), name) for name, own in sets.items()}


def _with_same_joints(sets: Mapping[str, _Split], seed: int) -> _Alike:
    """Return the data sets with the same joints: heads made up, and wrists as hands, if one lacks them.

    Raises:
        InputError: heads are missing in all of them.
    """

    def kinds(name: str) -> list[Any]:
        recordings = [r for part in sets[name] for r in _recordings_of(part)]
        return [upper_body_indices(names) for names in {tuple(r.names) for r in recordings}]

    lacking = [name for name in sets if any(kind.head is None for kind in kinds(name))]
    donors = [name for name in sets if name not in lacking]
    if not donors:
        raise InputError(f"heads are missing in all data sets: {', '.join(lacking)}")
    wrists = bool(lacking) or any(kind.hand == "wrist" for name in sets for kind in kinds(name))
    learnt = [r for name in donors for r in _recordings_of(sets[name].train)]
    completion = learn_completion(learnt, ("head",)) if lacking else None

    def convert(name: str, persons: _Persons, source: torch.Generator | None) -> _Persons:
        def one(recording: Recording) -> Recording:
            if completion is not None and name in lacking:
                return complete(recording, completion, source)
            if wrists and recording.upper_body().hand != "wrist":
                return with_wrists(recording)
            return recording

        return {person: [one(r) for r in group] for person, group in persons.items()}

    generator = torch.Generator().manual_seed(seed)
    drawn = {name: convert(name, split.train, generator) for name, split in sets.items()}
    mean = {
        name: _Split(*(convert(name, part, None) for part in split)) for name, split in sets.items()
    }
    persons = {name: [*split.tested, *split.train] for name, split in sets.items()}
    tested = {name: list(split.tested) for name, split in sets.items()}
    return _Alike(drawn, mean, completion, Crossed(persons, tested, wrists, lacking, donors))


def _cross_jobs(sets: _Alike, scoring: ScoreSettings, common: dict[str, Any]) -> list[Job]:
    """Return a fit to each data set, scored on the tested persons of all, and everybody of the others."""

    def labelled(name: str, persons: _Persons) -> _Persons:
        return {sets.how.label(name, person): group for person, group in persons.items()}

    if sets.completion is not None:
        head = ("head",)
        scoring = replace(scoring, unmeasured=head, unscored=head, likelihood=False)
    held = {
        k: v for name, split in sets.mean.items() for k, v in labelled(name, split.tested).items()
    }
    jobs = []
    for name, train in sets.drawn.items():
        far = {
            k: v
            for other, split in sets.mean.items()
            if other != name
            for k, v in labelled(other, split.train).items()
        }
        jobs.append(
            Job(f"trained on {name}", _recordings_of(train), held | far, test=scoring, **common)
        )
    return jobs


# --- motion capture added -------------------------------------------------------------------------


def _left_out(read: _DataSets, thin: int, seed: int, share: float) -> dict[str, _Held]:
    """Return training sets with and without motion capture for every data set that is left out."""
    held: dict[str, tuple[_Persons, dict[str, _Persons]]]
    few = set(_KINECT) - {_UTD} if read.published else set()  # too few recordings to be thinned
    sets = {n: _thinned(own, 1 if n in few else thin) for n, own in read.sets.items()}
    mocap = {n: _thinned(own, thin) for n, own in read.mocap.items()}
    if read.published:
        labels = "Kinect alone", "with MHAD", "with all motion capture"
        some = _split(sets[_UTD], _TESTED["UTD"], _UTD)
        extra = {"UTD s7, s8": (some.tested, sets | {_UTD: some.train})}
    else:
        labels, extra = ("alone", f"with {next(iter(mocap))}", "with all motion capture"), {}
    held = {name: (own, {n: p for n, p in sets.items() if n != name}) for name, own in sets.items()}
    pieces = {
        name: [piece for r in _recordings_of(persons) for piece in facing_pieces(r)]
        for name, persons in mocap.items()
    }
    found = {}
    for name, (tests, left) in (held | extra).items():
        base = [r for persons in left.values() for r in _recordings_of(persons)]
        completion = learn_completion(base)
        generator = torch.Generator().manual_seed(seed)
        made = [[complete(r, completion, generator) for r in own] for own in pieces.values()]
        bound = round(share * sum(map(len, base)))
        first, whole = made[0], [r for own in made for r in own]
        sources: list[list[Recording]] = [[], _at_most(first, bound), _at_most(whole, bound)]
        trains = {
            label: base + more
            for label, more in zip(labels, sources[: len(made) + 1], strict=False)
        }
        found[name] = _Held(tests, trains, completion)
    return found


def _at_most(recordings: Sequence[Recording], bound: int) -> list[Recording]:
    """Return evenly spread recordings with at most about as many frames, counted at 30 per second."""
    frames = [len(r) * 30.0 / (r.fps or 30.0) for r in recordings]
    step = max(1.0, sum(frames) / max(1, bound))
    wanted = {int(i * step) for i in range(int(len(recordings) / step))}
    return [r for i, r in enumerate(recordings) if i in wanted]


def _add_completion(report: Report, completions: Mapping[str, Completion]) -> None:
    """Add how far made-up joints are from true ones, on the recordings they were learnt on."""
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
