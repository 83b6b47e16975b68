"""Fit the radii of a person's limbs to silhouettes by the cross-entropy method."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.checks import check_finite, check_shape
from torchpose.body._kinematics import Body
from torchpose.body._limbs import Limbs
from torchpose.body._skeleton import BodySkeleton
from torchpose.camera._rig import CameraRig
from torchpose.errors import InputError, ShapeError
from torchpose.whole_body._silhouettes.likelihood import intersection_over_union
from torchpose.whole_body._silhouettes.rendering import (
    PreparedSilhouettes,
    count_pixels,
    prepare_silhouettes,
)

_SPREAD = 0.2  # of the logarithm of a factor among people and clothes, standard deviation
_PRIOR = 0.01  # of intersection over union, what factors one standard deviation off cost
_LEAST_SPREAD = 0.01  # of the search, so that it does not settle too soon
_ELITE = 0.15  # share of the candidates that the next ones are drawn about


def fit_radii(
    body: Body,
    states: Float[Tensor, "T D"],
    silhouettes: Bool[Tensor, "T C H W"],
    rig: CameraRig,
    seed: int = 0,
    *,
    n_frames: int = 8,
    n_candidates: int = 80,
    n_rounds: int = 12,
) -> Body:
    """Return the body with those radii that cover the silhouettes best.

    One factor f_g for every kind of limb, the same on both sides, multiplies the body's radii.
    Candidates are drawn from a Gaussian over log f, which is then moved to the best of them, round
    after round (cross-entropy method), so that they maximise

        mean over frames and cameras of |S(f) and S| / |S(f) or S| - c mean_g (log f_g / s)^2,

    where the second term, with s = 0.2 and c = 0.01, keeps factors near 1 of limbs that are never
    seen apart, and leaves shadows out. All candidates are counted at once, as if they were
    particles. Lengths are not changed.

    Args:
        body: the body of this person, with radii [L, 2].
        states: [T, D], of the frames, such as `fit_state` gives them.
        silhouettes: [T, C, H, W], True on the person.
        rig: the C cameras.
        seed: the seed of the search.
        n_frames: most frames to use, evenly spaced ones; a few in different poses are enough.
        n_candidates, n_rounds: of the search.

    Returns:
        A new body; the radii are those given if no candidate covers the silhouettes better.

    Raises:
        ShapeError: states and silhouettes of different numbers of frames, or batched radii.
        InputError: empty silhouettes only, or too few frames, candidates or rounds.

    Reference: Rubinstein, The cross-entropy method for combinatorial and continuous optimization,
    Methodology and Computing in Applied Probability 1 (1999).
    """
    _check(body, states, silhouettes, n_frames, n_candidates, n_rounds)
    chosen = torch.linspace(0, len(states) - 1, min(n_frames, len(states))).round().long()
    limbs = body.limbs(states[chosen.to(states.device)])
    prepared = prepare_silhouettes(silhouettes[chosen.to(silhouettes.device)])
    kinds = torch.tensor(_limb_kinds(body.skeleton))
    n_kinds = int(kinds.max()) + 1
    generator = torch.Generator().manual_seed(seed)
    mean, spread = torch.zeros(n_kinds).double(), torch.full((n_kinds,), _SPREAD).double()
    best, best_score = mean, -torch.inf
    for _ in range(n_rounds):
        noise = torch.randn(n_candidates, n_kinds, generator=generator, dtype=torch.float64)
        drawn = mean + spread * noise
        drawn[0] = mean  # the first one of all is the body as it is
        factors = drawn.exp()[:, kinds, None].to(limbs.radii)
        cost = _PRIOR * (drawn / _SPREAD).square().mean(-1)
        score = _overlap(limbs, factors, rig, prepared) - cost
        ranked = score.argsort(descending=True, stable=True)
        elite = drawn[ranked[: max(round(_ELITE * n_candidates), 2)]]
        if float(score[ranked[0]]) > best_score:
            best, best_score = elite[0], float(score[ranked[0]])
        mean, spread = elite.mean(0), elite.std(0).clamp_min(_LEAST_SPREAD)
    return body.altered(radii=body.radii * best.exp()[kinds, None].to(body.radii))


def _overlap(
    limbs: Limbs, factors: Tensor, rig: CameraRig, silhouettes: PreparedSilhouettes
) -> Float[Tensor, " N"]:
    """Return the mean intersection over union of every candidate, in float64 on the CPU."""
    n_frames, n_candidates = len(limbs.start), len(factors)
    shape = (n_frames, n_candidates, *limbs.start.shape[1:])
    start, end = (points[:, None].expand(shape) for points in (limbs.start, limbs.end))
    radii = (limbs.radii * factors).expand(*shape[:-1], 2)
    counts = count_pixels(Limbs(start, end, radii), None, rig, silhouettes)
    return intersection_over_union(counts).double().mean(0).cpu()


def _limb_kinds(skeleton: BodySkeleton) -> list[int]:
    """Return the number of every limb's kind: limbs that differ by their side only are of one."""
    first = [min(i, other) for i, other in enumerate(skeleton.mirrored_limbs)]
    order = sorted(set(first))
    return [order.index(i) for i in first]


def _check(
    body: Body, states: Tensor, silhouettes: Tensor, n_frames: int, candidates: int, rounds: int
) -> None:
    check_shape("states", states, ["T", body.dim])
    check_shape("silhouettes", silhouettes, ["T", "C", "H", "W"])
    check_finite("states", states)
    if len(states) != len(silhouettes) or not len(states):
        raise ShapeError(
            f"expected as many states as silhouettes and at least one, got {len(states)} states "
            f"and {len(silhouettes)} frames"
        )
    if body.radii.ndim != 2:
        raise ShapeError(f"expected a body with radii [L, 2], got {list(body.radii.shape)}")
    if n_frames < 1 or candidates < 4 or rounds < 1:
        raise InputError(
            "the search needs n_frames >= 1, n_candidates >= 4 and n_rounds >= 1, got "
            f"{n_frames}, {candidates}, {rounds}"
        )
    if not bool(silhouettes.any()):
        raise InputError("all silhouettes are empty; give frames in which the person is seen")
