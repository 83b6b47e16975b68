"""Follow how far away a torso is, how large, and how far its shoulders are turned, on a grid."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.skeleton._torso import upright_axes
from torchpose.upper_body._torso_likelihood import Root, Torso, TorsoLengths, torso_log_likelihood

# Metres, as the Kinect recordings have it, and of its log: others sit at webcams, or stand in halls.
_DEPTH, _DEPTH_STD = 2.6, 0.6
_NEAREST, _FARTHEST, _DEPTH_STEP = 0.4, 9.0, 0.04  # metres, and the step of log depth
_SIZES, _CELLS = 11, 2  # of torsos, and steps of log depth from one to the next
_TURN_STEP, _TURN_STD = 15.0, 20.0  # degrees
_BROAD_TURN = 0.2  # share of the turns that are all alike likely
_SPEED, _TURN_SPEED = 0.08, 60.0  # share of the depth, and degrees, after one second
_EVERY = 4  # steps of log depth between the depths of `RootGrid.at_all_depths`
_TOLERATED = 8.0  # nats by which arms may fit worse than at the best depth
_RULING = 0.2  # weight of what is beyond that
_MOST_SAID = 0.1  # nats of extrapolated evidence
_MOST = 500.0  # nats by which a cell may gain, which has next to no belief then
_LOST = 1e-6  # share of a frame's belief that restarts from the prior


class Moments(NamedTuple):
    """Moments of the belief about a torso, [B] each.

    Attributes:
        depth: the geometric mean of the depth, metres. size: that of the factor on `TorsoLengths`.
        of_depth, of_size: the variances of their logs.
    """

    depth: Tensor
    size: Tensor
    of_depth: Tensor
    of_size: Tensor


class RootGrid:
    """Point-mass filter over log depth z, the turn of the shoulders psi and the size s of the torso.

    The middle of the shoulders may be anywhere in the image. Given depth and turn, every measured
    joint of the torso says where it is, up to how stiff torsos are; what they disagree about is the
    evidence, with heavy tails (Student, 4 degrees of freedom). A torso that is s times as large looks like
    one at z / s, and stays as large: so a usual size at every frame is no evidence for it, and what arms
    say about the depth adds up.

    Args:
        fps: frames per second. like: tells dtype and device.
    """

    def __init__(self, fps: float, like: Tensor) -> None:
        n_depths = 1 + math.ceil(math.log(_FARTHEST / _NEAREST) / _DEPTH_STEP)
        beyond = _CELLS * (_SIZES // 2)
        steps = torch.arange(-beyond, n_depths + beyond, dtype=like.dtype, device=like.device)
        self._relative = _NEAREST * (_DEPTH_STEP * steps).exp()
        self.depth = self._relative[beyond:-beyond]
        self._log_depth = self.depth.log()
        self.log_size = _CELLS * _DEPTH_STEP * (steps[:_SIZES] - steps[_SIZES // 2])
        n_turns = round(360.0 / _TURN_STEP)
        degrees = _TURN_STEP * (torch.arange(n_turns, dtype=like.dtype) - n_turns // 2)
        self.turn = torch.deg2rad(degrees).to(like.device)
        self._axes = upright_axes(self.turn)
        usual = torch.softmax(-0.5 * (degrees / _TURN_STD).square(), 0).to(like.device)
        near = torch.softmax(
            -0.5 * ((self.depth.log() - math.log(_DEPTH)) / _DEPTH_STD).square(), 0
        )
        self.prior = ((1 - _BROAD_TURN) * usual + _BROAD_TURN / n_turns) * near[:, None]
        rows = torch.arange(n_depths).to(like) / _EVERY
        near = (1 - (rows[:, None] - rows[::_EVERY]).abs()).clamp_min(0.0)
        self._between = near / near.sum(1, keepdim=True)
        self._sides = torch.arange(2, device=like.device)[:, None]
        self._along = _share_that_moves(_SPEED / math.sqrt(fps), _DEPTH_STEP)
        share = _share_that_moves(_TURN_SPEED / math.sqrt(fps), _TURN_STEP)
        stays = torch.eye(n_turns).to(like)
        beside = stays.roll(1, 0) + stays.roll(-1, 0)
        self._round = (1 - _LOST) * ((1 - 2 * share) * stays + share * beside)

    def init(self, batch_size: int, spread: Float[Tensor, ""]) -> Float[Tensor, "B S Z P"]:
        """Return the belief before the first frame.

        Args:
            batch_size: B. spread: the standard deviation of the log of the size.
        """
        sizes = torch.softmax(-0.5 * (self.log_size / spread.clamp_min(1e-3)).square(), 0)
        belief = sizes[:, None, None] * self.prior
        return belief.expand(batch_size, *belief.shape)

    def predict(
        self, belief: Float[Tensor, "B S Z P"], farther: Float[Tensor, " B"] | None = None
    ) -> Float[Tensor, "B S Z P"]:
        """Return the predicted belief of the next frame: a random walk mixed with a restart from the prior.

        The size stays; a share of 1e-6 of the belief restarts from the prior over depth and turn.

        Args:
            belief: the belief of the frame before. farther: the log of the factor on the depth since then
                (`follow_size`); None is 0 for everybody.
        """
        moved = _diffused(belief, self._along) @ self._round
        if farther is not None:
            moved = _shifted(moved, farther / _DEPTH_STEP)
        anew = belief.sum((-2, -1), keepdim=True)
        return torch.addcmul(moved, anew, self.prior, value=_LOST)

    def likelihood(
        self, torso: Torso, lengths: TorsoLengths, power: Float[Tensor, " B"] | None = None
    ) -> Float[Tensor, "B S Z #P"]:
        """Return the likelihood of the torso's joints at every size, depth and turn, of largest value 1.

        Args:
            torso: the measured joints. lengths: the lengths of the torso. power: its exponent; None is 1.
        """
        turn = self.turn if torso.sided else self.turn[:1]
        shape = (len(torso.rays), len(self._relative), len(turn))
        relative = self._relative[:, None].expand(shape)
        logs = torso_log_likelihood(torso, relative, turn.expand(shape), lengths)
        logs = logs - logs.amax((1, 2), keepdim=True)
        found = (logs if power is None else power[:, None, None] * logs).exp()
        return found.unfold(1, len(self.depth), _CELLS).flip(1).mT

    def best(self, weight: Float[Tensor, "B S Z P"], count: int) -> Root:
        """Return the likeliest depths and turns, half of them turned to either side.

        A turn and its mirror image look alike, so that the wrong one may be the likelier for a while.

        Args:
            weight: the belief, of any sum. count: the number of both halves.
        """
        n_turns, half = len(self.turn), len(self.turn) // 2
        halves = weight.sum(1).unflatten(-1, (2, half)).movedim(2, 1).flatten(2)
        index = halves.topk(count // 2, -1).indices
        index = index // half * n_turns + index % half + half * self._sides
        return self._at(weight, index.flatten(1))

    def at_all_depths(self, weight: Float[Tensor, "B S Z P"]) -> Root:
        """Return the likeliest turn to either side at every fourth depth.

        Args:
            weight: the belief, of any sum.
        """
        n_turns, half = len(self.turn), len(self.turn) // 2
        halves = weight[:, :, ::_EVERY].sum(1).unflatten(-1, (2, half))
        depths = _EVERY * torch.arange(halves.shape[1], device=weight.device)
        index = depths[:, None] * n_turns + half * self._sides[:, 0] + halves.argmax(-1)
        return self._at(weight, index.flatten(1))

    def ruled_out(
        self, evidence: Float[Tensor, "B 2 N"], seen: Bool[Tensor, "B 2"]
    ) -> Float[Tensor, "B Z P"]:
        """Return the evidence against every cell, nats: 0 where arms may be that far away.

        One frame does not tell depths apart whose evidence is within some nats of the best, and tells the
        others apart as a later frame would. Of two arms the milder one counts for both, since a keypoint
        of the other may be an outlier.

        Args:
            evidence: the log-evidence of each arm at the hypotheses of `at_all_depths`.
            seen: whether elbow or hand of each arm are measured.
        """
        worse = evidence - evidence.amax(2, keepdim=True)
        agreed = torch.where(seen.all(1, keepdim=True), 2 * worse.amax(1), worse.sum(1))
        against = (self._between @ agreed.unflatten(1, (-1, 2)) + _TOLERATED).clamp_max(0.0)
        return _RULING * against.repeat_interleave(len(self.turn) // 2, -1)

    def _at(self, weight: Float[Tensor, "B S Z P"], index: Int[Tensor, "B M"]) -> Root:
        """Return the hypotheses of some cells of depth and turn.

        Args:
            weight: the belief, of any sum. index: the cells in the flat grid.
        """
        n_turns = len(self.turn)
        of_sizes = index[:, None].expand(-1, len(self.log_size), -1)
        share = weight.flatten(2).gather(2, of_sizes)
        total = share.sum(1)
        size = ((share.mT @ self.log_size) / total).exp()
        turns = index % n_turns
        return Root(
            self.depth[index // n_turns],
            self.turn[turns],
            size,
            total.log(),
            index,
            self._axes[turns],
        )

    def belief(
        self,
        weight: Float[Tensor, "B S Z P"],
        root: Root,
        evidence: Float[Tensor, "B M"],
        trend: Bool[Tensor, " B"],
    ) -> Float[Tensor, "B S Z P"]:
        """Return the posterior over the grid, given the evidence of the arms at some hypotheses.

        Cells that were not evaluated get the mean evidence of the hypotheses, or, with a trend, the
        evidence extrapolated linearly in log depth: hypotheses lie close together.

        Args:
            weight: the belief before, of any sum. root: the hypotheses that were evaluated.
            evidence: the log-evidence of the arms given each. trend: whether to extrapolate.
        """
        share = torch.log_softmax(root.log_weight, 1)
        usual = torch.logsumexp(share + evidence, 1, keepdim=True)
        more = trend[:, None].to(evidence) * self._trend(root, share.exp(), evidence)
        more = more[..., None].expand(-1, -1, len(self.turn))
        more = more.flatten(1).scatter(1, root.cell, (evidence - usual).clamp_max(_MOST))
        weighed = (weight.flatten(2) * more.exp()[:, None]).flatten(1)
        return (weighed / weighed.sum(1, keepdim=True)).view_as(weight)

    def _trend(
        self, root: Root, share: Float[Tensor, "B M"], evidence: Float[Tensor, "B M"]
    ) -> Float[Tensor, "B Z"]:
        """Return the evidence extrapolated over log depth, nats relative to that at the hypotheses' mean."""
        logs = root.depth.log()
        mean = (share * logs).sum(1, keepdim=True)
        off = share * (logs - mean)
        slope = (off * evidence).sum(1) / ((off * (logs - mean)).sum(1) + _DEPTH_STEP**2)
        along = slope[:, None] * (self._log_depth - mean)
        return along.clamp(-_MOST_SAID, _MOST_SAID)

    def moments(self, belief: Float[Tensor, "B S Z P"]) -> Moments:
        """Return the moments of depth and size."""
        both = belief.sum(-1)
        depth, of_depth = _mean_and_variance(both.sum(1), self._log_depth)
        size, of_size = _mean_and_variance(both.sum(2), self.log_size)
        return Moments(depth.exp(), size.exp(), of_depth, of_size)


def _mean_and_variance(
    share: Float[Tensor, "B N"], values: Float[Tensor, " N"]
) -> tuple[Tensor, Tensor]:
    """Return mean and variance of values under each belief, [B] each."""
    mean = share @ values
    return mean, (share @ values.square() - mean.square()).clamp_min(0.0)


def _share_that_moves(std: float, step: float) -> float:
    """Return the share of a cell that moves to either neighbour, for a walk of this standard deviation.

    It is a third at most. A walk of more than 0.8 steps is slowed to that, as the turn's at ten updates a
    second: 39 degrees after one second.
    """
    return min(0.5 * (std / step) ** 2, 1 / 3)


def _shifted(
    belief: Float[Tensor, "B S Z P"], steps: Float[Tensor, " B"]
) -> Float[Tensor, "B S Z P"]:
    """Return the belief moved by so many steps of depth, linearly between cells; the ends keep theirs."""
    rows = torch.arange(belief.shape[2], device=steps.device).to(steps)
    to = (rows + steps[:, None]).clamp(0, len(rows) - 1)
    share = (1 - (rows[:, None] - to[:, None]).abs()).clamp_min(0.0)
    return share[:, None] @ belief


def _diffused(belief: Float[Tensor, "B S Z P"], share: float) -> Float[Tensor, "B S Z P"]:
    """Return the belief after a share of each depth went to either neighbour; the ends keep theirs."""
    wider = torch.cat([belief[..., :1, :], belief, belief[..., -1:, :]], -2)
    beside = wider[..., :-2, :] + wider[..., 2:, :]
    return torch.add((1 - 2 * share) * belief, beside, alpha=share)
