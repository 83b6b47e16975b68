"""Hold the poses of a tracked whole body with their uncertainty, and read and write their file."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchpose._core.estimates import check_estimates, frame_facts, to_tensor
from torchpose._core.facade import set_up_facade
from torchpose._core.files import write_npz
from torchpose._core.reading import check_arrays, npz_keys, one_text, read_npz, texts
from torchpose.body._kinematics import Body
from torchpose.body._skeleton import BODY_15
from torchpose.camera._pinhole import PinholeCamera
from torchpose.errors import FileFormatError, InputError, ShapeError, SkeletonError
from torchpose.math._gaussian import mean_std
from torchpose.whole_body._body_feet import FIELDS_OF_FEET, BodyFeet, TrackedPoints, feet_of
from torchpose.whole_body._body_files import BodyMotion3d, write_body_file
from torchpose.whole_body._filters.body_particles import first_true

_FRAMES = {
    "state": "f T 36",
    "state_std": "f T 36",
    "joints3d": "f T 15 3",
    "covariance3d": "f T 15 3 3",
    "log_evidence": "f T",
    "effective_sample_size": "f T",
    "coasting": "b T",
    "respread": "b T",
}  # kinds and sizes in a file
_DETAIL = "detail_"  # of the keys of what only some filters report
_DETAILS = {"inlier": "n T C 15", "feet_inlier": "n T C 6", **FIELDS_OF_FEET}
_BODY = {
    "bone_lengths": "f 15",
    "offsets": "f 15 3",
    "tips": "f K 3",
    "radii": "f L 2",
    "centres": "f P 3",
}
_FPS = 30.0  # of files that need a rate, where none is known
_APART = 1e-3  # metres between joints and where the states put them
# Bones of this method adapt over time, by metres where keypoints are no person's.
_APART_OF = {"kalman": 5.0}
_HEIGHTS = (0.3, 5.0)  # metres; between them is everybody, and what is no person is outside


@dataclass
class BodyTrack:
    """Holds the poses of one person in T frames; J joints and states of D numbers, as their body has.

    Named as in `torchpose.PoseTrack`, without the dimension of a batch: what is [B, T, ...] there is [T, ...]
    here, and what is [B] there is a tensor without a dimension. A filter over bodies that fails goes on with
    particles drawn anew, so there is a pose in every frame: `respread` tells the frames in which that
    happened, `failed_at` the first of them. Past the length of a sequence its last pose is repeated.

    Attributes:
        body: the body of the person, to which the states belong.
        state: [T, D], the estimates.
        state_std: [T, D], their standard deviations, in the units of a step (`Body.difference`).
        joints3d: [T, J, 3], the joints of the estimates, metres, world axes. Those of "kalman" may be
            centimetres from where `state` has them, since its shoulders and hips shift and bones adapt.
        covariance3d: [T, J, 3, 3], the second moment of the particles' joints about them, metres squared;
            filters with Gaussians include these. Of "kalman" in one camera they hold that a person may be
            larger and farther away.
        log_evidence: [T], the increments log p(z_t | z_1:t-1).
        effective_sample_size: [T], 1 / sum_j w_j^2 of the particles; NaN where there are none.
        coasting: [T], True where no camera saw the person.
        respread: [T], True where all particles had died and were spread about the last estimate.
        fps: the number of frames per second, or None. notes: the assumptions, in plain words.
        first_frame: the frame of the videos that the first pose belongs to.
        details: what only some filters report, by name, [T, ...] each (`BodyFilterOutput.details`), such
            as "acceptance", "clamped" and "actions" of `ConstrainedParticleFilter`; of "kalman" "inlier"
            [T, C, J] (probability that a camera's keypoint was the joint's), "exchanged" [T, C, 2] (that
            left and right were exchanged, of arms and of legs), "bone_lengths" [T, J], metres, of one camera
            and of cameras side by side "covariance_from_pelvis" [T, J, 3, 3] (of joints relative to the
            pelvis, metres squared), where a camera was found to be turned "camera_turn" [T, C, 3, 3] (D in
            world axes: a camera whose calibration has the rotation R and the centre c sees a point x in the
            direction R D^T (x - c) of its axes), and where keypoints have some of feet what `feet` is made
            of.
        action_names: the names of the columns of ``details["actions"]``.
        method: the name of the filter that ran, one of `torchpose.whole_body.METHODS`; "unknown" in files
            of older releases.
    """

    body: Body
    state: Tensor
    state_std: Tensor
    joints3d: Tensor
    covariance3d: Tensor
    log_evidence: Tensor
    effective_sample_size: Tensor
    coasting: Tensor
    respread: Tensor
    fps: float | None = None
    notes: tuple[str, ...] = field(default_factory=tuple)
    first_frame: int = 0
    details: dict[str, Tensor] = field(default_factory=dict)
    action_names: tuple[str, ...] = field(default_factory=tuple)
    method: str = "unknown"

    def __len__(self) -> int:
        return len(self.state)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the joints."""
        return self.body.skeleton.names

    @property
    def feet(self) -> BodyFeet | None:
        """Return heels and toes with their covariances, and the ankles; None without keypoints of feet."""
        return feet_of(self.details)

    @property
    def failed_at(self) -> Int[Tensor, ""]:
        """Return the first frame in which all particles had died, -1 if none, as `PoseTrack.failed_at`."""
        return first_true(self.respread)

    @property
    def failed(self) -> Bool[Tensor, ""]:
        """Return whether the filter failed, in any frame, as `PoseTrack.failed`."""
        return self.failed_at >= 0

    def save(self, path: str | Path) -> None:
        """Write the poses as .npz, atomically: an interrupted write leaves no partial file.

        Keys: what holds for each frame, `names`, `fps` (NaN if unknown), `notes`, `first_frame`, `method`,
        `action_names`, details as `detail_acceptance` and so on, and the body as `body_bone_lengths`,
        `body_radii` and so on.

        Args:
            path: the file, which is replaced if there is one.

        Raises:
            InputError: a frame before tracking began. OutputError: the file cannot be written.
        """
        self._check_begun()
        arrays: dict[str, Any] = {
            name: getattr(self, name).detach().cpu().numpy() for name in _FRAMES
        }
        arrays |= {f"body_{n}": getattr(self.body, n).detach().cpu().numpy() for n in _BODY}
        for name, value in self.details.items():
            arrays[_DETAIL + name] = value.detach().cpu().numpy()
        arrays["action_names"] = np.array(self.action_names, dtype=str)
        arrays["body_skeleton"] = np.array(self.body.skeleton.name)
        arrays["body_frame"] = np.array(self.body.frame)
        arrays["names"] = np.array(self.names)
        arrays["fps"] = np.array(np.nan if self.fps is None else self.fps)
        arrays["notes"] = np.array(self.notes, dtype=str)
        arrays["first_frame"] = np.array(self.first_frame)
        arrays["method"] = np.array(self.method)
        write_npz(path, arrays)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what `save` wrote.

        Args:
            path: .npz file.

        Returns:
            The poses, with their body.

        Raises:
            InputError: no such file. FileFormatError: not such poses, or fields that do not agree: other
                shapes or types, details of other frames, joints elsewhere than the states put them.
            SkeletonError: another skeleton.
        """
        there = npz_keys(path)
        details = [key for key in there if key.startswith(_DETAIL)]
        required = (*_FRAMES, "names", "fps", "notes")
        arrays = read_npz(path, required, ("first_frame", "method", "action_names", *details))
        n_frames = check_arrays(path, arrays, _FRAMES)["T"]
        if n_frames == 0:
            raise FileFormatError(f"{path}: expected poses of one frame or more, got none")
        names = texts(path, "names", arrays["names"])
        if names != BODY_15.names:
            raise FileFormatError(f"{path}: expected the joints {', '.join(BODY_15.names)}")
        for key in details:
            value = arrays[key]
            if value.dtype.kind not in "fiub" or value.ndim < 1 or len(value) != n_frames:
                raise FileFormatError(
                    f"{path}: expected {key} of {n_frames} frames, got {value.dtype!s:.40} of the sizes "
                    f"{list(value.shape)!s:.60}"
                )
        actions = texts(path, "action_names", arrays.get("action_names", np.array(())))
        fields = {_DETAIL + name: field for name, field in _DETAILS.items()}
        fields[f"{_DETAIL}actions"] = f"n T {len(actions)}"
        check_arrays(path, arrays, {key: fields[key] for key in details if key in fields})
        frames: dict[str, Any] = {name: to_tensor(arrays[name]) for name in _FRAMES}
        poses = cls(
            load_body(path),
            **frames,
            details={key.removeprefix(_DETAIL): to_tensor(arrays[key]) for key in details},
            action_names=actions,
            method=one_text(path, "method", arrays.get("method", np.array("unknown"))),
            **frame_facts(path, arrays),
        )
        poses._check(path)
        return poses

    def _check_begun(self) -> None:
        """Raise `InputError` where there is no pose, as live before tracking begins."""
        there = self.state.isfinite().all(-1)
        if not bool(there.all()):
            first = self.first_frame + int((~there).nonzero()[0])
            raise InputError(
                f"frame {first} holds no pose, since tracking had not begun; write only live frames whose "
                "joints3d are finite"
            )

    def _check(self, path: str | Path) -> None:
        """Raise unless the values agree with one another; the types and shapes do."""
        check_estimates(path, "joints3d", self.joints3d, self.covariance3d)
        for name in ("state", "state_std", "joints3d"):
            if not bool(getattr(self, name).isfinite().all()):
                raise FileFormatError(f"{path}: {name} must be finite")
        bad = self.log_evidence.isposinf().any() or self.effective_sample_size.isinf().any()
        if bool(bad) or bool((self.state_std < 0).any()):
            raise FileFormatError(
                f"{path}: expected state_std that is not negative, and no infinite log_evidence or "
                "effective_sample_size"
            )
        joints = self.body.joints(self.state.to(self.body.bone_lengths))
        apart = float((joints - self.joints3d.to(joints)).abs().amax())
        if not apart <= _APART_OF.get(self.method, _APART):
            raise FileFormatError(
                f"{path}: expected joints3d where state puts them, they are {apart:.3g} m apart"
            )

    def joints_std(self) -> Tensor:
        """Return the standard deviation of every joint [T, J], metres: of an axis, by the mean variance."""
        return mean_std(self.covariance3d)

    def export(self, path: str | Path, *, up: str | None = None) -> None:
        """Write the poses for other programs: ``.trc`` (OpenSim), ``.c3d`` or ``.bvh``, by the suffix.

        TRC and C3D hold `joints3d` as markers with the names of Pose2Sim (RHip, LKnee, CHip, ...), in
        metres and in millimetres, and heels and toes if there are `feet`; the residuals of C3D are standard
        deviations. BVH holds the rigid body that `state` turns, in centimetres. A frame rate that is not
        known is written as 30. Where no camera has seen the person for more than a second, markers are
        missing, and BVH repeats the last pose.

        Args:
            path: the file, which is replaced if there is one.
            up: "z" or "y", the axis of the world that points up; the file then has y up. None keeps the
                axes of the world.

        Raises:
            InputError: another suffix or axis, or a frame before tracking began. OutputError: the file
                cannot be written.
        """
        self._check_begun()
        motion = BodyMotion3d(
            self.body, self.state, points_of(self), self.coasting, self.fps or _FPS,
            self.first_frame, self.feet,
        )  # fmt: skip
        write_body_file(path, motion, up)

    def seen_by(self, camera: PinholeCamera) -> "CameraPoses":
        """Return the joints in a camera's axes, and those of feet, for `torchpose.viz.write_report`.

        Args:
            camera: with a pose in the room.

        Returns:
            `CameraPoses`: joints [1, T, J, 3], metres, their covariances [1, T, J, 3, 3], square metres, and
            which of them were observed [1, T, J]: all where a camera saw the person; of keypoints
            (``details["inlier"]``) those of which a camera's was the joint's with more than 1/2. Those of
            `feet` follow.

        Raises:
            InputError: not one camera.
        """
        if not isinstance(camera, PinholeCamera):
            raise InputError(f"camera must be one PinholeCamera, got {type(camera).__name__}")
        R, t = (m.to(self.joints3d) for m in (camera.rotation_matrix, camera.translation))
        names, points, covariance = points_of(self)
        return CameraPoses(
            joints3d=(points @ R.mT + t)[None],
            covariance3d=(R @ covariance @ R.mT)[None],
            observed=self._observed()[None],
            failed_at=torch.full((1,), -1),
            names=names,
            fps=self.fps,
        )

    def _observed(self) -> Bool[Tensor, "T K"]:
        """Return which points a camera measured: all of a silhouette, of keypoints those that are inliers."""
        seen = ~self.coasting[:, None].expand(-1, len(self.names))
        inlier, feet = self.details.get("inlier"), self.feet
        seen = seen if inlier is None else seen & (inlier > 0.5).any(1)
        return seen if feet is None else torch.cat([seen, (feet.inlier > 0.5).any(1)], 1)


def points_of(track: BodyTrack) -> TrackedPoints:
    """Return the joints of a track, and its heels and toes."""
    joints, feet = TrackedPoints(track.names, track.joints3d, track.covariance3d), track.feet
    if feet is None:
        return joints
    pairs = zip(joints[1:], (feet.points3d, feet.covariance3d), strict=True)
    values = (torch.cat([own, more.to(own)], 1) for own, more in pairs)
    return TrackedPoints((*joints.names, *feet.names), *values)


def repeat_last(track: BodyTrack, count: int) -> BodyTrack:
    """Return a track with its last pose repeated, as past the length of a sequence."""
    if count == 0:
        return track
    held = torch.arange(len(track) + count).clamp(max=len(track) - 1)
    inside = torch.arange(len(held)) < len(track)
    fields = {name: getattr(track, name)[held] for name in _FRAMES}
    evidence, respread = fields["log_evidence"], fields["respread"]
    fields["log_evidence"] = torch.where(inside.to(evidence.device), evidence, 0.0)
    fields["respread"] = respread & inside.to(respread.device)
    details = {name: value[held] for name, value in track.details.items()}
    return replace(track, **fields, details=details)


@dataclass
class CameraPoses:
    """Holds poses in the axes of a camera; see `torchpose.viz._report.packing.ReportedTrack`."""

    joints3d: Tensor
    covariance3d: Tensor
    observed: Tensor
    failed_at: Tensor
    names: tuple[str, ...]
    fps: float | None
    frame: str = "camera"

    def __len__(self) -> int:
        return len(self.joints3d)


def load_body(path: str | Path) -> Body:
    """Read the body of poses that were saved: bone lengths, limbs and centres of a person.

    Args:
        path: .npz file of `BodyTrack`.

    Returns:
        `Body` in float64.

    Raises:
        InputError: no such file. FileFormatError: not such poses, or no body of a person.
        SkeletonError: another skeleton.
    """
    keys = {f"body_{name}": field for name, field in _BODY.items()}
    arrays = read_npz(path, (*keys, "body_skeleton", "body_frame"), ())
    skeleton, frame = (one_text(path, key, arrays[key]) for key in ("body_skeleton", "body_frame"))
    if skeleton != BODY_15.name:
        raise SkeletonError(f"{path}: expected a body of {BODY_15.name!r}, got {skeleton!r:.60}")
    if frame not in ("parent", "body"):
        raise FileFormatError(f"{path}: expected body_frame 'parent' or 'body', got {frame!r:.60}")
    check_arrays(path, arrays, keys)
    tensors = {name: to_tensor(arrays[f"body_{name}"]) for name in _BODY}
    try:
        body = Body(
            BODY_15,
            tensors["bone_lengths"],
            tensors["radii"],
            directions=torch.nn.functional.normalize(tensors["offsets"], dim=-1),
            centres=tensors["centres"],
            frame="parent" if frame == "parent" else "body",
            tips=tensors["tips"],
        )
    except (InputError, ShapeError) as error:
        raise FileFormatError(f"{path}: {error}") from error
    largest = max(float(tensors[name].abs().amax()) for name in _BODY)
    if not _HEIGHTS[0] < body.height < _HEIGHTS[1] or largest > _HEIGHTS[1]:
        raise FileFormatError(
            f"{path}: expected the body of a person in metres, got one of {body.height:.3g} m with parts "
            f"of up to {largest:.3g} m"
        )
    return body


set_up_facade(__name__)
