"""Say whether inputs are in another order than their cameras: which order lets cameras agree on joints."""

from collections.abc import Sequence
from itertools import combinations, permutations

import torch

from torchpose.whole_body._keypoints.joint_triangulation import agreeing
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame, RigMaps

_FRAMES = 20  # that are looked at, at most
_EVERY_ORDER = 4  # cameras, of which every order is tried; of more, exchanges of two
_AGREED = 0.7  # share of the keypoints that cameras have to agree on in another order
_MORE = 0.25  # by how much that is more than in the order of the inputs, and in any other


def notes_on_order(names: Sequence[str], maps: RigMaps, frames: KeypointFrame) -> tuple[str, ...]:
    """Return a note if keypoints agree far better in another order of the inputs.

    Args:
        names: of the cameras. maps: of them. frames: keypoints [T, C, J].
    """
    count = len(names)
    orders = list(permutations(range(count))) if count <= _EVERY_ORDER else _exchanges(count)
    stride = max(1, -(-len(frames.pixels) // _FRAMES))
    some = frames.map(lambda value: value[::stride])
    tried = some.map(lambda value: value[:, torch.tensor(orders)].flatten(0, 1))
    agreed = agreeing(maps, tried).unflatten(0, (-1, len(orders))).sum((0, 2, 3))
    share = agreed / (some.inlier > 0).sum().clamp_min(1)
    first, second = share.topk(2).values.tolist()
    best = int(share.argmax())
    known = first > max(_AGREED, share[0] + _MORE) and (best > 0) and first > second + _MORE / 2
    if not known:
        return ()
    fits = ", ".join(f"input {orders[best][c] + 1} is of {names[c]}" for c in range(count))
    return (
        f"inputs seem to be in another order than the cameras: cameras agree on {100 * first:.0f} % of the "
        f"keypoints if {fits}, and on {100 * float(share[0]):.0f} % as they are given; give them in the "
        "order of the cameras",
    )


def _exchanges(count: int) -> list[tuple[int, ...]]:
    """Return the order as it is, and those with two exchanged."""
    own = list(range(count))
    orders = [tuple(own)]
    for a, b in combinations(own, 2):
        order = own.copy()
        order[a], order[b] = b, a
        orders.append(tuple(order))
    return orders
