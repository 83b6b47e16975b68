"""Errors of persons who stand to the side, farther or nearer than the prior's persons.

A prior is fitted to the training persons s1 to s3 of UB-people and tracks s4 to s6 in the test camera,
still at the usual place (about 2 m away), walking in a circle, and standing elsewhere. Windows see
the body by a virtual camera that follows it (`torchpose.camera._virtual_camera`), single poses do not.

    python -m benchmarks.ub_people_places --data DIR --out DIR
"""

from pathlib import Path

import torch
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks._command import run_command
from benchmarks._upper_body import score
from benchmarks.ub_people import people, sway
from torchpose._core.files import check_output_folder
from torchpose.evaluation._trials import (
    CAMERA,
    Trials,
    cached_prior,
    centred_on_neck,
    make_test_set,
)
from torchpose.evaluation._trials import track as track_test
from torchpose.learning import fit_kinect_prior
from torchpose.priors import UpperBodyPrior

FITTED, TRACKED = ("s1", "s2", "s3"), ("s4", "s5", "s6")
TRACKERS = {
    "windows, filtered": {},
    "windows, smoothed": {"smoothing": "full"},
    "single poses": {"method": "mkf-fixed"},
}
PLACES = {
    "usual place": (0.0, 0.0, 0.0),
    "0.6 m to the side": (0.6, 0.0, 0.0),
    "0.7 m farther": (0.0, 0.0, 0.7),
    "1 m farther": (0.0, 0.0, 1.0),
    "2 m farther": (0.0, 0.0, 2.0),
    "0.5 m nearer": (0.0, 0.0, -0.5),
    "0.7 m nearer": (0.0, 0.0, -0.7),
}

_QUICK_FRAMES = 20  # of a sequence of a quick run


def paths(name: str, poses: list[Tensor], fps: float) -> list[Tensor]:
    """Return the places of the bodies in every frame of each sequence [T, 3], metres from the usual one."""
    if name == "walking in a circle":
        return [sway(len(p), fps, i / len(poses)) for i, p in enumerate(poses)]
    place = torch.tensor(PLACES[name], dtype=torch.float64)
    return [place.expand(len(p), 3) for p in poses]


def error(prior: UpperBodyPrior, test: Trials, options: dict[str, object]) -> str:
    """Return the mean 3D error after Procrustes, cm."""
    errors = score(track_test(prior, CAMERA, test, **options), test).errors3d
    return f"{float(errors[test.inside].mean()) * 100:.2f}"


def main(
    *,
    data: Path,
    out: Path,
    every: int = 6,
    seed: int = 0,
    threads: int = 2,
    quick: bool = False,
) -> None:
    """Fit, track and print the table.

    Args:
        data: folder of kinect_utd_mhad.
        out: folder for the fitted prior.
        every: track every n-th sequence.
        seed: of fit and noise.
        threads: cores.
        quick: small, to see that all of it works.
    """
    torch.set_num_threads(threads)
    out = check_output_folder(out)
    recordings, _ = people(data, quick)
    sizes = (4, 8, 1000) if quick else (30, 120, 60_000)
    settings = dict(
        zip(("n_components", "window_components", "window_samples"), sizes, strict=True)
    )
    if quick:
        settings |= {"n_samples": 1000, "window_steps": 2}
    prior = cached_prior(
        out, [r for r in recordings if r.person in FITTED], fit_kinect_prior, True,
        seed=seed, calibration_folds=0, name="ub-people-places", **settings,
    )  # fmt: skip
    tracked = [r for r in recordings if r.person in TRACKED][::every]
    poses, fps = [centred_on_neck(r.upper_body().joints) for r in tracked], tracked[0].fps or 30.0
    if quick:
        poses = [p[:_QUICK_FRAMES] for p in poses]
    print(f"| 3D error (cm), {sum(map(len, poses)):,} frames | {' | '.join(TRACKERS)} |")
    print("| --- |" + " ---: |" * len(TRACKERS))
    for name in tqdm([*PLACES, "walking in a circle"], desc="places"):
        test = make_test_set(poses, CAMERA, fps, seed, paths=paths(name, poses, fps))
        row = " | ".join(error(prior, test, options) for options in TRACKERS.values())
        tqdm.write(f"| {name} | {row} |")


if __name__ == "__main__":
    run_command(main)
