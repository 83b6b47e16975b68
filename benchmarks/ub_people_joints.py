"""How well are persons tracked whom no prior saw, from all eight joints, and from head, neck and hands?

Persons s7 and s8 of UTD-MHAD in the test camera of `python -m benchmarks.ub_people`, with 3 px of noise on
each measured joint. Priors and learned lifters know s1 to s6, the prior over arms all sets without s7 and
s8. Of all joints, arms that are lifted by geometry stand beside them, which is told what no image shows:

- how deep head, neck and shoulders are in every frame, else all as deep as the neck;
- the lengths of the person's bones, on average over a recording, or in every single frame, since Kinect's
  bones change their lengths;
- which end of a bone is nearer, else the nearer one of both places is taken.

    python -m benchmarks.ub_people_joints --data DIR --out DIR [--every 6]

Priors are kept in the second folder.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks._command import run_command
from benchmarks._upper_body import projected_training_poses, score, with_bones
from benchmarks.ub_people import TEST_PERSONS, mean_pose, nearest_neighbour, people
from benchmarks.ub_people_regressors import estimate, train_frames, train_sequences
from torchpose._core.files import check_output_folder
from torchpose.camera._projection import backproject
from torchpose.evaluation import Report
from torchpose.evaluation._person_tables import SHORT_NAMES
from torchpose.evaluation._trials import (
    CAMERA,
    MEASURED,
    Estimate,
    Trials,
    cached_prior,
    centred_on_neck,
    make_test_set,
    track,
)
from torchpose.io import Recording
from torchpose.learning import fit_kinect_prior
from torchpose.priors import UpperBodyPrior
from torchpose.skeleton import UPPER_BODY
from torchpose.skeleton._upper_body import LEFT_ARM, RIGHT_ARM

_TORSO = [UPPER_BODY.index(name) for name in ("shoulder_left", "head", "neck", "shoulder_right")]
_NECK = UPPER_BODY.index("neck")

_SETTINGS: dict[str, Any] = {
    "n_components": 10,  # with those of windows, as in the prior that comes with torchpose
    "window_components": 48,
    "calibration_folds": 0,  # covariances do not change the poses
}

_MEASURED = {"all eight joints": tuple(UPPER_BODY), "head, neck and hands": MEASURED}

Lengths = Literal["own", "in every frame"]


def main(
    *,
    data: Path,
    out: Path,
    every: int = 6,
    seed: int = 0,
    threads: int = 2,
    quick: bool = False,
) -> None:
    """Print both tables.

    Args:
        data: folder with all sets. out: folder for fitted priors.
        every: only each n-th sequence of the test persons is tracked.
        seed: of priors, noise and lifters. threads: cores.
        quick: small priors and few sequences, to see that it works.
    """
    torch.set_num_threads(threads)
    out = check_output_folder(out)
    train, tested = people(data, quick)
    tested = tested if quick else tested[::every]
    poses = [centred_on_neck(r.upper_body().joints) for r in tested]
    trackers = _trackers(data, out, train, seed, quick)
    report = Report("UB-people by measured joints")
    for title, names in _MEASURED.items():
        test = make_test_set(poses, CAMERA, tested[0].fps or 30.0, seed, names=names)
        lifts = _LIFTS if names == UPPER_BODY else {}
        methods = trackers | _learned(train, names, seed, quick) | lifts
        _add_table(report, title, methods, test)
    print("\n\n".join(table.to_markdown() for table in report.values()))


Method = Callable[[Trials], Estimate]


def _add_table(report: Report, measured: str, methods: Mapping[str, Method], test: Trials) -> None:
    """Add the errors of methods on a test set, of which these joints are measured."""
    table = report.table(
        measured, f"3D error after Procrustes (cm), measured: {measured}",
        ["mean", *SHORT_NAMES], digits=(2, *[1] * 8),
    )  # fmt: skip
    for name, method in tqdm(methods.items(), desc=measured):
        scores = score(method(test), test)
        table.add(name, [scores.mean_error, *(100 * scores.errors3d[test.inside].mean(0)).tolist()])
    table.note = f"{len(test.lengths)} sequences, {int(test.lengths.sum())} frames."


def _trackers(
    data: Path, out: Path, train: list[Recording], seed: int, quick: bool
) -> dict[str, Method]:
    """Return trackers with priors that do not know the test persons."""
    settings: dict[str, Any] = {"seed": seed, "name": "ub-people", **_SETTINGS}
    if quick:
        settings |= {"n_samples": 2_000, "window_samples": 1_000, "window_steps": 2}
    prior = cached_prior(out, train, fit_kinect_prior, True, **settings)
    bones = None if quick else with_bones(data, TEST_PERSONS)
    smooth = {"smoothing": "full"}
    options: dict[str, Mapping[str, Any]] = {"windows": {}, "windows, smoothed": smooth}
    if bones is not None:
        own = {"windows and bones": bones, "bones": bones | {"method": "articulated"}}
        options |= own | {f"{name}, smoothed": of | smooth for name, of in own.items()}

    return {name: partial(_tracked, prior, given) for name, given in options.items()}


def _tracked(prior: UpperBodyPrior, options: Mapping[str, Any], test: Trials) -> Estimate:
    return track(prior, CAMERA, test, **options)


def _learned(
    train: list[Recording], names: tuple[str, ...], seed: int, quick: bool
) -> dict[str, Method]:
    """Return lifters of these joints that learn from the training persons."""
    poses = [centred_on_neck(r.upper_body().joints).float() for r in train]
    known = projected_training_poses(train, CAMERA, 2_000 if quick else 100_000, seed)

    return {
        "MLP, per frame": partial(estimate, train_frames(poses, "body", seed, quick, names)),
        "GRU, causal": partial(estimate, train_sequences(poses, "body", seed, quick, False, names)),
        "GRU, both directions": partial(
            estimate, train_sequences(poses, "body", seed, quick, True, names)
        ),
        "nearest neighbour": partial(nearest_neighbour, joints=known[0], uv=known[1]),
        "mean pose": partial(mean_pose, joints=known[0], uv=known[1]),
    }


def lifted(test: Trials, depths: bool, lengths: Lengths, nearer_end: bool) -> Estimate:
    """Return arms on the rays of what is measured, by what geometry is told.

    Args:
        test: with all eight joints measured. depths: whether those of the torso's joints are told.
        lengths: of bones. nearer_end: whether it is told which end of a bone is nearer.
    """
    pixels = test.keypoints
    rays = backproject(torch.cat([pixels, torch.ones_like(pixels[..., :1])], -1), CAMERA.matrix)
    depth = test.truth3d[..., _TORSO if depths else [_NECK] * len(_TORSO), 2]
    joints = torch.zeros_like(test.truth3d)
    joints[..., _TORSO, :] = rays[..., _TORSO, :] * depth[..., None]
    for parent, child in _bones():
        truth = test.truth3d[..., child, :]
        length = (truth - test.truth3d[..., parent, :]).norm(dim=-1)
        if lengths == "own":
            length = length.nanmean(1, keepdim=True).expand_as(length)
        wanted = truth[..., 2] if nearer_end else None
        joints[..., child, :] = _on_ray(joints[..., parent, :], rays[..., child, :], length, wanted)
    joints[~test.inside] = torch.nan
    return Estimate(torch.full_like(test.truth2d, torch.nan), joints)


def _bones() -> Iterator[tuple[int, int]]:
    """Yield shoulder and elbow, then elbow and hand, of each arm."""
    for arm in (LEFT_ARM, RIGHT_ARM):
        hand, elbow, shoulder = arm[:3]
        yield shoulder, elbow
        yield elbow, hand


def _on_ray(
    start: Float[Tensor, "*batch 3"],
    ray: Float[Tensor, "*batch 3"],
    length: Float[Tensor, "*batch"],
    depth: Float[Tensor, "*batch"] | None,
) -> Float[Tensor, "*batch 3"]:
    """Return the place on a ray at a distance from a start; the nearest to it where there is none.

    Args:
        start, ray: the start of a bone, and the ray of its end. length: of the bone.
        depth: the one of both places that is nearer to this depth is taken; the nearer one without it.
    """
    along = (ray * start).sum(-1)
    square = ray.square().sum(-1)
    inside = along.square() - square * (start.square().sum(-1) - length.square())
    half = inside.clamp_min(0).sqrt()
    near, far = (along - half) / square, (along + half) / square
    if depth is not None:
        near = torch.where((far - depth).abs() < (near - depth).abs(), far, near)
    return ray * near[..., None]


def _lift_of(depths: bool, lengths: Lengths, nearer_end: bool) -> tuple[str, Method]:
    """Return the name of a lift, and itself."""
    of_bones = "lengths" if lengths == "own" else f"lengths {lengths}"
    told = ["depths of the torso"] * depths + [of_bones] + ["nearer ends"] * nearer_end
    return f"geometry, told {', '.join(told)}", partial(
        lifted, depths=depths, lengths=lengths, nearer_end=nearer_end
    )


_LIFTS: dict[str, Method] = dict(
    [_lift_of(depths, "own", ends) for ends, depths in product((False, True), repeat=2)]
    + [_lift_of(True, "in every frame", True)]
)

if __name__ == "__main__":
    run_command(main)
