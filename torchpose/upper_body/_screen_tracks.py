"""Follow the place of each joint in the image, and a candidate for it, through outliers."""

import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.upper_body._noise_level import NoiseLevel
from torchpose.upper_body._screen_model import CERTAIN, TAKEOVER, ScreenModel

# Fields of `ScreenState` that hold a track and a candidate of each joint.
_TRACKS = ("position", "velocity", "cov", "evidence")

DOUBTFUL = 3.0
"""Log-odds phi below whose negative a place does not go with the other joints."""


class ScreenState(NamedTuple):
    """State between two frames: for each joint a track, and a candidate for its place.

    Attributes:
        position, velocity: [B, 2, 8, 2], pixels and pixels per second.
        cov: variance of a coordinate, its covariance with its velocity, and that one's [B, 2, 8, 3].
        evidence: seconds for which each was seen, at most so many as count [B, 2, 8].
        exchange: log-probability of each way to exchange left and right [B, X]. lasting: seconds for
            which they have been exchanged [B]. scales: log-probability of the person's sizes [B, G].
        level: how much noise there is.
    """

    position: Tensor
    velocity: Tensor
    cov: Tensor
    evidence: Tensor
    exchange: Tensor
    lasting: Tensor
    scales: Tensor
    level: NoiseLevel


def init_screen(model: ScreenModel, batch_size: int) -> ScreenState:
    """Return the state before the first frame of B streams: joints may be anywhere in the image."""
    like, n = model.low, batch_size
    middle, cov = (model.low + model.high) / 2, like.new_tensor([model.broad, 0.0, 0.0])
    return ScreenState(
        middle.repeat(n, 2, 8, 1), like.new_zeros(n, 2, 8, 2), cov.repeat(n, 2, 8, 1),
        like.new_zeros(n, 2, 8), not_exchanged(model, n), like.new_zeros(n), model.usual.repeat(n, 1),
        NoiseLevel.usual(n, model.dt, like),
    )  # fmt: skip


def not_exchanged(model: ScreenModel, batch_size: int) -> Float[Tensor, "B X"]:
    """Return the log-probability of each way of exchange where nothing is exchanged."""
    exchange = model.low.new_full((batch_size, len(model.exchanges)), -math.inf)
    exchange[:, 0] = 0.0
    return exchange


def predict_tracks(
    model: ScreenModel, state: ScreenState, square: Float[Tensor, "B 1 1"]
) -> ScreenState:
    """Return the state a frame later: velocities persist for a while, and spreads grow."""
    cov = torch.addcmul(state.cov @ model.moving, square[..., None], model.agitation)
    return state._replace(
        position=state.position.add(state.velocity, alpha=model.drift),
        velocity=model.kept * state.velocity,
        cov=cov * (model.broad / cov[..., :1]).clamp_max(1.0),
    )


def take_over(
    model: ScreenModel, state: ScreenState, odds: Tensor, body: Tensor, known: Tensor
) -> tuple[ScreenState, Float[Tensor, "B 2 8"]]:
    """Return the state in which candidates with more evidence have become the tracks, and the log-odds.

    Those of the tracks count what the other joints say (`body`), those of candidates not.

    Evidence is the time for which a track was seen, up to `TAKEOVER`. A place that does not go with the
    other joints needs more of it, and may need more than there can be.
    """
    (track, candidate), (of_track, of_candidate) = odds.unbind(1), state.evidence.unbind(1)
    candidate = candidate.masked_fill(of_candidate <= 0.0, -math.inf)
    total = track + body
    right, beside = total > 0, candidate > 0
    change = torch.where(right, -TAKEOVER, torch.where(beside, model.dt, -model.dt))
    of_track = (of_track + model.dt * (right & known)).clamp_max(TAKEOVER)
    of_candidate = (of_candidate + change * known).clamp(0.0, 2 * TAKEOVER)
    needed = of_track - TAKEOVER / (CERTAIN - DOUBTFUL) * (body + DOUBTFUL).clamp_max(0.0)
    taken = known & ~right & beside & (of_candidate > needed)
    state = state._replace(evidence=torch.stack([of_track, of_candidate], 1))
    if bool(taken.any()):
        order = torch.stack([taken, ~taken], 1).long()
        state = tracks_in_order(state, order, 1)
        track, candidate = in_order(torch.stack([track, candidate], 1), order, 1).unbind(1)
        total = track + body
    return state, torch.stack([total, candidate], 1)


def update_tracks(
    state: ScreenState, z: Tensor, noise: Tensor, weight: Float[Tensor, "B 2 8"]
) -> ScreenState:
    """Return both tracks after a pixel that is theirs with a probability: the moments of the mixture."""
    total = state.cov[..., 0] + noise[:, None]
    gains = state.cov[..., :2] / total[..., None]
    gain, turn = gains.unbind(-1)
    apart = z[:, None] - state.position
    change = weight * ((1 - weight) * apart.square().sum(-1) / 2.0 - total)
    squares = torch.stack([gain.square(), gain * turn, turn.square()], -1)
    forward, faster = (weight[..., None] * gains).chunk(2, -1)
    return state._replace(
        position=torch.addcmul(state.position, forward, apart),
        velocity=torch.addcmul(state.velocity, faster, apart),
        cov=torch.addcmul(state.cov, change[..., None], squares),
    )


def start_candidates(
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
    changed: dict[str, Any] = {}
    for name, value in started.items():
        track, candidate = getattr(state, name).unbind(1)
        at = new.reshape(*new.shape, *[1] * (value.ndim - 2))
        changed[name] = torch.stack([track, torch.where(at, value, candidate)], 1)
    return state._replace(**changed)


def tracks_in_order(state: ScreenState, order: Int[Tensor, "B #N 8"], dim: int) -> ScreenState:
    """Return the state with its tracks permuted; see `in_order`."""
    tracks: dict[str, Any] = {name: in_order(getattr(state, name), order, dim) for name in _TRACKS}
    return state._replace(**tracks)


def in_order(value: Tensor, order: Int[Tensor, "B #N 8"], dim: int) -> Tensor:
    """Return tracks [B, 2, 8, ...] permuted along `dim`: track and candidate (1), or the joints (2)."""
    return value.gather(dim, order.reshape(*order.shape, *[1] * (value.ndim - 3)).expand_as(value))
