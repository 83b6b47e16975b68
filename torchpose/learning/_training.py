"""Turn recorded poses into sources of training states, and into the keypoints of a simulated detector."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.frame_rates import group_by_rate
from torchpose._core.wording import first_of
from torchpose.camera._projection import project
from torchpose.camera._viewpoints import ViewRange, sample_viewpoints
from torchpose.errors import InputError, PriorError
from torchpose.learning._samplers import ArmSource, PoseFrames, derived_seed
from torchpose.math._rotations import euler_to_matrix
from torchpose.priors._prior_file import PriorInfo
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.skeleton._torso import learn_neck_offset, place_neck
from torchpose.skeleton._upper_body import LEFT_ARM, NECK_KINDS, RIGHT_ARM, upper_body_indices

TRAINING_VIEWS = ViewRange(
    roll=math.radians(15),
    pitch=math.radians(15),
    yaw=math.radians(15),
    tx=(-0.2, 0.2),
    ty=(-0.45, -0.05),
    tz=(1.5, 2.5),
)
"""Viewpoints of the shipped priors: a person about 2 m in front of the camera."""

MIRROR = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
"""Factors that mirror points at x = 0."""

DEFAULT_SAMPLES = 100_000
DEFAULT_RATE = 30.0  # of recordings that do not say
_SHOWN_NAMES = 3  # recordings of each kind in a message
_HEAD, _NECK = UPPER_BODY.index("head"), UPPER_BODY.index("neck")
_UNSEEN = [i for i, name in enumerate(UPPER_BODY) if name.startswith(("elbow", "shoulder"))]


@runtime_checkable
class RecordingLike(Protocol):
    """Declares the attributes of a `torchpose.io.Recording` that fits use."""

    names: tuple[str, ...]
    fps: float | None
    source: str

    @property
    def person_id(self) -> str: ...

    def upper_body(self, nose_as_head: bool = False) -> Any: ...


class PoseSet(NamedTuple):
    """Holds the centred poses of many recordings, with one kind of neck.

    Attributes:
        joints: [N, 8, 3], metres, camera axes; NaN where a joint is missing.
        facts: what `PriorInfo` has to say about them, by the names of its fields.
        weight: how far to trust each joint, [N, 8] in [0, 1]; one where a recording does not say.
        lengths: frames of each recording. rates: their frames per second. persons: their ids.
    """

    joints: Float[Tensor, "N 8 3"]
    facts: dict[str, Any]
    weight: Float[Tensor, "N 8"]
    lengths: list[int]
    rates: list[float]
    persons: list[str]

    def frames(self) -> PoseFrames:
        """Return the frames, with where each recording begins and ends."""
        joints, weight = (values.split(self.lengths) for values in (self.joints, self.weight))
        return PoseFrames.join(joints, self.rates, weight)


class ArmSources(NamedTuple):
    """Sources of the states that the mixtures over poses are fitted to.

    Attributes:
        left: states of the left arm, with those of the mirrored right arm among them if `mirror`.
        right: states of the right arm, None if it is to be the mirror image of the left one.
        facts: as in `PoseSet`, with counts of frames that were used and left out.
    """

    left: ArmSource
    right: ArmSource | None
    facts: dict[str, Any]


def collect_poses(
    recordings: Sequence[RecordingLike],
    neck: str | None = None,
    centre: str = "neck",
    nose_as_head: bool = False,
    others: Sequence[RecordingLike] = (),
) -> PoseSet:
    """Collect centred upper-body poses of recordings, converted to one kind of neck.

    Necks of other kinds, and missing ones, are put where the recordings of the wanted kind have
    theirs (`learn_neck_offset`), or where `others` have it if none of these is of that kind. Hands and
    wrists are not converted: mixed, they are refused.

    Args:
        recordings: the recordings, in camera axes.
        neck: kind of neck wanted; the highest kind among the recordings if None.
        centre: "neck" or "head": every pose is centred on that joint; "sequence": every recording
            on the mean of its neck.
        nose_as_head: take the nose where a joint set has no head.
        others: recordings that tell where the neck is, such as the training's beside held-out ones.

    Raises:
        InputError: no recordings. PriorError: hands and wrists (or heads and noses) mixed, a neck
            that cannot be learnt, an unknown `centre`.
    """
    if not recordings:
        raise InputError("a prior needs at least one recording, got none")
    bodies = [r.upper_body(nose_as_head) for r in recordings]
    hand = one_kind("hand", [b.hand for b in bodies])
    head = one_kind("head", [b.head for b in bodies])
    kinds = [b.neck for b in bodies]
    wanted = neck or min((k for k in kinds if k in NECK_KINDS), key=NECK_KINDS.index, default=None)
    if wanted not in NECK_KINDS:
        raise PriorError(
            f"a prior needs recordings with a neck ({', '.join(NECK_KINDS)}), got {wanted!r}"
        )
    joints = [b.joints.to(torch.float64) for b in bodies]
    extra: dict[str, Any] = {"head": head}
    if any(kind != wanted for kind in kinds):
        beside = [] if wanted in kinds else [r.upper_body(nose_as_head) for r in others]
        joints, of_necks = _with_neck(wanted, joints, kinds, beside)
        extra |= of_necks
    rate = _frame_rate(recordings, joints)
    facts = {
        "neck": wanted,
        "hand": hand,
        "centre": centre,
        "fps": rate,
        "persons": tuple(sorted({r.person_id for r in recordings})),
        "sources": tuple(sorted({_origin(r) for r in recordings})),
        "extra": extra | {"recordings": len(recordings)},
    }
    return PoseSet(
        torch.cat([_centred(j, centre) for j in joints]),
        facts,
        torch.cat([_weights(r, nose_as_head) for r in recordings]),
        [len(j) for j in joints],
        [float(r.fps or rate or DEFAULT_RATE) for r in recordings],
        [r.person_id for r in recordings],
    )


def _with_neck(
    wanted: str, joints: Sequence[Tensor], kinds: Sequence[str | None], beside: Sequence[Any]
) -> tuple[list[Tensor], dict[str, Any]]:
    """Return joints with necks of one kind, and facts about those that were converted.

    Args:
        wanted: kind of neck. joints: of each recording. kinds: of their necks.
        beside: bodies that tell where the neck is, if none of these has one of that kind.
    """
    genuine = [j for j, kind in zip(joints, kinds, strict=True) if kind == wanted]
    genuine = genuine or [b.joints.to(torch.float64) for b in beside if b.neck == wanted]
    offset = learn_neck_offset(torch.cat(genuine) if genuine else joints[0][:0])
    placed = [
        j if kind == wanted else place_neck(j, offset)
        for j, kind in zip(joints, kinds, strict=True)
    ]
    count = sum(len(j) for j, kind in zip(joints, kinds, strict=True) if kind != wanted)
    return placed, {"neck_offset": offset._asdict(), "frames_with_converted_neck": count}


def short_paths(poses: PoseSet, room: float) -> PoseSet:
    """Return recordings cut where the neck is far from its start, each part centred on its mean neck.

    Args:
        poses: from `collect_poses`. room: diagonal of the box that holds a part's necks, at most;
            metres.
    """
    parts: list[Tensor] = []
    lengths, rates, persons = [], [], []
    recorded = poses.joints.split(poses.lengths)
    for joints, rate, person in zip(recorded, poses.rates, poses.persons, strict=True):
        own = joints.split(_near(joints[:, _NECK], room))
        parts += [_centred(part, "sequence") for part in own]
        lengths += [len(part) for part in own]
        rates += [rate] * len(own)
        persons += [person] * len(own)
    return poses._replace(joints=torch.cat(parts), lengths=lengths, rates=rates, persons=persons)


def _near(path: Float[Tensor, "T 3"], room: float) -> list[int]:
    """Return lengths of the parts of a path, each of which stays within a box of some diagonal."""
    lengths = [0]
    low = high = path.new_full((3,), torch.nan)
    for place in path:
        low, high = torch.fmin(low, place), torch.fmax(high, place)
        if float((high - low).norm()) > room:  # never where no place is known
            lengths.append(0)
            low = high = place
        lengths[-1] += 1
    return lengths


def arm_sources(
    poses: PoseSet,
    matrix: Float[Tensor, "3 3"],
    seed: int = 0,
    view_range: ViewRange = TRAINING_VIEWS,
    rotation_order: str = "zxy",
    mirror: bool = True,
    n_samples: int | None = None,
    views_per_pose: int | None = None,
) -> ArmSources:
    """Build sources of both arms' states from random viewpoints, with equal use of all poses.

    An arm leaves out the frames in which one of its five joints is missing; `facts` says how many.
    A state weighs as much as the least trusted joint of its pose.

    Args:
        poses: from `collect_poses`.
        matrix: K, pixels.
        seed: the seed of the viewpoints.
        view_range: limits of the viewpoints.
        rotation_order: "zxy" (paper) or "zyx" (released priors).
        mirror: pool left arms and mirrored right arms; the right mixture is then to be the mirror
            image of the left one.
        n_samples: states per arm; 100,000 if neither this nor `views_per_pose` is given.
        views_per_pose: viewpoints for each pose, instead of `n_samples`.

    Raises:
        InputError: no usable frames, both counts given, or viewpoints to one side with `mirror`.
    """
    if n_samples is not None and views_per_pose is not None:
        raise InputError("give n_samples or views_per_pose, not both")
    if mirror and not math.isclose(-view_range.tx[0], view_range.tx[1], abs_tol=1e-9):
        raise InputError(
            f"mirrored arms need views with tx the same to both sides, got {view_range.tx}; "
            "make it symmetric or use mirror=False"
        )
    left, right = (arm_poses(poses, arm) for arm in (LEFT_ARM, RIGHT_ARM))
    dropped = {"left": int((~left.known).sum()), "right": int((~right.known).sum())}
    arms = {"left": left.usable(), "right": right.usable()}
    if mirror:
        (own, trust), (other, also) = arms["left"], arms["right"]
        arms = {"left": (torch.cat([own, other * MIRROR]), torch.cat([trust, also]))}
    sources = {}
    for side, (points, weight) in arms.items():
        if not len(points):
            raise InputError(
                f"no frame has all five joints of the {side} arm (hand, elbow, shoulder, head, "
                "neck); the prior needs recordings that do"
            )
        count = _number_of_samples(len(points), n_samples, views_per_pose)
        own_seed = derived_seed(seed, f"poses {side}")
        sources[side] = ArmSource(
            matrix, view_range, rotation_order, count, own_seed, False, points, weight
        )
    facts = poses.facts | {
        "n_frames": int((left.known | right.known).sum()),
        "n_samples": sources["left"].n_samples,
        "mirrored": mirror,
        "extra": poses.facts["extra"] | {"frames_left_out": dropped},
    }
    return ArmSources(sources["left"], sources.get("right"), facts)


class ArmPoses(NamedTuple):
    """Holds poses [N, 5, 3] of an arm, which of them are complete and have weight, and weights [N]."""

    points: Tensor
    known: Tensor
    weight: Tensor

    def usable(self) -> tuple[Tensor, Tensor]:
        return self.points[self.known], self.weight[self.known]


def arm_poses(poses: PoseSet, arm: tuple[int, ...]) -> ArmPoses:
    """Return the joints of one arm with their weights."""
    points, weight = poses.joints[:, list(arm)], poses.weight[:, list(arm)].amin(1)
    return ArmPoses(points, torch.isfinite(points).flatten(1).all(1) & (weight > 0), weight)


def _weights(recording: RecordingLike, nose_as_head: bool) -> Float[Tensor, "T 8"]:
    """Return the weights of the eight joints; one for a joint that the recording does not have."""
    given = getattr(recording, "weights", None)
    frames = len(recording.upper_body(nose_as_head).joints)
    weight = torch.ones(frames, len(UPPER_BODY), dtype=torch.float64)
    if given is None:
        return weight
    indices = upper_body_indices(recording.names, nose_as_head).indices
    there = [i for i, index in enumerate(indices) if index >= 0]
    weight[:, there] = given[:, [indices[i] for i in there]].to(weight)
    return weight


def one_kind(
    joint: str, kinds: Sequence[str | None], names: Sequence[str] | None = None
) -> str | None:
    """Return the kind of joint that all recordings have; None if none says its kind.

    Args:
        joint: its name, for messages. kinds: of each recording. names: of the recordings, for messages.

    Raises:
        PriorError: kinds are mixed; recordings of each kind are named.
    """
    found = sorted({k for k in kinds if k is not None})
    if len(found) > 1:
        listed = "" if names is None else f" ({_names_by_kind(kinds, names, found)})"
        raise PriorError(
            f"recordings must agree on what a {joint} is, got {' and '.join(found)}{listed}; fit them "
            "apart, or leave one kind out"
        )
    return found[0] if found else None


def _names_by_kind(kinds: Sequence[str | None], names: Sequence[str], found: list[str]) -> str:
    each = []
    for kind in found:
        own = [name for name, other in zip(names, kinds, strict=True) if other == kind]
        each.append(f"{kind}: {first_of(own, _SHOWN_NAMES)}")
    return "; ".join(each)


def _origin(recording: RecordingLike) -> str:
    """Return the data set or repository of a recording, without the path inside it."""
    repository, at, rest = recording.source.partition("@")
    if not repository:
        return recording.person_id.partition("#")[0]
    return f"{repository}{at}{rest.partition(':')[0]}"


def _frame_rate(recordings: Sequence[RecordingLike], joints: Sequence[Tensor]) -> float | None:
    """Return the frame rate of most frames; those that differ by 5 % at most count as one."""
    stated = [(float(r.fps), len(j)) for r, j in zip(recordings, joints, strict=True) if r.fps]
    if not stated:
        return None
    groups = group_by_rate([rate for rate, _ in stated])
    most = max(groups.values(), key=lambda group: sum(stated[i][1] for i in group))
    frames: dict[float, int] = {}
    for rate, count in (stated[i] for i in most):
        frames[round(rate, 3)] = frames.get(round(rate, 3), 0) + count
    return max(frames, key=lambda rate: frames[rate])


def _centred(joints: Tensor, centre: str) -> Tensor:
    if centre == "sequence":
        return joints - joints[:, _NECK].nanmean(0)
    if centre not in ("neck", "head"):
        raise PriorError(f"centre must be neck, head or sequence, got {centre!r}")
    joint = _NECK if centre == "neck" else _HEAD
    return joints - joints[:, joint : joint + 1]


def _number_of_samples(n: int, n_samples: int | None, views_per_pose: int | None) -> int:
    if views_per_pose is not None:
        n_samples = n * views_per_pose
    count = DEFAULT_SAMPLES if n_samples is None else n_samples
    if count < 1:
        raise InputError(f"the number of samples must be at least 1, got {count}")
    return count


def seen_keypoints(
    poses: Float[Tensor, "B T 8 3"],
    info: PriorInfo,
    generator: torch.Generator,
    *,
    view_share: float,
    noise_std: float,
) -> Float[Tensor, "B T 8 2"]:
    """Project sequences from a random viewpoint each, with noise, as a detector would see them.

    Args:
        poses: body axes, metres. info: of the prior whose camera and viewpoints are taken.
        generator: of viewpoints and noise. view_share: of the width of the training views.
        noise_std: the standard deviation of a keypoint, pixels.

    Returns:
        The prior's pixels; elbows and shoulders are NaN, as is whatever is NaN in the poses.
    """
    views = sample_viewpoints(len(poses), ViewRange(**info.views).scaled(view_share), generator)
    rotation = euler_to_matrix(views.angles, info.rotation_order)
    pixels = project(poses, info.matrix, rotation[:, None], views.translation[:, None])[..., :2]
    noise = torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    keypoints = pixels + noise_std * noise
    keypoints[:, :, _UNSEEN] = torch.nan
    return keypoints
