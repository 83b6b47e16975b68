"""Real bends: people who pick something up and throw it, in one view of a depth camera.

The silhouettes are segmented depth (`utd_mhad_silhouettes`), paired with the Kinect's own skeleton at
the lag that the set gives, which is the reference: it errs by centimetres, most where a person bends
towards it. Everybody faces the camera, so that a bend is a bend towards it. The action space is of
other persons, exponent and noise are chosen on one who is neither tracked nor trained on. Beside the
errors stand what tells why: how well the estimate covers the silhouette and how well the reference
does, and errors across the view apart from those along it. It writes real-bends.md and the folder
real-bends of its pictures into the folder of the results.

    python -m benchmarks.real_bends --data DIR --out DIR
"""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks._command import run_command
from benchmarks._depth_silhouettes import (
    HEAD_TOP,
    PELVIS,
    Filmed,
    draw,
    fit_to_view,
    kinect,
    one_view,
    seeded,
)
from benchmarks._table_file import save_text
from benchmarks.bend.variants import REDRAWS, SHARPNESS, fit_space
from benchmarks.engine import Setting, choose_setting
from torchpose._core.files import check_output_folder
from torchpose.body import Body, centres_of, fit_body, fit_state
from torchpose.errors import DegenerateFilterWarning
from torchpose.evaluation import Report
from torchpose.priors import ActionSpace, state_postures
from torchpose.whole_body import ConstrainedParticleFilter, constant_velocity_std, count_pixels
from torchpose.whole_body._silhouettes.likelihood import intersection_over_union

ACTION, FPS = "pickup_throw", 30.0
TEST, TUNING, OTHERS = ("s02", "s04", "s06"), "s08", ("s01", "s03", "s05", "s07")
DIMENSIONS = {"first order": None, "constrained, D = 13": 13, "constrained, D = 25": 25}
SCALES = (0.35, 0.7, 1.4, 2.8)
PICTURES = "real-bends"


class Person(NamedTuple):
    """Body, noise, action of the others, and what is tracked."""

    body: Body
    step_std: Tensor
    space: ActionSpace
    data: Filmed
    states: Tensor


class Found(NamedTuple):
    """States [T, D], and the mean share of the draws that the gates let through."""

    states: Tensor
    accepted: float
    clamped: float


def prepare(folder: Path, person: str) -> Person:
    """Fit the body to other recordings of the person, and the action space to the other persons.

    Bone lengths are those of the person's other trials, radii those of silhouettes of another action.
    """
    trained = {p: list(kinect(folder, p, ACTION, "1234")) for p in OTHERS}
    plain = {p: fit_body(torch.cat(trials), head_top=HEAD_TOP) for p, trials in trained.items()}
    first = plain[OTHERS[0]]
    centres = centres_of(first, fit_state(first, torch.cat(trained[OTHERS[0]])))
    moved = [
        tuple(fit_state(body.altered(centres=centres), trial) for trial in trained[p])
        for p, body in plain.items()
    ]
    own = list(kinect(folder, person, ACTION, "234"))
    body = fit_to_view(own, one_view(folder, person, "squat")).altered(centres=centres)
    data = one_view(folder, person, ACTION)
    std = constant_velocity_std(body, [states for one in moved for states in one], floor=1e-3)
    return Person(
        body, std, fit_space(body, moved, ACTION, FPS), data, fit_state(body, data.joints)
    )


def track(person: Person, dimensions: int | None, setting: Setting, n: int, seed: int) -> Found:
    """Return the estimates from the true first pose."""
    action = None if dimensions is None else person.space.with_dimensions(dimensions)
    tracker = ConstrainedParticleFilter(
        person.body, action, n, process_cov=(setting.scale * person.step_std).square(), likelihood="overlap",
        sharpness=setting.value, max_redraws=REDRAWS,
    )  # fmt: skip
    with warnings.catch_warnings():  # frames in which all were clamped are counted
        warnings.simplefilter("ignore", DegenerateFilterWarning)
        out = tracker(
            person.data.silhouettes, person.data.rig, person.states[0], generator=seeded(seed)
        )
    shares = [float(out.details[name].mean()) for name in ("acceptance", "clamped")]
    return Found(out.mean, *shares)


def squared(person: Person, states: Tensor) -> float:
    """Return the mean squared error of the relative angles, degrees^2."""
    apart = state_postures(person.body, states) - state_postures(person.body, person.states)
    return float(apart.square().mean())


def covered(person: Person, states: Tensor) -> float:
    """Return the mean intersection over union with the silhouettes."""
    counts = count_pixels(person.body, states[:, None], person.data.rig, person.data.silhouettes)
    return float(intersection_over_union(counts).mean())


def errors(person: Person, states: Tensor) -> list[float]:
    """Return the numbers of a row, without the shares of accepted and clamped draws.

    These are the error of the angles, that of joints about the pelvis, across and along the view, that of
    the pelvis across and along the view, and the intersection over union with the silhouettes.
    """
    gap = 1000 * (person.body.joints(states) - person.data.joints)
    about = gap - gap[:, [PELVIS]]
    root = gap[:, PELVIS]
    return [
        squared(person, states), float(about.norm(dim=-1).mean()),
        float(about[..., :2].norm(dim=-1).mean()), float(about[..., 2].abs().mean()),
        float(root[:, :2].norm(dim=-1).mean()), float(root[:, 2].abs().mean()),
        covered(person, states),
    ]  # fmt: skip


def tune(judge: Person, dimensions: int | None, n: int) -> Setting:
    """Choose noise and exponent by the error of the judge's joints, each method with the same budget.

    Angles leave the root out: by their error a body that has turned over may be the best.
    """

    def off(setting: Setting) -> float:
        return errors(judge, track(judge, dimensions, setting, n, 0).states)[1]

    return choose_setting(off, SHARPNESS[0], SHARPNESS, SCALES).setting


def fill(
    report: Report, folder: Path, out: Path, n: int, seeds: int, persons: Sequence[str]
) -> None:
    """Add the table, the pictures, and findings with the acceptance of true postures."""
    table = report.table(
        "errors", "Picking up and throwing in one real view, mean over persons and seeds",
        ["angles (degrees^2)", "joints (mm)", "across", "along", "pelvis, across", "pelvis, along",
         "overlap", "accepted (%)", "clamped (%)"], digits=(0, 0, 0, 0, 0, 0, 3, 0, 0),
        note=f"Persons {', '.join(persons)}, trial 1, {n} particles, {seeds} seeds; noise and exponent "
        f"by the joints of {TUNING}; action space of {', '.join(OTHERS)}. Joints about the pelvis; "
        "across and along the view. Overlap: intersection over union with the silhouettes. "
        '"Reference": the Kinect\'s skeleton fitted by the body, from which errors are counted. "Not '
        'moving" keeps the first pose, which is given to all.',
    )  # fmt: skip
    judge = prepare(folder, TUNING)
    people = {p: prepare(folder, p) for p in tqdm(persons, desc="persons")}
    settings = {k: tune(judge, d, n) for k, d in tqdm(DIMENSIONS.items(), desc="exponents")}
    report.settings["settings"] = {k: s._asdict() for k, s in settings.items()}
    rows: dict[str, list[list[float]]] = {"reference": [], "not moving": []}
    nan = [float("nan")] * 2
    for p, person in tqdm(people.items(), desc="tracking"):
        still = person.states[:1].expand_as(person.states)
        rows["reference"].append([*errors(person, person.states), *nan])
        rows["not moving"].append([*errors(person, still), *nan])
        for label, dimensions in DIMENSIONS.items():
            for seed in range(seeds):
                found = track(person, dimensions, settings[label], n, seed)
                shares = nan if dimensions is None else [100 * x for x in found[1:]]
                rows.setdefault(label, []).append([*errors(person, found.states), *shares])
            if p == persons[0]:
                name = label.replace(", D = ", "-").replace(" ", "-")
                draw(report, person.data, person.body, found.states, out, f"{PICTURES}/{name}.png")
    for label, found_rows in rows.items():
        table.add(label, torch.tensor(found_rows).mean(0).tolist())
    _say(report, people, rows)


def _say(report: Report, people: dict[str, Person], rows: dict[str, list[list[float]]]) -> None:
    still = torch.tensor(rows["not moving"]).mean(0)
    reference = torch.tensor(rows["reference"]).mean(0)
    for label in DIMENSIONS:
        mean = torch.tensor(rows[label]).mean(0)
        better = "better" if mean[0] < still[0] else "WORSE"
        ambiguous = "as well as" if mean[6] > reference[6] - 0.01 else "less than"
        report.findings.append(
            f"{label}: {mean[0]:.0f} degrees^2, {better} than not moving ({still[0]:.0f}); it covers the "
            f"silhouettes {ambiguous} the reference ({mean[6]:.2f} against {reference[6]:.2f}); joints "
            f"are off by {mean[2]:.0f} mm across the view and {mean[3]:.0f} mm along it."
        )
    for d in (13, 25):
        shares = [
            100 * p.space.with_dimensions(d)
            .acceptance(state_postures(p.body, p.states), generator=seeded(0)).drawn
            for p in people.values()
        ]  # fmt: skip
        report.findings.append(
            f"D = {d}: the gates let {sum(shares) / len(shares):.0f} % of the reference's postures "
            f"through ({', '.join(f'{s:.0f}' for s in shares)} for {', '.join(people)})."
        )


def main(
    *,
    data: Path,
    out: Path,
    seeds: int = 3,
    particles: int = 1000,
    persons: Sequence[str] = TEST,
    threads: int = 1,
) -> None:
    """Print the table and write it as Markdown.

    Args:
        data: folder of the data sets.
        out: folder of the results.
        seeds: runs of each tracker.
        particles: of each tracker.
        persons: who is tracked.
        threads: cores.
    """
    torch.set_num_threads(threads)
    out = check_output_folder(out)
    report = Report("Real bends", {
        "seeds": seeds, "particles": particles, "persons": persons, "redraws": REDRAWS,
    })  # fmt: skip
    fill(report, data, out, particles, seeds, persons)
    print(report.summary())
    save_text(out / "real-bends.md", report.to_markdown())


if __name__ == "__main__":
    run_command(main)
