"""Hold hypotheses about both arms, weigh them, and tie them from frame to frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize, pad

from torchpose.priors._arms import ArmPrior
from torchpose.priors._gaussian_mixture import LOG_2PI
from torchpose.upper_body._limb_nodes import nodes_anywhere, nodes_on_ray

__all__ = ["ArmChain", "ArmInput", "ArmState", "Arms", "DirectionDensity"]

_SLACK = 0.018  # metres: joints of recordings are not the ends of stiff bones
_ANGLES = 17  # of a bone whose end is measured
_AROUND = 150  # directions of one whose end is not
_BOTH = 68  # of each of two such bones
_STEP = math.radians(10.0)  # of a direction from frame to frame at 30 frames a second
_ANEW = 0.2  # share of an arm's belief that is reinitialised in a frame at 30 frames a second
_RATE = 30.0
_NOTHING = -60.0
_LEAST = 1e-30  # density
_LIKELIEST = 32  # hypotheses of an arm that are compared with the other arm's
_ROWS = 2048  # directions at a time, so that intermediate results stay in the cache


class ArmInput(NamedTuple):
    """Measurements of both arms, the right one mirrored; shapes [B, 2, M] for M hypotheses of the root.

    Attributes:
        shoulder: camera axes, metres, [B, 2, M, 3]. rays: the rays of elbow and hand, [B, 2, 2, 3].
        known: whether elbow and hand are measured, [B, 2, 2].
        std: the standard deviation of a pixel over the focal length, of elbow and hand with their near
            ends, [B, 2, 2].
        axes: the rotation from camera to upright axes, [B, 2, M, 3, 3].
        lengths: the lengths of both bones, metres, [B, 2, M, 2].
        slack: the standard deviation of the ends of both bones for want of their lengths, metres, [B, 2].
    """

    shoulder: Tensor
    rays: Tensor
    known: Tensor
    std: Tensor
    axes: Tensor
    lengths: Tensor
    slack: Tensor


class Arms(NamedTuple):
    """Hypotheses about both arms.

    Attributes:
        directions: the directions of upper arm and forearm, upright axes, [B, 2, M, N, 6].
        log_weight: the log of the likelihood times the node's share of the directions, [B, 2, M, N].
        log_prior: the log-density of the prior, [B, 2, M, N].
    """

    directions: Tensor
    log_weight: Tensor
    log_prior: Tensor

    @property
    def log_evidence(self) -> Float[Tensor, "B 2 M"]:
        """Return the log of the prior predictive density of the measurements of each arm."""
        return torch.logsumexp(self.log_weight + self.log_prior, -1)

    @property
    def mean_directions(self) -> Float[Tensor, "B 2 M 6"]:
        """Return the mean directions given each hypothesis of the root; not of unit length."""
        weight = torch.softmax(self.log_weight + self.log_prior, -1)
        return (weight[..., None] * self.directions).sum(-2)


class ArmState(NamedTuple):
    """Posterior of both arms after a frame.

    Attributes:
        directions: the directions of the hypotheses, upright axes, [B, 2, N, 6].
        weight: their weights, normalised, [B, 2, N].
        log_evidence: the log-evidence of the frame given those before, [B, 2].
        prior, predicted: the density of the prior, and that predicted from the frames before, at each
            hypothesis, [B, 2, N].
    """

    directions: Tensor
    weight: Tensor
    log_evidence: Tensor
    prior: Tensor
    predicted: Tensor


class DirectionDensity:
    """Log-density of an `ArmPrior`; what does not depend on the directions is computed once."""

    def __init__(self, prior: ArmPrior, device: torch.device | None = None) -> None:
        parts = (*prior.directions.parameters_tuple(), prior.log_mass)
        weights, means, covariances, log_mass = (part.to(device).double() for part in parts)
        k, dim = means.shape
        factor = torch.linalg.cholesky(covariances)
        eye = torch.eye(dim, dtype=factor.dtype, device=factor.device).expand(k, dim, dim)
        inverse = torch.linalg.solve_triangular(factor, eye, upper=False)
        self.rows = inverse.transpose(0, 1).reshape(dim * k, dim).mT.contiguous().float()
        self.shift = (inverse @ means[..., None])[..., 0].mT.reshape(-1).float()
        logs = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        constant = weights.log() - 0.5 * dim * LOG_2PI - logs - log_mass
        self.constant = (constant + math.log1p(-prior.broad)).float()
        self.broad = math.log(prior.broad) - 2 * math.log(4 * math.pi)
        self.size = dim, k
        apart = (weights[:, None] * weights).clamp_min(_LEAST)
        tied = prior.together.to(device).double() / apart
        self.together = pad(tied, (0, 1, 0, 1), value=1.0)  # the broad part is tied to nothing

    def __call__(self, directions: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch"]:
        """Return log p(d_u, d_f), computed in float32, which unit vectors and spreads of 0.1 rad allow."""
        flat = directions.reshape(-1, 6).float()
        parts = [self._known(rows) for rows in flat.split(_ROWS)]
        known = torch.cat(parts).to(directions.dtype)
        return torch.logaddexp(known, known.new_tensor(self.broad)).view(directions.shape[:-1])

    def shares(self, directions: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch K"]:
        """Return the posterior of each component, the broad one last."""
        logs = self._logs(directions.reshape(-1, 6).float())
        logs = pad(logs, (0, 1), value=self.broad)
        return torch.softmax(logs, -1).to(directions.dtype).view(*directions.shape[:-1], -1)

    def _logs(self, rows: Float[Tensor, "N 6"]) -> Float[Tensor, "N K"]:
        """Return the log-density of each component of the mixture, times its weight."""
        off = torch.addmm(self.shift, rows, self.rows, beta=-1).square()
        squared = off.view(len(rows), *self.size).sum(1)
        return self.constant - 0.5 * squared

    def _known(self, rows: Float[Tensor, "N 6"]) -> Float[Tensor, " N"]:
        """Return the log-density of the mixture, without its broad part."""
        logs = self._logs(rows)
        most = logs.amax(-1, keepdim=True).detach()
        # exp of what is far below is slow where it is denormal, and adds nothing
        return (logs - most).clamp_min(_NOTHING).exp().sum(-1).log() + most[:, 0]


class ArmChain:
    """Point-mass filter over the directions of both bones of both arms.

    A hypothesis of the frame before moves to one of this frame by a heavy-tailed random walk on the
    directions, or is reinitialised from the prior:

        p(x' | x) = (1 - e) t_4(x'; x, s^2) + e p(x')

    Args:
        density: the log-density of the prior over directions. fps: frames per second.
    """

    def __init__(self, density: DirectionDensity, fps: float) -> None:
        self.density = density
        self.step = _STEP * math.sqrt(_RATE / fps)
        self.anew = 1 - (1 - _ANEW) ** (_RATE / fps)

    def hypotheses(self, arm: ArmInput, angles: int = _ANGLES, around: int = _AROUND) -> Arms:
        """Return hypotheses that agree with the measurements of each arm, given each hypothesis of the root.

        Args:
            arm: the measurements. angles: the number of angles of a bone whose end is measured.
            around: the number of directions of one whose end is not.
        """
        count = angles * angles
        both = min(around, _BOTH)
        sizes = {(True, True): (angles, angles), (True, False): (angles, around),
                 (False, True): (around, angles), (False, False): (both, both)}  # fmt: skip
        known = arm.known[..., None, :]
        patterns = {
            (upper, lower): (known[..., 0] == upper) & (known[..., 1] == lower)
            for upper in (True, False)
            for lower in (True, False)
        }
        there = {ends: here for ends, here in patterns.items() if bool(here.any())}
        found = {
            (upper, lower): self._weighed(arm, upper, lower, sizes[upper, lower], count)
            for upper, lower in there
        }
        first, *others = found
        arms = found[first]
        for ends in others:
            arms = _where(there[ends], found[ends], arms)
        return arms

    def _weighed(
        self, arm: ArmInput, upper: bool, lower: bool, sizes: tuple[int, int], count: int
    ) -> Arms:
        """Return the `count` hypotheses of largest weight, of arms whose elbow and hand are measured so."""
        lengths, noise = arm.lengths, self._noise(arm)
        start = arm.shoulder
        ray = arm.rays[:, :, None, 0].expand_as(start)
        first = (
            nodes_on_ray(start, ray, lengths[..., 0], noise[..., 0], sizes[0])
            if upper
            else nodes_anywhere(start, lengths[..., 0], sizes[0])
        )
        start = first.ends
        ray = arm.rays[:, :, None, None, 1].expand_as(start)
        if not upper:  # the elbow is known as well as its directions are dense
            grain = math.sqrt(4 * math.pi / sizes[0] / 12) * lengths[..., 0]
            noise = (noise.square() + grain.square()[..., None]).sqrt()
        length, std = (x[..., 1, None].expand(start.shape[:-1]) for x in (lengths, noise))
        second = (
            nodes_on_ray(start, ray, length, std, sizes[1])
            if lower
            else nodes_anywhere(start, length, sizes[1])
        )
        bones = first.directions[..., None, :].expand_as(second.directions), second.directions
        directions = torch.cat([bone.flatten(-3, -2) @ arm.axes.mT for bone in bones], -1)
        weight = (first.log_weight[..., None] + second.log_weight).flatten(-2)
        prior = self.density(directions)
        if weight.shape[-1] <= count:
            return Arms(directions, weight, prior)
        rows = (weight + prior).topk(count, -1).indices
        chosen = directions.gather(-2, rows[..., None].expand(*rows.shape, 6))
        return Arms(chosen, weight.gather(-1, rows), prior.gather(-1, rows))

    @staticmethod
    def _noise(arm: ArmInput) -> Float[Tensor, "B 2 M 2"]:
        """Return the standard deviation across the rays of elbow and hand, metres."""
        depth = arm.shoulder[..., 2:].clamp_min(0.1)
        slack = arm.slack.square()[:, None, None] + _SLACK**2
        return ((arm.std[:, :, None] * depth).square() + slack).sqrt()

    def evidence_of_both(self, arms: Arms) -> Float[Tensor, "B M"]:
        """Return the log of the prior predictive density of the measurements of both arms together.

        Given the torso each arm's likelihood is its own, and `ArmPrior.together` ties components:

            log p(z_l, z_r) = log p(z_l) + log p(z_r) + log sum_jk E_l[r_j] C_jk E_r[r_k]

        with the shares r of the components in each hypothesis, their means E over the likeliest
        hypotheses of an arm, and C_jk = A_jk / (pi_j pi_k).
        """
        logs = arms.log_weight + arms.log_prior
        logs, rows = logs.topk(min(_LIKELIEST, logs.shape[-1]), -1)
        chosen = arms.directions.gather(-2, rows[..., None].expand(*rows.shape, 6))
        weight = torch.softmax(logs, -1)[..., None, :]
        left, right = (weight @ self.density.shares(chosen))[..., 0, :].unbind(1)
        tied = ((left @ self.density.together) * right).sum(-1)
        return arms.log_evidence.sum(1) + tied.log()

    def start(self, arms: Arms) -> ArmState:
        """Return the posterior after the first frame, given one hypothesis of the root."""
        prior = arms.log_prior[:, :, 0].exp()
        return _belief(arms, prior, prior)

    def update(self, state: ArmState, arms: Arms) -> ArmState:
        """Return the posterior after one more frame."""
        prior = arms.log_prior[:, :, 0].exp()
        walk = self._walk(state.directions, arms.directions[:, :, 0])
        moved = (state.weight[..., None, :] @ walk)[..., 0, :]
        return _belief(arms, prior, (1 - self.anew) * moved + self.anew * prior)

    def smoothed(
        self, states: Sequence[ArmState], lengths: Tensor | None, lag: int | None
    ) -> list[ArmState]:
        """Return the posteriors given the later frames too (forward-backward algorithm).

        Args:
            states: the filtered posteriors of all frames. lengths: the number of frames of each sequence;
                None is all.
            lag: the number of later frames that an estimate may use; None is all.
        """
        n_frames = len(states)
        messages = [torch.ones_like(state.weight) for state in states]
        for _ in range(1 if lag is None else lag):
            # with a lag, each round takes the messages of the round before: one frame farther ahead
            source = messages if lag is None else list(messages)
            for t in range(n_frames - 2, -1, -1):
                messages[t] = self._backward_message(states[t], states[t + 1], source[t + 1])
                if lengths is not None:
                    ended = (lengths.to(messages[t].device) <= t + 1)[:, None, None]
                    messages[t] = torch.where(ended, 1.0, messages[t])
        weights = (state.weight * after for state, after in zip(states, messages, strict=True))
        weights = (w / w.sum(-1, keepdim=True) for w in weights)
        return [state._replace(weight=w) for state, w in zip(states, weights, strict=True)]

    def _backward_message(
        self, state: ArmState, later: ArmState, after: Tensor
    ) -> Float[Tensor, "B 2 N"]:
        """Return the backward message from the next frame, unnormalised.

        Args:
            state: the posterior of this frame. later: that of the next one.
            after: the backward message at the next frame.
        """
        ratio = later.weight / later.predicted.clamp_min(_LEAST) * after
        walk = self._walk(state.directions, later.directions)
        moved = (walk @ ratio[..., None])[..., 0]
        anew = (later.prior * ratio).sum(-1, keepdim=True)
        message = (1 - self.anew) * moved + self.anew * anew
        return message / message.amax(-1, keepdim=True).clamp_min(_LEAST)

    def _walk(self, before: Tensor, after: Tensor) -> Float[Tensor, "B 2 N M"]:
        """Return the density t_4(x'; x, s^2) of all pairs of directions of two frames."""
        scale = self.step**2
        alike = before @ after.mT  # of two pairs of unit vectors: 2 where they agree
        near = 1 / (1 + (2 - alike).clamp_min(0.0) / (2 * scale))
        return 6 / (16 * math.pi**2 * scale**2) * near.square().square()

    @staticmethod
    def mean_directions(state: ArmState, seen: Bool[Tensor, "B 2"]) -> Float[Tensor, "B 2 2 3"]:
        """Return the mean direction of each bone, upright axes.

        Args:
            state: the posterior. seen: whether elbow and hand are measured; if so the means have unit
                length.
        """
        mean = (state.weight[..., None] * state.directions).sum(-2).unflatten(-1, (2, 3))
        return torch.where(seen[..., None, None], normalize(mean, dim=-1), mean)


def _belief(arms: Arms, prior: Tensor, predicted: Float[Tensor, "B 2 N"]) -> ArmState:
    log_weight = arms.log_weight[:, :, 0] + predicted.clamp_min(_LEAST).log()
    evidence = torch.logsumexp(log_weight, -1)
    weight = (log_weight - evidence[..., None]).exp()
    return ArmState(arms.directions[:, :, 0], weight, evidence, prior, predicted)


def _where(here: Bool[Tensor, "B 2 1"], new: Arms, old: Arms) -> Arms:
    picks = zip((here[..., None, None], here[..., None], here[..., None]), new, old, strict=True)
    return Arms(*(torch.where(mask, a, b) for mask, a, b in picks))
