"""Lift the keypoints of a camera to a pose, which the filter takes for another measurement of the frame.

One camera does not see the depth of limbs. A network that has seen many poses tells the joints l_j that go
with the keypoints, and their standard deviations s_j. It has seen people who are upright, so keypoints of
others are turned about the optical axis first (`body_roll`). The filter is corrected by

    l_j = p_j(x) - p_pelvis(x) + e_j,   e_j ~ N(0, (1.5 s_j)^2 I),

before it is corrected by the keypoints themselves, so that these find limbs that point the right way. Where
the filter expects another pose altogether, as after frames with exchanged sides, tracking begins anew with
the lifted one.

Cameras side by side hardly see depth either, and a body fitted to noise along the rays has bones that grow.
So the mean of what is lifted from each of them counts, the less the larger the angle a between their rays is:
with k = 1 + (a / a_0)^2 its deviations are k s_j. The angle tells the size of the person as well, so

    e^((1/k - 1) s(x)) (p_j(x) - p_pelvis(x)) = l_j + e_j,

where s(x) is the log of the legs' length against that which is expected. At a = 0 this is one camera.
"""

import copy
import math
from typing import NamedTuple, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchpose._core.module_state import derived
from torchpose.body._articulation import BodyPoint
from torchpose.body._skeleton import BODY_15
from torchpose.camera._rig import CameraRig, centres_of_cameras
from torchpose.math._gaussian import symmetrise
from torchpose.priors._body_motion import BodyMotion
from torchpose.priors._lifting_network import (
    MEMORY,
    Lifted,
    lifting_features,
    shipped_lifting_network,
)
from torchpose.whole_body._keypoints.begin_anew import sees_enough, sees_most
from torchpose.whole_body._keypoints.body_kalman import HIPS, BodyGaussian, BodyKalmanFilter
from torchpose.whole_body._keypoints.body_roll import BodyRoll, next_roll, turn_upright
from torchpose.whole_body._keypoints.information_step import plus_one
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame, RigMaps
from torchpose.whole_body._keypoints.known_person import length_of_legs, weights_of_legs
from torchpose.whole_body._keypoints.lifted_lean import without_lean
from torchpose.whole_body._keypoints.nested import mapped
from torchpose.whole_body._keypoints.upright import LEGS, camera_up, upright_of

# On the network's standard deviations, which are those of persons that it was fitted to.
_FACTOR = 1.5
_CONTRADICTION = 1.0  # mean square of e_j / (1.5 s_j): usually 0.1, and 1 in one frame of a hundred
_ITERATIONS = 2
_SIDE_BY_SIDE = 1.0  # metres between cameras, up to which their keypoints are lifted
_TELLING = math.radians(7.0)  # a_0, chosen on the fitted persons of `benchmarks.keypoint_bodies`
_PASSES, _CLOSE = 4, 0.1  # metres, from where on the error of a ray counts less
_NEAREST = 0.5  # metres from the camera
_LEAST_UP = 0.2  # share of the upward direction in the image plane, below which it tells no roll
_PELVIS = BODY_15.joint("pelvis")
_NECK = BODY_15.joint("neck")
_HIDDEN = [*HIPS, *LEGS]
_REMEMBERED = 1.0  # seconds for which legs are expected as they were seen
_USUAL_SHARE = 10.0  # of the information about usual legs, afterwards, against that of the priors
_OTHERS = [j for j in range(len(BODY_15.names)) if j != _PELVIS]


class LifterMemory(NamedTuple):
    """Holds what is known of persons from earlier frames, by each camera.

    Attributes:
        network: the state of the network, [B, C, L, W]. roll: how they point, of [B, C].
    """

    network: Tensor
    roll: BodyRoll

    @classmethod
    def none(cls, like: Float[Tensor, "B C"]) -> Self:
        """Return the memory before the first frame."""
        network = torch.zeros(*like.shape, *MEMORY, device=like.device)
        return cls(network, BodyRoll.upright(like))


class _UprightView(NamedTuple):
    """Holds maps from homogeneous pixels to rays [C, 3, 3], and the poses of cameras turned upright.

    `up` is the direction that points up in their axes, [C, 3], None where the cameras are taken to be level.
    """

    to_rays: Tensor
    rotation: Tensor
    translation: Tensor
    up: Tensor | None

    @classmethod
    def of(cls, rig: CameraRig, up: str | None) -> Self:
        """Return the views of the cameras of a rig."""
        upright = upright_of(rig, up) or camera_up(rig)
        roll = torch.stack([_upright_roll(axes @ upright.direction) for axes in rig.rotation])
        place = (roll @ rig.translation[..., None]).squeeze(-1)
        rotation = roll @ rig.rotation
        known = None if up is None else rotation @ upright.direction
        return cls(roll @ torch.linalg.inv(rig.matrix), rotation, place, known)


class PoseLifter(nn.Module):
    """Lifts the keypoints of one camera, or of each of several, to joints of a person of known size.

    Args:
        rig: of cameras side by side. fps: frames per second. motion: of the person, whose legs tell the size.
        up: "y" or "z", the axis of the world that points up, by which the image and lifted bodies are turned
            upright; without it the camera is taken to be level.
    """

    def __init__(
        self, rig: CameraRig, fps: float, motion: BodyMotion, up: str | None = None
    ) -> None:
        super().__init__()
        self.network = copy.deepcopy(shipped_lifting_network())
        self.fps, self.up = fps, up
        self._given = (rig, motion)  # a tuple, so that their tensors are held once

    @property
    def size(self) -> float:
        """Return how much larger the person is than those that the network was fitted to."""
        motion = self._given[1]
        legs = self.network.info.legs
        return derived(self, "size", (motion.scale_mean,), lambda: length_of_legs(motion) / legs)

    @property
    def view(self) -> "_UprightView":
        """Return the cameras, turned upright."""
        rig = self._given[0]
        sources = (rig.matrix, rig.rotation, rig.translation)
        return derived(self, "view", sources, lambda: _UprightView.of(rig, self.up))

    def forward(
        self, frame: KeypointFrame, memory: LifterMemory | None
    ) -> tuple[Lifted, LifterMemory]:
        """Return joints relative to the pelvis in world axes, and what is known after the frame.

        They are the mean over the cameras that see enough joints.

        Args:
            frame: of keypoints. memory: of the frame before; None at the beginning.
        """
        sure, rays = frame.inlier, self._rays(frame)
        memory = LifterMemory.none(sure[..., 0]) if memory is None else memory
        flat = mapped(lambda value: value.flatten(0, 1), (rays, sure, memory))
        each = mapped(lambda value: value.unflatten(0, sure.shape[:2]), self._by_camera(*flat))
        (joints, std), memory = each
        joints = self._without_lean(joints, rays, sure, memory.roll)
        enough = sees_enough(frame)[..., None].to(rays)
        share = enough / enough.sum(1, keepdim=True).clamp_min(1)
        mean = (share[..., None] * (joints @ self.view.rotation)).sum(1)
        std = torch.where(share.sum(1) > 0.0, (share * std).sum(1), torch.inf)
        return Lifted(mean, std), memory

    def _by_camera(
        self, rays: Float[Tensor, "N J 3"], sure: Float[Tensor, "N J"], memory: LifterMemory
    ) -> tuple[Lifted, LifterMemory]:
        """Return what is lifted from single cameras, in axes of the cameras turned upright."""
        roll, turned = next_roll(memory.roll, rays[..., :2], sure > 0.0, self.fps)
        seen = lifting_features((rays @ roll.turn.mT)[..., :2], sure, self.fps)
        before = memory.network.masked_fill(turned[:, None, None], 0.0)
        seen, before = (value.to(self.network.places.weight) for value in (seen, before))
        lifted, after = self.network(seen[:, None], before)
        joints, std = (self.size * value[:, 0].to(rays) for value in lifted)
        return Lifted(joints @ roll.turn, std), LifterMemory(after, roll)

    def _without_lean(
        self,
        joints: Float[Tensor, "B C J 3"],
        rays: Float[Tensor, "B C J 3"],
        sure: Float[Tensor, "B C J"],
        roll: BodyRoll,
    ) -> Float[Tensor, "B C J 3"]:
        """Return lifted joints turned upright where it is known which way is up and bodies do not lie."""
        up = self.view.up
        if up is None:
            return joints
        known = rays[..., :2].masked_fill(~(sure > 0)[..., None], torch.nan)
        middle = known.nanmedian(-2).values.nan_to_num()
        level = (roll.up == BodyRoll.upright(sure[..., 0]).up).all(-1)
        return torch.where(level[..., None, None], without_lean(joints, middle, up), joints)

    def placed(self, lifted: Lifted, frame: KeypointFrame) -> Float[Tensor, "B J 3"]:
        """Return lifted joints in the world, where they lie near the rays of the camera that sees most.

        Args:
            lifted: of `forward`. frame: the keypoints.
        """
        camera = sees_most(frame)
        own = torch.arange(len(camera), device=camera.device), camera
        rotation, translation = self.view.rotation[camera], self.view.translation[camera]
        joints = lifted.joints @ rotation.mT
        place = place_on_rays(joints, self._rays(frame)[own][..., :2], frame.inlier[own])
        place = torch.cat([place[:, :2], place[:, 2:].clamp_min(_NEAREST)], -1)
        return (joints + place[:, None] - translation[:, None]) @ rotation

    def _rays(self, frame: KeypointFrame) -> Float[Tensor, "B C J 3"]:
        pixels = frame.pixels
        return torch.cat([pixels, torch.ones_like(pixels[..., :1])], -1) @ self.view.to_rays.mT


def are_side_by_side(rig: CameraRig) -> bool:
    """Return whether all cameras are so near each other that their keypoints are lifted; one camera is."""
    centres = centres_of_cameras(rig)
    return float(torch.cdist(centres, centres).amax()) < _SIDE_BY_SIDE


def telling(maps: RigMaps, joints: Float[Tensor, "*batch J 3"]) -> Float[Tensor, "*batch"]:
    """Return k = 1 + (a / a_0)^2 with the largest angle a between the rays of cameras to the pelvis."""
    rays = torch.nn.functional.normalize(joints[..., [_PELVIS], :] - maps.centre, dim=-1)
    chord = torch.cdist(rays, rays, compute_mode="donot_use_mm_for_euclid_dist").amax((-2, -1))
    return 1.0 + (chord / _TELLING).square()


def _upright_roll(up: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Return the rotation about the optical axis that turns an upward direction to -y in the image."""
    length = float(up[:2].norm())
    if length < _LEAST_UP:  # the camera looks down or up, and any roll is as good
        return torch.eye(3).to(up)
    return turn_upright(up[:2] / length)


def place_on_rays(
    joints: Float[Tensor, "B J 3"], rays: Float[Tensor, "B J 2"], weights: Float[Tensor, "B J"]
) -> Float[Tensor, "B 3"]:
    """Return the translation that puts joints near the rays of their keypoints.

    Of the place p of joints x and the rays (u, v, 1), u (x_z + p_z) = x_x + p_x, and so for v, are solved by
    least squares, weighted, and from the second time on with less weight where the error is large.

    Args:
        joints: anywhere, camera axes. rays: anything finite where there is no keypoint.
        weights: of the keypoints, 0 where there is none.
    """
    aim = torch.cat([torch.eye(2).expand(*rays.shape, 2).to(rays), -rays[..., None]], -1)
    wanted = rays * joints[..., 2:] - joints[..., :2]
    small = 1e-6 * torch.eye(3).to(rays)
    robust = torch.ones_like(weights)
    place = torch.zeros_like(joints[..., 0, :])
    for _ in range(_PASSES):
        weighed = (weights * robust)[..., None, None] * aim
        normal = (weighed.mT @ aim).sum(-3) + small
        place = torch.linalg.solve(normal, (weighed.mT @ wanted[..., None]).sum(-3)).squeeze(-1)
        off = ((aim @ place[..., None, :, None]).squeeze(-1) - wanted).norm(dim=-1)
        robust = 1 / (1 + (off / _CLOSE).square())
    return place


def contradicts(
    lifted: Lifted, filter: BodyKalmanFilter, state: BodyGaussian
) -> Bool[Tensor, " B"]:
    """Return whether lifted joints are nowhere near a prediction, so that one of the two is of another pose.

    Args:
        lifted: [B, J], world axes. filter: whose prediction it is. state: [B], the prediction.
    """
    joints = filter.articulation.joints(state.mean)
    apart = lifted.joints - (joints - joints[..., [_PELVIS], :])
    k = telling(filter.maps, joints)[..., None, None]
    off = (apart / (_FACTOR * k * lifted.std[..., None]))[..., _OTHERS, :]
    return off.square().mean((-2, -1)) > _CONTRADICTION


def legs_guessed_by(lifted: Lifted, filter: BodyKalmanFilter, state: BodyGaussian) -> BodyGaussian:
    """Return the Gaussians given the legs of lifted joints, with the share of the priors' information.

    Args:
        lifted: [B, J], world axes. filter: whose states they are. state: [B].
    """
    std = torch.full_like(lifted.std, torch.inf)
    std[..., LEGS] = lifted.std[..., LEGS] / math.sqrt(filter.transition.share)
    alone = torch.ones_like(std[..., :1])
    return corrected_by(Lifted(lifted.joints, std), filter, state, alone)


def shares_of_usual(unseen: Float[Tensor, "B J"]) -> Float[Tensor, "B 12"]:
    """Return shares of the information about usual legs: none for a second after they were seen.

    Args:
        unseen: seconds since joints were seen.
    """
    long = (unseen[:, LEGS] - _REMEMBERED).clamp(0.0, 1.0)
    return (_USUAL_SHARE * long).repeat_interleave(3, -1)


def spread_of_hidden(lifted: Lifted) -> Float[Tensor, "B J"]:
    """Return the standard deviations of hips and legs that are as far off as the pelvis is from the neck.

    Where nothing was lifted, and of other joints, they are zero.
    """
    std = lifted.std.clone()
    std[..., _PELVIS] = 0
    spread = torch.zeros_like(std)
    spread[..., _HIDDEN] = (std.square() + std[..., [_NECK]].square()).sqrt()[..., _HIDDEN]
    return spread.masked_fill(spread.isinf(), 0.0)


def corrected_by(
    lifted: Lifted,
    filter: BodyKalmanFilter,
    state: BodyGaussian,
    k: Float[Tensor, "B 1"] | None = None,
) -> BodyGaussian:
    """Return the Gaussians given the joints that a network lifted: an iterated extended Kalman filter's.

    Args:
        lifted: [B, J], world axes; the standard deviation is infinite where it says nothing.
        filter: whose states they are. state: [B]. k: factor of the standard deviations, by default `telling`.
    """
    body, mean, cov = filter.articulation, state.mean, state.cov
    at_mean = body.linearise(mean)
    k = telling(filter.maps, at_mean[0])[..., None] if k is None else k
    wanted = lifted.joints[..., _OTHERS, :]
    scale = 1 / (_FACTOR * k[..., None] * lifted.std[..., _OTHERS, None])
    wanted, scale = wanted.flatten(-2), scale.expand_as(wanted).flatten(-2)
    point, d = mean, torch.zeros_like(cov[..., 0])
    for iteration in range(_ITERATIONS):
        joints, jacobian = body.linearise(point) if iteration else at_mean
        apart = (joints - joints[..., [_PELVIS], :])[..., _OTHERS, :]
        H = (jacobian - jacobian[..., [_PELVIS], :, :])[..., _OTHERS, :, :].flatten(-3, -2)
        apart, H = _of_expected_size(filter, point, apart.flatten(-2), H, 1.0 - 1 / k)
        H = scale[..., None] * H
        off = scale * (wanted - apart)
        HP = H @ cov
        spread = HP @ H.mT
        chol = torch.linalg.cholesky(plus_one(spread))
        apart_from_mean = off[..., None] + H @ d[..., None]
        d = (HP.mT @ torch.cholesky_solve(apart_from_mean, chol)).squeeze(-1)
        point = body.moved(mean, d)
    U = torch.linalg.solve_triangular(chol, HP, upper=False)
    cov = cov - U.mT @ U
    return state._replace(mean=point, cov=symmetrise(cov))


def _of_expected_size(
    filter: BodyKalmanFilter,
    point: BodyPoint,
    apart: Float[Tensor, "B K"],
    H: Float[Tensor, "B K N"],
    share: Float[Tensor, "B 1"],
) -> tuple[Float[Tensor, "B K"], Float[Tensor, "B K N"]]:
    """Return joints from the pelvis, and their derivative, without a share of the log of the size."""
    if len(filter.maps.shift) == 1:
        return apart, H
    motion = filter.motion
    told = weights_of_legs(motion)
    factor = (-share * ((point.scales - motion.scale_mean) @ told)[..., None]).exp()
    apart, H = factor * apart, factor[..., None] * H
    along = torch.zeros_like(H[..., 0, :])
    along[..., filter.articulation.columns["scales"]] = told
    return apart, H - (share * apart)[..., None] * along[..., None, :]
