"""Hold a prior over arms that depends on no camera: directions of limbs, lengths of bones."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose._core.checks import check_shape
from torchpose._core.module_state import outside_inference, register_given
from torchpose._core.reading import reading
from torchpose._core.tensor_file import FileKind, read_tensors, require_tensor, write_tensors
from torchpose.errors import InputError, PriorError
from torchpose.priors._gaussian_mixture import GaussianMixture

LENGTHS = ("upper_arm", "forearm", "forearm_to_hand", "shoulder_width", "head_height")
"""Lengths of an `ArmPrior`: shoulder to elbow, elbow to wrist, elbow to the middle of the hand,
between the shoulders, and from Kinect's neck up to the head."""

_SPHERES = 2 * math.log(4 * math.pi)  # log of the area of S^2 x S^2
_SHIPPED = Path(__file__).resolve().parents[1] / "weights" / "arms" / "upper-body-arms.safetensors"
_POINTS = 20_000  # on both spheres, by which a density is integrated
_PARTS = ("weights", "means", "covariances")


@dataclass(frozen=True)
class ArmPriorInfo:
    """Holds facts about the fit of an `ArmPrior`.

    Attributes:
        name: the name of the prior. persons: ids of the persons in the training recordings.
        sources: data sets. licence: the licence of the data. command: that made the prior.
        extra: anything else that JSON can hold.
    """

    name: str = ""
    persons: tuple[str, ...] = ()
    sources: tuple[str, ...] = ()
    licence: str = ""
    command: str = ""
    extra: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("persons", "sources"):
            object.__setattr__(self, name, tuple(getattr(self, name)))


_KIND = FileKind("torchpose-arms", 1, ArmPriorInfo)


class ArmPrior(nn.Module):
    """Holds a density over the directions of an arm's two bones, and a Gaussian over log-lengths of bones.

        p(d_u, d_f) = (1 - b) / Z sum_k pi_k N([d_u, d_f]; mu_k, Sigma_k) + b / (4 pi)^2

    d_u and d_f are the unit vectors of the left upper arm and forearm in upright axes that turn with the
    shoulders: x to the person's left along the level part of the line between the shoulders, y down,
    z to the back. The right arm is the mirror image. Z is the mixture's mass on pairs of unit vectors,
    so that the density is one over S^2 x S^2; b is the share of the broad part, which expects nothing.
    What both arms do goes together by the components alone: a left arm is of j and a mirrored right one of
    k in a share A_jk of the frames.

    Args:
        directions: mixture over R^6. lengths: medians of `LENGTHS` [5], metres. spread: standard
            deviations of their logs over persons [5]. broad: b. info: facts about the fit.
        together: A, symmetric, of which each row sums to pi_j; pi_j pi_k (arms apart) by default.

    Raises:
        PriorError: a mixture of another size, lengths and spreads that are not positive, or pairs of
            components whose shares do not sum to the weights.

    >>> prior = shipped_arm_prior()
    >>> hanging = torch.tensor([0.0, 1.0, 0.0, 0.0, 1.0, 0.0], dtype=torch.float64)
    >>> bool(prior.log_prob(hanging) > prior.log_prob(-hanging))
    True
    """

    lengths: Tensor
    spread: Tensor
    together: Tensor
    log_mass: Tensor

    def __init__(
        self,
        directions: GaussianMixture,
        lengths: Float[Tensor, " 5"],
        spread: Float[Tensor, " 5"],
        broad: float = 0.1,
        info: ArmPriorInfo | None = None,
        together: Float[Tensor, "K K"] | None = None,
    ) -> None:
        super().__init__()
        if directions.dim != 6:
            raise PriorError(
                f"directions must be a mixture over 6 dimensions, two unit vectors, got {directions.dim}"
            )
        for name, value in (("lengths", lengths), ("spread", spread)):
            check_shape(name, value, [len(LENGTHS)])
            if not bool((value > 0).all()):
                raise PriorError(f"{name} must be positive, got {value.tolist()}")
        if not 0 < broad < 1:
            raise InputError(f"broad must lie between 0 and 1, got {broad!r}")
        self.directions, self.broad = directions, broad
        register_given(self, "lengths", lengths)
        register_given(self, "spread", spread)
        self.info = info or ArmPriorInfo()
        register_given(self, "together", _checked(together, directions.weights))
        self.register_buffer("log_mass", _log_mass(directions))

    def log_prob(self, directions: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch"]:
        """Return log p(d_u, d_f) over pairs of unit vectors.

        Args:
            directions: upper arm and forearm of a left arm, or of a mirrored right one.
        """
        check_shape("directions", directions, ("...", 6))
        known = self.directions.log_prob(directions) - self.log_mass
        broad = torch.full_like(known, math.log(self.broad) - _SPHERES)
        return torch.logaddexp(known + math.log1p(-self.broad), broad)

    def save(self, path: str | Path) -> None:
        """Write the prior as safetensors; the file appears whole or not at all.

        Raises:
            OutputError: the file cannot be written.
        """
        tensors = {part: getattr(self.directions, part) for part in _PARTS}
        broad = torch.tensor([self.broad], dtype=torch.float64)
        tensors |= {"lengths": self.lengths, "spread": self.spread, "broad": broad}
        tensors["together"] = self.together
        write_tensors(path, _KIND, self.info, {k: v.detach().cpu() for k, v in tensors.items()})

    @classmethod
    def load(cls, path: str | Path) -> ArmPrior:
        """Read a prior that `save` wrote; tensors come back in float64.

        Raises:
            InputError: no such file. FileFormatError: truncated, foreign, damaged, or newer.
        """
        info, tensors = read_tensors(path, _KIND)
        with reading(path, "a prior over arms"):
            named = {
                name: require_tensor(path, tensors, name).double()
                for name in (*_PARTS, "lengths", "spread", "broad")
            }
            together = tensors.get("together")  # earlier files have none
            return cls(
                GaussianMixture(*(named[part] for part in _PARTS)), named["lengths"], named["spread"],
                float(named["broad"]), info, None if together is None else together.double(),
            )  # fmt: skip


@cache
def shipped_arm_prior() -> ArmPrior:
    """Return the prior over arms that comes with the package, the same one each time: change a copy."""
    with outside_inference():
        return ArmPrior.load(_SHIPPED)


def _checked(
    together: Float[Tensor, "K K"] | None, weights: Float[Tensor, " K"]
) -> Float[Tensor, "K K"]:
    """Return the shares of pairs of components: those of arms apart unless they are given.

    Raises:
        ShapeError, PriorError: shares that are none.
    """
    if together is None:
        return weights[:, None] * weights
    check_shape("together", together, [len(weights)] * 2)
    alike = torch.allclose(together, together.mT, atol=1e-6)
    sums = torch.allclose(together.sum(1).to(weights), weights, atol=1e-4)
    if not (alike and sums and bool((together >= 0).all())):
        raise PriorError(
            "together must be symmetric, not negative, and sum to the weights of the directions; got "
            f"sums {together.sum(1).tolist()}"
        )
    return together


def _log_mass(mixture: GaussianMixture) -> Tensor:
    """Return the log of the mixture's integral over S^2 x S^2, by points spread over both spheres."""
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(_POINTS, 2, 3, generator=generator, dtype=torch.float64)
    points = torch.nn.functional.normalize(points, dim=-1).flatten(1)
    with torch.no_grad():
        density = mixture.log_prob(points.to(mixture.means.device))
    return torch.logsumexp(density, 0) - math.log(_POINTS) + _SPHERES
