"""List the keyword options of `UpperBodyTracker` with their types, for editors and type checkers."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypedDict

import torch
from torch import Tensor

from torchpose.priors._arm_lifter import ArmLifter
from torchpose.priors._arms import ArmPrior
from torchpose.upper_body._pose_track import PoseTrack


class MethodOptions(TypedDict, total=False):
    """The options of all shipped methods; `method_options` tells which of them a method has.

    A tracker refuses at run time what its method does not have, and knows the options of methods that
    were registered (`register_method`) at run time alone.
    """

    arms: ArmPrior | str | Path | None
    bone_lengths: Mapping[str, float] | None
    burn_in: int
    burn_in_scale: float | None
    dtype: torch.dtype
    gamma: Tensor | float | None
    height: float | None
    initial_cov: Tensor | None
    likelihood_power: float | None
    lifter: ArmLifter | str | Path | None
    n_particles: int
    n_tracks: int | None
    person: PoseTrack | str | Path | None
    process_cov: Tensor
    resample_threshold: float | None
    resampling: str
    reset_below: float | None
    start: str
    subspace: int | None
    transition: str
    uniform_weight: float | None
    weighting: str


class TrackerOptions(MethodOptions, total=False):
    """The options of a method, and those of `UpperBodyTracker` that hold for all methods."""

    method: str | None
    measurement_std: float | Sequence[float] | Tensor | None
    smoothing: int | str | None
    frame: str
    static_camera: bool
    window: bool | None
    steady: bool | None
    calibrated: bool
    neck: str | None
    outliers: bool
