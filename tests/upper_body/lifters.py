"""Networks that lift arms, of which tests know what they tell."""

import torch

from torchpose.camera._virtual_camera import axes_along
from torchpose.priors._arm_lifter import ArmLifter, LiftedArms
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body._articulated_frame import LIMBS, SHOULDERS

UNSURE = ArmLifter().requires_grad_(False)
"""A network that is not sure of anything, so that nothing is averaged with it."""
torch.nn.init.constant_(UNSURE.spread.bias, 20.0)


class Told(ArmLifter):
    """A network that is sure of the elbows and hands of these joints [T, 8, 3], frame by frame."""

    def __init__(self, joints):
        super().__init__()
        arms = joints[:, list(LIMBS)].unflatten(1, (2, 2))
        ends = arms - joints[:, SHOULDERS, None]
        self.told = (ends.flatten(1, 2) @ axes_along(joints[:, UPPER_BODY.index("neck")])).view_as(
            ends
        )

    def forward(self, seen):
        ends = self.told.expand(*seen.shape[:-2], *self.told.shape)
        return LiftedArms(ends, torch.full_like(ends[..., 0], 0.05))
