"""Fine-tune a prior through its filters, in one process or several.

A batch comes in shares, each drawn from (seed, step, share); processes take the shares rank, rank +
world, ..., and their gradients are averaged, so the steps do not depend on the number of processes.
The score is the error on held-out persons; the parameters with the lowest error are kept.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningDataModule, LightningModule
from torch import Tensor, nn
from torch.optim import Adam
from torch.optim.lr_scheduler import LambdaLR

from torchpose.errors import InputError
from torchpose.io import Recording
from torchpose.learning._curation import CurationSettings
from torchpose.learning._fine_tuning import TunableKalman, TunableWindow, parameter_groups
from torchpose.learning._recipes.calibration import HeldOut, calibration_noise, track_held_out
from torchpose.learning._recipes.choosing import fingerprint
from torchpose.learning._training import collect_poses
from torchpose.priors import UpperBodyPrior, load_prior
from train.checkpoints import ENTRY, check_identity
from train.data import data_of, read_sides
from train.fine_tuning_batches import batches_of
from train.predict_tracking import digest_of_prior
from train.processes import check_processes, from_all, results_of_all

__all__ = ["FineTuning", "FineTuningData"]

_CURATION = CurationSettings()
_CENTIMETRES = 100.0
_MOST_SKIPPED = 20
_POSITIVE = ("epochs", "patience", "batch_size", "shares", "learning_rate", "warmup", "clip")


class _Numbers:
    """Numbers of the steps of an epoch; batches are drawn where they are used."""

    def __init__(self, count: int) -> None:
        self._count = count

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[int]:
        return iter(range(self._count))


class FineTuningData(LightningDataModule):
    """Recordings of 3D joints: persons to tune to, and held-out persons.

    Args:
        paths: folders (with their subfolders) or files; `$NAME` stands for a variable of the
            environment.
        held_out: persons whose error decides when to stop; they are never tuned to.
        persons: whom to tune to, as `origin#person` or just the person; everybody else if None.
        curation: what is left out of the recordings; None takes them as they are.
        axes: of all recordings: camera, kinect, y-up, z-up; by default what each file says.
        steps_per_epoch: batches between two scores on the held-out persons.

    Raises:
        InputError: unknown persons, nobody to tune to or to watch. OverlapError: a person, or a
            recording, is on both sides.
    """

    def __init__(
        self,
        paths: list[str],
        held_out: list[str],
        persons: list[str] | None = None,
        curation: CurationSettings | None = _CURATION,
        axes: str | None = None,
        steps_per_epoch: int = 10,
    ) -> None:
        super().__init__()
        if steps_per_epoch < 1:
            raise InputError(f"steps_per_epoch must be at least 1, got {steps_per_epoch}")
        self.steps_per_epoch = steps_per_epoch
        self.said: list[str] = []
        self.train: list[Recording] = []
        self.watched: list[Recording] = []
        self._paths, self._axes, self._curation = paths, axes, curation
        self._persons, self._held_out = persons, held_out

    def setup(self, stage: str) -> None:
        """Read and split recordings; the second call does nothing."""
        if self.train:
            return
        if not self._held_out:
            raise InputError(
                "fine-tuning stops when persons who are not tuned to are tracked best: name at least "
                "one with --data.init_args.held_out"
            )
        sides = read_sides(self._paths, self._axes, self._persons, self._held_out, self._curation)
        self.train, self.watched, self.said = sides.train, sides.watched, sides.said

    def train_dataloader(self) -> _Numbers:
        """Return the steps of an epoch."""
        return _Numbers(self.steps_per_epoch)

    def val_dataloader(self) -> _Numbers:
        """Return one score for each epoch."""
        return _Numbers(1)

    def identity(self) -> dict[str, Any]:
        """Return settings and digests of the recordings, equal for equal fine-tunings."""
        return {
            "steps per epoch": self.steps_per_epoch,
            "recordings": fingerprint(self.train),
            "held-out recordings": fingerprint(self.watched),
        }


class FineTuning(LightningModule):
    """Tunes a prior by gradients through the filter: its noise, and its mixtures if asked for.

    Logged: `loss` in every step, and in every epoch `held_out`, the 3D error in centimetres, mean over
    the held-out persons. Epoch 0 is the prior as it was; the best epoch is kept.

    Args:
        prior: to start from: a name or a file. It must not have seen the held-out persons.
        part: "poses" tunes the filter over single poses: Q, R, and gamma where the prior has it;
            "causal" or "full" tune a window: the noise of its hands and the likelihood's power.
        mixtures: tune the mixtures of that part as well.
        error, evidence, departure: weights in the loss of the 3D error (decimetres), of the
            log-evidence (nats) and of how far mixtures depart from where they started.
        epochs: at most. patience: epochs without a better score after which it ends.
        batch_size: sequences, or windows, in a batch, over all processes.
        shares: parts of a batch, which are drawn, and shared among processes, one by one; as many
            as processes, or a multiple.
        learning_rate: of Adam, at its highest. warmup: steps until then; from there it falls as a
            half cosine until the last epoch.
        clip: largest norm of the gradient. seed: of batches and of the score.

    Raises:
        InputError: a setting that is not positive, or a batch that cannot be shared evenly.
    """

    def __init__(
        self,
        prior: str,
        part: str = "poses",
        mixtures: bool = False,
        error: float = 1.0,
        evidence: float = 0.0,
        departure: float = 0.01,
        epochs: int = 6,
        patience: int = 3,
        batch_size: int = 32,
        shares: int = 2,
        learning_rate: float = 0.05,
        warmup: int = 5,
        clip: float = 1.0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.save_hyperparameters()
        for name in _POSITIVE:
            if not self.hparams[name] > 0:
                raise InputError(f"{name} must be positive, got {self.hparams[name]}")
        if batch_size % shares:
            raise InputError(
                f"batch_size must be a multiple of shares = {shares}, got {batch_size}"
            )
        self.tuned: Any = nn.Identity()
        self.scores: list[float] = []
        self.skipped = 0
        self._best: dict[str, Tensor] = {}
        self._identity: dict[str, Any] = {}
        self._resumed, self._stopped = False, False

    # --- what Lightning calls

    def setup(self, stage: str) -> None:
        """Set up the filter of the prior, with its numbers as parameters."""
        data = self._data
        data.setup(stage)
        given = self._given
        prior = load_prior(given.prior)
        prior.check_unseen({r.person_id for r in data.watched})
        self._start = [prior]  # in a list: its buffers are none of this module's
        size = given.batch_size // given.shares
        self._batches = batches_of(prior, given.part, data.train, data.watched, size, given.seed)
        options = {name: given[name] for name in ("mixtures", "error", "evidence", "departure")}
        if given.part == "poses":
            self.tuned = TunableKalman(prior, **options)
        else:
            self.tuned = TunableWindow(prior, given.part, **options)
        self._identity = {"model": type(self).__name__, "settings": self.settings}
        self._identity |= {"prior": digest_of_prior(prior)} | data.identity()

    @property
    def _given(self) -> Any:
        return self.hparams

    @property
    def settings(self) -> dict[str, Any]:
        """Return all settings but for the prior to start from."""
        return {k: v for k, v in self._given.items() if k != "prior" and not k.startswith("_")}

    def configure_optimizers(self) -> Any:
        """Return Adam, with a rate that rises for the warm-up and then falls to zero."""
        groups = parameter_groups(self.tuned, self._given.learning_rate)
        adam = Adam(groups, lr=self._given.learning_rate, betas=(0.9, 0.99))
        total = self._given.epochs * self._data.steps_per_epoch

        def rate(step: int) -> float:
            rising = min(1.0, (step + 1) / self._given.warmup)
            return rising * 0.5 * (1 + math.cos(math.pi * min(step, total) / total))

        schedule = {"scheduler": LambdaLR(adam, rate), "interval": "step"}
        return {"optimizer": adam, "lr_scheduler": schedule}

    def configure_gradient_clipping(
        self,
        optimizer: Any,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip by this module's own setting; skip a step whose gradient is not finite."""
        gradients = [p.grad for p in self.parameters() if p.grad is not None]
        if all(bool(torch.isfinite(gradient).all()) for gradient in gradients):
            self.clip_gradients(optimizer, self._given.clip, "norm")
            return
        self.skipped += 1
        optimizer.zero_grad()
        if self.skipped > _MOST_SKIPPED:
            raise InputError(
                f"the gradient was not finite in {self.skipped} steps; choose a lower "
                "--model.init_args.learning_rate"
            )

    def on_train_start(self) -> None:
        """Check that all processes have the same settings, and score the prior as it is."""
        check_processes(self._identity, self.trainer.global_rank)
        if self._given.shares % self.trainer.world_size:
            raise InputError(
                f"{self._given.shares} shares of a batch cannot be shared evenly among "
                f"{self.trainer.world_size} processes; set model.init_args.shares to a multiple"
            )
        if not self._resumed:
            self._score()
            for logger in self.trainer.loggers:
                logger.log_metrics({"held_out": self.scores[0]}, step=0)
        if self._stopped or self.finished:
            self.trainer.should_stop = True

    def training_step(self, batch: int, batch_idx: int) -> Tensor:
        """Return the mean loss over this process' shares of a batch."""
        rank, world = self.trainer.global_rank, self.trainer.world_size
        own = range(rank, self._given.shares, world)
        losses = [self._batches.loss(self.tuned, self.global_step, share) for share in own]
        loss = torch.stack(losses).mean()
        self.log("loss", loss.detach(), on_step=True, sync_dist=True, batch_size=1)
        return loss

    def validation_step(self, batch: int, batch_idx: int) -> None:
        """Score the prior after this epoch."""
        self._score()
        score = torch.tensor(self.scores[-1], dtype=torch.float64)
        self.log("held_out", score, sync_dist=True, batch_size=1)
        if self.finished:
            self.trainer.should_stop = True

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Store the identity of the fine-tuning and the best parameters."""
        checkpoint[ENTRY] = {
            "identity": self._identity,
            "scores": self.scores,
            "best": self._best,
            "skipped": self.skipped,
            "stopped": self.trainer.should_stop,
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse a checkpoint of another fine-tuning, and restore the scores."""
        kept = check_identity(checkpoint.get(ENTRY), self._identity, self.trainer.ckpt_path)
        self.scores, self._best = list(kept["scores"]), dict(kept["best"])
        self.skipped, self._stopped, self._resumed = kept["skipped"], kept["stopped"], True

    # --- how good it is

    @property
    def best_epoch(self) -> int:
        """Return the epoch with the lowest score, counted from 1; 0 is the prior as it was."""
        return min(range(len(self.scores)), key=self.scores.__getitem__)

    @property
    def finished(self) -> bool:
        """Return whether all epochs are over, or the last better score is `patience` epochs ago."""
        over = len(self.scores) - 1
        return over >= self._given.epochs or over - self.best_epoch >= self._given.patience

    def finished_prior(self, **facts: str) -> UpperBodyPrior | None:
        """Return the best prior, calibrated on the held-out persons; None but in the first process.

        They are tracked in every way that the prior allows, before and after, for the model card.
        """
        self.tuned.load_state_dict(self._best)
        prior = self.tuned.prior()
        before, after = self._track(self._start[0]), self._track(prior)
        if self.trainer.global_rank:
            return None
        for name, value in calibration_noise(after).items():
            prior.set_noise(name, value)
        tuning = {
            "from": self._start[0].info.name or Path(self._given.prior).stem,
            "from_command": self._start[0].info.command,
            "from_sha256": self._identity["prior"],
            "settings": self.settings,
            "steps": self.best_epoch * self._data.steps_per_epoch,
            "held_out": sorted({r.person_id for r in self._data.watched}),
            "error_before": {mode: _mean(found) for mode, found in before.items()},
            "error_after": {mode: _mean(found) for mode, found in after.items()},
        }
        prior.info = replace(prior.info, **self._facts(prior, facts, tuning))
        return prior

    def _facts(
        self, prior: UpperBodyPrior, facts: Mapping[str, str], tuning: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Return the fields of `PriorInfo` that the tuning changes."""
        info, recordings = prior.info, [*self._data.train, *self._data.watched]
        seen = collect_poses(recordings, info.neck, info.centre).facts
        both = {
            name: tuple(sorted({*getattr(info, name), *seen[name]}))
            for name in ("persons", "sources")
        }
        given = {name: value for name, value in facts.items() if value}
        # errors of the recipe that the mixtures came from, not of this prior
        of_recipe = ("held_out", "held_out_drawn", "held_out_still")
        extra = {name: value for name, value in info.extra.items() if name not in of_recipe}
        if "calibrated" in extra:
            extra["calibrated"] = sorted(n for n in prior.noise if n.startswith("calibration"))
        return given | both | {"extra": extra | {"fine_tuned": dict(tuning)}}

    @property
    def _data(self) -> FineTuningData:
        return data_of(self, FineTuningData)

    def _score(self) -> None:
        """Score the held-out persons, shared among the processes, and keep the best parameters."""
        own = self._own_persons()
        parts = from_all([self._batches.error(self.tuned, person) for person in own])
        errors = [error for part in parts for error in part]
        score = _CENTIMETRES * math.fsum(errors) / len(errors)
        score = score if math.isfinite(score) else math.inf  # the filter has degenerated
        if not self.scores or score < min(self.scores):
            state = self.tuned.state_dict()
            self._best = {name: value.detach().clone() for name, value in state.items()}
        self.scores.append(score)

    def _own_persons(self) -> list[str]:
        """Return the held-out persons that this process scores."""
        persons = sorted({r.person_id for r in self._data.watched})
        return persons[self.trainer.global_rank :: self.trainer.world_size]

    def _track(self, prior: UpperBodyPrior) -> dict[str, HeldOut]:
        """Track the held-out persons in each way, and return the errors in every process."""
        data, info = self._data, prior.info
        poses = collect_poses(data.watched, info.neck, info.centre, others=data.train)
        persons, seed = self._own_persons(), self._given.seed
        parts = results_of_all(lambda: [track_held_out(prior, poses, {p}, seed) for p in persons])
        return HeldOut.join_modes([part for own in parts for part in own])


def _mean(found: HeldOut) -> float:
    """Return the mean over persons, metres."""
    errors = found.error_by_person().values()
    return round(math.fsum(errors) / len(errors), 5)
