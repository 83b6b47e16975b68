"""How well a bank of actions tells what somebody does whom it was not fitted on."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.errors import InputError
from torchpose.learning import fit_action_space
from torchpose.priors.actions.bank import ActionBank

__all__ = ["ConfusionTable", "Performed", "recognition_of_unseen"]


class Performed(NamedTuple):
    """A recording or a single performance.

    Attributes:
        person, action: who and what. postures: [T, 36], degrees.
    """

    person: str
    action: str
    postures: Tensor


class ConfusionTable(NamedTuple):
    """What recordings of unseen persons were taken for.

    Attributes:
        truth: the R actions of the rows. columns: the A + 1 states, the last one "none".
        frames: [R, A + 1], mean over frames of the posterior of each frame.
        recordings: [R, A + 1], share of the recordings whose mean posterior over all frames is
            highest there. n_recordings: [R].
    """

    truth: tuple[str, ...]
    columns: tuple[str, ...]
    frames: Tensor
    recordings: Tensor
    n_recordings: Tensor

    def correct(self) -> Float[Tensor, " R"]:
        """Share of each row's recordings that were told rightly: others than the known are none."""
        right = [self.columns.index(a) if a in self.columns else -1 for a in self.truth]
        return self.recordings[torch.arange(len(right)), torch.tensor(right)]


def recognition_of_unseen(
    performances: Sequence[Performed],
    recordings: Sequence[Performed],
    fps: float,
    *,
    n_dimensions: int = 25,
    settings: Mapping[str, Any] | None = None,
) -> ConfusionTable:
    """Leave one person out: fit a bank to everybody else, recognise what the person does.

    Args:
        performances: single performances of the known actions, of several persons.
        recordings: to be recognised, of these and of other actions.
        fps: of all of them. n_dimensions: D of every action.
        settings: of `ActionBank`.

    Raises:
        InputError: no performances or recordings, or an action that one person alone performed.
    """
    known = tuple(dict.fromkeys(p.action for p in performances))
    if not known or not recordings:
        raise InputError("expected performances to learn from and recordings to tell, got none")
    truth = (*known, *sorted({r.action for r in recordings} - set(known)))
    frames = torch.zeros(len(truth), len(known) + 1, dtype=torch.float64)
    taken, count = torch.zeros_like(frames), torch.zeros(len(truth), dtype=torch.float64)
    for person in sorted({r.person for r in recordings}):
        others = [p for p in performances if p.person != person]
        spaces = []
        for action in known:
            postures = [p.postures for p in others if p.action == action]
            if len(postures) < 2:
                raise InputError(
                    f"without {person} there are {len(postures)} performances of {action}; two or "
                    "more are needed"
                )
            spaces.append(fit_action_space(postures, n_dimensions, name=action, fps=fps))
        bank = ActionBank(spaces, **(settings or {}))
        for recording in (r for r in recordings if r.person == person):
            row = truth.index(recording.action)
            mean = bank.recognise(recording.postures, fps).mean(0)
            frames[row] += mean
            taken[row, int(mean.argmax())] += 1
            count[row] += 1
    share = count.clamp_min(1)[:, None]
    return ConfusionTable(truth, bank.names, frames / share, taken / share, count.long())
