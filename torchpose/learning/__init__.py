"""Learn priors from recordings: EM over many samples, fits, recipes, curation, fine-tuning."""

from torchpose.learning.model_card import write_model_card
from torchpose.learning.training import TRAINING_VIEWS, arm_sources, collect_poses

__all__ = ["TRAINING_VIEWS", "arm_sources", "collect_poses", "write_model_card"]
