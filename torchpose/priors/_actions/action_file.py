"""Record what action spaces and banks were fitted on, and name the kinds of their files."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

from torch import Tensor

from torchpose._core.tensor_file import FileKind
from torchpose.priors._actions.polar_limbs import LIMBS_12

_LIMBS = tuple(limb.name for limb in LIMBS_12)


@dataclass(frozen=True)
class ActionInfo:
    """Holds facts about the fit of an action space; fields that are not known are empty.

    Attributes:
        name: the name of the action. fps: of the performances. limbs: that the postures are of.
        performances: how many there were. key_frames: indices of the key postures.
        explained: share of the variance of the postures that the D dimensions hold.
        persons: ids. sources: recordings or data sets. licence: of the data. command: that made it.
        extra: anything else that JSON can hold.
    """

    name: str = ""
    fps: float | None = None
    limbs: tuple[str, ...] = _LIMBS
    performances: int = 0
    key_frames: tuple[int, ...] = ()
    explained: float | None = None
    persons: tuple[str, ...] = ()
    sources: tuple[str, ...] = ()
    licence: str = ""
    command: str = ""
    extra: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class BankInfo:
    """Holds facts about the actions of a bank, and the settings of its recognition.

    Attributes:
        names: the names of the A actions. fps: of their performances. limbs: that the postures are of.
        persons: ids of all persons. stay: probability of doing the same thing a second later.
        spread: factor on the deviations of the training persons, for others. background: factor on
            the deviation of all training postures, for none of the actions. evidence_rate: frames
            per second that count as independent of each other. gate_dimensions: of the D, how many
            the gates look at; None for all.
        licence: of the data. command: that made it. name: the name of the bank. sources: recordings or data
            sets. extra: anything else that JSON can hold.
    """

    names: tuple[str, ...] = ()
    fps: float | None = None
    limbs: tuple[str, ...] = _LIMBS
    persons: tuple[str, ...] = ()
    stay: float = 0.8
    spread: float = 1.0
    background: float = 1.0
    evidence_rate: float = 1.0
    gate_dimensions: int | None = None
    licence: str = ""
    command: str = ""
    name: str = ""
    sources: tuple[str, ...] = ()
    extra: dict[str, Any] = field(default_factory=dict)


SPACE_FILE = FileKind(
    "torchpose-action-space",
    1,
    ActionInfo,
    tensors={
        "mean": "36",
        "basis": "36 D",
        "performance": "K D",
        "std": "K D",
        "match_std": "D",
        "variances": "D",
        "lost_variance": "",
    },
    positive=("std", "match_std"),
)
"""Files of `ActionSpace`."""

BANK_FILE = FileKind(
    "torchpose-action-bank",
    1,
    BankInfo,
    tensors={
        "mean": "A 36",
        "basis": "A 36 D",
        "performance": "A K D",
        "std": "A K D",
        "match_std": "A D",
        "residual_std": "",
        "background_mean": "36",
        "background_axes": "36 36",
        "background_std": "36",
    },
    indices={"n_postures": "A", "n_dimensions": "A"},
    positive=("std", "match_std", "residual_std", "background_std"),
)
"""Files of `ActionBank`."""


class Synchronised(NamedTuple):
    """Holds performances with the same number K of postures.

    Attributes:
        before: [P, K, R], only their lengths normalised. after: [P, K, R], in step.
        key_frames: indices into the K postures, first and last included.
        times: [P, K], frame of each performance that the postures of `after` stand for.
    """

    before: Tensor
    after: Tensor
    key_frames: tuple[int, ...]
    times: Tensor
