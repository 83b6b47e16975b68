"""Fit an earlier version of the upper-body recipe, and renew the noise of priors from earlier versions."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Unpack

import torch

from torchpose._core.frame_rates import same_rate
from torchpose._core.wording import counted
from torchpose.camera._viewpoints import ViewRange
from torchpose.errors import InputError
from torchpose.learning._recipes.calibration import DRAWN
from torchpose.learning._recipes.settings import RecipeSettings
from torchpose.learning._recipes.upper_body import VERSION, UpperBodyRecipe, fit_kinect_prior
from torchpose.learning._samplers import SampleSource
from torchpose.learning._training import DEFAULT_RATE, RecordingLike, arm_poses
from torchpose.priors._gaussian_mixture import GaussianMixture
from torchpose.priors._upper_body_prior import UpperBodyPrior
from torchpose.priors._window import WindowLayout
from torchpose.skeleton._upper_body import LEFT_ARM, RIGHT_ARM

_OVER_POSES = ("pose", *DRAWN)
_OF_PROCESS_NOISE = (
    "process_cov",
    *(f"calibration_{what}_{mode}" for what in ("scale", "floor") for mode in _OVER_POSES),
)
"""Beginnings of the names of noise that is learnt anew, or no longer holds."""

# nats: every second recording of the shipped prior's differs by 0.4, and bodies that are 5 % larger by 1.1
_SAME_LIKELIHOOD = 0.1
_SAME_FRAMES = 0.01  # share of them that another curation may leave out
_SAMPLING = 4.0  # standard errors, where there are few states


def fit_recipe_2(
    recordings: Sequence[RecordingLike], **settings: Unpack[RecipeSettings]
) -> UpperBodyPrior:
    """Fit the recipe of the first shipped prior: windows without torso axes, bodies of less variety.

    Args:
        recordings: the recordings, in camera axes. settings: to `fit_kinect_prior`.
    """
    usual: RecipeSettings = {
        "body_size": 0.15,
        "bone_lengths": 0.10,
        "causal": WindowLayout((4, 10, 20), (0, 10)),
        "full": WindowLayout((4, 8, 16, -4, -8, -16), (0, 8, -8)),
    }
    usual.update(settings)
    return fit_kinect_prior(recordings, **usual)


def renew_noise(
    prior: UpperBodyPrior,
    recordings: Sequence[RecordingLike],
    *,
    calibration_folds: int = 6,
    drawn_pieces: int = 6,
    name: str = "",
    licence: str = "",
    command: str = "",
    progress: bool = False,
) -> UpperBodyPrior:
    """Return a prior with the process noise, and the calibration over single poses, of this recipe.

    Mixtures and windows, with their calibration, stay as they are; persons are held out in turn as by
    `UpperBodyRecipe.calibrate`, with the number of components, camera and seed of the prior. Calibrations
    over single poses that are not learnt anew are dropped: they are those of other noise.

    Args:
        prior: that the recipe fitted. recordings: those that it was fitted on.
        calibration_folds: groups of persons that are held out in turn. drawn_pieces: of each.
        name, licence: instead of the prior's own. command: to be noted. progress: whether to show a bar.

    Raises:
        InputError: other recordings than the prior's: of other persons, at another frame rate, with other
            joints, or with other poses.
    """
    info = prior.info
    recipe = _recipe_of(prior, calibration_folds, drawn_pieces)
    _check_recordings(prior, recipe, recordings)
    kept = {name: v for name, v in prior.noise.items() if not name.startswith(_OF_PROCESS_NOISE)}
    noise = kept | recipe.process_noise(prior, recordings)
    extra = _without_results(info.extra) | {"noise": {"recipe": VERSION, "command": command}}
    info = replace(info, name=name or info.name, licence=licence or info.licence, extra=extra)
    renewed = UpperBodyPrior(prior.left, prior.right, info, noise, prior.windows)
    return recipe.calibrate(renewed, recordings, progress)


def _without_results(extra: Mapping[str, Any]) -> dict[str, Any]:
    """Return facts about a prior without errors of the filters that its process noise matters to."""
    held_out = {mode: e for mode, e in extra.get("held_out", {}).items() if mode not in _OVER_POSES}
    kept = {
        name: fact for name, fact in extra.items() if name not in ("held_out", "held_out_drawn")
    }
    return kept | ({"held_out": held_out} if held_out else {})


def _recipe_of(prior: UpperBodyPrior, calibration_folds: int, drawn_pieces: int) -> UpperBodyRecipe:
    """Return the recipe of a prior's mixtures over poses."""
    info = prior.info
    return UpperBodyRecipe(
        n_components=prior.n_components,
        n_samples=info.n_samples or UpperBodyRecipe.n_samples,
        window_components=0,
        views=ViewRange(**info.views),
        calibration_folds=calibration_folds,
        drawn_pieces=drawn_pieces,
        seed=info.extra.get("seed", 0),
        camera_matrix=(info.fx, info.fy, info.cx, info.cy),
        rotation_order=info.rotation_order,
        neck=info.neck,
        mirror=info.mirrored,
        nose_as_head=info.extra.get("head") == "nose",
    )


def _check_recordings(
    prior: UpperBodyPrior, recipe: UpperBodyRecipe, recordings: Sequence[RecordingLike]
) -> None:
    """Raise `InputError` unless the prior was fitted to these recordings."""
    info = prior.info
    persons = sorted({r.person_id for r in recordings})
    if persons != sorted(info.persons):
        raise InputError(
            "the noise of a prior is learnt on the persons that it was fitted on, expected recordings "
            f"of {', '.join(sorted(info.persons)) or 'nobody'}, got {', '.join(persons)}"
        )
    other = _other_joints(prior, recordings) or _other_poses(prior, recipe, recordings)
    if other:
        raise InputError(
            "the noise of a prior is learnt on the recordings that it was fitted to, "
            f"{'; '.join(other)}; give those, with the same axes and curation, or fit a new prior"
        )


def _other_joints(prior: UpperBodyPrior, recordings: Sequence[RecordingLike]) -> list[str]:
    """Return sentences on joints of a prior that no recording has, or has of another kind."""
    nose = prior.info.extra.get("head") == "nose"
    bodies = [r.upper_body(nose) for r in recordings]
    wanted = {
        "neck": prior.info.neck,
        "hand": prior.info.hand,
        "head": prior.info.extra.get("head"),
    }
    found = []
    for joint, kind in wanted.items():
        there = sorted({str(getattr(body, joint) or "unknown") for body in bodies})
        if kind is not None and kind not in there:
            found.append(
                f"expected the {joint} to be of the kind {kind!r}, got {' and '.join(there)}"
            )
    return found


def _other_poses(
    prior: UpperBodyPrior, recipe: UpperBodyRecipe, recordings: Sequence[RecordingLike]
) -> list[str]:
    """Return sentences on how counts, rate and states differ from those that the recipe fitted a prior to."""
    found = []
    poses, info = recipe.poses(recordings), prior.info
    count, own = info.extra.get("recordings", len(recordings)), len(recordings)
    if count != own:
        found.append(f"expected {counted(count, 'recording')}, got {own}")
    known = [arm_poses(poses, arm).known for arm in (LEFT_ARM, RIGHT_ARM)]
    frames = int((known[0] | known[1]).sum())
    if info.n_frames and abs(frames - info.n_frames) > _SAME_FRAMES * info.n_frames:
        found.append(f"expected {counted(info.n_frames, 'frame')} with a whole arm, got {frames}")
    usual, rate = (float(fps or DEFAULT_RATE) for fps in (info.fps, poses.facts["fps"]))
    if not same_rate(usual, rate):
        found.append(f"expected {usual:g} frames per second, got {rate:g}")
    before = info.extra.get("fit", {}).get("log_likelihood")
    if before is not None:
        now, error = _mean_likelihood(prior.left, recipe.tasks(recordings)["pose"].source)
        if not abs(now - before) <= _SAME_LIKELIHOOD + _SAMPLING * error:
            found.append(
                f"expected poses with a log-likelihood of {before:.2f} nats under it, got {now:.2f} (other "
                "poses, joints, units or axes)"
            )
    return found


def _mean_likelihood(mixture: GaussianMixture, source: SampleSource) -> tuple[float, float]:
    """Return the mean log density of the states of a source, nats, and its standard error."""
    sums = torch.zeros(4, dtype=torch.float64)
    for index in range(source.n_blocks):
        states, weight = source.block(index)
        density = mixture.log_prob(states)
        powers = torch.stack([torch.ones_like(density), density, density.square()])
        sums += torch.cat([powers @ weight, weight.square().sum()[None]])
    total, first, second, squares = sums.tolist()
    mean = first / total
    return mean, max(second / total - mean**2, 0.0) ** 0.5 * squares**0.5 / total
