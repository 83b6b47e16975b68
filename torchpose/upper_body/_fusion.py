"""Read poses off the estimates of both arms, and steady their motion.

A filter over windows estimates every frame alone, so that the noise of keypoints and the change
from one component to the next show as jitter. `MotionStage` filters (or smooths) what is read out.
"""

from collections.abc import Mapping, Sequence
from functools import cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchpose._core.facade import set_up_facade
from torchpose._core.module_state import derived, index_tensor, outside_inference
from torchpose.camera._projection import (
    arm_in_body_frame,
    join_arms,
    lift,
    pixel_covariances,
    pixel_rays,
)
from torchpose.camera._virtual_camera import from_view
from torchpose.filters._constant_velocity import (
    ConstantVelocityFilter,
    VelocityFilters,
    VelocityFiltersState,
)
from torchpose.math._rotations import RotationOrder, euler_to_matrix, matrix_to_euler
from torchpose.priors._arm_state import STATE_DIM
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.skeleton._torso import onto_torso
from torchpose.upper_body._estimator import (
    Estimates,
    MotionRatios,
    ReadOut,
    SeenPoses,
    require_cov,
)

_LIMB_ENDS = tuple(
    UPPER_BODY.index(f"{j}_{s}") for j in ("hand", "elbow") for s in ("left", "right")
)
_HAND_OF = tuple(
    UPPER_BODY.index(f"hand_{'right' if 'right' in j else 'left'}") for j in UPPER_BODY
)
_WINDOWS = ("causal", "full")
_OWN = (*_WINDOWS, "articulated")  # calibrations that nothing else stands for
NEAREST = 0.1
"""Metres before the camera, from where a projection means something."""


def read_out(estimates: Estimates, matrix: Float[Tensor, "3 3"], order: RotationOrder) -> ReadOut:
    """Return both arms lifted into the body's frame (BL 5) and joined; what they share is averaged.

    Args:
        estimates: the estimates of both arms. matrix: K of the prior's camera. order: the order of roll,
            pitch and yaw.
    """
    outputs, view = estimates[:2], estimates.view
    mean = torch.stack([out.mean for out in outputs], 2)  # both arms: [B, T, 2, D]
    cov = torch.stack([require_cov(out) for out in outputs], 2)
    if mean.shape[-1] > STATE_DIM:
        uv, joints, joint_covs = _on_torso(mean, cov, matrix, order)
        uv_covs = cov[..., :5, :2, :2]
    else:
        lifted = arm_in_body_frame(mean, cov, matrix, order)
        seen = mean[..., :15].unflatten(-1, (5, 3))
        uv, joints, joint_covs = (_joined(values) for values in (seen, *lifted))
        uv_covs = pixel_covariances(cov)
    angles, place = mean[..., 15:STATE_DIM].mean(2).split(3, -1)
    uv, uv_covs = uv[..., :2], _joined(uv_covs)
    if view is not None:
        back = view.rotation.mT
        angles = matrix_to_euler(back @ euler_to_matrix(angles, order), order)
        place = (back @ place[..., None])[..., 0] * view.zoom[..., None]
        uv, slopes = from_view(uv, view, matrix)
        uv_covs = slopes @ uv_covs @ slopes.mT
    return ReadOut(joints, joint_covs, angles, place, uv, uv_covs)


def _joined(arms: Float[Tensor, "B T 2 5 *rest"]) -> Float[Tensor, "B T 8 *rest"]:
    """Return the eight joints of both arms (`join_arms`)."""
    return join_arms(*arms.unbind(2))


def _on_torso(
    mean: Float[Tensor, "B T 2 36"],
    cov: Float[Tensor, "B T 2 12 3 3"],
    matrix: Tensor,
    order: RotationOrder,
) -> tuple[Float[Tensor, "B T 8 3"], Float[Tensor, "B T 8 3"], Float[Tensor, "B T 8 3 3"]]:
    """Return (u, v, depth) and joints, which were estimated in the axes of the torso, in those of the body.

    The states say where head, neck and shoulders are there (BL 5), which takes no covariances.
    """
    # five joints (u, v, depth), angles and place, and five joints in the torso's axes
    seen, camera, own = mean.unflatten(-1, (-1, 3)).split([5, 2, 5], -2)
    angles, place = camera.unbind(-2)
    lifted = lift(seen, matrix, euler_to_matrix(angles, order), place)
    uv, pose, joints = _joined(torch.cat([seen, own, lifted], -1)).split(3, -1)
    covs = _joined(cov[..., STATE_DIM // 3 :, :, :])
    return uv, *onto_torso(pose, covs, joints)


def on_their_rays(
    poses: SeenPoses, matrix: Float[Tensor, "3 3"], observed: Bool[Tensor, "B T 8"]
) -> SeenPoses:
    """Return measured limbs on their rays, and the other joints' pixels where they project to.

    Pixels and the joints in space are two readings of one mixture, linear each, and differ where a
    camera is unlike those of the prior: on webcams that look up at somebody near, by 40 pixels for a
    hand. A measured joint keeps its depth and goes to where it was seen; a joint that was inferred is
    seen where it is in space, if the hand of its arm was measured: without, its pixels know better.
    Head, neck and shoulders stay, since the body hangs on them.

    Args:
        poses: the poses of windows. matrix: K of the prior's camera. observed: which joints were measured.
    """
    depth, known = poses.joints[..., 2:], observed[..., None]
    before = depth > NEAREST
    hands = known.index_select(2, index_tensor(_HAND_OF, known.device))
    seen = poses.joints @ matrix.mT
    uv = torch.where(hands & ~known & before, seen[..., :2] / depth, poses.uv)
    moved = depth * pixel_rays(uv, matrix)
    joints = torch.where(_limb_ends(uv.device) & known & before, moved, poses.joints)
    return poses._replace(joints=joints, uv=uv)


@cache
def _limb_ends(device: torch.device) -> Bool[Tensor, "8 1"]:
    """Return whether each joint is an elbow or a hand."""
    with outside_inference():
        rows = [[row in _LIMB_ENDS] for row in range(len(UPPER_BODY))]
        return torch.tensor(rows, device=device)


def in_camera_axes(reading: ReadOut, order: RotationOrder) -> SeenPoses:
    """Return poses turned into the camera's axes and put where they are.

    Args:
        reading: poses in the body's axes. order: the order of their angles.
    """
    rotations = euler_to_matrix(reading.angles, order)[:, :, None]
    back = rotations.mT
    joints = reading.joints @ back[:, :, 0] + reading.place[:, :, None]
    shares = torch.ones_like(reading.place[..., :1])
    return SeenPoses(
        joints, rotations @ reading.covs @ back, rotations, shares, reading.place, reading.uv,
        reading.uv_covs,
    )  # fmt: skip


def in_body_axes(poses: SeenPoses) -> SeenPoses:
    """Return joints and covariances turned into the axes of the body, whose centre is their origin."""
    rotation = poses.rotation
    turn = rotation[:, :, None]
    joints = (poses.joints - poses.place[:, :, None]) @ rotation
    return poses._replace(joints=joints, covs=turn.mT @ poses.covs @ turn)


def put_at(poses: SeenPoses, place: Float[Tensor, "3"]) -> SeenPoses:
    """Return poses whose bodies are all at one place, metres, in camera axes."""
    at = place.to(poses.place)
    joints = poses.joints + (at - poses.place)[:, :, None]
    return poses._replace(joints=joints, place=at.expand_as(poses.place))


def calibration_mode(method: str) -> str:
    """Return the name under which a prior keeps the calibration of a method over single poses."""
    return "pose" if method == "mkf-fixed" else method.replace("-", "_")


def recalibrated(
    covs: Float[Tensor, "B T 8 3 3"], noise: Mapping[str, Tensor], mode: str
) -> Float[Tensor, "B T 8 3 3"]:
    """Return s C + f I for each joint, as a prior's training persons showed; C if it does not say.

    Args:
        covs: C, metres squared. noise: the noise of a prior. mode: the name of the window, or
            `calibration_mode`; without a calibration of its own, a method over single poses has that of
            "pose".
    """
    if f"calibration_scale_{mode}" not in noise and mode not in _OWN:
        mode = "pose"
    scale = noise.get(f"calibration_scale_{mode}")
    floor = noise.get(f"calibration_floor_{mode}")
    if scale is None or floor is None:
        return covs
    eye = torch.eye(3, dtype=covs.dtype, device=covs.device)
    return covs * scale.to(covs)[:, None, None] + floor.to(covs)[:, None, None] * eye


MotionStageState = VelocityFiltersState
"""State of a `MotionStage`: of all its numbers, those of joints, then of pixels, then of the placement."""


class MotionStage(nn.Module):
    """Constant-velocity filters over joints, their pixels and the body's placement.

    They begin where somebody is first seen. Before, poses are those of the prior, far from that person
    perhaps. Covariances stay as they are.

    Args:
        joint_ratio, pixel_ratio, placement_ratio: q/r of `ConstantVelocityFilter`, 1/s^3. Pixels are
            known better than joints in space, and a body moves less briskly than its hands.
        fps: frames per second.
    """

    def __init__(
        self, joint_ratio: float, pixel_ratio: float, placement_ratio: float, fps: float
    ) -> None:
        super().__init__()
        self.joints = ConstantVelocityFilter(joint_ratio, fps)
        self.pixels = ConstantVelocityFilter(pixel_ratio, fps)
        self.placement = ConstantVelocityFilter(placement_ratio, fps)

    def forward(
        self,
        reading: ReadOut,
        seen: Bool[Tensor, "B T"],
        lengths: Int[Tensor, " B"] | None = None,
        lag: int | None = 0,
    ) -> ReadOut:
        """Return the poses with filtered or smoothed motion, from where somebody is first seen.

        Args:
            reading: the poses of whole sequences. seen: in which frames anything was measured.
            lengths: the number of frames of each, [B]; frames past it are not used.
            lag: the number of later frames that each may use; None is all, 0 only filters.
        """
        if lag == 0:
            return self.advance(self.init(reading), reading, seen)[1]
        n_frames = seen.shape[1]
        ends = torch.full_like(seen[:, 0], n_frames, dtype=torch.long)
        ends = ends if lengths is None else lengths.to(ends)
        unseen = (seen.cumsum(1) == 0).sum(1)
        first = torch.where(unseen < ends, unseen, 0)[:, None]
        frames = torch.arange(n_frames, device=seen.device)
        known = frames >= first
        smoothed = []
        for model, values in zip(self._filters(), _numbers(reading), strict=True):
            begun = _frames(values, (first + frames).clamp(max=n_frames - 1))
            begun = model.smooth_frames(begun, ends - first[:, 0], lag)
            begun = _frames(begun, (frames - first).clamp(min=0))
            smoothed.append(torch.where(known[..., None], begun, values))
        return _with_numbers(reading, *smoothed)

    def init(self, reading: ReadOut) -> MotionStageState:
        """Return the state before the first frame, that of `reading` [B, T, ...]."""
        numbers = _numbers(reading)
        return self._side_by_side(numbers).init(torch.cat(numbers, -1))

    def advance(
        self, state: MotionStageState, reading: ReadOut, seen: Bool[Tensor, "B T"]
    ) -> tuple[MotionStageState, ReadOut]:
        """Return the next state and some more frames [B, T, ...]: the numbers of `forward` with lag 0."""
        numbers = _numbers(reading)
        state, steady = self._side_by_side(numbers).advance(state, torch.cat(numbers, -1), seen)
        return state, _with_numbers(reading, *steady.split([x.shape[-1] for x in numbers], -1))

    def _side_by_side(self, numbers: Sequence[Tensor]) -> VelocityFilters:
        """Return the filters of all numbers; made once."""
        filters, counts = self._filters(), [values.shape[-1] for values in numbers]
        ratios = tuple(model.ratio for model in filters)
        return derived(
            self,
            ("all", *counts),
            (*ratios, self.joints.fps),
            lambda: VelocityFilters(filters, counts),
        )

    def _filters(self) -> tuple[ConstantVelocityFilter, ...]:
        return self.joints, self.pixels, self.placement


def kept_stage(owner: nn.Module, ratios: MotionRatios, fps: float, like: Tensor) -> MotionStage:
    """Return the motion stage of these ratios; made once for each owner.

    Args:
        owner: the module with which the stage is kept. ratios: q/r of its filters. fps: frames per second.
        like: a tensor on the device to work on.
    """
    return derived(
        owner, ("stage", *ratios), (like,), lambda: MotionStage(*ratios, fps).to(like.device)
    )


def stage_lag(smoothing: int | str | None, ahead: int) -> int | None:
    """Return the number of later frames that a stage may use, None for all.

    Args:
        smoothing: as in `TrackerModel`. ahead: the number of later frames that the estimates use already.
    """
    if smoothing is None:
        return 0
    return None if smoothing == "full" else int(smoothing) - ahead


def _numbers(reading: ReadOut) -> tuple[Tensor, Tensor, Tensor]:
    placement = torch.cat([reading.angles, reading.place], -1)
    return reading.joints.flatten(2), reading.uv.flatten(2), placement


def _frames(values: Float[Tensor, "B T N"], rows: Int[Tensor, "B T"]) -> Float[Tensor, "B T N"]:
    """Return values of other frames."""
    return values.gather(1, rows[..., None].expand_as(values))


def _with_numbers(reading: ReadOut, joints: Tensor, pixels: Tensor, placement: Tensor) -> ReadOut:
    return reading._replace(
        joints=joints.unflatten(-1, (8, 3)),
        uv=pixels.unflatten(-1, (8, 2)),
        angles=placement[..., :3],
        place=placement[..., 3:],
    )


set_up_facade(__name__)
