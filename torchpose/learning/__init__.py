"""Learn priors from recordings: EM over many samples, fits, recipes, curation, fine-tuning."""

from torchpose._core.facade import set_up_facade
from torchpose.learning._action_spaces import fit_action_space
from torchpose.learning._curation.curate import CurationSettings, curate
from torchpose.learning._curation.splits import leave_one_person_out, split_persons
from torchpose.learning._limb_conditionals_fit import fit_limb_conditionals
from torchpose.learning._manifolds import fit_gplvm, fit_gplvm_noise
from torchpose.learning._performances import repetition_axis, split_repetitions
from torchpose.learning._recipes.actions import ActionRecipe, fit_actions
from torchpose.learning._recipes.limbs import fit_limbs
from torchpose.learning._recipes.manifold import ManifoldRecipe
from torchpose.learning._recipes.upper_body import UpperBodyRecipe, fit_kinect_prior
from torchpose.learning._training import TRAINING_VIEWS
from torchpose.learning._upper_body_prior_fit import fit_upper_body_prior

__all__ = [
    "TRAINING_VIEWS",
    "ActionRecipe",
    "CurationSettings",
    "ManifoldRecipe",
    "UpperBodyRecipe",
    "curate",
    "fit_action_space",
    "fit_actions",
    "fit_gplvm",
    "fit_gplvm_noise",
    "fit_kinect_prior",
    "fit_limb_conditionals",
    "fit_limbs",
    "fit_upper_body_prior",
    "leave_one_person_out",
    "repetition_axis",
    "split_persons",
    "split_repetitions",
]

set_up_facade(__name__)
