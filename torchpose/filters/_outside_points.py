"""Condition mixtures of single frames on a point of the state that is probably outside of a region."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.filters._fixed_tracks import FixedTrackFilter
from torchpose.filters._measurements import Measurements
from torchpose.filters._memoryless import conditioned_groups
from torchpose.filters._outputs import FilterOutput
from torchpose.filters._weights import estimate_of
from torchpose.math._geometric_median import median_columns, with_medians
from torchpose.math._half_planes import outside_moments


class OutsidePoint(NamedTuple):
    """Evidence of B T frames that a point of the state is outside of a region.

    Attributes:
        columns: the two dimensions of the point, [2]. planes: the borders, [B, T, P, 3].
        log_inside: how likely the evidence is in the region, [B, T]; 0 where there is none. Both are as in
            `torchpose.math._half_planes.outside_moments`.
    """

    columns: Tensor
    planes: Tensor
    log_inside: Tensor


def with_outside_point(
    model: FixedTrackFilter, out: FilterOutput, frames: Measurements, point: OutsidePoint
) -> FilterOutput:
    """Return the estimates of a filter without memory, conditioned on the evidence about a point.

    Each component of a frame is a Gaussian, of which the point has the moments of `outside_moments`, and the
    other dimensions follow by regression on the point. The mass weighs the component. The log-evidence
    of the frame grows by the log of the mean mass.

    Args:
        model: the filter. out: its estimates of the frames, with covariances. frames: the measurements.
        point: the evidence.
    """
    if out.cov is None:
        raise RuntimeError("expected estimates with covariances")
    rows = (point.log_inside < 0).flatten().nonzero()[:, 0]
    z, mask = (values.flatten(0, 1)[rows][None] for values in frames[:2])
    cov = frames.cov if frames.cov.ndim == 2 else frames.cov.flatten(0, 1)[rows][None]
    chosen = Measurements(z, mask, cov, rows.new_tensor([len(rows)]))
    mean, total, weights, evidence = (
        value.flatten(0, 1).clone()
        for value in (out.mean, out.cov, out.log_weights, out.log_evidence)
    )
    planes, log_inside = point.planes.flatten(0, 1)[rows], point.log_inside.flatten()[rows]
    for group, means, covs, logs in conditioned_groups(model, model.weight_rule, chosen):
        own, at = group.rows, rows[group.rows]
        found = _conditioned(
            means, covs, logs, point.columns, planes[own], log_inside[own],
            median_columns(model.medians),
        )  # fmt: skip
        mean[at], total[at], weights[at] = (
            value.to(like) for value, like in zip(found, (mean, total, weights), strict=False)
        )
        evidence[at] = evidence[at] + found[3].to(evidence)
    shape = out.mean.shape[:2]
    mean, total, weights, evidence = (
        value.unflatten(0, shape) for value in (mean, total, weights, evidence)
    )
    return out._replace(mean=mean, cov=total, log_weights=weights, log_evidence=evidence)


def _conditioned(
    means: Float[Tensor, "N M D"],
    covs: Float[Tensor, "M D D"],
    logs: Float[Tensor, "N M"],
    columns: Int[Tensor, " 2"],
    planes: Float[Tensor, "N P 3"],
    log_inside: Float[Tensor, " N"],
    medians: Int[Tensor, "K 3"],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return mean, covariance, log-weights and the log of the mean mass of a group of frames."""
    means, logs = means.double(), logs.double()
    block = covs[:, columns[:, None], columns]
    gain = torch.linalg.solve(block, covs[:, columns]).mT
    points = outside_moments(means[..., columns], block, planes[:, None], log_inside[:, None])
    moved = (gain @ (points.mean - means[..., columns])[..., None])[..., 0]
    means, change = means + moved, points.cov - block
    logs = logs + points.log_mass
    log_mass = torch.logsumexp(logs, -1)
    logs = logs - log_mass[:, None]
    mean, total = estimate_of(logs, means, covs)
    narrowed = ((logs.exp()[..., None, None] * change) @ gain.mT).flatten(1, 2)
    total = total + gain.transpose(0, 1).flatten(1) @ narrowed
    if len(medians):
        own = gain[:, medians.flatten()]
        grown = ((own @ change) * own).sum(-1).unflatten(-1, medians.shape)
        variances = covs.diagonal(dim1=-2, dim2=-1)[:, medians] + grown
        around = mean
        mean = with_medians(mean, logs.exp(), means[..., medians], variances, medians)
        off = around - mean
        total = total + off[:, :, None] * off[:, None]
    return mean, total, logs, log_mass
