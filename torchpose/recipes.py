"""How the shipped prior is made: mixtures over poses and windows, their noise, their calibration.

`torchpose fit` and the evaluation protocols run this recipe on other recordings or persons.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence
from tqdm.auto import tqdm

from torchpose.calibration import chi2_quantile
from torchpose.camera import ViewRange, sample_viewpoints
from torchpose.errors import InputError
from torchpose.metrics import align
from torchpose.priors.gmm import GaussianMixture
from torchpose.priors.training import TRAINING_VIEWS, RecordingLike, collect_poses
from torchpose.priors.upper_body import (
    UpperBodyPrior,
    fit_upper_body_prior,
    released_process_cov,
)
from torchpose.priors.window import WindowLayout, WindowPrior, window_states
from torchpose.projection import project
from torchpose.rotations import euler_to_matrix
from torchpose.tracking import UpperBodyTracker

__all__ = ["VERSION", "fit_calibration", "fit_kinect_prior"]

VERSION = "2"
"""Changes whenever the recipe does, so that priors cached under an older one are not taken for it."""

LAYOUTS = {
    "causal": WindowLayout((4, 10, 20), (0, 10)),
    "full": WindowLayout((4, 8, 16, -4, -8, -16), (0, 8, -8)),
}
# Chosen on held-out training persons; see the benchmarks page for what each was worth.
_POWER = {"causal": 0.3, "full": 0.25}
_BODY_SIZE, _BONE_LENGTHS, _MIRROR_SHARE = 0.15, 0.10, 0.25
# q/r of the motion stage, 1/s^3: where errors of held-out training persons were least, and a body
# stays as smooth as the Kinect sees it.
_JOINT_RATIO = {"causal": 1e4, "full": 3e4}
_PIXEL_RATIO, _PLACEMENT_RATIO = 1e5, 1e2
_WINDOW_COMPONENTS = 8  # times those over poses
_WINDOW_SAMPLES, _WINDOWS_PER_FRAME = 120_000, 60
_EM_STEPS = 20
_MEASUREMENT_STD = 3.0
_MODES: dict[str, dict[str, Any]] = {
    "pose": {"window": False},
    "causal": {},
    "full": {"smoothing": "full"},
}
_CALIBRATION_VIEWS = 0.5  # of the training views' width: cameras are mostly in front of a person
_CALIBRATION_FRAMES, _CALIBRATION_SEQUENCES = 8000, 48  # in all, and of each group of persons


class _Size(NamedTuple):
    """How large a fit is: components over poses and over windows, windows, and steps of EM."""

    components: int
    window_components: int
    windows: int
    steps: int

    def smaller(self) -> "_Size":
        """Half of everything, for the fits that only serve the calibration."""
        return _Size(*(-(-value // 2) for value in self))


class _Sequences(NamedTuple):
    """Complete, centred recordings: poses [T, 8, 3], frames per second, and persons."""

    poses: list[Tensor]
    rates: list[float]
    persons: list[str]


def fit_kinect_prior(
    recordings: Sequence[RecordingLike],
    n_components: int = 30,
    seed: int = 0,
    views: ViewRange = TRAINING_VIEWS,
    *,
    window_components: int | None = None,
    window_samples: int | None = None,
    calibration_folds: int = 6,
    name: str = "",
    licence: str = "",
    command: str = "",
    progress: bool = False,
    **options: Any,
) -> UpperBodyPrior:
    """Fit the recipe of the shipped prior to recorded 3D poses.

    1. One mixture per arm over single poses (BL section 3.1), and process noise for the filters.
    2. Mixtures per arm over windows: poses with the hands' pixels around them (`WindowPrior`), from
       bodies of varied size, once with the past alone ("causal") and once with both sides ("full").
    3. For each of the three, a scale and a floor per joint that bring the covariances of the 3D
       joints of held-out training persons to their nominal coverage (`fit_calibration`).

    Args:
        recordings: in camera axes (`torchpose.io.read_recordings`).
        n_components: Gaussians per arm over single poses. seed: of everything random.
        views: limits of the random viewpoints. window_components: Gaussians per arm over windows, by
            default eight times as many as over poses; 0 leaves windows out.
        window_samples: training windows, by default 60 for each frame and 120,000 at most.
        calibration_folds: groups of persons that are held out in turn; below 2, or with a single
            person, nothing is calibrated.
        name, licence, command: for `PriorInfo`. progress: whether to show bars.
        options: to `fit_upper_body_prior`.

    Raises:
        InputError, PriorError: as `fit_upper_body_prior`.
    """
    if window_components is None:
        window_components = _WINDOW_COMPONENTS * n_components
    if window_samples is None:
        frames = sum(len(r.upper_body().joints) for r in recordings)
        window_samples = min(_WINDOW_SAMPLES, _WINDOWS_PER_FRAME * frames)
    size = _Size(n_components, window_components, window_samples, _EM_STEPS)
    facts = {"name": name, "licence": licence, "command": command}
    bar = tqdm(total=1 + calibration_folds, disable=not progress, unit="fit", desc="fit")
    prior = _fit(recordings, size, seed, views, **options, **facts)
    bar.update(1)
    sequences = _sequences(recordings, prior)
    folds = _folds(sequences.persons, calibration_folds)
    residuals: dict[str, list[tuple[Tensor, Tensor]]] = {mode: [] for mode in _MODES}
    for held_out in folds:
        seen = [r for r in recordings if r.person_id not in held_out]
        partial = _fit(seen, size.smaller(), seed, views, **options)
        rows = [i for i, person in enumerate(sequences.persons) if person in held_out]
        for mode, settings in _MODES.items():
            if mode == "pose" or mode in partial.windows:
                residuals[mode].append(_residuals(partial, sequences, rows, seed, settings))
        bar.update(1)
    bar.close()
    calibration = _calibration(residuals)
    for key, value in calibration.items():
        prior.set_noise(key, value)
    extra = prior.info.extra | {"recipe": VERSION, "calibrated": sorted(calibration)}
    prior.info = replace(prior.info, extra=extra)
    return prior


def _fit(
    recordings: Sequence[RecordingLike], size: _Size, seed: int, views: ViewRange, **options: Any
) -> UpperBodyPrior:
    """Mixtures and noise, without calibration."""
    base = fit_upper_body_prior(recordings, size.components, seed, views, **options)
    noise = {
        "process_cov": released_process_cov(),
        "measurement_std": torch.full((5,), _MEASUREMENT_STD, dtype=torch.float64),
    }
    windows = {}
    sequences = _sequences(recordings, base)
    if size.window_components and sequences.poses:
        for mode, layout in LAYOUTS.items():
            settings = _window_settings(mode)
            windows[mode] = _fit_window(sequences, layout, base, size, seed, views, settings)
    return UpperBodyPrior(base.left, base.right, base.info, noise, windows)


def _window_settings(mode: str) -> dict[str, float]:
    """Settings of the filter over windows, and of the motion stage behind it."""
    return {
        "hand_std": _MEASUREMENT_STD,
        "likelihood_power": _POWER[mode],
        "joint_ratio": _JOINT_RATIO[mode],
        "pixel_ratio": _PIXEL_RATIO,
        "placement_ratio": _PLACEMENT_RATIO,
    }


def _fit_window(
    sequences: _Sequences,
    layout: WindowLayout,
    base: UpperBodyPrior,
    size: _Size,
    seed: int,
    views: ViewRange,
    settings: dict[str, float],
    *,
    body_size: float = _BODY_SIZE,
    bone_lengths: float = _BONE_LENGTHS,
    mirror_share: float = _MIRROR_SHARE,
) -> WindowPrior:
    generator = torch.Generator().manual_seed(seed)
    states = window_states(
        sequences.poses, sequences.rates, layout, base.info.matrix, views,
        base.info.rotation_order, generator, n_samples=size.windows,
        size=body_size, bones=bone_lengths, mirror_share=mirror_share,
    )  # fmt: skip
    left, right = (
        GaussianMixture.fit(
            states[side], size.window_components, seed=generator, max_iter=size.steps
        )
        for side in ("left", "right")
    )
    # Numbers of single precision change no estimate by a thousandth of a millimetre, and their file
    # has half the size.
    return WindowPrior(left.float().double(), right.float().double(), layout, settings)


def _sequences(recordings: Sequence[RecordingLike], prior: UpperBodyPrior) -> _Sequences:
    """Recordings with the prior's neck and centre; those with missing joints are left out."""
    poses = collect_poses(recordings, prior.info.neck, prior.info.centre).joints
    lengths = [len(r.upper_body().joints) for r in recordings]
    kept = _Sequences([], [], [])
    for recording, sequence in zip(recordings, poses.split(lengths), strict=True):
        if bool(torch.isfinite(sequence).all()):
            kept.poses.append(sequence)
            kept.rates.append(float(recording.fps or prior.info.fps or 30.0))
            kept.persons.append(recording.person_id)
    return kept


def _folds(persons: Sequence[str], n_folds: int) -> list[set[str]]:
    """Groups of persons to hold out in turn; none if there are not enough."""
    distinct = sorted(set(persons))
    n_folds = min(n_folds, len(distinct))
    return [set(distinct[fold::n_folds]) for fold in range(n_folds)] if n_folds > 1 else []


def _calibration(residuals: dict[str, list[tuple[Tensor, Tensor]]]) -> dict[str, Tensor]:
    """Scale and floor of each mode, by the names that the tracker looks for."""
    found = {}
    for mode, parts in residuals.items():
        if parts:
            errors, covs = (torch.cat(values) for values in zip(*parts, strict=True))
            scale, floor = fit_calibration(errors, covs)
            found[f"calibration_scale_{mode}"] = scale
            found[f"calibration_floor_{mode}"] = floor
    return found


def _residuals(
    prior: UpperBodyPrior,
    sequences: _Sequences,
    rows: list[int],
    seed: int,
    settings: dict[str, Any],
) -> tuple[Tensor, Tensor]:
    """Errors [N, 8, 3] after Procrustes and covariances [N, 8, 3, 3] on some sequences."""
    rows = rows[:: max(1, len(rows) // _CALIBRATION_SEQUENCES)]
    keypoints, poses, inside = _held_out_views(prior, [sequences.poses[row] for row in rows], seed)
    tracker = UpperBodyTracker(prior, prior.camera, **settings)
    track = tracker(keypoints, lengths=inside.sum(1))
    aligned = align(track.joints3d[inside], poses[inside], covariance=track.covariance3d[inside])
    if aligned.covariance is None:
        raise RuntimeError("align was given covariances and returned none")
    return aligned.points - poses[inside], aligned.covariance


def _held_out_views(
    prior: UpperBodyPrior, sequences: list[Tensor], seed: int
) -> tuple[Float[Tensor, "B T 8 2"], Float[Tensor, "B T 8 3"], Bool[Tensor, "B T"]]:
    """Noisy keypoints of head, neck and hands, each sequence from a viewpoint of its own."""
    generator = torch.Generator().manual_seed(seed + 1)
    lengths = torch.tensor([len(sequence) for sequence in sequences])
    poses = pad_sequence(sequences, batch_first=True).double()
    inside = torch.arange(poses.shape[1]) < lengths[:, None]
    views = ViewRange(**prior.info.views).scaled(_CALIBRATION_VIEWS)
    view = sample_viewpoints(len(sequences), views, generator)
    rotation = euler_to_matrix(view.angles, prior.info.rotation_order)  # type: ignore[arg-type]
    place = view.translation[:, None]
    uvl = project(poses, prior.info.matrix, rotation[:, None], place)
    noise = torch.randn(uvl[..., :2].shape, generator=generator, dtype=torch.float64)
    keypoints = uvl[..., :2] + _MEASUREMENT_STD * noise
    keypoints[:, :, [1, 2, 5, 6]] = torch.nan
    keypoints[~inside] = torch.nan
    return keypoints, poses, inside


def fit_calibration(
    errors: Float[Tensor, "N J 3"],
    covs: Float[Tensor, "N J 3 3"],
    levels: tuple[float, ...] = (0.5, 0.9),
) -> tuple[Float[Tensor, " J"], Float[Tensor, " J"]]:
    """A scale s and a floor f per joint so that the ellipsoids of s C + f I cover what they say.

    Of a grid of 40 scales and 40 floors, the pair with the least sum of squared differences between
    coverage and level is taken, for each joint.

    Args:
        errors: estimate minus truth, metres. covs: C. levels: of the ellipsoids.

    Returns:
        s [J], without unit, and f [J], square metres.

    Raises:
        InputError: no errors.
    """
    if not len(errors):
        raise InputError("a calibration needs at least one error, got none")
    step = max(1, len(errors) // _CALIBRATION_FRAMES)
    values, vectors = torch.linalg.eigh(covs[::step].double())
    along = (vectors.mT @ errors[::step].double()[..., None])[..., 0].square()
    values = values.clamp_min(1e-12)
    bounds = chi2_quantile(torch.tensor(levels, dtype=torch.float64))
    wanted = torch.tensor(levels, dtype=torch.float64)
    scales = torch.logspace(-1.5, 1.5, 40, dtype=torch.float64)
    floors = torch.cat([torch.zeros(1), torch.logspace(-3.5, -1, 39)]).double().square()
    misses = []
    for scale in scales:
        widths = scale * values[None] + floors[:, None, None, None]
        squared = (along / widths).sum(-1)
        shares = torch.stack([(squared <= bound).double().mean(1) for bound in bounds])
        misses.append((shares - wanted[:, None, None]).square().sum(0))
    best = torch.stack(misses).flatten(0, 1).argmin(0)
    return scales[best // len(floors)], floors[best % len(floors)]
