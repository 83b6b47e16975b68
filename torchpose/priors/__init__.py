"""Learned priors over body states: mixtures of both arms, manifolds, postures of actions."""

from torchpose._core.facade import set_up_facade
from torchpose.priors.actions.bank import ActionBank
from torchpose.priors.actions.file import ActionInfo
from torchpose.priors.actions.space import ActionSpace
from torchpose.priors.arm_state import arm_state, arm_states, mirror_arm_state, mirror_mixture
from torchpose.priors.gaussian_mixture import ConditionedMixture, GaussianMixture
from torchpose.priors.manifold.file import ManifoldInfo
from torchpose.priors.manifold.gplvm import BackConstrainedGPLVM
from torchpose.priors.prior_file import PriorInfo
from torchpose.priors.shipped import (
    known_models,
    load_action,
    load_limb_conditionals,
    load_manifold,
)
from torchpose.priors.upper_body import (
    UpperBodyPrior,
    known_priors,
    load_prior,
)

__all__ = [
    "ActionBank",
    "ActionInfo",
    "ActionSpace",
    "BackConstrainedGPLVM",
    "ConditionedMixture",
    "GaussianMixture",
    "ManifoldInfo",
    "PriorInfo",
    "UpperBodyPrior",
    "arm_state",
    "arm_states",
    "known_models",
    "known_priors",
    "load_action",
    "load_limb_conditionals",
    "load_manifold",
    "load_prior",
    "mirror_arm_state",
    "mirror_mixture",
]

set_up_facade(__name__)
