"""Fit a manifold of poses, a back-constrained GPLVM, to recordings of whole bodies.

After each step of ten iterations the held-out poses are mapped to the manifold and back. The step with
the lowest error is kept, and its standard deviations are measured on the held-out poses.
"""

import math
import os
import pickle
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor, nn
from tqdm.auto import tqdm

from torchpose._core.digests import digest_of
from torchpose._core.files import atomic_path
from torchpose._core.wording import counted
from torchpose.body._kinematics import Body
from torchpose.errors import InputError, OutputError
from torchpose.io._formats.axes import Axes
from torchpose.io._recordings import Recording
from torchpose.learning._curation.splits import refuse_shared_recordings
from torchpose.learning._gplvm_fit import GPLVMFit
from torchpose.learning._manifolds import fit_gplvm_noise, fit_target, gplvm_of_fit, thin
from torchpose.learning._recipes.choosing import (
    body_of_each,
    choose_recordings,
    fingerprint,
    origin_of,
    recorded_joints,
    recording_name,
    state_of,
)
from torchpose.learning._recipes.gaps import notes_on_motion
from torchpose.priors._manifold.gplvm import BackConstrainedGPLVM
from torchpose.priors._manifold.manifold_file import ManifoldInfo


@dataclass(frozen=True)
class ManifoldRecipe:
    """Holds the settings of the fit of a manifold.

    Args:
        latent_dim: dimensions d of the latent space.
        gamma_x: of (MR 22); by default from the median distance of the poses.
        optimiser: "lbfgs" or "adam". learning_rate: None for the optimiser's own.
        steps: the largest number of steps, each of ten iterations of the optimiser.
        patience: steps without a better error on what is held out, after which it ends.
        start: which principal components to start from, 0 the first ones (`principal_start`).
        smoothness: the smoothness of the back constraints (`GPLVMFit`); 0 is the published form.
        standardise: let all columns weigh the same (`fit_gplvm`).
        seed: the seed of the frames that tell the scale of distances, gamma_x, where there are very many.

    Raises:
        InputError: a setting that is not positive.
    """

    latent_dim: int = 2
    gamma_x: float | None = None
    optimiser: str = "lbfgs"
    learning_rate: float | None = None
    steps: int = 40
    patience: int = 3
    start: int = 0
    smoothness: float = 0.0
    standardise: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (("steps", 1), ("patience", 1), ("start", 0)):
            if getattr(self, name) < least:
                raise InputError(f"{name} must be at least {least}, got {getattr(self, name)}")


@dataclass(frozen=True)
class ManifoldPoses:
    """Holds the poses to fit a manifold to, and held-out poses of other recordings.

    Attributes:
        train, watched: [T, Q] for each recording. fps: the frame rate of `watched`; `train` is thinned out.
        info: what they are of. fitted, held_out: the recordings. notes: on these, and on files not read.
    """

    train: list[Tensor]
    watched: list[Tensor]
    fps: float
    info: ManifoldInfo
    fitted: list[Recording]
    held_out: list[Recording]
    notes: tuple[str, ...] = ()

    @classmethod
    def gather(
        cls,
        paths: Sequence[str],
        *,
        persons: Sequence[str] | None = None,
        held_out: Sequence[str] | None = None,
        actions: Sequence[str] | None = None,
        without: Sequence[str] | None = None,
        fps: float = 60.0,
        axes: Axes | None = None,
        validation: int = 2,
        frames: int = 350,
        progress: bool = False,
    ) -> Self:
        """Read and split recordings, and turn joints into poses of a body fitted to each person.

        Args:
            paths, persons, actions, without, axes: see `choose_recordings`.
            held_out: persons who are not fitted to: they tell how good the model is on others, and give
                the manifold its noise.
            validation: without persons held out, recordings of each person that are, the last ones by
                name.
            fps: frame rate of what is fitted, best that of the videos.
            frames: that are fitted to at most, spread over all recordings; time grows with their cube.
            progress: show a bar.

        Raises:
            InputError: as `choose_recordings` and `recorded_joints`, a person with too few recordings,
                settings out of range. OverlapError: a recording on both sides.
        """
        check_gathering(validation, frames, fps)
        fitted, watched, unread = choose_recordings(
            paths, persons=persons, held_out=held_out, actions=actions, without=without, axes=axes
        )
        if not watched:
            fitted, watched = _last_apart(fitted, validation)
        both, n = [*fitted, *watched], len(fitted)
        joints = [recorded_joints(r, fps) for r in both]
        bodies = _bodies(both, joints, n)
        bar = tqdm(zip(both, joints, strict=True), "poses", len(both), disable=not progress)
        states = [(bodies[r.person_id], state_of(bodies[r.person_id], r, j)) for r, j in bar]
        poses = [body.relative(state) for body, state in states]
        facts: dict[str, Any] = origin_of(fitted)
        several = len(facts["persons"]) > 1
        facts["sequences"] = tuple(r.person_id if several else recording_name(r) for r in fitted)
        info = ManifoldInfo.of_body(bodies[fitted[0].person_id], fps=fps, **facts)
        notes = (*unread, *notes_on_motion(both))
        return cls(thin(poses[:n], frames), poses[n:], fps, info, fitted, watched, notes)

    def identity(self) -> dict[str, Any]:
        """Return frame rate and digests of poses and recordings, equal for equal fits."""
        return {
            "fps": self.fps,
            "poses": digest_of(part.numpy().round(9).tobytes() for part in self.train),
            "recordings": fingerprint(self.fitted),
            "held-out recordings": fingerprint(self.held_out),
        }


class ManifoldFitting(nn.Module):
    """Fits a manifold; the whole state of the fit beside its arguments is in its `state_dict`.

    Args:
        poses: to fit to. recipe: settings.
    """

    def __init__(self, poses: ManifoldPoses, recipe: ManifoldRecipe) -> None:
        super().__init__()
        self.data, self.recipe = poses, recipe
        self._target = fit_target(
            poses.train, poses.info.columns, recipe.standardise, recipe.gamma_x, recipe.seed
        )
        self.fit = GPLVMFit(
            self._target.scaled, recipe.latent_dim, self._target.gamma_x, recipe.optimiser,
            recipe.learning_rate, recipe.smoothness, start=recipe.start,
        )  # fmt: skip

    def identity(self) -> dict[str, Any]:
        """Return settings and digests of the poses, equal for equal fits."""
        return {"settings": asdict(self.recipe), **self.data.identity()}

    def step(self) -> dict[str, float]:
        """Take one step, and return the error on the held-out poses after it.

        Returns:
            `step`, counted from 1; `log_likelihood`, the objective (MR 16) before it, per number of
            the poses; `held_out`, the root mean square of x - f(g(x)) over held-out poses after it.
        """
        value = self.fit.step()
        self.fit.note(self.held_out_error())
        scores = self.fit.scores
        return {"step": len(scores), "log_likelihood": value, "held_out": scores[-1]}

    @property
    def finished(self) -> bool:
        """Return whether all steps are taken, or the last better score is `patience` steps ago."""
        taken = len(self.fit.scores)
        over = taken - self.fit.best_step
        return taken >= self.recipe.steps or over >= self.recipe.patience

    def held_out_error(self) -> float:
        """Return the root mean square of x - f(g(x)) over the held-out poses at the current step."""
        return self._current().reconstruction_error(torch.cat(self.data.watched))

    def manifold(self, **facts: str) -> BackConstrainedGPLVM:
        """Return the best manifold, its standard deviations from the held-out poses.

        Args:
            facts: name, licence, command; those that are empty are left out.
        """
        self.fit.restore_best()
        given: dict[str, Any] = {name: value for name, value in facts.items() if value}
        found = self._current()
        fit_gplvm_noise(found, self.data.watched, self.data.fps)
        extra = {
            "settings": asdict(self.recipe),
            "steps": self.fit.best_step,
            "held_out_error": min(self.fit.scores),
            "held_out_frames": sum(len(poses) for poses in self.data.watched),
            "held_out_persons": sorted({r.person_id for r in self.data.held_out}),
        }
        found.info = replace(found.info, **given, extra={**found.info.extra, **extra})
        return found

    def summary(self, manifold: BackConstrainedGPLVM) -> str:
        """Return a one-sentence summary of the fit."""
        persons = ", ".join(manifold.info.persons)
        return (
            f"{manifold.info.name}: {len(manifold.poses)} frames of {persons}, best after "
            f"{self.fit.best_step} of {len(self.fit.scores)} steps; held-out poses come back to within "
            f"{min(self.fit.scores):.4f} (root mean square of a column)"
        )

    def _current(self) -> BackConstrainedGPLVM:
        return gplvm_of_fit(self.fit, self._target, self.data.info).cpu()


def run_to_end(
    fitting: ManifoldFitting, kept: str | Path | None, progress: bool
) -> ManifoldFitting:
    """Take steps until the fit is finished.

    Args:
        fitting: at its start, or taken up. kept: file that holds the fit after every step; who writes
            the manifold removes it then. None keeps nothing. progress: show a bar.
    """
    with tqdm(
        total=fitting.recipe.steps, desc="manifold", unit="step", disable=not progress,
        initial=len(fitting.fit.scores),
    ) as bar:  # fmt: skip
        while not fitting.finished:
            found = fitting.step()
            if kept is not None:
                _keep(fitting, kept)
            bar.set_postfix_str(f"held-out error {found['held_out']:.5f}", refresh=False)
            bar.update()
    return fitting


def _keep(fitting: ManifoldFitting, kept: str | Path) -> None:
    """Write the whole state of a fit."""
    buffer = BytesIO()  # torch.save says of a full disk only that it is at a wrong place
    torch.save({"of": _same_for(fitting), "fit": fitting.state_dict()}, buffer)
    with atomic_path(kept) as temporary:
        temporary.write_bytes(buffer.getvalue())


def _same_for(fitting: ManifoldFitting) -> dict[str, Any]:
    """Return what is equal for fits of which one goes on with the other, whenever they end."""
    identity = fitting.identity()
    settings = {k: v for k, v in identity["settings"].items() if k not in ("steps", "patience")}
    return identity | {"settings": settings}


def taken_up(fitting: ManifoldFitting, kept: str | Path) -> int:
    """Restore a fit that `run_to_end` kept; return its steps so far, or 0 without any.

    Raises:
        OutputError: the file is another fit, or something else, which `run_to_end` would write over.
    """
    if not os.path.lexists(kept):
        return 0
    try:
        found = torch.load(kept, weights_only=True)
        same = found["of"] == _same_for(fitting)
        if same:
            fitting.load_state_dict(found["fit"])
    except (
        OSError,
        RuntimeError,
        pickle.UnpicklingError,
        EOFError,
        LookupError,
        TypeError,
    ) as error:
        raise OutputError(
            f"{kept}: is in the place where a fit is kept, and is none; move it away"
        ) from error
    if not same:
        raise OutputError(
            f"{kept}: holds a fit to other recordings, or with other settings, that was interrupted; "
            "remove it, or repeat that fit to go on with it"
        )
    return len(fitting.fit.scores)


def check_gathering(validation: int, frames: int, fps: float) -> None:
    """Raise `InputError` unless some recordings are held out, and frames and rate suffice."""
    if validation < 1 or frames < 10 or not 0 < fps < math.inf:
        raise InputError(
            "validation must be at least 1, frames at least 10 and fps positive, got "
            f"{validation}, {frames} and {fps:g}"
        )


def _last_apart(
    recordings: Sequence[Recording], count: int
) -> tuple[list[Recording], list[Recording]]:
    """Hold out the last recordings of each person."""
    fitted: list[Recording] = []
    watched: list[Recording] = []
    for person in sorted({r.person_id for r in recordings}):
        own = [r for r in recordings if r.person_id == person]
        if len(own) <= count:
            raise InputError(
                f"{person} has {counted(len(own), 'recording')}, and {count} of them are to be held out; "
                "hold fewer out (validation), name persons to hold out, or add recordings"
            )
        refuse_shared_recordings(own[:-count], own[-count:])
        fitted += own[:-count]
        watched += own[-count:]
    return fitted, watched


def _bodies(
    recordings: Sequence[Recording], joints: Sequence[Tensor], n_fitted: int
) -> dict[str, Body]:
    """Return a body for each person, from their recordings among the first `n_fitted` if any."""
    of_watched = body_of_each(recordings[n_fitted:], joints[n_fitted:])
    return of_watched | body_of_each(recordings[:n_fitted], joints[:n_fitted])
