"""Compute likelihoods of silhouettes from numbers of pixels, without the sharpness exponent.

As printed both are nearly flat: -log p lies in [0, 2] for the bidirectional one, so weights of
particles differ by at most e^2. A sharpness of 1 is the published form.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_choice
from torchpose.errors import InputError
from torchpose.whole_body._silhouettes.rendering import SilhouetteCounts


def bidirectional(counts: SilhouetteCounts) -> Float[Tensor, "*batch"]:
    """Return the bidirectional silhouette log-likelihood, up to a constant.

    log p(I | x) = -1/|I| sum_I { |S(x) without S| / |S(x)| + |S without S(x)| / |S| }   (MR 12)

    over the cameras I. An empty model or an empty silhouette counts 1 in its term.

    Args:
        counts: the counts of C cameras, each [..., C].

    Returns:
        [...], float64, in [-2, 0]; 0 if the silhouettes are equal.

    Reference: manifold-regularised particle filter, equation (12).

    >>> one = torch.tensor([[10, 20]])
    >>> bidirectional(SilhouetteCounts(one, torch.tensor([[5, 20]]), one)).tolist()
    [-0.5]
    """
    model, overlap, image = (count.double() for count in counts)
    missed = (model - overlap) / model.clamp_min(1) + (model == 0.0)
    unexplained = (image - overlap) / image.clamp_min(1) + (image == 0.0)
    return -(missed + unexplained).mean(-1)


def intersection_over_union(counts: SilhouetteCounts) -> Float[Tensor, "*batch"]:
    """Return the intersection over union, mean over the cameras.

    w = sum_xy I_OV(x, y) / sum_xy I_U(x, y)   (AS 7)

    with I_OV the pixels in both silhouettes and I_U those in either. Where both are empty it is 0.

    Args:
        counts: the counts of C cameras, each [..., C].

    Returns:
        [...], float64, in [0, 1]; 1 if the silhouettes are equal. It is a weight: its logarithm
        times the sharpness is the log-likelihood.

    Reference: aSpace posture constraints, equation (7).

    >>> ten = torch.tensor([10])
    >>> float(intersection_over_union(SilhouetteCounts(ten, torch.tensor([5]), ten)))
    0.333...
    """
    model, overlap, image = (count.double() for count in counts)
    return (overlap / (model + image - overlap).clamp_min(1)).mean(-1)


def silhouette_log_likelihood(
    counts: SilhouetteCounts, kind: str = "bidirectional", sharpness: float = 1.0
) -> Float[Tensor, "*batch"]:
    """Return sharpness times the log-likelihood of the named kind.

    Args:
        counts: the counts of C cameras, each [..., C].
        kind: "bidirectional" (MR 12), or "overlap": log of the intersection over union (AS 7),
            -inf without any overlap.
        sharpness: exponent of the likelihood, 0 or more; 1 is the published form.

    Returns:
        [...], float64.

    Raises:
        InputError: another kind, or a negative sharpness.
    """
    check_choice("likelihood", kind, LIKELIHOODS)
    if not 0 <= sharpness < float("inf"):
        raise InputError(f"sharpness must be 0 or more and finite, got {sharpness}")
    if sharpness == 0:
        return torch.zeros(counts.model.shape[:-1], dtype=torch.float64).to(counts.model.device)
    return sharpness * LIKELIHOODS[kind](counts)


def _log_overlap(counts: SilhouetteCounts) -> Tensor:
    return intersection_over_union(counts).log()


LIKELIHOODS = {"bidirectional": bidirectional, "overlap": _log_overlap}
"""Log-likelihoods by name."""
