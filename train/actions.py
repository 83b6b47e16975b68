"""Fit action spaces, or a bank, with Lightning, in one step.

The fit itself is `torchpose.learning._recipes.actions`.
"""

from typing import Literal

import torch

from torchpose.io._results import ResultsFolder
from torchpose.learning._fit_files import write_action_files
from torchpose.learning._recipes import ActionRecipe, Performances, fit_actions
from torchpose.learning._recipes.actions import FittedActions, check_actions
from torchpose.priors._actions.action_file import BankInfo
from train.body_fit import BodyData, BodyFit

__all__ = ["ActionData", "ActionFit"]


class ActionData(BodyData):
    """Performances of one action or several, and those of held-out persons.

    Args:
        paths: folders (with their subfolders) or files; `$NAME` stands for a variable of the
            environment.
        actions, persons, held_out, without, fps, repeated, postures, axes: see `Performances.gather`.

    Raises:
        InputError: see `Performances.gather`.
    """

    source = Performances

    def __init__(
        self,
        paths: list[str],
        actions: list[str],
        persons: list[str] | None = None,
        held_out: list[str] | None = None,
        without: list[str] | None = None,
        fps: float = 30.0,
        repeated: bool = True,
        postures: Literal["joints", "body"] = "joints",
        axes: str | None = None,
    ) -> None:
        check_actions(actions, fps)
        super().__init__(
            paths=paths, actions=actions, persons=persons, held_out=held_out, without=without,
            fps=fps, repeated=repeated, postures=postures, axes=axes,
        )  # fmt: skip


class ActionFit(BodyFit):
    """Fits an action space to the performances of `ActionData`, or a bank if there are several actions.

    Logged: `explained`, the share of the variance in the D dimensions, and with persons held out
    `accepted`, the share of their postures that pass the gate when j is drawn (AS 6).

    Args:
        n_dimensions, n_postures, prominence, stay, spread, background, evidence_rate, gate_dimensions,
            seed: see `ActionRecipe`.
    """

    data_type, what = ActionData, "actions are"

    def __init__(
        self,
        n_dimensions: int = 13,
        n_postures: int | None = None,
        prominence: float = 0.15,
        stay: float = BankInfo.stay,
        spread: float = BankInfo.spread,
        background: float = BankInfo.background,
        evidence_rate: float = BankInfo.evidence_rate,
        gate_dimensions: int | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.save_hyperparameters()
        self._recipe = ActionRecipe(**self.settings)
        self._fitted: FittedActions | None = None

    def fit_at_once(self) -> dict[str, float]:
        """Fit every action."""
        fitted = self._fit()
        found = {"explained": [s.info.explained or 0.0 for s, _ in fitted.spaces.values()]}
        if fitted.accepted:
            found["accepted"] = list(fitted.accepted.values())
        return {k: float(torch.tensor(v).double().mean()) for k, v in found.items()}

    def write(self, results: ResultsFolder, file: str, pictures: bool, **facts: str) -> str:
        """Write the action space or bank, and pictures of the synchronised performances of each action."""
        return write_action_files(self._fit(), results, file, pictures, **facts)

    def _fit(self) -> FittedActions:
        if self._fitted is None:  # after a resumed run, too, whose step is not done again
            self._fitted = fit_actions(self.gathered, self._recipe)
        return self._fitted
