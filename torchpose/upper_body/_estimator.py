"""Define the interface of the estimators: measured joints in, the states of both arms out."""

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from typing import Any, ClassVar, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchpose._core.checks import check_tracked_rate
from torchpose.camera._pinhole import PinholeCamera
from torchpose.camera._virtual_camera import BodyView
from torchpose.errors import CameraError, PriorError
from torchpose.filters._lengths import held_past_lengths, inside_lengths
from torchpose.filters._outputs import FilterOutput, StepOutput
from torchpose.filters._recursive_filter import Generators
from torchpose.math._rotations import (
    matrix_to_quaternion_vector,
    mean_rotation,
    quaternion_vector_to_matrix,
)
from torchpose.priors._upper_body_prior import UpperBodyPrior
from torchpose.skeleton._upper_body import ARM_JOINTS, LEFT_ARM, RIGHT_ARM
from torchpose.upper_body._measured_joints import MeasuredJoints

ArmJoints = dict[str, tuple[str, ...]]
"""For each arm, "left" and "right", those of `ARM_JOINTS` that are measured."""

ArmGenerators = dict[str, Generators]
"""For each arm, "left" and "right", the random generators of its filter."""


class TrackerModel(NamedTuple):
    """Prior, noise and settings that an estimator is made from, beside its own options.

    Attributes:
        owner: the module with which filters are kept between calls.
        prior: mixtures and noise. measurement_cov: R of the eight joints, [8, 2, 2], prior's pixels.
        fps: frames per second, or None. smoothing: None, the number of later frames that an estimate may
            use, or "full".
        hand: the kind of the measured hands, "hand" or "wrist"; None is the prior's.
        middle: whether the middle of the shoulders is measured in place of the neck, and whether of the
            shoulders their middle alone is measured.
        calibrated: whether covariances are recalibrated by the noise of the prior.
        steadied: whether the poses of windows pass filters of constant velocity.
        pitch: the angle by which the camera looks up, radians, if its orientation against gravity is known;
            measurements are then those of a level camera. None is about level.
    """

    owner: nn.Module
    prior: UpperBodyPrior
    measurement_cov: Float[Tensor, "8 2 2"]
    fps: float | None
    smoothing: int | str | None = None
    hand: str | None = None
    middle: tuple[bool, bool] = (False, False)
    calibrated: bool = True
    steadied: bool = True
    pitch: float | None = None

    @property
    def upright(self) -> bool:
        """Return whether roll and pitch of the camera against gravity are known, as angles of a state."""
        # with yaw the last rotation, they do not depend on the turn of the body
        return self.pitch is not None and self.prior.info.rotation_order == "zxy"

    @property
    def rate(self) -> float:
        """Return the frames per second, 30 where none is given."""
        return self.fps or 30.0


def check_model(
    prior: UpperBodyPrior, camera: PinholeCamera | None, fps: float | None
) -> PinholeCamera:
    """Return the camera, after checks of prior, camera and frame rate of a tracker.

    Raises:
        PriorError: no prior of the upper body. CameraError: no camera. InputError: a frame rate that is
            not positive.
    """
    if not isinstance(prior, UpperBodyPrior):
        raise PriorError(
            f"prior must be an UpperBodyPrior, got {type(prior).__name__}; see torchpose.load_prior"
        )
    if fps is not None:
        check_tracked_rate(fps)
    if camera is None:
        raise CameraError(
            "a camera is needed, got None; pass camera=PinholeCamera(fx, fy, cx, cy), "
            "PinholeCamera.from_image_size(width, height), or prior.camera if it is the same"
        )
    if not isinstance(camera, PinholeCamera):
        raise CameraError(
            f"camera must be a PinholeCamera, got {type(camera).__name__}; pass "
            "PinholeCamera(fx, fy, cx, cy), or for a matrix PinholeCamera.from_matrix(K)"
        )
    return camera


class ReadOut(NamedTuple):
    """Poses in the axes of the body, with its rotation and its place.

    Attributes:
        joints: in the body's frame [B, T, 8, 3], metres. covs: [B, T, 8, 3, 3].
        angles: roll, pitch, yaw that turn the body's axes into the camera's [B, T, 3], radians.
        place: the body's centre in camera axes [B, T, 3], metres.
        uv: [B, T, 8, 2], pixels of the prior's camera. uv_covs: [B, T, 8, 2, 2].
    """

    joints: Tensor
    covs: Tensor
    angles: Tensor
    place: Tensor
    uv: Tensor
    uv_covs: Tensor


class SeenPoses(NamedTuple):
    """Poses in the axes of the camera.

    Attributes:
        joints: [B, T, 8, 3], metres. covs: [B, T, 8, 3, 3].
        rotations: from the axes of the body to those of the camera, by each of N models, [B, T, N, 3, 3].
        shares: the weights of these models, [B, T, N].
        place: the body's centre [B, T, 3], metres.
        uv: [B, T, 8, 2], pixels of the prior's camera. uv_covs: [B, T, 8, 2, 2].
    """

    joints: Tensor
    covs: Tensor
    rotations: Tensor
    shares: Tensor
    place: Tensor
    uv: Tensor
    uv_covs: Tensor

    @property
    def rotation(self) -> Float[Tensor, "B T 3 3"]:
        """Return the rotation from the axes of the body to those of the camera: the mean of the models'."""
        if self.rotations.shape[2] == 1:
            return self.rotations[:, :, 0]
        vectors = matrix_to_quaternion_vector(self.rotations)
        return quaternion_vector_to_matrix(mean_rotation(vectors, self.shares))


class Bones(NamedTuple):
    """Lengths of bones.

    Attributes:
        names: the names of K lengths, as `torchpose.priors._arms.LENGTHS` has them.
        metres: [..., K]. covs: metres squared, [..., K, K].
    """

    names: tuple[str, ...]
    metres: Tensor
    covs: Tensor


class Estimates(NamedTuple):
    """Holds the states of both arms in T frames.

    Attributes:
        left, right: the states of each arm with covariances, float64; the first 21 dimensions are those
            of `torchpose.priors._arm_state`. If more follow, which are joints in the axes of the torso,
            covariances are those of each three dimensions alone, [B, T, 12, 3, 3].
        view: the virtual camera in whose pixels the states are; None is the prior's camera.
        poses: by estimators that do not estimate the states of single arms; no motion stage follows. Else
            None.
        bones: the lengths of bones [B, T, K], by estimators that learn them; else None.
    """

    left: FilterOutput
    right: FilterOutput
    view: BodyView | None = None
    poses: SeenPoses | None = None
    bones: Bones | None = None

    @property
    def seen_poses(self) -> SeenPoses:
        """Return the poses.

        Raises:
            RuntimeError: the estimator estimates the states of single arms.
        """
        if self.poses is None:
            raise RuntimeError("the estimator reads out no poses itself")
        return self.poses


class MotionRatios(NamedTuple):
    """Ratios q/r, 1/s^3, of the constant-velocity filters over joints, their pixels and the placement."""

    joint: float
    pixel: float
    placement: float


class Estimator(ABC):
    """Estimates the states of both arms from the measured joints; `METHODS` has one estimator per method.

    The constructor takes a `TrackerModel` and, by name, the options of the method. An estimator holds
    no state: what changes from frame to frame is the value that `init` makes and `advance` returns.

    Attributes:
        smooths: whether estimates can use later frames. particles: whether estimates rest on
            weighted points, which can collapse onto one of them (`note_collapse`).
        calibration: the name under which a prior keeps its calibration of the covariances; None goes
            by the name of the method.
        steadied_by: the ratios of the motion stage that the poses need; None where they follow each other
            smoothly.
        ahead: the number of later frames that an estimate uses by itself.
        knows_wrists: whether it tells wrists from hands (`TrackerModel.hand`).
        reads_rays: whether pixels and joints in space are two readings (`on_their_rays`).
    """

    smooths: ClassVar[bool] = False
    particles: ClassVar[bool] = False
    calibration: str | None = None
    steadied_by: MotionRatios | None = None
    ahead: int = 0
    knows_wrists: ClassVar[bool] = False
    reads_rays: bool = False

    def check(self) -> None:  # noqa: B027  # most estimators have nothing to refuse
        """Raise the errors of the options before any work; estimators may leave it out."""

    @abstractmethod
    def init(self, batch_size: int, joints: ArmJoints, arm_generators: ArmGenerators) -> Any:
        """Return the state before the first frame of B streams.

        Args:
            batch_size: B. joints: the joints of each arm that may be measured.
            arm_generators: the random generators of each arm (`generators_of_arms`), for methods that
                draw.

        Returns:
            State of B streams, for `advance`.
        """

    @abstractmethod
    def advance(
        self, state: Any, measured: MeasuredJoints, progress: bool = False
    ) -> tuple[Any, Estimates]:
        """Return the next state and the estimates of T more frames, which later frames do not change.

        Args:
            state: the state from `init` or the previous call; it is not changed.
            measured: the measurements, [B, T, ...]. progress: whether to show a progress bar.

        Returns:
            The next state, and `Estimates` with means [B, T, D].
        """

    def forward(
        self,
        measured: MeasuredJoints,
        joints: ArmJoints,
        arm_generators: ArmGenerators,
        lengths: Int[Tensor, " B"] | None = None,
        progress: bool = False,
    ) -> Estimates:
        """Return the estimates of whole sequences: `init`, then `advance` over all frames.

        Estimators that smooth override it, and so may those that know a faster way to the same numbers.

        Args:
            measured: the measurements, [B, T, ...]. joints, arm_generators: as in `init`.
            lengths: the number of frames of each sequence, [B]; past it the last estimate is repeated.
            progress: whether to show a progress bar.

        Returns:
            `Estimates` with means [B, T, D].
        """
        state = self.init(len(measured.uv), joints, arm_generators)
        _, estimates = self.advance(state, measured, progress)
        return repeat_last(estimates, lengths)


ARMS = {"left": LEFT_ARM, "right": RIGHT_ARM}
"""Indices into `UPPER_BODY` of each arm, in the order of `ARM_JOINTS`."""

_USUAL = ("hand", "head", "neck")


def joints_of_arm(side: str, there: Sequence[bool]) -> tuple[str, ...]:
    """Return hand, head and neck of an arm, and those of its other joints that are measured.

    Args:
        side: "left" or "right". there: whether each of `UPPER_BODY` is measured.

    >>> joints_of_arm("left", [True, True, False, True, False, False, False, True])
    ('hand', 'elbow', 'head', 'neck')
    """
    rows = zip(ARM_JOINTS, ARMS[side], strict=True)
    return tuple(joint for joint, row in rows if joint in _USUAL or there[row])


def arm_joints(there: Sequence[bool]) -> dict[str, tuple[str, ...]]:
    """Return `joints_of_arm` of both arms.

    Args:
        there: whether each of `UPPER_BODY` is measured.
    """
    return {side: joints_of_arm(side, there) for side in ARMS}


def generators_of_arms(generator: Generators) -> ArmGenerators:
    """Return a generator for each arm, so that the draws of one do not depend on those of the other."""
    return dict(zip(ARMS, _pair(generator), strict=True))


def _pair(generator: Generators) -> tuple[Generators, Generators]:
    if generator is None:
        return None, None
    if isinstance(generator, torch.Generator):
        left, right = torch.randint(2**62, (2,), generator=generator, device=generator.device)
        device = generator.device
        return (
            torch.Generator(device).manual_seed(int(left)),
            torch.Generator(device).manual_seed(int(right)),
        )
    pairs = [_pair(g) for g in generator]
    lefts = [left for left, _ in pairs if isinstance(left, torch.Generator)]
    return lefts, [right for _, right in pairs if isinstance(right, torch.Generator)]


def repeat_last(estimates: Estimates, lengths: Int[Tensor, " B"] | None) -> Estimates:
    """Return the estimates with the last one of each sequence repeated past its length.

    There the log-evidence is 0, no covariance counts as mended, and a failure does not count.

    Args:
        estimates: the estimates of T frames. lengths: the number of frames of each sequence, [B]; None
            is T.
    """
    n_frames = estimates.left.mean.shape[1]
    if lengths is None or bool((lengths >= n_frames).all()):
        return estimates
    lengths = lengths.to(estimates.left.mean.device)
    view, poses, bones = estimates.view, estimates.poses, estimates.bones
    return Estimates(
        _repeat_output(estimates.left, lengths),
        _repeat_output(estimates.right, lengths),
        None if view is None else BodyView(*_held(view, lengths)),
        None if poses is None else repeat_poses(poses, lengths),
        None if bones is None else Bones(bones.names, *_held(bones[1:], lengths)),
    )


def repeat_poses(poses: SeenPoses, lengths: Int[Tensor, " B"]) -> SeenPoses:
    """Return the poses with the last one of each sequence repeated past its length."""
    return SeenPoses(*_held(poses, lengths))


def _repeat_output(out: FilterOutput, lengths: Int[Tensor, " B"]) -> FilterOutput:
    mean, log_weights = _held((out.mean, out.log_weights), lengths)
    inside = inside_lengths(lengths, out.mean.shape[1])
    return FilterOutput(
        mean,
        log_weights,
        torch.where(inside, out.log_evidence, torch.zeros_like(out.log_evidence)),
        None if out.cov is None else _held((out.cov,), lengths)[0],
        torch.where(out.failed_at < lengths, out.failed_at, -1),
        None if out.mended is None else out.mended * inside,
        None if out.jitter is None else out.jitter * inside,
    )


def _held(values: Iterable[Tensor], lengths: Int[Tensor, " B"]) -> list[Tensor]:
    """Return values [B, T, ...] with those of the last frame of each sequence past its length."""
    return [held_past_lengths(value, lengths.to(value.device)) for value in values]


def first_failure(left: FilterOutput, right: FilterOutput) -> Tensor:
    """Return the first frame at which either arm degenerated, -1 where none did, [B]."""
    if left.failed_at is right.failed_at:
        return left.failed_at
    n_frames = left.mean.shape[1]
    failures = torch.stack([left.failed_at, right.failed_at])
    first = failures.where(failures >= 0, n_frames).amin(0)
    return torch.where((failures >= 0).any(0), first, -1)


def in_double(out: FilterOutput) -> FilterOutput:
    """Return the estimates in float64, in which poses are read out of them."""
    wide = [
        v.double() if v is not None and v.is_floating_point() and v.dtype != torch.float64 else v
        for v in out
    ]
    return FilterOutput(*wide)  # type: ignore[arg-type]


def mending_notes(left: FilterOutput, right: FilterOutput) -> tuple[str, ...]:
    """Return a note about covariances that were mended; nothing where none was."""
    outputs = [out for out in (left, right) if out.mended is not None and out.jitter is not None]
    count = sum(int(out.mended.sum()) for out in outputs if out.mended is not None)
    if not count:
        return ()
    most = max(float(out.jitter.max()) for out in outputs if out.jitter is not None)
    return (_mending_note(count, most),)


def _mending_note(count: int, most: float) -> str:
    return (
        f"{count} covariances were not positive definite in rounding and were mended: their "
        f"variances grew by at most {most:.0e} of themselves"
    )


_MENDED = re.compile(r"(\d+) covariances were not positive definite .* at most (\S+) of themselves")


def joined_notes(notes: Iterable[str]) -> tuple[str, ...]:
    """Return the notes of all parts of a sequence, each once, and one on all covariances that were mended."""
    mended, others = [], []
    for note in notes:
        match = _MENDED.fullmatch(note)
        mended += [match] if match else []
        others += [] if match else [note]
    once = tuple(dict.fromkeys(others))
    if not mended:
        return once
    count, most = sum(int(match[1]) for match in mended), max(float(match[2]) for match in mended)
    return (*once, _mending_note(count, most))


def require_cov(out: FilterOutput | StepOutput) -> Tensor:
    """Return the covariances, which the filter was asked for."""
    if out.cov is None:
        raise RuntimeError("the filter was run without return_cov=True")
    return out.cov
