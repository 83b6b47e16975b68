"""The postures of one action: a principal subspace, a mean performance in it and a tube around it."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchpose.errors import InputError, PriorError, check_finite, check_shape
from torchpose.priors.postures import LIMBS_12, POSTURE_DIM, check_limbs, normalise_postures
from torchpose.priors.synchronisation import Synchronised, synchronise
from torchpose.priors.tensor_file import FileKind, read_tensors, write_tensors

__all__ = [
    "CLAMP_ROUNDS",
    "GATE_WIDTH",
    "Acceptance",
    "ActionInfo",
    "ActionSpace",
    "clamp_in_rounds",
    "match_postures",
]

GATE_WIDTH = 2.0
"""Deviations on either side of the matched posture that (AS 6) allows."""

CLAMP_ROUNDS = 10
"""In which postures are moved into a gate."""

_MARGIN = 0.9  # of the gate, to which postures are clamped in rounds
_STD_FLOOR = 0.1  # of a dimension's deviation over the whole performance
_LEAST_STD = 0.1  # degrees
_SMALLEST_VARIANCE = 1e-10  # of the largest; below it a direction is rounding
_INSIDE = 1 - 1e-6  # of the gate, to which postures are clamped
_CHUNK = 4_000_000  # entries of a table of distances


@dataclass(frozen=True)
class ActionInfo:
    """What an action space was fitted on; fields that are not known are empty.

    Attributes:
        name: of the action. fps: of the performances. limbs: that the postures are of.
        performances: how many there were. key_frames: indices of the key postures.
        explained: share of the variance of the postures that the D dimensions hold.
        persons: ids. sources: recordings or data sets. licence: of the data. command: that made it.
        extra: anything else that JSON can hold.
    """

    name: str = ""
    fps: float | None = None
    limbs: tuple[str, ...] = tuple(limb.name for limb in LIMBS_12)
    performances: int = 0
    key_frames: tuple[int, ...] = ()
    explained: float | None = None
    persons: tuple[str, ...] = ()
    sources: tuple[str, ...] = ()
    licence: str = ""
    command: str = ""
    extra: dict[str, Any] = field(default_factory=dict)


_FILE = FileKind(
    "torchpose-action-space",
    1,
    ActionInfo,
    tensors={
        "mean": "36",
        "basis": "36 D",
        "performance": "K D",
        "std": "K D",
        "match_std": "D",
        "variances": "D",
        "lost_variance": "",
    },
)


class Acceptance(NamedTuple):
    """Share of postures that the gate lets through, by how j is chosen.

    Attributes:
        drawn: j drawn from its Gaussian, as in the filter. best: the most likely j. any: any j at all.
    """

    drawn: float
    best: float
    any: float


class ActionSpace(nn.Module):
    """The action model Gamma = (Omega, g, sigma_k) of aSpace, over postures of 36 angles in degrees.

    With phi a posture, z = (phi - m) U its projection on the first D principal axes (Omega),
    g_k the k-th posture of the synchronised mean performance and sigma_k its deviation (AS 1):

        matched   j ~ N(z; g_j, Delta) over all k,        inside   |z_d - g_{j,d}| < 2 sigma_{j,d}
        posture                                                    for all d = 1..D   (AS 6).

    Delta is diagonal, the mean square of z - g_k over all performances of the training set. sigma_k
    is never below a tenth of its dimension's root of Delta, nor below 0.1 degrees: at the key frames,
    at which performances are matched, it would be too narrow for anybody else. The postures of an
    action are the same at any frame rate, and so is all of this.

    Args:
        mean: m, [36], degrees. basis: U, [36, D], orthonormal columns.
        performance: g, [K, D]. std: sigma, [K, D]. match_std: root of Delta, [D]. All in degrees.
        variances: of the training postures along each axis, [D]. lost_variance: of all other
            directions together; degrees^2.
        info: what it was fitted on.

    Buffers: the seven tensors.

    Raises:
        ShapeError: other sizes. InputError: not finite, or a deviation that is not positive.
        SkeletonError: limbs of other names.

    Reference: Rowe, Rius, Gonzalez & Villanueva, Posture constraints for Bayesian human motion
    tracking, AMDO 2006, section 2 and equations (1) and (6).

    >>> t = torch.linspace(0, 3.14, 40, dtype=torch.float64)[:, None]
    >>> sway = torch.rand(1, 36, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    >>> bends = [40 * (1 + 0.1 * i) * t.sin() * sway + 5 * (i * t).cos() for i in range(5)]
    >>> space = ActionSpace.fit(bends, 2, name="bend", fps=30.0)
    >>> z = space.project(bends[0])
    >>> j = space.match(z, torch.Generator().manual_seed(0))
    >>> space.inside(z, j).shape
    torch.Size([40])
    """

    mean: Tensor
    basis: Tensor
    performance: Tensor
    std: Tensor
    match_std: Tensor
    variances: Tensor
    lost_variance: Tensor

    def __init__(
        self,
        mean: Float[Tensor, " 36"],
        basis: Float[Tensor, "36 D"],
        performance: Float[Tensor, "K D"],
        std: Float[Tensor, "K D"],
        match_std: Float[Tensor, " D"],
        variances: Float[Tensor, " D"],
        lost_variance: Float[Tensor, ""],
        info: ActionInfo | None = None,
    ) -> None:
        super().__init__()
        self.info = info or ActionInfo()
        check_limbs(self.info.limbs)
        check_shape("basis", basis, [POSTURE_DIM, None])
        d = basis.shape[1]
        if d < 1:
            raise InputError("an action space needs at least one dimension, got a basis of none")
        check_shape("performance", performance, ["K", d])
        count = len(performance)
        given = {
            "mean": (mean, [POSTURE_DIM]), "basis": (basis, [POSTURE_DIM, d]),
            "performance": (performance, [count, d]), "std": (std, [count, d]),
            "match_std": (match_std, [d]), "variances": (variances, [d]),
            "lost_variance": (lost_variance, []),
        }  # fmt: skip
        for name, (value, shape) in given.items():
            check_shape(name, value, shape)
            check_finite(name, value)
            if name in ("std", "match_std") and not bool((value > 0).all()):
                raise InputError(f"{name} must be positive, degrees, got {float(value.min()):g}")
            self.register_buffer(name, value)

    @classmethod
    def fit(
        cls,
        performances: Sequence[Float[Tensor, "_ 36"]],
        n_dimensions: int = 13,
        *,
        name: str = "",
        fps: float | None = None,
        n_postures: int | None = None,
        prominence: float = 0.15,
        info: ActionInfo | None = None,
    ) -> "ActionSpace":
        """Fit an action space to performances of one action (AS 1).

        Performances are synchronised in all principal axes, whatever D is, so that
        `with_dimensions(d)` of a larger space is the fit with d.

        Args:
            performances: [T_p, 36] each, degrees, of any lengths, one repetition of the action from
                its start to its end (`split_repetitions` cuts them out of recordings).
            n_dimensions: D; reduced, with a warning, if the postures span fewer.
            name: of the action. fps: of the performances, for the record.
            n_postures: K; by default the median length. prominence: see `synchronise`.
            info: more facts; name, fps and what the fit finds are filled in.

        Raises:
            InputError: one performance only, one with too few frames, NaN, D not positive.
            ShapeError: postures of other than 36 angles.
        """
        space, _ = cls.fit_synchronised(
            performances, n_dimensions, name=name, fps=fps, n_postures=n_postures,
            prominence=prominence, info=info,
        )  # fmt: skip
        return space

    @classmethod
    def fit_synchronised(
        cls,
        performances: Sequence[Float[Tensor, "_ 36"]],
        n_dimensions: int = 13,
        *,
        name: str = "",
        fps: float | None = None,
        n_postures: int | None = None,
        prominence: float = 0.15,
        info: ActionInfo | None = None,
    ) -> tuple["ActionSpace", Synchronised]:
        """The same as `fit`, and the performances in the D dimensions before and after being put in
        step, for pictures."""
        _check_fit(performances, n_dimensions)
        postures = torch.cat([p.detach().double() for p in performances])
        check_finite("postures", postures, hint="cut out the frames with missing joints")
        mean = postures.mean(0)
        variances, axes = _principal_axes(postures - mean)
        rank = int((variances > _SMALLEST_VARIANCE * variances[0]).sum())
        if n_dimensions > rank:
            warnings.warn(
                f"the postures of {name or 'the action'} span {rank} dimensions, fewer than the "
                f"{n_dimensions} that were asked for: the action space has {rank}",
                stacklevel=3,
            )
        d = min(n_dimensions, rank)
        axes = axes[:, :rank]
        projected = [(p.detach().double() - mean) @ axes for p in performances]
        found = synchronise(projected, n_postures, prominence)
        found = found._replace(before=found.before[..., :d], after=found.after[..., :d])
        performance, std = found.after.mean(0), found.after.std(0)
        match_std = (found.after - performance).square().mean((0, 1)).sqrt().clamp_min(_LEAST_STD)
        facts = replace(
            info or ActionInfo(), performances=len(performances), key_frames=found.key_frames,
            explained=float(variances[:d].sum() / variances.sum()),
        )  # fmt: skip
        facts = replace(facts, name=name or facts.name, fps=facts.fps if fps is None else fps)
        space = cls(
            mean, axes[:, :d].contiguous(), performance, torch.maximum(std, _STD_FLOOR * match_std),
            match_std, variances[:d].clone(), variances[d:].sum(), facts,
        )  # fmt: skip
        return space, found

    # --- sizes ------------------------------------------------------------------------------------

    @property
    def n_dimensions(self) -> int:
        """D."""
        return self.basis.shape[1]

    @property
    def n_postures(self) -> int:
        """K."""
        return len(self.performance)

    def with_dimensions(self, n_dimensions: int) -> "ActionSpace":
        """The same action in its first dimensions only.

        Raises:
            InputError: more than there are, or none.
        """
        if not 1 <= n_dimensions <= self.n_dimensions:
            raise InputError(
                f"expected from 1 to {self.n_dimensions} dimensions, got {n_dimensions}; fit the "
                "action space with as many as are needed"
            )
        d = n_dimensions
        total = self.variances.sum() + self.lost_variance
        kept = self.variances[:d].sum()
        return ActionSpace(
            self.mean, self.basis[:, :d].contiguous(), self.performance[:, :d].contiguous(),
            self.std[:, :d].contiguous(), self.match_std[:d], self.variances[:d], total - kept,
            replace(self.info, explained=float(kept / total)),
        )  # fmt: skip

    # --- postures and the subspace ----------------------------------------------------------------

    def project(self, postures: Float[Tensor, "*batch 36"]) -> Float[Tensor, "*batch D"]:
        """z = (phi - m) U, degrees."""
        check_shape("postures", postures, ["...", POSTURE_DIM])
        return (postures - self.mean) @ self.basis

    def reconstruct(self, z: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch 36"]:
        """The posture m + U z, degrees."""
        check_shape("z", z, ["...", self.n_dimensions])
        return self.mean + z @ self.basis.mT

    # --- the gate ---------------------------------------------------------------------------------

    def log_match(self, z: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch K"]:
        """log N(z; g_k, Delta) of every k, up to what they have in common."""
        check_shape("z", z, ["...", self.n_dimensions])
        a, b = z / self.match_std, self.performance / self.match_std
        return a @ b.mT - 0.5 * b.square().sum(-1) - 0.5 * a.square().sum(-1, keepdim=True)

    def match(
        self, z: Float[Tensor, "*batch D"], generator: torch.Generator | None = None
    ) -> Int[Tensor, "*batch"]:
        """The matched posture j of every z, drawn with probability proportional to N(z; g_j, Delta).

        Args:
            z: [..., D]. generator: of the random numbers.
        """
        uniform = torch.rand(z.shape[:-1], generator=generator, dtype=z.dtype, device=z.device)
        return match_postures(self.log_match(z), uniform)

    def best_match(self, z: Float[Tensor, "*batch D"]) -> Int[Tensor, "*batch"]:
        """The most likely posture of every z."""
        return self.log_match(z).argmax(-1)

    def inside(
        self, z: Float[Tensor, "*batch D"], j: Int[Tensor, "*batch"], width: float = GATE_WIDTH
    ) -> Bool[Tensor, "*batch"]:
        """Whether z lies in the gate of posture j in all dimensions (AS 6).

        Args:
            z: [..., D]. j: [...]. width: of the gate, in sigma to either side; 2 as published.
        """
        _check_width(width)
        return ((z - self.performance[j]).abs() < width * self.std[j]).all(-1)

    def clamp(
        self, z: Float[Tensor, "*batch D"], j: Int[Tensor, "*batch"], width: float = GATE_WIDTH
    ) -> Float[Tensor, "*batch D"]:
        """The nearest point of the gate of posture j; z itself where it is inside."""
        _check_width(width)
        reach = _INSIDE * width * self.std[j]
        return self.performance[j] + (z - self.performance[j]).clamp(-reach, reach)

    def clamp_postures(
        self,
        postures: Float[Tensor, "*batch 36"],
        j: Int[Tensor, "*batch"],
        width: float = GATE_WIDTH,
        rounds: int = CLAMP_ROUNDS,
    ) -> Float[Tensor, "*batch 36"]:
        """Postures moved into the gate of posture j; those inside stay as they are.

        A projection is clamped and what lies outside of the D dimensions stays. That leaves angles
        of no direction, and those of the directions nearest to them are outside again: so both are
        done in turn, with a gate nine tenths as wide. Nearly all are inside in the end, the others next
        to it.

        Args:
            postures: [..., 36], degrees. j: [...]. width: of the gate.
            rounds: 0 clamps once and leaves the angles as they come out, inside in any case.
        """

        def clamp(angles: Tensor, width: float) -> Tensor:
            z = self.project(angles)
            return angles + (self.clamp(z, j, width) - z) @ self.basis.mT

        inside = self.inside(self.project(postures), j, width)
        return clamp_in_rounds(postures, inside, clamp, width, rounds)

    def acceptance(
        self,
        postures: Float[Tensor, "N 36"],
        width: float = GATE_WIDTH,
        generator: torch.Generator | None = None,
    ) -> Acceptance:
        """Share of true postures that the gate lets through.

        One that deviates as the training postures do, independently in D dimensions and matched
        without error, passes with probability erf(width / sqrt 2)^D: 0.55 for 2 sigma and D = 13.

        Args:
            postures: [N, 36], degrees. width: of the gate. generator: for the matching.
        """
        z = self.project(postures)
        if len(z) == 0:
            raise InputError("an acceptance needs at least one posture, got none")
        somewhere = [
            self._anywhere(part, width)
            for part in z.split(max(1, _CHUNK // self.performance.numel()))
        ]
        return Acceptance(
            float(self.inside(z, self.match(z, generator), width).double().mean()),
            float(self.inside(z, self.best_match(z), width).double().mean()),
            float(torch.cat(somewhere).double().mean()),
        )

    def _anywhere(self, z: Tensor, width: float) -> Tensor:
        off = (z[:, None] - self.performance).abs()
        return (off < width * self.std).all(-1).any(-1)

    # --- files ------------------------------------------------------------------------------------

    def save(self, path: str | Path) -> None:
        """Write it as safetensors; the file appears whole or not at all.

        Raises:
            OutputError: the file cannot be written.
        """
        write_tensors(path, _FILE, self.info, {name: getattr(self, name) for name in _FILE.tensors})

    @classmethod
    def load(cls, path: str | Path) -> "ActionSpace":
        """Read what `save` has written.

        Raises:
            InputError: no such file. FileFormatError: damaged, or a file of another kind.
            SkeletonError: limbs of other names.
        """
        info, tensors = read_tensors(path, _FILE)
        return cls(**tensors, info=info)

    def check_for(self, limbs: Sequence[str]) -> None:
        """Raise `PriorError` unless the postures are of these limbs."""
        if tuple(limbs) != self.info.limbs:
            raise PriorError(
                f"the action space {self.info.name!r} is of the limbs {', '.join(self.info.limbs)}, "
                f"got {', '.join(limbs)}"
            )

    def extra_repr(self) -> str:
        return (
            f"{self.info.name!r}, n_dimensions={self.n_dimensions}, n_postures={self.n_postures}, "
            f"performances={self.info.performances}"
        )


def clamp_in_rounds(
    postures: Float[Tensor, "*batch 36"],
    inside: Bool[Tensor, "*batch"],
    clamp: Callable[[Tensor, float], Tensor],
    width: float,
    rounds: int,
) -> Float[Tensor, "*batch 36"]:
    """Clamp and normalise postures in turn, see `ActionSpace.clamp_postures`.

    Args:
        postures: [..., 36]. inside: [...], those that stay. clamp: postures to the gate of a width.
        width: of the gate. rounds: 0 clamps once.
    """
    moved = clamp(postures, width) if rounds == 0 else postures
    for _ in range(rounds):
        moved = normalise_postures(clamp(moved, _MARGIN * width))
    return torch.where(inside[..., None], postures, moved)


def match_postures(
    log_weights: Float[Tensor, "*batch K"], uniform: Float[Tensor, "*batch"]
) -> Int[Tensor, "*batch"]:
    """An index for every row, drawn by the inverse of its distribution function.

    Args:
        log_weights: [..., K], of any common factor. uniform: [...], in [0, 1).

    >>> match_postures(torch.tensor([[0.0, 0.0], [0.0, -99.0]]), torch.tensor([0.6, 0.9]))
    tensor([1, 0])
    """
    share = log_weights.softmax(-1).cumsum(-1)
    place = torch.searchsorted(share, (uniform * share[..., -1])[..., None])
    return place.squeeze(-1).clamp_max(log_weights.shape[-1] - 1)


def _principal_axes(moves: Tensor) -> tuple[Tensor, Tensor]:
    """Variances [36], falling, and axes [36, 36] with their largest entry positive."""
    variances, axes = torch.linalg.eigh(moves.mT @ moves / len(moves))
    variances, axes = variances.flip(0).clamp_min(0), axes.flip(1)
    largest = axes.gather(0, axes.abs().argmax(0, keepdim=True))
    return variances, axes * largest.sign()


def _check_fit(performances: Sequence[Tensor], n_dimensions: int) -> None:
    if n_dimensions < 1:
        raise InputError(f"n_dimensions must be at least 1, got {n_dimensions}")
    if len(performances) < 2:
        raise InputError(
            f"an action space needs the deviation between performances: expected two or more, got "
            f"{len(performances)}; add recordings, or cut one with `split_repetitions`"
        )
    for number, performance in enumerate(performances):
        check_shape(f"performance {number}", performance, ["T", POSTURE_DIM])
    first = performances[0].detach().double()
    if all(torch.equal(first, p.detach().double()) for p in performances[1:]):
        raise InputError("all performances are one and the same: there is no deviation to learn")


def _check_width(width: float) -> None:
    if not 0 < width < float("inf"):
        raise InputError(f"the width of the gate must be positive, in sigma, got {width}")
