"""Find a first pose in the silhouettes of one frame, without a pose to start from."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.checks import check_choice, check_finite, check_shape
from torchpose.camera._rig import CameraRig, Cameras, as_rig
from torchpose.errors import InputError
from torchpose.filters._recursive_filter import Generators, standard_normal, uniform
from torchpose.math._rotations import (
    compose,
    minimal_rotation,
    quaternion_vector_to_matrix,
    within_half_turn,
)
from torchpose.whole_body._filters.annealed import anneal
from torchpose.whole_body._filters.body_frames import check_observation, silhouette_score
from torchpose.whole_body._filters.body_particles import best_particle, check_limits
from torchpose.whole_body._silhouettes.likelihood import LIKELIHOODS

_ACROSS = 0.1  # metres: how far the middle of a silhouette lies from that of the body
_DEPTH_SHARE = 0.1  # of a ray's information across it that its length has, from the person's height
_VERTICAL = 0.87  # cosine to the vertical from which on a direction tells no heading
_TILT = 0.1  # sine of half the angle by which a trunk leans, about each axis
_PART = 0.15  # spread of the parts about the rest pose where there is no prior
# standard deviations of the diffusion in the first and in the last layer
_FIRST_STEP = (0.06, 0.15, 0.12)  # root (metres), its orientation, parts
_LAST_STEP = (0.005, 0.02, 0.02)
_ONE_MODE = math.sin(math.pi / 8)  # particles turned by less than 45 degrees from the best


class SilhouettePlace(NamedTuple):
    """Holds the middle of the body according to the silhouettes.

    Attributes:
        position: [..., 3], metres, world axes. cov: [..., 3, 3].
    """

    position: Tensor
    cov: Tensor


def upward_direction(rig: CameraRig) -> Float[Tensor, "3"]:
    """Return the world axis that is nearest to "up" in the images: cameras are mounted upright.

    Raises:
        InputError: the cameras do not agree about one, by 45 degrees or more.
    """
    up = -rig.rotation[:, 1].mean(0)  # the y axis of a camera points down
    axis = int(up.abs().argmax())
    if float(up[axis].abs()) < 0.5**0.5:
        raise InputError(
            "the cameras do not show which world axis points up; give `up`, "
            f"their mean is {[round(float(x), 2) for x in up]}"
        )
    return torch.eye(3).to(up)[axis] * up[axis].sign()


def world_up(rig: CameraRig, up: Tensor | None) -> Float[Tensor, "3"]:
    """Return the direction that was given as up, of length one, or `upward_direction` if it is None.

    Raises:
        InputError: not a direction, or none can be told. ShapeError: not [3].
    """
    return _unit("up", upward_direction(rig) if up is None else up)


def place_from_silhouettes(
    silhouettes: Bool[Tensor, "B C H W"], rig: CameraRig, height: float
) -> SilhouettePlace:
    """Return the point nearest to the rays through the middles of the silhouettes (least squares).

    p = (sum_c A_c)^-1 sum_c A_c (o_c + h_c d_c),   A_c = I - (1 - e) d_c d_c^T,

    o_c and d_c a camera's centre and the direction of its ray; along the ray, where it says little,
    the distance h_c at which a person of this height is as tall as the silhouette counts with e = 0.1.

    Args:
        silhouettes: cameras that see nothing do not count. height: of the person, metres.

    Raises:
        InputError: a person whom no camera sees.
    """
    seen = silhouettes.flatten(2).any(-1)
    if not bool(seen.any(-1).all()):
        raise InputError(
            "a pose can only be found in a frame in which a camera sees the person; all silhouettes "
            f"of element {int((~seen.any(-1)).nonzero()[0])} are empty"
        )
    mask = silhouettes.double()
    K, R, t = (b.to(mask) for b in (rig.matrix, rig.rotation, rig.translation))
    area = mask.sum((-2, -1)).clamp_min(1)
    columns = torch.arange(mask.shape[-1]).to(K)
    rows = torch.arange(mask.shape[-2]).to(K)
    u = (mask.sum(-2) @ columns) / area
    v = (mask.sum(-1) @ rows) / area
    tall = silhouettes.any(-1).sum(-1).clamp_min(1)
    rays = torch.linalg.solve(K, torch.stack([u, v, torch.ones_like(u)], -1)[..., None])[..., 0]
    depth = K[:, 1, 1] * height / tall
    distance = depth * rays.norm(dim=-1)
    direction = torch.nn.functional.normalize((R.mT @ rays[..., None])[..., 0], dim=-1)
    centre = -(R.mT @ t[..., None])[..., 0]
    along = (1 - _DEPTH_SHARE) * direction[..., None] * direction[..., None, :]
    across = (torch.eye(3).to(K) - along) * seen[..., None, None]
    target = centre + distance[..., None] * direction
    information = across.sum(1)
    total = (across @ target[..., None]).sum(1)
    position = torch.linalg.solve(information, total)[..., 0]
    return SilhouettePlace(position, _ACROSS**2 * torch.linalg.inv(information))


class PoseCandidates(NamedTuple):
    """Holds the best pose of every sector of headings.

    Attributes:
        states: [B, S, D]. log_likelihood: of each [B, S].
    """

    states: Tensor
    log_likelihood: Tensor


def find_pose(
    body: Any,
    silhouettes: Tensor,
    cameras: Cameras,
    prior: Any = None,
    generator: Generators = None,
    *,
    n_particles: int = 2000,
    n_layers: int = 12,
    n_headings: int = 4,
    survival_rate: float = 0.5,
    likelihood: str = "bidirectional",
    limits: Any = None,
    up: Tensor | None = None,
    facing: Tensor | None = None,
) -> Float[Tensor, "*B D"]:
    """Find the pose in one frame by annealing: all headings, poses of the prior, the rays' position.

    Every sector of headings is searched alone, so that the first layers do not settle on one. The pose
    of the sector that fits best is returned (`find_candidates`).

    One frame hardly tells front from back, and left leg from right: without `facing` the person may
    come out turned by half a turn. `find_first_pose` lets several frames decide.

    Args:
        body: a `torchpose.body.Body`.
        silhouettes: bool [C, H, W], or [B, C, H, W] for a frame of each of B persons.
        cameras: the C cameras.
        prior: poses to start from: relative columns [M, Q], states [M, D], a fitted
            `BackConstrainedGPLVM`, or None for the rest pose.
        generator: one generator, or a list of one for each of B.
        n_particles: N, of all sectors together. n_layers: M; the search evaluates M N likelihoods.
        n_headings: sectors of the circle. survival_rate: the survival rate of a layer, above 0 to below 1.
        likelihood: "bidirectional" or "overlap".
        limits: joint limits with `clamp(states)`, or None.
        up: [3], direction of the world's vertical; by `upward_direction` if None.
        facing: [3], the world direction that the person faces to within 60 degrees, if it is known.

    Returns:
        State [D] or [B, D].

    Raises:
        InputError: no camera sees the person, or a bad setting or list. ShapeError, CameraError: silhouettes,
        cameras or prior of other sizes. PriorError: a manifold of another skeleton.
    """
    batched = silhouettes.ndim == 4
    silhouettes = silhouettes if batched else silhouettes[None]
    found = find_candidates(
        body, silhouettes, cameras, prior, generator, n_particles=n_particles, n_layers=n_layers,
        n_headings=n_headings, survival_rate=survival_rate, likelihood=likelihood, limits=limits, up=up,
        facing=facing,
    )  # fmt: skip
    states = best_particle(found.states, found.log_likelihood)
    return states if batched else states[0]


@torch.no_grad()
def find_candidates(
    body: Any,
    silhouettes: Tensor,
    cameras: Cameras,
    prior: Any = None,
    generator: Generators = None,
    *,
    n_particles: int = 2000,
    n_layers: int = 12,
    n_headings: int = 4,
    survival_rate: float = 0.5,
    likelihood: str = "bidirectional",
    limits: Any = None,
    up: Tensor | None = None,
    facing: Tensor | None = None,
) -> PoseCandidates:
    """Find a pose in one frame for every sector of headings, by annealing.

    The particles start where the rays of the silhouettes meet, upright with headings within the
    sector, with poses of the prior. In layers of diffusion that shrinks, weights and resampling they
    gather where the likelihood is high; the mean of the best ones is the sector's pose.

    Args:
        silhouettes: bool [B, C, H, W], a frame of each of B persons.
        n_headings: S, sectors of the circle; one of 120 degrees with `facing`.
        body, cameras, prior, generator, n_particles, n_layers, survival_rate, likelihood, limits, up,
            facing: as `find_pose`; the exponents of the likelihood are solved from the survival rate.

    Raises:
        InputError, ShapeError, CameraError, PriorError: as `find_pose`.
    """
    check_choice("likelihood", likelihood, LIKELIHOODS)
    check_limits(limits, "clamp")
    if n_headings < 1 or n_particles < n_headings or n_layers < 2:
        raise InputError(
            "a search needs at least 1 heading, 1 particle for each and 2 layers, got "
            f"{n_headings}, {n_particles} and {n_layers}"
        )
    check_observation(silhouettes, len(silhouettes), generator, plain=True)
    rig = as_rig(cameras)
    rig.check_images("silhouettes", silhouettes.shape[1:])
    up = world_up(rig, up).to(body.offsets)
    sectors = _sectors(up, n_headings, facing)
    batch, count = len(silhouettes), len(sectors.middle)
    # every sector is an element of the batch
    silhouettes = silhouettes.to(up.device).repeat_interleave(count, 0)
    if isinstance(generator, Sequence):
        generator = [g for g in generator for _ in range(count)]
    n = n_particles // count
    particles = _first_particles(body, silhouettes, rig, prior, generator, n, up, sectors)
    score = silhouette_score(body, silhouettes, rig, likelihood)
    keep = (lambda x: x) if limits is None else limits.clamp
    steps = _layer_steps(body.dim, n_layers).to(particles)

    def diffuse(states: Tensor, layer: int) -> Tensor:
        if layer == 0:  # as drawn
            return keep(states)
        noise = standard_normal(len(states), states.shape[1:], generator, states)
        return keep(body.perturb(states, noise * steps[layer]))

    run = anneal(particles, score, diffuse, n_layers, survival_rate, generator=generator)
    found = _mean_of_best_mode(body, run.particles, run.log_weights)
    fit = score(found[:, None])
    return PoseCandidates(found.view(batch, count, -1), fit.view(batch, count))


class _Sectors(NamedTuple):
    """Holds sectors of headings: the middle of each sector [S], and half its width, radians."""

    middle: Tensor
    half_width: float


def _sectors(up: Float[Tensor, "3"], count: int, facing: Tensor | None) -> _Sectors:
    if facing is not None:
        facing = _unit("facing", facing).to(up)
        if abs(float(facing @ up)) > _VERTICAL:
            raise InputError(
                "facing must be a direction along the floor, got one within 30 degrees of the vertical, "
                f"which is {[round(value, 2) for value in up.tolist()]} in the axes of these cameras"
            )
        return _Sectors(_heading_of(up, facing)[None], math.pi / 3)
    return _Sectors(torch.arange(count).to(up) * (2 * math.pi / count), math.pi / count)


def _first_particles(
    body: Any,
    silhouettes: Tensor,
    rig: CameraRig,
    prior: Any,
    generator: Generators,
    n: int,
    up: Float[Tensor, "3"],
    sectors: _Sectors,
) -> Float[Tensor, "B N D"]:
    batch = len(silhouettes)
    place = place_from_silhouettes(silhouettes, rig, body.height)
    factor = torch.linalg.cholesky(place.cov).to(up)
    noise = standard_normal(batch, (n, 6), generator, up)
    position = place.position.to(up)[:, None] + noise[..., :3] @ factor.mT
    turn = sectors.half_width * (2 * uniform(batch, (n,), generator, up) - 1)
    turn = within_half_turn(turn + sectors.middle.repeat(batch // len(sectors.middle))[:, None])
    upright = minimal_rotation(torch.tensor([0.0, 1.0, 0.0]).to(up), up)
    heading = compose((turn / 2).sin()[..., None] * up, upright)
    heading = compose(heading, _TILT * noise[..., 3:])
    relative = _draw_poses(body, prior, batch, n, generator, up)
    return body.with_relative(torch.cat([position, heading, relative], -1), relative)


def _unit(name: str, direction: Tensor) -> Tensor:
    direction = torch.as_tensor(direction, dtype=torch.float64)
    check_shape(name, direction, [3])
    check_finite(name, direction)
    if float(direction.norm()) < 1e-9:
        raise InputError(f"{name} must be a direction, got zero")
    return direction / direction.norm()


def _heading_of(up: Tensor, facing: Tensor) -> Tensor:
    """Return the angle about `up` that turns the z axis of the upright body to `facing`."""
    y = torch.tensor([0.0, 1.0, 0.0]).to(up)
    ahead = quaternion_vector_to_matrix(minimal_rotation(y, up))[:, 2]
    return torch.atan2(torch.linalg.cross(ahead, facing) @ up, ahead @ facing)


def _draw_poses(
    body: Any, prior: Any, batch: int, n: int, generator: Generators, like: Tensor
) -> Float[Tensor, "B N Q"]:
    n_columns = body.dim - 6
    noise = standard_normal(batch, (n, n_columns), generator, like)
    if prior is None:
        return _PART * noise
    rows = uniform(batch, (n,), generator, like)
    if hasattr(prior, "pose_mean") and hasattr(prior, "to_latent"):
        prior.check_for(body)
        points = prior.latents
        chosen = points[(rows * len(points)).long().clamp_max(len(points) - 1)]
        extra = standard_normal(batch, (n, points.shape[1]), generator, like)
        poses = prior.pose_mean(chosen + extra * prior.std_latent.to(chosen).nan_to_num(0.0))
        return poses.to(like) + noise * prior.std_pose.to(like).nan_to_num(0.0)
    poses = torch.as_tensor(prior)
    if poses.ndim != 2 or len(poses) == 0 or poses.shape[1] not in (n_columns, body.dim):
        raise InputError(
            f"prior must be a manifold, or poses [M, {n_columns}] or [M, {body.dim}], "
            f"got {list(poses.shape)}"
        )
    check_finite("prior", poses)
    poses = poses[:, -n_columns:].to(like)
    return poses[(rows * len(poses)).long().clamp_max(len(poses) - 1)]


def _layer_steps(dim: int, n_layers: int) -> Float[Tensor, "M D"]:
    """Return standard deviations of the diffusion, which fall geometrically from layer to layer."""
    share = torch.linspace(0, 1, n_layers, dtype=torch.float64)[:, None]
    first, last = (torch.tensor(s, dtype=torch.float64).log() for s in (_FIRST_STEP, _LAST_STEP))
    steps = ((1 - share) * first + share * last).exp()
    return steps[:, [0] * 3 + [1] * 3 + [2] * (dim - 6)]


def _mean_of_best_mode(
    body: Any, particles: Float[Tensor, "B N D"], log_weights: Float[Tensor, "B N"]
) -> Float[Tensor, "B D"]:
    """Return the weighted mean of the particles that face about the same way as the best one."""
    log_weights = log_weights.nan_to_num(0.0, neginf=-torch.inf)  # all of them ruled out: alike
    chosen = best_particle(particles, log_weights)[:, None]
    turned = body.difference(particles, chosen)[..., 3:6].norm(dim=-1)
    kept = log_weights.masked_fill(turned > _ONE_MODE, -torch.inf)
    return body.mean(particles, kept.to(particles))
