"""Calibrate covariances by a scale and a floor per joint, from persons held out in turn."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from torchpose._core.frame_rates import group_by_rate, same_rate
from torchpose.errors import InputError
from torchpose.filters._lengths import inside_lengths
from torchpose.learning._training import DEFAULT_RATE, PoseSet, seen_keypoints
from torchpose.metrics._calibration import chi2_quantile
from torchpose.metrics._pose_errors import align
from torchpose.priors._upper_body_prior import UpperBodyPrior
from torchpose.upper_body._estimator_table import METHODS
from torchpose.upper_body._fusion import calibration_mode
from torchpose.upper_body._single_poses import PoseFilter
from torchpose.upper_body._upper_body_tracker import UpperBodyTracker

MODES: dict[str, dict[str, Any]] = {
    "pose": {"method": "mkf-fixed"},
    "causal": {"method": "window-mixture"},
    "full": {"method": "window-mixture", "smoothing": "full"},
}
"""The ways of tracking that have a calibration of their own, with their options of the tracker."""

DRAWN = {
    calibration_mode(method): {"method": method}
    for method, made_by in METHODS.items()
    if isinstance(made_by, PoseFilter)
    and method not in {options["method"] for options in MODES.values()}
}
"""The ways that draw samples; they take longer, and are tested on fewer frames."""

STILL = "still"
"""Key of the errors of the mean pose, beside those of the ways of tracking."""

_VIEWS = 0.5  # of the training views' width: cameras are mostly in front of a person
_FRAMES, _SEQUENCES = 8000, 48  # in all, and of each group of persons
# Frames at the prior's rate; pieces at other rates last as long.
_PIECE = 300  # at most, so that one long recording does not pad all others
_SHORT = 60  # frames of a piece for the filters that draw
_NOISE = 3.0  # pixels


class HeldOut(NamedTuple):
    """Holds the errors and covariances from tracking persons whom a fit did not see.

    Attributes:
        errors: estimate minus truth after fixed-scale Procrustes, metres. covs: of the estimates.
        persons: id of each row's person.
    """

    errors: Float[Tensor, "N 8 3"]
    covs: Float[Tensor, "N 8 3 3"]
    persons: list[str]

    @classmethod
    def join(cls, parts: Sequence["HeldOut"]) -> "HeldOut":
        """Join the rows of all parts."""
        errors, covs, persons = zip(*parts, strict=True)
        return cls(torch.cat(errors), torch.cat(covs), [p for part in persons for p in part])

    @classmethod
    def join_modes(cls, parts: Sequence[Mapping[str, "HeldOut"]]) -> dict[str, "HeldOut"]:
        """Join the rows of all parts for each way of tracking."""
        modes = dict.fromkeys(mode for part in parts for mode in part)
        return {mode: cls.join([part[mode] for part in parts if mode in part]) for mode in modes}

    def error_by_person(self) -> dict[str, float]:
        """Return the mean distance over joints and frames of each person, metres."""
        distance = self.errors.norm(dim=-1).mean(-1)
        names = sorted(set(self.persons))
        rows = torch.tensor([names.index(person) for person in self.persons])
        sums = torch.zeros(len(names), dtype=distance.dtype).index_add_(0, rows, distance)
        return dict(zip(names, (sums / rows.bincount()).tolist(), strict=True))


def folds(persons: Sequence[str], n_folds: int) -> list[set[str]]:
    """Return groups of persons to hold out in turn; none if there are not enough."""
    distinct = sorted(set(persons))
    n_folds = min(n_folds, len(distinct))
    return [set(distinct[fold::n_folds]) for fold in range(n_folds)] if n_folds > 1 else []


def track_held_out(
    prior: UpperBodyPrior, poses: PoseSet, persons: set[str], seed: int, drawn_pieces: int = 0
) -> dict[str, HeldOut]:
    """Track recordings of some persons in every way that the prior allows, and score complete frames.

    Each recording is tracked at its own frame rate.

    Args:
        prior: fitted without these persons. poses: of everybody, centred as the prior's are.
        persons: whose recordings are tracked. seed: the seed of viewpoints, noise and what filters draw.
        drawn_pieces: pieces of recordings, of 60 frames at most, for the ways in `DRAWN`.
    """
    usual = float(prior.info.fps or DEFAULT_RATE)
    pieces = _pieces(poses, persons, usual)
    if not pieces:
        return {}
    modes = {mode: s for mode, s in MODES.items() if mode == "pose" or mode in prior.windows}
    found = _track(prior, pieces, modes, seed)
    if drawn_pieces:
        step = max(1, len(pieces) // drawn_pieces)
        few = [
            piece._replace(joints=piece.joints[: _frames(_SHORT, piece.rate, usual)])
            for piece in pieces[::step][:drawn_pieces]
        ]
        found |= _track(prior, few, DRAWN, seed)
    return found


def still_poses(prior: UpperBodyPrior, poses: PoseSet, persons: set[str]) -> HeldOut | None:
    """Return the errors of the prior's mean pose, which looks at nothing, in the frames that are tracked.

    Args:
        prior, poses, persons: see `track_held_out`.

    Returns:
        `HeldOut`, with covariances of zero; None if no frame has all joints.
    """
    pieces = _pieces(poses, persons, float(prior.info.fps or DEFAULT_RATE))
    truth = torch.cat([piece.joints for piece in pieces] or [poses.joints[:0]]).double()
    who = [piece.person for piece in pieces for _ in piece.joints]
    whole = torch.isfinite(truth).flatten(1).all(1)
    if not bool(whole.any()):
        return None
    truth = truth[whole]
    aligned = align(prior.mean_pose().to(truth).expand_as(truth), truth)
    covs = truth.new_zeros(*truth.shape, 3)
    return HeldOut(aligned.points - truth, covs, [who[i] for i in whole.nonzero()[:, 0].tolist()])


class _Piece(NamedTuple):
    """Holds joints [T, 8, 3] of a part of a recording, whose they are, and frames per second."""

    joints: Tensor
    person: str
    rate: float


def _pieces(poses: PoseSet, persons: set[str], usual: float) -> list[_Piece]:
    """Return parts of the recordings of some persons, evenly spread over them."""
    recorded = zip(poses.joints.split(poses.lengths), poses.persons, poses.rates, strict=True)
    pieces = [
        _Piece(joints, person, rate)
        for sequence, person, rate in recorded
        if person in persons
        for joints in sequence.split(_frames(_PIECE, rate, usual))
    ]
    return pieces[:: max(1, len(pieces) // _SEQUENCES)]


def _frames(number: int, rate: float, usual: float) -> int:
    """Return the frames at a rate that last as long as a number of frames at the usual one."""
    return number if same_rate(rate, usual) else max(1, round(number * rate / usual))


def _track(
    prior: UpperBodyPrior, pieces: list[_Piece], modes: Mapping[str, dict[str, Any]], seed: int
) -> dict[str, HeldOut]:
    """Track pieces of recordings in several ways, each at its rate; return errors and covariances."""
    rates = group_by_rate([piece.rate for piece in pieces], prior.info.fps)
    parts = [
        _track_at(prior, [pieces[i] for i in group], modes, seed, rate)
        for rate, group in rates.items()
    ]
    return HeldOut.join_modes(parts)


def _track_at(
    prior: UpperBodyPrior,
    pieces: list[_Piece],
    modes: Mapping[str, dict[str, Any]],
    seed: int,
    fps: float,
) -> dict[str, HeldOut]:
    keypoints, truth, inside = _noisy_keypoints(prior, [piece.joints for piece in pieces], seed)
    scored = inside & torch.isfinite(truth).flatten(2).all(2)
    who = [pieces[i].person for i in scored.nonzero()[:, 0].tolist()]
    found = {}
    for mode, settings in modes.items() if who else ():
        tracker = UpperBodyTracker(prior, prior.camera, calibrated=False, fps=fps, **settings)
        generator = torch.Generator().manual_seed(seed)
        with torch.inference_mode():
            track = tracker(keypoints, lengths=inside.sum(1), generator=generator)
        covs = track.covariance3d[scored]
        aligned = align(track.joints3d[scored], truth[scored], covariance=covs)
        if aligned.covariance is None:
            raise RuntimeError("align was given covariances and returned none")
        found[mode] = HeldOut(aligned.points - truth[scored], aligned.covariance, who)
    return found


def _noisy_keypoints(
    prior: UpperBodyPrior, sequences: list[Tensor], seed: int
) -> tuple[Float[Tensor, "B T 8 2"], Float[Tensor, "B T 8 3"], Bool[Tensor, "B T"]]:
    """Return noisy keypoints of head, neck and hands, each sequence from a viewpoint of its own."""
    generator = torch.Generator().manual_seed(seed + 1)
    lengths = torch.tensor([len(sequence) for sequence in sequences])
    poses = pad_sequence(sequences, batch_first=True).double()
    inside = inside_lengths(lengths, poses.shape[1])
    keypoints = seen_keypoints(poses, prior.info, generator, view_share=_VIEWS, noise_std=_NOISE)
    keypoints[~inside] = torch.nan
    return keypoints, poses, inside


def calibration_noise(held_out: Mapping[str, HeldOut]) -> dict[str, Tensor]:
    """Return scale and floor of each way of tracking, by the names that the tracker looks for."""
    found = {}
    for mode, part in held_out.items():
        scale, floor = fit_calibration(part.errors, part.covs)
        found[f"calibration_scale_{mode}"] = scale
        found[f"calibration_floor_{mode}"] = floor
    return found


def fit_calibration(
    errors: Float[Tensor, "N J 3"],
    covs: Float[Tensor, "N J 3 3"],
    levels: tuple[float, ...] = (0.5, 0.9),
) -> tuple[Float[Tensor, " J"], Float[Tensor, " J"]]:
    """Fit a scale s and a floor f per joint such that ellipsoids of s C + f I have nominal coverage.

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
    step = max(1, len(errors) // _FRAMES)
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
