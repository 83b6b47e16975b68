"""Several actions at once, and none of them: gates, likelihoods of postures, and who does what when."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchpose.errors import InputError, check_finite, check_shape
from torchpose.priors.action_space import (
    CLAMP_ROUNDS,
    GATE_WIDTH,
    ActionSpace,
    clamp_in_rounds,
    match_postures,
)
from torchpose.priors.postures import LIMBS_12, POSTURE_DIM, check_limbs
from torchpose.priors.tensor_file import FileKind, read_tensors, write_tensors

__all__ = ["NONE", "ActionBank", "BankInfo"]

NONE = "none"
"""Name of the last state: none of the known actions."""

_LEAST_RESIDUAL = 2.0  # degrees, of every direction outside of an action's subspace


@dataclass(frozen=True)
class BankInfo:
    """What a bank holds, and how sure it is.

    Attributes:
        names: of the A actions. fps: of their performances. limbs: that the postures are of.
        persons: ids of all persons. stay: probability of doing the same thing a second later.
        spread: factor on the deviations of the training persons, for others. background: factor on
            the deviation of all training postures, for none of the actions. evidence_rate: frames
            per second that count as independent of each other. gate_dimensions: of the D that the gates
        look at; None for all.
        licence: of the data. command: that made it.
    """

    names: tuple[str, ...] = ()
    fps: float | None = None
    limbs: tuple[str, ...] = tuple(limb.name for limb in LIMBS_12)
    persons: tuple[str, ...] = ()
    stay: float = 0.8
    spread: float = 1.0
    background: float = 1.0
    evidence_rate: float = 1.0
    gate_dimensions: int | None = None
    licence: str = ""
    command: str = ""


_FILE = FileKind(
    "torchpose-action-bank",
    1,
    BankInfo,
    tensors={
        "mean": "A 36",
        "basis": "A 36 D",
        "performance": "A K D",
        "std": "A K D",
        "match_std": "A D",
        "residual_std": "",
        "background_mean": "36",
        "background_axes": "36 36",
        "background_std": "36",
    },
    indices={"n_postures": "A", "n_dimensions": "A"},
)


class ActionBank(nn.Module):
    """Action spaces stacked by padding, with one more state: none of the actions.

    The likelihood of a posture phi under action a is a tube of Gaussians around the mean performance
    in the action's subspace, and one Gaussian in all directions outside of it:

        p(phi | a)    = 1/K_a sum_k N(z; g_k, (c sigma_k)^2) N(|phi - m - U z|; 0, s^2 I)
        p(phi | none) = N(phi; m_0, C_0),

    with c, `spread`, for persons who are not among those of the training set. s^2 is the mean variance
    that the subspaces leave over in a direction, at least (2 degrees)^2, the same for all actions.
    m_0 and C_0 are mean and covariance of the postures of all actions (the mean performances with
    their deviations, each action alike), its deviations multiplied by `background` and none below s:
    none of the actions is whoever moves as much, but otherwise. Postures of frames that follow each
    other are no independent evidence: the log-likelihood of a frame is multiplied by
    min(1, evidence_rate / fps). Actions change as a chain that goes from each state to every other
    one at the same rate,

        p(A_t = A_{t-1}) = 1/n + (1 - 1/n) e^(-r dt),  n = A + 1,  r such that it is `stay` in a second,

    so that two frames of 1/60 s are as one of 1/30 s.

    Args:
        spaces: at least one. stay: above 1/n and below 1. spread, background, evidence_rate: positive.
        gate_dimensions: of the first so many dimensions the gates are made, all by default. More
            dimensions than a gate should have tell actions apart better.

    Attributes:
        info: names, frame rate and settings.

    Buffers: mean [A, 36], basis [A, 36, D], performance, std [A, K, D], match_std [A, D], n_postures,
    n_dimensions [A], residual_std [], background_mean [36], background_axes [36, 36],
    background_std [36]. Padded entries have g = 0 and sigma = 1 in dimensions whose axis is zero.

    Raises:
        InputError: no action, a name twice, empty or "none", a setting out of range, actions of
            different frame rates.

    Reference: what Rowe, Rius, Gonzalez & Villanueva, Posture constraints for Bayesian human motion
    tracking, AMDO 2006, leave as future work (section 5).
    """

    mean: Tensor
    basis: Tensor
    performance: Tensor
    std: Tensor
    match_std: Tensor
    n_postures: Tensor
    n_dimensions: Tensor
    residual_std: Tensor
    background_mean: Tensor
    background_axes: Tensor
    background_std: Tensor

    def __init__(
        self,
        spaces: Sequence[ActionSpace],
        *,
        stay: float = BankInfo.stay,
        spread: float = BankInfo.spread,
        background: float = BankInfo.background,
        evidence_rate: float = BankInfo.evidence_rate,
        gate_dimensions: int | None = None,
    ) -> None:
        super().__init__()
        names = _names(spaces)
        if gate_dimensions is not None and gate_dimensions < 1:
            raise InputError(f"gate_dimensions must be at least 1, got {gate_dimensions}")
        _check_settings(stay, spread, background, evidence_rate, len(names) + 1)
        self.info = BankInfo(
            names, _frame_rate(spaces), spaces[0].info.limbs,
            tuple(sorted({p for space in spaces for p in space.info.persons})),
            stay, spread, background, evidence_rate, gate_dimensions,
            "; ".join(dict.fromkeys(s.info.licence for s in spaces if s.info.licence)),
        )  # fmt: skip
        for name, value in {**_stacked(spaces), **_densities(spaces, background)}.items():
            self.register_buffer(name, value)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the states: the actions, then "none"."""
        return (*self.info.names, NONE)

    @property
    def none(self) -> int:
        """Index A of the state "none"."""
        return len(self.info.names)

    # --- gates ------------------------------------------------------------------------------------

    def project(self, postures: Float[Tensor, "*batch 36"]) -> Float[Tensor, "*batch A D"]:
        """Projections on the subspace of every action, degrees."""
        check_shape("postures", postures, ["...", POSTURE_DIM])
        flat = self.basis.transpose(0, 1).flatten(1)  # [36, A D]
        offset = (self.mean[:, None] @ self.basis).flatten()
        return (postures @ flat - offset).unflatten(-1, self.basis.shape[::2])

    def match(
        self,
        postures: Float[Tensor, "*batch 36"],
        actions: Int[Tensor, "*batch"],
        generator: torch.Generator | None = None,
        *,
        uniform: Float[Tensor, "*batch"] | None = None,
    ) -> Int[Tensor, "*batch"]:
        """The posture of its own action that each is matched with, see `ActionSpace.match`.

        Args:
            postures: [..., 36]. actions: [...], A for none, for which the index means nothing.
            generator: of the random numbers. uniform: the numbers themselves, [...] in [0, 1).
        """
        own = actions.clamp_max(self.none - 1)
        gated = self._gated
        z, std = self.project(postures)[..., :gated], self.match_std[:, None, :gated]
        log = -0.5 * self._squared(z, std)
        log = log.masked_fill(~self._there(), -math.inf)
        index = own[..., None, None].expand(*own.shape, 1, log.shape[-1])
        log = log.gather(-2, index).squeeze(-2)
        if uniform is None:
            uniform = torch.rand(own.shape, generator=generator, dtype=log.dtype, device=log.device)
        return match_postures(log, uniform)

    def inside(
        self,
        postures: Float[Tensor, "*batch 36"],
        actions: Int[Tensor, "*batch"],
        j: Int[Tensor, "*batch"],
        width: float = GATE_WIDTH,
    ) -> Bool[Tensor, "*batch"]:
        """Whether postures lie in the gates of their own actions (AS 6); always for none."""
        z, own = self._own(postures, actions)
        within = (z - self.performance[own, j]).abs() < width * self.std[own, j]
        return within[..., : self._gated].all(-1) | (actions == self.none)

    def clamp_postures(
        self,
        postures: Float[Tensor, "*batch 36"],
        actions: Int[Tensor, "*batch"],
        j: Int[Tensor, "*batch"],
        width: float = GATE_WIDTH,
        rounds: int = CLAMP_ROUNDS,
    ) -> Float[Tensor, "*batch 36"]:
        """Postures moved into the gates of their own actions, see `ActionSpace.clamp_postures`.

        They stay as they are for none.
        """
        own = actions.clamp_max(self.none - 1)
        centre, std, basis = self.performance[own, j], self.std[own, j], self.basis[own]
        gated = torch.arange(std.shape[-1], device=std.device) < self._gated

        def clamp(angles: Tensor, width: float) -> Tensor:
            z, _ = self._own(angles, actions)
            reach = (1 - 1e-6) * width * std
            step = gated * ((z - centre).clamp(-reach, reach) - (z - centre))
            return angles + (basis @ step[..., None]).squeeze(-1)

        inside = self.inside(postures, actions, j, width)
        return clamp_in_rounds(postures, inside, clamp, width, rounds)

    # --- which action -----------------------------------------------------------------------------

    def log_likelihood(self, postures: Float[Tensor, "*batch 36"]) -> Float[Tensor, "*batch S"]:
        """log p(phi | a) of every state, [..., A + 1], the last one none, of a single posture."""
        z = self.project(postures)
        std = self.info.spread * self.std
        used = torch.arange(std.shape[-1], device=z.device) < self.n_dimensions[:, None]  # [A, D]
        tube = -0.5 * self._squared(z, std) - (std.log() * used[:, None]).sum(-1)  # [..., A, K]
        tube = tube.masked_fill(~self._there(), -math.inf).logsumexp(-1) - self.n_postures.log()
        total = (postures.unsqueeze(-2) - self.mean).square().sum(-1)
        left = (total - z.square().sum(-1)).clamp_min(0) / self.residual_std.square()
        outside = -0.5 * left - (POSTURE_DIM - self.n_dimensions) * self.residual_std.log()
        whitened = ((postures - self.background_mean) @ self.background_axes) / self.background_std
        none = -0.5 * whitened.square().sum(-1) - self.background_std.log().sum()
        both = torch.cat([tube + outside, none[..., None]], -1)
        return both - 0.5 * POSTURE_DIM * math.log(2 * math.pi)

    def transition(self, fps: float | None = None) -> Float[Tensor, "S S"]:
        """Probabilities [A + 1, A + 1] of going from each state to each in one frame.

        Args:
            fps: frames per second; by default that of the performances.
        """
        n = len(self.names)
        lasting = (self.info.stay - 1 / n) / (1 - 1 / n)  # e^-r
        lasting = lasting ** (1 / self._rate(fps))
        eye = torch.eye(n, dtype=self.mean.dtype, device=self.mean.device)
        return lasting * eye + (1 - lasting) / n

    def start(self) -> Float[Tensor, " S"]:
        """Log-probabilities [A + 1] of the states before the first frame: all alike."""
        return self.mean.new_full((len(self.names),), -math.log(len(self.names)))

    def update(
        self,
        log_posterior: Float[Tensor, "*#batch S"],
        postures: Float[Tensor, "*batch 36"],
        fps: float | None = None,
    ) -> Float[Tensor, "*batch S"]:
        """One frame of the recursion over actions.

            log p(A_t | phi_1:t) = e log p(phi_t | A_t) + log sum p(A_t | A_{t-1}) p(A_{t-1} | ...) + const

        Args:
            log_posterior: [..., A + 1], of the frame before. postures: [..., 36], of this frame.
            fps: frames per second; by default that of the performances.
        """
        return self._step(log_posterior, self.log_likelihood(postures), self._rate(fps))

    def recognise(
        self, postures: Float[Tensor, "*batch T 36"], fps: float | None = None
    ) -> Float[Tensor, "*batch T S"]:
        """Posterior over the actions and none in every frame, given the frames up to it.

        Args:
            postures: [..., T, 36], degrees, of one sequence or a batch of them.
            fps: frames per second of the postures; by default that of the performances. Another one
                rescales the transitions and how much a frame counts.

        Returns:
            [..., T, A + 1], sums to 1; columns are in the order of `names`.

        Raises:
            ShapeError: other than 36 angles. InputError: not finite, no frames, no frame rate.
        """
        check_shape("postures", postures, ["...", "T", POSTURE_DIM])
        check_finite("postures", postures, hint="cut out the frames with missing joints")
        if postures.shape[-2] == 0:
            raise InputError("expected at least one frame of postures, got none")
        rate = self._rate(fps)
        log, found = self.start(), []
        for frame in self.log_likelihood(postures).unbind(-2):
            log = self._step(log, frame, rate)
            found.append(log)
        return torch.stack(found, -2).exp()

    def _step(self, log: Tensor, log_likelihood: Tensor, rate: float) -> Tensor:
        moved = (log.unsqueeze(-1) + self.transition(rate).log()).logsumexp(-2)
        share = min(1.0, self.info.evidence_rate / rate)
        return (moved + share * log_likelihood).log_softmax(-1)

    # --- files ------------------------------------------------------------------------------------

    def save(self, path: str | Path) -> None:
        """Write it as safetensors; the file appears whole or not at all."""
        tensors = {n: getattr(self, n) for n in (*_FILE.tensors, *_FILE.indices)}
        write_tensors(path, _FILE, self.info, tensors)

    @classmethod
    def load(cls, path: str | Path) -> "ActionBank":
        """Read what `save` has written.

        Raises:
            InputError: no such file. FileFormatError: damaged, or a file of another kind.
            SkeletonError: limbs of other names.
        """
        info, tensors = read_tensors(path, _FILE)
        check_limbs(info.limbs)
        bank = cls.__new__(cls)
        nn.Module.__init__(bank)
        bank.info = info
        for name, value in tensors.items():
            bank.register_buffer(name, value)
        return bank

    # --- pieces -----------------------------------------------------------------------------------

    def _own(self, postures: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Projection [..., D] of each on its own action, and that action (none: the last one)."""
        own = actions.clamp_max(self.none - 1)
        z = self.project(postures)
        index = own[..., None, None].expand(*own.shape, 1, z.shape[-1])
        return z.gather(-2, index).squeeze(-2), own

    def _squared(self, z: Tensor, std: Tensor) -> Tensor:
        """sum_d (z_d - g_{k,d})^2 / std_{k,d}^2 of every action and posture, [..., A, K].

        By products of matrices: the table of differences, [..., A, K, D], would not fit the cache.
        """
        performance = self.performance[..., : z.shape[-1]]
        precision = std.square().reciprocal().expand_as(performance)
        weighted = performance * precision
        rows = z.reshape(-1, *z.shape[-2:]).transpose(0, 1)  # [A, N, D]
        found = rows.square() @ precision.mT - 2 * rows @ weighted.mT
        found = found + (performance * weighted).sum(-1)[:, None]
        return found.clamp_min(0).transpose(0, 1).reshape(*z.shape[:-1], -1)

    @property
    def _gated(self) -> int:
        """Dimensions that the gates look at."""
        return min(self.info.gate_dimensions or self.basis.shape[-1], self.basis.shape[-1])

    def _there(self) -> Tensor:
        """[A, K], postures that are not padding."""
        k = torch.arange(self.performance.shape[1], device=self.performance.device)
        return k < self.n_postures[:, None]

    def _rate(self, fps: float | None) -> float:
        rate = self.info.fps if fps is None else fps
        if rate is None:
            raise InputError("the actions were fitted without a frame rate; give fps")
        if not 0 < rate < math.inf:
            raise InputError(f"fps must be positive, got {rate:g}")
        return rate

    def extra_repr(self) -> str:
        return ", ".join(self.names)


def _stacked(spaces: Sequence[ActionSpace]) -> dict[str, Tensor]:
    """The tensors of all actions, padded to the same D and K."""
    dims = torch.tensor([s.n_dimensions for s in spaces])
    counts = torch.tensor([s.n_postures for s in spaces])
    d, k = int(dims.max()), int(counts.max())

    def padded(name: str, fill: float) -> Tensor:
        parts = []
        for space in spaces:
            value = getattr(space, name)
            missing = [0, d - value.shape[-1]]
            if name in ("performance", "std"):
                missing += [0, k - len(value)]
            parts.append(torch.nn.functional.pad(value, missing, value=fill))
        return torch.stack(parts)

    device = spaces[0].mean.device
    return {
        "mean": torch.stack([s.mean for s in spaces]), "basis": padded("basis", 0.0),
        "performance": padded("performance", 0.0), "std": padded("std", 1.0),
        "match_std": padded("match_std", 1.0), "n_postures": counts.to(device),
        "n_dimensions": dims.to(device),
    }  # fmt: skip


def _densities(spaces: Sequence[ActionSpace], background: float) -> dict[str, Tensor]:
    """Deviation outside of the subspaces, and the Gaussian of none of the actions."""
    left = [s.lost_variance / max(POSTURE_DIM - s.n_dimensions, 1) for s in spaces]
    residual = torch.stack(left).mean().sqrt().clamp_min(_LEAST_RESIDUAL)
    means = torch.stack([s.mean for s in spaces])
    centre = means.mean(0)
    within = torch.stack([(s.basis * s.variances) @ s.basis.mT for s in spaces]).mean(0)
    between = (means - centre).mT @ (means - centre) / len(spaces)
    variances, axes = torch.linalg.eigh(within + between)
    std = torch.maximum(background * variances.clamp_min(0).sqrt(), residual)
    return {
        "residual_std": residual, "background_mean": centre, "background_axes": axes.contiguous(),
        "background_std": std,
    }  # fmt: skip


def _names(spaces: Sequence[ActionSpace]) -> tuple[str, ...]:
    names = tuple(space.info.name for space in spaces)
    if not names:
        raise InputError("a bank needs at least one action space, got none")
    if len(set(names)) < len(names) or "" in names or NONE in names:
        raise InputError(
            f"the actions of a bank need names of their own other than {NONE!r}, got "
            f"{', '.join(map(repr, names))}; fit each with `name`"
        )
    return names


def _frame_rate(spaces: Sequence[ActionSpace]) -> float | None:
    rates = {space.info.fps for space in spaces if space.info.fps is not None}
    if len(rates) > 1:
        raise InputError(
            "the actions of a bank must be fitted at one frame rate, got "
            f"{', '.join(f'{r:g}' for r in sorted(rates))}; resample the performances"
        )
    return next(iter(rates), None)


def _check_settings(stay: float, spread: float, background: float, rate: float, n: int) -> None:
    if not 1 / n < stay < 1:
        raise InputError(f"stay must lie between 1/{n}, where nothing lasts, and 1, got {stay:g}")
    for name, value in (("spread", spread), ("background", background), ("evidence_rate", rate)):
        if not 0 < value < math.inf:
            raise InputError(f"{name} must be positive, got {value:g}")
