"""Variants of the tracker of UB-people: persons, kept fits, and learnt noise."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks._data import data_files, data_folder
from benchmarks._upper_body import MADE_WITH, score, trials_of
from benchmarks.engine import kept_prior, kept_runs, source_hash
from torchpose.camera import ViewRange
from torchpose.evaluation._trials import CAMERA, MEASURED, Estimate, Trials, settings_hash
from torchpose.filters import MixtureKalmanFilter
from torchpose.io import Recording, read_recordings
from torchpose.learning import TRAINING_VIEWS, UpperBodyRecipe
from torchpose.priors import GaussianMixture, UpperBodyPrior
from torchpose.priors._window import WindowLayout, WindowPrior
from torchpose.skeleton._upper_body import ARM_JOINTS
from torchpose.upper_body import UpperBodyTracker, pixel_indices
from torchpose.upper_body._estimator_table import process_cov

FIT_PERSONS, SCORED_PERSONS = ("s1", "s2", "s4", "s5"), ("s3", "s6")
MODES: dict[str, dict[str, Any]] = {"causal": {}, "full": {"smoothing": "full"}}
SAMPLES = 120_000
JOINTS = ("hand", "head", "neck")
_CHUNK = 24  # sequences that are tracked at a time
_FITTED_WITH = (
    "torchpose/camera", "torchpose/filters", "torchpose/learning", "torchpose/math", "torchpose/priors",
    "torchpose/skeleton", "benchmarks/_levers.py",
)  # fmt: skip
_TRACKED_WITH = (
    *MADE_WITH,
    "torchpose/learning",
    "benchmarks/_upper_body.py",
    "benchmarks/_levers.py",
)


class Size(NamedTuple):
    """How large the fits are, and how much is tracked: all of it, or enough to see that it works."""

    pose_components: int = 30
    pose_samples: int = 100_000
    shrink: int = 1  # of components and samples of windows
    em_steps: int = UpperBodyRecipe.window_steps
    noise_steps: int = 40
    noise_sequences: int = 32
    thin_fit: int = 1  # every so many recordings are fitted
    thin_scored: int = 3


QUICK = Size(6, 2_000, 20, 3, 2, 2, 40, 60)


class Windows(NamedTuple):
    """What mixtures over windows are fitted with: the recipe's settings, but for what a lever turns.

    Attributes:
        layouts: by mode, or None for the recipe's. components, samples: of each arm.
        views: limits of the viewpoints. bodies: body_size, bone_lengths, mirror_share if not the
            recipe's. seeds: fits of so many seeds are joined into one mixture.
    """

    layouts: Mapping[str, WindowLayout] | None = None
    components: int = 240
    samples: int = SAMPLES
    views: ViewRange = TRAINING_VIEWS
    bodies: tuple[tuple[str, float], ...] = ()
    seeds: int = 1


class Lever(NamedTuple):
    """One change of the default tracker.

    Attributes:
        group, name: where it stands in the table. windows: what is fitted, None for single poses.
        options: of the tracker. factors: of the windows' settings, by name. learnt_noise: of Q and
            R of the filter over single poses. start_factor: of its covariance before the first frame.
        seed_offset: added to the seed of all fits.
    """

    group: str
    name: str
    windows: Windows | None = Windows()
    options: Mapping[str, Any] = {}
    factors: Mapping[str, float] = {}
    learnt_noise: bool = False
    start_factor: float = 1.0
    seed_offset: int = 0


class Persons(NamedTuple):
    """Recordings to fit, the test made of held-out training persons, and a hash of all numbers."""

    fitted: list[Recording]
    test: Trials
    digest: str


def read_persons(data: Path, size: Size) -> Persons:
    """Return the training persons of UB-people; files of the test persons are not opened."""
    folder = data_folder(data, "kinect_utd_mhad")
    recordings = read_recordings(_files(folder, FIT_PERSONS)[:: size.thin_fit])
    held_out = read_recordings(_files(folder, SCORED_PERSONS)[:: size.thin_scored])
    test = trials_of(held_out)
    digest = settings_hash([r.joints for r in recordings + held_out])
    return Persons(recordings, test, digest)


def _files(folder: Path, persons: Sequence[str]) -> list[Path]:
    return data_files(folder, *(f"s{int(person[1:]):02d}_*.npz" for person in persons))


class Measured(NamedTuple):
    """What a row of the table says.

    Attributes:
        error: mean 3D error after Procrustes, cm. jitter: m/s^2. seconds: CPU time of the fit.
        evidence: log-evidence per frame before and after noise is learnt [2], NaN if none is.
        measurement_std: what is learnt for `JOINTS`, pixels [3].
    """

    error: Tensor
    jitter: Tensor
    seconds: Tensor
    evidence: Tensor
    measurement_std: Tensor

    @property
    def note(self) -> str:
        """Return a sentence on the learnt noise, or an empty one."""
        if bool(self.evidence.isnan().any()):
            return ""
        pairs = zip(JOINTS, self.measurement_std.tolist(), strict=True)
        pixels = ", ".join(f"{joint} {std:.1f}" for joint, std in pairs)
        before, after = self.evidence.tolist()
        return f"log-evidence {before:.2f} to {after:.2f} per frame; R {pixels} px"


class Fit(NamedTuple):
    """A prior, and the CPU seconds of its fit."""

    prior: UpperBodyPrior
    seconds: float


class Bench:
    """Fits what a lever needs, tracks with it, and keeps both in a folder.

    Args:
        persons: whom to fit and to score. size: of everything. out: folder of fits and results.
    """

    def __init__(self, persons: Persons, size: Size, out: Path) -> None:
        self.persons, self.size, self.out = persons, size, out

    def measure(self, lever: Lever, mode: str, seed: int) -> Measured:
        """Return the numbers of a lever, from the folder or by a fit and a run of the tracker."""
        facts = [source_hash(*_TRACKED_WITH), self.size, self.persons.digest,
                 lever._replace(group="", name=""), mode]  # fmt: skip

        def make(seeds: Sequence[int]) -> list[Measured]:
            return [self._measure(lever, mode, seed) for seed in seeds]

        (measured,) = kept_runs(self.out, Measured, facts, [seed], make)
        return measured

    def _measure(self, lever: Lever, mode: str, seed: int) -> Measured:
        seed += lever.seed_offset
        base, seconds = self._poses(seed)
        if lever.learnt_noise:
            base, added = self._learnt_noise(base, seed)
            seconds += added
        prior = base
        if lever.windows is not None:
            window, seconds = self._joined_window(base, lever.windows, mode, seed)
            window.settings |= {k: f * window.settings[k] for k, f in lever.factors.items()}
            prior = UpperBodyPrior(base.left, base.right, base.info, base.noise, {mode: window})
        tracker = self._tracker(prior, lever, mode)
        found = score(_estimate(tracker, self.persons.test), self.persons.test)
        unknown = {"evidence": [torch.nan] * 2, "measurement_std": [torch.nan] * len(JOINTS)}
        learnt = base.info.extra.get("learnt_noise", unknown)
        numbers = (
            found.mean_error, float(found.jitter.mean()), seconds,
            learnt["evidence"], learnt["measurement_std"],
        )  # fmt: skip
        return Measured(*(torch.tensor(value, dtype=torch.float64) for value in numbers))

    def _fit(self, name: str, facts: Sequence[Any], make: Callable[[], UpperBodyPrior]) -> Fit:
        """Return a prior from the folder, or fit it and keep it with the seconds that this took."""

        def timed() -> UpperBodyPrior:
            start = time.process_time()
            prior = make()
            seconds = time.process_time() - start
            prior.info = replace(prior.info, extra=prior.info.extra | {"fit_seconds": seconds})
            return prior

        known = [source_hash(*_FITTED_WITH), self.size, self.persons.digest]
        prior = kept_prior(self.out, name, [*known, name, *facts], timed)
        return Fit(prior, float(prior.info.extra["fit_seconds"]))

    def _tracker(self, prior: UpperBodyPrior, lever: Lever, mode: str) -> UpperBodyTracker:
        method = "mkf-fixed" if lever.windows is None else "window-mixture"
        options = {"method": method, "max_gap": None} | MODES[mode]
        options |= {"fps": self.persons.test.fps, "neck": prior.info.neck} | lever.options
        tracker = UpperBodyTracker(prior, CAMERA, **options)
        if lever.start_factor != 1:
            for side in ("left", "right"):
                model = tracker.estimator.filter(side, ("hand", "head", "neck"))
                model.initial_cov = lever.start_factor * model.start_cov  # type: ignore[operator]
        return tracker

    def _poses(self, seed: int) -> Fit:
        """Return mixtures over single poses with the released noise."""
        recipe = UpperBodyRecipe(
            self.size.pose_components, self.size.pose_samples, window_components=0,
            calibration_folds=0, seed=seed,
        )  # fmt: skip
        return self._fit("poses", [seed], lambda: recipe.fit(self.persons.fitted))

    def _learnt_noise(self, prior: UpperBodyPrior, seed: int) -> Fit:
        """Return mixtures over single poses with learnt noise."""
        return self._fit(
            "noise", [seed], lambda: learn_noise(prior, self.persons.fitted, self.size, seed)
        )

    def _joined_window(
        self, base: UpperBodyPrior, spec: Windows, mode: str, seed: int
    ) -> tuple[WindowPrior, float]:
        """Return the mixtures over windows of all seeds as one, and the seconds of their fits."""
        fits = [self._window(base, spec, mode, seed + i) for i in range(spec.seeds)]
        windows = [window for window, _ in fits]
        left, right = (
            _joined([getattr(window, side) for window in windows]) for side in ("left", "right")
        )
        joined = WindowPrior(left, right, windows[0].layout, windows[0].settings)
        return joined, sum(seconds for _, seconds in fits)

    def _window(
        self, base: UpperBodyPrior, spec: Windows, mode: str, seed: int
    ) -> tuple[WindowPrior, float]:
        """Return mixtures over windows of one seed, and the seconds of their fit."""
        recipe = self._window_recipe(spec, seed)
        facts = [spec._replace(layouts=None, seeds=1), recipe.layouts[mode], mode, seed]

        def make() -> UpperBodyPrior:
            tasks = recipe.tasks(self.persons.fitted)
            fitted = {key: task.fit() for key, task in tasks.items() if key.startswith(mode)}
            window = recipe.window(mode, fitted)
            return UpperBodyPrior(base.left, base.right, base.info, base.noise, {mode: window})

        prior, seconds = self._fit("window", facts, make)
        return prior.windows[mode], seconds

    def _window_recipe(self, spec: Windows, seed: int) -> UpperBodyRecipe:
        """Return the recipe with the settings of windows that a lever changes."""
        return UpperBodyRecipe(
            window_components=spec.components // self.size.shrink,
            window_samples=spec.samples // self.size.shrink,
            window_steps=self.size.em_steps,
            views=spec.views,
            seed=seed,
            **dict(spec.layouts or {}),
            **dict(spec.bodies),
        )


def _joined(mixtures: Sequence[GaussianMixture]) -> GaussianMixture:
    """Return one mixture of all components, in which every mixture has an equal share."""
    weights = torch.cat([mixture.weights for mixture in mixtures]) / len(mixtures)
    means = torch.cat([mixture.means for mixture in mixtures])
    return GaussianMixture(weights, means, torch.cat([m.covariances for m in mixtures]))


def _estimate(tracker: UpperBodyTracker, test: Trials) -> Estimate:
    tracks = []
    with torch.inference_mode():
        for start in range(0, len(test.lengths), _CHUNK):
            rows = slice(start, start + _CHUNK)
            keypoints, lengths = test.keypoints[rows], test.lengths[rows]
            tracks.append(tracker(keypoints, names=MEASURED, lengths=lengths))
    joints2d = torch.cat([track.joints2d for track in tracks])
    return Estimate(joints2d, torch.cat([track.joints3d for track in tracks]))


def learn_noise(
    prior: UpperBodyPrior, recordings: list[Recording], size: Size, seed: int
) -> UpperBodyPrior:
    """Set Q and R of single poses to those of most log-evidence on some training sequences.

    Adam on the logarithms of the diagonal of Q, one for both arms, and of the variances of hand,
    head and neck, from the noise that the prior has. The sequences are seen as the test is.

    Returns:
        The prior, whose card holds what was learnt.
    """
    step = max(1, len(recordings) // size.noise_sequences)
    test = trials_of(recordings[::step], seed + 1)
    rows = [ARM_JOINTS.index(joint) for joint in JOINTS]
    std = prior.noise["measurement_std"]
    log_process = process_cov(prior, "left", "mkf-fixed").log().requires_grad_()
    log_measurement = std[rows].square().log().requires_grad_()
    adam = torch.optim.Adam([log_process, log_measurement], lr=0.2)
    gains = []
    for _ in tqdm(range(size.noise_steps), desc="noise", leave=False):
        adam.zero_grad()
        evidence = _evidence(prior, test, log_process.exp(), log_measurement.exp())
        (-evidence).backward()
        adam.step()
        gains.append(float(evidence.detach()))
    learnt = std.clone()
    learnt[rows] = (log_measurement.detach() / 2).exp()
    prior.set_noise("process_cov", log_process.detach().exp())
    prior.set_noise("measurement_std", learnt)
    learning = {"evidence": [gains[0], gains[-1]], "measurement_std": learnt[rows].tolist()}
    prior.info = replace(prior.info, extra=prior.info.extra | {"learnt_noise": learning})
    return prior


def _evidence(
    prior: UpperBodyPrior, test: Trials, process_cov: Tensor, measurement_cov: Tensor
) -> Tensor:
    """Return the log-evidence of both arms, mean over frames."""
    total = torch.zeros((), dtype=torch.float64)
    for side, mixture in (("left", prior.left), ("right", prior.right)):
        rows = [MEASURED.index(name) for name in (f"hand_{side}", "head", "neck")]
        model = MixtureKalmanFilter(
            mixture,
            process_cov,
            measurement_cov.repeat_interleave(2),
            pixel_indices(JOINTS),
            transition=prior.info.transition,
        )
        z = test.keypoints[:, :, rows].flatten(-2)
        total = total + model(z, lengths=test.lengths).log_evidence.sum()
    return total / test.lengths.sum()
