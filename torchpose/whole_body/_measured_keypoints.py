"""Give keypoints to the particle filters over bodies: frames of measurements, and the first pose."""

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_shape, check_tensors
from torchpose.body._fitting import fit_state
from torchpose.body._kinematics import Body
from torchpose.camera._rig import CameraRig
from torchpose.errors import InputError, NobodySeenError
from torchpose.whole_body._following import Observed
from torchpose.whole_body._keypoints.begin_anew import LEAST_JOINTS
from torchpose.whole_body._keypoints.keypoint_body_tracker import KeypointBodyTracker
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame
from torchpose.whole_body._keypoints.particle_likelihood import KeypointMeasurement


class GivenKeypoints(NamedTuple):
    """Holds keypoints as `BodyTracker` takes them, for T frames."""

    keypoints: Tensor
    confidence: Tensor | None = None
    names: Sequence[str] | None = None
    covariance: Tensor | None = None

    def alone(self) -> "GivenKeypoints":
        """Return the keypoints of one frame as those of a sequence of one."""
        confidence, covariance = (
            None if value is None else value[None] for value in (self.confidence, self.covariance)
        )
        return GivenKeypoints(self.keypoints[None], confidence, self.names, covariance)


def given_keypoints(
    keypoints: Tensor | None,
    confidence: Tensor | None,
    names: Sequence[str] | None,
    covariance: Tensor | None,
) -> GivenKeypoints | None:
    """Return keypoints with what belongs to them, None if there are none.

    Raises:
        InputError: arrays or lists in place of tensors.
    """
    check_tensors(keypoints=keypoints, confidence=confidence, covariance=covariance)
    if keypoints is None:
        return None
    return GivenKeypoints(keypoints, confidence, names, covariance)


class BodyKeypointMeasurer:
    """Makes measurements for particle filters of a detector's keypoints.

    Args:
        rig: the cameras. fps: frames per second. body: upright, of which the first pose is.
        keypoint_std, pixel_std: as `BodyTracker`.

    Raises:
        InputError, CameraError, SkeletonError: as `KeypointBodyTracker`.
    """

    def __init__(
        self,
        rig: CameraRig,
        fps: float,
        body: Body,
        keypoint_std: float | None,
        pixel_std: float | None,
    ) -> None:
        self.body = body
        self.tracker = KeypointBodyTracker(
            rig, fps, body=body, keypoint_std=keypoint_std, pixel_std=pixel_std
        )

    def measured(self, given: GivenKeypoints, fitting: bool = False) -> KeypointFrame:
        """Return the keypoints of T frames [T, C, 15, ...], with their noise and trust.

        Args:
            given: the keypoints. fitting: as `KeypointReader.frames_and_feet`.

        Raises:
            ShapeError, InputError, CameraError: as `BodyTracker.forward`.
        """
        check_shape("keypoints", given.keypoints, ["T", len(self.tracker.rig), None, 2])
        return self.tracker.reader.frames_and_feet(*given, fitting=fitting)[0]

    def observed(self, frames: KeypointFrame, t: int) -> KeypointMeasurement:
        """Return the measurement of one frame, of one element."""
        maps = self.tracker.tracker.filter.maps
        return KeypointMeasurement(frames.map(lambda v: v[t : t + 1]), maps)

    def first_frame(self, frames: KeypointFrame) -> int:
        """Return the first frame with enough joints for a first pose: the one in which "kalman" begins.

        Raises:
            NobodySeenError: there is none.
        """
        return self.tracker.first_frames(frames.map(lambda value: value[None]))[0]

    def first_pose(self, frames: KeypointFrame) -> Float[Tensor, " D"]:
        """Return the pose of the first of some frames, as the Kalman smoother finds it in all of them.

        It is that of the first frame with enough joints in any camera.

        Raises:
            NobodySeenError: there is none. CameraError: cameras of another convention or unit.
        """
        batch = frames.map(lambda value: value[None])
        self.tracker.check_cameras(batch)
        poses = self.tracker.tracker(batch, smoothing=True, waited=math.inf)
        if not bool(poses.started.any()):
            raise NobodySeenError(
                f"no frame has keypoints of {LEAST_JOINTS} joints or more in any camera; check the "
                "keypoints and their names"
            )
        begun = int(poses.started[0].int().argmax())
        return fit_state(self.body, poses.joints[0, begun : begun + 1])[0]


def observed_frames(
    silhouettes: Iterable[Tensor] | None,
    measurer: BodyKeypointMeasurer | None,
    frames: KeypointFrame | None,
) -> Iterator[Observed]:
    """Yield frames of silhouettes, of keypoints, or of both.

    Raises:
        InputError: silhouettes and keypoints of different numbers of frames.
    """
    if frames is None or measurer is None:
        yield from map(Observed, silhouettes or ())
        return
    count = len(frames.pixels)
    if silhouettes is None:
        yield from (Observed(None, measurer.observed(frames, t)) for t in range(count))
        return
    t = 0
    for t, outlined in enumerate(silhouettes, 1):
        if t > count:
            break
        yield Observed(outlined, measurer.observed(frames, t - 1))
    if t != count:
        raise InputError(
            f"silhouettes and keypoints must have the same number of frames, got {t} or more of "
            f"silhouettes and {count} of keypoints"
        )
