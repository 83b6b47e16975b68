"""Follow one person among the people whom a detector found in each frame.

Everybody is tracked, so that who stands nearby is not taken for a person who is hidden. A detection is that
of somebody seen n frames ago rather than that of somebody new by the log odds

    g = log N(d; 0, s_n^2 I) - log N(0; 0, s_new^2 I),    s_n = min(s_1 + (n - 1) s_grow, s_most),

where d is the mean distance of the keypoints that both have, in sizes of the person. The assignment of
detections to persons with the largest sum of log odds is taken, and none below 0.
"""

from collections.abc import Sequence

import numpy as np

from torchpose._core.assignment import best_columns

_NEAR = 0.08  # sizes of a person, standard deviation of the way from one frame to the next
_GROWTH = 0.02  # growth of that deviation with every frame without the person
_FARTHEST = 5.0  # sizes, the largest such deviation
_ANYWHERE = 10.0  # sizes, standard deviation of where somebody new is
_SAME = 0.1  # sizes, within which two detections are of one person
_FORGOTTEN = 100  # frames without a person other than the followed one
_LEAST_SIZE = 1.0  # pixels


def follow_person(frames: Sequence[Sequence[np.ndarray]], n_joints: int) -> np.ndarray:
    """Return the keypoints [T, J, 3] of one person, 0 where not seen.

    It is the one of largest mean confidence in the first frame with people. If no frame has several people,
    it is whoever is there.

    Args:
        frames: people [J, 3] (u, v, confidence) of each frame. n_joints: J.
    """
    table = np.zeros((len(frames), n_joints, 3))
    if max(map(len, frames)) < 2:
        for row, group in enumerate(frames):
            table[row] = group[0] if group else 0.0
        return table
    last, age = np.zeros((0, n_joints, 3)), np.zeros(0)  # of everybody, the followed person first
    for row, group in enumerate(frames):
        age = age + 1
        if not group:
            continue
        people = np.stack(group)
        if not len(last):
            people = people[np.argsort(-people[..., 2].mean(-1), kind="stable")]
            last, age = people[:1], np.ones(1)
        chosen = _choose(last, age, people)
        found = chosen >= 0
        if found[0]:
            table[row] = people[chosen[0]]
        last[found], age[found] = people[chosen[found]], 0
        new = _newcomers(people, chosen[found])
        kept = age < _FORGOTTEN
        kept[0] = True
        last = np.concatenate([last[kept], new])
        age = np.concatenate([age[kept], np.zeros(len(new))])
    return table


def _choose(last: np.ndarray, age: np.ndarray, people: np.ndarray) -> np.ndarray:
    """Return the row in people [P, J, 3] of everybody who was seen before [N, J, 3], -1 if none.

    Where nobody in the frame has a keypoint in common with the followed person, it is the most confident of
    those who are nobody else.
    """
    distance = _distances(last, people)
    spread = np.minimum(_NEAR + (age - 1) * _GROWTH, _FARTHEST)[:, None]
    gains = 2 * np.log(_ANYWHERE / spread) - distance**2 / (2 * spread**2)
    chosen = best_columns(gains.clip(min=0.0))
    chosen[gains[np.arange(len(last)), chosen] <= 0] = -1
    free = np.setdiff1d(np.arange(len(people)), chosen)
    if chosen[0] < 0 and len(free) and np.isinf(distance[0]).all():
        chosen[0] = free[people[free, :, 2].mean(-1).argmax()]
    return chosen


def _newcomers(people: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return the people [N, J, 3] who are nobody, without second detections of who is there."""
    free = np.setdiff1d(np.arange(len(people)), chosen)
    near = _distances(people[chosen], people[free]) < _SAME
    return people[free[~near.any(0)]]


def _distances(some: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the mean distances [N, P] of the keypoints that both have, in sizes of the first.

    Infinity where they have none in common.
    """
    both = (some[:, None, :, 2] > 0) & (others[..., 2] > 0)
    gaps = np.linalg.norm(some[:, None, :, :2] - others[..., :2], axis=-1)
    shared = both.sum(-1)
    mean = np.where(both, gaps, 0.0).sum(-1) / np.maximum(shared, 1)
    return np.where(shared > 0, mean / _sizes(some)[:, None], np.inf)


def _sizes(people: np.ndarray) -> np.ndarray:
    """Return the larger sides of the boxes around keypoints [N, J, 3], pixels."""
    seen = people[..., 2:] > 0
    low = np.where(seen, people[..., :2], np.inf).min(1)
    high = np.where(seen, people[..., :2], -np.inf).max(1)
    return np.maximum((high - low).max(-1), _LEAST_SIZE)
