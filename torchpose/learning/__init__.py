"""Learn priors from recordings: EM over many samples, fits, recipes, curation, fine-tuning."""

from torchpose._core.facade import set_up_facade
from torchpose.learning.action_spaces import fit_action_space
from torchpose.learning.limb_conditionals import fit_limb_conditionals
from torchpose.learning.manifolds import fit_gplvm, fit_gplvm_noise
from torchpose.learning.model_card import model_card, write_model_card
from torchpose.learning.training import TRAINING_VIEWS, arm_sources, collect_poses
from torchpose.learning.upper_body import fit_upper_body_prior

__all__ = [
    "TRAINING_VIEWS",
    "arm_sources",
    "collect_poses",
    "fit_action_space",
    "fit_gplvm",
    "fit_gplvm_noise",
    "fit_limb_conditionals",
    "fit_upper_body_prior",
    "model_card",
    "write_model_card",
]

set_up_facade(__name__)
