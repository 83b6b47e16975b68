"""What fine-tuning through the filter gains: Q, R and mixtures by gradient of the 3D error.

On training persons of UB-people alone (s1 to s6 of UTD-MHAD): a prior over single poses is fitted to four
of them, its filter is tuned on the same four, and every third sequence of the other two is tracked from
head, neck and hands with 3 px noise, by the prior as it is with hand-set Q and R (the paper's
transition), with the released Q, and tuned. Each seed draws other viewpoints, starts and batches. The
error is the 3D distance after fixed-scale Procrustes, pooled over joints and frames, without windows.

    python -m benchmarks.fine_tuned_filter --data DIR --out DIR [--splits A B C] [--seeds 0 1 2]

A seed of a split takes about a minute and a half. Finished ones lie in `--out` and are read from there.
"""

import argparse
import json
from pathlib import Path
from statistics import fmean, stdev

import torch
from tqdm.auto import tqdm

from benchmarks._upper_body import data_folder, plain_prior, score
from benchmarks.speed._timing import machine_line, markdown_table
from torchpose._core.files import atomic_path, check_output_folder
from torchpose.evaluation._common import CAMERA, Trials, centred_on_neck, make_test_set, track
from torchpose.io import Recording, read_recordings
from torchpose.learning import UpperBodyRecipe
from torchpose.learning._fine_tuning import TunableKalman, draw_sequences, parameter_groups
from torchpose.priors import UpperBodyPrior

SPLITS = {"A": ("s3", "s6"), "B": ("s2", "s4"), "C": ("s1", "s5")}
"""Persons who are tracked; the other four of s1 to s6 are fitted and tuned on."""

METHODS = ("hand-set Q and R", "released Q", "Q and R tuned", "Q, R and mixtures tuned")
STEPS, RATE, SEQUENCES, FRAMES = 80, 0.1, 16, 48
BODY_SIZE, BONE_LENGTHS = 0.3, 0.05


def tuned(
    prior: UpperBodyPrior, persons: list[Recording], seed: int, **options: bool
) -> UpperBodyPrior:
    """The prior with its filter tuned; the learning rate falls over the second half."""
    poses = UpperBodyRecipe().poses(persons)
    sequences = list(poses.joints.split(poses.lengths))
    model = TunableKalman(prior, **options)
    adam = torch.optim.Adam(parameter_groups(model, RATE))
    rates = [group["lr"] for group in adam.param_groups]
    generator = torch.Generator().manual_seed(seed)
    for step in tqdm(range(STEPS), desc="tune", leave=False):
        for group, rate in zip(adam.param_groups, rates, strict=True):
            group["lr"] = rate * min(1.0, 2 * (1 - step / STEPS))
        batch = draw_sequences(
            sequences, prior, SEQUENCES, generator, frames=FRAMES,
            body_size=BODY_SIZE, bone_lengths=BONE_LENGTHS,
        )  # fmt: skip
        adam.zero_grad()
        model.loss(batch).backward()
        adam.step()
    return model.prior()


def error(prior: UpperBodyPrior, test: Trials) -> float:
    """Mean 3D error in cm."""
    estimate = track(prior, CAMERA, test, method="mkf-fixed")
    return 100 * float(score(estimate, test).errors3d.nanmean())


def measure(data: Path, split: str, seed: int, quick: bool) -> dict[str, float]:
    """Errors of all methods on one split."""
    held_out = SPLITS[split]
    files = sorted(data_folder(data, "kinect_utd_mhad").glob("s0[1-6]_*.npz"))
    recordings = read_recordings(files[:: 40 if quick else 1])
    seen = [r for r in recordings if r.person not in held_out]
    own = [r for r in recordings if r.person in held_out][:: 1 if quick else 3]
    test = make_test_set([centred_on_neck(r.upper_body().joints) for r in own], CAMERA, 30.0)
    recipe = UpperBodyRecipe(
        4 if quick else 30, 2_000 if quick else 60_000, pose_steps=5 if quick else 60,
        window_components=0, calibration_folds=0, seed=seed,
    )  # fmt: skip
    prior = recipe.fit(seen)
    priors = (
        plain_prior(prior),
        prior,
        tuned(prior, seen, seed),
        tuned(prior, seen, seed, mixtures=True),
    )
    return {name: error(p, test) for name, p in zip(METHODS, priors, strict=True)}


def table(found: dict[str, dict[str, float]], splits: list[str], seeds: list[int]) -> str:
    """A row per method: mean and standard deviation over seeds for each split."""
    rows = []
    for method in METHODS:
        row = [method]
        for split in splits:
            values = [
                found[f"{split}{seed}"][method] for seed in seeds if f"{split}{seed}" in found
            ]
            spread = f" ± {stdev(values):.2f}" if len(values) > 1 else ""
            row.append(f"{fmean(values):.2f}{spread}" if values else "-")
        rows.append(row)
    header = ["filter over single poses", *(f"{', '.join(SPLITS[s])} (cm)" for s in splits)]
    return markdown_table(header, rows)


def main() -> None:
    """Measure what is not there yet, and print and write the table."""
    global STEPS
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--splits", nargs="+", choices=sorted(SPLITS), default=sorted(SPLITS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    if arguments.quick:
        STEPS = 2
    kept = check_output_folder(arguments.out) / "results.json"
    found = json.loads(kept.read_text(encoding="utf-8")) if kept.is_file() else {}
    for split in arguments.splits:
        for seed in arguments.seeds:
            if f"{split}{seed}" not in found:
                found[f"{split}{seed}"] = measure(arguments.data, split, seed, arguments.quick)
                with atomic_path(kept) as temporary:
                    temporary.write_text(json.dumps(found, indent=1), encoding="utf-8")
    text = table(found, arguments.splits, arguments.seeds)
    note = f"Mean and standard deviation over {len(arguments.seeds)} seeds."
    print(f"{text}\n\n{note}\n\n{machine_line(arguments.threads)}")
    with atomic_path(arguments.out / "fine-tuned.md") as temporary:
        temporary.write_text(f"{text}\n\n{note}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
