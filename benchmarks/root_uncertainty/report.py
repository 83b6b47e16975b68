"""Tables of the protocol Root uncertainty, and findings on the paper's claims."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.bodies.tracking import part_error
from benchmarks.bodies.views import SEEN, Subject, subjects_of
from benchmarks.engine import (
    Results,
    Tuning,
    bootstrap,
    describe,
    mean,
    mean_of,
    pivot,
    spread,
    worst,
    worst_of,
)
from benchmarks.engine.statistics import Cell
from benchmarks.root_uncertainty.walkers import METHODS, Budget, Walker, published, selected_among
from torchpose.body import fit_state
from torchpose.evaluation import Report

PAPER = {2: 103.8, 3: 93.7}
"""Error of the published tracker, mm, by the number of cameras (DX, Tables 1 and 2)."""

_ROOT = METHODS["root"].label
_ERROR = part_error()
_AHEAD = 2.0  # mm by which one method must be ahead of another to be called better


# --- Tables 1 and 2 -------------------------------------------------------------------------------


def add_errors(report: Report, key: str, title: str, runs: Results) -> None:
    """Add the error of every method and person as in Tables 1 and 2, with the worst person and seed."""

    def persons(own: Results) -> Tensor:
        return own.values(_ERROR).mean(1)

    def between(own: Results) -> float:
        return float(persons(own).std()) if len(persons(own)) > 1 else float("nan")

    def died(own: Results) -> float:
        return 100 * float(torch.cat([run.respread for run in own.runs]).double().mean())

    def of_person(name: str) -> Cell:
        return lambda own: mean(_ERROR)(own.where(subject=name))

    cells = {name: of_person(name) for name in runs.names("subject")}
    cells |= {
        "average": mean(_ERROR), "± persons": between,
        "worst person": lambda own: float(persons(own).max()), "worst run": worst(_ERROR),
        "± seeds": spread(_ERROR), "respread (%)": died,
    }  # fmt: skip
    pivot(
        report, key, title, runs, ["method"], cells,
        note="Mean over joints and frames, mm. Average: over persons, each the mean of all seeds; "
        "± persons: standard deviation over them, as in the paper; worst run: of all persons and "
        "seeds; ± seeds: standard deviation over seeds, pooled over persons; respread: frames in "
        "which all particles died.",
    )  # fmt: skip


def _by_method(runs: Results) -> dict[str, Float[Tensor, "Q S"]]:
    return {method: own.values(_ERROR) for (method,), own in runs.by("method").items()}


def add_differences(report: Report, runs: Results) -> None:
    """Add the root tracker minus the others under every condition, with intervals."""
    table = report.table(
        "differences", "Differences (mm) with the 95 % intervals of a bootstrap",
        ["mean", "from", "to", "worst run", "from ", "to "],
        note="Below zero is for the root tracker. Drawn again are persons and seeds.",
    )  # fmt: skip
    for (condition,), own in runs.by("condition").items():
        errors = _by_method(own)
        for other in [name for name in errors if name != _ROOT and _ROOT in errors]:
            both = errors[_ROOT], errors[other]
            cells = [*bootstrap(mean_of, *both), *bootstrap(worst_of, *both)]
            table.add(f"{condition}: {_ROOT} - {other}", cells)


def add_order(report: Report, n_cameras: int, runs: Results) -> None:
    """Add findings: whether each order of the paper's tables appears."""
    sir, apf = METHODS["sir"].label, METHODS["apf"].label
    errors = _by_method(runs)
    if _ROOT not in errors:
        return
    average = {label: float(mean_of(e)) for label, e in errors.items()}
    say = report.findings.append
    where = f"{n_cameras} camera{'s' if n_cameras > 1 else ''}"
    if n_cameras in PAPER:
        within = average[_ROOT] <= PAPER[n_cameras] + 1
        say(
            f"{where}: the root tracker's mean error is {average[_ROOT]:.1f} mm, "
            f"{'at most' if within else 'ABOVE'} the paper's {PAPER[n_cameras]} mm (of other "
            "persons, cameras and silhouettes)."
        )
    if sir in errors:
        say(
            f"{where}: better than SIR on average, as in the paper: "
            f"{_yes(average[_ROOT] < average[sir])}; {average[_ROOT]:.1f} and {average[sir]:.1f} mm."
        )
    if apf in errors:
        _compare_with_annealing(report, where, errors[_ROOT], errors[apf], runs.names("subject"))


def _compare_with_annealing(
    report: Report, where: str, root: Float[Tensor, "Q S"], apf: Float[Tensor, "Q S"],
    names: Sequence[str],
) -> None:  # fmt: skip
    say = report.findings.append
    person = float(root.mean(1).max()), float(apf.mean(1).max())
    run = float(root.max()), float(apf.max())
    say(
        f"{where}: more robust than APF, as in the paper: by the worst person "
        f"{_yes(person[0] < person[1])} ({person[0]:.1f} and {person[1]:.1f} mm), by the worst run "
        f"{_yes(run[0] < run[1])} ({run[0]:.1f} and {run[1]:.1f} mm)."
    )
    ahead = [n for n, a, b in zip(names, root.mean(1), apf.mean(1), strict=True) if b + _AHEAD < a]
    say(
        f"{where}: APF wins where the root is certain, as for two of three persons in the paper: "
        + (f"here for {', '.join(ahead)}." if ahead else "here for nobody.")
    )


def _yes(true: bool) -> str:
    return "yes" if true else "NO"


# --- Figure 9 -------------------------------------------------------------------------------------


def add_rates(report: Report, runs: Results) -> None:
    """Add the error over frame rates, and say whether the order of Figure 9 appears."""
    table = pivot(
        report, "rates", "Error (mm) over frames per second, mean over persons", runs, ["condition"],
        {"{}": mean(_ERROR), "± {}": spread(_ERROR), "worst {}": worst(_ERROR)}, columns="method",
        note="Every n-th frame of the same silhouettes. Diffusion is learnt from every n-th frame of "
        "the training clips; survival and scale of the diffusion are chosen on validation clips at "
        "each rate. ±: standard deviation over seeds, pooled over persons; worst: of all runs.",
    )  # fmt: skip
    labels = runs.names("method")
    if _ROOT not in labels:
        return
    for other in labels:
        ahead = [fps for fps in table.rows if table[fps, _ROOT] < table[fps, other]]
        if other != _ROOT:
            report.findings.append(
                f"Frame rates: the root tracker is ahead of {other} at "
                f"{', '.join(ahead) or 'none'} of {', '.join(table.rows)} frames per "
                "second; in the paper at all of them."
            )


def add_speed(report: Report, runs: Results, budget: str) -> None:
    """Add the frames per second of every method."""

    def seconds(own: Results) -> float:
        return float(torch.cat([run.seconds for run in own.runs]).mean())

    pivot(
        report, "speed", "Speed", runs, ["method"],
        {"frames per second": lambda own: 1 / seconds(own),
         "ms per frame": lambda own: 1000 * seconds(own)},
        note=f"Of one run of a batch of seeds, {budget}, on {torch.get_num_threads()} thread(s).",
    )  # fmt: skip


# --- settings and sequences -----------------------------------------------------------------------


def add_tuning(
    report: Report, tunings: Mapping[float, Mapping[str, Tuning]], budget: Budget
) -> None:
    """Add the settings of every method at every frame rate, chosen by validation or given."""
    table = report.table(
        "tuning", "What validation clips chose: the setting with the smallest error",
        ["survival", "particles", "diffusion", "error (mm)", "tried: survival x diffusion, error"],
        digits=(2, 1, 1, 1, 0),
        note="Survival: share of the particles that survives a frame, for APF a layer; as published "
        "0.01 a second, and 0.5 a layer. Particles: how many that are. Diffusion: factor of its "
        "standard deviation, 1 as learnt. Diffusion and survival go in turn to better neighbours "
        "until there is none, so that what is chosen has larger errors beside it; at the highest rate "
        "the published survival is tried as well, at another the search starts from the choice at the "
        "last. The same clips and one seed for all. Nothing is tried where settings are given or published.",
    )  # fmt: skip
    for fps, methods in tunings.items():
        for method, found in methods.items():
            value, scale = found.setting
            usual = " (published)" if found.setting == published(method, fps) else ""
            table.add(
                f"{METHODS[method].label}, {fps:g} fps",
                [
                    f"{value:.2g}{usual}", value * selected_among(method, budget), scale,
                    found.error, found.text(".2g"),
                ],
            )  # fmt: skip


def add_sequences(report: Report, walkers: Sequence[Walker]) -> None:
    """Add the sequences, and how near the tracker's body can come to what the cameras see."""

    def within_limits(subject: Subject[Walker]) -> float:
        states = fit_state(subject.body, subject.view.clip.joints)
        return 100 * float(subject.person.limits.inside(states).all(-1).double().mean())

    describe(
        report, "sequences", "Sequences", subjects_of(walkers),
        {
            "frames": lambda subject: len(subject.view.clip),
            "training frames": lambda subject: sum(map(len, subject.person.training)),
            "validation frames": lambda subject: sum(
                len(view.clip) for _, view in subject.person.validation
            ),
            **SEEN, "within limits (%)": within_limits,
        },
        digits=(0, 0, 0, 1, 2, 1, 1),
        note="Training: of all persons' other trials, for conditionals, diffusion and limits. Nearest "
        "state: error of the tracker's body fitted to the true joints, below which no tracker comes "
        "but by chance. Overlap: intersection over union of that body's silhouettes with those that "
        "are tracked. In view: joints within the image of the worst camera. Within limits: frames in "
        "which that body is within the limits of all its parts.",
    )  # fmt: skip
