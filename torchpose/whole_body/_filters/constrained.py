"""Run the particle filter with action-specific posture constraints (aSpace)."""

from typing import Any, Unpack

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.checks import check_choice, check_positive, number_of
from torchpose._core.wording import counted
from torchpose.body._kinematics import Body
from torchpose.body._skeleton import BODY_15
from torchpose.errors import InputError
from torchpose.filters._recursive_filter import Generators, standard_normal
from torchpose.math._rotations import within_unit_ball
from torchpose.priors._actions.bank import ActionBank
from torchpose.priors._actions.gate import GATE_WIDTH
from torchpose.priors._actions.space import ActionSpace
from torchpose.whole_body._filters.body_frames import Frame
from torchpose.whole_body._filters.body_particles import (
    BodyFilterOptions,
    BodyFilterOutput,
    BodyFilterState,
    PoseSpace,
    WeightedParticles,
    reweight,
    warn_of_frames,
)
from torchpose.whole_body._filters.motion import next_velocity, rescale_std
from torchpose.whole_body._filters.posture_gate import (
    PostureGate,
    Redrawn,
    Rows,
    all_accepted,
    redraw_until_accepted,
)
from torchpose.whole_body._filters.silhouette_filter import SilhouetteParticleFilter

CONSTRAINED_WEIGHTS = ("published", "normalised")
_RELATIVE = slice(6, None)  # the columns of a state that a posture depends on
_COMMON_HEIGHT = 1.75  # metres, of the body on which the postures of actions are told
# What a constant velocity misses, at 60 Hz, about twice that of walks and exercises: metres for the
# root, sines of half angles for its orientation and for parts.
_TRACKING_STD, _TRACKING_RATE = (0.004, 0.006, 0.01), 60.0
_TRACKING_SHARPNESS = 30.0  # of the overlap
_REJECTED = (
    "the gate rejected every draw of all particles {times} times ({frames}), and they were moved to its "
    "border; start in a posture of the action, use fewer dimensions, a wider gate, more redraws or a "
    "larger process_cov, or a bank in which no action is possible too"
)


class ConstrainedParticleFilter(SilhouetteParticleFilter):
    """Filters by first-order motion, of which only postures of a known action are let through (aSpace).

    In frame t, for each particle s,
        phi^_s = phi_s + V_{t-1} + eta(sigma_phi)                                        (AS 3)
    is drawn again until the action accepts it: with z its projection and j the posture of the mean
    performance that it matched,
        p(phi | Gamma) = 1 if |z_d - g_jd| < 2 sigma_jd for all d = 1..D, else 0.        (AS 6)
    Then particles are weighted by the image (AS 7, `likelihood="overlap"`) and resampled. V is the
    velocity of the estimate, V_t = a V_{t-1} + (1 - a)(phi_{t-1} - phi_{t-2}). States move by
    `body.perturb`; the root is outside the gate.

    What is still rejected after `max_redraws` is moved to the gate's border (`details["clamped"]`).

    (AS 5) multiplies p(phi_t | phi_{t-1}) by p(phi_t | Gamma); drawing again divides by the share Z of
    the draws that are accepted, which differs from ancestor to ancestor. weights="normalised" puts Z
    back, estimated without bias from the draws of all copies of an ancestor; what was clamped gets no
    weight then. With Z, particles that are about to leave the action lose.

    With an `ActionBank` every particle has an action of its own, or none: it changes by the bank's
    matrix, and only its own action's gate counts. Weights are also multiplied by the bank's likelihood of
    the posture under that action, to the power that a frame counts: a gate alone, which says yes or no,
    hardly tells actions apart. The sums of weights are a posterior over actions, p(A_t | I_1:t); where
    none of them has the most, the motion is free, which `details["released"]` says.

    Reported per frame in `BodyFilterOutput.details`: "acceptance", the share of first draws that were
    accepted; "redraws", how many more were drawn per particle; "clamped", a share; with a bank "actions"
    [A + 1], none last, and "released".

    Args:
        body: a `Body` of the joints of `BODY_15`.
        action: the fitted action, a bank of several, or None for first-order motion without constraint.
        n_particles: N.
        velocity_rate: a, from 0 to below 1; None for no velocity at all.
        max_redraws: how often a particle is drawn again at most.
        weights: "published" or "normalised".
        gate_width: deviations to either side in (AS 6), 2 as published.
        posture_body: see `PostureGate`.
        fps: of the frames to be tracked, to which a bank's transitions are rescaled (`repr` says from
            which); that of its performances if None. One action is the same at any frame rate.
        **options: as `SilhouetteParticleFilter`; `process_cov` is sigma_phi^2 (`constant_velocity_std`), and
            ``likelihood="overlap"`` the published one.

    Raises:
        InputError, ShapeError: an argument is not as described. SkeletonError: a body of other joints.

    Reference:
        AS, equations (3)-(7).
    """

    def __init__(
        self,
        body: PoseSpace,
        action: ActionSpace | ActionBank | None,
        n_particles: int = 2000,
        *,
        velocity_rate: float | None = 0.5,
        max_redraws: int = 50,
        weights: str = "published",
        gate_width: float = GATE_WIDTH,
        posture_body: Body | None = None,
        fps: float | None = None,
        **options: Unpack[BodyFilterOptions],
    ) -> None:
        super().__init__(body, n_particles, **options)
        if velocity_rate is not None and not 0 <= velocity_rate < 1:
            raise InputError(f"velocity_rate must be from 0 to below 1, got {velocity_rate}")
        if not number_of(max_redraws) >= 0 or max_redraws % 1:
            raise InputError(f"max_redraws must be a whole number of 0 or more, got {max_redraws}")
        check_choice("weights", weights, CONSTRAINED_WEIGHTS)
        if weights == "normalised" and isinstance(action, ActionBank):
            raise InputError(
                "a bank compares motions that are normalised under every action, as redrawing does; "
                "expected weights='published', got 'normalised'"
            )
        if fps is not None:
            check_positive("fps", fps)
        if isinstance(action, ActionBank):
            action.frame_rate(fps)  # there is one
        self.velocity_rate, self.max_redraws, self.weights = velocity_rate, max_redraws, weights
        self.fps = fps
        self.gate: PostureGate | None = None
        if not isinstance(posture_body, Body | None):
            raise InputError(
                f"posture_body must be a torchpose.body.Body, got {type(posture_body).__name__}"
            )
        if action is not None:
            self.gate = PostureGate(body, action, posture_body, gate_width)  # type: ignore[arg-type]

    # --- what is remembered

    def first_memory(self, particles: Float[Tensor, "B N D"]) -> Tensor | None:
        """Return the action of every new particle, or its index, by which its copies are recognised.

        Returns:
            [B, N] integers; None where neither is needed.
        """
        batch, n = particles.shape[:2]
        if self.gate is not None and self.gate.several:
            return self.gate.first_actions(batch, n)
        if self._copies_known:
            return torch.arange(n, device=particles.device).expand(batch, n)
        return None

    def swap_memory(self, memory: Tensor, swapped: Bool[Tensor, "B N"]) -> Tensor:
        """Return the memory of particles of which some have exchanged their legs: no copies of the others.

        Returns:
            Memory of the same shape; that of actions as it was.
        """
        if not self._copies_known:
            return memory
        return memory + memory.shape[1] * swapped

    def first_trend(self, mean: Float[Tensor, "B D"]) -> Tensor:
        """Return the velocity, zero, and the estimate before the first frame.

        Returns:
            [B, 2, D], in the units of a step and of the state.
        """
        return torch.stack([torch.zeros_like(mean), mean], 1)

    # --- a frame

    def move(
        self, state: BodyFilterState, frame: Frame, generator: Generators
    ) -> WeightedParticles:
        """Predict within the action (AS 3, 6), then weigh by the image (AS 7)."""
        trend = self._trend(state)
        batch, n, dim = state.particles.shape
        rows = Rows.all(batch, n, generator, state.particles.device)
        actions = None
        if self.gate is not None and self.gate.several:
            actions = self.gate.next_actions(state.memory, self.fps, generator)  # type: ignore[arg-type]
        found = self._predict(state.particles, trend[:, 0], actions, rows)
        particles = found.states.view(batch, n, dim)
        log_prior = state.log_weights + self.log_limits(particles)
        if self.gate is not None and actions is not None:
            evidence = self.gate.log_evidence(particles, actions, self.fps)
            log_prior = log_prior + torch.where(frame.seen[:, None], evidence, 0.0)
        memory = state.memory if actions is None else actions
        if self._copies_known:
            log_prior = log_prior + log_share(found, state.memory)  # type: ignore[arg-type]
            memory = self.first_memory(particles)
        moved = reweight(particles, log_prior, frame.score(particles))
        details = self._details(found, moved.log_weights, actions)
        return moved._replace(memory=memory, trend=trend, details=details)

    def warn(self, track: BodyFilterOutput) -> None:
        """Warn of the frames in which all particles died, or the gate rejected every draw.

        Args:
            track: the track of a batch, [B, T, ...].
        """
        super().warn(track)
        warn_of_frames(track.details["clamped"] == 1, _REJECTED)

    @property
    def action_names(self) -> tuple[str, ...]:
        """Return the names of the bank's actions, none last; empty without a bank."""
        return () if self.gate is None or not self.gate.several else tuple(self.gate.action.names)

    def notes(self, track: BodyFilterOutput, first_frame: int = 0) -> tuple[str, ...]:
        """Report the share of draws that the gate accepted, and when it was released."""
        if self.gate is None:
            return ()
        accepted, clamped = track.details["acceptance"], track.details["clamped"]
        found = [
            f"the gate let {100 * float(accepted.mean()):.0f} % of the first draws through; "
            f"{100 * float(clamped.mean()):.0f} % of the particles were moved to its border"
        ]
        shut = (clamped == 1).nonzero().flatten() + first_frame
        if len(shut):
            found.append(
                f"in {counted(len(shut), 'frame')}, the first of them {int(shut[0])}, the gate "
                "rejected every draw: the person did something else, or the body is not theirs; a bank of "
                "several actions lets go there"
            )
        released = track.details.get("released")
        if released is not None and bool(released.any()):
            found.append(
                f"in {counted(int(released.sum()), 'frame')} none of the actions was likeliest, and the "
                "constraint was released"
            )
        return tuple(found)

    @classmethod
    def tracking_options(cls, body: Any, fps: float, learnt: Any = None) -> dict[str, Any]:
        """Return the options of tracking: twice the error of constant velocity, the published likelihood."""
        step = torch.empty(body.dim, dtype=torch.float64)
        step[:3], step[3:6], step[6:] = _TRACKING_STD
        return {
            "process_cov": rescale_std(step, 1 / _TRACKING_RATE, 1 / fps).square(),
            "sharpness": _TRACKING_SHARPNESS,
            "likelihood": "overlap",
            "posture_body": None if learnt is None else _posture_body(learnt),
        }

    def extra_repr(self) -> str:
        said = f"{self.n_particles} particles"
        if self.gate is None or not self.gate.several:
            return said
        fitted, fps = self.gate.action.info.fps, self.gate.action.frame_rate(self.fps)
        rescaled = "" if fitted in (None, fps) else f", rescaled from {fitted:g}"
        return f"{said}, transitions at {fps:g} frames per second{rescaled}"

    # --- helpers

    @property
    def _copies_known(self) -> bool:
        return self.gate is not None and self.weights == "normalised"

    def _trend(self, state: BodyFilterState) -> Float[Tensor, "B 2 D"]:
        velocity, before = state.trend.unbind(1)  # type: ignore[union-attr]
        if self.velocity_rate is not None:
            velocity = next_velocity(self.body, velocity, state.mean, before, self.velocity_rate)
        return torch.stack([velocity, state.mean], 1)

    def _predict(
        self,
        particles: Float[Tensor, "B N D"],
        velocity: Float[Tensor, "B D"],
        actions: Int[Tensor, "B N"] | None,
        rows: Rows,
    ) -> Redrawn:
        """Draw by (AS 3), relative columns until the gate accepts them, or moved to its border."""
        batch, n, dim = particles.shape
        noise = standard_normal(batch, (n, dim), rows.generator, particles) * self.step_std
        moved = self.constrain(self.body.perturb(particles, velocity[:, None] + noise))
        moved = moved.flatten(0, 1)
        if self.gate is None:
            return all_accepted(moved)
        gate, own = self.gate, None if actions is None else actions.flatten()
        before, ahead, std = (
            part[..., _RELATIVE].flatten(0, -2).float()
            for part in (particles, velocity, self.step_std[None])
        )

        def draw(rows: Rows) -> Tensor:
            step = torch.addcmul(ahead[rows.element], rows.normal(len(std[0]), std), std)
            return self._constrained(before[rows.at] + step)

        def accept(relative: Tensor, rows: Rows) -> Tensor:
            return gate.accept(relative, rows, own)

        found = redraw_until_accepted(
            draw, accept, rows, self.max_redraws, estimate_share=self._copies_known
        )
        moved = torch.cat([moved[:, : _RELATIVE.start], found.states.to(moved)], -1)
        left = rows.keep(~found.accepted)
        if len(left.at):
            moved[left.at] = gate.clamp(moved[left.at], left, own)
        moved = self.constrain(moved[None])[0]
        return found._replace(states=moved)

    def _constrained(self, relative: Float[Tensor, "r Q"]) -> Float[Tensor, "r Q"]:
        """Return columns within the unit ball, and within the joint limits if they clamp."""
        relative = within_unit_ball(relative.unflatten(-1, (-1, 3))).flatten(-2)
        if self.limits is None or self.limit_mode != "clamp":
            return relative
        root = relative.new_zeros(len(relative), _RELATIVE.start)
        return self.limits.clamp(torch.cat([root, relative], -1))[:, _RELATIVE]

    def _details(
        self, found: Redrawn, log_weights: Float[Tensor, "B N"], actions: Int[Tensor, "B N"] | None
    ) -> dict[str, Tensor]:
        shape = log_weights.shape

        def share(per_row: Tensor) -> Tensor:
            return per_row.view(shape).double().mean(-1)

        details = {
            "acceptance": share(found.first),
            "redraws": share(found.draws - 1),
            "clamped": share(~found.accepted),
        }
        if actions is not None:
            n_states = len(self.gate.action.names)  # type: ignore[union-attr]
            weights = log_weights.softmax(-1).nan_to_num(1 / shape[1])  # dead: as many of each
            none = weights.new_zeros(len(weights), n_states)
            details["actions"] = none.scatter_add(1, actions, weights)
            details["released"] = details["actions"].argmax(-1) == n_states - 1
        return details


def _posture_body(action: ActionSpace | ActionBank) -> Body | None:
    """Return the body on which the performances were put, None if it is the tracked one."""
    usual = "body" if isinstance(action, ActionBank) else "joints"
    common = action.info.extra.get("postures", usual) == "body"
    return Body.of_height(BODY_15, _COMMON_HEIGHT) if common else None


def log_share(found: Redrawn, ancestors: Int[Tensor, "B N"]) -> Float[Tensor, "B N"]:
    """Return log Z of particles, from the draws of all copies of an ancestor; -inf where clamped.

    The copies that were accepted share the sum of what all copies estimate, so that the weighted
    particles stay exact on average. Where everything was clamped all are alike.

    Args:
        found: of R = B N rows. ancestors: number of the particle that each one is a copy of, N more where
            it has exchanged its legs.
    """
    shape = ancestors.shape
    share, accepted = found.share.view(shape), found.accepted.view(shape)
    none = share.new_zeros(shape[0], 2 * shape[1])
    total = none.scatter_add(1, ancestors, share)
    count = none.scatter_add(1, ancestors, accepted.to(share))
    log_z = (total / count.clamp_min(1)).log().gather(1, ancestors)
    log_z = log_z.masked_fill(~accepted, -torch.inf)
    return torch.where(accepted.any(1, keepdim=True), log_z, 0.0)
