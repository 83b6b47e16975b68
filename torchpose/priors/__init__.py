"""Hold learnt priors over body states: mixtures of both arms, manifolds, postures of actions."""

from torchpose._core.facade import set_up_facade
from torchpose.priors._actions.bank import ActionBank
from torchpose.priors._actions.postures import posture_angles, posture_to_state, state_postures
from torchpose.priors._actions.space import ActionSpace
from torchpose.priors._gaussian_mixture import ConditionedMixture, GaussianMixture
from torchpose.priors._limb_conditionals import in_body_frame
from torchpose.priors._manifold.gplvm import BackConstrainedGPLVM
from torchpose.priors._manifold.manifold_file import ManifoldInfo
from torchpose.priors._shipped import (
    known_models,
    load_action,
    load_limb_conditionals,
    load_manifold,
)
from torchpose.priors._upper_body_prior import UpperBodyPrior, known_priors, load_prior

__all__ = [
    "ActionBank",
    "ActionSpace",
    "BackConstrainedGPLVM",
    "ConditionedMixture",
    "GaussianMixture",
    "ManifoldInfo",
    "UpperBodyPrior",
    "in_body_frame",
    "known_models",
    "known_priors",
    "load_action",
    "load_limb_conditionals",
    "load_manifold",
    "load_prior",
    "posture_angles",
    "posture_to_state",
    "state_postures",
]

set_up_facade(__name__)
