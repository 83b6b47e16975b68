"""Tune mixtures over windows on single windows, through the closed form of their filter."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchpose.camera._projection import join_arms
from torchpose.errors import InputError, PriorError
from torchpose.learning._fine_tuning.parameters import (
    MEASURED,
    Fraction,
    Positive,
    TunableMixture,
    departure_of,
    pose_error,
    tuned_info,
    tuned_mixtures,
)
from torchpose.learning._samplers import WindowSource
from torchpose.math._mixture_steps import MixtureParameters
from torchpose.priors._arm_state import STATE_DIM, arm_in_body_axes
from torchpose.priors._upper_body_prior import UpperBodyPrior
from torchpose.priors._window import WindowPrior
from torchpose.skeleton._upper_body import ARM_JOINTS
from torchpose.upper_body._estimator import ARMS
from torchpose.upper_body._measured_joints import joint_covariances, pixel_indices


class WindowBatch(NamedTuple):
    """Windows of both arms, of the same bodies from the same viewpoints.

    Attributes:
        states: true window states by side, [N, D]. hands: which hands of the window lie inside the
            recording, [N, H].
    """

    states: Mapping[str, Float[Tensor, "N D"]]
    hands: Bool[Tensor, "N H"]


def draw_windows(sources: Mapping[str, WindowSource], index: int, epoch: int = 0) -> WindowBatch:
    """Draw the windows of a block, with those of their hands known that a tracker would have seen.

    Args:
        sources: of the left and right arm, from the same seed. index, epoch: of the block.

    Raises:
        InputError: sources of different windows.
    """
    left, right = sources["left"], sources["right"]
    if (left.seed, left.layout, left.n_samples) != (right.seed, right.layout, right.n_samples):
        raise InputError("windows of both arms must come from one seed, layout and size")
    states = {side: sources[side].block(index, epoch).states for side in ARMS}
    layout, frames, centres = left.layout, left.frames, left.centres_of(index)
    wanted = frames.wanted(centres, (*layout.own, *layout.other), layout.fps)
    hands = (wanted >= frames.first[centres, None]) & (wanted <= frames.last[centres, None])
    return WindowBatch(states, hands)


class TunableWindow(nn.Module):
    """Holds the mixtures over windows of both arms, the noise of their hands, and the likelihood's power.

    Frames do not depend on each other here, so the estimate is a closed form: with the gains G_j,
        x = sum_j w_j (mu_j + G_j (z - H mu_j)),  w_j prop. to pi_j N(z; H mu_j, S_j)^tau.

    Args:
        prior: to start from. name: the name of its window, "causal" or "full".
        mixtures: whether the mixtures are tuned as well as noise and power.
        error, evidence, departure: weights in the loss of the mean 3D error (in decimetres), of the
            log density of the true arm given its measurements (nats, both arms), and of
            `TunableMixture.departure`.

    Raises:
        PriorError: no such window.
    """

    def __init__(
        self,
        prior: UpperBodyPrior,
        name: str,
        *,
        mixtures: bool = True,
        error: float = 1.0,
        evidence: float = 0.0,
        departure: float = 0.01,
    ) -> None:
        super().__init__()
        if name not in prior.windows:
            raise PriorError(
                f"the prior must have the window {name!r}, got {', '.join(prior.windows) or 'none'}"
            )
        self._prior, self.name = [prior], name
        self.weights_of_loss = (error, evidence, departure)
        window = prior.windows[name]
        self.layout = window.layout
        cov = joint_covariances(prior, None, prior.info.matrix)
        arm = ARMS["left"]
        variance = [cov[arm[ARM_JOINTS.index(joint)], 0, 0] for joint in MEASURED]
        self.register_buffer("measured_cov", torch.stack(variance).repeat_interleave(2))
        self.hand_variance = Positive(torch.tensor(window.settings["hand_std"] ** 2))
        self.power = Fraction(torch.tensor(window.settings["likelihood_power"]))
        self.mixtures = nn.ModuleDict(
            {side: TunableMixture(getattr(window, side)) for side in ARMS} if mixtures else {}
        )

    measured_cov: Tensor

    def _parameters_of(self, side: str) -> MixtureParameters:
        if side in self.mixtures:
            return self.mixtures[side]()
        return getattr(self._prior[0].windows[self.name], side).parameters_tuple()

    def _measured(self) -> list[int]:
        """Return the measured dimensions of a state: hand, head and neck, and the window's hands."""
        return [*pixel_indices(MEASURED), *self.layout.hands]

    def _wanted(self) -> list[int]:
        """Return the dimensions of a state that the pose is read from."""
        return list(self.layout.in_torso or range(STATE_DIM))

    def _noise(self) -> Float[Tensor, " Z"]:
        """Return the variances of all measured pixels: of this frame, then of the window's hands."""
        hand = self.measured_cov[:1] + self.hand_variance()
        return torch.cat([self.measured_cov, hand.expand(2 * self.layout.n_hands)])

    def _condition(
        self, side: str, z: Float[Tensor, "N Z"], known: Bool[Tensor, "N Z"]
    ) -> tuple[list[Tensor], list[tuple[Tensor, Tensor, Tensor]]]:
        """Return groups of rows with the same measured dimensions, and the posterior mixture of each."""
        weights, means, covariances = self._parameters_of(side)
        columns, wanted = torch.tensor(self._measured()), torch.tensor(self._wanted())
        noise, rows, found = self._noise(), [], []
        patterns, group = torch.unique(known, dim=0, return_inverse=True)
        for number, pattern in enumerate(patterns):
            own = (group == number).nonzero()[:, 0]
            seen = columns[pattern]
            spread = covariances[:, seen][:, :, seen] + torch.diag(noise[pattern])
            factor = torch.linalg.cholesky(spread)
            white = torch.linalg.solve_triangular(
                factor, covariances[:, seen[:, None], wanted], upper=False
            )
            residual = z[own][:, pattern] - means[:, None, seen]
            residual = torch.linalg.solve_triangular(factor, residual.mT, upper=False)
            log_likelihood = -0.5 * residual.square().sum(1)
            log_likelihood = log_likelihood - _log_det(factor)[:, None]
            log_weights = (weights.log()[:, None] + self.power() * log_likelihood).log_softmax(0)
            estimates = means[:, None, wanted] + residual.mT @ white
            rest = covariances[:, wanted[:, None], wanted] - white.mT @ white
            rows.append(own)
            found.append((log_weights, estimates, rest))
        return rows, found

    def forward(
        self, batch: WindowBatch, generator: torch.Generator | None = None
    ) -> tuple[Float[Tensor, "N 8 3"], Float[Tensor, ""]]:
        """Return joints in the body's axes, and log p(arm | measured) of both arms, mean over windows.

        Args:
            batch: windows. generator: of the noise that is added to their pixels.
        """
        info, arms = self._prior[0].info, {}
        density = torch.zeros((), dtype=torch.float64)
        for side, state in batch.states.items():
            measured = state[:, self._measured()]
            noise = torch.randn(measured.shape, generator=generator, dtype=torch.float64)
            z = measured + self.measured_cov[0].sqrt() * noise
            hands = batch.hands.repeat_interleave(2, 1)
            known = torch.cat([hands.new_ones(len(z), 6), hands], 1)
            mean = torch.zeros(len(z), len(self._wanted()), dtype=torch.float64)
            for own, (log_weights, estimates, rest) in zip(
                *self._condition(side, z, known), strict=True
            ):
                part = (log_weights.exp()[..., None] * estimates).sum(0)
                mean = mean.index_copy(0, own, part)
                if self.weights_of_loss[1]:
                    arm = state[own][:, self._wanted()]
                    density = density + _log_density(log_weights, estimates, rest, arm).sum()
            arms[side] = (
                mean.unflatten(-1, (-1, 3))
                if self.layout.torso
                else arm_in_body_axes(mean, info.matrix, info.rotation_order)
            )
        joints = join_arms(*(arms[side][None] for side in ARMS))[0]
        return joints, density / len(batch.hands)

    def loss(
        self, batch: WindowBatch, generator: torch.Generator | None = None
    ) -> Float[Tensor, ""]:
        """Return the weighted sum of 3D error, negative log density and departure from the start."""
        error, evidence, departure = self.weights_of_loss
        joints, density = self(batch, generator)
        total = 10 * error * pose_error(joints, self._truth(batch)).mean() - evidence * density
        return total + departure * departure_of(self.mixtures)

    @torch.no_grad()
    def error(
        self, batch: WindowBatch, generator: torch.Generator | None = None
    ) -> Float[Tensor, ""]:
        """Return the mean 3D error after Procrustes, metres."""
        return pose_error(self(batch, generator)[0], self._truth(batch)).mean()

    def _truth(self, batch: WindowBatch) -> Float[Tensor, "N 8 3"]:
        info = self._prior[0].info
        arms = [
            arm_in_body_axes(batch.states[side], info.matrix, info.rotation_order) for side in ARMS
        ]
        return join_arms(*(arm[None] for arm in arms))[0]

    def window(self) -> WindowPrior:
        """Return the window at the current parameters."""
        window = self._prior[0].windows[self.name]
        left, right = tuned_mixtures(self.mixtures, window)
        settings = window.settings | {
            "hand_std": float(self.hand_variance().detach().sqrt()),
            "likelihood_power": float(self.power().detach()),
        }
        return WindowPrior(left, right, window.layout, settings)

    def prior(self) -> UpperBodyPrior:
        """Return the prior at the current parameters."""
        start = self._prior[0]
        info = tuned_info(start, f"window {self.name}")
        windows = dict(start.windows) | {self.name: self.window()}
        return UpperBodyPrior(start.left, start.right, info, dict(start.noise), windows)


def _log_det(factor: Float[Tensor, "K Z Z"]) -> Float[Tensor, " K"]:
    """Return half of the log determinant plus the constant of the density."""
    n = factor.shape[-1]
    return factor.diagonal(dim1=-2, dim2=-1).log().sum(-1) + 0.5 * n * math.log(2 * math.pi)


def _log_density(
    log_weights: Float[Tensor, "K N"],
    means: Float[Tensor, "K N D"],
    covariances: Float[Tensor, "K D D"],
    x: Float[Tensor, "N D"],
) -> Float[Tensor, " N"]:
    """Return log sum_j w_j N(x; m_j, C_j)."""
    ridge = 1e-9 * covariances.diagonal(dim1=-2, dim2=-1)
    factor = torch.linalg.cholesky(covariances + torch.diag_embed(ridge))
    white = torch.linalg.solve_triangular(factor, (x - means).mT, upper=False)
    each = -0.5 * white.square().sum(1) - _log_det(factor)[:, None]
    return (log_weights + each).logsumexp(0)
