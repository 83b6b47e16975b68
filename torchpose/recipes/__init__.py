"""How priors are made: every setting of a fit in one place, and the steps from recordings to a file."""

from torchpose.recipes.calibration import fit_calibration
from torchpose.recipes.earlier import fit_recipe_2
from torchpose.recipes.upper_body import VERSION, MixtureTask, UpperBodyRecipe, fit_kinect_prior

__all__ = [
    "VERSION",
    "MixtureTask",
    "UpperBodyRecipe",
    "fit_calibration",
    "fit_kinect_prior",
    "fit_recipe_2",
]
