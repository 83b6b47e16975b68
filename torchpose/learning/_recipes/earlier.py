"""Fit an earlier version of the upper-body recipe, and renew the noise of priors from earlier versions."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Unpack

from torchpose.camera._viewpoints import ViewRange
from torchpose.errors import InputError
from torchpose.learning._recipes.settings import RecipeSettings
from torchpose.learning._recipes.upper_body import VERSION, UpperBodyRecipe, fit_kinect_prior
from torchpose.learning._training import RecordingLike
from torchpose.priors._upper_body_prior import UpperBodyPrior
from torchpose.priors._window import WindowLayout


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
    `UpperBodyRecipe.calibrate`, with the number of components, camera and seed of the prior.

    Args:
        prior: that the recipe fitted. recordings: those that it was fitted on.
        calibration_folds: groups of persons that are held out in turn. drawn_pieces: of each.
        name, licence: instead of the prior's own. command: to be noted. progress: whether to show a bar.

    Raises:
        InputError: recordings of other persons than the prior's.
    """
    info = prior.info
    persons = sorted({r.person_id for r in recordings})
    if persons != sorted(info.persons):
        raise InputError(
            "the noise of a prior is learnt on the persons that it was fitted on, expected recordings "
            f"of {', '.join(sorted(info.persons)) or 'nobody'}, got {', '.join(persons)}"
        )
    recipe = UpperBodyRecipe(
        n_components=prior.n_components,
        window_components=0,
        views=ViewRange(**info.views),
        calibration_folds=calibration_folds,
        drawn_pieces=drawn_pieces,
        seed=info.extra.get("seed", 0),
        camera_matrix=(info.fx, info.fy, info.cx, info.cy),
        rotation_order=info.rotation_order,
        neck=info.neck,
        mirror=info.mirrored,
    )
    kept = {name: v for name, v in prior.noise.items() if not name.startswith("process_cov")}
    noise = kept | recipe.process_noise(prior, recordings)
    info = replace(
        info, name=name or info.name, licence=licence or info.licence,
        extra=info.extra | {"noise": {"recipe": VERSION, "command": command}},
    )  # fmt: skip
    renewed = UpperBodyPrior(prior.left, prior.right, info, noise, prior.windows)
    return recipe.calibrate(renewed, recordings, progress)
