"""Fit of a manifold of poses, a back-constrained GPLVM, to recordings of whole bodies.

An epoch is one step, ten iterations of the optimiser over all poses at once. After each of them the
poses of held-out recordings are sent to the manifold and back; what did best on them is kept.
"""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor, nn

from torchpose.body import Body, body_joints, fit_body, fit_state
from torchpose.curation import pick_persons
from torchpose.curation.duplicates import refuse_shared_recordings
from torchpose.errors import InputError
from torchpose.io import Recording, find_recordings, read_recordings
from torchpose.priors.gplvm import BackConstrainedGPLVM
from torchpose.priors.gplvm_fit import GPLVMFit, median_gamma
from torchpose.priors.manifold_file import ManifoldInfo
from torchpose.priors.pose_sequences import column_scale, join_sequences, thin
from train.body_fit import BodyFit, recording_name
from train.data import expand_path, fingerprint

__all__ = ["ManifoldData", "ManifoldFit"]

_SAME_RATE = 0.02  # of the frame rate that is asked for


class ManifoldData(LightningDataModule):
    """Poses of one motion of one person or several, and of other recordings of the same persons.

    Args:
        paths: folders (with their subfolders) or files; `$NAME` stands for a variable of the
            environment.
        persons: whose, as `origin#person` or just the person; everybody if None.
        validation: recordings of each person that are not fitted to, the last ones by name.
        without: names of files, without their suffix, that are on neither side.
        fps: frame rate of the poses to be tracked; recordings of a multiple of it are thinned out.
        frames: that are fitted to at most, spread evenly over the recordings.
        axes: of all recordings: camera, kinect, y-up, z-up; by default what each file says.

    Raises:
        InputError: unknown persons or files, a person with too few recordings, a frame rate that is
            no multiple of `fps`, a joint that is missing in some frames.
    """

    def __init__(
        self,
        paths: list[str],
        persons: list[str] | None = None,
        validation: int = 2,
        without: list[str] | None = None,
        fps: float = 60.0,
        frames: int = 350,
        axes: str | None = None,
    ) -> None:
        super().__init__()
        if validation < 1 or frames < 10 or not 0 < fps < math.inf:
            raise InputError(
                "validation must be at least 1, frames at least 10 and fps positive, got "
                f"{validation}, {frames} and {fps:g}"
            )
        self.fps = fps
        self.train: list[Tensor] = []
        self.watched: list[Tensor] = []
        self.info = ManifoldInfo()
        self._paths, self._persons, self._without = paths, persons, without or []
        self._validation, self._frames, self._axes = validation, frames, axes
        self._recordings: dict[str, list[Recording]] = {"train": [], "watched": []}

    def setup(self, stage: str) -> None:
        """Read, split, and turn joints into poses; the second call does nothing."""
        if self.train:
            return
        people = self._people()
        bodies: list[Body] = []
        for person, recordings in people.items():
            fitted, watched = self._split(person, recordings)
            refuse_shared_recordings(fitted, watched)
            body = fit_body(torch.cat([_joints(r) for r in fitted]))
            self.train += [_poses(body, r, self.fps) for r in fitted]
            self.watched += [_poses(body, r, self.fps) for r in watched]
            self._recordings["train"] += fitted
            self._recordings["watched"] += watched
            bodies.append(body)
        self.train = thin(self.train, self._frames)
        self.info = self._facts(bodies[0])

    def train_dataloader(self) -> range:
        """One step an epoch."""
        return range(1)

    def identity(self) -> dict[str, Any]:
        """What makes a fit the same one."""
        return {
            "fps": self.fps,
            "frames": self._frames,
            "poses": _digest(self.train),
            "recordings": fingerprint(self._recordings["train"]),
            "held-out recordings": fingerprint(self._recordings["watched"]),
        }

    def _people(self) -> dict[str, list[Recording]]:
        files = find_recordings([expand_path(path) for path in self._paths])
        unknown = sorted(set(self._without) - {file.stem for file in files})
        if unknown:
            raise InputError(f"without: no file named {', '.join(unknown)} among the recordings")
        recordings = read_recordings([f for f in files if f.stem not in self._without], self._axes)
        recordings = [r for r in recordings if not r.companion]
        known = sorted({r.person_id for r in recordings})
        wanted = known if self._persons is None else sorted(pick_persons(self._persons, known))
        return {person: [r for r in recordings if r.person_id == person] for person in wanted}

    def _split(
        self, person: str, recordings: list[Recording]
    ) -> tuple[list[Recording], list[Recording]]:
        if len(recordings) <= self._validation:
            raise InputError(
                f"{person} has {len(recordings)} recordings, and {self._validation} of them are to be "
                "held out; lower --data.init_args.validation or add recordings"
            )
        return recordings[: -self._validation], recordings[-self._validation :]

    def _facts(self, body: Body) -> ManifoldInfo:
        fitted = self._recordings["train"]
        return ManifoldInfo.of_body(
            body,
            fps=self.fps,
            persons=tuple(sorted({r.person_id for r in fitted})),
            actions=tuple(sorted({r.action for r in fitted if r.action})),
            sources=tuple(sorted({r.source or str(r.path) for r in fitted})),
            sequences=tuple(r.person_id if _several(fitted) else recording_name(r) for r in fitted),
        )


class ManifoldFit(BodyFit):
    """Fits a back-constrained GPLVM to the poses of `ManifoldData`.

    Logged in each step: `log_likelihood`, the objective (MR 16) before it, per number of the poses;
    `held_out`, the root mean square of x - f(g(x)) over the held-out poses after it.

    Args:
        latent_dim: d. gamma_x: of (MR 22); by default from the median distance of the poses.
        optimiser: "lbfgs" or "adam". learning_rate: None for the optimiser's own.
        steps: of ten iterations, at most. patience: steps without a better held-out error after
            which it ends.
        start: which principal components to start from: 0 the first ones, see `principal_start`.
        smoothness: see `GPLVMFit`. standardise: see `BackConstrainedGPLVM.fit`.
        seed: of the frames whose distances give gamma_x, where there are very many.
        picture: draw the latent space beside the file.

    Raises:
        InputError: a setting that is not positive.
    """

    data_type, what = ManifoldData, "a manifold is"

    def __init__(
        self,
        latent_dim: int = 2,
        gamma_x: float | None = None,
        optimiser: str = "lbfgs",
        learning_rate: float | None = None,
        steps: int = 40,
        patience: int = 3,
        start: int = 0,
        smoothness: float = 0.0,
        standardise: bool = False,
        seed: int = 0,
        picture: bool = True,
    ) -> None:
        super().__init__()
        self.save_hyperparameters()
        for name, least in (("steps", 1), ("patience", 1), ("start", 0)):
            if self.hparams[name] < least:
                raise InputError(f"{name} must be at least {least}, got {self.hparams[name]}")
        self.fit: Any = nn.Identity()
        self._stopped = False

    # --- what Lightning calls

    def setup(self, stage: str) -> None:
        """The fit at its start; a checkpoint's state comes later."""
        _check_trainer(self.trainer)
        super().setup(stage)
        data, given = self._data, self._given
        self._poses, self._lengths = join_sequences(data.train, data.info.columns)
        same = torch.ones_like(self._poses[0])
        self._scale = column_scale(self._poses) if given.standardise else same
        target = (self._poses - self._poses.mean(0)) / self._scale
        gamma = median_gamma(target, given.seed) if given.gamma_x is None else given.gamma_x
        self.fit = GPLVMFit(
            target, given.latent_dim, gamma, given.optimiser, given.learning_rate,
            given.smoothness, start=given.start,
        )  # fmt: skip

    def on_train_start(self) -> None:
        """Nothing is left to do if the fit was resumed after its last step."""
        if self._stopped or self.finished:
            self.trainer.should_stop = True

    def training_step(self, batch: int, batch_idx: int) -> None:
        """One step, and what it did to the held-out poses."""
        value = self.fit.step()
        self.fit.note(self.held_out_error())
        scores = self.fit.scores
        found = {"step": len(scores), "log_likelihood": value, "held_out": scores[-1]}
        self.log_dict({k: torch.tensor(float(v)).double() for k, v in found.items()}, on_step=True)
        if self.finished:
            self.trainer.should_stop = True

    def progress_made(self) -> dict[str, Any]:
        """Whether the fit had come to its end."""
        return {"stopped": self.trainer.should_stop}

    def go_on_from(self, kept: dict[str, Any]) -> None:
        """Stop at once if it had."""
        self._stopped = bool(kept["stopped"])

    # --- what comes of it

    @property
    def finished(self) -> bool:
        """Whether all steps are taken, or the last better score is too long ago."""
        taken = len(self.fit.scores)
        over = taken - self.fit.best_step
        return taken >= self._given.steps or over >= self._given.patience

    def manifold(self, **facts: str) -> BackConstrainedGPLVM:
        """The best manifold, its standard deviations from the held-out poses.

        Args:
            facts: name, licence, command; those that are empty are left out.
        """
        self.fit.restore_best()
        data = self._data
        given: dict[str, Any] = {name: value for name, value in facts.items() if value}
        found = self._current()
        found.fit_noise(data.watched, data.fps)
        extra = {
            "settings": self.settings,
            "steps": self.fit.best_step,
            "held_out_error": min(self.fit.scores),
            "held_out_frames": sum(len(poses) for poses in data.watched),
        }
        found.info = replace(found.info, **given, extra=extra)
        return found

    def finished_prior(self, **facts: str) -> None:
        """Write the manifold where a prior's file would be; there is no prior to be calibrated."""
        out = self.written_to
        if out is None:
            return
        manifold = self.manifold(**facts)
        manifold.save(out)
        written = [out]
        if self._given.picture:
            written.append(_draw(manifold, self._data.watched, out.with_suffix(".png")))
        print(self._summary(manifold, written), flush=True)

    def _summary(self, manifold: BackConstrainedGPLVM, written: Sequence[Path]) -> str:
        persons = ", ".join(manifold.info.persons)
        return (
            f"{manifold.info.name}: {len(manifold.poses)} frames of {persons}, best after "
            f"{self.fit.best_step} of {len(self.fit.scores)} steps; held-out poses come back to within "
            f"{min(self.fit.scores):.4f} (root mean square of a column)\n"
            f"wrote {', '.join(map(str, written))}"
        )

    def held_out_error(self) -> float:
        """Root mean square of x - f(g(x)) over the held-out poses, as the fit stands."""
        return self._current().reconstruction_error(torch.cat(self._data.watched))

    def _current(self) -> BackConstrainedGPLVM:
        fit, info = self.fit, self._data.info
        return BackConstrainedGPLVM.from_fit(
            fit, self._poses, self._lengths, self._scale, info
        ).cpu()


def _check_trainer(trainer: Any) -> None:
    if trainer.strategy.root_device.type == "mps":
        raise InputError(
            "a fit needs double precision, which MPS does not have; add --trainer.accelerator cpu"
        )
    if trainer.precision not in ("32-true", "64-true"):
        raise InputError(
            f"a fit runs in double precision, got --trainer.precision {trainer.precision}; leave it out"
        )


def _joints(recording: Recording) -> Tensor:
    return body_joints(recording.joints, recording.names)


def _poses(body: Body, recording: Recording, fps: float) -> Tensor:
    """Poses of a recording at a frame rate."""
    if recording.fps is None:
        raise InputError(
            f"{recording_name(recording)}: the file does not say its frame rate, which is needed"
        )
    every = max(1, round(recording.fps / fps))
    if abs(recording.fps / every / fps - 1) > _SAME_RATE:
        raise InputError(
            f"{recording_name(recording)}: {recording.fps:g} frames per second are no multiple of "
            f"{fps:g}; set --data.init_args.fps to {recording.fps / every:g}"
        )
    try:
        return body.relative(fit_state(body, _joints(recording)[::every])).detach()
    except InputError as error:
        raise InputError(f"{recording_name(recording)}: {error}") from error


def _several(recordings: Sequence[Recording]) -> bool:
    return len({r.person_id for r in recordings}) > 1


def _digest(poses: Sequence[Tensor]) -> str:
    digest = hashlib.sha256()
    for part in poses:
        digest.update(part.numpy().round(9).tobytes())
    return digest.hexdigest()


def _draw(manifold: BackConstrainedGPLVM, watched: Sequence[Tensor], path: Path) -> Path:
    from torchpose.viz import save_figure
    from torchpose.viz.manifold_picture import plot_manifold

    return save_figure(plot_manifold(manifold, {"held out": list(watched)[:1]}), path)
