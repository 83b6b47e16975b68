"""Say whether inputs are in another order than their cameras: which order lets cameras agree on joints."""

from collections.abc import Sequence
from itertools import combinations, permutations

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.whole_body._keypoints.joint_triangulation import agreement, agreement_of_each
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame, RigMaps

_FRAMES = 20  # that are looked at, at most
_EVERY_ORDER = 4  # cameras, of which every order is tried; of more, exchanges of two
WELL = 0.8
"""Agreement that another reading of what was given has to reach."""
MORE = 0.08
"""By how much this is more than as it was given."""


def notes_on_order(names: Sequence[str], maps: RigMaps, frames: KeypointFrame) -> tuple[str, ...]:
    """Return a note if cameras agree far better in another order of the inputs.

    Args:
        names: of the cameras. maps: of them. frames: keypoints [T, C, J].
    """
    orders, agreed = agreement_of_orders(maps, some_frames(frames))
    first, second = agreed.topk(2).values.tolist()
    best = int(agreed.argmax())
    if best == 0 or first < max(WELL, agreed[0] + MORE):
        return ()
    fits = ", ".join(f"input {orders[best][c] + 1} is of {names[c]}" for c in range(len(names)))
    several = ", hardly less in others," if first < second + MORE / 2 else ""
    return (
        f"inputs seem to be in another order than the cameras: cameras agree on {100 * first:.0f} % of the "
        f"keypoints if {fits}{several} and on {100 * float(agreed[0]):.0f} % as they are given; give them "
        "in the order of the cameras",
    )


def agree_as_given(maps: RigMaps, frames: KeypointFrame) -> bool:
    """Return whether cameras agree so well that by no other reading they can agree by `MORE` better.

    Args:
        maps: the cameras. frames: keypoints [T, C, J].
    """
    return float(agreement(maps, some_frames(frames))) + MORE > 1


def agreement_of_orders(
    maps: RigMaps, some: KeypointFrame
) -> tuple[list[tuple[int, ...]], Float[Tensor, " N"]]:
    """Return the orders of inputs that are tried, the given one first, and how well cameras agree in each.

    Args:
        maps: the cameras. some: keypoints [T, C, J] of some frames.
    """
    count = some.pixels.shape[1]
    orders = list(permutations(range(count))) if count <= _EVERY_ORDER else _exchanges(count)
    return orders, agreement_of_readings(maps, some.map(lambda v: v[:, torch.tensor(orders)]))


def agreement_of_readings(maps: RigMaps, tried: KeypointFrame) -> Float[Tensor, " N"]:
    """Return how well cameras agree by each of N readings of keypoints [T, N, C, J]."""
    count = tried.pixels.shape[1]
    flat = tried.map(lambda value: value.flatten(0, 1))
    good, seen = (v.unflatten(0, (-1, count)).sum(0) for v in agreement_of_each(maps, flat))
    return good / seen.clamp_min(1)


def some_frames(frames: KeypointFrame) -> KeypointFrame:
    """Return frames [T, ...] of all, few enough to try several readings."""
    stride = max(1, -(-len(frames.pixels) // _FRAMES))
    return frames.map(lambda value: value[::stride])


def _exchanges(count: int) -> list[tuple[int, ...]]:
    """Return the order as it is, and those with two exchanged."""
    own = list(range(count))
    orders = [tuple(own)]
    for a, b in combinations(own, 2):
        order = own.copy()
        order[a], order[b] = b, a
        orders.append(tuple(order))
    return orders
