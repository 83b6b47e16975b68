"""Outliers among the keypoints: single ones, and many together with exchanged hands.

UB-people: prior of s1 to s6, some sequences of s7 and s8, head, neck and hands measured with 3 pixels of
noise. Tracked as they are, with one keypoint of one frame moved by 100 to a million pixels, and with 5 % of
the keypoints anywhere in the image and hands exchanged in 2 % of the frames; with the search for outliers,
without it, and after a median over five frames.

    python -m benchmarks.outliers --data DIR --out DIR
    python -m benchmarks.outliers --data DIR --out DIR --persons s3 s6 --every 8
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from benchmarks._command import run_command
from benchmarks._data import data_folder
from benchmarks._upper_body import Tracker, score, trials_of, with_bones
from benchmarks.ub_people import TEST_PERSONS, TRAIN_PERSONS
from torchpose._core.files import check_output_folder
from torchpose.evaluation import Report
from torchpose.evaluation._trials import CAMERA, Estimate, Trials, cached_prior
from torchpose.evaluation._unseen import QUICK
from torchpose.io import read_recordings
from torchpose.learning import fit_kinect_prior
from torchpose.metrics import joint_errors
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body import PoseTrack, UpperBodyTracker

SIZES = (1e2, 3e2, 1e3, 1e4, 1e6)
JOINTS = ("head", "neck", "hand_left")
IMAGE = (640.0, 480.0)
_FIRST, _EVERY, _LATER = 15, 20, 3  # frames with an outlier, and how long after it is looked again
_SHARE, _EXCHANGED, _LONGEST = 0.05, 0.02, 5
_HANDS = ("hand_left", "hand_right")
FIT: dict[str, Any] = {"n_components": 10, "window_components": 48, "calibration_folds": 2}
QUICK_FIT: dict[str, Any] = QUICK | {"n_components": 2, "n_samples": 3000, "calibration_folds": 0}


class Options(NamedTuple):
    """What is tracked.

    Attributes:
        data: folder of the recordings.
        out: folder for what is kept, and the report.
        every: take every n-th sequence.
        persons: who is tracked; no other is fitted.
        quick: a tiny prior, to see that it works.
        seed: of the outliers.
        threads: cores.
        progress: show bars.
    """

    data: Path
    out: Path
    every: int = 12
    persons: Sequence[str] = TEST_PERSONS
    quick: bool = False
    seed: int = 0
    threads: int = 2
    progress: bool = False


class Wild(NamedTuple):
    """A test set whose keypoints went wrong.

    Attributes:
        test: with these keypoints. outliers: which of them are none of the joint [B, T, M].
        exchanged: frames in which the hands are [B, T].
    """

    test: Trials
    outliers: Bool[Tensor, "B T M"]
    exchanged: Bool[Tensor, "B T"]


def spoiled(test: Trials, seed: int) -> Wild:
    """Return the test set with 5 % outliers, uniform over the image, and runs of exchanged hands.

    Runs last 1 to 5 frames and cover 2 % of the frames.
    """
    generator = torch.Generator().manual_seed(seed)
    shape = test.keypoints.shape[:3]
    begins = torch.rand(shape[:2], generator=generator) < _EXCHANGED / ((1 + _LONGEST) / 2)
    lasts = torch.randint(1, _LONGEST + 1, shape[:2], generator=generator)
    exchanged = torch.zeros(shape[:2], dtype=torch.bool)
    for b, t in begins.nonzero().tolist():
        exchanged[b, t : t + int(lasts[b, t])] = True
    hands = [test.names.index(name) for name in _HANDS]
    keypoints = test.keypoints.clone()
    keypoints[:, :, hands] = torch.where(
        exchanged[..., None, None], keypoints[:, :, hands[::-1]], keypoints[:, :, hands]
    )
    outliers = torch.rand(shape, generator=generator) < _SHARE
    places = torch.rand(*shape, 2, generator=generator, dtype=torch.float64)
    places = places * torch.tensor(IMAGE, dtype=torch.float64)
    keypoints = torch.where(outliers[..., None], places, keypoints)
    inside = test.inside
    keypoints[~inside] = torch.nan
    return Wild(
        test._replace(keypoints=keypoints), outliers & inside[..., None], exchanged & inside
    )


def one_outlier(
    test: Trials, joint: str, size: float, seed: int
) -> tuple[Trials, Bool[Tensor, "B T"]]:
    """Return the test set in which a joint is so many pixels off in some frames, far apart in time."""
    generator = torch.Generator().manual_seed(seed)
    at = torch.zeros(test.inside.shape, dtype=torch.bool)
    at[:, _FIRST::_EVERY] = True
    at[:, -_LATER:] = False
    at = at & test.inside
    angle = 2 * torch.pi * torch.rand(at.shape, generator=generator, dtype=torch.float64)
    offset = size * torch.stack([angle.cos(), angle.sin()], -1)
    keypoints = test.keypoints.clone()
    keypoints[:, :, test.names.index(joint)] += torch.where(at[..., None], offset, 0.0)
    return test._replace(keypoints=keypoints), at


def median_of_frames(keypoints: Float[Tensor, "B T M 2"], width: int = 5) -> Tensor:
    """Return the median of each coordinate over the frames round each frame, without missing ones."""
    half = width // 2
    padded = torch.nn.functional.pad(keypoints, (0, 0, 0, 0, half, half), value=torch.nan)
    middle = padded.unfold(1, width, 1).nanmedian(-1).values
    return torch.where(keypoints.isfinite(), middle, keypoints)


def track(how: Tracker, test: Trials, outliers: bool) -> PoseTrack:
    """Return the poses of a test set."""
    prior, options = how
    tracker = UpperBodyTracker(
        prior,
        CAMERA,
        fps=test.fps,
        neck=prior.info.neck,
        max_gap=None,
        outliers=outliers,
        **options,
    )
    with torch.inference_mode():
        return tracker(test.keypoints, names=test.names, lengths=test.lengths)


Way = Callable[[Tracker, Trials], PoseTrack]

WAYS: Mapping[str, Way] = {
    "as they are": lambda how, test: track(how, test, False),
    "median of 5 frames": lambda how, test: track(
        how, test._replace(keypoints=median_of_frames(test.keypoints)), False
    ),
    "outliers left out": lambda how, test: track(how, test, True),
}


def add_many(report: Report, trackers: Mapping[str, Tracker], test: Trials, wild: Wild) -> None:
    """Add errors and coverage on keypoints as they come and on those that went wrong."""
    table = report.table(
        "many",
        f"5 % outliers anywhere in the image, hands exchanged in "
        f"{100 * float(wild.exchanged.sum() / test.inside.sum()):.1f} % of the frames",
        ["clean (cm)", "with outliers (cm)", "over the best clean", "clean, inside 50 %", "90 %",
         "with outliers, inside 50 %", "90 %"],
        digits=(3, 3, 3, 0, 0, 0, 0),
    )  # fmt: skip
    for method, how in trackers.items():
        numbers = {}
        for name, way in WAYS.items():
            row: list[float] = []
            for subject in (test, wild.test):
                row += _error_and_coverage(way(how, subject), test)
            numbers[name] = row
        known = test._replace(
            keypoints=torch.where(wild.outliers[..., None], torch.nan, test.keypoints)
        )
        floor = _error_and_coverage(track(how, known, False), test)
        numbers["outliers known"] = [*numbers["as they are"][:3], *floor]
        best = min(row[0] for row in numbers.values())
        for name, row in numbers.items():
            table.add(f"{method}, {name}", [row[0], row[3], row[3] / best, *row[1:3], *row[4:]])
    report.findings.append(
        "'over the best clean' is the error with outliers over the least error on clean keypoints of "
        "the same method; 'outliers known' has what is wrong as missing and no hands exchanged."
    )


def _error_and_coverage(poses: PoseTrack, test: Trials) -> list[float]:
    found = score(Estimate(poses.joints2d, poses.joints3d, poses.covariance3d), test)
    if found.coverage is None:
        raise RuntimeError("a track has covariances")
    return [
        found.mean_error,
        *(100 * float(x) for x in found.coverage.overall),
    ]


def add_found(report: Report, how: Tracker, test: Trials, wild: Wild) -> None:
    """Add the shares of keypoints that are left out."""
    rows = [UPPER_BODY.index(name) for name in test.names]
    table = report.table(
        "found",
        "What is left out (% of the keypoints of a kind)",
        ["clean ones", "good ones beside outliers", "outliers", "outliers more than 1 m away"],
        digits=(3, 3, 1, 1),
        note="Frames with exchanged hands do not count for hands. A metre is what it is at the neck.",
    )
    clean = track(how, test, True)
    poses = track(how, wild.test, True)
    inside = test.inside[..., None]
    distance = (wild.test.keypoints - test.truth2d[:, :, rows]).norm(dim=-1)
    metre = CAMERA.matrix[0, 0] / test.truth3d[..., UPPER_BODY.index("neck"), 2]
    for i, name in enumerate(test.names):
        left_out = [~t.observed[..., rows[i]] for t in (clean, poses)]
        hand = torch.full_like(wild.exchanged, name in _HANDS)
        counted = inside[..., 0] & ~(wild.exchanged & hand)
        outlier = wild.outliers[..., i] & counted
        kinds = [
            left_out[0][inside[..., 0]],
            left_out[1][counted & ~outlier],
            left_out[1][outlier],
            left_out[1][outlier & (distance[..., i] > metre)],
        ]
        table.add(name, [100 * float(kind.double().mean()) for kind in kinds])


def add_single(report: Report, trackers: Mapping[str, Tracker], test: Trials, seed: int) -> None:
    """Add the error that one outlier of each size adds at each joint."""
    table = report.table(
        "single",
        f"One outlier: error added in its frame and {_LATER} frames later (cm)",
        ["mean", "worst", "mean later", "worst later", "as they are: mean", "mean later"],
        digits=(2, 1, 2, 1, 1, 1),
        note="Mean over eight joints; 'worst' over outliers.",
    )
    for method, how in trackers.items():
        base = {found: _errors(track(how, test, found), test) for found in (True, False)}
        everything: dict[bool, list[Tensor]] = {True: [], False: []}
        for joint in JOINTS:
            for size in SIZES:
                wild, at = one_outlier(test, joint, size, seed)
                numbers = {}
                for found, clean in base.items():
                    added = _errors(track(how, wild, found), test) - clean
                    later = added[:, _LATER:][at[:, :-_LATER] & test.inside[:, _LATER:]]
                    numbers[found] = (added[at], later)
                    everything[found].append(torch.stack([added[at].mean(), later.nanmean()]))
                (now, later), (now_without, later_without) = numbers[True], numbers[False]
                row = [now.mean(), now.max(), later.mean(), later.max(), now_without.mean(),
                       later_without.mean()]  # fmt: skip
                table.add(f"{method}, {joint}, {size:,.0f} px", [float(x) for x in row])
        means = torch.stack(everything[True]).mean(0).tolist()
        before = torch.stack(everything[False]).mean(0).tolist()
        report.findings.append(
            f"{method}: one outlier adds {means[0]:.2f} cm in its frame and {means[1]:.2f} cm "
            f"{_LATER} frames later, mean over joints and sizes; without the search {before[0]:,.0f} "
            f"and {before[1]:,.0f} cm."
        )


def _errors(poses: PoseTrack, test: Trials) -> Float[Tensor, "B T"]:
    """Return the mean error of the eight joints in camera axes, wherever the body is put, cm."""
    return 100 * joint_errors(poses.joints3d, test.truth3d).mean(-1)


def main(options: Options) -> None:
    """Fit, track, write the report and print it."""
    torch.set_num_threads(options.threads)
    check_output_folder(options.out)
    make_report(options).save(options.out)
    print((options.out / "report.md").read_text())


def make_report(options: Options) -> Report:
    """Fit and track, and return the report."""
    recordings = read_recordings(data_folder(options.data, "kinect_utd_mhad"))
    everybody = {*TRAIN_PERSONS, *TEST_PERSONS} - {*options.persons}
    fitted = [r for r in recordings if r.person in everybody - {*TEST_PERSONS}]
    test = trials_of([r for r in recordings if r.person in options.persons][:: options.every])
    small = QUICK_FIT if options.quick else FIT
    prior = cached_prior(
        options.out, fitted, fit_kinect_prior, options.progress, seed=0, name="UB-people", **small
    )
    wild = spoiled(test, options.seed)
    facts = {"every": options.every, "persons": options.persons, "seed": options.seed}
    facts |= {"sequences": len(test.lengths), "frames": int(test.lengths.sum()), **small}
    report = Report("Outliers", facts)
    bones = with_bones(options.data, options.persons)
    trackers = {"multiple-model": Tracker(prior, bones)} if bones else {}
    trackers |= {
        "window-mixture": Tracker(prior, {"method": "window-mixture"}),
        "mkf-fixed": Tracker(prior, {"method": "mkf-fixed"}),
    }
    add_many(report, trackers, test, wild)
    add_found(report, next(iter(trackers.values())), test, wild)
    add_single(report, trackers, test, options.seed)
    report.findings.append(
        "A keypoint that is left out costs what a missing one does: the numbers of sizes that are all found "
        "are alike."
    )
    return report


if __name__ == "__main__":
    run_command(main)
