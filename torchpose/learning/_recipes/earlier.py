"""Recipes of priors that were shipped before, to compare with on the same persons."""

from collections.abc import Sequence
from typing import Any

from torchpose.learning._recipes.upper_body import fit_kinect_prior
from torchpose.learning._training import RecordingLike
from torchpose.priors._upper_body import UpperBodyPrior
from torchpose.priors._window import WindowLayout

__all__ = ["VERSION", "fit_recipe_2"]

VERSION = "2"


def fit_recipe_2(recordings: Sequence[RecordingLike], **settings: Any) -> UpperBodyPrior:
    """The recipe of the first shipped prior: windows without torso axes, bodies of less variety.

    Args:
        recordings: in camera axes. settings: to `fit_kinect_prior`.
    """
    layouts = {
        "causal": WindowLayout((4, 10, 20), (0, 10)),
        "full": WindowLayout((4, 8, 16, -4, -8, -16), (0, 8, -8)),
    }
    return fit_kinect_prior(
        recordings, **({"body_size": 0.15, "bone_lengths": 0.10} | layouts | settings)
    )
