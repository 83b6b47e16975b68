"""Gain of fine-tuning through the filter: Q, R and mixtures by gradient of the 3D error.

On training persons of UB-people alone (s1 to s6 of UTD-MHAD): a prior over single poses is fitted to four
of them, its filter is tuned on the same four, and every third sequence of the other two is tracked from
head, neck and hands with 3 px noise, by the prior as it is with hand-set Q and R (the paper's
transition), with the released Q, and tuned. Each seed draws other viewpoints, starts and batches. The
error is the 3D distance after fixed-scale Procrustes, pooled over joints and frames, without windows.

    python -m benchmarks.fine_tuned_filter --data DIR --out DIR [--splits A B C] [--seeds 0 1 2]

A seed of a split takes about a minute and a half. Finished ones are kept in `--out`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks._command import OneOf, run_command
from benchmarks._data import data_files, data_folder
from benchmarks._table_file import save_text
from benchmarks._upper_body import MADE_WITH, plain_prior, score
from benchmarks.engine import Experiment, Grid, Results
from benchmarks.speed._timing import machine_line, markdown_table
from torchpose._core.files import check_output_folder
from torchpose.evaluation._trials import CAMERA, Trials, centred_on_neck, make_test_set, track
from torchpose.io import Recording, read_recordings
from torchpose.learning import UpperBodyRecipe
from torchpose.learning._fine_tuning import TunableKalman, draw_sequences, parameter_groups
from torchpose.priors import UpperBodyPrior

SPLITS = {"A": ("s3", "s6"), "B": ("s2", "s4"), "C": ("s1", "s5")}
"""Persons who are tracked; the other four of s1 to s6 are fitted and tuned on."""

METHODS = ("hand-set Q and R", "released Q", "Q and R tuned", "Q, R and mixtures tuned")
RATE, SEQUENCES, FRAMES = 0.1, 16, 48
BODY_SIZE, BONE_LENGTHS = 0.3, 0.05


class Effort(NamedTuple):
    """How large the fits are, and how many sequences are read and tracked."""

    components: int = 30
    samples: int = 60_000
    pose_steps: int = 60
    tuning_steps: int = 80
    every_file: int = 1
    every_tracked: int = 3


QUICK = Effort(4, 2_000, 5, 2, 40, 1)


class Split(NamedTuple):
    """Recordings to fit to and to tune on, and the test set of the persons who are held out."""

    seen: list[Recording]
    test: Trials


class Errors(NamedTuple):
    """Mean 3D errors in cm, in the order of `METHODS` [4]."""

    by_method: Tensor


def tuned(
    prior: UpperBodyPrior, persons: list[Recording], seed: int, steps: int, **options: bool
) -> UpperBodyPrior:
    """Return the prior with its filter tuned; the learning rate falls over the second half."""
    poses = UpperBodyRecipe().poses(persons)
    sequences = list(poses.joints.split(poses.lengths))
    model = TunableKalman(prior, **options)
    adam = torch.optim.Adam(parameter_groups(model, RATE))
    rates = [group["lr"] for group in adam.param_groups]
    generator = torch.Generator().manual_seed(seed)
    for step in tqdm(range(steps), desc="tune", leave=False):
        for group, rate in zip(adam.param_groups, rates, strict=True):
            group["lr"] = rate * min(1.0, 2 * (1 - step / steps))
        batch = draw_sequences(
            sequences, prior, SEQUENCES, generator, frames=FRAMES,
            body_size=BODY_SIZE, bone_lengths=BONE_LENGTHS,
        )  # fmt: skip
        adam.zero_grad()
        model.loss(batch).backward()
        adam.step()
    return model.prior()


def error(prior: UpperBodyPrior, test: Trials) -> float:
    """Return the mean 3D error in cm."""
    estimate = track(prior, CAMERA, test, method="mkf-fixed")
    return score(estimate, test).mean_error


def read_split(data: Path, split: str, effort: Effort) -> Split:
    """Return the recordings of a split."""
    files = data_files(data_folder(data, "kinect_utd_mhad"), "s0[1-6]_*.npz")
    recordings = read_recordings(files[:: effort.every_file])
    held_out = [r for r in recordings if r.person in SPLITS[split]][:: effort.every_tracked]
    poses = [centred_on_neck(r.upper_body().joints) for r in held_out]
    seen = [r for r in recordings if r.person not in SPLITS[split]]
    return Split(seen, make_test_set(poses, CAMERA, 30.0))


def measure(split: Split, effort: Effort, seeds: Sequence[int]) -> list[Errors]:
    """Fit, tune and track once for each seed."""
    return [_measure(split, effort, seed) for seed in seeds]


def _measure(split: Split, effort: Effort, seed: int) -> Errors:
    recipe = UpperBodyRecipe(
        effort.components, effort.samples, pose_steps=effort.pose_steps,
        window_components=0, calibration_folds=0, seed=seed,
    )  # fmt: skip
    prior = recipe.fit(split.seen)
    steps = effort.tuning_steps
    priors = (
        plain_prior(prior),
        prior,
        tuned(prior, split.seen, seed, steps),
        tuned(prior, split.seen, seed, steps, mixtures=True),
    )
    errors = [error(one, split.test) for one in priors]
    return Errors(torch.tensor(errors, dtype=torch.float64))


def facts(split: Split, effort: Effort) -> list[Any]:
    """Return the inputs of a run, beside its seed."""
    joints = [fact for r in split.seen for fact in (r.person_id, r.joints)]
    return [effort, *joints, split.test.keypoints, split.test.truth3d, split.test.lengths]


TUNING = Experiment(
    Errors,
    measure,
    facts,
    (
        *MADE_WITH,
        "torchpose/learning",
        "benchmarks/_upper_body.py",
        "benchmarks/fine_tuned_filter.py",
    ),
)


def table(found: Results) -> str:
    """Return a row per method: mean and standard deviation over seeds for each split."""
    rows = [[method] for method in METHODS]
    for (_,), own in found.by("subject").items():
        errors = torch.stack([run.by_method for run in own.runs], 1)
        for row, values in zip(rows, errors, strict=True):
            spread = f" ± {float(values.std()):.2f}" if len(values) > 1 else ""
            row.append(f"{float(values.mean()):.2f}{spread}")
    splits = [", ".join(SPLITS[name]) for name in found.names("subject")]
    return markdown_table(["filter over single poses", *(f"{s} (cm)" for s in splits)], rows)


def main(
    *,
    data: Path,
    out: Path,
    splits: Annotated[Sequence[str], OneOf(SPLITS)] = tuple(SPLITS),
    seeds: Sequence[int] = (0, 1, 2),
    threads: int = 1,
    quick: bool = False,
) -> None:
    """Measure what is not there yet, and print and write the table.

    Args:
        data: folder with kinect_utd_mhad/.
        out: folder for what is kept, and the table.
        splits: who is tracked.
        seeds: of fits and batches.
        threads: cores.
        quick: tiny fits, to see that it works.
    """
    torch.set_num_threads(threads)
    check_output_folder(out)
    effort = QUICK if quick else Effort()
    grid = Grid({name: read_split(data, name, effort) for name in splits}, {"": effort})
    text = table(TUNING.run({"": grid}, seeds, out, progress=True, title="splits"))
    note = f"Mean and standard deviation over {len(seeds)} seeds."
    print(f"{text}\n\n{note}\n\n{machine_line(threads)}")
    save_text(out / "fine-tuned.md", f"{text}\n\n{note}\n")


if __name__ == "__main__":
    run_command(main)
