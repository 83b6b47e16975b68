"""Tables of the protocol Root uncertainty, and what they say about the paper's claims."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.root_uncertainty.runs import DISPLACEMENTS, Recovery
from benchmarks.root_uncertainty.trackees import METHODS, Budget, Walker, published, selected_among
from benchmarks.silhouette.runs import Runs, Tuning, sequence_name
from benchmarks.silhouette.tables import bootstrap, mean_of, part_errors, pooled_std
from benchmarks.silhouette.trackees import Setting
from torchpose.body import fit_state
from torchpose.evaluation import Report

__all__ = [
    "add_differences",
    "add_errors",
    "add_order",
    "add_rates",
    "add_recovery",
    "add_setup",
    "add_speed",
    "add_tuning",
]

PAPER = {2: 103.8, 3: 93.7}
"""Error of the published tracker, mm, by the number of cameras (DX, Tables 1 and 2)."""

_ROOT = METHODS["root"].label
_BACK = 30.0  # mm from the error without a displacement: recovered
_WINDOW = 0.1  # seconds over which the error after a displacement is taken
_AHEAD = 2.0  # mm by which one method must be ahead of another to be called better


# --- Tables 1 and 2 -------------------------------------------------------------------------------


def add_errors(report: Report, key: str, title: str, runs: Runs) -> None:
    """Error of every method and person as in Tables 1 and 2, with the worst person and seed."""
    names = list(next(iter(runs.values())))
    table = report.table(
        key, title,
        [*names, "average", "± persons", "worst person", "worst run", "± seeds",
         "respread (%)"],
        note="Mean over joints and frames, mm. Average: over persons, each the mean of all seeds; "
        "± persons: standard deviation over them, as in the paper; worst run: of all persons and "
        "seeds; ± seeds: standard deviation over seeds, pooled over persons; respread: frames in "
        "which all particles died.",
    )  # fmt: skip
    for label in runs:
        errors = part_errors(runs, label)
        mean = errors.mean(1)
        every = [run.respread for seeds in runs[label].values() for run in seeds]
        died = torch.cat(every).double().mean()
        spread = float(mean.std()) if len(mean) > 1 else float("nan")
        pooled = float(pooled_std(errors)) if errors.shape[1] > 1 else float("nan")
        table.add(label, [
            *mean.tolist(), float(mean.mean()), spread, float(mean.max()), float(errors.max()),
            pooled, 100 * float(died),
        ])  # fmt: skip


def add_differences(report: Report, conditions: Mapping[str, Runs]) -> None:
    """The root tracker minus the others under every condition, with intervals."""
    table = report.table(
        "differences", "Differences (mm) with the 95 % intervals of a bootstrap",
        ["mean", "from", "to", "worst run", "from ", "to "],
        note="Below zero is for the root tracker. Drawn again are persons and seeds.",
    )  # fmt: skip
    for condition, runs in conditions.items():
        for other in runs:
            if other == _ROOT or _ROOT not in runs:
                continue
            both = part_errors(runs, _ROOT), part_errors(runs, other)
            cells = [*bootstrap(mean_of, *both), *bootstrap(_worst, *both)]
            table.add(f"{condition}: {_ROOT} - {other}", cells)


def _worst(errors: Float[Tensor, "*batch Q S"]) -> Float[Tensor, "*batch"]:
    return errors.amax((-1, -2))


def add_order(report: Report, n_cameras: int, runs: Runs) -> None:
    """Whether each order of the paper's tables appears, in words."""
    sir, apf = METHODS["sir"].label, METHODS["apf"].label
    if _ROOT not in runs:
        return
    errors = {label: part_errors(runs, label) for label in runs}
    mean = {label: float(mean_of(e)) for label, e in errors.items()}
    say = report.findings.append
    where = f"{n_cameras} camera{'s' if n_cameras > 1 else ''}"
    if n_cameras in PAPER:
        within = mean[_ROOT] <= PAPER[n_cameras] + 1
        say(
            f"{where}: the root tracker's mean error is {mean[_ROOT]:.1f} mm, "
            f"{'at most' if within else 'ABOVE'} the paper's {PAPER[n_cameras]} mm (of other "
            "persons, cameras and silhouettes)."
        )
    if sir in runs:
        say(
            f"{where}: better than SIR on average, as in the paper: "
            f"{_yes(mean[_ROOT] < mean[sir])}; {mean[_ROOT]:.1f} and {mean[sir]:.1f} mm."
        )
    if apf in runs:
        _compare_with_annealing(report, where, errors[_ROOT], errors[apf], list(runs[_ROOT]))


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


def add_rates(report: Report, conditions: Mapping[float, Runs]) -> None:
    """Error over frame rates, and whether the order of Figure 9 appears."""
    labels = list(next(iter(conditions.values())))
    columns = [c for label in labels for c in (label, f"± {label}", f"worst {label}")]
    table = report.table(
        "rates", "Error (mm) over frames per second, mean over persons", columns,
        note="Every n-th frame of the same silhouettes. Diffusion is learnt from every n-th frame of "
        "the training clips; survival and scale of the diffusion are chosen on validation clips at "
        "each rate. ±: standard deviation over seeds, pooled over persons; worst: of all runs.",
    )  # fmt: skip
    found: dict[float, dict[str, float]] = {}
    for fps, runs in conditions.items():
        cells = []
        for label in labels:
            errors = part_errors(runs, label)
            pooled = float(pooled_std(errors)) if errors.shape[1] > 1 else float("nan")
            cells += [float(mean_of(errors)), pooled, float(errors.max())]
            found.setdefault(fps, {})[label] = cells[-3]
        table.add(f"{fps:g}", cells)
    if _ROOT not in labels:
        return
    for other in labels:
        ahead = [f"{fps:g}" for fps, e in found.items() if e[_ROOT] < e[other]]
        if other != _ROOT:
            report.findings.append(
                f"Frame rates: the root tracker is ahead of {other} at "
                f"{', '.join(ahead) or 'none'} of {', '.join(f'{f:g}' for f in found)} frames per "
                "second; in the paper at all of them."
            )


# --- recovery and speed ---------------------------------------------------------------------------


def add_recovery(report: Report, recovery: Recovery, fps: float, seconds: float) -> None:
    """Error a second after the root was displaced, and the share of runs that are back."""
    labels = list(recovery)
    columns = [c for label in labels for c in (label, f"back, {label} (%)")]
    table = report.table(
        "recovery", f"Error (mm) {seconds:g} s after all particles were displaced", columns,
        note=f"Mean over joints, persons, seeds and the last {_WINDOW:g} s. Back: runs within "
        f"{_BACK:g} mm of what the method has there without a displacement, mean over its seeds. "
        "Displaced are the particles before the first frame, or in the middle, to a level direction "
        "or about the vertical, the same ones for all methods.",
    )  # fmt: skip
    width = max(1, round(_WINDOW * fps))
    for key in next(iter(recovery.values())):
        displacement, time = key
        cells: list[float] = []
        for label in labels:
            last = recovery[label][key][..., -width:].mean(-1)
            usual = recovery[label][str(DISPLACEMENTS[0]), time][..., -width:].mean((-1, -2))
            back = (last <= usual[:, None] + _BACK).double().mean()
            cells += [float(last.mean()), 100 * float(back)]
        table.add(f"{displacement}, {'start' if not time else f'after {time:g} s'}", cells)


def add_speed(report: Report, runs: Runs, budget: str) -> None:
    """Frames per second of every method."""
    table = report.table(
        "speed", "Speed", ["frames per second", "ms per frame"],
        note=f"Of one run of a batch of seeds, {budget}, on {torch.get_num_threads()} thread(s).",
    )  # fmt: skip
    for label, sequences in runs.items():
        seconds = torch.cat([run.seconds for seeds in sequences.values() for run in seeds])
        each = float(seconds.mean())
        table.add(label, [1 / each, 1000 * each])


def add_tuning(
    report: Report, tunings: Mapping[float, Mapping[str, Tuning]], budget: Budget
) -> None:
    """What validation chose for every method at every frame rate, or what was given."""
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
            tried = zip(found.tried, found.errors, strict=True)
            text = "; ".join(f"{s.value:.2g} x {s.scale:g}, {e:.0f}" for s, e in tried)
            setting: Setting = found.setting
            usual = " (published)" if setting == published(method, fps) else ""
            table.add(
                f"{METHODS[method].label}, {fps:g} fps",
                [
                    f"{setting.value:.2g}{usual}",
                    setting.value * selected_among(method, budget),
                    setting.scale,
                    found.error,
                    text or "-",
                ],
            )


def add_setup(report: Report, walkers: Sequence[Walker]) -> None:
    """The sequences, and how near the tracker's body can come to what the cameras see."""
    table = report.table(
        "sequences",
        "Sequences",
        [
            "frames",
            "training frames",
            "validation frames",
            "nearest state (mm)",
            "overlap",
            "in view (%)",
            "within limits (%)",
        ],
        digits=(0, 0, 0, 1, 2, 1, 1),
        note="Training: of all persons' other trials, for conditionals, diffusion and limits. Nearest "
        "state: error of the tracker's body fitted to the true joints, below which no tracker comes "
        "but by chance. Overlap: intersection over union of that body's silhouettes with those that "
        "are tracked. In view: joints within the image of the worst camera. Within limits: frames in "
        "which that body is within the limits of all its parts.",
    )
    for walker in walkers:
        for view in walker.tests:
            states = fit_state(walker.body, view.clip.joints)
            inside = walker.limits.inside(states).all(-1).double().mean()
            validation = sum(len(seen.clip) for _, seen in walker.validation)
            table.add(
                sequence_name(walker, view),
                [
                    len(view.clip),
                    sum(map(len, walker.training)),
                    validation,
                    view.floor,
                    view.overlap,
                    100 * view.in_view,
                    100 * float(inside),
                ],
            )
