"""Test sequences, reference poses and scores that the benchmarks of upper bodies share."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import Module

from benchmarks import bones
from benchmarks.engine import Experiment
from torchpose.camera import PinholeCamera, project, sample_viewpoints
from torchpose.evaluation._trials import (
    CAMERA,
    Estimate,
    Trials,
    centred_on_neck,
    make_test_set,
    track,
)
from torchpose.io import Recording
from torchpose.learning import TRAINING_VIEWS
from torchpose.learning._training import collect_poses
from torchpose.math import euler_to_matrix
from torchpose.metrics import (
    align,
    coverage,
    jitter,
    joint_errors_2d,
    joint_errors_3d,
    pcp,
    reliability,
)
from torchpose.metrics._calibration import Coverage
from torchpose.metrics._pose_errors import PCP
from torchpose.priors import UpperBodyPrior
from torchpose.skeleton._upper_body import mirror_pose
from torchpose.upper_body._single_poses import default_process_cov

MADE_WITH = (
    "torchpose/camera", "torchpose/filters", "torchpose/math", "torchpose/priors",
    "torchpose/skeleton", "torchpose/upper_body", "torchpose/evaluation/_trials.py",
)  # fmt: skip
"""What the numbers of a tracker depend on beside its facts: files and folders of a checkout."""


class Tracker(NamedTuple):
    """A prior, and the options of the `UpperBodyTracker` that has it."""

    prior: UpperBodyPrior
    options: Mapping[str, Any]


def tracker_facts(test: Trials, tracker: Tracker) -> list[Any]:
    """Return the inputs of a run of a tracker on a test set, beside its seed."""
    prior, options = tracker
    numbers = [value for value in options.values() if isinstance(value, Tensor)]
    numbers += [
        t for v in options.values() if isinstance(v, Module) for t in v.state_dict().values()
    ]
    words = {name: v for name, v in options.items() if not isinstance(v, Tensor | Module)}
    facts = [words, *numbers, prior.info.transition, *prior.state_dict().values()]
    return [*facts, test.keypoints, test.lengths, test.fps, test.names]


def generators_of(test: Trials, seed: int) -> list[torch.Generator]:
    """Return a stream of random numbers for each sequence."""
    n = len(test.lengths)
    return [torch.Generator().manual_seed(seed * n + b) for b in range(n)]


def _track(test: Trials, tracker: Tracker, seeds: Sequence[int]) -> list[Estimate]:
    prior, options = tracker
    return [
        track(prior, CAMERA, test, generator=generators_of(test, seed), **options) for seed in seeds
    ]


TRACKING = Experiment(Estimate, _track, tracker_facts, (*MADE_WITH, "benchmarks/_upper_body.py"))
"""Estimates of a `Tracker` on a test set."""


def with_bones(data: Path, persons: Sequence[str]) -> dict[str, Any] | None:
    """Return the options of the tracker's default, with a prior over arms that does not know these persons.

    The prior over arms that comes with the package was fitted to all sets, the test persons included.

    Args:
        data: folder with all sets, `bones.SETS`; None is returned where one is missing. persons: who is
            tracked.
    """
    if not all((data / name).exists() for name in bones.SETS):
        return None
    return {"method": "multiple-model", "arms": bones.fit_without(data, None, persons)}


def trials_of(recordings: Sequence[Recording], seed: int = 0, **options: Any) -> Trials:
    """Return recordings, centred on their necks, as the test camera measures them.

    Args:
        recordings: of one frame rate. seed: of the noise. options: of `make_test_set`.
    """
    poses = [centred_on_neck(r.upper_body().joints) for r in recordings]
    return make_test_set(poses, CAMERA, recordings[0].fps or 30.0, seed, **options)


def plain_prior(prior: UpperBodyPrior) -> UpperBodyPrior:
    """Return the same mixtures over poses with the paper's transition and `default_process_cov`.

    Without windows, calibration or anything else that a recipe learns.
    """
    noise = {"process_cov": default_process_cov(prior)}
    return UpperBodyPrior(prior.left, prior.right, replace(prior.info, transition="paper"), noise)


def projected_training_poses(
    recordings: Sequence[Recording], camera: PinholeCamera, n: int, seed: int = 0
) -> tuple[Float[Tensor, "n 8 3"], Float[Tensor, "n 8 2"]]:
    """Return poses and their pixels from random training viewpoints, every second one mirrored.

    Args:
        recordings: to draw poses from, each as often as any other. camera: whose pixels.
        n: how many. seed: of viewpoints and order.

    Returns:
        Joints centred on the neck, metres, and pixels, without noise.
    """
    generator = torch.Generator().manual_seed(seed)
    joints = collect_poses(recordings, centre="neck").joints
    joints = joints[torch.isfinite(joints).flatten(1).all(1)]
    rounds = -(-n // len(joints))
    order = [torch.randperm(len(joints), generator=generator) for _ in range(rounds)]
    joints = joints[torch.cat(order)[:n]]
    joints[1::2] = mirror_pose(joints[1::2])
    views = sample_viewpoints(n, TRAINING_VIEWS, generator)
    rotation = euler_to_matrix(views.angles, "zxy")
    return joints, project(joints, camera.matrix, rotation, views.translation)[..., :2]


class Scores(NamedTuple):
    """How good a method is on a test set; NaN where nothing is to be counted.

    Attributes:
        errors3d: metres after fixed-scale Procrustes [B, T, 8]. errors2d: pixels [B, T, 8].
        limbs: curve of correct limbs in the image. jitter: m/s^2 [8], mean over frames.
        coverage: at 50 and 90 %. reliability: at 5 to 95 %. Both None without covariances.
    """

    errors3d: Tensor
    errors2d: Tensor
    limbs: PCP
    jitter: Tensor
    coverage: Coverage | None
    reliability: Coverage | None

    @property
    def mean_error(self) -> float:
        """Return the mean 3D error of all joints and frames, cm."""
        return 100 * float(self.errors3d.nanmean())


def score(estimate: Estimate, test: Trials) -> Scores:
    """Return errors, correct limbs, smoothness and calibration of estimates."""
    inside = test.inside[..., None].expand(*test.inside.shape, 8)
    errors3d = joint_errors_3d(estimate.joints3d, test.truth3d, inside)
    errors2d = joint_errors_2d(estimate.joints2d, test.truth2d, inside)
    limbs = pcp(estimate.joints2d, test.truth2d, mask=inside)
    moved = estimate.joints3d.masked_fill(~inside[..., None], torch.nan)
    triples = (test.lengths - 2).clamp_min(0).double()
    per_sequence = jitter(moved, test.fps) if moved.shape[1] > 2 else torch.full((1, 8), torch.nan)
    per_joint = (per_sequence.nan_to_num() * triples[:, None]).sum(0) / triples.sum()
    if estimate.covariance3d is None:
        return Scores(errors3d, errors2d, limbs, per_joint, None, None)
    aligned = align(estimate.joints3d, test.truth3d, covariance=estimate.covariance3d)
    turned: Any = aligned.covariance
    hits = coverage(aligned.points, turned, test.truth3d, mask=inside)
    curve = reliability(aligned.points, turned, test.truth3d, mask=inside)
    return Scores(errors3d, errors2d, limbs, per_joint, hits, curve)
