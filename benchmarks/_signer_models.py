"""The data and the models of the protocol Signer: annotated videos, filters, and the noise that is learnt."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from tqdm.auto import tqdm

from torchpose._core.reading import read_npz
from torchpose.errors import FileFormatError
from torchpose.filters import MixtureKalmanFilter
from torchpose.priors import GaussianMixture, UpperBodyPrior
from torchpose.priors._upper_body_prior import released_process_cov

NECK_BELOW_HEAD = 45.0
FPS = 25.0
SIDES = ("left", "right")
# Order of the released code: head, hand, neck, elbow (u, v each).
OBSERVED = (9, 10, 0, 1, 12, 13, 3, 4)
RELEASED_R = (1.0, 1.0, 1.0, 1.0, 124.0, 144.0, 124.0, 144.0)


class Videos(NamedTuple):
    """Annotated hands and heads of many videos; past the length of a video all is NaN.

    Attributes:
        z: head, hand, neck (u, v) for each side, [2, V, T, 6], pixels.
        lengths: [V]. names: of the videos.
    """

    z: Float[Tensor, "2 V T 6"]
    lengths: Int[Tensor, " V"]
    names: tuple[str, ...]


def read_videos(folder: Path) -> Videos:
    """Return head, hand and neck of every annotated video; zero coordinates are missing.

    Raises:
        InputError: no such file. FileFormatError: no videos, or not [T, 3, 2].
    """
    path = folder / "rwth_annotations.npz"
    arrays = read_npz(path)
    names = tuple(sorted(name for name in arrays if name.startswith("video_")))
    if not names:
        raise FileFormatError(
            f"{path}: expected keys video_NNN, found {', '.join(arrays) or 'none'}"
        )
    sequences = []
    for name in names:
        points = np.asarray(arrays[name], dtype=np.float64)
        if points.ndim != 3 or points.shape[1:] != (3, 2) or len(points) == 0:
            raise FileFormatError(f"{path}: {name} must be [T, 3, 2], got {list(points.shape)}")
        points = np.where((points == 0).any(-1, keepdims=True), np.nan, points)
        neck = points[:, 2] + (0.0, NECK_BELOW_HEAD)
        both = [np.concatenate([points[:, 2], points[:, side], neck], -1) for side in (0, 1)]
        sequences.append(torch.from_numpy(np.stack(both, 1)))
    z = torch.nn.utils.rnn.pad_sequence(sequences, True, padding_value=math.nan)
    return Videos(z.permute(2, 0, 1, 3), torch.tensor([len(s) for s in sequences]), names)


def released_filter(mixture: GaussianMixture, elbow: bool = True) -> MixtureKalmanFilter:
    """Return the released tracker of one arm: its Q, R, P0 = 5000 I, epsilon = 0.

    Args:
        mixture: its prior. elbow: whether its constant dummy elbow is measured too.
    """
    n = 8 if elbow else 6
    return MixtureKalmanFilter(
        mixture,
        released_process_cov(),
        torch.tensor(RELEASED_R[:n], dtype=torch.float64),
        OBSERVED[:n],
        uniform_weight=0.0,
        initial_cov=torch.full((mixture.dim,), 5000.0, dtype=torch.float64),
    )


def hand_log_density(
    model: MixtureKalmanFilter, z: Float[Tensor, "V T 6"], hidden: Bool[Tensor, "V T"]
) -> Float[Tensor, "V T"]:
    """Return log p(hand_t | z_1:t-1), R included, with hands hidden from the filter in some frames.

    The log-evidence of a step in which the hand alone is measured is that density; the step itself
    is thrown away, and the filter goes on with what it may see.

    Args:
        model: measures head, hand, neck. z: measurements, NaN = missing. hidden: frames in which
            the filter does not see the hand.

    Returns:
        Nats; NaN in the first frame and where the hand is not annotated.
    """
    measured = torch.isfinite(z)
    seen = measured.clone()
    seen[..., 2:4] &= ~hidden[..., None]
    only_hand = torch.zeros_like(measured)
    only_hand[..., 2:4] = measured[..., 2:4]
    values = z.nan_to_num()
    state = model.init(z.shape[0])
    densities = []
    for t in range(z.shape[1]):
        _, out = model.step(state, values[:, t], only_hand[:, t])
        densities.append(out.log_evidence)
        state, _ = model.step(state, values[:, t], seen[:, t])
    found = torch.stack(densities, 1).masked_fill(~measured[..., 2:4].all(-1), torch.nan)
    found[:, 0] = torch.nan
    return found


class Noise(NamedTuple):
    """Learnt noise of one transition: diagonal Q [21], R [6], gamma or None; log-evidence gained."""

    process: Tensor
    measurement: Tensor
    gamma: Tensor | None
    gain: float


def learn_noise(
    prior: UpperBodyPrior, videos: Videos, transition: str, n_steps: int, progress: bool = False
) -> Noise:
    """Return Q, R and gamma of most log-evidence, by Adam on their logarithms.

    Both arms share them. Pixels only: R stays at a quarter of a square pixel or more, since the
    annotations are whole numbers (variance 1/12) of a point that is itself uncertain.

    Args:
        prior: mixtures. videos: to learn from. transition: see `make_transition`.
        n_steps: of Adam. progress: whether to show a bar.
    """
    log_q = released_process_cov().log().requires_grad_()
    log_r = torch.tensor(RELEASED_R[:6], dtype=torch.float64).log().requires_grad_()
    logit = torch.tensor(3.0, dtype=torch.float64, requires_grad=True)
    is_ou = transition == "ou"
    leaves = [logit, log_r] if is_ou else [log_q, log_r]
    adam = torch.optim.Adam(leaves, lr=0.1)
    mask = torch.isfinite(videos.z)
    n = int(mask.any(-1).sum())
    history = []
    for _ in tqdm(range(n_steps), disable=not progress, desc=f"noise, {transition}", leave=False):
        adam.zero_grad()
        noise = _noise(log_q, log_r, logit if is_ou else None)
        total = torch.zeros((), dtype=torch.float64)
        for side, z, seen in zip(SIDES, videos.z, mask, strict=True):
            model = _filter(getattr(prior, side), transition, noise)
            evidence = model(z.nan_to_num(), seen, lengths=videos.lengths).log_evidence
            loss = -evidence.sum() / n
            loss.backward(retain_graph=True)
            total = total - loss.detach()
        history.append(float(total))
        adam.step()
    noise = _noise(log_q.detach(), log_r.detach(), logit.detach() if is_ou else None)
    return noise._replace(gain=history[-1] - history[0])


def _noise(log_q: Tensor, log_r: Tensor, logit: Tensor | None) -> Noise:
    gamma = None if logit is None else torch.sigmoid(logit)
    return Noise(log_q.exp(), 0.25 + log_r.exp(), gamma, 0.0)


def _filter(mixture: GaussianMixture, transition: str, noise: Noise | None) -> MixtureKalmanFilter:
    if noise is None:
        noise = Noise(
            released_process_cov(), torch.tensor(RELEASED_R[:6], dtype=torch.float64), None, 0.0
        )
    options: dict[str, Any] = {"transition": transition, "gamma": noise.gamma}
    return MixtureKalmanFilter(mixture, noise.process, noise.measurement, OBSERVED[:6], **options)


def filters_of(
    prior: UpperBodyPrior, transition: str, noise: Noise | None
) -> list[MixtureKalmanFilter]:
    return [_filter(getattr(prior, side), transition, noise) for side in SIDES]
