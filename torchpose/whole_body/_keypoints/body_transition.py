"""Predict the state of an articulated body one frame ahead, by the motion learnt from recordings."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.body._articulation import Articulation, BodyPoint
from torchpose.priors._body_motion import BodyMotion
from torchpose.priors._motion_drift import drift_at
from torchpose.whole_body._keypoints.keypoint_likelihood import LEAST_ODDS

_SCALE_DRIFT = 0.002  # of the log of a bone's length, per root of a second
_EXCHANGES = 0.1  # rate, per second and camera, at which sides begin to be exchanged
_RETURNS = 3.0  # rate, per second, at which exchanged sides become right again
_LOST = 0.2  # rate, per second, at which a joint comes to be elsewhere than predicted
_STAYS_LOST = 0.6  # share of such joints that a frame does not find again
_JUMPS = {"position": 0.1, "rotations": 0.7, "velocity": 5.0, "shifts": 0.05}
_ROOT_JUMP = 1.0  # metres per second
_KEPT = 0.1  # 1/s, decay of the root's horizontal velocity while nothing is measured


class Ahead(NamedTuple):
    """Holds bodies [*batch] one frame later, and their derivative [*batch, N, N] by the tangents before."""

    mean: BodyPoint
    matrix: Tensor


class BodyTransition(NamedTuple):
    """Holds the model of one frame.

    Attributes:
        matrix, noise: [N, N], or of each body [*batch, N, N], of the tangent.
        driven: [N, V], or of each body, how far accelerations that last for the frame move the tangent.
        share: of the pose prior's information that a frame adds.
        begin, end: probabilities that an exchange of sides begins, and ends. lost: that a joint is.
    """

    matrix: Tensor
    noise: Tensor
    driven: Tensor
    share: float
    begin: float
    end: float
    lost: float

    def ahead(self, motion: BodyMotion, point: BodyPoint) -> Ahead:
        """Return bodies one frame later, and how changes of them go on."""
        body = motion.articulation
        drift = drift_at(body, motion.drift, point)
        driven = (self.driven @ drift.acceleration[..., None]).squeeze(-1)
        matrix = self.matrix + self.driven @ drift.jacobian
        return Ahead(body.moved(point, self._step(body, point) + driven), matrix)

    def _step(self, articulation: Articulation, point: BodyPoint) -> Float[Tensor, "*batch N"]:
        """Return the step of the mean in the tangent space without mean accelerations."""
        at = articulation.columns
        moving = point.velocity.new_zeros(*point.velocity.shape[:-1], articulation.dim)
        moving[..., at["velocity"]] = point.velocity
        moving[..., at["shifts"]] = point.shifts.flatten(-2)
        return (moving.unsqueeze(-2) @ self.matrix.mT).squeeze(-2) - moving

    def where_coasting(
        self, other: "BodyTransition", coasting: Bool[Tensor, "*batch"]
    ) -> "BodyTransition":
        """Return the model of each body, another one for those of whom nothing was measured."""
        rows = coasting[..., None, None]
        matrix = torch.where(rows, other.matrix, self.matrix)
        noise = torch.where(rows, other.noise, self.noise)
        driven = torch.where(rows, other.driven, self.driven)
        return self._replace(matrix=matrix, noise=noise, driven=driven)

    def next_log_odds(self, log_odds: Float[Tensor, "*batch C 2"]) -> Float[Tensor, "*batch C 2"]:
        """Return the log-odds of exchanged sides one frame later."""
        p = log_odds.sigmoid()
        return torch.logit(p * (1 - self.end) + (1 - p) * self.begin, LEAST_ODDS)

    def next_doubt(self, doubt: Float[Tensor, "*batch J"]) -> Float[Tensor, "*batch J"]:
        """Return the log-odds of joints elsewhere than predicted one frame later."""
        return torch.logit(_STAYS_LOST * doubt.sigmoid() + self.lost, LEAST_ODDS)


def transition(
    motion: BodyMotion, dt: float, decay: Float[Tensor, " V"] | None = None
) -> BodyTransition:
    """Return the model of a frame of dt seconds.

    Position and angles: x' = x + b v,  v' = a v,  a = exp(-decay dt),  b = (1 - a) / decay, with the noise of
    white accelerations q, that are correlated. With the covariance Q of these, and c = (1 - a_i a_j) /
    (decay_i + decay_j), the covariances of the noise of i and j are

        Q_ij [(dt - b_i - b_j + c) / (decay_i decay_j),  (b_j - c) / decay_i;  (b_i - c) / decay_j,  c].

    Mean accelerations u add (dt - b) / decay u to x', and b u to v'.

    Args:
        motion: how bodies move. dt: seconds. decay: 1/s, of other velocities than the motion's.
    """
    body = motion.articulation
    decay = motion.decay if decay is None else decay
    at = body.columns
    matrix = torch.eye(body.dim).to(motion.acceleration)
    noise = torch.zeros_like(matrix)
    pose, velocity = torch.arange(body.n_pose), _index(at["velocity"])
    keep = torch.exp(-decay * dt)
    gone = (1 - keep) / decay
    matrix[pose, velocity] = gone
    matrix[velocity, velocity] = keep
    power = motion.correlation * torch.outer(motion.acceleration, motion.acceleration)
    together = (1 - torch.outer(keep, keep)) / (decay[:, None] + decay)
    both = power / torch.outer(decay, decay) * (dt - gone[:, None] - gone + together)
    across = power / decay[:, None] * (gone - together)
    noise[: body.n_pose, : body.n_pose] = both
    noise[: body.n_pose, at["velocity"]], noise[at["velocity"], : body.n_pose] = across, across.mT
    noise[at["velocity"], at["velocity"]] = power * together
    driven = matrix.new_zeros(body.dim, body.n_pose)
    driven[pose, pose], driven[velocity, pose] = (dt - gone) / decay, gone
    shifts = _index(at["shifts"])
    held = torch.exp(-dt / motion.shift_time).expand_as(motion.shift_std)
    spread = motion.shift_std.square() * (1 - held.square())
    matrix[shifts, shifts] = held.repeat_interleave(3)
    noise[shifts, shifts] = spread.repeat_interleave(3)
    scales = _index(at["scales"])
    noise[scales, scales] = _SCALE_DRIFT**2 * dt
    begin, end, lost = (1 - math.exp(-rate * dt) for rate in (_EXCHANGES, _RETURNS, _LOST))
    share = dt / float(motion.pull_time)
    return BodyTransition(matrix, noise, driven, share, begin, end, lost)


def coasting_transition(motion: BodyMotion, dt: float, up: Float[Tensor, "3"]) -> BodyTransition:
    """Return the model of a frame of dt seconds after one in which nothing was measured.

    The decay of the root's velocity that recordings tell is of all its motion, and most of that goes to and
    fro. By it who walks on unseen would stay behind by a metre in a second. Here the horizontal part, across
    `up`, hardly decays. Nothing has a mean acceleration, since a pose that is imagined tells none.
    """
    at, decay = motion.articulation.columns, motion.decay.clone()
    decay[:3] = _KEPT
    usual, kept = transition(motion, dt), transition(motion, dt, decay)
    root = torch.cat([_index(at["position"]), _index(at["velocity"])[:3]])
    vertical = torch.block_diag(*[torch.outer(up, up)] * 2).to(motion.acceleration)

    def mixed(usual: Float[Tensor, "N N"], kept: Float[Tensor, "N N"]) -> Float[Tensor, "N N"]:
        block = root[:, None], root
        kept[block] += (usual - kept)[block] @ vertical
        return kept

    matrix, noise = mixed(usual.matrix, kept.matrix), mixed(usual.noise, kept.noise)
    undriven = torch.zeros_like(usual.driven)
    return usual._replace(matrix=matrix, noise=noise, driven=undriven)


def jump_variance(motion: BodyMotion) -> Float[Tensor, " N"]:
    """Return the variances that a part gets whose joint is elsewhere than predicted."""
    body = motion.articulation
    std = torch.zeros(body.dim, dtype=torch.float64)
    for name, value in _JUMPS.items():
        std[body.columns[name]] = value
    std[body.columns["velocity"]][:3] = _ROOT_JUMP
    return std.square().to(motion.acceleration.device)


def _index(columns: slice) -> Tensor:
    return torch.arange(columns.start, columns.stop)
