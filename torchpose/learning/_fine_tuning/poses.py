"""Tune the filter over single poses on short sequences: Q, R, gamma and the mixtures."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from torchpose.camera._projection import join_arms
from torchpose.errors import InputError, PriorError
from torchpose.filters._lengths import inside_lengths
from torchpose.filters._mkf import MixtureKalmanFilter
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
from torchpose.learning._training import seen_keypoints
from torchpose.priors._arm_state import arm_in_body_axes
from torchpose.priors._gaussian_mixture import GaussianMixture
from torchpose.priors._upper_body_prior import UpperBodyPrior
from torchpose.priors._window import augment_bodies
from torchpose.skeleton._upper_body import ARM_JOINTS
from torchpose.upper_body._estimator import ARMS
from torchpose.upper_body._estimator_table import noise_options
from torchpose.upper_body._measured_joints import pixel_indices

_ROWS = [ARM_JOINTS.index(joint) for joint in MEASURED]


class SequenceBatch(NamedTuple):
    """Sequences from one random viewpoint each; NaN past the end of each.

    Attributes:
        keypoints: head, neck and hands of the eight joints, noisy, the prior's pixels.
        poses: body axes, metres. lengths: frames of each sequence.
    """

    keypoints: Float[Tensor, "B T 8 2"]
    poses: Float[Tensor, "B T 8 3"]
    lengths: Int[Tensor, " B"]

    @property
    def inside(self) -> Bool[Tensor, "B T"]:
        """Return True up to the length of each sequence."""
        return inside_lengths(self.lengths, self.poses.shape[1])


def draw_sequences(
    sequences: Sequence[Float[Tensor, "T 8 3"]],
    prior: UpperBodyPrior,
    n: int,
    generator: torch.Generator,
    *,
    frames: int = 64,
    noise_std: float = 3.0,
    view_share: float = 1.0,
    body_size: float = 0.0,
    bone_lengths: float = 0.0,
) -> SequenceBatch:
    """Draw pieces of recorded sequences in proportion to their length, from random viewpoints.

    Args:
        sequences: complete poses, centred as the prior's are, body axes, metres.
        prior: whose camera and viewpoints are taken. n: how many. generator: of everything random.
        frames: of a piece at most; pieces begin where recordings do as often as not.
        noise_std: the standard deviation of a keypoint, pixels. view_share: of the training views' width.
        body_size, bone_lengths: each piece has a body of its own (`augment_bodies`).

    Raises:
        InputError: no sequences. PriorError: a prior that does not say its viewpoints.
    """
    if not sequences:
        raise InputError("fine-tuning needs at least one complete recording, got none")
    if not prior.info.views:
        raise PriorError(
            "fine-tuning draws viewpoints from those of the prior, which does not say any; refit it"
        )
    lengths = torch.tensor([len(sequence) for sequence in sequences])
    rows = torch.multinomial(lengths.double(), n, True, generator=generator)
    late = torch.rand(n, generator=generator) * torch.randint(2, (n,), generator=generator)
    first = (late * (lengths[rows] - frames + 1).clamp_min(1)).long()
    pieces = [
        sequences[row][start : start + frames].double()
        for row, start in zip(rows.tolist(), first.tolist(), strict=True)
    ]
    poses = pad_sequence(pieces, batch_first=True, padding_value=math.nan)
    poses = augment_bodies(poses, generator, body_size, bone_lengths)
    keypoints = seen_keypoints(
        poses, prior.info, generator, view_share=view_share, noise_std=noise_std
    )
    return SequenceBatch(keypoints, poses, torch.tensor([len(piece) for piece in pieces]))


class TunableKalman(nn.Module):
    """Holds Q, R, gamma and the mixtures of the filter over single poses (fixed tracks).

    Args:
        prior: to start from; its transition is kept.
        mixtures: whether the mixtures are tuned as well as the noise. Both arms have one mixture,
            mirrored, where the prior's right one is the mirror image of its left one.
        error, evidence, departure: weights in the loss of the mean 3D error (in decimetres), of the
            log-evidence of a frame (nats, both arms), and of `TunableMixture.departure`.

    Raises:
        PriorError: a prior without a process noise.
    """

    def __init__(
        self,
        prior: UpperBodyPrior,
        *,
        mixtures: bool = False,
        error: float = 1.0,
        evidence: float = 0.0,
        departure: float = 0.01,
    ) -> None:
        super().__init__()
        self._prior = [prior]  # in a list: its buffers are no parameters of this module
        self.weights_of_loss = (error, evidence, departure)
        options = noise_options(prior, "left", "mkf-fixed")
        process = options["process_cov"]
        self.process = Positive(process if process.ndim == 1 else process.diagonal())
        std = prior.noise.get("measurement_std", torch.tensor(3.0)).double().expand(5)
        self.measurement = Positive(std[_ROWS].square())
        gamma = options.get("gamma")
        is_ou = prior.info.transition == "ou"
        self.gamma = Fraction(torch.as_tensor(0.5 if gamma is None else gamma)) if is_ou else None
        self.process.requires_grad_(not is_ou)  # that transition has no Q
        self.epsilon = float(options.get("uniform_weight", 1e-3))
        self.mixtures = nn.ModuleDict(
            {side: TunableMixture(getattr(prior, side)) for side in ARMS} if mixtures else {}
        )

    def _filter(self, side: str) -> MixtureKalmanFilter:
        mixture = getattr(self._prior[0], side)
        if side in self.mixtures:
            mixture = GaussianMixture(*self.mixtures[side]())
        return MixtureKalmanFilter(
            mixture,
            self.process(),
            self.measurement().repeat_interleave(2),
            pixel_indices(MEASURED),
            transition=self._prior[0].info.transition,
            gamma=None if self.gamma is None else self.gamma(),
            uniform_weight=self.epsilon,
        )

    def forward(self, batch: SequenceBatch) -> tuple[Float[Tensor, "B T 8 3"], Tensor]:
        """Return joints in the body's axes, and the log-evidence of both arms, mean over frames."""
        info = self._prior[0].info
        arms, evidence = {}, torch.zeros((), dtype=torch.float64)
        for side, arm in ARMS.items():
            columns = [arm[ARM_JOINTS.index(joint)] for joint in MEASURED]
            z = batch.keypoints[:, :, columns].nan_to_num().flatten(-2)
            out = self._filter(side)(z, lengths=batch.lengths)
            mean = torch.where(batch.inside[..., None], out.mean, torch.ones_like(out.mean))
            arms[side] = arm_in_body_axes(mean, info.matrix, info.rotation_order)
            evidence = evidence + torch.where(batch.inside, out.log_evidence, 0.0).sum()
        return join_arms(arms["left"], arms["right"]), evidence / batch.lengths.sum()

    def loss(self, batch: SequenceBatch) -> Float[Tensor, ""]:
        """Return the weighted sum of 3D error, negative log-evidence and departure from the start."""
        error, evidence, departure = self.weights_of_loss
        joints, log_evidence = self(batch)
        total = -evidence * log_evidence
        total = total + 10 * error * _mean_error(joints, batch.poses, batch.inside)
        return total + departure * departure_of(self.mixtures)

    @torch.no_grad()
    def error(self, batch: SequenceBatch) -> Float[Tensor, ""]:
        """Return the mean 3D error after Procrustes, metres."""
        return _mean_error(self(batch)[0], batch.poses, batch.inside)

    def prior(self) -> UpperBodyPrior:
        """Return the prior at the current parameters.

        It has no calibration over single poses: those of the prior to start from were of other parameters.
        """
        start = self._prior[0]
        noise = {
            name: value.clone()
            for name, value in start.noise.items()
            if not name.startswith("calibration_") or name.split("_", 2)[2] in start.windows
        }
        for side in ARMS:
            noise.pop(f"process_cov_{side}", None)
        noise["process_cov"] = self.process().detach()
        std = start.noise.get("measurement_std", torch.tensor(3.0)).double().expand(5).clone()
        std[_ROWS] = self.measurement().detach().sqrt()
        noise["measurement_std"] = std
        if self.gamma is not None:
            noise["gamma"] = self.gamma().detach()
        left, right = tuned_mixtures(self.mixtures, start)
        return UpperBodyPrior(left, right, tuned_info(start, "poses"), noise, dict(start.windows))


def _mean_error(joints: Tensor, poses: Tensor, inside: Bool[Tensor, "B T"]) -> Tensor:
    return pose_error(joints[inside], poses[inside]).mean()
