"""Learned priors over body states: mixtures of both arms, manifolds, postures of actions."""

from torchpose.priors.action_bank import ActionBank
from torchpose.priors.action_space import ActionInfo, ActionSpace
from torchpose.priors.arm_state import arm_state, arm_states, mirror_arm_state, mirror_mixture
from torchpose.priors.em import (
    FitReport,
    MixtureParameters,
    SufficientStatistics,
    e_step,
    expectation_maximisation,
    m_step,
)
from torchpose.priors.gmm import ConditionedMixture, GaussianMixture
from torchpose.priors.gplvm import BackConstrainedGPLVM
from torchpose.priors.manifold_file import ManifoldInfo
from torchpose.priors.model_card import model_card, write_model_card
from torchpose.priors.neck import (
    NeckFraction,
    NeckOffset,
    learn_neck_fraction,
    learn_neck_offset,
    place_neck,
)
from torchpose.priors.prior_file import PriorInfo
from torchpose.priors.shipped import (
    known_models,
    load_action,
    load_limb_conditionals,
    load_manifold,
)
from torchpose.priors.training import TRAINING_VIEWS, arm_sources, collect_poses
from torchpose.priors.upper_body import (
    UpperBodyPrior,
    fit_upper_body_prior,
    known_priors,
    load_prior,
)

__all__ = [
    "TRAINING_VIEWS",
    "ActionBank",
    "ActionInfo",
    "ActionSpace",
    "BackConstrainedGPLVM",
    "ConditionedMixture",
    "FitReport",
    "GaussianMixture",
    "ManifoldInfo",
    "MixtureParameters",
    "NeckFraction",
    "NeckOffset",
    "PriorInfo",
    "SufficientStatistics",
    "UpperBodyPrior",
    "arm_sources",
    "arm_state",
    "arm_states",
    "collect_poses",
    "e_step",
    "expectation_maximisation",
    "fit_upper_body_prior",
    "known_models",
    "known_priors",
    "learn_neck_fraction",
    "learn_neck_offset",
    "load_action",
    "load_limb_conditionals",
    "load_manifold",
    "load_prior",
    "m_step",
    "mirror_arm_state",
    "mirror_mixture",
    "model_card",
    "place_neck",
    "write_model_card",
]
