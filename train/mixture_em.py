"""Fit all mixtures of a recipe at once by exact expectation-maximisation, in one process or several.

An epoch is one EM step. Each process sums up the sufficient statistics of its share of the blocks,
one exchange at the end of the epoch adds up the sums of all processes, and each of them makes the
same maximisation step. There are no gradients and no optimisers.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import torch
from lightning.pytorch import LightningModule
from torch import nn
from torch.optim import Optimizer

from torchpose.errors import InputError, TorchposeError
from torchpose.learning._blocks import Share
from torchpose.learning._recipes import MixtureTask
from torchpose.learning._recipes.calibration import folds
from torchpose.learning._stepwise_em import stepwise_pass
from torchpose.learning._streamed_em import StreamedEM
from torchpose.math._mixture_em import SufficientStatistics
from torchpose.priors import GaussianMixture, UpperBodyPrior
from train.blocks import Key, Sweep
from train.checkpoints import ENTRY, check_identity
from train.data import RecordingsDataModule, check_double_precision, data_of
from train.processes import broadcast_state, check_processes, results_of_all

__all__ = ["MixtureEM"]


class MixtureEM(LightningModule):
    """Fits the mixtures of `RecordingsDataModule.tasks` by exact EM.

    After the same number of steps the mixtures are the same, up to the rounding of sums, from any
    number of processes, with or without an interruption, and from `torchpose fit`.

    Logged in each step, all of the mixtures as they were before it: `log_likelihood/NAME` and
    `held_out/NAME`, means over the states in nats, and `log_likelihood` and `held_out`, their means
    over the mixtures.

    Args:
        first_pass: go once over the states by stepwise (online) EM before the first exact step,
            which is worth several exact ones where there are very many states.
    """

    def __init__(self, first_pass: bool = False) -> None:
        super().__init__()
        self._first_pass = first_pass
        self.automatic_optimization = False
        self.mixtures = nn.ModuleDict()
        self.held_out_history: dict[str, list[float]] = {}
        self._tasks: dict[str, MixtureTask] = {}
        self._identity: dict[str, Any] = {}
        self._whole: dict[str, tuple[int, GaussianMixture]] = {}  # and the length of its history
        self._resumed, self._stopped = False, False

    # --- what Lightning calls

    def setup(self, stage: str) -> None:
        """Create a blank mixture for every task, to be filled by a start or a checkpoint."""
        check_double_precision(self.trainer)
        data = self._data
        data.setup(stage)
        self._tasks, self._identity = data.tasks, data.identity()
        self._identity |= {"model": type(self).__name__, "first pass": self._first_pass}
        self.mixtures = nn.ModuleDict(
            {
                _module_name(name): StreamedEM.blank(task.n_components, task.source.dim)
                for name, task in self._tasks.items()
            }
        )

    def on_fit_start(self) -> None:
        """Check that all processes have the same recordings, and start every mixture."""
        check_processes(self._identity, self.trainer.global_rank)
        if not self._resumed:
            self._start()

    def on_train_start(self) -> None:
        """Stop if the fit was resumed after its last step."""
        if self._stopped or self.finished:
            self.trainer.should_stop = True

    def configure_optimizers(self) -> Sequence[Optimizer]:
        """Return none: the maximisation step is in closed form."""
        return []

    def training_step(self, batch: Sweep, batch_idx: int) -> None:
        """Take one EM step."""
        totals = self._exchange(batch)
        for name, task in self._tasks.items():
            em = self.em(name)
            if Key(name, held_out=True) in totals:
                value = em.mean_log_likelihood(totals[Key(name, held_out=True)])
                self.held_out_history.setdefault(name, []).append(value)
            if Key(name) not in totals:
                continue
            if int(em.steps) >= task.max_iter:
                em.record(totals[Key(name)], task.tol)
            else:
                em.maximise(totals[Key(name)], task.tol)
        self._log_likelihoods()
        if self.finished:
            self.trainer.should_stop = True

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Store the identity and the progress of the fit."""
        checkpoint[ENTRY] = {
            "identity": self._identity,
            "held_out": self.held_out_history,
            "stopped": self.trainer.should_stop,
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse a checkpoint of another fit, and restore the progress."""
        kept = check_identity(checkpoint.get(ENTRY), self._identity, self.trainer.ckpt_path)
        self.held_out_history = {name: list(v) for name, v in kept["held_out"].items()}
        self._stopped = bool(kept["stopped"])
        self._resumed = True

    # --- where the fit stands

    def em(self, name: str) -> StreamedEM:
        """Return the fit of one mixture."""
        return cast(StreamedEM, self.mixtures[_module_name(name)])

    @property
    def histories(self) -> dict[str, list[float]]:
        """Return the mean log-likelihood of each mixture before every step, and at its end."""
        return {name: self.em(name).history.tolist() for name in self._tasks}

    @property
    def finished(self) -> bool:
        """Return whether every mixture has converged or taken all of its steps."""
        return all(self._is_finished(name) for name in self._tasks)

    def epoch_of(self, key: Key) -> int | None:
        """Return how many steps the mixture of a source has taken; None if it needs no more."""
        return None if self._is_finished(key.name) else int(self.em(key.name).steps)

    def assembled(self, **facts: str) -> UpperBodyPrior:
        """Return the prior of the mixtures as they are, not calibrated; facts are name, licence, command."""
        for name, task in self._tasks.items():
            length = len(self.em(name).history)
            if self._whole.get(name, (-1, None))[0] != length:
                self._whole[name] = length, task.whole(self.em(name).mixture().cpu())
        whole = {name: mixture for name, (_, mixture) in self._whole.items()}
        return self._data.recipe.assemble(self._data.train, whole, **facts)

    def finished_prior(self, **facts: str) -> UpperBodyPrior | None:
        """Return the calibrated prior in the first process, None in the others; all have to call it.

        The groups of persons that are held out in turn are shared among the processes.
        """
        data, trainer = self._data, self.trainer
        groups = folds([r.person_id for r in data.train], data.recipe.calibration_folds)
        mine = range(trainer.global_rank, len(groups), trainer.world_size)
        parts: dict[int, Any] = {}
        for share in results_of_all(
            lambda: {i: data.recipe.hold_out(data.train, groups[i]) for i in mine}
        ):
            parts |= share
        if not trainer.is_global_zero:
            return None
        prior = data.recipe.finish(self.assembled(**facts), [parts[i] for i in range(len(groups))])
        prior.info = replace(prior.info, extra=prior.info.extra | data.facts())
        return prior

    # --- one step

    def _is_finished(self, name: str) -> bool:
        em, task = self.em(name), self._tasks[name]
        recorded = len(em.history) > int(em.steps)
        return bool(em.converged) or (int(em.steps) >= task.max_iter and recorded)

    def _sweep(self, sweep: Sweep) -> dict[Key, SufficientStatistics]:
        """Sum the statistics over this process' share."""
        sums: dict[Key, SufficientStatistics] = {}
        for key, samples in sweep:
            found = self.em(key.name).expect(samples)
            sums[key] = sums[key].merge(found) if key in sums else found
        return sums

    def _exchange(self, sweep: Sweep) -> dict[Key, SufficientStatistics]:
        """Sum the statistics over all processes, in a single exchange."""
        wanted = [key for key in self._data.sources if self.epoch_of(key) is not None]
        blank = {
            key: SufficientStatistics.zeros(
                self._tasks[key.name].n_components, self.em(key.name).means.shape[1], self.device
            )
            for key in wanted
        }
        share = Share.of_processes()
        with share.failing_together(torch.cat([blank[key].pack() for key in wanted])):
            mine = blank | self._sweep(sweep)
        packed = [mine[key].pack() for key in wanted]
        sums = share.total(torch.cat(packed)).split([len(p) for p in packed])
        return {
            key: SufficientStatistics.unpack(part, self._tasks[key.name].n_components)
            for key, part in zip(wanted, sums, strict=True)
        }

    def _log_likelihoods(self) -> None:
        """Log the last value of every mixture; a finished one keeps its last."""
        step = max((len(history) for history in self.histories.values()), default=0)
        found = {"log_likelihood": self.histories, "held_out": self.held_out_history}
        values = {"step": float(step)}
        for kind, histories in found.items():
            last = {name: history[-1] for name, history in histories.items() if history}
            values |= {f"{kind}/{name}": value for name, value in last.items()}
            if last:
                values[kind] = sum(last.values()) / len(last)
        self.log_dict({k: torch.tensor(v).double() for k, v in values.items()}, on_step=True)

    # --- before the first step

    @property
    def _data(self) -> RecordingsDataModule:
        return data_of(self, RecordingsDataModule)

    def _start(self) -> None:
        """Start every mixture, shared among the processes."""
        rank, world = self.trainer.global_rank, self.trainer.world_size

        def start() -> None:
            for name in list(self._tasks)[rank::world]:
                self._start_one(name)

        results_of_all(start)
        for number, (name, task) in enumerate(self._tasks.items()):
            broadcast_state(self.em(name), number % world)
            if self._first_pass:
                source, share = self._data.sources[Key(name)], Share.of_processes()
                stepwise_pass(self.em(name), source, task.seed, share=share)

    def _start_one(self, name: str) -> None:
        task = self._tasks[name]
        try:
            em = StreamedEM.start(self._data.sources[Key(name)], task.n_components, task.seed)
        except TorchposeError as error:
            raise InputError(f"mixture {name!r}: {error}") from error
        self.em(name).load_state_dict(em.state_dict())


def _module_name(name: str) -> str:
    return name.replace(".", "_")  # torch has dots between the names of modules
