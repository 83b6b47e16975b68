"""Track arms of bones, and average them with what a network lifts from single frames."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from torchpose.priors._arm_lifter import ArmLifter
from torchpose.priors._arms import ArmPrior
from torchpose.upper_body._articulated import ArticulatedFilter, ArticulatedState
from torchpose.upper_body._estimator import (
    ArmGenerators,
    ArmJoints,
    Estimates,
    Estimator,
    TrackerModel,
    repeat_last,
)
from torchpose.upper_body._lifted_ends import LiftedState, ends_average
from torchpose.upper_body._measured_joints import MeasuredJoints
from torchpose.upper_body._pose_track import PoseTrack

_MODESTY = 0.5  # factor on the variances of bones, to find their share beside lifted arms


class LiftedArticulatedState(NamedTuple):
    """State of `LiftedArticulatedFilter` between two frames.

    Attributes:
        bones: the state of the filter of bones. lifted: what is kept for the network that lifts arms.
    """

    bones: ArticulatedState
    lifted: LiftedState


class LiftedArticulatedFilter(Estimator):
    """Estimator that averages the poses of `ArticulatedFilter` with elbows and hands that a network lifts.

    See `EndsAverage`, which moves a body along its rays, and arms beside that. Covariances stay as they are:
    on four sets that were in no fit they hold for the average as well as for bones alone. `bone_lengths` stay
    the belief of the filter of bones, about which those of the joints vary.

    Args:
        model, arms, bone_lengths, height, person: as in `ArticulatedFilter`.
        lifter: the network that lifts arms, or its file; by default the one that comes with the package.

    Raises:
        InputError: as `ArticulatedFilter`, or no network. FileFormatError: a file of another kind.
    """

    calibration = ArticulatedFilter.calibration
    smooths = ArticulatedFilter.smooths
    knows_wrists = ArticulatedFilter.knows_wrists

    def __init__(
        self,
        model: TrackerModel,
        arms: ArmPrior | str | Path | None = None,
        bone_lengths: Mapping[str, float] | None = None,
        height: float | None = None,
        person: PoseTrack | str | Path | None = None,
        lifter: ArmLifter | str | Path | None = None,
    ) -> None:
        self.bones = ArticulatedFilter(model, arms, bone_lengths, height, person)
        self.ahead = self.bones.ahead
        self.ends = ends_average(model, lifter, _MODESTY, unit=self.bones.lengths.unit)

    def init(
        self, batch_size: int, joints: ArmJoints, arm_generators: ArmGenerators
    ) -> LiftedArticulatedState:
        """Return the state before the first frame; see `Estimator`."""
        bones = self.bones.init(batch_size, joints, arm_generators)
        return LiftedArticulatedState(bones, self.ends.init(batch_size))

    def advance(
        self, state: LiftedArticulatedState, measured: MeasuredJoints, progress: bool = False
    ) -> tuple[LiftedArticulatedState, Estimates]:
        """Return the next state and the estimates of T more frames; see `Estimator`."""
        bones, bodies = self.bones.advance(state.bones, measured, progress)
        lifted, averaged = self._averaged(state.lifted, bodies, measured)
        return LiftedArticulatedState(bones, lifted), averaged

    def forward(
        self,
        measured: MeasuredJoints,
        joints: ArmJoints,
        arm_generators: ArmGenerators,
        lengths: Tensor | None = None,
        progress: bool = False,
    ) -> Estimates:
        """Return the estimates of whole sequences; see `Estimator`."""
        bodies = self.bones.forward(measured, joints, arm_generators, lengths, progress)
        _, averaged = self._averaged(self.ends.init(len(measured.uv)), bodies, measured)
        return repeat_last(averaged, lengths)

    def _averaged(
        self, state: LiftedState, bodies: Estimates, measured: MeasuredJoints
    ) -> tuple[LiftedState, Estimates]:
        """Return what is kept of lifted arms, and the estimates of bones with averaged poses."""
        ends = self.ends.lift(state, bodies.seen_poses, measured.mask)
        state, poses = self.ends.advance(state, bodies.seen_poses, ends, measured.mask)
        return state, bodies._replace(poses=poses)
