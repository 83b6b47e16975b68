"""Tables of the protocol Silhouette: errors by sequence and part, spreads over seeds, drift."""

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.silhouette.data import Split
from benchmarks.silhouette.runs import Runs, Tuning, sequence_name
from benchmarks.silhouette.trackees import METHODS, PUBLISHED_SURVIVAL, Setting, Tracked, label_of
from torchpose.body import BODY_15
from torchpose.evaluation import Report
from torchpose.evaluation.report import RESULTS
from torchpose.io._results import replace_own

__all__ = [
    "PARTS",
    "add_differences",
    "add_errors",
    "add_parts",
    "add_pooled",
    "add_setup",
    "add_tuning",
    "bootstrap",
    "drift",
    "part_errors",
    "pooled_std",
    "write_csv",
]

PARTS = {
    "torso": ("pelvis", "neck", "left_shoulder", "right_shoulder", "left_hip", "right_hip"),
    "head": ("head",),
    "legs": ("left_knee", "right_knee", "left_ankle", "right_ankle"),
    "arms": ("left_elbow", "right_elbow", "left_wrist", "right_wrist"),
}
"""Joints of each part; all fifteen make the whole body."""

_COLUMNS = {part: [BODY_15.joint(name) for name in names] for part, names in PARTS.items()}
_DRAWS = 2000
_SETTLED = 30  # frames
Statistic = Callable[[Tensor], Tensor]


def part_errors(runs: Runs, method: str, part: str = "") -> Float[Tensor, "Q S"]:
    """Mean over joints and frames, mm, of every sequence and seed; of the whole body without a part."""
    columns = _COLUMNS[part] if part else slice(None)
    return torch.stack(
        [
            torch.stack([run.errors[:, columns].double().nanmean() for run in seeds])
            for seeds in runs[method].values()
        ]
    )


def drift(runs: Runs, method: str, fps: float) -> Float[Tensor, "Q S"]:
    """Slope of the error over time, mm per second, by least squares, of every sequence and seed.

    Runs start at the true pose, so of those that last a second and a half or more the first half
    second is left out.
    """

    def slope(errors: Tensor) -> Tensor:
        settled = _SETTLED if len(errors) >= 3 * _SETTLED else 0
        value = errors[settled:].double().nanmean(1)
        t = torch.arange(len(value), dtype=torch.float64) / fps
        known = value.isfinite()  # not where the truth was lost
        t, value = t[known], value[known]
        t = t - t.mean()
        return (t * value).sum() / (t * t).sum()

    return torch.stack(
        [torch.stack([slope(run.errors) for run in seeds]) for seeds in runs[method].values()]
    )


def pooled_std(errors: Float[Tensor, "*batch Q S"]) -> Float[Tensor, "*batch"]:
    """Standard deviation over seeds, pooled over sequences: root of the mean variance."""
    return errors.var(-1, correction=1).mean(-1).sqrt()


def mean_of(errors: Float[Tensor, "*batch Q S"]) -> Float[Tensor, "*batch"]:
    """Mean over sequences and seeds."""
    return errors.mean((-1, -2))


def bootstrap(
    statistic: Statistic,
    one: Float[Tensor, "Q S"],
    other: Float[Tensor, "Q S"] | None = None,
    seed: int = 0,
    draws: int = _DRAWS,
) -> tuple[float, float, float]:
    """A statistic, or its difference one - other, with the 95 % interval of a bootstrap.

    Sequences are drawn with replacement, the same for both; then seeds within each, apart.

    Args:
        statistic: [..., Q, S] -> [...]. one, other: by sequence and seed. seed: of the draws.
    """
    generator = torch.Generator().manual_seed(seed)
    n, s = one.shape
    rows = torch.randint(n, (draws, n, 1), generator=generator)

    def drawn(values: Tensor) -> Tensor:
        columns = torch.randint(s, (draws, n, s), generator=generator)
        return statistic(values[rows, columns])

    value, spread = statistic(one), drawn(one)
    if other is not None:
        value, spread = value - statistic(other), spread - drawn(other)
    low, high = torch.quantile(spread, torch.tensor([0.025, 0.975], dtype=spread.dtype)).tolist()
    return float(value), low, high


# --- tables ---------------------------------------------------------------------------------------


def _labels(runs: Runs) -> dict[str, str]:
    return {method: label_of(method) for method in runs}


def add_errors(report: Report, runs: Runs, condition: str = "") -> None:
    """Table 1: mean error of every sequence, and its standard deviation over seeds.

    Args:
        condition: of the runs, where a report has several; a part of the table's name and title.
    """
    labels = _labels(runs)
    columns = [c for label in labels.values() for c in (label, f"± {label}")]
    title = "Error (mm) of the joints, mean over joints, frames and seeds"
    table = report.table(
        f"errors, {condition}" if condition else "errors",
        f"{condition}: {title[0].lower()}{title[1:]}" if condition else title, columns,
        note="±: standard deviation over seeds; in the last row pooled over sequences.",
    )  # fmt: skip
    found = {method: part_errors(runs, method) for method in labels}
    for i, name in enumerate(next(iter(runs.values()))):
        cells = [v for m in labels for v in (float(found[m][i].mean()), _std(found[m][i]))]
        table.add(name, cells)
    table.add("all", [v for m in labels for v in (float(mean_of(found[m])), _pooled(found[m]))])


def add_parts(report: Report, runs: Runs) -> None:
    """Table 2: the same by part of the body."""
    labels = _labels(runs)
    columns = [c for part in PARTS for c in (part, f"± {part}")]
    table = report.table(
        "parts", "Error (mm) by part of the body, mean over frames and seeds", columns,
        note="; ".join(f"{part}: {_text(names)}" for part, names in PARTS.items()),
    )  # fmt: skip
    found = {(m, part): part_errors(runs, m, part) for m in labels for part in PARTS}
    for i, name in enumerate(next(iter(runs.values()))):
        for m, label in labels.items():
            cells = [v for p in PARTS for v in (_mean(found[m, p][i]), _std(found[m, p][i]))]
            table.add(f"{name}, {label}", cells)
    for m, label in labels.items():
        cells = [v for p in PARTS for v in (_mean(found[m, p]), _pooled(found[m, p]))]
        table.add(f"all, {label}", cells)


def add_pooled(report: Report, runs: Runs, fps: float) -> None:
    """Every method over all sequences: spread, drift, how often it had nothing to go by, time."""
    table = report.table(
        "pooled", "Methods over all sequences",
        ["error (mm)", "± seeds", "drift (mm/s)", "from", "to", "coasting (%)", "respread (%)",
         "ms per frame"],
        digits=(1, 1, 2, 2, 2, 1, 1, 1),
        note="Drift: slope of the error over time, without the first half second, since runs start at "
        "the true pose; with the 95 % interval of a bootstrap over sequences and seeds. Time: of one "
        "run of a batch of seeds.",
    )  # fmt: skip
    for method, label in _labels(runs).items():
        every = [run for seeds in runs[method].values() for run in seeds]
        errors = part_errors(runs, method)
        slope = bootstrap(mean_of, drift(runs, method, fps))
        flags = [100 * float(torch.cat([getattr(r, k) for r in every]).double().mean())
                 for k in ("coasting", "respread")]  # fmt: skip
        seconds = float(torch.cat([run.seconds for run in every]).mean())
        cells = [float(mean_of(errors)), _pooled(errors), *slope, *flags, 1000 * seconds]
        table.add(label, cells)
        spread = f"standard deviation over seeds {cells[1]:.1f} mm"
        if errors.shape[1] == 1:
            spread = "one seed"
        report.findings.append(
            f"{label}: {cells[0]:.1f} mm, {spread}; the error changes by {slope[0]:+.1f} mm per second "
            f"({slope[1]:+.1f} to {slope[2]:+.1f})."
        )


def add_differences(report: Report, runs: Runs, condition: str = "") -> None:
    """What the manifold's methods have over the others, with intervals.

    Args:
        condition: of the runs, where a report has several; before the names of the rows.
    """
    labels = _labels(runs)
    table = report.get("differences") or report.table(
        "differences", "Differences (mm) with the 95 % intervals of a bootstrap",
        ["mean", "from", "to", "arms", "from ", "to ", "± seeds", "from  ", "to  "],
        note="Below zero is for the first. Drawn again are sequences and seeds.",
    )  # fmt: skip
    for method in labels:
        if not method.startswith("mrpf"):
            continue
        for other in [m for m in ("sir", "apf") if m in labels]:
            whole = part_errors(runs, method), part_errors(runs, other)
            arms = part_errors(runs, method, "arms"), part_errors(runs, other, "arms")
            n_seeds = whole[0].shape[1]
            spread = bootstrap(pooled_std, *whole) if n_seeds > 1 else (float("nan"),) * 3
            cells = [*bootstrap(mean_of, *whole), *bootstrap(mean_of, *arms), *spread]
            name = f"{labels[method]} - {labels[other]}"
            table.add(f"{condition}: {name}" if condition else name, cells)


def add_tuning(report: Report, tunings: Mapping[str, Tuning], condition: str = "") -> None:
    """What validation chose for every method, or what was given.

    Args:
        condition: of the runs, where a report has several; before the names of the rows.
    """
    given = not any(found.tried for found in tunings.values())
    title = "What validation clips chose: the setting with the smallest error"
    table = report.get("tuning") or report.table(
        "tuning", "Settings as given, without validation" if given else title,
        ["chosen", "diffusion", "error (mm)", "as published (mm)", "tried: value x diffusion, error"],
        digits=(2, 1, 1, 1, 0),
        note="Chosen: the sharpness of the likelihood for SIR and MRPF, 1 as published; the survival "
        "rate of a layer for APF, 0.5 as published, since its sharpness would cancel. Diffusion: "
        "factor of sigma x->x, 1 being the motion of the validation clips. First the diffusion is "
        "chosen, then the other; the same number of settings, clips and seeds for all. As "
        "published: the published value at the chosen diffusion.",
    )  # fmt: skip
    for method, found in tunings.items():
        errors = dict(zip(found.tried, found.errors, strict=True))
        published = PUBLISHED_SURVIVAL if method == "apf" else 1.0
        text = "; ".join(f"{s.value:g} x {s.scale:g}, {e:.0f}" for s, e in errors.items())
        label = METHODS[method].label
        table.add(f"{condition}: {label}" if condition else label, [
            *found.setting, found.error, errors.get(Setting(published, found.setting.scale)),
            text or "-",
        ])  # fmt: skip


def add_setup(report: Report, trackees: Sequence[Tracked], condition: str = "") -> None:
    """The sequences, and how near the tracker's body can come to what the cameras see.

    Args:
        condition: of the silhouettes, where a report has several; a part of the table's name.
    """
    name = f"sequences, {condition}" if condition else "sequences"
    table = report.table(
        name, name.capitalize(),
        ["frames", "manifold frames", "validation frames", "own manifold", "nearest state (mm)",
         "overlap", "in view (%)"],
        digits=(0, 0, 0, 0, 1, 2, 1),
        note="Nearest state: error of the tracker's body fitted to the true joints, below which no "
        "tracker comes but by chance. Overlap: intersection over union of that body's silhouettes "
        "with those that are tracked. In view: joints within the image of the worst camera.",
    )  # fmt: skip
    for trackee in trackees:
        split = trackee.split
        for view in trackee.tests:
            table.add(sequence_name(trackee, view), [
                len(view.clip), sum(map(len, split.manifold)), sum(map(len, split.validation)),
                _manifold_of(split), view.floor, view.overlap, 100 * view.in_view,
            ])  # fmt: skip


def _manifold_of(split: Split) -> str:
    """Whether the manifold is the person's own, and of which action if of another one."""
    actions = " ".join(dict.fromkeys(clip.action for clip in split.manifold))
    other = actions not in {clip.action for clip in split.test}
    return ("yes" if split.seen else "no") + (f", of {actions}" if other else "")


def write_csv(path: Path, runs: Runs, fps: float, first_seed: int = 0) -> None:
    """One line for every run: sequence, method, seed, errors by part (mm), drift (mm/s)."""
    with (
        replace_own(path, RESULTS) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as out,
    ):
        writer = csv.writer(out)
        head = ["sequence", "method", "seed", "error_mm", *(f"{part}_mm" for part in PARTS)]
        writer.writerow([*head, "drift_mm_per_s", "coasting_frames", "respread_frames"])
        for method, sequences in runs.items():
            slopes = drift(runs, method, fps)
            for i, (name, seeds) in enumerate(sequences.items()):
                for s, run in enumerate(seeds):
                    errors = [run.errors.double().nanmean()]
                    errors += [run.errors[:, c].double().nanmean() for c in _COLUMNS.values()]
                    writer.writerow([
                        name, method, first_seed + s, *(f"{float(e):.3f}" for e in errors),
                        f"{float(slopes[i, s]):.3f}", int(run.coasting.sum()),
                        int(run.respread.sum()),
                    ])  # fmt: skip


def _mean(values: Tensor) -> float:
    return float(values.mean())


def _std(values: Tensor) -> float:
    return float(values.std()) if len(values) > 1 else float("nan")


def _pooled(values: Float[Tensor, "Q S"]) -> float:
    return float(pooled_std(values)) if values.shape[1] > 1 else float("nan")


def _text(names: Sequence[str]) -> str:
    return ", ".join(dict.fromkeys(n.replace("left_", "").replace("right_", "") for n in names))
