"""Learned priors over body states: mixtures of both arms, manifolds, postures of actions."""

from torchpose._core.facade import set_up_facade
from torchpose.priors._actions.bank import ActionBank
from torchpose.priors._actions.space import ActionSpace
from torchpose.priors._arm_state import arm_state
from torchpose.priors._gaussian_mixture import ConditionedMixture, GaussianMixture
from torchpose.priors._manifold.file import ManifoldInfo
from torchpose.priors._manifold.gplvm import BackConstrainedGPLVM
from torchpose.priors._shipped import (
    known_models,
    load_action,
    load_limb_conditionals,
    load_manifold,
)
from torchpose.priors._upper_body import UpperBodyPrior, known_priors, load_prior

__all__ = [
    "ActionBank",
    "ActionSpace",
    "BackConstrainedGPLVM",
    "ConditionedMixture",
    "GaussianMixture",
    "ManifoldInfo",
    "UpperBodyPrior",
    "arm_state",
    "known_models",
    "known_priors",
    "load_action",
    "load_limb_conditionals",
    "load_manifold",
    "load_prior",
]

set_up_facade(__name__)
