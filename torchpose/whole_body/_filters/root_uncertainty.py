"""Track with large uncertainty in the root: many roots, and a Gaussian per part for each of them.

Particles sample the position and heading of the body. Given these, the rotation of every part has a
Gaussian, which seven positions of the part in the image update in closed form.
"""

import math
from collections.abc import Mapping
from typing import Any, ClassVar, Unpack

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from torchpose._core.checks import check_choice, check_positive, check_shape, number_of
from torchpose.body._kinematics import Body
from torchpose.errors import InputError
from torchpose.filters._recursive_filter import Generators, standard_normal
from torchpose.filters._resampling import (
    LEAST_SURVIVORS,
    check_survival_rate,
    survival_exponent,
    survival_rate_per_frame,
)
from torchpose.math._gaussian import symmetrise
from torchpose.math._rotations import (
    compose,
    conjugate,
    cross_matrix,
    quaternion_vector_to_matrix,
    vector_to_quaternion,
    within_unit_ball,
)
from torchpose.math._tree_messages import propagate
from torchpose.math._unscented import sigma_points
from torchpose.priors._limb_conditionals import LimbConditionals
from torchpose.whole_body._filters.body_frames import Frame
from torchpose.whole_body._filters.body_particles import (
    BodyFilterOptions,
    BodyFilterState,
    WeightedParticles,
    reweight,
)
from torchpose.whole_body._filters.legs import leg_permutation
from torchpose.whole_body._filters.limb_observations import (
    check_rules,
    count_positions,
    least_part_log_likelihood,
    observation_gaussians,
    part_groups,
    part_log_likelihood,
    parts_log_weight,
)
from torchpose.whole_body._filters.motion import default_step_std
from torchpose.whole_body._filters.silhouette_filter import SilhouetteParticleFilter
from torchpose.whole_body._keypoints.particle_likelihood import (
    keypoint_log_likelihood,
    limbs_given_keypoints,
)

WEIGHTINGS = ("parts", "body")

_SURVIVAL = 0.1  # a frame
_POINTS = 7  # places of every part, which together cost as much as so many whole bodies
_TRACKING_SWAP = 0.02
_ROOT = 6  # columns of a state: position and orientation of the root


class RootUncertaintyTracker(SilhouetteParticleFilter):
    """Tracks root hypotheses by sampling, and for each of them a Gaussian over every part's rotation.

    X_n = {x_r, mu_1, Sigma_1, ..., mu_{P-1}, Sigma_{P-1}, w}. In every frame the root diffuses,
    x_r <- x_r + N(0, process_cov), and the parts' covariances grow (DX 13-14). Seven sigma points of
    every part, the others at their means, are weighed by the silhouette pixels under them (DX 4) and
    make p(x_i | O_i) = N(mu_i^obs, Sigma_i^obs); messages along the tree of parts (DX 5-11) give the
    posterior of each part. A hypothesis weighs

        w_n ~ (prod_i sum_{j=1}^7 p(O_i | sigma_ij))^beta   (DX 12),

    with beta such that the share alpha of them survives, as published alpha = exp(ln alpha_c / fps).
    A part under which no camera sees any silhouette, at none of its seven points, may be hidden or out of
    view: a hundredth of its pixels counts there, unless that is so of all parts of the hypothesis.

    The particles of the state are the roots with the parts' means, its `memory` the covariances
    [B, N, P - 1, 3, 3]. The weights are no posterior's, so the log-evidence is NaN; the standard
    deviations reported are those of the hypotheses and of their Gaussians together.

    Args:
        body: with ``frame="body"`` and the centres of the conditionals.
        conditionals: of limbs, with temporal diffusion; rescaled to `fps` if learnt at another rate,
            see `info` of the attribute.
        n_particles: N, root hypotheses. A frame costs 7 N likelihoods: 114 are worth 800 particles.
        fps: frames per second.
        survival_rate: alpha, the share of the hypotheses that survives a frame, at least 2 / N. The
            default, 0.1 (2 / N of fewer than 20), is within 0.4 mm of the best on validation clips
            of walks at 60, 30, 20 and 15 frames a second.
        survival_per_second: alpha_c, instead of `survival_rate`. The published 0.01 keeps 0.93 in a
            frame at 60 Hz, which is too little selection for a root that walks and diffuses with
            zero mean; a much smaller one leaves less than one hypothesis at low frame rates.
        normalisation: "share" of a part's own pixels, or "published": their number. See
            `part_log_likelihood`.
        camera_rule: "product" over the cameras, or "sum".
        observation_sharpness: exponent of the pixel weights of the sigma points; 1 as published.
        least_std: the least standard deviation of an observation in any direction, sines of half angles.
        first_std: the standard deviation of every part at the start, and where all hypotheses died.
        weighting: "parts" (DX 12), or "body": the likelihood of the whole body at the posterior
            means, one more evaluation for each hypothesis.
        **options: as `SilhouetteParticleFilter`, but `estimate` is "map" by default, the means of the
            hypothesis of the largest weight, and `limit_mode` "discard"; only the root's part of
            `process_cov` counts, `likelihood` only with ``weighting="body"``, and `sharpness` cancels.

    Attributes:
        conditionals: at `fps`. survival_rate: alpha, per frame.

    Raises:
        PriorError: a body of another frame or other centres than the conditionals. InputError,
        ShapeError, SkeletonError: an argument is not as described.

    Reference: Daubney & Xie, Tracking 3D human pose with large root node uncertainty, CVPR 2011.
    """

    least_particles: ClassVar[int] = 3
    unused: ClassVar[frozenset[str]] = frozenset({"sharpness"})

    body: Body
    root_std: Tensor

    def __init__(
        self,
        body: Body,
        conditionals: LimbConditionals,
        n_particles: int = 114,
        *,
        fps: float,
        survival_rate: float | None = None,
        survival_per_second: float | None = None,
        normalisation: str = "share",
        camera_rule: str = "product",
        observation_sharpness: float = 8.0,
        least_std: float = 0.02,
        first_std: float = 0.05,
        weighting: str = "parts",
        **options: Unpack[BodyFilterOptions],
    ) -> None:
        _check(body, options.get("likelihood"), weighting, least_std, first_std)
        if not isinstance(conditionals, LimbConditionals):
            raise InputError(
                f"conditionals must be LimbConditionals, got {type(conditionals).__name__}; "
                "load_limb_conditionals reads them from a file"
            )
        check_rules(normalisation, camera_rule)
        check_positive("observation_sharpness", observation_sharpness)
        conditionals.check_for(body)
        options.setdefault("estimate", "map")
        options.setdefault("limit_mode", "discard")
        super().__init__(body, n_particles, **options)
        self.survival_rate = _survival(survival_rate, survival_per_second, fps, n_particles)
        self.conditionals = conditionals.at_rate(fps).to(self.step_std)
        self.fps, self.normalisation, self.camera_rule = float(fps), normalisation, camera_rule
        self.observation_sharpness, self.weighting = float(observation_sharpness), weighting
        self.least_std, self.first_std = least_std, first_std
        self.groups = part_groups(body.skeleton)
        self.register_buffer("root_std", self.step_std[:_ROOT].clone())

    # --- what the base asks for

    @classmethod
    def likelihoods_per_particle(cls, options: Mapping[str, Any]) -> int:
        """Return the number of likelihoods of one hypothesis: its sigma points, and the whole body."""
        return _POINTS + (options.get("weighting") == "body")

    @classmethod
    def tracking_options(cls, body: Any, fps: float, learnt: Any = None) -> dict[str, Any]:
        """Return the options of tracking: the default diffusion of the root, legs exchanged now and then."""
        return {"process_cov": default_step_std(body, fps).square(), "leg_swap": _TRACKING_SWAP}

    def start_std(self) -> Float[Tensor, " D"]:
        """Return the spread of the root alone: parts have Gaussians of their own."""
        spread = super().start_std()
        spread[list(self.body.relative_columns)] = 0.0
        return spread

    def first_memory(self, particles: Float[Tensor, "B N D"]) -> Float[Tensor, "B N V 3 3"]:
        """Return the covariances of the parts of new hypotheses.

        Returns:
            [B, N, P - 1, 3, 3], squares of sines of half angles.
        """
        eye = torch.eye(3, dtype=particles.dtype, device=particles.device)
        shape = (*particles.shape[:2], self.conditionals.tree.n_nodes, 3, 3)
        return (self.first_std**2 * eye).expand(shape).clone()

    def move(
        self, state: BodyFilterState, frame: Frame, generator: Generators
    ) -> WeightedParticles:
        """Diffuse the roots, observe the parts, pass messages and weigh (DX 4-14)."""
        roots = self._diffuse_roots(state.particles, generator)
        mean = roots[..., _ROOT:].unflatten(-1, (-1, 3))
        covariance = self.conditionals.diffuse(mean, self._memory(state))[1]
        particles, value = roots, torch.zeros_like(state.log_weights)
        if bool(frame.seen.any()):
            seen = self._update(roots, mean, covariance, frame)
            particles = torch.where(frame.seen[:, None, None], seen[0], roots)
            covariance = torch.where(frame.seen[:, None, None, None, None], seen[1], covariance)
            value = torch.where(frame.seen[:, None], seen[2], 0.0)
        log_limits = self.log_limits(particles)
        exponent = survival_exponent(value + log_limits, self.survival_rate)[:, None]
        moved = reweight(particles, state.log_weights + log_limits, exponent * value)
        coasting = ~frame.seen & (log_limits == 0).all(-1)  # exactly: without rounding
        return moved._replace(
            log_weights=torch.where(coasting[:, None], state.log_weights, moved.log_weights),
            memory=covariance, log_evidence=torch.full_like(moved.log_evidence, torch.nan),
        )  # fmt: skip

    def swap_memory(
        self, memory: Float[Tensor, "B N V 3 3"], swapped: Bool[Tensor, "B N"]
    ) -> Float[Tensor, "B N V 3 3"]:
        """Return covariances with those of the legs exchanged; left and right centres differ a little.

        x' = (w I + [v]_x) x + ... to first order, for the rotation (v, w) from one centre to the other.
        """
        order = leg_permutation(self.body.skeleton)[1:].to(memory.device)
        centres = self.body.centres.to(memory)
        shift = vector_to_quaternion(compose(conjugate(centres[1:]), centres[order]))
        turn = shift[..., 3, None, None] * torch.eye(3).to(memory) + cross_matrix(shift[..., :3])
        exchanged = turn @ memory[:, :, order - 1] @ turn.mT
        return torch.where(swapped[..., None, None, None], exchanged, memory)

    def spread(
        self,
        particles: Float[Tensor, "B N D"],
        log_weights: Float[Tensor, "B N"],
        mean: Float[Tensor, "B D"],
        memory: Tensor | None,
    ) -> Float[Tensor, "B D"]:
        """Return the deviation about the estimate: of the hypotheses, and within each of them."""
        between = super().spread(particles, log_weights, mean, memory)
        if memory is None:
            return between
        weights = log_weights.exp().to(memory.dtype)
        variance = memory.diagonal(dim1=-2, dim2=-1).flatten(-2)
        within = torch.einsum("bn,bnd->bd", weights, variance)
        return (between.square() + pad(within, (_ROOT, 0))).sqrt()

    def joint_covariance(
        self, state: BodyFilterState, mean: Float[Tensor, "B D"]
    ) -> Float[Tensor, "B J 3 3"]:
        """Return the second moment about the estimate's joints: of the hypotheses, and within each."""
        return joint_covariance_with_parts(self.body, state, self._memory(state), mean)

    # --- one frame

    def _diffuse_roots(self, particles: Tensor, generator: Generators) -> Tensor:
        batch, n, dim = particles.shape
        noise = self.root_std * standard_normal(batch, (n, _ROOT), generator, particles)
        return self.body.perturb(particles, pad(noise, (0, dim - _ROOT)))

    def _update(
        self, roots: Tensor, mean: Tensor, covariance: Tensor, frame: Frame
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return hypotheses, covariances, and log-weights before annealing, given an image."""
        value = roots.new_zeros(roots.shape[:2], dtype=torch.float64)
        if frame.silhouettes is not None:
            value, mean, covariance = self._outlined_parts(roots, mean, covariance, frame)
        if frame.keypoints is not None:
            states = self.body.with_relative(roots, mean.flatten(-2))
            mean, covariance = limbs_given_keypoints(
                frame.keypoints, self.body, states, mean, covariance, self.least_std
            )
        tree, transport = self.conditionals.tree, self.conditionals.transport
        mean, covariance = propagate(mean, covariance, tree, transport)
        particles = self.constrain(self.body.with_relative(roots, mean.flatten(-2)))
        if self.weighting == "body":
            return particles, covariance, frame.score(particles)
        if frame.keypoints is not None:
            joints = self.body.joints(particles)
            value = value + keypoint_log_likelihood(frame.keypoints, joints)
        return particles, covariance, value

    def _outlined_parts(
        self, roots: Tensor, mean: Tensor, covariance: Tensor, frame: Frame
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return log-weights before annealing, and the parts' Gaussians, given the silhouettes (DX 4, 12)."""
        points = sigma_points(mean, covariance, centre=True)
        counts = count_positions(
            self.body, roots, points, frame.cameras, frame.silhouettes, self.groups
        )
        likelihood = part_log_likelihood(
            counts, normalisation=self.normalisation, cameras=self.camera_rule
        )
        sharp = self.observation_sharpness * likelihood
        observed = observation_gaussians(points, sharp, mean, covariance, self.least_std)
        value = parts_log_weight(likelihood, least_part_log_likelihood(
            counts, normalisation=self.normalisation, cameras=self.camera_rule
        ))  # fmt: skip
        if frame.outlined is not None:
            value = torch.where(frame.outlined[:, None], value, 0.0)
        return value, *observed

    def _memory(self, state: BodyFilterState) -> Tensor:
        return self.first_memory(state.particles) if state.memory is None else state.memory

    def extra_repr(self) -> str:
        return (
            f"{self.n_particles} root hypotheses, {self.fps:g} frames per second, survival "
            f"{self.survival_rate:.3g} per frame"
        )


def joint_covariance_with_parts(
    body: Body,
    state: BodyFilterState,
    covariances: Float[Tensor, "B N V 3 3"],
    mean: Float[Tensor, "B D"],
) -> Float[Tensor, "B J 3 3"]:
    """Return the joints' second moment for particles with a Gaussian N(x_i; mu_i, Sigma_i) per part.

    With ``frame="body"`` a joint is a sum over the parts, p_j = p_r + sum_i R_r C_i R(x_i) o_ij, and
    the parts of a particle are independent of each other, so that with p^ of the estimate

        E[(p_j - p^_j)(p_j - p^_j)^T] = sum_n w_n (sum_i Cov[R_r C_i R(x_i) o_ij] + d_nj d_nj^T),
        d_nj = E[p_j | n] - p^_j.

    Mean and covariance of the rotations R(x_i) come from six sigma points each (`sigma_points`).

    Args:
        body: with ``frame="body"``. state: its particles [B, N, D] and their weights.
        covariances: Sigma of the V = P - 1 parts that are not the root, [B, N, V, 3, 3].
        mean: the estimate [B, D].

    Returns:
        [B, J, 3, 3], metres squared, symmetric.

    Raises:
        InputError: a body of another frame. ShapeError: another number of parts.
    """
    if body.frame != "body":
        raise InputError(
            "parts add up to joints only in rotations against the root; expected a body with "
            f"frame='body', got {body.frame!r}"
        )
    n_parts = len(body.skeleton.parts) - 1
    check_shape("covariances", covariances, ["B", "N", n_parts, 3, 3])
    particles = state.particles
    points = sigma_points(particles[..., _ROOT:].unflatten(-1, (-1, 3)), covariances)
    turns = quaternion_vector_to_matrix(within_unit_ball(points))  # [B, N, V, S, 3, 3]
    root = quaternion_vector_to_matrix(particles[..., None, 3:_ROOT])
    turns = (root @ body.centre_rotations[1:])[..., None, :, :] @ turns
    middle = turns.mean(3)
    expected = _joints(body, particles, torch.cat([root, middle], 2))
    away = expected - body.joints(mean)[:, None]
    weights = state.log_weights.exp().to(away)
    between = torch.einsum("bn,bnji,bnjk->bjik", weights, away, away)
    share = (weights / points.shape[-2]).sqrt()[..., None, None, None, None]
    spread = (share * (turns - middle[..., None, :, :])).transpose(1, 2).flatten(2, 3)
    rows = spread.flatten(-2)  # [B, V, N S, 9]
    of_parts = (rows.mT @ rows).unflatten(-1, (3, 3)).unflatten(2, (3, 3))
    offsets = body.joint_weights[3:].unflatten(0, (n_parts, 3))
    within = torch.einsum("bvxcyd,vcj,vdj->bjxy", of_parts, offsets, offsets)
    return symmetrise(between + within)


def _joints(
    body: Body, state: Float[Tensor, "*batch D"], rotations: Float[Tensor, "*batch P 3 3"]
) -> Float[Tensor, "*batch J 3"]:
    """Return joints for matrices of the parts, which need be no rotations: joints are linear in them."""
    rows = rotations.transpose(-3, -2).flatten(-2)
    return (rows @ body.joint_weights).mT + state[..., None, :3]


def _survival(rate: float | None, per_second: float | None, fps: float, n_particles: int) -> float:
    if rate is not None and per_second is not None:
        raise InputError(
            f"expected survival_rate or survival_per_second, got both ({rate} and {per_second})"
        )
    if per_second is not None:
        rate = survival_rate_per_frame(per_second, fps)
    elif rate is None:
        few = LEAST_SURVIVORS < n_particles < LEAST_SURVIVORS / _SURVIVAL
        rate = LEAST_SURVIVORS / n_particles if few else _SURVIVAL
    check_survival_rate(rate, n_particles)
    return rate


def _check(body: Any, likelihood: Any, weighting: str, least_std: float, first_std: float) -> None:
    if not isinstance(body, Body):
        raise InputError(f"expected a torchpose.body.Body, got {type(body).__name__}")
    if callable(likelihood):
        raise InputError(
            "the tracker counts silhouette pixels under single parts and takes no other likelihood; "
            "leave likelihood out, or name one of a whole body"
        )
    check_choice("weighting", weighting, WEIGHTINGS)
    for name, value in (("least_std", least_std), ("first_std", first_std)):
        if not 0 <= number_of(value) < math.inf:
            raise InputError(f"{name} must be zero or more and finite, got {value}")
