"""Fine-tune a prior through its filters, by gradients of log-evidence and of the 3D error.

Expectation-maximisation fits a mixture to poses, and Q and R are set by hand. Here both are tuned for
the filter that uses them. Every parameter is free of constraints (logarithms, logits, triangular factors
with the logarithm of their diagonal), so covariances stay positive definite and weights positive after any
step of an optimiser.

`TunableKalman` tunes the filter over single poses on short sequences (`draw_sequences`),
`TunableWindow` the mixtures over windows on single windows (`draw_windows`). Both have

    loss(batch) -> Tensor      what is made small: mean 3D error and log-evidence, weighted
    error(batch) -> Tensor     mean 3D error in metres after Procrustes, to stop early by
    prior() -> UpperBodyPrior  at the current parameters
"""

from torchpose.learning._fine_tuning.parameters import TunableMixture, parameter_groups, pose_error
from torchpose.learning._fine_tuning.poses import SequenceBatch, TunableKalman, draw_sequences
from torchpose.learning._fine_tuning.windows import TunableWindow, WindowBatch, draw_windows

__all__ = [
    "SequenceBatch",
    "TunableKalman",
    "TunableMixture",
    "TunableWindow",
    "WindowBatch",
    "draw_sequences",
    "draw_windows",
    "parameter_groups",
    "pose_error",
]
