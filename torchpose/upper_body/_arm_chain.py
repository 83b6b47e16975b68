"""Hold hypotheses about both arms, weigh them, and tie them from frame to frame."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import repeat
from typing import Any, NamedTuple, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.module_state import outside_inference
from torchpose.upper_body._absence import log_beyond
from torchpose.upper_body._arm_reach import loss_beyond_reach
from torchpose.upper_body._direction_density import DirectionDensity
from torchpose.upper_body._guessed_elbows import ElbowPull, pull_of_elbows
from torchpose.upper_body._lifted_arms import LiftedBones
from torchpose.upper_body._limb_nodes import (
    LimbNodes,
    flat_rows,
    nodes_anywhere,
    nodes_on_ray,
    take_rows,
)
from torchpose.upper_body._torso_occlusion import log_in_view

_ANGLES = 17  # directions of a bone whose end is measured
_AROUND = 150  # directions of a bone whose end is not measured
_BOTH = 68  # directions of each of two bones whose ends are not measured
_STEP = math.radians(10.0)  # step of a direction in a frame, at 30 frames a second
_ANEW = 0.2  # share of an arm's belief that is reinitialised in a frame at 30 frames a second
_STEP_UNSEEN, _ANEW_UNSEEN = math.radians(5.0), 0.02  # the same of arms whose hand is not measured
# Exponent of what later frames say of an arm whose hand is measured: they err as the frame itself does.
_LATER = 0.25
_RATE = 30.0
_LEAST = 1e-30  # density
# Pairs of directions for each hypothesis from which on, and share of them at most of which, densities are
# computed pair by pair.
_MANY, _FEW = 4, 2
_LIKELIEST = 32  # hypotheses of an arm that are compared with the other arm's
# Arms of which all pairs of directions are compared at a time: intermediate results stay in the cache.
_ARMS = 2


class ArmInput(NamedTuple):
    """Measurements of both arms, the right one mirrored, in upright axes, given M hypotheses of the root.

    Attributes:
        shoulder: metres, [B, 2, M, 3]. middle: that of both shoulders, [B, 2, M, 3].
        rays: the rays of elbow and hand, of length one, [B, 2, M, 2, 3].
        known: whether elbow and hand are measured, [B, 2, 2].
        patterns: the pairs of these that there are, for elbow and hand of any arm.
        variance: the variance across the rays of elbow and hand, metres squared, [B, 2, M, 2].
        axes: the rotation from camera to upright axes, [B, M, 3, 3].
        lengths: the lengths of both bones, metres, [B, 2, M, 2].
        borders: the planes of the image's borders, then the optical axis, [B, 2, M, P + 1, 3]; None where
            nothing is known of hands that are not measured. log_inside: see `Absence`, [B, 2].
        bones: the lifted upper arms and forearms, [B, 2, M, 2, 3] and [B, 2, 2]; None without any.
    """

    shoulder: Tensor
    middle: Tensor
    rays: Tensor
    known: Tensor
    patterns: Sequence[tuple[bool, bool]]
    variance: Tensor
    axes: Tensor
    lengths: Tensor
    borders: Tensor | None = None
    log_inside: Tensor | None = None
    bones: LiftedBones | None = None


class Arms(NamedTuple):
    """Hypotheses about both arms.

    Attributes:
        directions: the directions of upper arm and forearm, upright axes, [B, 2, M, N, 6].
        log_weight: the log of the likelihood times the node's share of the directions, [B, 2, M, N].
        log_prior: the log-density of the prior, [B, 2, M, N].
        log_told: the part of `log_weight` that lifted bones say, [B, 2, M, N]; None without any.
        hand_rays: the rays of the hands, upright axes, [B, 2, M, 3]; None while roots are weighed.
    """

    directions: Tensor
    log_weight: Tensor
    log_prior: Tensor
    log_told: Tensor | None = None
    hand_rays: Tensor | None = None

    @property
    def log_evidence(self) -> Float[Tensor, "B 2 M"]:
        """Return the log of the prior predictive density of the measurements of each arm."""
        return torch.logsumexp(self.log_weight + self.log_prior, -1)

    @property
    def mean_directions(self) -> Float[Tensor, "B 2 M 6"]:
        """Return the mean directions given each hypothesis of the root; not of unit length."""
        weight = torch.softmax(self.log_weight + self.log_prior, -1)
        return (weight[..., None, :] @ self.directions)[..., 0, :]


class ArmState(NamedTuple):
    """Posterior of both arms after a frame.

    Attributes:
        directions: the directions of the hypotheses, upright axes, [B, 2, N, 6].
        weight: their weights, normalised, [B, 2, N].
        log_evidence: the log-evidence of the frame's keypoints given the frames before, [B, 2].
        prior, predicted: the density of the prior, and that predicted from the frames before, at each
            hypothesis, [B, 2, N].
        seen: whether the hands are measured, [B, 2].
        pull: `ElbowPull.root`, 1 for arms without it. around: its mean about each hypothesis of the frame
            before, [B, 2, L].
    """

    directions: Tensor
    weight: Tensor
    log_evidence: Tensor
    prior: Tensor
    predicted: Tensor
    seen: Tensor
    pull: Tensor
    around: Tensor


class ArmChain:
    """Point-mass filter over the directions of both bones of both arms.

    A hypothesis of the frame before moves to one of this frame by a heavy-tailed random walk on the
    directions, or is reinitialised from the prior:

        p(x' | x) = (1 - e) t_4(x'; x, s^2) + e p(x')

    An arm whose hand is not measured moves less (s = 5 degrees, e = 0.02 at 30 frames a second, else 10 and
    0.2): what is not seen is best expected where it was. Above 30 frames a second steps are not smaller.

    An elbow that is not measured is pulled to where people have it when their hand is there
    (`pull_of_elbows`).

    Args:
        density: the log-density of the prior over directions. fps: frames per second.
    """

    def __init__(self, density: DirectionDensity, fps: float) -> None:
        self.density = density
        # Hypotheses are about as far apart as a step at 30 frames a second: a smaller one sticks to them.
        frames = max(_RATE / fps, 1.0)
        self.step, self.step_unseen = _STEP * math.sqrt(frames), _STEP_UNSEEN * math.sqrt(frames)
        self.anew = 1 - (1 - _ANEW) ** frames
        self.anew_unseen = 1 - (1 - _ANEW_UNSEEN) ** (_RATE / fps)

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
        if len(arm.patterns) == 1:
            (ends,) = arm.patterns
            return self._weighed(arm, ends, sizes[ends], count)
        # each arm for its own pattern alone
        known = arm.known.flatten(0, 1)
        parts = []
        for ends in arm.patterns:
            rows = (known == known.new_tensor(ends)).all(-1).nonzero()[:, 0]
            parts.append((rows, self._weighed(arm, ends, sizes[ends], count, rows)))
        order = torch.cat([rows for rows, _ in parts]).argsort()
        n_fields = 3 if arm.bones is None else 4
        columns = zip(*(cast(tuple[Tensor, ...], x[:n_fields]) for _, x in parts), strict=True)
        joined = (torch.cat(values, 1)[:, order] for values in columns)
        return Arms(*(value.view(*arm.known.shape[:2], *value.shape[2:]) for value in joined))

    def _weighed(
        self,
        arm: ArmInput,
        ends: tuple[bool, bool],
        sizes: tuple[int, int],
        count: int,
        rows: Int[Tensor, " A"] | None = None,
    ) -> Arms:
        """Return the `count` hypotheses of largest weight, of arms whose elbow and hand are measured so.

        Args:
            arm: the measurements of all arms. ends: whether elbow and hand are measured.
            sizes: the number of nodes of either bone. count: that of hypotheses. rows: the arms that are
                meant, which come as those of a single body; None is all of them.
        """
        upper, variance = _upper_nodes(arm, ends[0], sizes[0], rows)
        lower = _lower_nodes(arm, ends[1], sizes[1], (upper, variance), rows)
        weight = upper.log_weight[..., None] + lower.log_weight - loss_beyond_reach(upper, lower)
        if not ends[1] and arm.borders is not None and arm.log_inside is not None:
            borders = _taken(arm.borders, rows)[..., None, :, :]
            log_inside = _taken(arm.log_inside, rows)[..., None, None]
            weight = weight + log_beyond(
                lower.ends, borders[..., :-1, :], borders[..., -1, :], log_inside
            )
        if all(ends):
            places = torch.cat([upper.ends, lower.ends.flatten(-3, -2)], -2)
            in_view = log_in_view(places, upper.start, _taken(arm.middle, rows))
            of_elbow, of_hand = in_view.tensor_split(sizes[:1], -1)
            weight = weight + of_elbow[..., None] + of_hand.view(weight.shape)
        told = None
        if arm.bones is not None:
            told = _log_told(LiftedBones(*(_taken(part, rows) for part in arm.bones)), upper, lower)
            told = told.flatten(-2).expand_as(weight.flatten(-2))
        return self._likeliest(upper, lower, weight.flatten(-2), told, count)

    def _likeliest(
        self,
        upper: LimbNodes,
        lower: LimbNodes,
        seen: Float[Tensor, "*batch N"],
        told: Float[Tensor, "*batch N"] | None,
        count: int,
    ) -> Arms:
        """Return the hypotheses of largest weight, that of the prior included.

        Args:
            upper, lower: the nodes of both bones. seen, told: the log of the likelihood of all their pairs,
                by keypoints and by lifted bones. count: the number of hypotheses, at most.
        """
        weight = seen if told is None else seen + told
        uppers = upper.directions.expand_as(upper.ends)
        if weight.shape[-1] <= count:
            prior = self.density.of_arms(uppers, lower.axes, lower.turns).flatten(-2)
            shape = *upper.ends.shape[:-1], len(lower.turns), 3
            bones = uppers[..., None, :], lower.directions
            directions = torch.cat([bone.expand(shape) for bone in bones], -1).flatten(-3, -2)
            return Arms(directions, weight, prior, told)
        prior = self._prior(uppers, lower, weight, count)
        best = (weight + prior).topk(count, -1, sorted=False).indices
        return Arms(
            lower.chosen(uppers, flat_rows(best, weight.shape[-1])),
            weight.gather(-1, best),
            prior.gather(-1, best),
            None if told is None else told.gather(-1, best),
        )

    def _prior(
        self,
        uppers: Float[Tensor, "*batch U 3"],
        lower: LimbNodes,
        weight: Float[Tensor, "*batch N"],
        count: int,
    ) -> Float[Tensor, "*batch N"]:
        """Return the log-density of the prior at all pairs, or -inf where weights rule a pair out.

        The density has a least and a largest value, so a pair that is farther than their ratio below the
        weight of rank `count` is none of the `count` likeliest. Of forearms to hands that are measured few
        others are left.

        Args:
            uppers: the directions of the upper arms. lower, weight, count: as of `_likeliest`.
        """
        if weight.shape[-1] >= _MANY * count:
            least = weight.kthvalue(weight.shape[-1] - count + 1, -1, keepdim=True).values
            left = (weight >= least - self.density.log_ratio).flatten().nonzero()[:, 0]
            if len(left) * _FEW <= weight.numel():
                prior = self.density(lower.chosen(uppers, left))
                nothing = torch.full_like(weight, -torch.inf).flatten()
                return nothing.index_copy(0, left, prior).view_as(weight)
        return self.density.of_arms(uppers, lower.axes, lower.turns).flatten(-2)

    def evidence_of_both(self, arms: Arms) -> Float[Tensor, "B M"]:
        """Return the log of the prior predictive density of the measurements of both arms together.

        Given the torso each arm's likelihood is its own, and `ArmPrior.together` ties components:

            log p(z_l, z_r) = log p(z_l) + log p(z_r) + log sum_jk E_l[r_j] C_jk E_r[r_k]

        with the shares r of the components in each hypothesis, their means E over the likeliest
        hypotheses of an arm, and C_jk = A_jk / (pi_j pi_k).
        """
        logs = arms.log_weight + arms.log_prior
        logs, rows = logs.topk(min(_LIKELIEST, logs.shape[-1]), -1)
        chosen = take_rows(arms.directions, rows)
        weight = torch.softmax(logs, -1)[..., None, :]
        left, right = (weight @ self.density.shares(chosen))[..., 0, :].unbind(1)
        tied = ((left @ self.density.together) * right).sum(-1)
        return arms.log_evidence.sum(1) + tied.log()

    @staticmethod
    def start(arms: Arms, known: Bool[Tensor, "B 2 2"]) -> ArmState:
        """Return the posterior after the first frame, given one hypothesis of the root.

        Args:
            arms: the hypotheses. known: whether elbow and hand of both arms are measured.
        """
        prior = arms.log_prior[:, :, 0].exp()
        alone = torch.ones_like(prior)
        return _belief(arms, prior, prior, known[..., 1], alone, alone)

    def update(
        self,
        state: ArmState,
        arms: Arms,
        known: Bool[Tensor, "B 2 2"],
        again: Bool[Tensor, " B"] | None = None,
    ) -> ArmState:
        """Return the posterior after one more frame; see `start`.

        Args:
            again: whose arms start again, as if it were their first frame; None is nobody.
        """
        prior, (elbow, seen) = arms.log_prior[:, :, 0].exp(), known.unbind(-1)
        directions, pull = arms.directions[:, :, 0], None
        if arms.hand_rays is not None:
            rays, likelihood = arms.hand_rays[:, :, 0], arms.log_weight[:, :, 0]
            pull = pull_of_elbows(directions, prior, likelihood, rays, seen & ~elbow)
        moved, around = self._moved(state.weight, state.directions, directions, seen, pull)
        root = torch.ones_like(prior) if pull is None else pull.root
        moved = root * moved
        predicted = moved + self._anew(seen, prior) * (prior - moved)
        if again is not None:
            predicted = torch.where(again[:, None, None], prior, predicted)
        return _belief(arms, prior, predicted, seen, root, around)

    def _anew(self, seen: Bool[Tensor, "B 2"], like: Tensor) -> Float[Tensor, "B 2 1"]:
        """Return the share of each arm that is reinitialised in a frame."""
        shares = torch.full_like(like[..., :1], self.anew_unseen)
        return shares.masked_fill(seen[..., None], self.anew)

    def smoothed(
        self, states: Sequence[ArmState], lengths: Tensor | None, lag: int | None
    ) -> list[ArmState]:
        """Return the posteriors given the later frames too (forward-backward algorithm).

        With the filtered weight w and the backward message m of a hypothesis it is w m^c / sum w m^c, c = 1/4
        if the hand is measured. Frames of one motion err alike, so that with c = 1, which arms without a hand
        have, smoothed arms are worse than filtered ones.

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
        return [_given_later(state, after) for state, after in zip(states, messages, strict=True)]

    def _backward_message(
        self, state: ArmState, later: ArmState, after: Tensor
    ) -> Float[Tensor, "B 2 N"]:
        """Return the backward message from the next frame, unnormalised.

        Args:
            state: the posterior of this frame. later: that of the next one.
            after: the backward message at the next frame.
        """
        ratio = later.weight / later.predicted.clamp_min(_LEAST) * after
        pulled = later.pull * ratio
        moved, _ = self._moved(pulled, later.directions, state.directions, later.seen)
        moved = moved / later.around
        drawn = (later.prior * ratio).sum(-1, keepdim=True)
        message = moved + self._anew(later.seen, moved) * (drawn - moved)
        return message / message.amax(-1, keepdim=True).clamp_min(_LEAST)

    def _moved(
        self,
        weight: Float[Tensor, "B 2 N"],
        before: Tensor,
        after: Float[Tensor, "B 2 M 6"],
        seen: Bool[Tensor, "B 2"],
        pull: ElbowPull | None = None,
    ) -> tuple[Float[Tensor, "B 2 M"], Float[Tensor, "B 2 N"]]:
        """Return sum_n w_n t_4(x'_m; x_n, s^2) / a_n for the directions x of two frames, and a.

        Args:
            pull: that to x', for a; without it a is 1.
        """
        if not bool(seen.any()):
            return self._walked(weight, before, after, self.step_unseen)
        moved, around = self._walked(weight, before, after, self.step, pull)
        if not bool(seen.all()):
            unseen, _ = self._walked(weight, before, after, self.step_unseen)
            moved = torch.where(seen[..., None], moved, unseen)
        return moved, around

    @classmethod
    def _walked(
        cls,
        weight: Float[Tensor, "B 2 N"],
        before: Tensor,
        after: Float[Tensor, "B 2 M 6"],
        step: float,
        pull: ElbowPull | None = None,
    ) -> tuple[Float[Tensor, "B 2 M"], Float[Tensor, "B 2 N"]]:
        pulls = None if pull is None else pull.weighed
        moved, means = [], []
        for share, old, new, own in _some_arms(weight[:, :, None], before, after, pulls):
            walk = cls._walk(old, new, step)
            if own is not None:
                pulled, alone = torch.bmm(own, walk.mT).split(1, 1)
                means.append(pulled / alone)
                share = share / means[-1]
            moved.append(torch.bmm(share, walk))
        around = torch.cat(means).view_as(weight) if means else torch.ones_like(weight)
        return torch.cat(moved).view(*after.shape[:-1]), around

    @staticmethod
    def _walk(
        before: Float[Tensor, "A N 6"], after: Float[Tensor, "A M 6"], step: float
    ) -> Float[Tensor, "A N M"]:
        """Return the density t_4(x'; x, s^2) of all pairs of directions of two frames."""
        scale = step**2
        most = 6 / (16 * math.pi**2 * scale**2)
        unit = most**-0.25
        # of two pairs of unit vectors the product is 2 where they agree, and less elsewhere: far >= unit
        same = before.new_full((1, 1, 1), unit * (1 + 1 / scale))
        far = torch.baddbmm(same, before, after.mT, alpha=-unit / (2 * scale))
        # in place: memory for as many numbers again takes longer than the arithmetic
        return far.square_().pow_(-2)


def _taken(values: Float[Tensor, "B 2 *rest"], rows: Int[Tensor, " A"] | None) -> Tensor:
    """Return values of some arms as those of a single body, or of all arms as they are."""
    return values if rows is None else values.flatten(0, 1)[rows][None]


def _upper_nodes(
    arm: ArmInput, measured: bool, count: int, rows: Int[Tensor, " A"] | None
) -> tuple[LimbNodes, Tensor]:
    """Return nodes of upper arms, and the variance across the rays of elbow and hand given one of them.

    Args:
        arm, rows: as of `ArmChain._weighed`. measured: whether the elbow is. count: the number of nodes.
    """
    shoulder, lengths, variance = (
        _taken(values, rows) for values in (arm.shoulder, arm.lengths, arm.variance)
    )
    if measured:
        ray, std = _taken(arm.rays, rows)[..., 0, :], variance[..., 0].sqrt()
        return nodes_on_ray(shoulder, ray, lengths[..., 0], std, count), variance
    axes = _taken(_axes_of_spheres(arm.axes), rows)
    grain = (4 * math.pi / count / 12) * lengths[..., :1].square()  # elbows are as dense as that
    return nodes_anywhere(shoulder, lengths[..., 0], axes, count), variance + grain


def _lower_nodes(
    arm: ArmInput,
    measured: bool,
    count: int,
    upper: tuple[LimbNodes, Tensor],
    rows: Int[Tensor, " A"] | None,
) -> LimbNodes:
    """Return nodes of forearms from each node of the upper arms.

    Args:
        arm, rows: as of `ArmChain._weighed`. measured: whether the hand is. count: the number of nodes.
        upper: what `_upper_nodes` returns.
    """
    nodes, variance = upper
    length = _taken(arm.lengths, rows)[..., 1, None]
    if measured:
        ray, std = _taken(arm.rays, rows)[..., None, 1, :], variance[..., 1, None].sqrt()
        return nodes_on_ray(nodes.ends, ray, length, std, count)
    axes = _taken(_axes_of_spheres(arm.axes), rows)[..., None, :, :]
    return nodes_anywhere(nodes.ends, length, axes, count)


def _log_told(
    bones: LiftedBones, upper: LimbNodes, lower: LimbNodes
) -> Float[Tensor, "*batch U N"]:
    """Return the log-likelihood k (d^T v - 1) of all pairs of nodes, given the directions v of both bones."""
    k = bones.precision[..., None, :, None]
    upper_arm, forearm = bones.directions[..., None, :, :].unbind(-2)
    of_upper = k[..., 0, :] * ((upper.directions * upper_arm).sum(-1) - 1)
    of_lower = k[..., 1, :, None] * ((lower.directions * forearm[..., None, :]).sum(-1) - 1)
    return of_upper[..., None] + of_lower


def _given_later(state: ArmState, message: Float[Tensor, "B 2 N"]) -> ArmState:
    """Return the posterior with the backward message, to the power that it counts with."""
    power = torch.where(state.seen, _LATER, 1.0)[..., None]
    weight = state.weight * message.clamp_min(_LEAST).pow(power)
    return state._replace(weight=weight / weight.sum(-1, keepdim=True))


def _some_arms(*values: Tensor | None) -> Iterator[tuple[Any, ...]]:
    """Yield values of both arms of B bodies, `_ARMS` arms at a time; None where there are none."""
    chunks = [repeat(None) if x is None else x.flatten(0, 1).split(_ARMS) for x in values]
    yield from zip(*chunks, strict=False)


def _belief(
    arms: Arms,
    prior: Float[Tensor, "B 2 N"],
    predicted: Float[Tensor, "B 2 N"],
    seen: Bool[Tensor, "B 2"],
    pull: Float[Tensor, "B 2 N"],
    around: Float[Tensor, "B 2 L"],
) -> ArmState:
    log_weight = arms.log_weight[:, :, 0] + predicted.clamp_min(_LEAST).log()
    total = evidence = torch.logsumexp(log_weight, -1)
    if arms.log_told is not None:
        evidence = torch.logsumexp(log_weight - arms.log_told[:, :, 0], -1)
    weight = (log_weight - total[..., None]).exp()
    directions = arms.directions[:, :, 0]
    return ArmState(directions, weight, evidence, prior, predicted, seen, pull, around)


def _axes_of_spheres(axes: Float[Tensor, "B M 3 3"]) -> Float[Tensor, "B 2 M 3 3"]:
    """Return the camera's axes in upright ones, for left arms and for right arms of the mirror image."""
    return mirrored(mirrored(axes[:, None].expand(-1, 2, -1, -1, -1)).mT)


def mirrored(vectors: Float[Tensor, "B 2 *batch 3"]) -> Float[Tensor, "B 2 *batch 3"]:
    """Return vectors of both arms, with those of the right one mirrored."""
    return vectors * _signs(vectors.ndim - 3, vectors.dtype, vectors.device)


@cache
def _signs(count: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "2 *one 3"]:
    """Return the signs of the axes by which right arms are mirrored, with so many axes between."""
    with outside_inference():
        signs = torch.tensor([[1.0, 1.0, 1.0], [-1.0, 1.0, 1.0]], dtype=dtype, device=device)
        return signs.view(2, *[1] * count, 3)
