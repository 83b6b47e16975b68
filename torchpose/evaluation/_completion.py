"""Head, hands and neck for motion capture that has none: a conditional Gaussian learnt on Kinects.

In the frame of a person's own trunk,
    y = W [x, 1] + e,  e ~ N(0, S),
with y the head from the middle of the shoulders and each hand from its wrist, and x shoulders,
elbows, wrists and hip centre: the conditional of a joint Gaussian over all of them. The residual e
is mostly the person's own build, so it is drawn once for a recording, not for every frame.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.errors import PriorError, SkeletonError
from torchpose.io._recordings import Recording, cut_recording
from torchpose.skeleton._joint_sets import UPPER_BODY, canonical_names
from torchpose.skeleton._torso import NeckOffset, learn_neck_offset, place_neck

_KNOWN = ("hip_center", "shoulder_left", "shoulder_right", "elbow_left", "elbow_right",
          "wrist_left", "wrist_right")  # fmt: skip
_HIP, _LEFT, _RIGHT = 0, 1, 2
_BASES = {"head": None, "hand_left": "wrist_left", "hand_right": "wrist_right"}
_RIDGE = 1e-6
_LEAST_FRAMES = 100
_FACING = 0.6  # cosine of the largest angle between the shoulders' line and the image
_SHORTEST = 30  # frames of a part that faces the camera
_AS_WRIST = tuple(name.replace("hand", "wrist").replace("neck", "shoulder_center")
                  for name in UPPER_BODY)  # fmt: skip
_AS_HAND = tuple(name.replace("neck", "shoulder_center") for name in UPPER_BODY)


class Completion(NamedTuple):
    """Holds the conditional Gaussian of missing joints, and the position of the neck.

    Attributes:
        targets: the joints y. weights: W. covariance: S. neck: of the recordings it was learnt on.
        spread: root mean square residual of each target, metres. frames: how many there were.
        persons: whose they were.
    """

    targets: tuple[str, ...]
    weights: Float[Tensor, "F Y"]
    covariance: Float[Tensor, "Y Y"]
    neck: NeckOffset
    spread: dict[str, float]
    frames: int
    persons: tuple[str, ...]


def learn_completion(
    recordings: Sequence[Recording], targets: Sequence[str] = ("head", "hand_left", "hand_right")
) -> Completion:
    """Fit a linear map by least squares on recordings that have the targets, wrists and hips.

    Args:
        recordings: those without wrists, hips or one of the targets are passed over.
        targets: the targets of head, hand_left and hand_right.

    Raises:
        PriorError: fewer than 100 frames with all of them.
    """
    usable = [r for r in recordings if {*_KNOWN, *targets, "head"} <= _names(r)]
    known = torch.cat([_joints(r, _KNOWN) for r in usable] or [torch.zeros(0, 7, 3)]).double()
    wanted = torch.cat([_joints(r, targets) for r in usable] or [torch.zeros(0, 1, 3)]).double()
    whole = torch.isfinite(known).flatten(1).all(1) & torch.isfinite(wanted).flatten(1).all(1)
    if int(whole.sum()) < _LEAST_FRAMES:
        raise PriorError(
            f"completing joints needs {_LEAST_FRAMES} frames with {', '.join((*_KNOWN, *targets))}, "
            f"got {int(whole.sum())}; add Kinect recordings of whole persons"
        )
    known, wanted = known[whole], wanted[whole]
    frame, middle = _trunk(known)
    y = torch.stack(
        [wanted[:, i] - _base(known, target, middle) for i, target in enumerate(targets)], 1
    )
    y = (y @ frame).flatten(1)
    x = _features(known, frame, middle)
    ridge = _RIDGE * len(x) * torch.eye(x.shape[1], dtype=torch.float64)
    weights = torch.linalg.solve(x.mT @ x + ridge, x.mT @ y)
    residual = y - x @ weights
    covariance = residual.mT @ residual / len(residual)
    each = covariance.diagonal().view(-1, 3).sum(1).sqrt().tolist()
    bodies = [r.upper_body() for r in usable]
    neck = learn_neck_offset(torch.cat([b.joints.double() for b in bodies if b.neck == "neck"]))
    persons = tuple(sorted({r.person_id for r in usable}))
    spread = dict(zip(targets, each, strict=True))
    return Completion(tuple(targets), weights, covariance, neck, spread, len(x), persons)


def complete(
    recording: Recording, completion: Completion, generator: torch.Generator | None = None
) -> Recording:
    """Return the eight joints of a recording, its head, hands (if among the targets) and neck made up.

    Hands that are no target stay wrists. The neck is put where the completion's recordings have it,
    from the shoulders and the head.

    Args:
        recording: with shoulders, elbows, wrists and hip centre, in camera axes.
        completion: the completion from `learn_completion`. generator: of the residual, one for the whole
            recording; None takes the mean.

    Raises:
        SkeletonError: one of these joints is not in the recording.
    """
    missing = {*_KNOWN} - _names(recording)
    if missing:
        raise SkeletonError(
            f"{recording.path}: completing a body needs {', '.join(_KNOWN)}; missing are "
            f"{', '.join(sorted(missing))}"
        )
    known = _joints(recording, _KNOWN).double()
    frame, middle = _trunk(known)
    y = _features(known, frame, middle) @ completion.weights
    if generator is not None:
        factor = torch.linalg.cholesky(
            completion.covariance + 1e-12 * torch.eye(len(completion.covariance)).double()
        )
        draw = torch.randn(len(factor), generator=generator, dtype=torch.float64)
        y = y + factor @ draw
    made = y.view(len(y), -1, 3) @ frame.mT
    found = {name: known[:, i] for i, name in enumerate(_KNOWN)}
    for i, target in enumerate(completion.targets):
        found[target] = made[:, i] + _base(known, target, middle)
    found["neck"] = torch.full_like(middle, torch.nan)
    hands = "hand_left" in completion.targets
    joints = torch.stack(
        [found[name if hands else name.replace("hand", "wrist")] for name in UPPER_BODY], 1
    )
    return _eight(recording, place_neck(joints, completion.neck), hands)


def with_wrists(recording: Recording) -> Recording:
    """Return the eight joints of a Kinect recording, with wrists in place of hands."""
    names = ("head", "elbow_left", "elbow_right", "shoulder_left", "shoulder_right")
    body = recording.upper_body()
    wrists = _joints(recording, ("wrist_left", "wrist_right"))
    if not {*names, "wrist_left", "wrist_right"} <= _names(recording) or body.neck != "neck":
        raise SkeletonError(
            f"{recording.path}: expected a Kinect's wrists, elbows, shoulders, neck and head"
        )
    joints = body.joints.clone()
    joints[:, [0, 7]] = wrists
    return _eight(recording, joints, hands=False)


def facing_pieces(recording: Recording) -> list[Recording]:
    """Return the parts of a recording in which the person faces the camera, as recordings of their own."""
    shoulders = _joints(recording, ("shoulder_left", "shoulder_right")).double()
    line = shoulders[:, 0] - shoulders[:, 1]
    facing = line[:, 0] > _FACING * line.norm(dim=-1)
    closed = torch.cat([facing.new_zeros(1), facing, facing.new_zeros(1)]).int()
    edges = torch.nonzero(closed.diff()).flatten().tolist()
    return [
        cut_recording(recording, start, stop)
        for start, stop in zip(edges[::2], edges[1::2], strict=True)
        if stop - start >= _SHORTEST
    ]


def _eight(recording: Recording, joints: Float[Tensor, "T 8 3"], hands: bool) -> Recording:
    names = _AS_HAND if hands else _AS_WRIST
    return replace(recording, joints=joints, names=names, weights=None, skeleton="")


def _names(recording: Recording) -> set[str]:
    return set(canonical_names(recording.names))


def _joints(recording: Recording, wanted: Sequence[str]) -> Float[Tensor, "T J 3"]:
    where = {name: i for i, name in enumerate(canonical_names(recording.names))}
    if not set(wanted) <= where.keys():
        return recording.joints.new_full((len(recording), len(wanted), 3), torch.nan)
    return recording.joints[:, [where[name] for name in wanted]]


def _trunk(
    known: Float[Tensor, "N 7 3"],
) -> tuple[Float[Tensor, "N 3 3"], Float[Tensor, "N 3"]]:
    """Return axes of the trunk as columns (to the person's left, up, forward), and the shoulders' middle."""
    middle = (known[:, _LEFT] + known[:, _RIGHT]) / 2
    across = torch.nn.functional.normalize(known[:, _LEFT] - known[:, _RIGHT], dim=-1)
    up = middle - known[:, _HIP]
    up = up - (up * across).sum(-1, keepdim=True) * across
    up = torch.nn.functional.normalize(up, dim=-1)
    return torch.stack([across, up, torch.linalg.cross(across, up, dim=-1)], -1), middle


def _features(
    known: Float[Tensor, "N 7 3"], frame: Float[Tensor, "N 3 3"], middle: Float[Tensor, "N 3"]
) -> Float[Tensor, "N F"]:
    own = (known - middle[:, None]) @ frame
    return torch.cat([own.flatten(1), torch.ones_like(own[:, :1, 0])], 1)


def _base(
    known: Float[Tensor, "N 7 3"], target: str, middle: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 3"]:
    base = _BASES[target]
    return middle if base is None else known[:, _KNOWN.index(base)]
