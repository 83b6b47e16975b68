"""Runs of body filters on silhouettes, with their inputs and measures."""

from collections.abc import Callable, Sequence
from time import perf_counter
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.bodies.views import Subject, View
from benchmarks.engine import Row
from torchpose.body import BODY_15, Body
from torchpose.whole_body import BodyFilterOutput, SilhouetteParticleFilter

LAYERS = 5
"""Of the annealed particle filter."""

PUBLISHED_SURVIVAL = 0.5
"""Of a layer of the annealed particle filter."""

MADE_WITH = (
    "torchpose/body", "torchpose/camera", "torchpose/filters", "torchpose/math", "torchpose/priors",
    "torchpose/whole_body", "benchmarks/bodies/faults.py", "benchmarks/bodies/tracking.py",
)  # fmt: skip
"""What the numbers of every run depend on: files and folders of a checkout."""

PARTS = {
    "torso": ("pelvis", "neck", "left_shoulder", "right_shoulder", "left_hip", "right_hip"),
    "head": ("head",),
    "legs": ("left_knee", "right_knee", "left_ankle", "right_ankle"),
    "arms": ("left_elbow", "right_elbow", "left_wrist", "right_wrist"),
}
"""Joints of each part; all fifteen make the whole body."""

_COLUMNS = {part: [BODY_15.joint(name) for name in names] for part, names in PARTS.items()}
_SETTLED = 30  # frames


class Method(NamedTuple):
    """A filter of a comparison.

    Attributes:
        label: in tables. tuned: what validation chooses, beside the scale of the diffusion.
        first: the value with which the scale is chosen. values: what it then chooses among, the
            published one among them. options: of the filter.
    """

    label: str
    tuned: str
    first: float
    values: tuple[float, ...]
    options: dict[str, Any]


class Run(NamedTuple):
    """One method on one clip with one seed.

    Attributes:
        errors: distance of every joint [T, 15], mm, NaN where the truth is unknown (MR 31).
        mean: estimated states [T, D]. std: of the particles [T, D].
        coasting, respread: [T], as `BodyFilterOutput`. seconds: [1], per frame, of the batch it ran in.
    """

    errors: Tensor
    mean: Tensor
    std: Tensor
    coasting: Tensor
    respread: Tensor
    seconds: Tensor


def generators_of(seeds: Sequence[int]) -> list[torch.Generator]:
    """Return a stream of random numbers for every run."""
    return [torch.Generator().manual_seed(7919 * s + 1) for s in seeds]


def track_view(
    tracker: SilhouetteParticleFilter,
    body: Body,
    view: View,
    start: Float[Tensor, "S D"],
    generators: list[torch.Generator],
) -> list[Run]:
    """Return one run for each generator, made as one batch, each from its own initial state."""
    began = perf_counter()
    out: BodyFilterOutput = tracker(view.silhouettes, view.rig, start, generator=generators)
    seconds = (perf_counter() - began) / len(view.clip) / len(generators)
    errors = view_errors(body, view, out.mean)
    return [
        Run(
            errors[i].float(), out.mean[i].float(), out.std[i].float(), out.coasting[i],
            out.respread[i], torch.tensor([seconds], dtype=torch.float64),
        )
        for i in range(len(generators))
    ]  # fmt: skip


def view_errors(
    body: Body, view: View, states: Float[Tensor, "*batch T D"]
) -> Float[Tensor, "*batch T 15"]:
    """Return the distance of the estimated joints from the recorded ones, mm (MR 31)."""
    return 1000 * (body.joints(states) - view.clip.joints).norm(dim=-1)


def subject_facts(subject: Subject[Any]) -> list[Any]:
    """Return the inputs of a run, beside its filter: silhouettes, cameras, truth, body and noise."""
    view, body = subject.view, subject.body
    return [
        view.silhouettes.byte(), view.rig.matrix, view.rig.rotation, view.rig.translation,
        view.initial_state, view.clip.joints, view.clip.fps, body.frame, body.offsets, body.radii,
        body.tips, body.centres, subject.person.step_std,
    ]  # fmt: skip


# --- measures -------------------------------------------------------------------------------------


def part_error(part: str = "") -> Callable[[Any], Tensor]:
    """Return the measure of a run: mean over joints and frames, mm, of a part or of the whole body."""
    columns = _COLUMNS[part] if part else slice(None)
    return lambda run: run.errors[:, columns].double().nanmean()


def drift(fps: float) -> Callable[[Run], Tensor]:
    """Return the measure of a run: slope of the error over time, mm per second, by least squares.

    Runs start at the true pose, so of those that last a second and a half or more the first half
    second is left out.
    """

    def slope(run: Run) -> Tensor:
        settled = _SETTLED if len(run.errors) >= 3 * _SETTLED else 0
        value = run.errors[settled:].double().nanmean(1)
        t = torch.arange(len(value), dtype=torch.float64) / fps
        known = value.isfinite()  # not where the truth was lost
        t, value = t[known], value[known]
        t = t - t.mean()
        return (t * value).sum() / (t * t).sum()

    return slope


def csv_columns(fps: float) -> dict[str, Callable[[Row], Any]]:
    """Return the columns of runs.csv: sequence, method, seed, errors by part (mm), drift (mm/s)."""

    def number(measure: Callable[[Run], Tensor]) -> Callable[[Row], str]:
        return lambda row: f"{float(measure(row.run)):.3f}"

    return {
        "sequence": lambda row: row.subject,
        "method": lambda row: row.method,
        "seed": lambda row: row.seed,
        "error_mm": number(part_error()),
        **{f"{part}_mm": number(part_error(part)) for part in PARTS},
        "drift_mm_per_s": number(drift(fps)),
        "coasting_frames": lambda row: int(row.run.coasting.sum()),
        "respread_frames": lambda row: int(row.run.respread.sum()),
    }
