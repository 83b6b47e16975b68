"""Assemble results of filters: estimates, failures, mended covariances, and runs of steps."""

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose._core.value_checks import seen_finite, values_visible
from torchpose._core.wording import counted
from torchpose.errors import DegenerateFilterWarning
from torchpose.filters._lengths import held_past_lengths, inside_lengths


class StepOutput(NamedTuple):
    """Holds the estimate after one time step.

    Attributes:
        mean: [B, D]. log_weights: of the M tracks or particles, normalised, [B, M].
        log_evidence: log p(z_t | z_1:t-1), [B]; 0 where nothing is measured, NaN for variants
            that drop the evidence term. cov: [B, D, D] on request.
        mended, jitter: as in `FilterOutput`, [B]; None stands for 0.
    """

    mean: Tensor
    log_weights: Tensor
    log_evidence: Tensor
    cov: Tensor | None = None
    mended: Tensor | None = None
    jitter: Tensor | None = None


class FilterOutput(NamedTuple):
    """Holds the estimates of a batch of sequences; past the length of a sequence its last one is repeated.

    Attributes:
        mean: [B, T, D]. log_weights: [B, T, M], of the estimate, normalised.
        log_evidence: increments log p(z_t | z_1:t-1) [B, T]; 0 where nothing is measured and past
            the length, NaN for variants that drop the evidence term.
        cov: [B, T, D, D], or None unless asked for.
        failed_at: [B], the first frame at which an element degenerated, -1 where it did not. From
            that frame on the element's estimates are NaN.
        mended: number of covariances of the frame's tracks that rounding had made indefinite and
            that were mended (`torchpose.math.mended_cholesky`), [B, T]; 0 as a rule and past the
            length.
        jitter: the largest share by which their variances grew, [B, T], float64; at most 1e-6.
    """

    mean: Tensor
    log_weights: Tensor
    log_evidence: Tensor
    cov: Tensor | None
    failed_at: Tensor
    mended: Tensor | None = None
    jitter: Tensor | None = None

    @property
    def failed(self) -> Tensor:
        """Return whether the filter degenerated, [B]."""
        return self.failed_at >= 0

    @property
    def effective_sample_size(self) -> Tensor:
        """Return 1 / sum_j w_j^2 (BL 25), [B, T]."""
        return effective_sample_size(self.log_weights)


def effective_sample_size(log_weights: Float[Tensor, "*batch M"]) -> Float[Tensor, "*batch"]:
    """Return N_eff = 1 / sum_j w_j^2 of normalised log-weights (BL 25)."""
    return torch.exp(-torch.logsumexp(2.0 * log_weights, -1))


class Mending(NamedTuple):
    """Repairs that `mended_cholesky` had to make.

    Attributes:
        mended: number of covariances that got a jitter, [B] or [B, T].
        jitter: the largest of them, as a share of each variance, [B] or [B, T], float64.
    """

    mended: Tensor
    jitter: Tensor


def mending(like: Float[Tensor, "B *rest"], *jitters: Tensor | None) -> Mending:
    """Sum up the covariances of one frame that were mended.

    Args:
        like: tells the number of elements and the device.
        jitters: of its covariances, [B, ...] each; None where all factorised as they were.
    """
    found = [jitter.reshape(len(like), -1) for jitter in jitters if jitter is not None]
    if not found:
        mended = torch.zeros(len(like), dtype=torch.long, device=like.device)
        return Mending(mended, mended.double())
    joint = torch.cat(found, 1)
    return Mending((joint > 0).sum(1), joint.double().amax(1))


def stacked_mending(frames: Sequence[Mending]) -> Mending:
    """Return the sums of several frames [B] as one [B, T]."""
    mended = torch.stack([frame.mended for frame in frames], 1)
    return Mending(mended, torch.stack([frame.jitter for frame in frames], 1))


def collect(steps: Sequence[StepOutput], lengths: Int[Tensor, " B"]) -> FilterOutput:
    """Stack the steps of a run into its output."""
    cov = None
    if steps[0].cov is not None:
        cov = torch.stack([s.cov for s in steps if s.cov is not None], 1)
    none = mending(steps[0].mean)
    work = [
        none if s.mended is None or s.jitter is None else Mending(s.mended, s.jitter) for s in steps
    ]
    return finish_output(
        torch.stack([s.mean for s in steps], 1),
        torch.stack([s.log_weights for s in steps], 1),
        torch.stack([s.log_evidence for s in steps], 1),
        cov,
        lengths,
        stacked_mending(work),
    )


def first_step(out: FilterOutput) -> StepOutput:
    """Return the first frame of a run as a step."""
    cov, mended, jitter = (
        None if value is None else value[:, 0] for value in (out.cov, out.mended, out.jitter)
    )
    return StepOutput(
        out.mean[:, 0], out.log_weights[:, 0], out.log_evidence[:, 0], cov, mended, jitter
    )


def finish_output(
    mean: Float[Tensor, "B T D"],
    log_weights: Float[Tensor, "B T M"],
    log_evidence: Float[Tensor, "B T"],
    cov: Float[Tensor, "B T *blocks"] | None,
    lengths: Int[Tensor, " B"],
    work: Mending,
    n_filters: int = 1,
) -> FilterOutput:
    """Repeat the last estimate past each length, and report the elements that degenerated.

    Of filters side by side the estimates of each follow those of the one before.
    """
    n_frames = log_evidence.shape[1]
    if not values_visible() or bool((lengths < n_frames).any()):
        mean, log_weights = (held_past_lengths(value, lengths) for value in (mean, log_weights))
        cov = None if cov is None else held_past_lengths(cov, lengths)
        inside = inside_lengths(lengths, n_frames)
        log_evidence = torch.where(inside, log_evidence, torch.zeros_like(log_evidence))
        work = Mending(*(part * inside for part in work))
    failed_at = first_not_finite(mean)
    failed = failed_at >= 0
    if not values_visible() or bool(failed.any()):
        lost = ~inside_lengths(failed_at, n_frames) & failed[:, None]
        log_weights = log_weights.masked_fill(lost[..., None], float("nan"))
        if values_visible():
            _warn_of_failures(failed_at.unflatten(0, (n_filters, -1)))
    return FilterOutput(mean, log_weights, log_evidence, cov, failed_at, *work)


def first_not_finite(values: Float[Tensor, "B T D"]) -> Int[Tensor, " B"]:
    """Return the first frame in which any value is NaN or infinite, -1 where none is."""
    if seen_finite(values):
        return torch.full_like(values[:, 0, 0], -1, dtype=torch.long)
    bad = ~torch.isfinite(values).all(-1)
    first = bad.int().argmax(1)
    return torch.where(bad.any(1), first, -1)


def _warn_of_failures(failed_at: Int[Tensor, "A B"]) -> None:
    never = torch.iinfo(failed_at.dtype).max
    first = torch.where(failed_at >= 0, failed_at, never).amin(0)
    failed_at = first.masked_fill(first == never, -1)
    failed = torch.nonzero(failed_at >= 0).reshape(-1).tolist()
    listed = ", ".join(f"element {b} at frame {int(failed_at[b])}" for b in failed[:8])
    warnings.warn(
        f"{len(failed)} of {counted(len(failed_at), 'sequence')} degenerated ({listed}); "
        "their estimates are NaN from there on, the others finished. Check the scale of the "
        "measurements, or widen the measurement covariance",
        DegenerateFilterWarning,
        stacklevel=4,
    )
