"""The interface of the estimators: measured joints in, the states of both arms out."""

from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple

from jaxtyping import Float
from torch import Tensor, nn

from torchpose.camera.pinhole import PinholeCamera
from torchpose.camera.virtual_camera import BodyView
from torchpose.errors import CameraError, PriorError, check_rate
from torchpose.filters.base import Generators
from torchpose.filters.outputs import FilterOutput
from torchpose.priors.upper_body import UpperBodyPrior
from torchpose.upper_body.measurements import MeasuredJoints

__all__ = ["ArmJoints", "Estimates", "Estimator", "MotionRatios", "TrackerModel", "check_model"]

ArmJoints = dict[str, tuple[str, ...]]
"""For each arm, "left" and "right", those of `ARM_JOINTS` that are measured."""


class TrackerModel(NamedTuple):
    """What an estimator is made from, beside its own options.

    Attributes:
        owner: the module with which filters are kept between calls.
        prior: mixtures and noise. measurement_cov: R of the eight joints, [8, 2, 2], prior's pixels.
        fps: frame rate, or None. smoothing: None, the number of later frames that an estimate may
            use, or "full".
    """

    owner: nn.Module
    prior: UpperBodyPrior
    measurement_cov: Float[Tensor, "8 2 2"]
    fps: float | None
    smoothing: int | str | None = None

    @property
    def rate(self) -> float:
        """Frames per second, 30 where nobody says."""
        return self.fps or 30.0


def check_model(
    prior: UpperBodyPrior, camera: PinholeCamera | None, fps: float | None
) -> PinholeCamera:
    """Return the camera, if what a tracker works with is all there.

    Raises:
        PriorError: no prior of the upper body. CameraError: no camera. InputError: a frame rate that is
            not positive.
    """
    if not isinstance(prior, UpperBodyPrior):
        raise PriorError(
            f"prior must be an UpperBodyPrior, got {type(prior).__name__}; see torchpose.load_prior"
        )
    if fps is not None:
        check_rate("fps", fps)
    if camera is None:
        raise CameraError(
            "a camera is needed, got None; pass camera=PinholeCamera(fx, fy, cx, cy), "
            "PinholeCamera.from_image_size(width, height), or prior.camera if it is the same"
        )
    return camera


class Estimates(NamedTuple):
    """The states of both arms in T frames.

    Attributes:
        left, right: with covariances, float64; the first 21 dimensions are those of
            `torchpose.priors.arm_state`.
        view: the virtual camera in whose pixels the states are; None is the prior's camera.
    """

    left: FilterOutput
    right: FilterOutput
    view: BodyView | None = None


class MotionRatios(NamedTuple):
    """q/r, 1/s^3, of the constant-velocity filters over joints, their pixels and the placement."""

    joint: float
    pixel: float
    placement: float


class Estimator(ABC):
    """Estimates the states of both arms from the measured joints; each entry of `METHODS` makes one.

    The constructor takes a `TrackerModel` and, by name, the options of the method. An estimator holds
    no state: what changes from frame to frame is the value that `init` makes and `advance` returns.

    Attributes:
        smooths: whether estimates can use later frames. particles: whether estimates rest on
            weighted points, which can collapse onto one of them (`note_collapse`).
        calibration: the name under which a prior keeps its calibration of the covariances; None goes
            by the name of the method.
        steadied_by: of the motion stage that frames need, None where they follow each other smoothly.
        ahead: number of later frames that an estimate uses by itself.
        reads_rays: whether pixels and joints in space are two readings (`on_their_rays`).
    """

    smooths: ClassVar[bool] = False
    particles: ClassVar[bool] = False
    calibration: str | None = None
    steadied_by: MotionRatios | None = None
    ahead: int = 0
    reads_rays: bool = False

    def check(self) -> None:  # noqa: B027  # most estimators have nothing to refuse
        """Raise what does not fit, before any work; estimators may leave it out."""

    @abstractmethod
    def init(self, batch_size: int, joints: ArmJoints, generators: dict[str, Generators]) -> Any:
        """Return the state before the first frame of B streams.

        Args:
            batch_size: B. joints: that may be measured. generators: of each arm, for what draws.
        """

    @abstractmethod
    def advance(self, state: Any, measured: MeasuredJoints) -> tuple[Any, Estimates]:
        """Return the next state and the estimates of T more frames, which later frames do not change.

        Args:
            state: from `init` or the call before; it is not changed. measured: [B, T, ...].
        """

    @abstractmethod
    def forward(
        self,
        measured: MeasuredJoints,
        joints: ArmJoints,
        generators: dict[str, Generators],
        lengths: Tensor | None = None,
        progress: bool = False,
    ) -> Estimates:
        """Return the estimates of whole sequences: those of `init` and `advance`, or smoothed ones.

        Args:
            measured: [B, T, ...]. joints, generators: as in `init`. lengths: frames of each sequence,
                [B]; past them the last estimate is repeated. progress: whether to show a bar.
        """
