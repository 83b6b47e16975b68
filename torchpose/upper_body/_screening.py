"""Find keypoints that belong to no body: glitches of a detector, and left and right hand exchanged.

Every joint is followed by a small filter of its own, which asks of a measured pixel whether the joint can
have moved there and whether a body can have it there beside its other joints. What is improbable is
taken as missing, before any estimator sees it.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.upper_body._measurements import MeasuredJoints
from torchpose.upper_body._screen_model import (
    APART,
    BRISK,
    CERTAIN,
    OUTLIERS,
    SLACK,
    TAKEOVER,
    ScreenModel,
)

__all__ = ["ScreenState", "Screened", "advance_screen", "init_screen", "screen_joints"]

_LEFT, _RIGHT = UPPER_BODY.index("hand_left"), UPPER_BODY.index("hand_right")
_TRACKS = ("position", "velocity", "cov", "evidence")
_DOUBTFUL = 3.0  # of log phi: below that, a place does not go with the other joints
# Of OpenPose's wrists and elbows, beside the truth: the confidence at which every second is an outlier,
# and the step of confidence in which odds change by e.
_EVEN, _STEEP = 0.25, 0.06
_MOST = 30.0  # log-odds beyond which a joint tells the others no more


class ScreenState(NamedTuple):
    """State between two frames: for each joint a track, and a candidate for its place.

    Attributes:
        position, velocity: [B, 2, 8, 2], pixels and pixels per second.
        cov: variance of a coordinate, its covariance with its velocity, and that one's [B, 2, 8, 3].
        evidence: seconds for which each was seen, at most so many as count [B, 2, 8].
        exchange: log-probability of each way to exchange left and right [B, X]. lasting: seconds for
            which they have been exchanged [B]. scales: log-probability of the person's sizes [B, G].
    """

    position: Tensor
    velocity: Tensor
    cov: Tensor
    evidence: Tensor
    exchange: Tensor
    lasting: Tensor
    scales: Tensor


class Screened(NamedTuple):
    """Measurements that are probable.

    Attributes:
        measured: where improbable ones are missing, and exchanged ones exchanged back.
        probability: that a joint's measurement is one of it [B, T, 8]; NaN where nothing was given.
        exchanged: whether left and right hand were exchanged [B, T].
    """

    measured: MeasuredJoints
    probability: Tensor
    exchanged: Tensor


class _Odds(NamedTuple):
    """Log-odds of an inlier, and the probability that the joint is brisk where it is one."""

    total: Tensor
    brisk: Tensor


def screen_joints(
    model: ScreenModel | None, state: ScreenState | None, measured: MeasuredJoints
) -> tuple[ScreenState | None, Screened]:
    """Return the next state, and T more frames without outliers; without a model as they are.

    Args:
        model: None takes everything as it is. state: None before the first frame.
        measured: of T frames, in the prior's pixels.
    """
    if model is None:
        unknown = torch.full_like(measured.uv[..., 0], torch.nan)
        return None, Screened(measured, unknown, torch.zeros_like(measured.mask[..., 0]))
    return advance_screen(model, state or init_screen(model, len(measured.uv)), measured)


def init_screen(model: ScreenModel, batch_size: int) -> ScreenState:
    """Return the state before the first frame of B streams: joints may be anywhere in the image."""
    like, n = model.low, batch_size
    middle, cov = (model.low + model.high) / 2, like.new_tensor([model.broad, 0.0, 0.0])
    exchange = like.new_full((n, len(model.exchanges)), -math.inf)
    exchange[:, 0] = 0.0
    return ScreenState(
        middle.repeat(n, 2, 8, 1), like.new_zeros(n, 2, 8, 2), cov.repeat(n, 2, 8, 1),
        like.new_zeros(n, 2, 8), exchange, like.new_zeros(n), model.usual.repeat(n, 1),
    )  # fmt: skip


def advance_screen(
    model: ScreenModel, state: ScreenState, measured: MeasuredJoints
) -> tuple[ScreenState, Screened]:
    """Return the next state, and T more frames without the keypoints that are improbable.

    Of a measured pixel z of a joint with the predicted place x, variance P, J more where it is brisk,
        p = sigmoid(log ((1 - o) f(z) / (o u)) + log phi),
        f(z) = (1 - b) N(z; x, P + R) + b N(z; x, P + R + J),
    o and u the share and density of outliers, phi how well z goes with the other joints
    (`_beside_others`). The track becomes the mixture of what it would be with z and without; it goes on
    without where z does not go with the others, so that no outlier that stays draws it to its place.

    Args:
        state: from `init_screen` or the call before. measured: of T frames, in the prior's pixels.
    """
    with torch.no_grad():
        state, probability, way = _run(model, state, measured)
    joints = model.exchanges[way]
    screened = _screened(measured, probability, joints)
    given = measured.mask.gather(2, joints)
    return state, Screened(screened, probability.where(given, torch.nan), way > 0)


def _run(
    model: ScreenModel, state: ScreenState, measured: MeasuredJoints
) -> tuple[ScreenState, Float[Tensor, "B T 8"], Int[Tensor, "B T"]]:
    """Return the next state, and of each frame the inlier probabilities and the way of exchange."""
    uv = measured.uv.to(model.low)
    known = measured.mask & ((uv >= model.low) & (uv <= model.high)).all(-1)
    noise = _largest_variance(measured.cov.to(model.low)).expand(known.shape)
    ways = model.exchanges
    frames = (uv[:, :, ways], known[:, :, ways], noise[:, :, ways], _doubt(measured)[:, :, ways])
    probabilities, chosen = [], []
    for t in range(uv.shape[1]):
        state, probability, way = _step(model, state, *(x[:, t] for x in frames))
        probabilities.append(probability)
        chosen.append(way)
    return state, torch.stack(probabilities, 1), torch.stack(chosen, 1)


def _step(
    model: ScreenModel,
    state: ScreenState,
    uv: Float[Tensor, "B X 8 2"],
    known: Bool[Tensor, "B X 8"],
    noise: Float[Tensor, "B X 8"],
    doubt: Float[Tensor, "B X 8"],
) -> tuple[ScreenState, Float[Tensor, "B 8"], Int[Tensor, " B"]]:
    """Return the next state, the inlier probabilities of a frame, and the way of exchange."""
    scale = model.scale * (state.scales.exp() @ model.log_scales).exp()
    square = scale.square()[:, None, None]
    state = _predict(model, state, square)
    noise, jump = noise + SLACK**2 * square, square * model.jump
    if len(model.exchanges) > 1:
        track = state.position[:, :1], state.cov[:, :1]
        odds = _log_odds(model, *track, uv, known, noise, doubt, jump)
        hands = state.position[:, 0, _LEFT] - state.position[:, 0, _RIGHT]
        state, way = _exchange(model, state, odds, hands.norm(dim=-1) > APART * scale)
    else:
        way = torch.zeros(len(uv), dtype=torch.long, device=uv.device)
    rows = torch.arange(len(way), device=way.device)
    z, known, noise, doubt = (x[rows, way] for x in (uv, known, noise, doubt))
    both = _log_odds(
        model, state.position, state.cov, z[:, None], known[:, None], noise[:, None],
        doubt[:, None], jump,
    )  # fmt: skip
    change = both.brisk * jump
    changed = torch.stack([change, change / model.dt, change / model.dt**2], -1)
    body, scales = _beside_others(model, both.total[:, 0], z, known, noise, state.scales)
    state = state._replace(cov=state.cov + changed, scales=scales)
    state, total = _take_over(model, state, both.total, body, known)
    odds_now = torch.stack([total[:, 0] + body, total[:, 1]], 1)
    probability = odds_now.sigmoid() * known[:, None]
    nowhere = (probability < 0.5) & (body < -_DOUBTFUL)[:, None]
    state = _update(state, z, noise, torch.where(nowhere, 0.0, probability))
    new = known & (probability < 0.5).all(1) & (state.evidence[:, 1] <= 0)
    if bool(new.any()):
        state = _started(model, state, z, noise, square[:, 0], new)
    return state, probability[:, 0], way


def _predict(model: ScreenModel, state: ScreenState, square: Float[Tensor, "B 1 1"]) -> ScreenState:
    """Return the state a frame later: velocities persist for a while, and spreads grow."""
    cov = state.cov @ model.moving + square[..., None] * model.agitation
    return state._replace(
        position=state.position + model.drift * state.velocity,
        velocity=model.kept * state.velocity,
        cov=cov * (model.broad / cov[..., :1]).clamp_max(1.0),
    )


def _log_odds(
    model: ScreenModel,
    position: Float[Tensor, "B #N 8 2"],
    cov: Float[Tensor, "B #N 8 3"],
    uv: Float[Tensor, "B #N 8 2"],
    known: Bool[Tensor, "B #N 8"],
    noise: Float[Tensor, "B #N 8"],
    doubt: Float[Tensor, "B #N 8"],
    jump: Float[Tensor, "B 1 8"],
) -> _Odds:
    """Return log ((1 - o) f(z) / (o u)), 0 where nothing is measured; see `advance_screen`."""
    start = model.start - doubt
    half, calm = (uv - position).square().sum(-1) / 2, cov[..., 0] + noise
    brisk = calm + jump
    usual = start + math.log1p(-BRISK) - calm.log() - half / calm
    other = start + math.log(BRISK) - brisk.log() - half / brisk
    total = torch.logaddexp(usual, other)
    return _Odds(total * known, (other - total).exp() * (known & (total > 0)))


def _exchange(
    model: ScreenModel, state: ScreenState, odds: _Odds, apart: Bool[Tensor, " B"]
) -> tuple[ScreenState, Int[Tensor, " B"]]:
    """Return the most probable way to exchange left and right, and the state that knows it.

    It begins only where it puts both hands well on their tracks and these are apart: hands that meet may
    part in two ways. One that lasts is no exchange: the tracks are, and take the other side's place.
    """
    ways = model.exchanges
    fits = torch.nn.functional.softplus(odds.total).sum(-1)
    well = (odds.total > 0) & (odds.brisk < 0.5)
    clear = (well | (ways == ways[0])).all(-1) & apart[:, None]
    clear = clear | (state.lasting > 0)[:, None]
    clear[:, 0] = True
    log_weights = (state.exchange[:, :, None] + model.switching).logsumexp(1)
    log_weights = (log_weights + fits).masked_fill(~clear, -math.inf).log_softmax(-1)
    way = torch.where(log_weights[:, 0] < math.log(0.5), log_weights[:, 1:].argmax(-1) + 1, 0)
    lasting = torch.where(way > 0, state.lasting + model.dt, 0.0)
    turned = lasting > TAKEOVER
    state = state._replace(exchange=log_weights, lasting=lasting)
    if not bool(turned.any()):
        return state, way
    order = ways[torch.where(turned, way, 0)][:, None]
    none = torch.full_like(log_weights, -math.inf)
    none[:, 0] = 0.0
    state = state._replace(
        **{name: _in_order(getattr(state, name), order, 2) for name in _TRACKS},
        exchange=torch.where(turned[:, None], none, log_weights),
        lasting=torch.where(turned, 0.0, lasting),
    )
    return state, torch.where(turned, 0, way)


def _beside_others(
    model: ScreenModel,
    odds: Float[Tensor, "B 8"],
    z: Float[Tensor, "B 8 2"],
    known: Bool[Tensor, "B 8"],
    noise: Float[Tensor, "B 8"],
    scales: Float[Tensor, "B G"],
) -> tuple[Float[Tensor, "B 8"], Float[Tensor, "B G"]]:
    """Return how well each joint goes with the others, and the weights of the person's scales.

    For every subset of the joints that may be right, all are spread about one neck, which may be
    anywhere: phi = exp(-1/2 sum_i |z_i - s m_i - n|^2 / (s^2 sd_i^2 + R_i)) at the best n. The
    first result is the log of phi with the joint over phi without it, averaged over subsets and scales.
    """
    odds = odds.clamp(-_MOST, _MOST)
    precision = known[:, None] / (model.spread + noise[:, None])  # [B, G, 8]
    u, v = (z - z.mean(1, keepdim=True))[:, None].unbind(-1)
    v = v - model.below
    sums = [precision, precision * u, precision * v, precision * (u.square() + v.square())]
    total, first, second, square = (torch.stack(sums, 1) @ model.subsets.mT).unbind(1)
    best = (first.square() + second.square()) / total.clamp_min(1e-12)
    count = (known.to(z) @ model.subsets.mT - 1).clamp_min(0.0)[:, None]
    weights = (best - square) / 2 - 2 * count * model.log_scales[:, None]
    weights = scales[..., None] + weights + (odds @ model.subsets.mT)[:, None]
    of_scales = weights.logsumexp(-1)
    share = (weights - of_scales.amax(1)[:, None, None]).exp().sum(1)
    inside, outside = share @ model.subsets, share @ (1 - model.subsets)
    tiny = torch.finfo(share.dtype).tiny
    body = inside.clamp_min(tiny).log() - outside.clamp_min(tiny).log() - odds
    body = torch.where(known, body, 0.0).clamp_max(0.0)
    seen = model.memory * of_scales + (1 - model.memory) * model.usual
    return body, seen.log_softmax(-1)


def _take_over(
    model: ScreenModel, state: ScreenState, odds: Tensor, body: Tensor, known: Tensor
) -> tuple[ScreenState, Float[Tensor, "B 2 8"]]:
    """Return the state in which candidates whose evidence is larger are the tracks, and their odds.

    Evidence is the time for which a track was seen, up to `TAKEOVER`. A place that does not go with the
    other joints needs more of it, and may need more than there can be.
    """
    alive = state.evidence[:, 1] > 0
    odds = torch.stack([odds[:, 0], odds[:, 1].where(alive, -math.inf)], 1)
    right = odds[:, 0] + body > 0
    again = ~right & (odds[:, 1] > 0)
    change = torch.where(again, model.dt, torch.where(right, -TAKEOVER, -model.dt))
    evidence = torch.stack([
        (state.evidence[:, 0] + model.dt * (right & known)).clamp_max(TAKEOVER),
        (state.evidence[:, 1] + change * known).clamp(0.0, 2 * TAKEOVER),
    ], 1)  # fmt: skip
    doubt = -(body + _DOUBTFUL).clamp_max(0.0) / (CERTAIN - _DOUBTFUL)
    needed = evidence[:, 0] + TAKEOVER * doubt
    taken = known & again & (evidence[:, 1] > needed)
    state = state._replace(evidence=evidence)
    if not bool(taken.any()):
        return state, odds
    order = torch.stack([taken, ~taken], 1).long()
    tracks = {name: _in_order(getattr(state, name), order, 1) for name in _TRACKS}
    return state._replace(**tracks), _in_order(odds, order, 1)


def _update(
    state: ScreenState, z: Tensor, noise: Tensor, weight: Float[Tensor, "B 2 8"]
) -> ScreenState:
    """Return both tracks after a pixel that is theirs with a probability: the moments of the mixture."""
    pp, pv, vv = state.cov.unbind(-1)
    total = pp + noise[:, None]
    gain, turn = pp / total, pv / total
    apart = z[:, None] - state.position
    spread = weight * (1 - weight) * apart.square().sum(-1) / 2
    cov = [
        pp - weight * gain * pp + spread * gain.square(),
        pv - weight * gain * pv + spread * gain * turn,
        vv - weight * turn * pv + spread * turn.square(),
    ]
    return state._replace(
        position=state.position + (weight * gain)[..., None] * apart,
        velocity=state.velocity + (weight * turn)[..., None] * apart,
        cov=torch.stack(cov, -1),
    )


def _started(
    model: ScreenModel,
    state: ScreenState,
    z: Tensor,
    noise: Tensor,
    square: Tensor,
    new: Bool[Tensor, "B 8"],
) -> ScreenState:
    """Return the state with a new candidate at the measured pixels of these joints."""
    started = {
        "position": z, "velocity": torch.zeros_like(z),
        "cov": torch.stack([noise, torch.zeros_like(noise), square * model.speed], -1),
        "evidence": torch.full_like(noise, model.dt),
    }  # fmt: skip
    changed = {}
    for name, value in started.items():
        track, candidate = getattr(state, name).unbind(1)
        at = new.reshape(*new.shape, *[1] * (value.ndim - 2))
        changed[name] = torch.stack([track, torch.where(at, value, candidate)], 1)
    return state._replace(**changed)


def _in_order(value: Tensor, order: Int[Tensor, "B #N 8"], dim: int) -> Tensor:
    """Return tracks [B, 2, 8, ...] in another order: of track and candidate (1), or of the joints (2)."""
    return value.gather(dim, order.reshape(*order.shape, *[1] * (value.ndim - 3)).expand_as(value))


def _doubt(measured: MeasuredJoints) -> Float[Tensor, "B T 8"]:
    """Return by how much the log-odds of an inlier are lower than usual for want of confidence c.

    Those of a keypoint that a detector is unsure of are (c - 0.25) / 0.06.
    """
    if measured.confidence is None:
        return torch.zeros_like(measured.uv[..., 0])
    usual = math.log((1 - OUTLIERS) / OUTLIERS)
    return (usual - (measured.confidence - _EVEN) / _STEEP).clamp_min(0.0)


def _largest_variance(cov: Float[Tensor, "*batch 2 2"]) -> Float[Tensor, "*batch"]:
    """Return the larger eigenvalue."""
    (a, b), (c, d) = (row.unbind(-1) for row in cov.unbind(-2))
    return (a + d) / 2 + (((a - d) / 2).square() + b * c).clamp_min(0.0).sqrt()


def _screened(
    measured: MeasuredJoints, probability: Float[Tensor, "B T 8"], joints: Int[Tensor, "B T 8"]
) -> MeasuredJoints:
    """Return the measurements that are probable, of these joints; the same value if those are all."""
    uv, mask, cov = measured[:3]
    exchanged = bool((joints != torch.arange(8, device=mask.device)).any())
    if exchanged:
        mask = mask.gather(2, joints)
        uv = uv.gather(2, joints[..., None].expand_as(uv))
        if cov.ndim > 3:
            cov = cov.gather(2, joints[..., None, None].expand_as(cov))
    kept = mask & (probability >= 0.5)
    if not exchanged and bool((kept == mask).all()):
        return measured
    uv = torch.where(kept[..., None], uv, torch.zeros_like(uv))
    return measured._replace(uv=uv, mask=kept, cov=cov)
