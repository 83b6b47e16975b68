"""Detect skin in colour images by a Gaussian mixture of the face's colours (Burke & Lasenby, 5.2).

The paper tried it before the histogram: "computationally expensive, and provided little improvement".
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchpose._core.checks import check_count, check_shape
from torchpose._core.rows import where_rows
from torchpose.errors import InputError
from torchpose.math._mixture_steps import MixtureParameters, natural_parameters
from torchpose.measure._face_detector import check_faces
from torchpose.measure._skin import FACE_PATCH

_SAMPLES = 16  # across the middle of the face, and down
_HAND = 0.3  # a pixel that is more probably a hand is not learnt
_LEAST = 0.3  # least share of the samples that are learnt
_ROWS, _COLUMNS = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)  # upper triangle of a 3 x 3 matrix


class SkinMixtureState(NamedTuple):
    """Holds the mixtures of B faces.

    Attributes:
        weights: [B, K]. means: L, a, b [B, K, 3]. covariances: [B, K, 3, 3].
        statistics: averaged sums of the features (1, c, c c') under each component [B, K, 10].
        frames: seen so far [B].
    """

    weights: Float[Tensor, "B K"]
    means: Float[Tensor, "B K 3"]
    covariances: Float[Tensor, "B K 3 3"]
    statistics: Float[Tensor, "B K 10"]
    frames: Int[Tensor, " B"]


class SkinMixtureModel(nn.Module):
    """Computes the probability of skin from a Gaussian mixture over L, a and b of the face.

        p(c) = sum_k pi_k N(c | mu_k, Sigma_k),   p(skin | c) = p(c) / (p(c) + u)

    In every `every`-th frame a few steps of expectation-maximisation run on samples of the face; the
    sufficient statistics of the last one are averaged over time, s <- d s + (1 - d) s_now, and give
    the mixture.

    Args:
        n_components: K. every: frames between two fits. steps: of EM in each of them; twice as many
            in a face's first frame.
        decay: d, per frame. floor: variance that is added to all colours, in squared units of Lab.
        even: u, density of colours that are not skin.

    Raises:
        InputError: settings out of range.

    Reference:
        Burke & Lasenby, section 5.2, and appendix A for EM; O. Cappé, E. Moulines (2009) for
        statistics averaged over time.

    Example:
        >>> import torch
        >>> from torchpose.measure._skin import rgb_to_lab
        >>> from torchpose.measure._skin_mixture import SkinMixtureModel
        >>> image = torch.zeros(1, 3, 60, 80)
        >>> image[:, :, 10:30, 30:50] = torch.tensor([0.8, 0.6, 0.5])[:, None, None]
        >>> model, face = SkinMixtureModel(), torch.tensor([[40.0, 20, 16]])
        >>> state, skin = model.step(model.init(1), rgb_to_lab(image), face)
        >>> bool(skin[0, 20, 40] > 0.9) and bool(skin[0, 50, 40] < 0.1)
        True
    """

    def __init__(
        self,
        n_components: int = 3,
        every: int = 5,
        steps: int = 3,
        decay: float = 0.95,
        floor: float = 2.0,
        even: float = 4e-6,
    ) -> None:
        super().__init__()
        if min(n_components, every, steps) < 1:
            raise InputError(
                "n_components, every and steps must be at least 1, got "
                f"{n_components}, {every} and {steps}"
            )
        if not (0 <= decay < 1 and floor > 0 and even > 0):
            raise InputError(
                f"decay must be in [0, 1), floor and even positive, got {decay}, {floor} and {even}"
            )
        self.n_components, self.every, self.steps = n_components, every, steps
        self.decay, self.floor, self.even = decay, floor, even
        place = (torch.arange(_SAMPLES, dtype=torch.float32) + 0.5) / _SAMPLES
        across = (2 * place - 1) * FACE_PATCH[0]
        down = FACE_PATCH[1] + place * (FACE_PATCH[2] - FACE_PATCH[1])
        grid = torch.stack(torch.broadcast_tensors(across, down[:, None]), -1)
        self.register_buffer("samples", grid.reshape(-1, 2))

    samples: Tensor

    def init(self, batch_size: int) -> SkinMixtureState:
        """Return the state before the first frame: equal weights for all components.

        Args:
            batch_size: B, number of persons.

        Returns:
            `SkinMixtureState` of B mixtures.

        Raises:
            InputError: batch_size below 1.
        """
        check_count("batch_size", batch_size)
        shape = (batch_size, self.n_components)
        weights = self.samples.new_full(shape, 1 / self.n_components)
        eye = torch.eye(3).to(self.samples)
        return SkinMixtureState(
            weights,
            self.samples.new_full((*shape, 3), 50.0),
            (2500 * eye).expand(*shape, 3, 3).clone(),
            self.samples.new_zeros(*shape, 10),
            torch.zeros(batch_size, dtype=torch.long, device=weights.device),
        )

    def step(
        self,
        state: SkinMixtureState,
        lab: Float[Tensor, "B 3 H W"],
        faces: Float[Tensor, "B 3"],
        hands: Float[Tensor, "B H W"] | None = None,
    ) -> tuple[SkinMixtureState, Float[Tensor, "B H W"]]:
        """Learn from a frame, and return the probability of skin in it.

        Args:
            state: from `init` or the step before. lab: see `rgb_to_lab`.
            faces: centre (x, y) and size of each image's face, pixels.
            hands: probability that a pixel belongs to a hand, where known.

        Returns:
            The next state, and the probability of skin.

        Raises:
            ShapeError: wrong shapes. InputError: faces without a size.
        """
        check_shape("lab", lab, [len(state.weights), 3, "H", "W"])
        check_faces(faces, len(state.weights))
        due = state.frames % self.every == 0
        known = state.frames > 0
        if bool(due.any()):
            colours, weight = self._sample(lab, faces.to(lab), hands)
            due = due & (weight.mean(1) >= _LEAST)
            state = self._fit(state, colours, weight, due)
        state = state._replace(frames=torch.where(known | due, state.frames + 1, 0))
        density = self.log_density(state, lab.flatten(2).mT).exp()
        return state, (density / (density + self.even)).view_as(lab[:, 0])

    def log_density(
        self, state: SkinMixtureState, colours: Float[Tensor, "B P 3"]
    ) -> Float[Tensor, "B P"]:
        """Return the log density of colours under each person's mixture.

        Args:
            state: of B persons. colours: [B, P, 3], Lab, in the units of the fit (`step`).

        Returns:
            log p(c) [B, P].
        """
        return (_features(colours) @ _theta(state).mT).logsumexp(-1)

    def _sample(self, lab: Tensor, faces: Tensor, hands: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return the colours of the middle of the faces [B, P, 3], and which of them count [B, P]."""
        place = (faces[:, None, :2] + faces[:, None, 2:] * self.samples).round().long()
        height, width = lab.shape[2:]
        x, y = place.unbind(-1)
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        flat = y.clamp(0, height - 1) * width + x.clamp(0, width - 1)
        if hands is not None:
            inside = inside & (hands.flatten(1).gather(1, flat) < _HAND)
        colours = lab.flatten(2).gather(2, flat[:, None].expand(-1, 3, -1))
        return colours.mT, inside.to(lab)

    def _fit(
        self, state: SkinMixtureState, colours: Tensor, weight: Tensor, due: Tensor
    ) -> SkinMixtureState:
        """Return the state after a few steps of EM for the faces that are due."""
        first = (state.frames == 0)[:, None, None]
        features = _features(colours)
        fitted = self._started(state, colours, weight)
        for step in range(2 * self.steps):
            now = _expected(fitted, features, weight)
            kept = torch.where(first, 0.0, self.decay**self.every)
            averaged = kept * state.statistics + (1 - kept) * now
            renewed = self._mixture(fitted, averaged)
            running = due & ((step < self.steps) | first[:, 0, 0])
            fitted = where_rows(running, renewed, fitted)
        return fitted

    def _started(
        self, state: SkinMixtureState, colours: Tensor, weight: Tensor
    ) -> SkinMixtureState:
        """Return the state with components of new faces started at quantiles of the lightness."""
        order = torch.where(weight > 0, colours[..., 0], torch.inf).argsort(1)
        count = weight.sum(1, keepdim=True)
        share = (torch.arange(self.n_components).to(colours) + 0.5) / self.n_components
        pick = order.gather(1, (share * count).long().clamp_max(order.shape[1] - 1))
        means = colours.gather(1, pick[..., None].expand(-1, -1, 3))
        centred = (colours - colours.mean(1, keepdim=True)) * weight[..., None]
        cov = centred.mT @ centred / count.clamp_min(1)[..., None]
        cov = (cov + self.floor * torch.eye(3).to(cov))[:, None].expand_as(state.covariances)
        even = torch.full_like(state.weights, 1 / self.n_components)
        new = state._replace(weights=even, means=means, covariances=cov)
        return where_rows(state.frames == 0, new, state)

    def _mixture(self, state: SkinMixtureState, statistics: Tensor) -> SkinMixtureState:
        """Return the mixture of the statistics: the maximisation step (BL 54-56)."""
        count = statistics[..., 0].clamp_min(1e-3)
        means = statistics[..., 1:4] / count[..., None]
        second = torch.zeros_like(state.covariances)
        second[..., _ROWS, _COLUMNS] = second[..., _COLUMNS, _ROWS] = (
            statistics[..., 4:] / count[..., None]
        )
        covariances = second - means[..., :, None] * means[..., None, :]
        covariances = covariances + self.floor * torch.eye(3).to(means)
        weights = count / count.sum(-1, keepdim=True)
        return SkinMixtureState(weights, means, covariances, statistics, state.frames)


def _features(colours: Tensor) -> Tensor:
    """Return (1, c_i, c_i c_j with i <= j), [B, P, 10]."""
    squares = colours[..., _ROWS] * colours[..., _COLUMNS]
    return torch.cat([torch.ones_like(colours[..., :1]), colours, squares], -1)


def _theta(state: SkinMixtureState) -> Tensor:
    """Return the coefficients of the features in the logarithm of each component [B, K, 10]."""
    flat = (x.flatten(0, 1).double() for x in state[:3])
    return (
        natural_parameters(MixtureParameters(*flat)).view(*state.weights.shape, -1).to(state.means)
    )


def _expected(state: SkinMixtureState, features: Tensor, weight: Tensor) -> Tensor:
    """Return the mean of the features under each component, by its responsibility (BL 53) [B, K, 10]."""
    share = (features @ _theta(state).mT).softmax(-1) * weight[..., None]
    return share.mT @ features / weight.sum(1).clamp_min(1)[:, None, None]
