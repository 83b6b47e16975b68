"""Check frames of silhouettes, and score how well states explain them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool
from torch import Tensor

from torchpose._core.checks import check_shape, check_tensors
from torchpose.errors import InputError, ShapeError
from torchpose.filters._recursive_filter import Generators, check_generators
from torchpose.whole_body._keypoints.particle_likelihood import (
    KeypointMeasurement,
    keypoint_log_likelihood,
)
from torchpose.whole_body._silhouettes.likelihood import LIKELIHOODS
from torchpose.whole_body._silhouettes.rendering import (
    PreparedSilhouettes,
    count_pixels,
    prepare_silhouettes,
)

Score = Callable[[Tensor], Tensor]
Likelihood = Callable[[Tensor, Tensor], Tensor]

# Shares below which a silhouette is specks: of the area in which the body is expected there (specks that an
# empty scene leaves had up to 7 %, persons 70 % and more), and of the image if it is expected beside that.
_OF_BODY, _OF_IMAGE = 0.1, 0.002


class Frame(NamedTuple):
    """Holds the observation of one frame, and the score of states under it.

    Attributes:
        score: states [B, N, D] -> sharpened log-likelihood [B, N], float64; 0 in elements that nobody
            sees.
        seen: [B], False where the frame is empty.
        silhouettes: `PreparedSilhouettes` of [B, C, H, W]; with a callable as the likelihood, what it
            is given; None where there are keypoints alone. cameras: as handed to the filter.
        keypoints: of the frame, or None. outlined: [B], whether there is a silhouette; as `seen` if None.
    """

    score: Score
    seen: Bool[Tensor, " B"]
    silhouettes: Any
    cameras: Any
    keypoints: KeypointMeasurement | None = None
    outlined: Bool[Tensor, " B"] | None = None


def silhouette_score(
    body: Any,
    silhouettes: Tensor | PreparedSilhouettes,
    cameras: Any,
    likelihood: str,
    limb_shape: str = "cylinders",
) -> Score:
    """Return the function from states [B, N, D] to the log-likelihood [B, N] of one frame's silhouettes.

    Args:
        silhouettes: [B, C, H, W]. cameras: the C cameras. likelihood: "bidirectional" or "overlap".
        limb_shape: "cylinders" or "rectangles".
    """
    prepared = prepare_silhouettes(silhouettes)

    def score(states: Tensor) -> Tensor:
        counts = count_pixels(body, states, cameras, prepared, limb_shape=limb_shape)
        return LIKELIHOODS[likelihood](counts)

    return score


def see_frame(
    body: Any,
    expected: Tensor,
    observed: Tensor,
    cameras: Any,
    likelihood: str | Likelihood,
    sharpness: float,
    limb_shape: str,
) -> Frame:
    """Return the frame of some observations, with the exponent of the likelihood.

    Args:
        expected: the states [B, D] of which silhouettes are expected.
        observed: silhouettes [B, C, H, W], or what a callable takes. cameras: the C cameras.
        likelihood, sharpness, limb_shape: as `SilhouetteParticleFilter`.
    """
    if callable(likelihood):
        seen = is_seen(observed)
        raw: Score = lambda states: likelihood(states, observed)  # noqa: E731
        return Frame(_sharpened(raw, sharpness, seen), seen, observed, cameras)
    prepared = without_specks(body, expected, observed, cameras, limb_shape)
    seen = prepared.area.any(-1)
    raw = silhouette_score(body, prepared, cameras, likelihood, limb_shape)
    return Frame(_sharpened(raw, sharpness, seen), seen, prepared, cameras)


def with_keypoints(body: Any, frame: Frame | None, measured: KeypointMeasurement | None) -> Frame:
    """Return a frame whose keypoints are scored as well: log-likelihoods of both add.

    Args:
        body: whose joints the keypoints are of. frame: of silhouettes, or None. measured: keypoints, or None.

    Raises:
        InputError: neither of both.
    """
    if measured is None:
        if frame is None:
            raise InputError("a frame needs silhouettes or keypoints, got neither")
        return frame
    own = measured

    def score(states: Tensor) -> Tensor:
        value = keypoint_log_likelihood(own, body.joints(states))
        return value if frame is None else value + frame.score(states)

    if frame is None:
        return Frame(score, own.seen, None, None, own, torch.zeros_like(own.seen))
    return Frame(score, frame.seen | own.seen, frame.silhouettes, frame.cameras, own, frame.seen)


def _sharpened(raw: Score, sharpness: float, seen: Bool[Tensor, " B"]) -> Score:
    """Return the log-likelihood times its exponent; 0 for elements without a silhouette."""
    nobody = not bool(seen.any())

    def score(states: Tensor) -> Tensor:
        if nobody:
            return states.new_zeros(states.shape[:2], dtype=torch.float64)
        value = raw(states)
        check_tensors(**{"what likelihood returns": value})
        check_shape("what likelihood returns", value, list(states.shape[:2]))
        value = sharpness * value.double()
        value = torch.where(torch.isfinite(value), value, -torch.inf)
        return torch.where(seen[:, None], value, 0.0)

    return score


def without_specks(
    body: Any, expected: Tensor, silhouettes: Tensor, cameras: Any, limb_shape: str = "cylinders"
) -> PreparedSilhouettes:
    """Return silhouettes [B, C, H, W], those empty that are too small for the body that is expected.

    Args:
        expected: its states [B, D]. cameras: the C cameras. limb_shape: "cylinders" or "rectangles".
    """
    prepared = prepare_silhouettes(silhouettes)
    if not bool(prepared.area.any()):
        return prepared
    shown = count_pixels(body, expected[:, None], cameras, prepared, limb_shape=limb_shape).model
    anywhere = _OF_IMAGE * silhouettes[0, 0].numel()
    least = torch.where(shown > 0, _OF_BODY * shown, anywhere)[:, 0].to(prepared.area.device)
    specks = (prepared.area > 0) & (prepared.area < least)
    if not bool(specks.any()):
        return prepared
    return prepare_silhouettes(silhouettes & ~specks[..., None, None])


def is_seen(observed: Tensor) -> Bool[Tensor, " B"]:
    """Tell whether anything is observed: a True pixel, or a number that is not NaN."""
    known = observed if observed.dtype == torch.bool else ~torch.isnan(observed)
    return known.flatten(1).any(1)


def seen_until(inside: Bool[Tensor, " B"], observed: Tensor) -> Tensor:
    """Return the observations [B, ...] with nothing seen in the sequences that are over.

    Whole numbers, which a callable may take, have no value for that, and stay.
    """
    if observed.dtype != torch.bool and not observed.is_floating_point():
        return observed
    over = ~inside.to(observed.device).view(-1, *[1] * (observed.ndim - 1))
    return observed.masked_fill(over, False if observed.dtype == torch.bool else torch.nan)


def check_sequences(
    observed: Tensor, initial_state: Tensor, generator: Generators, dim: int, *, plain: bool
) -> tuple[Tensor, Tensor, bool]:
    """Return observations [B, T, ...], initial states [B, D], and whether a batch was given.

    Args:
        observed, initial_state, generator: as `SilhouetteParticleFilter.forward`. dim: D.
        plain: whether the observations are silhouettes; otherwise any tensor that a callable takes.

    Raises:
        ShapeError, InputError: as `SilhouetteParticleFilter.forward`.
    """
    check_tensors(silhouettes=observed, initial_state=initial_state)
    if observed is None or initial_state is None:
        raise InputError("silhouettes and an initial_state must be given, got None")
    check_shape("initial_state", initial_state, ["...", dim])
    if initial_state.ndim > 2:
        raise ShapeError(f"initial_state must be [D] or [B, D], got {list(initial_state.shape)}")
    batched = initial_state.ndim == 2
    if plain:
        if observed.ndim not in (4, 5):
            raise ShapeError(
                "silhouettes must have shape [T, C, H, W] or [B, T, C, H, W], "
                f"got {list(observed.shape)}"
            )
        several = observed.ndim == 5
        _check_silhouettes(observed)
    else:
        several = batched
    frames = observed if several else observed[None]
    start = initial_state if batched else initial_state[None]
    sizes = {len(frames), len(start)} - {1}
    if len(sizes) > 1 or 0 in sizes or 0 in frames.shape[:2]:
        raise ShapeError(
            "silhouettes and initial_state must hold the same number of sequences, at least one "
            f"of one frame; got {list(observed.shape)} and {list(initial_state.shape)}"
        )
    batch = max(len(frames), len(start))
    check_generators(generator, batch)
    frames, start = frames.expand(batch, *frames.shape[1:]), start.expand(batch, -1)
    return frames, start, batched or several


def check_observation(
    observed: Tensor, batch: int, generator: Generators, *, plain: bool, frames: bool = False
) -> None:
    """Raise unless this is a frame [B, ...], or are frames [B, T, ...], of B sequences, and generators suit.

    Raises:
        ShapeError, InputError: as `SilhouetteParticleFilter.step` and `advance`.
    """
    check_tensors(silhouettes=observed)
    sizes = ["B", *["T"] * frames, "C", "H", "W"]
    if observed.ndim <= frames or len(observed) != batch or (frames and not observed.shape[1]):
        raise ShapeError(
            f"silhouettes must hold one frame{' or more' * frames} for each of the {batch} elements of the "
            f"state, [{', '.join(sizes)}]; got {list(observed.shape)}"
        )
    if plain:
        check_shape("silhouettes", observed, sizes)
        _check_silhouettes(observed)
    check_generators(generator, batch)


def _check_silhouettes(silhouettes: Tensor) -> None:
    if silhouettes.dtype != torch.bool:
        raise InputError(
            f"silhouettes must be bool (True = person), got {silhouettes.dtype}; pass mask > 0"
        )
