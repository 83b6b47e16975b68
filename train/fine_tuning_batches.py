"""Draw the batches of fine-tuning, and the fixed views of held-out persons.

A batch is all the shares of a step. A share is a function of the seed, its step and its number, so any
process can draw it.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol

import torch
from torch import Tensor

from torchpose.camera import ViewRange
from torchpose.errors import InputError
from torchpose.io import Recording
from torchpose.learning._curation.joints import measured, runs
from torchpose.learning._fine_tuning import (
    TunableKalman,
    TunableWindow,
    WindowBatch,
    draw_sequences,
    draw_windows,
)
from torchpose.learning._recipes import UpperBodyRecipe
from torchpose.learning._samplers import WindowSource, derived_seed
from torchpose.learning._streamed_em import ColumnsSource
from torchpose.learning._training import collect_poses
from torchpose.priors import UpperBodyPrior

__all__ = ["Batches", "SequenceBatches", "WindowBatches", "batches_of"]

_HELD_OUT_VIEWS = 0.5  # of the training views' width: cameras are mostly in front of a person
_HELD_OUT_SEQUENCES, _HELD_OUT_WINDOWS = 32, 2048
_LEAST_FRAMES = 10  # of a part of a recording between frames with missing joints


class Batches(Protocol):
    """Training data of one kind of filter."""

    def loss(self, tuned: Any, step: int, share: int) -> Tensor:
        """Return the loss on one share of a batch; all shares count the same."""
        ...

    def error(self, tuned: Any, person: str) -> float:
        """Return the mean 3D error on a held-out person, metres, always on the same views."""
        ...


def batches_of(
    prior: UpperBodyPrior,
    part: str,
    train: Sequence[Recording],
    watched: Sequence[Recording],
    share_size: int,
    seed: int,
) -> Batches:
    """Return the data to tune the filter over single poses ("poses") or over a window.

    Args:
        prior: that is tuned. part: "poses", or the name of one of its windows.
        train, watched: recordings to tune to, and of held-out persons.
        share_size: sequences or windows in a share. seed: of everything random.

    Raises:
        InputError: no such part, or no complete recordings of somebody.
    """
    if part == "poses":
        return SequenceBatches(prior, train, watched, share_size, seed)
    if part not in prior.windows:
        known = ", ".join(["poses", *prior.windows])
        raise InputError(f"part must be one of {known}, got {part!r}")
    return WindowBatches(prior, part, train, watched, share_size, seed)


class SequenceBatches:
    """Pieces of sequences, for `TunableKalman`."""

    def __init__(
        self,
        prior: UpperBodyPrior,
        train: Sequence[Recording],
        watched: Sequence[Recording],
        share_size: int,
        seed: int,
    ) -> None:
        self._prior, self._size, self._seed = prior, share_size, seed
        self._train = _complete(prior, train)
        self._watched = {
            person: _complete(prior, [r for r in watched if r.person_id == person], train)
            for person in sorted({r.person_id for r in watched})
        }

    def loss(self, tuned: TunableKalman, step: int, share: int) -> Tensor:
        """Return the loss on one share of a batch."""
        generator = _generator(self._seed, f"step {step} share {share}")
        # bodies of other sizes keep mixtures from the persons they see; noise is better off without
        share_of_bodies = 1.0 if getattr(tuned, "mixtures", None) else 0.0
        drawn = draw_sequences(
            self._train, self._prior, self._size, generator,
            body_size=share_of_bodies * UpperBodyRecipe.body_size,
            bone_lengths=share_of_bodies * UpperBodyRecipe.bone_lengths,
        )  # fmt: skip
        return tuned.loss(drawn)

    def error(self, tuned: TunableKalman, person: str) -> float:
        """Return the mean 3D error on a held-out person, metres."""
        generator = _generator(self._seed, f"held out {person}")
        sequences, n = self._watched[person], _HELD_OUT_SEQUENCES
        drawn = draw_sequences(sequences, self._prior, n, generator, view_share=_HELD_OUT_VIEWS)
        return float(tuned.error(drawn))


class WindowBatches:
    """Single windows of both arms, for `TunableWindow`."""

    def __init__(
        self,
        prior: UpperBodyPrior,
        name: str,
        train: Sequence[Recording],
        watched: Sequence[Recording],
        share_size: int,
        seed: int,
    ) -> None:
        self._size, self._seed = share_size, seed
        info, layout = prior.info, prior.windows[name].layout
        recipe = UpperBodyRecipe(
            causal=layout, full=layout, views=ViewRange(**info.views), seed=seed, neck=info.neck,
            camera_matrix=(info.fx, info.fy, info.cx, info.cy), rotation_order=info.rotation_order,
        )  # fmt: skip
        still = replace(
            recipe, body_size=0.0, bone_lengths=0.0, mirror_share=0.0,
            views=recipe.views.scaled(_HELD_OUT_VIEWS), window_samples=_HELD_OUT_WINDOWS,
        )  # fmt: skip
        self._train = _window_sources(recipe, train)
        self._watched = {
            person: draw_windows(
                _window_sources(still, [r for r in watched if r.person_id == person], train), 0
            )
            for person in sorted({r.person_id for r in watched})
        }

    def loss(self, tuned: TunableWindow, step: int, share: int) -> Tensor:
        """Return the loss on one share of a batch."""
        generator = _generator(self._seed, f"step {step} share {share}")
        epoch = int(torch.randint(1 << 30, (), generator=generator))
        block = int(torch.randint(self._train["left"].n_blocks, (), generator=generator))
        drawn = draw_windows(self._train, block, epoch)
        chosen = torch.randperm(len(drawn.hands), generator=generator)[: self._size]
        states = {side: value[chosen] for side, value in drawn.states.items()}
        return tuned.loss(WindowBatch(states, drawn.hands[chosen]), generator)

    def error(self, tuned: TunableWindow, person: str) -> float:
        """Return the mean 3D error on a held-out person, metres."""
        generator = _generator(self._seed, f"held out {person}")
        return float(tuned.error(self._watched[person], generator))


def _generator(seed: int, what: str) -> torch.Generator:
    return torch.Generator().manual_seed(derived_seed(seed, what))


def _complete(
    prior: UpperBodyPrior, recordings: Sequence[Recording], others: Sequence[Recording] = ()
) -> list[Tensor]:
    """Return the sequences, cut where a joint is missing.

    Args:
        prior: whose kind of neck they get. recordings: to cut. others: that tell where this neck is.

    Raises:
        InputError: nothing is left.
    """
    poses = collect_poses(recordings, prior.info.neck, prior.info.centre, others=others)
    found = [
        sequence[frames]
        for sequence in poses.joints.split(poses.lengths)
        for frames in runs(measured(sequence).all(1), min(_LEAST_FRAMES, len(sequence)))
    ]
    if not found:
        raise InputError(
            f"fine-tuning needs {_LEAST_FRAMES} frames in a row without a missing joint, got none of "
            f"{', '.join(sorted(set(poses.persons)))}"
        )
    return found


def _window_sources(
    recipe: UpperBodyRecipe, recordings: Sequence[Recording], others: Sequence[Recording] = ()
) -> dict[str, WindowSource]:
    """Return windows of both arms, from other viewpoints whenever they are drawn."""
    tasks = recipe.tasks(recordings, others)
    sources = {}
    for side in ("left", "right"):
        if f"causal.{side}" not in tasks:
            persons = sorted({r.person_id for r in recordings})
            raise InputError(f"the recordings of {', '.join(persons)} hold no complete windows")
        source = tasks[f"causal.{side}"].source
        if isinstance(source, ColumnsSource):
            source = source.source
        if not isinstance(source, WindowSource):
            raise TypeError(f"expected a WindowSource, got {type(source).__name__}")
        sources[side] = replace(source, fresh=True)
    return sources
