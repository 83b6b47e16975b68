"""What `ub_people_levers.py` turns: persons, fits that are kept in files, and the learnt noise."""

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks._upper_body import data_folder, score, trials_of
from torchpose._core.files import atomic_path
from torchpose.camera import ViewRange
from torchpose.evaluation._common import CAMERA, MEASURED, Estimate, Trials, settings_hash
from torchpose.filters import MixtureKalmanFilter
from torchpose.io import Recording, read_recordings
from torchpose.learning import TRAINING_VIEWS, UpperBodyRecipe
from torchpose.learning._recipes import VERSION
from torchpose.priors import GaussianMixture, UpperBodyPrior
from torchpose.priors._window import WindowLayout, WindowPrior
from torchpose.skeleton._upper_body import ARM_JOINTS
from torchpose.upper_body import UpperBodyTracker, pixel_indices
from torchpose.upper_body._methods import process_cov

FIT_PERSONS, SCORED_PERSONS = ("s1", "s2", "s4", "s5"), ("s3", "s6")
MODES: dict[str, dict[str, Any]] = {"causal": {}, "full": {"smoothing": "full"}}
SAMPLES = 120_000
JOINTS = ("hand", "head", "neck")
_CHUNK = 24  # sequences that are tracked at a time


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
    """The training persons of UB-people; files of the test persons are not opened."""
    folder = data_folder(data, "kinect_utd_mhad")
    recordings = read_recordings(_files(folder, FIT_PERSONS)[:: size.thin_fit])
    held_out = read_recordings(_files(folder, SCORED_PERSONS)[:: size.thin_scored])
    test = trials_of(held_out)
    digest = settings_hash([r.joints for r in recordings + held_out])
    return Persons(recordings, test, digest)


def _files(folder: Path, persons: Sequence[str]) -> list[Path]:
    return [
        path for person in persons for path in sorted(folder.glob(f"s{int(person[1:]):02d}_*.npz"))
    ]


class Measured(NamedTuple):
    """Mean 3D error after Procrustes (cm), jitter (m/s^2), CPU seconds of the fit, and a note."""

    error: float
    jitter: float
    seconds: float
    note: str = ""


class Bench:
    """Fits what a lever needs, tracks with it, and keeps both in a folder.

    Args:
        persons: whom to fit and to score. size: of everything. out: folder of fits and results.
    """

    def __init__(self, persons: Persons, size: Size, out: Path) -> None:
        self.persons, self.size, self.out = persons, size, out
        self._results = out / "results.json"

    def known(self) -> dict[str, Measured]:
        """What was measured before, by `key`."""
        if not self._results.is_file():
            return {}
        found = json.loads(self._results.read_text(encoding="utf-8"))
        return {key: Measured(**row["measured"]) for key, row in found.items()}

    def key(self, lever: Lever, mode: str, seed: int) -> str:
        """Changes with whatever a result depends on, but for the code of fit and tracker."""
        facts = lever._replace(group="", name="")
        return self._hash(facts, mode, seed)

    def measure(self, lever: Lever, mode: str, seed: int) -> Measured:
        """Fit what a lever needs, unless it lies in the folder, and track with it."""
        seed += lever.seed_offset
        base, seconds, note = self._base(seed, lever.learnt_noise)
        prior = base
        if lever.windows is not None:
            window, seconds = self._joined_window(base, lever.windows, mode, seed)
            window.settings |= {k: f * window.settings[k] for k, f in lever.factors.items()}
            prior = UpperBodyPrior(base.left, base.right, base.info, base.noise, {mode: window})
        tracker = self._tracker(prior, lever, mode)
        found = score(_estimate(tracker, self.persons.test), self.persons.test)
        error, jitter = 100 * float(found.errors3d.nanmean()), float(found.jitter.mean())
        return Measured(error, jitter, seconds, note)

    def store(self, key: str, lever: Lever, mode: str, seed: int, measured: Measured) -> None:
        """Add a result to those in the folder."""
        results = {}
        if self._results.is_file():
            results = json.loads(self._results.read_text(encoding="utf-8"))
        names = {"group": lever.group, "name": lever.name, "mode": mode, "seed": seed}
        results[key] = names | {"measured": measured._asdict()}
        with atomic_path(self._results) as temporary:
            temporary.write_text(json.dumps(results, indent=1), encoding="utf-8")

    def _hash(self, *facts: Any) -> str:
        return settings_hash([VERSION, self.size, self.persons.digest, *facts])

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

    def _base(self, seed: int, learnt_noise: bool) -> tuple[UpperBodyPrior, float, str]:
        """Mixtures over single poses with the released noise or with learnt noise."""
        path = self.out / f"poses-{self._hash('poses', seed)}.safetensors"
        if not path.is_file():
            start = time.process_time()
            recipe = UpperBodyRecipe(
                self.size.pose_components, self.size.pose_samples, window_components=0,
                calibration_folds=0, seed=seed,
            )  # fmt: skip
            prior = recipe.fit(self.persons.fitted)
            _save(prior, path, fit_seconds=time.process_time() - start)
        prior = UpperBodyPrior.load(path)
        seconds = float(prior.info.extra["fit_seconds"])
        if not learnt_noise:
            return prior, seconds, ""
        path = self.out / f"noise-{self._hash('noise', seed)}.safetensors"
        if not path.is_file():
            start = time.process_time()
            note = learn_noise(prior, self.persons.fitted, self.size, seed)
            _save(prior, path, noise_seconds=time.process_time() - start, note=note)
        prior = UpperBodyPrior.load(path)
        extra = prior.info.extra
        return prior, seconds + float(extra["noise_seconds"]), str(extra["note"])

    def _joined_window(
        self, base: UpperBodyPrior, spec: Windows, mode: str, seed: int
    ) -> tuple[WindowPrior, float]:
        """Mixtures over windows, joined over seeds, and the seconds of their fits."""
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
        recipe = self._window_recipe(spec, seed)
        facts = spec._replace(layouts=None, seeds=1)
        layout = recipe.layouts[mode]
        path = self.out / f"window-{self._hash(facts, layout, mode, seed)}.safetensors"
        if not path.is_file():
            start = time.process_time()
            tasks = recipe.tasks(self.persons.fitted)
            chosen = {key: task for key, task in tasks.items() if key.startswith(mode)}
            fitted = {key: task.fit() for key, task in chosen.items()}
            window = recipe.window(mode, fitted)
            seconds = time.process_time() - start
            prior = UpperBodyPrior(base.left, base.right, base.info, base.noise, {mode: window})
            _save(prior, path, fit_seconds=seconds)
        prior = UpperBodyPrior.load(path)
        return prior.windows[mode], float(prior.info.extra["fit_seconds"])

    def _window_recipe(self, spec: Windows, seed: int) -> UpperBodyRecipe:
        """The recipe with what a lever turns of its windows."""
        return UpperBodyRecipe(
            window_components=spec.components // self.size.shrink,
            window_samples=spec.samples // self.size.shrink,
            window_steps=self.size.em_steps,
            views=spec.views,
            seed=seed,
            **dict(spec.layouts or {}),
            **dict(spec.bodies),
        )


def _save(prior: UpperBodyPrior, path: Path, **extra: Any) -> None:
    prior.info = replace(prior.info, extra=prior.info.extra | extra)
    prior.save(path)


def _joined(mixtures: Sequence[GaussianMixture]) -> GaussianMixture:
    """One mixture of all components, those of each mixture with an equal share."""
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


def learn_noise(prior: UpperBodyPrior, recordings: list[Recording], size: Size, seed: int) -> str:
    """Set Q and R of single poses to those of most log-evidence on some training sequences.

    Adam on the logarithms of the diagonal of Q, one for both arms, and of the variances of hand,
    head and neck, from the noise that the prior has. The sequences are seen as the test is.

    Returns:
        What was gained.
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
    pixels = ", ".join(f"{j} {s:.1f}" for j, s in zip(JOINTS, learnt[rows].tolist(), strict=True))
    return f"log-evidence {gains[0]:.2f} to {gains[-1]:.2f} per frame; R {pixels} px"


def _evidence(
    prior: UpperBodyPrior, test: Trials, process_cov: Tensor, measurement_cov: Tensor
) -> Tensor:
    """Log-evidence of both arms, mean over frames."""
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
