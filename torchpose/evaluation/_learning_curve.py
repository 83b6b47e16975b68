"""Learning curve: error on persons never seen over the number of training persons.

For each number n, priors are fitted to cyclic runs of n persons (s1 s2, s2 s3, ..., s8 s1), and each
tracks all persons whom it did not see; so few fits serve many test persons, and every person is
tracked and trained on equally often. Beyond all persons less one, persons of other recordings join the
training. A second part asks what a prior of one's own is worth: fitted to half of a person's
recordings, and scored on the other half.

Camera and noise are those of `score`. Covariances are not calibrated.
"""

import os
import re
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import torch

from torchpose._core.checks import check_count
from torchpose._core.files import check_output_folder
from torchpose.errors import InputError
from torchpose.evaluation._person_recordings import (
    KnownPersons,
    by_person,
    read_known_persons,
    renamed,
    spread,
)
from torchpose.evaluation._person_tables import (
    STAGES,
    TRACKED,
    Curve,
    Stage,
    add_pose_classes,
    mean_error,
    plot_curves,
)
from torchpose.evaluation._report import Report
from torchpose.evaluation._trials import Recipe, draw_picture
from torchpose.evaluation._unseen import Job, Scored, ScoreSettings, fit_settings, pooled, run_jobs
from torchpose.io._recordings import Recording
from torchpose.learning._curation.splits import (
    check_kinds,
    refuse_shared_between_persons,
    refuse_shared_recordings,
)
from torchpose.learning._recipes.upper_body import fit_kinect_prior

_PUBLISHED, _FURTHER = "kinect_utd_mhad", ("burke_kinect", "kinect_laban")
"""Data sets that are taken from a folder that holds them, without being named."""
_PUBLISHED_COUNTS = (1, 2, 4, 7, 9)


def run(
    data: Sequence[str | Path] | str | Path,
    out: str | Path,
    *,
    seed: int = 0,
    progress: bool = True,
    quick: bool = False,
    more: tuple[str, ...] = (),
    counts: tuple[int, ...] = (),
    n_subsets: int = 8,
    n_own: int = 8,
    n_components: int | None = None,
    window_components: int | None = None,
    window_samples: int | None = None,
    every: int = 1,
    curate: bool = True,
    workers: int = 1,
    fits: str | None = None,
    compare: tuple[str, ...] = (),
    recipes: Sequence[tuple[str, Recipe]] | None = None,
) -> Report:
    """Run the protocol; writes report.json, report.md and pictures to `out`.

    Args:
        data: folders or files with recordings of two persons or more. Of one folder that holds
            kinect_utd_mhad that is taken, with burke_kinect and kinect_laban beside it as `more`.
        out: folder for the results.
        seed: the seed of priors and noise. progress: whether to show bars.
        n_components, window_components, window_samples, every, curate, workers, fits: see
            `torchpose.evaluation._leave_one_person_out.run`.
        quick: small priors, few subsets and a tenth of the sequences, to see that all of it works.
        more: folders or files with further training persons, for counts beyond the persons of `data`
            less one.
        counts: the numbers of training persons; where none is given 1, 2, 4 and so on up to all, and for
            the published data sets 1, 2, 4, 7 and 9.
        n_subsets: the number of fits for each count, at most one for each person.
        n_own: the number of persons for whom a prior of their own is fitted; 0 leaves that part out, and
            persons with one recording are left out of it.
        compare: other recipes to draw beside the one of the shipped priors, each as NAME=module.function.
        recipes: names and functions, instead of all that.

    Raises:
        InputError: no such data, more training persons than there are, an unknown recipe, settings out
            of range. OverlapError: one recording under two persons, or in both halves of one.
            PriorError: hands beside wrists. OutputError: `out` cannot be written.
    """
    for setting, value in {"every": every, "workers": workers, "n_subsets": n_subsets}.items():
        check_count(setting, value)
    for count in counts:
        check_count("counts", count)
    out = check_output_folder(out)
    known = list(recipes or [("this recipe", fit_kinect_prior), *map(_imported, compare)])
    if len(dict(known)) < len(known):
        raise InputError(
            f"recipes need names of their own, got {', '.join(name for name, _ in known)}; rename some"
        )
    persons, others, counts, notes = _read(data, more, counts, quick, curate)
    if quick:
        n_subsets, n_own = 2, min(1, n_own)
    settings = fit_settings(
        "learning-curve", seed, quick, n_components, window_components, window_samples, 0
    )
    scoring = ScoreSettings(seed=seed, every=max(every, 10) if quick else every)
    fittings = {name: _Fitting(settings, recipe, scoring) for name, recipe in known}
    jobs = _curve_jobs(persons, others, counts, n_subsets, fittings)
    own = _own_jobs(persons, n_own, fittings)
    folder = check_output_folder(fits or out)
    found = run_jobs([*jobs.values(), *own.values()], folder, workers, progress)
    scores = dict(zip([*jobs, *own], found, strict=True))
    report = Report("Learning curve over persons", settings | {
        "quick": quick, "every": scoring.every, "curate": curate, "counts": list(counts),
        "subsets": n_subsets, "persons": list(persons), "further training persons": list(others),
        "recipes": {name: f"{r.__module__}.{r.__qualname__}" for name, r in known},
        "threads": torch.get_num_threads(), "workers": workers,
    })  # fmt: skip
    curves = _add_curve(report, [name for name, _ in known], counts, jobs, scores, len(persons))
    if own:
        _add_own(report, own, scores)
    _add_classes(report, known[0][0], counts, jobs, scores)
    _add_findings(report, curves)
    whole = [name for name, group in persons.items() if len(group) < 2]
    if n_own and whole:
        report.findings.append(
            f"Not tested on a prior of their own, with one recording only: {', '.join(whole)}."
        )
    report.findings += notes
    tracked: dict[str, dict[str, Curve]] = {stage: curves[stage] for stage in TRACKED}
    title = "Persons never seen: error over the number of training persons"
    draw_picture(report, out, "learning-curve.png", lambda: plot_curves(tracked, title))
    report.save(out)
    return report


def cyclic_subsets(names: Sequence[str], count: int, n_subsets: int) -> list[list[str]]:
    """Return runs of `count` names, the first following the last, from starts that are evenly spread.

    Never all of the names, so that somebody is left to score: at most all but one.

    >>> cyclic_subsets(["a", "b", "c", "d"], 2, 2)
    [['a', 'b'], ['c', 'd']]
    """
    n = len(names)
    length = min(count, n - 1)
    n_subsets = min(n_subsets, n)
    starts = [(i * n) // n_subsets for i in range(n_subsets)]
    return [[names[(start + k) % n] for k in range(length)] for start in starts]


def halves(recordings: Sequence[Recording]) -> tuple[list[Recording], list[Recording]]:
    """Return a person's recordings in two halves, each with half of the trials of every action.

    Trials follow each other in the order of their files. Of an odd number the middle one goes to the
    half that has fewer recordings so far.
    """
    actions: dict[str, list[Recording]] = {}
    for recording in recordings:
        actions.setdefault(recording.action, []).append(recording)
    first: list[Recording] = []
    second: list[Recording] = []
    for group in actions.values():
        middle = len(group) // 2
        if len(group) % 2 and len(first) <= len(second):
            middle += 1
        first += group[:middle]
        second += group[middle:]
    return first, second


def _imported(text: str) -> tuple[str, Recipe]:
    """Return NAME=module.function as name and function; modules may be in the working folder."""
    if os.getcwd() not in sys.path:  # `python -m` has it, and the command `torchpose` has not
        sys.path.append(os.getcwd())
    match = re.fullmatch(r"(.+)=([\w.]+)\.(\w+)", text)
    try:
        if match is not None:
            return match[1], getattr(import_module(match[2]), match[3])
    except (ImportError, AttributeError) as error:
        raise InputError(f"--compare {text}: there is no such function ({error})") from error
    raise InputError(f"--compare {text}: expected NAME=module.function")


class _Persons(NamedTuple):
    """Holds recordings by person, of those who are tracked and of others, counts, and what is doubtful."""

    persons: dict[str, list[Recording]]
    others: dict[str, list[Recording]]
    counts: tuple[int, ...]
    notes: list[str]


def _read(
    data: Sequence[str | Path] | str | Path,
    more: Sequence[str],
    counts: tuple[int, ...],
    quick: bool,
    curated: bool,
) -> _Persons:
    """Return the persons and the numbers of them that priors are fitted to, few for a quick run."""
    folders, further, usual = _sources(data, more)
    recordings, notes = read_known_persons(folders, curated)
    persons = by_person(recordings)
    if len(persons) < 2:
        raise InputError(f"a learning curve needs two persons or more, got {', '.join(persons)}")
    counts = counts or usual or _doubling(len(persons) - 1)
    if more and max(counts) < len(persons):
        raise InputError(
            f"more: further training persons are for counts beyond the {len(persons) - 1} who are there "
            f"beside the one who is tracked, got counts of {', '.join(map(str, counts))}; give larger ones "
            "(--counts), or leave --more out"
        )
    if quick:
        persons = {name: group[::5] for name, group in persons.items()}
        counts = tuple(c for c in counts if c in counts[:2])
    others, more_notes = _further_persons(further, len(persons) - 1, max(counts), curated)
    everything = [*recordings, *(r for group in others.values() for r in group)]
    refuse_shared_between_persons(everything)
    check_kinds(everything)
    return _Persons(persons, others, counts, [*notes, *more_notes])


def _sources(
    data: Sequence[str | Path] | str | Path, more: Sequence[str]
) -> tuple[list[Path], list[Path], tuple[int, ...]]:
    """Return the folders of the recordings and of further persons, and the usual counts, if any."""
    given = [Path(data)] if isinstance(data, str | Path) else [Path(path) for path in data]
    further = [Path(path) for path in more]
    home = given[0] if len(given) == 1 else Path()
    if home.name != _PUBLISHED and not (home / _PUBLISHED).is_dir():
        return given, further, ()
    beside = [home / name for name in _FURTHER if (home / name).is_dir()]
    found = home if home.name == _PUBLISHED else home / _PUBLISHED
    return [found], further or beside, _PUBLISHED_COUNTS


def _doubling(most: int) -> tuple[int, ...]:
    """Return 1, 2, 4 and so on, and the most itself.

    >>> _doubling(5)
    (1, 2, 4, 5)
    """
    return tuple(sorted({min(2**i, most) for i in range(most.bit_length() + 1)}))


def _further_persons(
    folders: Sequence[Path], most: int, count: int, curated: bool
) -> tuple[dict[str, list[Recording]], list[str]]:
    """Return the missing number of further training persons, and notes on their recordings."""
    missing = count - most
    if missing <= 0:
        return {}, []
    recordings, notes = read_known_persons(folders, curated) if folders else KnownPersons([], [])
    others = by_person(recordings)
    if missing > len(others):
        raise InputError(
            f"{count} training persons are asked for, and there are {most} beside the one who is "
            f"tracked, and {len(others)} further ones; name recordings of others with --more, or "
            "smaller --counts"
        )
    return dict(list(others.items())[:missing]), notes


class _Fitting(NamedTuple):
    """Holds how a recipe's priors are fitted and scored, as a `Job` takes it."""

    settings: Mapping[str, Any]
    recipe: Recipe
    scoring: ScoreSettings


def _curve_jobs(
    persons: Mapping[str, list[Recording]],
    others: Mapping[str, list[Recording]],
    counts: Sequence[int],
    n_subsets: int,
    fittings: Mapping[str, _Fitting],
) -> dict[tuple[str, int, int], Job]:
    """Return fits to some persons, scored on the rest, by recipe, number of persons and place."""
    jobs = {}
    for (recipe, fitting), count in product(fittings.items(), counts):
        for i, subset in enumerate(cyclic_subsets(list(persons), count, n_subsets)):
            further = list(others.values())[: max(0, count - len(subset))]
            train = [r for name, group in persons.items() if name in subset for r in group]
            train += [r for group in further for r in group]
            tests = {name: group for name, group in persons.items() if name not in subset}
            jobs[recipe, count, i] = Job(f"{count}: {' '.join(subset)}", train, tests, *fitting)
    return jobs


def _own_jobs(
    persons: Mapping[str, list[Recording]], n_own: int, fittings: Mapping[str, _Fitting]
) -> dict[tuple[str, str, str], Job]:
    """Return fits to persons' first halves, of all others, and of both; scored on second halves.

    Persons with one recording have no second half, and are trained on only.

    Raises:
        OverlapError: a recording is in one half of a person, and a copy of it in the other one.
    """
    later = {name: halves(group)[1] for name, group in persons.items() if len(group) > 1}
    jobs: dict[tuple[str, str, str], Job] = {}
    for (recipe, fitting), person in product(fittings.items(), list(later)[:n_own]):
        first = halves(persons[person])[0]
        refuse_shared_recordings(first, later[person])
        mine = renamed(first, "first half")
        rest = [r for name, group in persons.items() if name != person for r in group]
        on = {person: later[person]}
        jobs |= {
            (recipe, person, "one"): Job(f"{person} alone", mine, later, *fitting),
            (recipe, person, "others"): Job(f"all but {person}", rest, on, *fitting),
            (recipe, person, "both"): Job(f"all, half of {person}", rest + mine, on, *fitting),
        }
    return jobs


# --- tables ---------------------------------------------------------------------------------------


def _add_curve(
    report: Report,
    recipes: Sequence[str],
    counts: Sequence[int],
    jobs: Mapping[tuple[str, int, int], Job],
    scores: Mapping[Any, Mapping[str, Scored]],
    n_persons: int,
) -> dict[str, dict[str, Curve]]:
    """Add the table of the curve; return the curves by stage and recipe."""
    table = report.table(
        "curve",
        "3D error after Procrustes (cm) on persons never seen, by number of training persons",
        ["mean pose", "filtered", "± drawn", "± tested", "smoothed", "± drawn ", "± tested ", "log-lik.",
         "fits", "tests"],
        digits=(2, 2, 2, 2, 2, 2, 2, 2, 0, 0),
        note="Mean over test persons of the mean over fits. The mean pose is that of the prior. Drawn: "
        "standard deviation over the fits that track the same person; tested: over test persons. Beyond "
        f"{n_persons - 1} persons the further ones are of other data sets.",
    )  # fmt: skip
    curves: dict[str, dict[str, Curve]] = {stage: {} for stage in STAGES}
    for recipe in recipes:
        points: dict[str, list[tuple[float, float, float]]] = {stage: [] for stage in STAGES}
        for count in counts:
            results = [scores[key] for key in jobs if key[:2] == (recipe, count)]
            for stage in STAGES:
                points[stage].append(_point(results, stage))
            likelihood = [
                float(s.log_likelihood.mean()) for found in results for s in found.values()
            ]
            table.add(f"{recipe}, {_people(count)}" if len(recipes) > 1 else _people(count), [
                points["still"][-1][0], *points["filtered"][-1], *points["smoothed"][-1],
                spread(likelihood)[0],
                len(results), sum(map(len, results)),
            ])  # fmt: skip
        for stage in STAGES:
            columns = [list(values) for values in zip(*points[stage], strict=True)]
            curves[stage][recipe] = Curve(list(counts), *columns)
    return curves


def _people(count: int) -> str:
    return f"{count} person{'s' if count > 1 else ''}"


def _point(results: Sequence[Mapping[str, Scored]], stage: Stage) -> tuple[float, float, float]:
    """Return mean, spread over fits (root mean of the variance within a person), spread over persons."""
    by_test: dict[str, list[float]] = {}
    for found in results:
        for name, scored in found.items():
            by_test.setdefault(name, []).append(mean_error(scored, stage))
    means = [spread(values)[0] for values in by_test.values()]
    variances = [spread(values)[1] ** 2 for values in by_test.values()]
    middle, tested = spread(means)
    return middle, spread(variances)[0] ** 0.5, tested


def _add_own(
    report: Report,
    own: Mapping[tuple[str, str, str], Job],
    scores: Mapping[Any, Mapping[str, Scored]],
) -> None:
    """Add one person's prior against that of many, on that person and off."""
    table = report.table(
        "own",
        "One person's prior against many (cm): tracked are the second halves of the recordings",
        ["mean pose", "filtered", "± persons", "smoothed", "± persons ", "log-lik.", "tests"],
        digits=(2, 2, 2, 2, 2, 2, 0),
        note="Halves by trial, so that no recording is in both. The mean pose is that of the "
        "prior. The spread is over the persons whom the prior of one, or all but one, is made of.",
    )
    recipes = list(dict.fromkeys(name for name, _, _ in own))
    rows = (
        ("the person's first half, on the person", "one", True),
        ("the person's first half, on others", "one", False),
        ("all others, on the person", "others", True),
        ("all others and the first half, on the person", "both", True),
    )
    for recipe in recipes:
        for label, kind, on in rows:
            found = [
                [s for name, s in scores[key].items() if (name == key[1]) is on]
                for key in own
                if key[0] == recipe and key[2] == kind
            ]
            still, filtered, smoothed = (
                spread([spread([mean_error(s, stage) for s in group])[0] for group in found])
                for stage in STAGES
            )
            likelihood = spread([float(s.log_likelihood.mean()) for g in found for s in g])[0]
            name = f"{recipe}: {label}" if len(recipes) > 1 else label
            table.add(name, [still[0], *filtered, *smoothed, likelihood, sum(map(len, found))])
    values = [float(table[name, "filtered"]) for name in list(table.rows)[:4]]
    report.findings.append(
        f"A person is tracked with {values[0]:.2f} cm by a prior of other recordings of that person, "
        f"with {values[2]:.2f} cm by one of all others, and with {values[3]:.2f} cm by one of both; "
        f"the prior of one person has {values[1]:.2f} cm on others."
    )


def _add_classes(
    report: Report,
    recipe: str,
    counts: Sequence[int],
    jobs: Mapping[tuple[str, int, int], Job],
    scores: Mapping[Any, Mapping[str, Scored]],
) -> None:
    groups = {
        _people(count): pooled(
            [s for key in jobs if key[:2] == (recipe, count) for s in scores[key].values()]
        )
        for count in counts
    }
    add_pose_classes(report, groups)


def _add_findings(report: Report, curves: Mapping[str, Mapping[str, Curve]]) -> None:
    for recipe, curve in curves["filtered"].items():
        smooth, still = curves["smoothed"][recipe], curves["still"][recipe]
        if len(curve.counts) < 2:
            continue
        report.findings.append(
            f"{recipe}: from {curve.counts[0]} to {curve.counts[-1]} training persons the error "
            f"goes from {curve.mean[0]:.2f} to {curve.mean[-1]:.2f} cm filtered and from "
            f"{smooth.mean[0]:.2f} to {smooth.mean[-1]:.2f} cm smoothed. The mean poses of these priors are "
            f"{still.mean[0]:.2f} and {still.mean[-1]:.2f} cm off."
        )
    names = list(curves["filtered"])
    for name in names[1:]:
        gains = ", ".join(
            f"{_people(count)} {ours - theirs:+.2f} / {late - theirs_late:+.2f}"
            for count, ours, theirs, late, theirs_late in zip(
                curves["filtered"][name].counts,
                curves["filtered"][names[0]].mean,
                curves["filtered"][name].mean,
                curves["smoothed"][names[0]].mean,
                curves["smoothed"][name].mean,
                strict=True,
            )
        )
        report.findings.append(
            f"'{names[0]}' against '{name}' on the same training persons, in cm filtered / smoothed: "
            f"{gains}."
        )
