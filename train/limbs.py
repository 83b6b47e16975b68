"""Fit of limb conditionals, and of how limbs turn from frame to frame, to recordings of whole bodies.

There is one step: the fit is in closed form. Persons who are held out then tell how far others are
from it.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from lightning.pytorch import LightningDataModule
from torch import Tensor

from torchpose.body import BODY_15, Body, body_joints, centres_of, fit_body, fit_state
from torchpose.body.quaternion_vectors import compose, conjugate
from torchpose.curation import pick_persons
from torchpose.errors import InputError
from torchpose.io import Recording, find_recordings, read_recordings
from torchpose.io.mocap import resample
from torchpose.priors.limb_conditionals import LimbConditionals
from train.body_fit import BodyFit, recording_name
from train.data import expand_path, fingerprint

__all__ = ["HeldOut", "LimbData", "LimbFit", "held_out_spread"]


class LimbData(LightningDataModule):
    """Recorded states of all persons, of one body with safe centres (DX 1), at one frame rate.

    Args:
        paths: folders (with their subfolders) or files; `$NAME` stands for a variable of the
            environment.
        persons: whose, as `origin#person` or just the person; everybody if None.
        held_out: persons of whom nothing is fitted, named in the same way.
        actions: names of those to fit to, as the files give them; all if None.
        without: names of files, without their suffix, that are on neither side.
        fps: frame rate that recordings are resampled to, best that of the frames to be tracked.
        axes: of all recordings: camera, kinect, y-up, z-up; by default what each file says.

    Raises:
        InputError: unknown persons, actions or files, nobody left to learn from, a recording without a
            frame rate, a joint that is missing in some frames.
    """

    def __init__(
        self,
        paths: list[str],
        persons: list[str] | None = None,
        held_out: list[str] | None = None,
        actions: list[str] | None = None,
        without: list[str] | None = None,
        fps: float = 60.0,
        axes: str | None = None,
    ) -> None:
        super().__init__()
        if not 0 < fps < float("inf"):
            raise InputError(f"fps must be positive, got {fps:g}")
        self.fps = fps
        self.body: Body | None = None
        self.train: list[Tensor] = []
        self.watched: list[Tensor] = []
        self._paths, self._persons, self._held_out = paths, persons, held_out or []
        self._actions, self._without, self._axes = actions, without or [], axes
        self._recordings: dict[str, list[Recording]] = {"train": [], "watched": []}

    def setup(self, stage: str) -> None:
        """Read, fit everybody's body, turn joints into states; the second call does nothing."""
        if self.train:
            return
        self._recordings = self._read()
        learnt, watched = self._recordings["train"], self._recordings["watched"]
        joints = [self._joints(r) for r in (*learnt, *watched)]
        owners = [r.person_id for r in (*learnt, *watched)]
        bodies, n = self._bodies(owners, joints), len(learnt)
        first = bodies[owners[0]]
        raw = self._states(bodies, owners[:n], joints[:n])
        centres = centres_of(first, torch.cat(raw))
        centred = {person: body.altered(centres=centres) for person, body in bodies.items()}
        # fitted anew: the twist that joints do not tell is none about the centres
        states = self._states(centred, owners, joints)
        self.body, self.train, self.watched = centred[owners[0]], states[:n], states[n:]

    def train_dataloader(self) -> range:
        """One step."""
        return range(1)

    def identity(self) -> dict[str, Any]:
        """What makes a fit the same one."""
        return {
            "fps": self.fps,
            "recordings": fingerprint(self._recordings["train"]),
            "held-out recordings": fingerprint(self._recordings["watched"]),
        }

    def facts(self) -> dict[str, Any]:
        """What is known of the recordings before anything is fitted, as fields of `LimbInfo`."""
        fitted = self._recordings["train"]
        return {
            "persons": tuple(sorted({r.person_id for r in fitted})),
            "actions": tuple(sorted({r.action for r in fitted if r.action})),
            "sources": tuple(sorted({r.source or str(r.path) for r in fitted})),
        }

    def _read(self) -> dict[str, list[Recording]]:
        files = find_recordings([expand_path(path) for path in self._paths])
        unknown = sorted(set(self._without) - {file.stem for file in files})
        if unknown:
            raise InputError(f"without: no file named {', '.join(unknown)} among the recordings")
        recordings = read_recordings([f for f in files if f.stem not in self._without], self._axes)
        recordings = [r for r in recordings if not r.companion]
        known = sorted({r.person_id for r in recordings})
        wanted = set(known if self._persons is None else pick_persons(self._persons, known))
        held_out = set(pick_persons(self._held_out, known)) if self._held_out else set()
        if self._actions is not None:
            done = sorted({r.action for r in recordings})
            missing = [action for action in self._actions if action not in done]
            if missing:
                raise InputError(
                    f"no recording of {', '.join(missing)}; there are {', '.join(done)}"
                )
            recordings = [r for r in recordings if r.action in self._actions]
        train = [r for r in recordings if r.person_id in wanted - held_out]
        if not train:
            raise InputError(
                "everybody is held out, or did none of the actions; nobody is left to learn from"
            )
        return {"train": train, "watched": [r for r in recordings if r.person_id in held_out]}

    def _joints(self, recording: Recording) -> Tensor:
        if recording.fps is None:
            raise InputError(
                f"{recording_name(recording)}: the file does not say its frame rate, which is needed"
            )
        joints = body_joints(recording.joints, recording.names)
        missing = joints.isnan().any(-1)
        gaps = (missing & ~missing.all(0)).nonzero()
        if len(gaps):
            frame, joint = gaps[0].tolist()
            raise InputError(
                f"{recording_name(recording)}: {BODY_15.names[joint]} is missing in frame {frame}; end the "
                "recording there, or fill the gap"
            )
        return resample(joints, recording.fps, self.fps)

    def _bodies(self, owners: Sequence[str], joints: Sequence[Tensor]) -> dict[str, Body]:
        found = {}
        for person in dict.fromkeys(owners):
            own = [j for j, owner in zip(joints, owners, strict=True) if owner == person]
            try:
                found[person] = fit_body(torch.cat(own), frame="body")
            except InputError as error:
                raise InputError(f"{person}: {error}") from error
        return found

    def _states(
        self, bodies: dict[str, Body], owners: Sequence[str], joints: Sequence[Tensor]
    ) -> list[Tensor]:
        """States [T, D] of every recording on its owner's body."""
        both = (*self._recordings["train"], *self._recordings["watched"])
        found = []
        for recording, owner, points in zip(both, owners, joints, strict=False):
            try:
                found.append(fit_state(bodies[owner], points).detach())
            except InputError as error:
                raise InputError(f"{recording_name(recording)}: {error}") from error
        return found


class HeldOut(NamedTuple):
    """Persons who were held out, against those who were learnt from.

    Attributes:
        deviation: of their limbs, in deviations of the conditionals; 1 if they are as the others.
        speed: of their limbs, in deviations of the diffusion. frames: how many there were.
    """

    deviation: float
    speed: float
    frames: int


def held_out_spread(
    conditionals: LimbConditionals, body: Body, sequences: Sequence[Float[Tensor, "_ D"]]
) -> HeldOut:
    """How far states that were not learnt from are from limb conditionals.

    deviation^2 = sum_ij E|x_ij - mu_ij|^2 / sum_ij tr Sigma_ij,
    speed^2 = sum_j E|q'_j|^2 / sum_j tr Sigma'_j,

    with the means E over their frames.

    Args:
        body: whose states they are, of the conditionals' centres. sequences: [T, D] each, at their
            frame rate.
    """
    above, below = conditionals.edges.long().unbind(-1)
    turns = [compose(body.centres, s[:, 3:].unflatten(-1, (-1, 3))) for s in sequences]
    every = torch.cat(turns)
    between = compose(conjugate(every[:, above]), every[:, below])
    away = compose(conjugate(conditionals.edge_centres), between) - conditionals.mean
    steps = torch.cat([compose(conjugate(q[:-1]), q[1:]) for q in turns])
    return HeldOut(
        _ratio(away, conditionals.covariance), _ratio(steps, conditionals.diffusion), len(every)
    )


def _ratio(vectors: Float[Tensor, "N M 3"], covariance: Float[Tensor, "M 3 3"]) -> float:
    learnt = covariance.diagonal(dim1=-2, dim2=-1).sum()
    return float((vectors.square().sum((-2, -1)).mean() / learnt).sqrt())


class LimbFit(BodyFit):
    """Fits `LimbConditionals` to the states of `LimbData`.

    Logged, with persons held out: `deviation` and `speed` of `HeldOut`.

    Args:
        least_std: floor of the standard deviations of q_ij, see `LimbConditionals.fit`.
    """

    data_type, what = LimbData, "limb conditionals are"

    def __init__(self, least_std: float = 0.01) -> None:
        super().__init__()
        if not 0 <= least_std < float("inf"):
            raise InputError(f"least_std must be zero or more and finite, got {least_std:g}")
        self.save_hyperparameters()
        self._fitted: list[LimbConditionals] = []  # no part of the module, nor of its checkpoints

    def training_step(self, batch: int, batch_idx: int) -> None:
        """The fit."""
        found = self.held_out()
        values = {"frames": sum(len(states) for states in self._data.train)} if found is None else {
            "deviation": found.deviation, "speed": found.speed,
        }  # fmt: skip
        self.log_dict({k: torch.tensor(v).double() for k, v in values.items()}, on_step=True)
        self.trainer.should_stop = True

    # --- what comes of it

    def conditionals(self) -> LimbConditionals:
        """Those of the recordings; fitted once."""
        data = self._data
        if data.body is None:
            raise InputError("the recordings have not been read; call setup first")
        if not self._fitted:
            least = self.settings["least_std"]
            self._fitted.append(
                LimbConditionals.fit(
                    data.body, data.train, data.fps, least_std=least, **data.facts()
                )
            )
        return self._fitted[0]

    def held_out(self) -> HeldOut | None:
        """How far the persons who are held out are from them; None without any."""
        found, data = self.conditionals(), self._data
        if not data.watched or data.body is None:
            return None
        return held_out_spread(found, data.body, data.watched)

    def finished_prior(self, **facts: str) -> None:
        """Write the conditionals where a prior's file would be."""
        out = self.written_to
        if out is None:
            return
        found, held_out = self.conditionals(), self.held_out()
        given: dict[str, Any] = {name: value for name, value in facts.items() if value}
        extra: dict[str, Any] = {"settings": self.settings}
        if held_out is not None:
            extra["held_out"] = held_out._asdict()
        found.info = replace(found.info, **given, extra=extra)
        found.save(out)
        print(f"{summary(found, held_out)}\nwrote {out}", flush=True)


def summary(conditionals: LimbConditionals, held_out: HeldOut | None) -> str:
    """What was fitted, in a sentence."""
    info = conditionals.info
    text = (
        f"{info.name}: {len(conditionals.edges)} limbs from {info.n_frames} frames of "
        f"{len(info.persons)} persons at {info.fps:g} frames per second"
    )
    if held_out is None:
        return text
    return (
        f"{text}; those of the persons held out deviate {held_out.deviation:.2f} times as much and "
        f"turn {held_out.speed:.2f} times as fast"
    )
