"""Model the postures of one action: a principal subspace, a mean performance and gates around it."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.checks import check_finite, check_generator, check_shape
from torchpose._core.module_state import NoHalfModule, register_given
from torchpose._core.moved import moved_function
from torchpose._core.reading import reading
from torchpose._core.tensor_file import read_tensors, write_tensors
from torchpose.errors import InputError, PriorError
from torchpose.priors._actions.action_file import SPACE_FILE, ActionInfo, Synchronised
from torchpose.priors._actions.gate import (
    CLAMP_ROUNDS,
    GATE_WIDTH,
    Acceptance,
    check_gate_width,
    clamp_in_rounds,
    clamp_offset,
    match_postures,
    passes_any_gate,
)
from torchpose.priors._actions.polar_limbs import POSTURE_DIM, check_limbs


class ActionSpace(NoHalfModule):
    """Holds the action model Gamma = (Omega, g, sigma_k) of aSpace, over postures of 36 angles in degrees.

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
        variances: the variances of the training postures along each axis, [D]. lost_variance: of all other
            directions together; degrees^2.
        info: facts about the fit.

    Attributes:
        synchronised: the performances in step, which `torchpose.viz.plot_action_space` draws; None where the
            space was loaded from a file, which does not hold them.

    Buffers: the seven tensors.

    Raises:
        ShapeError: other sizes. InputError: not finite, or a deviation that is not positive.
        SkeletonError: limbs of other names.

    Reference: Rius, Varona, Roca & Gonzalez, Posture constraints for Bayesian human motion
    tracking, AMDO 2006, section 2 and equations (1) and (6).

    >>> from torchpose.learning import fit_action_space
    >>> t = torch.linspace(0, 3.14, 40, dtype=torch.float64)[:, None]
    >>> sway = torch.rand(1, 36, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    >>> bends = [40 * (1 + 0.1 * i) * t.sin() * sway + 5 * (i * t).cos() for i in range(5)]
    >>> space = fit_action_space(bends, 2, name="bend", fps=30.0)
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
        self.synchronised: Synchronised | None = None
        check_limbs(self.info.limbs)
        check_shape("basis", basis, [POSTURE_DIM, None])
        d = basis.shape[1]
        if d < 1:
            raise InputError("an action space needs at least one dimension, got a basis of none")
        check_shape("performance", performance, ["K", d])
        count = len(performance)
        if count < 1:
            raise InputError(
                "an action space needs at least one posture, got a performance of none"
            )
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
            register_given(self, name, value)

    fit = staticmethod(moved_function("ActionSpace.fit", "torchpose.learning.fit_action_space"))
    fit_synchronised = staticmethod(
        moved_function(
            "ActionSpace.fit_synchronised", "torchpose.learning._action_spaces.fit_synchronised"
        )
    )

    # --- sizes ------------------------------------------------------------------------------------

    @property
    def n_dimensions(self) -> int:
        """Return D."""
        return self.basis.shape[1]

    @property
    def n_postures(self) -> int:
        """Return K."""
        return len(self.performance)

    def with_dimensions(self, n_dimensions: int) -> "ActionSpace":
        """Return the same action in its first dimensions only.

        Args:
            n_dimensions: number of dimensions to keep, 1 to D.

        Returns:
            `ActionSpace` of that many dimensions.

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
        first = ActionSpace(
            self.mean, self.basis[:, :d].contiguous(), self.performance[:, :d].contiguous(),
            self.std[:, :d].contiguous(), self.match_std[:d], self.variances[:d], total - kept,
            replace(self.info, explained=float(kept / total)),
        )  # fmt: skip
        if self.synchronised is not None:
            before, after = self.synchronised.before, self.synchronised.after
            first.synchronised = self.synchronised._replace(
                before=before[..., :d], after=after[..., :d]
            )
        return first

    # --- postures and the subspace ----------------------------------------------------------------

    def project(self, postures: Float[Tensor, "*batch 36"]) -> Float[Tensor, "*batch D"]:
        """Project postures on the first D principal axes, z = (phi - m) U.

        Args:
            postures: phi [..., 36], degrees.

        Returns:
            z [..., D], degrees.

        Raises:
            ShapeError: other than 36 angles.
        """
        check_shape("postures", postures, ["...", POSTURE_DIM])
        return (postures.to(self.mean) - self.mean) @ self.basis

    def reconstruct(self, z: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch 36"]:
        """Return the posture m + U z.

        Args:
            z: [..., D], degrees.

        Returns:
            [..., 36], degrees.

        Raises:
            ShapeError: another number of dimensions.
        """
        check_shape("z", z, ["...", self.n_dimensions])
        return self.mean + z.to(self.mean) @ self.basis.mT

    # --- the gate ---------------------------------------------------------------------------------

    def log_match(self, z: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch K"]:
        """Return log N(z; g_k, Delta) for every posture k, up to a constant that all of them share.

        Args:
            z: [..., D], degrees.

        Returns:
            [..., K], natural logarithm.

        Raises:
            ShapeError: another number of dimensions.
        """
        check_shape("z", z, ["...", self.n_dimensions])
        a, b = z / self.match_std, self.performance / self.match_std
        return a @ b.mT - 0.5 * b.square().sum(-1) - 0.5 * a.square().sum(-1, keepdim=True)

    def match(
        self, z: Float[Tensor, "*batch D"], generator: torch.Generator | None = None
    ) -> Int[Tensor, "*batch"]:
        """Draw the matched posture j of every z with probability proportional to N(z; g_j, Delta).

        Args:
            z: [..., D]. generator: the generator of the random numbers.

        Returns:
            Indices [...] from 0 to K - 1.

        Raises:
            ShapeError: another number of dimensions. InputError: no generator.
        """
        check_generator(generator)
        uniform = torch.rand(z.shape[:-1], generator=generator, dtype=z.dtype, device=z.device)
        return match_postures(self.log_match(z), uniform)

    def best_match(self, z: Float[Tensor, "*batch D"]) -> Int[Tensor, "*batch"]:
        """Return the most likely posture j of the mean performance for every z.

        Args:
            z: [..., D], degrees.

        Returns:
            Indices [...] from 0 to K - 1.

        Raises:
            ShapeError: another number of dimensions.
        """
        return self.log_match(z).argmax(-1)

    def inside(
        self, z: Float[Tensor, "*batch D"], j: Int[Tensor, "*batch"], width: float = GATE_WIDTH
    ) -> Bool[Tensor, "*batch"]:
        """Return whether z lies in the gate of posture j in all dimensions (AS 6).

        Args:
            z: [..., D]. j: [...]. width: the width of the gate, in sigma to either side; 2 as published.

        Returns:
            Bool [...].

        Raises:
            InputError: a width that is not positive.
        """
        check_gate_width(width)
        return ((z - self.performance[j]).abs() < width * self.std[j]).all(-1)

    def clamp(
        self, z: Float[Tensor, "*batch D"], j: Int[Tensor, "*batch"], width: float = GATE_WIDTH
    ) -> Float[Tensor, "*batch D"]:
        """Return the nearest point of the gate of posture j.

        Args:
            z: [..., D], degrees. j: [...]. width: the width of the gate, in sigma to either side.

        Returns:
            [..., D], degrees; z itself where it is inside.

        Raises:
            InputError: a width that is not positive.
        """
        check_gate_width(width)
        centre = self.performance[j]
        return centre + clamp_offset(z - centre, self.std[j], width)

    def clamp_postures(
        self,
        postures: Float[Tensor, "*batch 36"],
        j: Int[Tensor, "*batch"],
        width: float = GATE_WIDTH,
        rounds: int = CLAMP_ROUNDS,
    ) -> Float[Tensor, "*batch 36"]:
        """Move postures into the gate of posture j; those inside stay as they are.

        A projection is clamped and what lies outside of the D dimensions stays. That leaves angles
        of no direction, and those of the directions nearest to them are outside again: so both are
        done in turn, with a gate nine tenths as wide. Nearly all are inside in the end, the others next
        to it.

        Args:
            postures: [..., 36], degrees. j: [...]. width: the width of the gate.
            rounds: 0 clamps once and leaves the angles as they come out, inside in any case.

        Returns:
            Postures [..., 36], degrees.
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
        """Return the share of true postures that the gate lets through.

        One that deviates as the training postures do, independently in D dimensions and matched
        without error, passes with probability erf(width / sqrt 2)^D: 0.55 for 2 sigma and D = 13.

        Args:
            postures: [N, 36], degrees. width: the width of the gate. generator: for the matching.

        Returns:
            `Acceptance`, three shares from 0 to 1.

        Raises:
            InputError: no posture, or one that is not finite. ShapeError: other than 36 angles.
        """
        z = self.project(postures)
        if len(z) == 0:
            raise InputError("an acceptance needs at least one posture, got none")
        check_finite("postures", postures, hint="leave out the frames with missing joints")
        somewhere = passes_any_gate(z, self.performance, self.std, width)
        return Acceptance(
            float(self.inside(z, self.match(z, generator), width).double().mean()),
            float(self.inside(z, self.best_match(z), width).double().mean()),
            float(somewhere.double().mean()),
        )

    # --- files ------------------------------------------------------------------------------------

    def save(self, path: str | Path) -> None:
        """Write the action space as safetensors, atomically: an interrupted write leaves no partial file.

        Args:
            path: the file, which is replaced.

        Raises:
            OutputError: the file cannot be written.
        """
        tensors = {name: getattr(self, name) for name in SPACE_FILE.tensors}
        write_tensors(path, SPACE_FILE, self.info, tensors)

    @classmethod
    def load(cls, path: str | Path) -> "ActionSpace":
        """Read what `save` has written.

        Args:
            path: safetensors file.

        Returns:
            The action space, in float64.

        Raises:
            InputError: no such file. FileFormatError: damaged, or a file of another kind.
            SkeletonError: limbs of other names.
        """
        info, tensors = read_tensors(path, SPACE_FILE)
        with reading(path, "an action space"):
            return cls(**{name: value.double() for name, value in tensors.items()}, info=info)

    def check_for(self, limbs: Sequence[str]) -> None:
        """Check that postures are of the limbs that this action is of.

        Args:
            limbs: their names, in order.

        Raises:
            PriorError: other limbs, or another order.
        """
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
