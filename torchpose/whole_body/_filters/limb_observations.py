"""Compute likelihoods of single parts of the body, and Gaussians from seven places of each.

Every part is tried at the sigma points of its prediction while the others stay at their means; the
silhouette pixels under it are the likelihood of each point, and the weighted points make a Gaussian.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_choice, check_shape
from torchpose.body._kinematics import Body
from torchpose.body._limbs import Limbs
from torchpose.body._skeleton import BodySkeleton, other_side
from torchpose.camera._rig import Cameras
from torchpose.errors import SkeletonError
from torchpose.math._rotations import quaternion_vector_to_matrix
from torchpose.math._unscented import floor_eigenvalues, moments
from torchpose.whole_body._silhouettes.limb_counts import PartCounts, count_parts
from torchpose.whole_body._silhouettes.rendering import PreparedSilhouettes

NORMALISATIONS = ("published", "share")
CAMERA_RULES = ("product", "sum")
_LEAST_SHARE = 0.01  # of a part's pixels: one camera alone does not rule a place out
_ROOT = 6  # columns of a state: position and orientation of the root


class PartGroup(NamedTuple):
    """Holds parts with the same number of limbs, whose pixels are counted at once.

    Attributes:
        parts: G places among the parts without the root. limbs: [G][K] limbs of each.
        opposing: places within the group of the same part on the other side; empty if there is none.
    """

    parts: tuple[int, ...]
    limbs: tuple[tuple[int, ...], ...]
    opposing: tuple[int, ...]


def part_groups(skeleton: BodySkeleton) -> tuple[PartGroup, ...]:
    """Return which limbs move with each part, for all parts but the root.

    A limb between two parts belongs to the one farther from the root. Those of the root part alone
    count with the first part that hangs on it.

    Raises:
        SkeletonError: a part without limbs, which no image shows.

    >>> from torchpose.body._skeleton import BODY_15
    >>> [len(group.parts) for group in part_groups(BODY_15)], sum(
    ...     len(limbs) for group in part_groups(BODY_15) for limbs in group.limbs
    ... )
    ([6, 2, 1, 1], 17)
    """
    limbs = _limbs_of_parts(skeleton)
    bare = [skeleton.parts[part + 1] for part, own in enumerate(limbs) if not own]
    if bare:
        raise SkeletonError(
            f"every part but the root needs a limb to be seen by; {', '.join(bare)} of "
            f"{skeleton.name!r} have none"
        )
    other = _opposing_parts(skeleton)
    paired = [part != mirrored for part, mirrored in enumerate(other)]
    kinds = dict.fromkeys((len(own), paired[part]) for part, own in enumerate(limbs))
    groups = []
    for kind in sorted(kinds, key=lambda k: (not k[1], k[0])):
        parts = [p for p, own in enumerate(limbs) if (len(own), paired[p]) == kind]
        opposing = tuple(parts.index(other[p]) for p in parts) if kind[1] else ()
        groups.append(PartGroup(tuple(parts), tuple(limbs[p] for p in parts), opposing))
    return tuple(groups)


def part_positions(
    body: Body,
    states: Float[Tensor, "*batch D"],
    points: Float[Tensor, "*batch V S 3"],
    group: PartGroup,
) -> Limbs:
    """Return the limbs of each part of a group at every sigma point, all other parts as in the state.

    The part turns about its proximal joint, which stays where the state has it.

    Args:
        body: with ``frame="body"``. states: [..., D].
        points: quaternion vectors of the V = P - 1 parts without the root [..., V, S, 3].
        group: of `part_groups`.

    Returns:
        Limbs [..., G, S, K].
    """
    check_shape("points", points, ["...", len(body.skeleton.parts) - 1, None, 3])
    parts = torch.tensor(group.parts, device=states.device)
    limbs = torch.tensor(group.limbs, device=states.device)
    root = quaternion_vector_to_matrix(states[..., 3:_ROOT])[..., None, :, :]
    vectors = states[..., _ROOT:].unflatten(-1, (-1, 3))[..., parts, :]
    tried = torch.cat([vectors[..., None, :], points[..., parts, :, :]], -2)
    turns = root @ body.centre_rotations[parts + 1]
    rotations = turns[..., None, :, :] @ quaternion_vector_to_matrix(tried)
    moved = rotations[..., 1:, :, :] - rotations[..., :1, :, :]  # against the state's own
    weights = body.limb_weights.unflatten(0, (-1, 3)).unflatten(-1, (-1, 2))
    weights = weights[parts[:, None] + 1, :, limbs].movedim(1, 2).flatten(2)  # [G, 3, K 2]
    shift = (moved @ weights[:, None]).unflatten(-1, (-1, 2)).movedim(-3, -1)  # [..., G S K 2 3]
    whole = body.limbs(states)
    start = whole.start[..., limbs, :].unsqueeze(-3) + shift[..., 0, :]
    end = whole.end[..., limbs, :].unsqueeze(-3) + shift[..., 1, :]
    return Limbs(start, end, whole.radii[..., limbs, :].unsqueeze(-3))


def count_positions(
    body: Body,
    states: Float[Tensor, "*batch D"],
    points: Float[Tensor, "*batch V S 3"],
    cameras: Cameras,
    silhouettes: PreparedSilhouettes,
    groups: tuple[PartGroup, ...],
) -> PartCounts:
    """Count silhouette pixels under every part at every sigma point, 1/2 where the opposing part may be.

    Args:
        body, states, points: as `part_positions`. cameras: C. silhouettes: as `count_parts`.
        groups: `part_groups(body.skeleton)`.

    Returns:
        `PartCounts`, each [..., V, S, C].

    Reference: Daubney & Xie, equation (4).
    """
    weights, areas = [], []
    for group in groups:
        limbs = part_positions(body, states, points, group)
        opposing = None
        if group.opposing:
            order = torch.tensor(group.opposing, device=states.device)
            radii = limbs.radii.expand(*limbs.start.shape[:-1], 2)
            opposing = Limbs(*(x.index_select(-4, order) for x in (*limbs[:2], radii)))
        found = count_parts(limbs, opposing, cameras, silhouettes)
        weights.append(found.weight)
        areas.append(found.area)
    order = torch.tensor([part for group in groups for part in group.parts]).argsort()
    order = order.to(states.device)
    return PartCounts(*(torch.cat(x, -3).index_select(-3, order) for x in (weights, areas)))


def part_log_likelihood(
    counts: PartCounts, *, normalisation: str = "published", cameras: str = "product"
) -> Float[Tensor, "*batch V S"]:
    """Return log p(O_i | sigma_s), of all cameras together.

    p = prod_c v_c or sum_c v_c,   v_c the pixels (DX 4), or their share of the part's own

    The paper does not say how cameras combine; "product" takes them as independent.

    Args:
        counts: [..., V, S, C]. normalisation: "published" (pixels), or "share", which no scale of the
            image changes. cameras: "product", each factor at least a hundredth of the part's pixels
            in view (one camera alone rules nothing out), or "sum".

    Returns:
        [..., V, S], float64, -inf for a place that no camera sees any silhouette under.

    Raises:
        InputError: another rule.
    """
    check_rules(normalisation, cameras)
    area = counts.area.clamp_min(1).double()
    pixels = counts.weight
    if cameras == "product":
        value = torch.maximum(pixels, _LEAST_SHARE * area)
        value = (value if normalisation == "published" else value / area).log().sum(-1)
        value = torch.where((pixels > 0).any(-1), value, -math.inf)
    else:
        value = (pixels if normalisation == "published" else pixels / area).sum(-1).log()
    return value


def least_part_log_likelihood(
    counts: PartCounts, *, normalisation: str = "published", cameras: str = "product"
) -> Float[Tensor, "*batch V S"]:
    """Return log p(O_i | sigma_s) of places with a hundredth of their pixels in the silhouettes.

    Args:
        counts: [..., V, S, C], of which the areas count. normalisation, cameras: as `part_log_likelihood`.
    """
    least = PartCounts(_LEAST_SHARE * counts.area.clamp_min(1).double(), counts.area)
    return part_log_likelihood(least, normalisation=normalisation, cameras=cameras)


def parts_log_weight(
    log_likelihood: Float[Tensor, "*batch V S"], least: Float[Tensor, "*batch V S"]
) -> Float[Tensor, "*batch"]:
    """Return the log-weight of hypotheses before annealing, sum_i log sum_j p(O_i | sigma_ij)   (DX 12).

    A part that is seen at none of its places may be hidden, behind a table or beyond the image. As printed
    it would rule its hypothesis out, and soon all of them; it has its least likelihood instead. A hypothesis
    of which nothing is seen is ruled out.

    Args:
        log_likelihood: of `part_log_likelihood`. least: of `least_part_log_likelihood`.

    Returns:
        [...], float64, -inf where no part is seen at any place.
    """
    parts = log_likelihood.logsumexp(-1)
    hidden = parts.isneginf()
    hidden = hidden & ~hidden.all(-1, keepdim=True)
    return torch.where(hidden, least.logsumexp(-1), parts).sum(-1)


def observation_gaussians(
    points: Float[Tensor, "*batch V S 3"],
    log_weights: Float[Tensor, "*batch V S"],
    mean: Float[Tensor, "*batch V 3"],
    covariance: Float[Tensor, "*batch V 3 3"],
    least_std: float = 0.0,
) -> tuple[Float[Tensor, "*batch V 3"], Float[Tensor, "*batch V 3 3"]]:
    """Return the moments of weighted sigma points, p(x_i | O_i) = N(x_i; mu_obs, Sigma_obs).

    Equal weights leave the distribution as it was.

    Args:
        points: sigma points with the mean. log_weights: of any common factor; a part whose weights
            are all zero keeps its distribution.
        mean, covariance: of which the points are.
        least_std: least standard deviation in any direction; two equal weights beside zeros
            have none across the line between them.

    Reference: Daubney & Xie, section 5.
    """
    known = torch.isfinite(log_weights.amax(-1))
    safe = torch.where(known[..., None], log_weights, 0.0)
    new_mean, new_covariance = moments(points, safe)
    new_mean = torch.where(known[..., None], new_mean, mean)
    new_covariance = torch.where(known[..., None, None], new_covariance, covariance)
    return new_mean, floor_eigenvalues(new_covariance, least_std**2)


def check_rules(normalisation: str, cameras: str) -> None:
    """Raise `InputError` unless both rules are known."""
    check_choice("normalisation", normalisation, NORMALISATIONS)
    check_choice("cameras", cameras, CAMERA_RULES)


# --- helpers --------------------------------------------------------------------------------------


def _limbs_of_parts(skeleton: BodySkeleton) -> list[tuple[int, ...]]:
    """Return the limbs of every part but the root."""
    carrier = {name: skeleton.part_of[i] for i, name in enumerate(skeleton.names)}
    carrier |= {tip.name: skeleton.part(tip.part) for tip in skeleton.tips}
    depth = {part: d for d, level in enumerate(skeleton.part_levels) for part in level}
    first = skeleton.part_levels[1][0] if len(skeleton.part_levels) > 1 else 0
    owned: list[list[int]] = [[] for _ in skeleton.parts]
    for i, limb in enumerate(skeleton.limbs):
        part = max(carrier[limb.start], carrier[limb.end], key=depth.__getitem__)
        owned[part or first].append(i)
    return [tuple(own) for own in owned[1:]]


def _opposing_parts(skeleton: BodySkeleton) -> list[int]:
    """Return the index of each part's counterpart on the other side, its own in the middle; no root."""
    names = list(skeleton.parts)[1:]
    others = [other_side(name) for name in names]
    return [names.index(o) if o in names else i for i, o in enumerate(others)]
