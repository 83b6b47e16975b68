"""How much persons differ: the training persons of UB-people, each tracked by a prior of the others.

For each of s1 to s6 a prior is fitted to the other five, without calibration, and tracks that person
in the test camera. Scale and floor of the covariances then come from the errors of the other five,
each under the prior that did not know them (`torchpose.learning._recipes.fit_calibration`). The table
shows the error and the share of true joints inside the 50 % and 90 % ellipsoids, person by person:
its spread
is what a calibration on a handful of persons can promise for the next one.

    python -m benchmarks.ub_people_by_person --data DIR --out DIR
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks._upper_body import trials_of
from benchmarks.ub_people import people
from torchpose._core.files import check_output_folder
from torchpose.evaluation.common import CAMERA, cached_prior, track
from torchpose.evaluation.person_tables import SHORT_NAMES
from torchpose.io import Recording
from torchpose.learning import fit_kinect_prior
from torchpose.learning._recipes import fit_calibration
from torchpose.metrics import align, coverage

LEVELS = (0.5, 0.9)


class HeldOut(NamedTuple):
    """Aligned estimates, covariances and truth of a person whom the prior never saw, [N, 8, ...]."""

    points: Tensor
    covs: Tensor
    truth: Tensor


def hold_out(
    person: str, recordings: list[Recording], arguments: argparse.Namespace, bar: "tqdm[str]"
) -> HeldOut:
    """Track a person with a prior of all others."""
    bar.set_postfix_str(person)
    seen = [r for r in recordings if r.person != person]
    own = [r for r in recordings if r.person == person][:: arguments.every]
    settings = {"seed": arguments.seed, "calibration_folds": 0, "name": "ub-people-by-person"}
    if arguments.quick:
        settings |= {"n_components": 4, "n_samples": 3000, "window_steps": 5}
    settings |= {
        "window_components": 8 if arguments.quick else arguments.window_components,
        "window_samples": 3000 if arguments.quick else arguments.window_samples,
    }
    prior = cached_prior(arguments.out, seen, fit_kinect_prior, False, **settings)
    test = trials_of(own, arguments.seed)
    found = track(prior, CAMERA, test)
    if found.covariance3d is None:
        raise RuntimeError("the tracker returned no covariances")
    inside = test.inside
    truth = test.truth3d[inside]
    aligned = align(found.joints3d[inside], truth, covariance=found.covariance3d[inside])
    if aligned.covariance is None:
        raise RuntimeError("align was given covariances and returned none")
    return HeldOut(aligned.points, aligned.covariance, truth)


def calibrated_coverage(person: str, parts: dict[str, HeldOut]) -> Tensor:
    """Share inside the ellipsoids [2, 8], calibrated on all other persons."""
    others = [part for name, part in parts.items() if name != person]
    errors = torch.cat([part.points - part.truth for part in others])
    scale, floor = fit_calibration(errors, torch.cat([part.covs for part in others]), LEVELS)
    own = parts[person]
    covs = own.covs * scale[:, None, None] + floor[:, None, None] * torch.eye(3).double()
    return coverage(own.points, covs, own.truth, levels=LEVELS).per_joint


def table(parts: dict[str, HeldOut]) -> str:
    """Errors and coverage as a Markdown table, with mean and standard deviation over persons."""
    errors = {name: (p.points - p.truth).norm(dim=-1).mean() * 100 for name, p in parts.items()}
    shares = {name: 100 * calibrated_coverage(name, parts) for name in parts}
    head = ["person", "error (cm)", *(f"{joint}, 50 / 90 %" for joint in SHORT_NAMES)]
    rows = [
        [name, f"{errors[name]:.2f}", *(f"{low:.0f} / {high:.0f}" for low, high in shares[name].T)]
        for name in parts
    ]
    stacked = torch.stack(list(shares.values()))
    all_errors = torch.stack(list(errors.values()))
    for label, function in (("mean", torch.mean), ("standard deviation", torch.std)):
        pairs = (f"{low:.0f} / {high:.0f}" for low, high in function(stacked, 0).T)
        rows.append([label, f"{function(all_errors):.2f}", *pairs])
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(row) + " |" for row in lines)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", required=True, type=Path, help="folder of kinect_utd_mhad")
    parser.add_argument("--out", required=True, type=Path, help="folder for the fitted priors")
    parser.add_argument("--window-components", type=int, help="by default as the shipped prior")
    parser.add_argument("--window-samples", type=int, help="by default as the shipped prior")
    parser.add_argument("--every", type=int, default=1, help="track every n-th sequence")
    parser.add_argument("--seed", type=int, default=0, help="of fits and noise")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--quick", action="store_true", help="small, to see that all of it works")
    arguments = parser.parse_args()
    arguments.out = check_output_folder(arguments.out)
    torch.set_num_threads(arguments.threads)
    recordings, _ = people(arguments.data, arguments.quick)
    bar = tqdm(sorted({r.person for r in recordings if r.person}), desc="persons held out")
    parts = {person: hold_out(person, recordings, arguments, bar) for person in bar}
    print(table(parts))


if __name__ == "__main__":
    main()
