"""Recognise which of several actions, or none, is performed: gates, likelihoods, transitions."""

import math
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.checks import check_count, check_finite, check_shape
from torchpose._core.estimates import check_number_range
from torchpose._core.module_state import NoHalfModule
from torchpose._core.reading import reading
from torchpose._core.tensor_file import read_tensors, write_tensors
from torchpose.errors import FileFormatError, InputError
from torchpose.priors._actions.action_file import BANK_FILE, BankInfo
from torchpose.priors._actions.gate import (
    CLAMP_ROUNDS,
    GATE_WIDTH,
    check_gate_width,
    clamp_in_rounds,
    clamp_offset,
    match_postures,
)
from torchpose.priors._actions.polar_limbs import POSTURE_DIM, check_limbs
from torchpose.priors._actions.space import ActionSpace
from torchpose.priors._actions.stack import (
    NONE,
    chain_step,
    chain_transition,
    check_chain,
    common_frame_rate,
    evidence_share,
    names_of,
    stack_spaces,
)


class ActionBank(NoHalfModule):
    """Holds the action spaces of several actions, padded to one size, with one more state: none of them.

    The likelihood of a posture phi under action a is a tube of Gaussians around the mean performance
    in the action's subspace, and one Gaussian in all directions outside of it:

        p(phi | a)    = 1/K_a sum_k N(z; g_k, (c sigma_k)^2) N(|phi - m - U z|; 0, s^2 I)
        p(phi | none) = N(phi; m_0, C_0),

    with c, `spread`, for persons who are not among those of the training set. s^2 is the mean variance
    that the subspaces leave over in a direction, at least (2 degrees)^2, the same for all actions.
    m_0 and C_0 are mean and covariance of the postures of all actions (the mean performances with
    their deviations, each action alike), its deviations multiplied by `background` and none below s;
    so "none" covers postures as varied as those of the actions, but different ones. Actions change as a chain
    (`chain_transition`). Postures of frames that follow each other are no independent evidence: the
    log-likelihood of a frame is multiplied by min(1, evidence_rate / fps).

    Args:
        spaces: at least one. stay: above 1/n and below 1. spread, background, evidence_rate: positive.
        gate_dimensions: how many of the first dimensions the gates look at; all by default, or if
            there are fewer. More dimensions than a gate should have tell actions apart better.

    Attributes:
        info: names, frame rate and settings.

    Buffers: mean [A, 36], basis [A, 36, D], performance, std [A, K, D], match_std [A, D], n_postures,
    n_dimensions [A], residual_std [], background_mean [36], background_axes [36, 36],
    background_std [36]. Padded entries have g = 0 and sigma = 1 in dimensions whose axis is zero.

    Raises:
        InputError: no action, a name twice, empty or "none", a setting out of range, actions of
            different frame rates.

    Reference: what Rius, Varona, Roca & Gonzalez, Posture constraints for Bayesian human motion
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
        names = names_of(spaces)
        self.info = BankInfo(
            names, common_frame_rate(spaces), spaces[0].info.limbs,
            tuple(sorted({p for space in spaces for p in space.info.persons})),
            stay, spread, background, evidence_rate, gate_dimensions,
            "; ".join(dict.fromkeys(s.info.licence for s in spaces if s.info.licence)),
        )  # fmt: skip
        _check_settings(self.info)
        for name, value in stack_spaces(spaces, background).items():
            self.register_buffer(name, value)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the states: the actions, then "none"."""
        return (*self.info.names, NONE)

    @property
    def none(self) -> int:
        """Return the index A of the state "none"."""
        return len(self.info.names)

    # --- gates ------------------------------------------------------------------------------------

    def project(self, postures: Float[Tensor, "*batch 36"]) -> Float[Tensor, "*batch A D"]:
        """Project postures on the principal axes of every action.

        Args:
            postures: [..., 36], degrees.

        Returns:
            z [..., A, D], degrees; zero in the dimensions that an action lacks.

        Raises:
            ShapeError: other than 36 angles.
        """
        check_shape("postures", postures, ["...", POSTURE_DIM])
        flat = self.basis.transpose(0, 1).flatten(1)  # [36, A D]
        offset = (self.mean[:, None] @ self.basis).flatten()
        return (postures.to(flat) @ flat - offset).unflatten(-1, self.basis.shape[::2])

    def match(
        self,
        postures: Float[Tensor, "*batch 36"],
        actions: Int[Tensor, "*batch"],
        generator: torch.Generator | None = None,
        *,
        uniform: Float[Tensor, "*batch"] | None = None,
    ) -> Int[Tensor, "*batch"]:
        """Draw the posture of its own action that each posture is matched with, see `ActionSpace.match`.

        Args:
            postures: [..., 36]. actions: [...], A for none, for which the index means nothing.
            generator: of the random numbers. uniform: the numbers themselves, [...] in [0, 1).

        Returns:
            Indices [...] from 0 to K - 1.
        """
        own = actions.clamp_max(self.none - 1)
        gated = self._gated
        z, std = self.project(postures)[..., :gated], self.match_std[:, None, :gated]
        log = -0.5 * self._squared(z, std)
        log = log.masked_fill(~self._is_posture(), -math.inf)
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
        """Return whether postures lie in the gates of their own actions (AS 6); always for none.

        Args:
            postures: [..., 36], degrees. actions: [...], A for none. j: [...], matched postures.
            width: the width of the gate, in sigma to either side; 2 as published.

        Returns:
            Bool [...].

        Raises:
            ShapeError: other than 36 angles. InputError: a width that is not positive.
        """
        check_gate_width(width)
        z, own = self._project_on_own(postures, actions)
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
        """Move postures into the gates of their own actions; those without an action stay as they are.

        See `ActionSpace.clamp_postures`.

        They stay as they are for none.

        Args:
            postures: [..., 36], degrees. actions: [...], A for none. j: [...], matched postures.
            width: the width of the gate, in sigma to either side.
            rounds: 0 clamps once and leaves the angles as they come out.

        Returns:
            Postures [..., 36], degrees.

        Raises:
            ShapeError: other than 36 angles. InputError: a width that is not positive.
        """
        own = actions.clamp_max(self.none - 1)
        centre, std, basis = self.performance[own, j], self.std[own, j], self.basis[own]
        gated = torch.arange(std.shape[-1], device=std.device) < self._gated

        def clamp(angles: Tensor, width: float) -> Tensor:
            z, _ = self._project_on_own(angles, actions)
            step = gated * (clamp_offset(z - centre, std, width) - (z - centre))
            return angles + (basis @ step[..., None]).squeeze(-1)

        inside = self.inside(postures, actions, j, width)
        return clamp_in_rounds(postures, inside, clamp, width, rounds)

    # --- which action -----------------------------------------------------------------------------

    def log_likelihood(self, postures: Float[Tensor, "*batch 36"]) -> Float[Tensor, "*batch S"]:
        """Return the log-likelihood log p(phi | a) of a posture under every action and under none.

        Args:
            postures: [..., 36], degrees.

        Returns:
            [..., A + 1], natural logarithm, the last one none.

        Raises:
            ShapeError: other than 36 angles.
        """
        postures = postures.to(self.mean)
        z = self.project(postures)
        std = self.info.spread * self.std
        used = torch.arange(std.shape[-1], device=z.device) < self.n_dimensions[:, None]  # [A, D]
        tube = -0.5 * self._squared(z, std) - (std.log() * used[:, None]).sum(-1)  # [..., A, K]
        tube = (
            tube.masked_fill(~self._is_posture(), -math.inf).logsumexp(-1) - self.n_postures.log()
        )
        total = (postures.unsqueeze(-2) - self.mean).square().sum(-1)
        left = (total - z.square().sum(-1)).clamp_min(0) / self.residual_std.square()
        outside = -0.5 * left - (POSTURE_DIM - self.n_dimensions) * self.residual_std.log()
        whitened = ((postures - self.background_mean) @ self.background_axes) / self.background_std
        none = -0.5 * whitened.square().sum(-1) - self.background_std.log().sum()
        both = torch.cat([tube + outside, none[..., None]], -1)
        return both - 0.5 * POSTURE_DIM * math.log(2 * math.pi)

    def transition(self, fps: float | None = None) -> Float[Tensor, "S S"]:
        """Return the probabilities of the changes from each state to each in one frame.

        Args:
            fps: frames per second; by default that of the performances.

        Returns:
            [A + 1, A + 1], rows sum to 1; the last state is none.

        Raises:
            InputError: as `frame_rate`.
        """
        return chain_transition(len(self.names), self.info.stay, self.frame_rate(fps), self.mean)

    def evidence_share(self, fps: float | None = None) -> float:
        """Return min(1, evidence_rate / fps), the power to which the likelihood of a frame counts.

        Args:
            fps: frames per second; by default that of the performances.

        Returns:
            Exponent in (0, 1].

        Raises:
            InputError: as `frame_rate`.
        """
        return evidence_share(self.info.evidence_rate, self.frame_rate(fps))

    def frame_rate(self, fps: float | None = None) -> float:
        """Return the given frame rate, or that of the performances.

        Args:
            fps: frames per second; None is that of the performances.

        Returns:
            Frames per second.

        Raises:
            InputError: not positive, or there is none.
        """
        rate = self.info.fps if fps is None else fps
        if rate is None:
            raise InputError("the actions were fitted without a frame rate; give fps")
        if not 0 < rate < math.inf:
            raise InputError(f"fps must be positive, got {rate:g}")
        return rate

    def start(self) -> Float[Tensor, " S"]:
        """Return the log-probabilities [A + 1] of the states before the first frame: all alike."""
        return self.mean.new_full((len(self.names),), -math.log(len(self.names)))

    def update(
        self,
        log_posterior: Float[Tensor, "*#batch S"],
        postures: Float[Tensor, "*batch 36"],
        fps: float | None = None,
    ) -> Float[Tensor, "*batch S"]:
        """Take one frame of the recursion over actions, see `chain_step`.

        Args:
            log_posterior: [..., A + 1], of the frame before. postures: [..., 36], of this frame.
            fps: frames per second; by default that of the performances.

        Returns:
            Log-posterior of this frame [..., A + 1], normalised.

        Raises:
            ShapeError: other than 36 angles. InputError: as `frame_rate`.
        """
        log_likelihood = self.log_likelihood(postures)
        log_transition = self.transition(fps).log()
        return chain_step(log_posterior, log_likelihood, log_transition, self.evidence_share(fps))

    def recognise(
        self, postures: Float[Tensor, "*batch T 36"], fps: float | None = None
    ) -> Float[Tensor, "*batch T S"]:
        """Return the posterior over the actions and none in every frame, given the frames up to it.

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
        log_transition, share = self.transition(fps).log(), self.evidence_share(fps)
        log, found = self.start(), []
        for frame in self.log_likelihood(postures).unbind(-2):
            log = chain_step(log, frame, log_transition, share)
            found.append(log)
        return torch.stack(found, -2).exp()

    # --- files ------------------------------------------------------------------------------------

    def save(self, path: str | Path) -> None:
        """Write the bank as safetensors, atomically: an interrupted write leaves no partial file.

        Args:
            path: the file, which is replaced.

        Raises:
            OutputError: the file cannot be written.
        """
        tensors = {n: getattr(self, n) for n in (*BANK_FILE.tensors, *BANK_FILE.indices)}
        write_tensors(path, BANK_FILE, self.info, tensors)

    @classmethod
    def load(cls, path: str | Path) -> "ActionBank":
        """Read what `save` has written.

        Args:
            path: safetensors file.

        Returns:
            The bank, in float64.

        Raises:
            InputError: no such file, or settings out of range. FileFormatError: damaged, or a file
                of another kind. SkeletonError: limbs of other names.
        """
        info, tensors = read_tensors(path, BANK_FILE)
        with reading(path, "a bank of actions"):
            check_limbs(info.limbs)
            _check_settings(info)
        if len(info.names) != len(tensors["mean"]):
            raise FileFormatError(
                f"{path}: expected a name for each of {len(tensors['mean'])} actions, got "
                f"{len(info.names)}; fit the bank again"
            )
        for name, size in zip(BANK_FILE.indices, tensors["performance"].shape[1:], strict=True):
            check_number_range(path, name, tensors[name], 1, size)
        bank = cls.__new__(cls)
        NoHalfModule.__init__(bank)
        bank.info = info
        for name, value in tensors.items():
            bank.register_buffer(name, value if name in BANK_FILE.indices else value.double())
        return bank

    # --- pieces -----------------------------------------------------------------------------------

    def _project_on_own(self, postures: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Return the projection [..., D] of each on its own action, and that action (none: the last one)."""
        own = actions.clamp_max(self.none - 1)
        z = self.project(postures)
        index = own[..., None, None].expand(*own.shape, 1, z.shape[-1])
        return z.gather(-2, index).squeeze(-2), own

    def _squared(self, z: Tensor, std: Tensor) -> Tensor:
        """Return sum_d (z_d - g_{k,d})^2 / std_{k,d}^2 of every action and posture, [..., A, K].

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
        """Return the number of dimensions that the gates use."""
        return min(self.info.gate_dimensions or self.basis.shape[-1], self.basis.shape[-1])

    def _is_posture(self) -> Tensor:
        """Return [A, K], True for postures that are not padding."""
        k = torch.arange(self.performance.shape[1], device=self.performance.device)
        return k < self.n_postures[:, None]

    def extra_repr(self) -> str:
        return ", ".join(self.names)


def _check_settings(info: BankInfo) -> None:
    check_chain(len(info.names) + 1, info.stay, info.evidence_rate)
    for name in ("spread", "background"):
        if not 0 < getattr(info, name) < math.inf:
            raise InputError(f"{name} must be positive, got {getattr(info, name):g}")
    if info.gate_dimensions is not None:
        check_count("gate_dimensions", info.gate_dimensions)
