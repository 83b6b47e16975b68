"""Runs of the protocol Silhouette: filters tuned alike, and every run kept in a folder.

A run is one method on one clip with one seed. Runs that are missing are filtered as one batch, each
with random numbers of its own, so a run does not depend on which others were missing.
"""

from collections.abc import Mapping, Sequence
from math import inf, isfinite
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from torchpose.body.kinematics import Body
from torchpose.errors import TorchposeError
from torchpose.filters.pose_search import find_pose
from torchpose.filters.sharpness import ValidationSequence, fit_sharpness
from torchpose.filters.silhouette_filter import BodyTrack, SilhouetteParticleFilter
from torchpose.io.files import read_npz, write_npz
from torchpose.protocols.common import settings_hash
from torchpose.protocols.silhouette_trackees import (
    METHODS,
    SCALES,
    Setting,
    Trackee,
    View,
    make_filter,
)

__all__ = ["Run", "Runs", "Tuning", "run_all", "tune"]

_VERSION = 1


class Run(NamedTuple):
    """One method on one clip with one seed.

    Attributes:
        errors: distance of every joint [T, 15], mm, NaN where the truth is unknown (MR 31).
        mean: estimated states [T, D]. std: of the particles [T, D].
        coasting, respread: [T], as `BodyTrack`. seconds: [1], per frame, of the batch it ran in.
    """

    errors: Tensor
    mean: Tensor
    std: Tensor
    coasting: Tensor
    respread: Tensor
    seconds: Tensor


Runs = dict[str, dict[str, list[Run]]]
"""Runs by method and sequence, one for each seed."""


class Tuning(NamedTuple):
    """What validation chose for a method, and the mean errors (mm) of all settings it tried."""

    setting: Setting
    tried: tuple[Setting, ...] = ()
    errors: tuple[float, ...] = ()

    @property
    def error(self) -> float:
        """The error of what was chosen, mm, or NaN if nothing was tried."""
        found = [e for s, e in zip(self.tried, self.errors, strict=True) if s == self.setting]
        return found[0] if found else float("nan")


def sequence_name(trackee: Trackee, view: View) -> str:
    """What a sequence is called in tables."""
    return f"{trackee.split.person} {view.clip.trial}"


def tune(
    trackees: Sequence[Trackee],
    method: str,
    n_particles: int,
    likelihood: str,
    folder: Path,
    seeds: int = 1,
) -> Tuning:
    """The setting with the smallest mean error over everybody's validation clips.

    First the scale of the diffusion, then the sharpness (or survival rate) at that scale. Every
    method has the same clips, seeds and number of settings to choose among.
    """
    known = METHODS[method]
    tried: dict[Setting, float] = {}

    def best() -> Setting:
        return min(tried, key=lambda s: tried[s] if isfinite(tried[s]) else inf)

    def attempt(setting: Setting) -> None:
        if setting not in tried:
            found = [
                _kept_error(t, body, view, method, setting, n_particles, likelihood, folder, seeds)
                for t in trackees
                for body, view in t.validation
            ]
            tried[setting] = sum(found) / len(found)

    for scale in SCALES:
        attempt(Setting(known.first, scale))
    scale = best().scale
    for value in known.values:
        attempt(Setting(value, scale))
    return Tuning(best(), tuple(tried), tuple(tried.values()))


def _kept_error(
    trackee: Trackee, body: Body, view: View, method: str, setting: Setting, n_particles: int,
    likelihood: str, folder: Path, seeds: int,
) -> float:  # fmt: skip
    """Mean error on a validation clip, mm, read from the folder if it is there."""
    facts = ["tuning", _VERSION, method, list(setting), n_particles, likelihood, seeds]
    path = folder / f"tuning-{settings_hash([*facts, *_facts(trackee, body, view, method)])}.npz"
    if path.is_file():
        try:
            return float(read_npz(path, ("error",))["error"])
        except TorchposeError:
            path.unlink()  # damaged: try again
    sequence = ValidationSequence(
        view.silhouettes, view.rig, None, view.initial_state, view.clip.joints
    )

    def tracker(value: float) -> SilhouetteParticleFilter:
        return make_filter(
            method, trackee, Setting(value, setting.scale), n_particles, likelihood, body
        )

    fit = fit_sharpness(tracker, [sequence], values=[setting.value], seeds=seeds)
    error = 1000 * fit.errors[0]
    write_npz(path, {"error": np.array(error)})
    return error


def run_all(
    trackees: Sequence[Trackee],
    settings: Mapping[str, Setting],
    folder: Path,
    *,
    seeds: int = 5,
    seed: int = 0,
    n_particles: int = 500,
    likelihood: str = "bidirectional",
    initial: str = "given",
    progress: bool = False,
) -> Runs:
    """All runs that are not in the folder yet, and those that are.

    Args:
        trackees: who is tracked. settings: of each method.
        folder: where runs are kept. seeds: how many runs, numbered from `seed`.
        n_particles: likelihoods per frame. initial: "given", or "found" from the first frame.
        progress: whether to show a bar.
    """
    runs: Runs = {method: {} for method in settings}
    frames = sum(len(view.clip) for t in trackees for view in t.tests) * len(settings) * seeds
    with tqdm(total=frames, disable=not progress, unit="frame", desc="tracking") as bar:
        for trackee in trackees:
            for view in trackee.tests:
                name = sequence_name(trackee, view)
                for method, setting in settings.items():
                    bar.set_postfix_str(f"{name} {method}")
                    facts = [_VERSION, method, list(setting), n_particles, likelihood, initial]
                    facts += _facts(trackee, trackee.body, view, method)
                    paths = {
                        s: folder / f"run-{settings_hash([*facts, s])}.npz"
                        for s in range(seed, seed + seeds)
                    }
                    missing = [s for s, path in paths.items() if _read(path) is None]
                    if missing:
                        track = (trackee, view, method, setting, n_particles, likelihood)
                        found = _filtered(*track, initial, missing)
                        for s, run in zip(missing, found, strict=True):
                            arrays = {key: value.numpy() for key, value in run._asdict().items()}
                            write_npz(paths[s], arrays)
                    # read back, so that a run that goes on works with the same bits
                    runs[method][name] = [r for r in map(_read, paths.values()) if r is not None]
                    bar.update(seeds * len(view.clip))
    return runs


def _read(path: Path) -> Run | None:
    if not path.is_file():
        return None
    try:
        arrays = read_npz(path, Run._fields)
    except TorchposeError:
        path.unlink()  # damaged: run again
        return None
    return Run(*(torch.from_numpy(arrays[key]) for key in Run._fields))


def _filtered(
    trackee: Trackee, view: View, method: str, setting: Setting, n_particles: int, likelihood: str,
    initial: str, seeds: Sequence[int],
) -> list[Run]:  # fmt: skip
    """Runs of some seeds on one clip, as one batch."""
    tracker = make_filter(method, trackee, setting, n_particles, likelihood)
    generators = [torch.Generator().manual_seed(7919 * s + 1) for s in seeds]
    start = view.initial_state.expand(len(seeds), -1)
    if initial == "found":
        start = torch.stack([_found_pose(trackee, view, g) for g in generators])
    began = perf_counter()
    out: BodyTrack = tracker(view.silhouettes, view.rig, start, generator=generators)
    seconds = (perf_counter() - began) / len(view.clip) / len(seeds)
    errors = joint_errors(trackee, view, out.mean)
    return [
        Run(
            errors[i].float(), out.mean[i].float(), out.std[i].float(), out.coasting[i],
            out.respread[i], torch.tensor([seconds], dtype=torch.float64),
        )
        for i in range(len(seeds))
    ]  # fmt: skip


def joint_errors(
    trackee: Trackee, view: View, states: Float[Tensor, "*batch T D"]
) -> Float[Tensor, "*batch T 15"]:
    """Distance of the estimated joints from the recorded ones, mm (MR 31)."""
    return 1000 * (trackee.body.joints(states) - view.clip.joints).norm(dim=-1)


def _found_pose(trackee: Trackee, view: View, generator: torch.Generator) -> Float[Tensor, " D"]:
    """The first pose from the first silhouettes alone, about the poses of the manifold."""
    found = find_pose(
        trackee.body, view.silhouettes[0], view.rig, trackee.manifold, generator, up=view.clip.up
    )
    return found.to(view.initial_state)


def _facts(trackee: Trackee, body: Body, view: View, method: str) -> list[Any]:
    """Everything that a run depends on, beside the filter's own settings."""
    facts: list[Any] = [
        view.silhouettes.byte(), view.rig.matrix, view.rig.rotation, view.rig.translation,
        view.initial_state, view.clip.joints, body.offsets, body.radii, body.tips,
        trackee.step_std,
    ]  # fmt: skip
    if method.startswith("mrpf"):
        facts += [trackee.manifold.poses, trackee.manifold.weights]
        facts += [trackee.manifold.std_latent, trackee.manifold.std_pose]
    return facts
