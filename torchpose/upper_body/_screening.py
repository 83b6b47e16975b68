"""Find keypoints that belong to no body: glitches of a detector, and left and right hand exchanged.

Every joint is followed by a small filter of its own, which asks of a measured pixel whether the joint can
have moved there and whether a body can have it there beside its other joints. What is improbable is
taken as missing, before any estimator sees it. Where torsos shake more than R says, R is enlarged
(`follow_noise`).
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import linear

from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.upper_body._measured_joints import MeasuredJoints
from torchpose.upper_body._noise_level import follow_noise
from torchpose.upper_body._screen_model import (
    APART,
    OUTLIERS,
    SLACK,
    TAKEOVER,
    ScreenModel,
    largest_variance,
)
from torchpose.upper_body._screen_tracks import (
    DOUBTFUL,
    ScreenState,
    in_order,
    init_screen,
    not_exchanged,
    predict_tracks,
    start_candidates,
    take_over,
    tracks_in_order,
    update_tracks,
)

_LEFT, _RIGHT = UPPER_BODY.index("hand_left"), UPPER_BODY.index("hand_right")
# Of OpenPose's wrists and elbows, beside the truth: the confidence at which every second is an outlier,
# and the step of confidence in which odds change by e.
_EVEN, _STEEP = 0.25, 0.06
_MOST = 30.0  # log-odds beyond which a joint tells the others no more


class Screened(NamedTuple):
    """Measurements without outliers.

    Attributes:
        measured: the measurements; outliers are missing, and exchanged hands exchanged back.
        probability: the probability that the measurement of a joint is no outlier, [B, T, 8]; NaN where
            nothing was given.
        exchanged: whether left and right hand were exchanged, [B, T].
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
        model: the model of the screening; None takes everything as it is. state: None before the first
            frame. measured: the measurements of T frames, in the prior's pixels.
    """
    if model is None:
        unknown = torch.full_like(measured.uv[..., 0], torch.nan)
        return None, Screened(measured, unknown, torch.zeros_like(measured.mask[..., 0]))
    return advance_screen(model, state or init_screen(model, len(measured.uv)), measured)


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
        state: from `init_screen` or the previous call. measured: the measurements of T frames, in the
            prior's pixels.
    """
    with torch.no_grad():
        state, probability, way, factor = _run(model, state, measured)
    measured = _noisier(measured, factor)
    exchanged = way > 0
    joints = model.exchanges[way] if bool(exchanged.any()) else None
    given = measured.mask if joints is None else measured.mask.gather(2, joints)
    screened = _screened(measured, probability, joints)
    return state, Screened(screened, probability.where(given, torch.nan), exchanged)


def _run(
    model: ScreenModel, state: ScreenState, measured: MeasuredJoints
) -> tuple[ScreenState, Float[Tensor, "B T 8"], Int[Tensor, "B T"], Float[Tensor, "B T"]]:
    """Return the next state, and of each frame inlier probabilities, the way of exchange, and R's factor."""
    uv = measured.uv.to(model.low)
    known = measured.mask & (uv.clamp(model.low, model.high) == uv).all(-1)
    usual = measured.cov is model.cov
    noise = model.noise if usual else largest_variance(measured.cov.to(model.low))
    noise, ways, doubts = noise.expand(known.shape), model.exchanges, _doubt(measured)
    frames = (uv[:, :, ways], known[:, :, ways], noise[:, :, ways])
    doubts = None if doubts is None else doubts[:, :, ways]
    probabilities, factors, chosen = [], [], torch.zeros_like(known[..., 0], dtype=torch.long)
    for t in range(uv.shape[1]):
        z, there, variance = (x[:, t] for x in frames)
        doubt = None if doubts is None else doubts[:, t]
        level, scale = state.level, _scale(model, state)
        factors.append(level.factor)
        variance = factors[-1][:, None, None] * variance
        state, probability, way = _step(model, state, scale, z, there, variance, doubt)
        kept = known[:, t] & (probability >= 0.5)
        level = follow_noise(level, uv[:, t], kept, noise[:, t], scale, model.dt)
        state = state._replace(level=level)
        probabilities.append(probability)
        if way is not None:
            chosen[:, t] = way
    return state, torch.stack(probabilities, 1), chosen, torch.stack(factors, 1)


def _step(
    model: ScreenModel,
    state: ScreenState,
    scale: Float[Tensor, " B"],
    uv: Float[Tensor, "B X 8 2"],
    known: Bool[Tensor, "B X 8"],
    noise: Float[Tensor, "B X 8"],
    doubt: Float[Tensor, "B X 8"] | None,
) -> tuple[ScreenState, Float[Tensor, "B 8"], Int[Tensor, " B"] | None]:
    """Return the next state, the inlier probabilities of a frame, and the way of exchange; None is 0."""
    square = scale.square()[:, None, None]
    state = predict_tracks(model, state, square)
    noise, jump = noise + SLACK**2 * square, square * model.jump
    odds = _log_odds(model, state, uv, known, noise, doubt, jump[:, None])
    hands = state.position[:, 0, _LEFT] - state.position[:, 0, _RIGHT]
    apart = torch.linalg.vector_norm(hands, dim=-1) > APART * scale
    state, odds, way = _exchange(model, state, odds, apart)
    z, known, noise = (_of_way(x, way) for x in (uv, known, noise))
    body, scales = _beside_others(model, odds.total[:, 0], z, known, noise, state.scales)
    change = (odds.brisk * jump)[..., None] * model.lurch
    state = state._replace(cov=state.cov + change, scales=scales)
    state, total = take_over(model, state, odds.total, body, known)
    probability = total.sigmoid() * known[:, None]
    wrong = probability < 0.5
    nowhere = wrong & (body < -DOUBTFUL)[:, None]
    state = update_tracks(state, z, noise, probability.masked_fill(nowhere, 0.0))
    new = known & wrong.all(1) & (state.evidence[:, 1] <= 0.0)
    if bool(new.any()):
        state = start_candidates(model, state, z, noise, square[:, 0], new)
    return state, probability[:, 0], way


def _scale(model: ScreenModel, state: ScreenState) -> Float[Tensor, " B"]:
    """Return the expected scale of each person, pixels for each metre."""
    return model.scale * (state.scales.exp() @ model.log_scales).exp()


def _log_odds(
    model: ScreenModel,
    state: ScreenState,
    uv: Float[Tensor, "B X 8 2"],
    known: Bool[Tensor, "B X 8"],
    noise: Float[Tensor, "B X 8"],
    doubt: Float[Tensor, "B X 8"] | None,
    jump: Float[Tensor, "B 1 1 8"],
) -> _Odds:
    """Return log ((1 - o) f(z) / (o u)) of tracks and candidates for each way of exchange, [B, 2, X, 8].

    It is 0 where nothing is measured; see `advance_screen`.
    """
    apart = (uv[:, None] - state.position[:, :, None]).square().sum(-1)
    calm = state.cov[:, :, None, :, 0] + noise[:, None]
    variance = torch.stack([calm, calm + jump], -1)
    logs = model.start - variance.log()
    densities = torch.addcdiv(logs, apart[..., None], variance, value=-0.5)
    usual, brisk = densities.unbind(-1)
    either, known = torch.logaddexp(usual, brisk), known[:, None]
    total = either if doubt is None else either - doubt[:, None]
    return _Odds(total * known, (brisk - either).exp() * (known & (total > 0.0)))


def _exchange(
    model: ScreenModel, state: ScreenState, odds: _Odds, apart: Bool[Tensor, " B"]
) -> tuple[ScreenState, _Odds, Int[Tensor, " B"] | None]:
    """Return the state after the most probable way to exchange left and right, its odds, and the way.

    It begins only where it puts both hands well on their tracks and these are apart: hands that meet may
    part in two ways. One that lasts is no exchange: the tracks are, and take the other side's place. Where
    none may begin, as in most frames, the way is None.
    """
    ways, track = model.exchanges, odds.total[:, 0]
    ill = model.exchanged & ((track <= 0.0) | (odds.brisk[:, 0] >= 0.5))
    begun = state.lasting > 0.0
    barred = (ill.any(-1) | ~apart[:, None]) & ~begun[:, None] & model.exchanged.any(1)
    if bool(barred[:, 1:].all()):
        state = state._replace(exchange=not_exchanged(model, len(track)))
        return state, _Odds(*(_of_way(x, None, 2) for x in odds)), None
    fits = torch.nn.functional.softplus(track).sum(-1)
    log_weights = (state.exchange[:, :, None] + model.switching).logsumexp(1)
    log_weights = (log_weights + fits).masked_fill(barred, -math.inf).log_softmax(-1)
    way = torch.where(log_weights[:, 0] < math.log(0.5), log_weights[:, 1:].argmax(-1) + 1, 0)
    lasting = torch.where(way > 0, state.lasting + model.dt, 0.0)
    turned = lasting > TAKEOVER
    state = state._replace(exchange=log_weights, lasting=lasting)
    odds = _Odds(*(_of_way(x, way, 2) for x in odds))
    if not bool(turned.any()):
        return state, odds, way
    order = ways[torch.where(turned, way, 0)][:, None]
    none = not_exchanged(model, len(track))
    state = tracks_in_order(state, order, 2)._replace(
        exchange=torch.where(turned[:, None], none, log_weights),
        lasting=torch.where(turned, 0.0, lasting),
    )
    odds = _Odds(*(in_order(x, order, 2) for x in odds))
    return state, odds, torch.where(turned, 0, way)


def _of_way(values: Tensor, way: Int[Tensor, " B"] | None, dim: int = 1) -> Tensor:
    """Return the values of each stream's way of exchange, along this dimension; None is 0."""
    if way is None:
        return values.select(dim, 0)
    return values.movedim(dim, 1)[torch.arange(len(way), device=way.device), way]


def _beside_others(
    model: ScreenModel,
    odds: Float[Tensor, "B 8"],
    z: Float[Tensor, "B 8 2"],
    known: Bool[Tensor, "B 8"],
    noise: Float[Tensor, "B 8"],
    scales: Float[Tensor, "B G"],
) -> tuple[Float[Tensor, "B 8"], Float[Tensor, "B G"]]:
    """Return the log-odds phi of each joint given the others, and the log-probability of each body scale.

    For every subset of the joints that may be right, all are spread about one neck, which may be
    anywhere: phi = exp(-1/2 sum_i |z_i - s m_i - n|^2 / (s^2 sd_i^2 + R_i)) at the best n. The
    first result is the log of phi with the joint over phi without it, averaged over subsets and scales.
    """
    odds = odds.clamp(-_MOST, _MOST)
    precision = (known[:, None] / (model.spread + noise[:, None]))[..., None]  # [B, G, 8, 1]
    apart = (z - z.mean(1, keepdim=True))[:, None] - model.below
    pulled = precision * apart
    sums = model.subsets @ torch.cat([precision, pulled, pulled * apart], -1)  # [B, G, S, 5]
    total, pull, square = sums.split([1, 2, 2], -1)
    misfit = (square - pull.square() / total.clamp_min(1e-12)).sum(-1)
    count = (linear(known.to(z), model.subsets) - 1.0).clamp_min(0.0)
    weights = (
        linear(odds, model.subsets)[:, None] - 2.0 * count[:, None] * model.log_scales[:, None]
    )
    weights = (scales[..., None] + weights).sub(misfit, alpha=0.5)
    of_scales = weights.logsumexp(-1, keepdim=True)
    share = (weights - of_scales.amax(1, keepdim=True)).exp().sum(1)
    tiny = torch.finfo(share.dtype).tiny
    inside, outside = (share @ model.with_without).clamp_min(tiny).log().split(8, -1)
    body = (inside - outside - odds).clamp_max(0.0) * known
    return body, model.usual.lerp(of_scales[..., 0], model.memory).log_softmax(-1)


def _doubt(measured: MeasuredJoints) -> Float[Tensor, "B T 8"] | None:
    """Return the reduction of the log-odds of an inlier by a low confidence c of the detector, or None.

    The log-odds are those of the share of outliers, but at most (c - 0.25) / 0.06.
    """
    if measured.confidence is None:
        return None
    usual = math.log((1 - OUTLIERS) / OUTLIERS)
    return (usual - (measured.confidence - _EVEN) / _STEEP).clamp_min(0.0)


def _noisier(measured: MeasuredJoints, factor: Float[Tensor, "B T"]) -> MeasuredJoints:
    """Return measurements with R times its factor, and so less sure; the same value if it is 1 everywhere."""
    if bool((factor == 1.0).all()):
        return measured
    factor = factor.to(measured.cov)[..., None]
    of_joints = factor[..., None, None]
    middle, sure = measured.middle, measured.confidence
    if middle is not None:
        middle = middle._replace(cov=of_joints[..., 0] * middle.cov)
    sure = torch.ones_like(measured.uv[..., 0]) if sure is None else sure
    return measured._replace(cov=of_joints * measured.cov, middle=middle, confidence=sure / factor)


def _screened(
    measured: MeasuredJoints,
    probability: Float[Tensor, "B T 8"],
    joints: Int[Tensor, "B T 8"] | None,
) -> MeasuredJoints:
    """Return the measurements that are probable, of these joints; the same value if those are all.

    None are the joints as they are.
    """
    uv, mask, cov = measured[:3]
    sure = measured.confidence
    if joints is not None:
        mask = mask.gather(2, joints)
        uv = uv.gather(2, joints[..., None].expand_as(uv))
        if cov.ndim > 3:
            cov = cov.gather(2, joints[..., None, None].expand_as(cov))
        if sure is not None:
            sure = sure.gather(2, joints)
    kept = mask & (probability >= 0.5)
    if joints is None and bool((kept == mask).all()):
        return measured
    uv = torch.where(kept[..., None], uv, torch.zeros_like(uv))
    if sure is not None:
        sure = torch.where(kept, sure, torch.ones_like(sure))
    return measured._replace(uv=uv, mask=kept, cov=cov, confidence=sure)
