"""How priors are made: every setting of a fit in one place, and the steps from recordings to a file."""

from torchpose.recipes.actions import ActionRecipe, Performances, fit_actions
from torchpose.recipes.calibration import fit_calibration
from torchpose.recipes.earlier import fit_recipe_2
from torchpose.recipes.limbs import LimbStates, fit_limbs
from torchpose.recipes.manifold import ManifoldFitting, ManifoldPoses, ManifoldRecipe
from torchpose.recipes.upper_body import VERSION, MixtureTask, UpperBodyRecipe, fit_kinect_prior

__all__ = [
    "VERSION",
    "ActionRecipe",
    "LimbStates",
    "ManifoldFitting",
    "ManifoldPoses",
    "ManifoldRecipe",
    "MixtureTask",
    "Performances",
    "UpperBodyRecipe",
    "fit_actions",
    "fit_calibration",
    "fit_kinect_prior",
    "fit_limbs",
    "fit_recipe_2",
]
