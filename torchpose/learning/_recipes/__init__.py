"""Make priors from recordings: settings of each fit, and the steps from recordings to a file."""

from torchpose.learning._recipes.actions import ActionRecipe, Performances, fit_actions
from torchpose.learning._recipes.body_motion import RecordedMotion, fit_motion
from torchpose.learning._recipes.calibration import fit_calibration
from torchpose.learning._recipes.earlier import fit_recipe_2
from torchpose.learning._recipes.limbs import LimbStates, fit_limbs
from torchpose.learning._recipes.manifold import ManifoldFitting, ManifoldPoses, ManifoldRecipe
from torchpose.learning._recipes.upper_body import VERSION, UpperBodyRecipe, fit_kinect_prior
from torchpose.learning._streamed_em import MixtureTask

__all__ = [
    "VERSION",
    "ActionRecipe",
    "LimbStates",
    "ManifoldFitting",
    "ManifoldPoses",
    "ManifoldRecipe",
    "MixtureTask",
    "Performances",
    "RecordedMotion",
    "UpperBodyRecipe",
    "fit_actions",
    "fit_calibration",
    "fit_kinect_prior",
    "fit_limbs",
    "fit_motion",
    "fit_recipe_2",
]
