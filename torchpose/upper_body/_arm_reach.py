"""Weigh poses of arms that joints do not reach.

An upper arm that hangs goes back by about 60 degrees, one at the height of the shoulder by less than 30, and
an elbow does not bend backwards. With the shares y downwards and z backwards of the unit vectors u of the
upper arm and f of the forearm,

    log r = -e(u_z - 0.45 - 0.9 [u_y]) - e(f_z - [u_z] - 0.2 - 0.4 (1 - [u_y])),
    e(x) = min([x]^2 / (2 s^2), 8),   [x] = max(x, 0),   s = 0.1.

The limits are soft, and nothing is quite impossible, since the axes are upright while a trunk may lean. The
prior cannot say this: hypotheses walk from frame to frame to where it is low without a loss.
"""

from __future__ import annotations

import math

from jaxtyping import Float
from torch import Tensor

from torchpose.upper_body._limb_nodes import LimbNodes

# Share backwards of an upper arm: as it is raised, and more as it hangs.
_RAISED, _LOWERED = 0.45, 0.9
# Of a forearm beyond the upper arm: as that hangs, and more as it is raised.
_STRAIGHT, _TURNED = 0.2, 0.4
_SHARPNESS = 1 / (0.1 * math.sqrt(2.0))  # 1 / (s 2^0.5)
_MOST = math.sqrt(8.0)  # the most of the root of e


def loss_beyond_reach(upper: LimbNodes, lower: LimbNodes) -> Float[Tensor, "*batch U G"]:
    """Return -log r of all pairs of nodes, in upright axes of the trunk: to the left, down, to the back.

    Args:
        upper: nodes of upper arms. lower: of the forearms from each of them.
    """
    down, back = upper.directions[..., 1:].unbind(-1)
    down, behind = down.clamp_min(0.0), back.clamp_min(0.0)
    of_upper = _SHARPNESS * (back - _RAISED - _LOWERED * down)
    limit = _SHARPNESS * (behind + _STRAIGHT + _TURNED * (1.0 - down))
    forearm = (_SHARPNESS * lower.axes[..., 2]) @ lower.turns.mT
    # in place: memory for as many numbers again takes longer than the arithmetic
    loss = (forearm - limit[..., None]).clamp_(0.0, _MOST).square_()
    return loss.add_(of_upper.clamp(0.0, _MOST).square()[..., None])
