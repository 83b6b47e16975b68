"""Fit of action spaces, or of a bank of several actions, to recordings of whole bodies.

There is one step: the fit is in closed form. The gate is then tried on persons who were held out.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor

from torchpose.body import BODY_15, Body, body_joints, fit_body, fit_state
from torchpose.curation import pick_persons
from torchpose.errors import InputError
from torchpose.io import Recording, find_recordings, read_recordings
from torchpose.io.mocap import resample
from torchpose.priors.action_bank import ActionBank, BankInfo
from torchpose.priors.action_recognition import Performed
from torchpose.priors.action_space import ActionInfo, ActionSpace
from torchpose.priors.postures import posture_angles, state_postures
from torchpose.priors.repetitions import repetition_axis, split_repetitions
from torchpose.priors.synchronisation import LEAST_FRAMES, Synchronised
from train.body_fit import BodyFit, recording_name
from train.data import expand_path, fingerprint

__all__ = ["ActionData", "ActionFit"]

_COMMON_HEIGHT = 1.75  # metres, of the body on which everybody's postures are told


class ActionData(LightningDataModule):
    """Performances of one action or several, and those of persons who are held out.

    Args:
        paths: folders (with their subfolders) or files; `$NAME` stands for a variable of the
            environment.
        actions: names, as the files give them.
        persons: whose, as `origin#person` or just the person; everybody if None.
        held_out: persons on whom the gate is tried instead, named in the same way.
        fps: frame rate that recordings are resampled to.
        repeated: cut recordings into repetitions; false if each is a single performance.
        postures: "joints", angles between the recorded joints; "body", of a body of average
            proportions that is turned as a body fitted to each person, so that it makes no difference
            where shoulders and hips are.
        axes: of all recordings: camera, kinect, y-up, z-up; by default what each file says.

    Raises:
        InputError: unknown persons or actions, a recording without a frame rate, a joint that is
            missing in some frames.
    """

    def __init__(
        self,
        paths: list[str],
        actions: list[str],
        persons: list[str] | None = None,
        held_out: list[str] | None = None,
        fps: float = 30.0,
        repeated: bool = True,
        postures: Literal["joints", "body"] = "joints",
        axes: str | None = None,
    ) -> None:
        super().__init__()
        if not actions or len(set(actions)) < len(actions):
            raise InputError(
                f"actions must be names, each once, got {', '.join(actions) or 'none'}"
            )
        if not 0 < fps < float("inf"):
            raise InputError(f"fps must be positive, got {fps:g}")
        self.fps, self.actions = fps, tuple(actions)
        self.train: list[Performed] = []
        self.watched: list[Performed] = []
        self.left_out = 0  # repetitions that are too short
        self._paths, self._persons, self._held_out = paths, persons, held_out or []
        self._repeated, self._postures, self._axes = repeated, postures, axes
        self._recordings: list[Recording] = []

    def setup(self, stage: str) -> None:
        """Read, turn joints into postures, cut; the second call does nothing."""
        if self.train:
            return
        self._recordings, held_out = self._read()
        found = self._performances()
        self.train = [p for p in found if p.person not in held_out]
        self.watched = [p for p in found if p.person in held_out]
        for action in self.actions:
            if not any(p.action == action for p in self.train):
                raise InputError(
                    f"{action}: there is no performance to learn from; everybody who did it is held "
                    f"out or not among the persons, or no repetition lasts {LEAST_FRAMES} frames"
                )

    def train_dataloader(self) -> range:
        """One step."""
        return range(1)

    def identity(self) -> dict[str, Any]:
        """What makes a fit the same one."""
        return {
            "fps": self.fps, "actions": list(self.actions), "held out": sorted(self._held_out),
            "repeated": self._repeated, "postures": self._postures,
            "recordings": fingerprint(self._recordings),
        }  # fmt: skip

    def facts(self, action: str) -> ActionInfo:
        """What is known of an action before it is fitted."""
        learnt = {p.person for p in self.train if p.action == action}
        mine = [r for r in self._recordings if r.action == action and r.person_id in learnt]
        return ActionInfo(
            name=action,
            fps=self.fps,
            persons=tuple(sorted(learnt)),
            sources=tuple(sorted({r.source or str(r.path) for r in mine})),
            extra={"postures": self._postures},
        )

    def _read(self) -> tuple[list[Recording], set[str]]:
        files = find_recordings([expand_path(path) for path in self._paths])
        recordings = [r for r in read_recordings(files, self._axes) if not r.companion]
        done = sorted({r.action for r in recordings})
        missing = [action for action in self.actions if action not in done]
        if missing:
            raise InputError(f"no recording of {', '.join(missing)}; there are {', '.join(done)}")
        known = sorted({r.person_id for r in recordings})
        wanted = set(known if self._persons is None else pick_persons(self._persons, known))
        held_out = set(pick_persons(self._held_out, known)) if self._held_out else set()
        wanted |= held_out
        chosen = [r for r in recordings if r.action in self.actions and r.person_id in wanted]
        return chosen, held_out

    def _performances(self) -> list[Performed]:
        joints = [self._joints(r) for r in self._recordings]
        told = self._told(joints)
        found = []
        for action in self.actions:
            mine = [i for i, r in enumerate(self._recordings) if r.action == action]
            for i, parts in zip(mine, self._parts([told[i] for i in mine]), strict=True):
                person = self._recordings[i].person_id
                found += [Performed(person, action, told[i][part]) for part in parts]
        if not self._repeated:  # then every recording counts, and a short one is refused
            return found
        kept = [p for p in found if len(p.postures) >= LEAST_FRAMES]
        self.left_out = len(found) - len(kept)
        return kept

    def _parts(self, told: Sequence[Tensor]) -> list[list[slice]]:
        """Frames of the single performances in each recording of an action."""
        if not told or not self._repeated:
            return [[slice(0, len(postures))] for postures in told]
        axis = repetition_axis(told)
        return [split_repetitions(postures, self.fps, axis) for postures in told]

    def _joints(self, recording: Recording) -> Tensor:
        if recording.fps is None:
            raise InputError(
                f"{recording_name(recording)}: the file does not say its frame rate, which is needed"
            )
        return resample(body_joints(recording.joints, recording.names), recording.fps, self.fps)

    def _told(self, joints: Sequence[Tensor]) -> list[Tensor]:
        """Postures [T, 36] of every recording."""
        found: list[Tensor] = [torch.empty(0)] * len(joints)
        common = Body.of_height(BODY_15, _COMMON_HEIGHT)
        for person in sorted({r.person_id for r in self._recordings}):
            mine = [i for i, r in enumerate(self._recordings) if r.person_id == person]
            for i in mine:
                try:
                    found[i] = posture_angles(joints[i])
                except InputError as error:
                    raise InputError(f"{recording_name(self._recordings[i])}: {error}") from error
            if self._postures == "body":
                body = fit_body(torch.cat([joints[i] for i in mine]))
                for i in mine:
                    found[i] = state_postures(common, fit_state(body, joints[i])).detach()
        return found


class ActionFit(BodyFit):
    """Fits an action space to the performances of `ActionData`, or a bank if there are several actions.

    Logged: `explained`, the share of the variance in the D dimensions, and with persons held out
    `accepted`, the share of their postures that pass the gate when j is drawn (AS 6).

    Args:
        n_dimensions: D. n_postures: K, by default the median length. prominence: of key frames.
        stay, spread, background, evidence_rate, gate_dimensions: of a bank, see `ActionBank`.
        seed: of the matching that `accepted` rests on.
        picture: draw the performances before and after being synchronised beside the file.
    """

    data_type, what = ActionData, "an action is"

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
        picture: bool = True,
    ) -> None:
        super().__init__()
        self.save_hyperparameters()
        self.fitted: dict[str, tuple[ActionSpace, Synchronised]] = {}
        self._accepted: dict[str, float] = {}

    def training_step(self, batch: int, batch_idx: int) -> None:
        """The fit of every action."""
        self.fit()
        found = {"explained": [s.info.explained or 0.0 for s, _ in self.fitted.values()]}
        accepted = self.accepted()
        if accepted:
            found["accepted"] = list(accepted.values())
        values = {k: torch.tensor(v).double().mean() for k, v in found.items()}
        self.log_dict(values, on_step=True)
        self.trainer.should_stop = True

    # --- what comes of it

    def fit(self) -> None:
        """Fit every action, and try its gate on who is held out."""
        given, data = self._given, self._data
        for action in data.actions:
            self.fitted[action] = ActionSpace.fit_synchronised(
                [p.postures for p in data.train if p.action == action], given.n_dimensions,
                name=action, fps=data.fps, n_postures=given.n_postures,
                prominence=given.prominence, info=data.facts(action),
            )  # fmt: skip

        self._accepted = self._tried()

    def accepted(self) -> dict[str, float]:
        """Share of the held-out postures that pass the gate, by action, of the last fit."""
        return dict(self._accepted)

    def _tried(self) -> dict[str, float]:
        found = {}
        for action, (space, _) in self.fitted.items():
            watched = [p.postures for p in self._data.watched if p.action == action]
            if watched:
                generator = torch.Generator().manual_seed(self._given.seed)
                d = self._given.gate_dimensions or space.n_dimensions
                gated = space.with_dimensions(min(d, space.n_dimensions))
                found[action] = gated.acceptance(torch.cat(watched), generator=generator).drawn
        return found

    def result(self, **facts: str) -> ActionSpace | ActionBank:
        """The action space, or the bank of all actions.

        Args:
            facts: name, licence, command; the actions keep their own names.
        """
        if not self.fitted:
            self.fit()
        given = {k: v for k, v in facts.items() if v and k != "name"}
        accepted = self.accepted()
        spaces = []
        for action, (space, _) in self.fitted.items():
            extra = {**space.info.extra, "settings": self.settings, "file": facts.get("name", "")}
            if action in accepted:
                extra["accepted"] = accepted[action]
            space.info = replace(space.info, **given, extra=extra)  # type: ignore[arg-type]
            spaces.append(space)
        if len(spaces) == 1:
            return spaces[0]
        s = self._given
        bank = ActionBank(
            spaces, stay=s.stay, spread=s.spread, background=s.background,
            evidence_rate=s.evidence_rate, gate_dimensions=s.gate_dimensions,
        )  # fmt: skip
        bank.info = replace(bank.info, **given)  # type: ignore[arg-type]
        return bank

    def finished_prior(self, **facts: str) -> None:
        """Write the action space or bank where a prior's file would be."""
        out = self.written_to
        if out is None:
            return
        found = self.result(**facts)
        found.save(out)
        written = [out]
        if self._given.picture:
            several = len(self.fitted) > 1
            written += [
                _draw(space, steps, out.with_name(f"{out.stem}-{a}.png" if several else f"{out.stem}.png"))
                for a, (space, steps) in self.fitted.items()
            ]  # fmt: skip
        print(self._summary(written), flush=True)

    def _summary(self, written: Sequence[Path]) -> str:
        accepted, lines = self.accepted(), []
        for action, (space, _) in self.fitted.items():
            line = (
                f"{action}: {space.info.performances} performances of {len(space.info.persons)} persons, "
                f"{space.n_postures} postures, {len(space.info.key_frames)} key frames, "
                f"{space.n_dimensions} dimensions with {100 * (space.info.explained or 0):.1f} % of the "
                "variance"
            )
            if action in accepted:
                line += f"; {100 * accepted[action]:.0f} % of held-out postures pass the gate"
            lines.append(line)
        if self._data.left_out:
            lines.append(
                f"left out {self._data.left_out} repetitions shorter than {LEAST_FRAMES} frames"
            )
        return "\n".join([*lines, f"wrote {', '.join(map(str, written))}"])


def _draw(space: ActionSpace, synchronised: Synchronised, path: Path) -> Path:
    from torchpose.viz import save_figure
    from torchpose.viz.action_picture import plot_action_space

    return save_figure(plot_action_space(space, synchronised), path)
