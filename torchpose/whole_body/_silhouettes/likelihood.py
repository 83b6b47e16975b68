"""Compute likelihoods of silhouettes from numbers of pixels, without the sharpness exponent.

As printed both are nearly flat: -log p lies in [0, 2] for the bidirectional one, so weights of
particles differ by at most e^2. A sharpness of 1 is the published form.
"""

from jaxtyping import Float
from torch import Tensor

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

    >>> import torch
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

    >>> import torch
    >>> ten = torch.tensor([10])
    >>> float(intersection_over_union(SilhouetteCounts(ten, torch.tensor([5]), ten)))
    0.333...
    """
    model, overlap, image = (count.double() for count in counts)
    return (overlap / (model + image - overlap).clamp_min(1)).mean(-1)


def _log_overlap(counts: SilhouetteCounts) -> Tensor:
    return intersection_over_union(counts).log()


LIKELIHOODS = {"bidirectional": bidirectional, "overlap": _log_overlap}
"""Log-likelihoods by name: (MR 12), and the log of (AS 7), which is -inf without any overlap."""
