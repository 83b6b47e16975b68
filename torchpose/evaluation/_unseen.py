"""What protocols over persons share: priors fitted to some persons and scored on others.

A `Job` is a fit and the persons it is scored on. Priors and scores are kept in a folder by what they
depend on, so that a killed run goes on where it stopped and protocols do not fit the same twice.
"""

import pickle
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from multiprocessing import active_children, get_context
from pathlib import Path
from threading import RLock
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from tqdm.auto import tqdm

from torchpose._core.facade import package_version
from torchpose._core.frame_rates import group_by_rate
from torchpose._core.rows import joined
from torchpose.camera._viewpoints import ViewRange, sample_viewpoints
from torchpose.errors import InputError, PriorError
from torchpose.evaluation._person_recordings import LEAST_FRAMES, complete_pieces, pose_classes
from torchpose.evaluation._trials import (
    CAMERA,
    MEASURED,
    Estimate,
    Recipe,
    Trials,
    cached_prior,
    centred_on_neck,
    keep,
    make_test_set,
    read_kept,
    settings_hash,
    track,
)
from torchpose.io._recordings import Recording
from torchpose.learning._recipes.upper_body import fit_kinect_prior
from torchpose.learning._training import DEFAULT_RATE
from torchpose.metrics._calibration import chi2_quantile, mahalanobis_squared
from torchpose.metrics._pose_errors import ALIGN_JOINTS, align, joint_errors
from torchpose.priors._arm_state import arm_states
from torchpose.priors._upper_body_prior import UpperBodyPrior
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.skeleton._torso import NeckOffset, learn_neck_offset, place_neck

LEVELS = (0.5, 0.9)
"""Of the ellipsoids whose coverage is counted."""

QUICK: dict[str, Any] = {"n_components": 4, "window_components": 8, "window_samples": 3000}
"""Sizes of the fits of a quick run."""

_STANDS_FOR = {"hand": "wrist", "wrist": "hand"}


@dataclass(frozen=True)
class ScoreSettings:
    """Holds the settings of tracking and scoring.

    Args:
        seed: the seed of the noise, and of the viewpoints of the likelihood. every: of the sequences of a
            person only each n-th is tracked. noise_std: pixels.
        unmeasured: joints among `MEASURED` that the tracker is not given, such as a head that was
            never recorded. unscored: joints whose errors are not counted, nor aligned on.
        likelihood: whether the prior's likelihood is asked for; it needs all joints.
    """

    seed: int = 0
    every: int = 1
    noise_std: float = 3.0
    unmeasured: tuple[str, ...] = ()
    unscored: tuple[str, ...] = ()
    likelihood: bool = True


class Scored(NamedTuple):
    """Holds the errors of tracking a person, frame by frame.

    Attributes:
        filtered, smoothed: metres after fixed-scale Procrustes, NaN for joints that do not count.
        inside: 1 where the true joint is inside the filter's ellipsoid at each of `LEVELS`, 0 where
            it is not. log_likelihood: of the pose under the prior's mixtures over poses, mean of
            both arms, nats; NaN if it was not asked for.
        classes: what the left and the right arm do, index into `persons.POSE_CLASSES`.
        still: errors of the prior's mean pose, which looks at nothing; metres, aligned as those of tracking.
    """

    filtered: Float[Tensor, "N 8"]
    smoothed: Float[Tensor, "N 8"]
    inside: Float[Tensor, "N L 8"]
    log_likelihood: Float[Tensor, " N"]
    classes: Int[Tensor, "N 2"]
    still: Float[Tensor, "N 8"]


def pooled(parts: Sequence[Scored]) -> Scored:
    """Return all frames of several persons, or of several frame rates, as one."""
    return joined(parts)


@dataclass(frozen=True)
class Job:
    """Holds a fit and the persons that it is scored on.

    Args:
        label: for the bar. train: recordings of the fit. tests: recordings of each person by name.
        settings: the settings of the recipe. recipe: fits the prior. test: settings of the tracking.
    """

    label: str
    train: Sequence[Recording]
    tests: Mapping[str, Sequence[Recording]]
    settings: Mapping[str, Any]
    recipe: Recipe = fit_kinect_prior
    test: ScoreSettings = field(default_factory=ScoreSettings)


def fit_settings(
    name: str,
    seed: int,
    quick: bool,
    n_components: int | None,
    window_components: int | None,
    window_samples: int | None,
    calibration_folds: int,
) -> dict[str, Any]:
    """Return the settings of a recipe: the given ones, small sizes for a quick run, else its own.

    The filters that draw, which no protocol tracks with, are not calibrated.
    """
    settings: dict[str, Any] = {"name": name, "seed": seed}
    settings |= QUICK if quick else {}
    sizes = {
        "n_components": n_components,
        "window_components": window_components,
        "window_samples": window_samples,
    }
    settings |= {key: value for key, value in sizes.items() if value is not None}
    settings["calibration_folds"] = 0 if quick else calibration_folds
    return settings | ({"drawn_pieces": 0} if settings["calibration_folds"] else {})


def run_jobs(
    jobs: Sequence[Job], folder: Path, workers: int = 1, progress: bool = False
) -> list[dict[str, Scored]]:
    """Fit and score, in `workers` processes of one thread each (1: in this one).

    Args:
        jobs: fits with the persons that they are scored on.
        folder: where priors and scores are kept. progress: whether to show a bar.

    Returns:
        Scores of each job by person.

    Raises:
        OverlapError: a person is in the training recordings of a job that scores them. InputError: a
            person to be scored has no complete frames, which is seen before any fit.
    """
    for job in jobs:
        for name, recordings in job.tests.items():
            chosen = recordings[:: job.test.every]
            if not any(complete_pieces(r.upper_body().joints) for r in chosen):
                raise _incomplete(name)
    with tqdm(total=len(jobs), disable=not progress, unit="fit", desc="fits") as bar:
        if workers <= 1 or len(jobs) < 2:
            found = []
            for job in jobs:
                bar.set_postfix_str(job.label)
                found.append(_run(job, folder, progress))
                bar.update(1)
            return found
        return _run_in_processes(jobs, folder, workers, bar)


def _run_in_processes(
    jobs: Sequence[Job], folder: Path, workers: int, bar: tqdm
) -> list[dict[str, Scored]]:
    others = active_children()
    pool = ProcessPoolExecutor(workers, get_context("spawn"), initializer=_start_worker)
    with pool:
        futures = [pool.submit(_run_there, AsBytes(job), folder) for job in jobs]
        try:
            for done in as_completed(futures):
                done.result()
                bar.update(1)
        except BaseException:
            for process in active_children():
                if process not in others:  # it would finish its fits, and those that wait for it
                    process.terminate()
            pool.shutdown(cancel_futures=True)
            raise
        return [pickle.loads(future.result()) for future in futures]


class AsBytes:
    """Becomes the value that it holds in another process, which gets it as bytes.

    As they are, tensors are sent as open files, one each, of which a process may have a thousand.
    """

    def __init__(self, value: Any) -> None:
        self._value = value

    def __reduce__(self) -> tuple[Callable[[bytes], Any], tuple[bytes]]:
        return pickle.loads, (pickle.dumps(self._value),)


def _start_worker() -> None:
    torch.set_num_threads(1)
    tqdm.set_lock(RLock())  # its own, of several processes, is left over where a worker is ended


def _run_there(job: Any, folder: Path) -> bytes:
    """Run a job, sent by `AsBytes`, in a process of its own; return its scores as bytes, too."""
    return pickle.dumps(_run(job, folder, False))


def _run(job: Job, folder: Path, progress: bool) -> dict[str, Scored]:
    settings = dict(job.settings)
    cached_prior(folder, job.train, job.recipe, progress, **settings)
    # Read back, so that a run that goes on works with the same bits.
    prior = cached_prior(folder, job.train, job.recipe, progress, **settings)
    return {name: _scored(prior, job, name, folder, progress) for name in job.tests}


def _scored(prior: UpperBodyPrior, job: Job, name: str, folder: Path, progress: bool) -> Scored:
    """Return the scores of one person, read from the folder if they are there."""
    recordings = job.tests[name]
    prior.check_unseen({r.person_id for r in recordings})
    chosen = recordings[:: job.test.every]
    parts = [
        _scored_at(prior, job, fps, poses, folder, progress)
        for fps, poses in poses_by_rate(chosen, prior, job.train, name).items()
    ]
    return pooled(parts)


def _scored_at(
    prior: UpperBodyPrior,
    job: Job,
    fps: float,
    poses: Sequence[Float[Tensor, "T 8 3"]],
    folder: Path,
    progress: bool,
) -> Scored:
    """Return the scores of sequences at one frame rate, read from the folder if they are there."""
    facts = ["scores 2", package_version(), repr(job.test), fps]
    facts += [*prior.state_dict().values(), *poses]
    path = folder / f"scores-{settings_hash(facts)}.npz"
    found: Scored | None = read_kept(path, Scored, Scored._fields)
    if found is None:
        found = score_person(prior, poses, fps, job.test, progress)
        keep(path, found)
    return found


def score_person(
    prior: UpperBodyPrior,
    poses: Sequence[Float[Tensor, "T 8 3"]],
    fps: float,
    settings: ScoreSettings,
    progress: bool = False,
) -> Scored:
    """Track sequences from noisy keypoints, filtered and smoothed, and compare with the truth.

    Args:
        prior: of the tracker. poses: complete, centred on the neck, camera axes, metres.
        fps: frame rate. settings: see `ScoreSettings`. progress: whether to show bars.
    """
    test = make_test_set(poses, CAMERA, fps, settings.seed, settings.noise_std)
    inside = test.inside
    mask = torch.tensor([name not in settings.unmeasured for name in MEASURED])
    mask = mask.expand(*inside.shape, len(MEASURED))
    scored = torch.tensor([name not in settings.unscored for name in UPPER_BODY])
    own: dict[str, Any] = {"mask": mask, "progress": progress}
    filtered = compare(track(prior, CAMERA, test, label="filter", **own), test, scored)
    smooth = track(prior, CAMERA, test, label="smoother", smoothing="full", **own)
    smoothed = compare(smooth, test, scored)
    truth = torch.cat(list(poses)).double()
    likelihood = torch.full((len(truth),), torch.nan, dtype=torch.float64)
    if settings.likelihood:
        likelihood = log_likelihood(prior, truth, settings.seed)
    return Scored(
        filtered[0].float(), smoothed[0].float(), filtered[1].float(), likelihood,
        pose_classes(truth), mean_pose_errors(prior, truth, scored),
    )  # fmt: skip


def compare(found: Estimate, test: Trials, scored: Bool[Tensor, " 8"]) -> tuple[Tensor, Tensor]:
    """Return errors [N, 8], and whether the truth is inside the ellipsoids [N, L, 8]; NaN if unscored.

    Args:
        found: by a tracker, with covariances. test: that it was given. scored: joints that count; the
            others are not aligned on.
    """
    inside = test.inside
    truth, estimate = test.truth3d[inside], found.joints3d[inside]
    on = [joint for joint in ALIGN_JOINTS if bool(scored[joint])]
    cov = None if found.covariance3d is None else found.covariance3d[inside]
    aligned = align(estimate, truth, on, covariance=cov)
    errors = joint_errors(aligned.points, truth).masked_fill(~scored, torch.nan)
    if aligned.covariance is None:
        raise RuntimeError("align was given covariances and returned none")
    squared = mahalanobis_squared(aligned.points, aligned.covariance, truth)
    radius = chi2_quantile(torch.tensor(LEVELS, dtype=torch.float64))
    hits = (squared[:, None] <= radius[:, None]).double()
    return errors, hits.masked_fill(~scored, torch.nan)


def mean_pose_errors(
    prior: UpperBodyPrior, truth: Float[Tensor, "N 8 3"], scored: Bool[Tensor, " 8"]
) -> Float[Tensor, "N 8"]:
    """Return the errors of the prior's mean pose, aligned as estimates are; NaN if unscored."""
    on = [joint for joint in ALIGN_JOINTS if bool(scored[joint])]
    still = prior.mean_pose().to(truth).expand_as(truth)
    errors = joint_errors(align(still, truth, on).points, truth)
    return errors.masked_fill(~scored, torch.nan).float()


def log_likelihood(
    prior: UpperBodyPrior, poses: Float[Tensor, "N 8 3"], seed: int = 0
) -> Float[Tensor, " N"]:
    """Return the log density of poses under the mixtures over poses, mean of both arms, nats.

    Every pose is seen from a random viewpoint of the prior's own, as its training poses were.

    Args:
        poses: centred on the neck. seed: the seed of the viewpoints.
    """
    generator = torch.Generator().manual_seed(seed)
    views = sample_viewpoints(len(poses), ViewRange(**prior.info.views), generator)
    left, right = arm_states(poses, views, prior.info.matrix, prior.info.rotation_order)
    return (prior.left.log_prob(left) + prior.right.log_prob(right)) / 2


# --- test sequences -------------------------------------------------------------------------------


def poses_by_rate(
    recordings: Sequence[Recording],
    prior: UpperBodyPrior,
    train: Sequence[Recording] | None,
    name: str,
) -> dict[float, list[Float[Tensor, "T 8 3"]]]:
    """Return complete sequences with the prior's neck, centred on it, by their frames per second.

    Frames with a missing joint cut a recording in two, and pieces below ten frames are left out. A
    neck of another kind is put where the training recordings have theirs (`learn_neck_offset`).

    Args:
        recordings: of a person. prior: that is to track them. train: its training recordings; None
            leaves necks of another kind where they are.
        name: the name of the person, for errors.

    Raises:
        PriorError: another kind of hand than the prior's. InputError: no complete frames.
    """
    pieces = _pieces(recordings, prior, train, name)
    rates = [
        float(r.fps or prior.info.fps or DEFAULT_RATE)
        for r, own in zip(recordings, pieces, strict=True)
        if own
    ]
    pieces = [own for own in pieces if own]
    groups = group_by_rate(rates)
    return {rate: [piece for i in group for piece in pieces[i]] for rate, group in groups.items()}


def _pieces(
    recordings: Sequence[Recording],
    prior: UpperBodyPrior,
    train: Sequence[Recording] | None,
    name: str,
) -> list[list[Tensor]]:
    """Return the sequences of each recording, as `poses_by_rate` has them."""
    bodies = [r.upper_body() for r in recordings]
    hands = {body.hand for body in bodies} - {prior.info.hand}
    if hands:
        hand = str(next(iter(hands)))
        raise PriorError(
            f"{name}: recorded are {hand}s, and the prior has {prior.info.hand}s; score them with a "
            f"prior of {_STANDS_FOR.get(str(prior.info.hand), 'other')}s, or convert them first"
        )
    offset: NeckOffset | None = None
    found = []
    for body in bodies:
        joints = body.joints.double()
        if train is not None and body.neck != prior.info.neck:
            offset = offset or training_neck(train, str(prior.info.neck))
            joints = place_neck(joints, offset)
        found.append([centred_on_neck(piece) for piece in complete_pieces(joints)])
    if not any(found):
        raise _incomplete(name)
    return found


def _incomplete(name: str) -> InputError:
    return InputError(
        f"{name}: no {LEAST_FRAMES} frames in a row have all eight joints; a test needs some"
    )


def training_neck(train: Sequence[Recording], kind: str) -> NeckOffset:
    """Return the mean offset of the neck in the training recordings whose neck is of this kind.

    Raises:
        PriorError: there are fewer than ten such frames.
    """
    bodies = (r.upper_body() for r in train)
    genuine = [body.joints.double() for body in bodies if body.neck == kind]
    return learn_neck_offset(torch.cat(genuine) if genuine else torch.zeros(0, 8, 3))
