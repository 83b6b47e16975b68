"""UB-people: tracking persons whom the prior never saw, from head, neck and hands of one camera.

Prior, noise and calibration come from persons s1 to s6 of UTD-MHAD (Kinect v1); every sequence of
s7 and s8 is tracked with what the recipe makes of them, with its parts left out, and with the
paper's own transition and hand-set noise. The error is the 3D distance after fixed-scale Procrustes
on head, neck and shoulders (BL section 6), pooled over joints and frames.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks._data import data_folder
from benchmarks._gaps import add_gap_tables
from benchmarks._people_tables import (
    BASELINE,
    DEFAULT,
    LAGGED,
    MAIN,
    MEAN_POSE,
    NEIGHBOUR,
    SMOOTHED,
    UNCALIBRATED,
    add_calibration_table,
    add_error_tables,
    add_findings,
    add_pcp_table,
    add_pictures,
)
from benchmarks._upper_body import (
    TRACKING,
    Scores,
    Tracker,
    plain_prior,
    projected_training_poses,
    score,
    trials_of,
    with_bones,
)
from benchmarks.engine import Grid
from torchpose._core.files import check_output_folder
from torchpose.errors import InputError
from torchpose.evaluation import Report
from torchpose.evaluation._trials import (
    CAMERA,
    Estimate,
    Recipe,
    Trials,
    cached_prior,
    centred_on_neck,
)
from torchpose.io import Recording, read_recordings
from torchpose.io._recordings import cut_recording
from torchpose.learning import fit_kinect_prior
from torchpose.priors import UpperBodyPrior
from torchpose.skeleton import UPPER_BODY

TRAIN_PERSONS = ("s1", "s2", "s3", "s4", "s5", "s6")
TEST_PERSONS = ("s7", "s8")
_DATA = "kinect_utd_mhad"
_N_PROJECTED = 100_000
_QUICK_FRAMES = 20  # of a sequence of the test persons in a quick run


def run(
    data: str | Path,
    out: str | Path,
    *,
    seed: int = 0,
    progress: bool = True,
    quick: bool = False,
    n_components: int | None = None,
    lag: int = 0,
    n_gap_sequences: int = 72,
    recipe: Recipe = fit_kinect_prior,
    prior: UpperBodyPrior | None = None,
) -> Report:
    """Run the protocol; writes report.json, report.md and pictures to `out`.

    A prior that was fitted there with the same settings, and estimates of the same trackers, are read
    instead of made again.

    Args:
        data: folder kinect_utd_mhad, or the one it is in; the tracker's default is scored too if all
            other sets are there. out: folder for the results.
        seed: of prior and noise. progress: whether to show bars.
        quick: a small prior, a few sequences and no fixed lag, to see that all of it works.
        n_components: Gaussians per arm; what the recipe has by default if None.
        lag: frames of a fixed-lag smoother, 0 to leave it out. Smoothing with windows looks 16 frames
            ahead whatever the lag above that.
        n_gap_sequences: sequences in which a hand is hidden; 0 leaves that part out.
        recipe: fits the prior to the training persons. prior: one to score instead.

    Raises:
        InputError: no such data, persons missing. OverlapError: `prior` saw a test person.
        OutputError: `out` cannot be written.
    """
    out = check_output_folder(out)
    train, tested = people(data, quick)
    settings: dict[str, Any] = {"seed": seed, "name": "ub-people"}
    if n_components or quick:
        settings["n_components"] = n_components or 8
    if prior is None:
        prior = cached_prior(out, train, recipe, progress, **settings)
    prior.check_unseen({r.person_id for r in tested})
    still, moving = still_and_moving(tested, seed)
    report = Report("UB-people", _settings(train, tested, still, prior, settings, quick))
    lag = 0 if quick else lag
    projected = projected_training_poses(train, CAMERA, 2_000 if quick else _N_PROJECTED, seed)
    bones = None if quick else with_bones(Path(data), TEST_PERSONS)
    trackers = _usual(prior, bones) | _variants(prior, lag)
    scores = _all_methods(trackers, still, projected, out, progress)
    some = {n: t for n, t in trackers.items() if n in (MAIN, SMOOTHED, BASELINE) or DEFAULT in n}
    moved = _all_methods(some, moving, projected, out, progress, "moving: trackers")
    add_error_tables(report, scores, moved, still, moving)
    add_pcp_table(report, {name: s.limbs for name, s in scores.items()})
    add_calibration_table(report, prior, scores)
    if n_gap_sequences:
        poses = [centred_on_neck(r.upper_body().joints) for r in tested]
        add_gap_tables(report, out, prior, poses, still.fps, seed, n_gap_sequences, progress, quick)
    add_findings(report)
    add_pictures(report, out, scores)
    report.save(out)
    return report


def people(data: str | Path, quick: bool = False) -> tuple[list[Recording], list[Recording]]:
    """Return recordings of the training and of the test persons (a few, short ones if `quick`).

    Raises:
        InputError: recordings of either are missing.
    """
    recordings = read_recordings(data_folder(data, _DATA))
    train = [r for r in recordings if r.person in TRAIN_PERSONS]
    tested = [r for r in recordings if r.person in TEST_PERSONS]
    missing = {*TRAIN_PERSONS, *TEST_PERSONS} - {r.person for r in recordings}
    if missing:
        raise InputError(
            f"{data}: expected recordings of the persons {', '.join(TRAIN_PERSONS + TEST_PERSONS)}, "
            f"found none of {', '.join(sorted(missing))}"
        )
    if quick:
        few = tested[:: max(1, len(tested) // 10)]
        return train[:: max(1, len(train) // 40)], [cut_recording(r, 0, _QUICK_FRAMES) for r in few]
    return train, tested


def still_and_moving(recordings: Sequence[Recording], seed: int = 0) -> tuple[Trials, Trials]:
    """Return the tests of people whose necks stay in their place, and of the same who `sway`.

    Args:
        recordings: of one frame rate. seed: of the noise.
    """
    fps = recordings[0].fps or 30.0
    paths = [sway(len(r), fps, i / len(recordings)) for i, r in enumerate(recordings)]
    return trials_of(recordings, seed), trials_of(recordings, seed, paths=paths)


def sway(n_frames: int, fps: float, phase: float = 0.0) -> Float[Tensor, "T 3"]:
    """Return the path of a body that moves 0.3 m to either side and 0.3 m in depth once in 4 s.

    x = 0.3 sin(a), z = 0.3 cos(a), a = 2 pi (t / 4 s + phase): a circle on the floor, 0.47 m/s.

    Args:
        n_frames: T. fps: frame rate. phase: where on the circle it starts, 0 to 1.
    """
    angle = 2 * math.pi * (torch.arange(n_frames, dtype=torch.float64) / fps / 4.0 + phase)
    return 0.3 * torch.stack([angle.sin(), torch.zeros_like(angle), angle.cos()], 1)


def _settings(
    train: Sequence[Recording],
    tested: Sequence[Recording],
    test: Trials,
    prior: UpperBodyPrior,
    settings: dict[str, Any],
    quick: bool,
) -> dict[str, Any]:
    return settings | {
        "quick": quick,
        "training": f"{len(train)} sequences of {', '.join(TRAIN_PERSONS)}",
        "test": f"{len(tested)} sequences of {', '.join(TEST_PERSONS)}, "
        f"{int(test.lengths.sum())} frames",
        "components": prior.n_components,
        "transition": prior.info.transition,
        "learnt": sorted([*prior.noise, *(f"window {name}" for name in prior.windows)]),
        "threads": torch.get_num_threads(),
    }


def _usual(prior: UpperBodyPrior, options: dict[str, Any] | None) -> dict[str, Tracker]:
    """Return the tracker as it comes, filtered and smoothed, where it has both of its priors."""
    if not prior.windows or options is None:
        return {}
    return {
        f"{DEFAULT}, filtered": Tracker(prior, options),
        f"{DEFAULT}, smoothed": Tracker(prior, options | {"smoothing": "full"}),
    }


def _variants(prior: UpperBodyPrior, lag: int) -> dict[str, Tracker]:
    """Return the other trackers of the table, of the prior alone: prior with noise, and options."""
    plain = plain_prior(prior)
    smooth: dict[str, Any] = {"smoothing": "full"}
    variants = {MAIN: Tracker(prior, {}), SMOOTHED: Tracker(prior, smooth)}
    if any(name.startswith("calibration") for name in prior.noise):
        variants[UNCALIBRATED] = Tracker(prior, {"calibrated": False})
        variants[f"{SMOOTHED}, uncalibrated"] = Tracker(prior, smooth | {"calibrated": False})
    poses = {"method": "mkf-fixed"}
    if prior.windows:
        variants[f"{MAIN}, single poses"] = Tracker(prior, poses)
        variants[f"{SMOOTHED}, single poses"] = Tracker(prior, poses | smooth)
    if lag:
        variants[f"{LAGGED} {lag}, single poses"] = Tracker(prior, poses | {"smoothing": lag})
    variants[BASELINE] = Tracker(plain, {})
    variants["MKF stationary, hand-set noise"] = Tracker(
        plain, poses | {"transition": "stationary"}
    )
    variants["MKF ou 0.95, hand-set noise"] = Tracker(
        plain, poses | {"transition": "ou", "gamma": 0.95}
    )
    variants[f"{BASELINE}, smoothed"] = Tracker(plain, smooth)
    return variants


def _all_methods(
    trackers: Mapping[str, Tracker],
    test: Trials,
    projected: tuple[Tensor, Tensor],
    out: Path,
    progress: bool,
    title: str = "trackers",
) -> dict[str, Scores]:
    """Return the scores of the trackers, of the nearest training pose and of the mean pose."""
    grid = Grid({"": test}, trackers)
    runs = TRACKING.run({"": grid}, (0,), out, progress=progress, title=title)
    scores = {row.method: score(row.run, test) for row in runs.rows}
    scores[NEIGHBOUR] = score(nearest_neighbour(test, *projected, progress=progress), test)
    scores[MEAN_POSE] = score(mean_pose(test, *projected), test)
    return scores


def mean_pose(test: Trials, joints: Float[Tensor, "N 8 3"], uv: Float[Tensor, "N 8 2"]) -> Estimate:
    """Return the mean of the training poses for every frame; in the image, about the measured neck."""
    shape = test.truth3d.shape[:2]
    offsets = (uv - uv[:, 4:5]).mean(0)
    neck = test.names.index("neck")
    return Estimate(
        offsets + test.keypoints[:, :, neck : neck + 1],
        joints.mean(0).expand(*shape, 8, 3).contiguous(),
    )


def nearest_neighbour(
    test: Trials,
    joints: Float[Tensor, "N 8 3"],
    uv: Float[Tensor, "N 8 2"],
    chunk: int = 256,
    progress: bool = False,
) -> Estimate:
    """Return for each frame alone the training pose whose measured joints look most alike.

    Args:
        test: sequences. joints, uv: training poses and their pixels.
        chunk: frames at a time. progress: whether to show a bar.
    """
    columns = [UPPER_BODY.index(name) for name in test.names]
    known = uv[:, columns].flatten(1).float()
    inside = test.inside
    wanted = test.keypoints[inside].flatten(1).float()
    found = [
        torch.cdist(part, known).argmin(1)
        for part in tqdm(wanted.split(chunk), disable=not progress, desc=NEIGHBOUR, leave=False)
    ]
    index = torch.cat(found)
    joints2d, joints3d = torch.full_like(test.truth2d, torch.nan), test.truth3d * torch.nan
    joints2d[inside], joints3d[inside] = uv[index], joints[index]
    return Estimate(joints2d, joints3d)


if __name__ == "__main__":
    from benchmarks._protocols import run_protocol

    run_protocol("ub_people")
